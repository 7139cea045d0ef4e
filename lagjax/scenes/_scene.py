"""`Scene`: a system with parameters, a start, and what is known about its motion."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp

from lagjax._scene import System


@final
class Scene(eqx.Module):
    """A Lagrangian ready to move: the system, its parameters, a natural start, and what is known about the motion.

    `lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params)` runs it.

    - `system`: the `lagjax.System`.
    - `params`: default parameters, a dict.
    - `q0`, `qdot0`: initial state, in the structure the Lagrangian expects.
    - `duration`: a time that shows the motion; one period where the motion is periodic.
    - `exact`: `(t, q0, qdot0, params) -> (q, qdot)`, the closed solution of the state that is `(q0, qdot0)` at t = 0;
      None where there is none.
    - `invariants`: `{name: (q, qdot, t, params) -> scalar}`, constants of the motion.
    """

    system: System
    params: dict[str, Any]
    q0: Any
    qdot0: Any
    duration: float
    invariants: dict[str, Callable]
    exact: Callable | None = None


def conservative_scene(system: System, params, q0, qdot0, duration, more=None, exact=None) -> Scene:
    """A scene whose energy is constant, and the quantities `more` by name."""
    return Scene(system, params, q0, qdot0, duration, {"energy": system.energy} | (more or {}), exact)


def components(name: str, vector: Callable, axes: str = "xyz") -> dict[str, Callable]:
    """The components of a `vector`, a function of (q, qdot, t, params), along the axes: `name`_x, …."""
    return {
        f"{name}_{axis}": lambda q, qdot, t, params, k=k: vector(q, qdot, t, params)[k] for k, axis in enumerate(axes)
    }


def total_momentum(system: System) -> Callable:
    """The sum of ∂L/∂q̇ over bodies, of a scene whose q is an array (bodies, axes)."""
    return lambda *state: jnp.sum(system.momentum(*state), axis=0)
