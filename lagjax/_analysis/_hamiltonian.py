"""`hamiltonian`: the canonical form of a scene, by Legendre's transformation.

    p = ∂L/∂q̇(q, q̇, t)   ⇄   q̇ = v(q, p, t)        H = p·v − L        q̇ = v,   ṗ = ∂L/∂q(q, v) + Q

A canonical motion is integrated as it stands: z = (q, p) with ż = X(z, t) is, differentiated once, z̈ = (∂X/∂z) ż +
∂X/∂t, the equation of a scene with the kinetic energy ½ ż² and that force. Its momenta are never those of L.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lagjax._analysis._coordinates import restrict_signature
from lagjax._analysis._solve import is_root, newton, shortest_preimage
from lagjax._consistent import has_constraints
from lagjax._failures import nan_unless
from lagjax._layout import Layout
from lagjax._simulate import simulate
from lagjax._system import System, present_system, require_system

PyTree = Any
Vector = Float[Array, " n"]


class CanonicalTrajectory(NamedTuple):
    """A motion in phase space: times (T,), and q and p in the structure of q with the time axis in front; `ok`."""

    ts: Float[Array, " T"]
    q: PyTree
    p: PyTree
    ok: Bool[Array, ""]


class Hamiltonian(NamedTuple):
    """The canonical form of a scene. Momenta p have the structure of q; t is 0.0 and params None by default.

    - `system`: the scene.
    - `energy(q, p, t, params)`: H, a scalar.
    - `momentum(q, qdot, t, params)` and `velocity(q, p, t, params)`: the Legendre transformation in both directions.
      The velocity is found by Newton's method; it is NaN where p determines none (a singular mass matrix).
    - `equations(q, p, t, params)`: (q̇, ṗ).
    - `simulate(q0, p0, ts, params, **options)`: the canonical motion, a `CanonicalTrajectory`; options as of
      `lagjax.simulate`.
    """

    system: System
    energy: Callable
    momentum: Callable
    velocity: Callable
    equations: Callable
    simulate: Callable

    def __repr__(self) -> str:
        """Three lines: the scene, and the functions with their arguments."""
        return (
            f"Hamiltonian of {self.system!r}\n"
            "energy, velocity and equations of (q, p, t, params), momentum of (q, qdot, t, params)\n"
            "simulate(q0, p0, ts, params) for canonical motions"
        )


def hamiltonian(system: System) -> Hamiltonian:
    r"""The canonical form of `system`: H(q, p, t) and Hamilton's equations.

        H(q, p, t) = p·q̇ − L,   q̇ = ∂H/∂p,   ṗ = −∂H/∂q + Q

    L need not be quadratic in the velocities. All functions are differentiable and work under `jit` and `vmap`.
    Canonical motions are integrated in (q, p), independently of `lagjax.simulate`.

    **Raises** `TypeError` for what is no `System`, `ValueError` for a system with constraints.

    Source: Landau & Lifshitz, *Mechanics*, §40.

    ```python
    import jax.numpy as jnp, lagjax

    canonical = lagjax.hamiltonian(lagjax.System(lambda q, v: 0.5 * v**2 + 9.81 * jnp.cos(q)))
    canonical.energy(0.0, 2.0)  # 2.0 - 9.81
    ```
    """
    system = require_system(system)
    if has_constraints(system):
        raise ValueError("hamiltonian takes systems without constraints: give L in coordinates that satisfy them.")

    def momentum(q, qdot, t=0.0, params=None):
        return system.momentum(q, qdot, t, params)

    def velocity(q, p, t=0.0, params=None):
        flat = _FlatScene.from_state(system, q, p, params)
        return flat.layout.restore(flat.velocity(flat.layout.flatten(q), flat.layout.flatten(p), _time(t, flat)))

    def energy(q, p, t=0.0, params=None):
        flat = _FlatScene.from_state(system, q, p, params)
        x, y, t = flat.layout.flatten(q), flat.layout.flatten(p), _time(t, flat)
        v = flat.velocity(x, y, t)
        return y @ v - flat.motion.lagrangian(x, v, t, flat.numbers)

    def equations(q, p, t: Any = 0.0, params=None):
        flat = _FlatScene.from_state(system, q, p, params)
        rate, force = flat.rates(flat.layout.flatten(q), flat.layout.flatten(p), _time(t, flat))
        return flat.layout.restore(rate), flat.layout.restore(force)

    canonical = _phase_space(equations, system)

    def run(q0, p0, ts, params=None, **options):
        z0 = {"p": p0, "q": q0}
        q_rate, p_rate = equations(q0, p0, jnp.asarray(ts)[0], params)
        done = simulate(canonical, z0, {"p": p_rate, "q": q_rate}, ts, params, **options)
        return CanonicalTrajectory(done.ts, done.q["q"], done.q["p"], done.ok)

    return Hamiltonian(system, energy, momentum, velocity, equations, run)


def _time(t, flat: "_FlatScene") -> Array:
    return jnp.asarray(t, flat.layout.dtype)


def _phase_space(equations: Callable, system: System) -> System:
    """The scene whose coordinates are z = (q, p): ½ ż², and the force that ż = X(z, t) makes."""

    def kinetic(z, zdot):
        return 0.5 * sum(jnp.sum(x**2) for x in jax.tree.leaves(zdot))

    def force(z, zdot, t, params):
        def rates(z, t):
            q_rate, p_rate = equations(z["q"], z["p"], t, params)
            return {"p": p_rate, "q": q_rate}

        t = jnp.asarray(t, float)
        return jax.jvp(rates, (z, t), (zdot, jnp.ones_like(t)))[1]

    functions = [f for f in (system.lagrangian, system.forces, system.dissipation) if f is not None]
    return System(kinetic, forces=restrict_signature(force, {extra for f in functions for extra in f.extras}))


class _FlatScene(NamedTuple):
    """The functions of a scene on vectors (n,), for q and p of this layout, and the numbers of its parameters."""

    layout: Layout
    motion: Any
    numbers: PyTree

    @classmethod
    def from_state(cls, system: System, q: PyTree, p: PyTree, params: PyTree) -> "_FlatScene":
        layout = Layout.from_state(q, p)
        return cls(layout, present_system(system)._motion(layout, params), eqx.filter(params, eqx.is_array_like))

    def velocity(self, q: Vector, p: Vector, t) -> Vector:
        """v with ∂L/∂q̇(q, v, t) = p, by Newton's method from rest."""

        def residual(v):
            return self.motion.momentum(q, v, t, self.numbers) - p

        v = jax.lax.custom_root(residual, jnp.zeros_like(p), newton, shortest_preimage)
        return nan_unless(jax.lax.stop_gradient(is_root(residual, v, p)), v)

    def rates(self, q: Vector, p: Vector, t) -> tuple[Vector, Vector]:
        """(q̇, ṗ)."""
        v = self.velocity(q, p, t)
        return v, self.motion.generalized_force(q, v, t, self.numbers)
