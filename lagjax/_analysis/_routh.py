"""`routhian`: the motion of a scene without its cyclic coordinates, at given momenta of these.

    R(s, ṡ; μ) = L − μ·ċ,   ∂L/∂ċ(s, ṡ, ċ) = μ

R is a Lagrangian for the other coordinates s. The cyclic ones c follow by an integral of ċ over the time; machine code
follows them beside the others at no other price, so that the motion of the whole scene is that of `lagjax.simulate`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax._analysis._scene_state import SceneState
from lagjax._equations import factorize
from lagjax._interface import Layout, present, restrict_signature
from lagjax._run import simulate
from lagjax._scene import System


class Routhian(NamedTuple):
    """A scene without its cyclic coordinates.

    - `system`: its `System`, with the Lagrangian R. Its coordinates are an array (n − k,), in the order in which those
      left lie end to end (`names`), its parameters {"momenta": μ (k,), "params": the scene's own}.
    - `names`, `cyclic`: the names of the coordinates that are left, and of those that are gone.
    - `reduce(q, qdot, t=0.0, params=None)`: (s, ṡ, the parameters of `system`) of a state of the scene.
    - `restore(s, sdot, c, params, t=0.0)`: the state (q, q̇) of the scene, with the cyclic coordinates c (k,).
    - `simulate(q0, qdot0, ts, params, **options)`: the motion of the whole scene, a `Trajectory`.
    """

    system: System
    names: tuple[str, ...]
    cyclic: tuple[str, ...]
    reduce: Callable
    restore: Callable
    simulate: Callable


def routhian(system: System, q: PyTree, qdot: PyTree, params: PyTree = None) -> Routhian:
    r"""`system` without the cyclic coordinates on which no force acts, at constant momenta of these.

        R(s, ṡ; μ) = L − μ·ċ      with ċ from  ∂L/∂ċ = μ

    Which coordinates these are is read off the scene's programs; of q, qdot and params only the structure matters. L
    must be quadratic in their velocities.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, a system with constraints or forces, or
    without cyclic coordinates, or where nothing would be left.

    Source: Routh, *Stability of a Given State of Motion* (1877); Landau & Lifshitz, *Mechanics*, §41.

    ```python
    import lagjax

    kepler = lagjax.System(lambda q, v: 0.5 * (v["r"] ** 2 + (q["r"] * v["phi"]) ** 2) + 1 / q["r"])
    radial = lagjax.routhian(kepler, {"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": 1.0})
    print(radial.names)  # ("q['r']",)
    ```
    """
    scene = SceneState.from_state(system, q, qdot, params)
    if scene.constrained or system.forces is not None or system.dissipation is not None:
        raise ValueError("routhian is of systems without constraints, forces and dissipation: R is a Lagrangian alone.")
    gone, layout = np.array(scene.conserved, int), scene.layout
    left = np.setdiff1d(np.arange(layout.size), gone)
    if not len(gone) or not len(left):
        what = "every coordinate is" if len(gone) else "no coordinate is"
        more = ", …" if layout.size > 8 else ""
        raise ValueError(f"There is nothing to reduce: {what} cyclic ({', '.join(layout.names[:8])}{more}).")
    whole = _CyclicSplit(scene.system, layout, left, gone)
    extras = {*system.lagrangian.extras, "params"}
    reduced = System(restrict_signature(whole.routh, extras), path=system.path)  # pyright: ignore[reportArgumentType]
    names = tuple(layout.names[i] for i in left), tuple(layout.names[i] for i in gone)
    return Routhian(reduced, *names, whole.reduce, whole.restore, functools.partial(simulate, scene.system))


class _CyclicSplit(NamedTuple):
    """A scene before reduction, with the indices of its coordinates that are `left` and of the cyclic ones, `gone`."""

    system: System
    layout: Layout
    left: np.ndarray
    gone: np.ndarray

    def join_coordinates(self, s, c) -> Array:
        return jnp.zeros(self.layout.size, self.layout.dtype).at[self.left].set(s).at[self.gone].set(c)

    def lagrangian(self, s, sdot, cdot, t, params):
        q, qdot = self.join_coordinates(s, jnp.zeros(len(self.gone))), self.join_coordinates(sdot, cdot)
        return present(self.system.lagrangian)(self.layout.restore(q), self.layout.restore(qdot), t=t, params=params)

    def cyclic_velocity(self, s, sdot, t, params) -> Array:
        """Return ċ (k,) of the cyclic coordinates from the momenta in `params`, those of the reduced scene."""
        none = jnp.zeros(len(self.gone), self.layout.dtype)

        momenta = jax.grad(lambda cdot: self.lagrangian(s, sdot, cdot, t, params["params"]))
        mass, missing = jax.jacfwd(momenta)(none), params["momenta"] - momenta(none)
        if len(self.gone) == 1:  # a division, of which machine code is made
            return missing / mass[0]
        return factorize(mass).solve(missing)

    def routh(self, s, sdot, t, params):
        cdot = self.cyclic_velocity(s, sdot, t, params)
        return self.lagrangian(s, sdot, cdot, t, params["params"]) - params["momenta"] @ cdot

    def reduce(self, q, qdot, t: Any = 0.0, params=None) -> tuple[Array, Array, dict]:
        p = self.layout.flatten(self.system.momentum(q, qdot, t, params))[self.gone]
        q, qdot = self.layout.flatten(q), self.layout.flatten(qdot)
        return q[self.left], qdot[self.left], {"momenta": p, "params": params}

    def restore(self, s, sdot, c, params, t=0.0) -> tuple[PyTree, PyTree]:
        cdot = self.cyclic_velocity(s, sdot, jnp.asarray(t, self.layout.dtype), params)
        return self.layout.restore(self.join_coordinates(s, c)), self.layout.restore(self.join_coordinates(sdot, cdot))
