"""`hamiltonian`: the canonical form of a scene, by Legendre's transformation.

    p = ∂L/∂q̇(q, q̇, t)   ⇄   q̇ = v(q, p, t)        H = p·v − L        q̇ = v,   ṗ = ∂L/∂q(q, v) + Q

A canonical motion is that of Lagrange's equations from q̇ = v(q, p, t), with p = ∂L/∂q̇ along it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from lagjax._analysis._scene_state import SceneState
from lagjax._analysis._solve import STEPS, is_root, newton, shortest_preimage
from lagjax._equations import SparseMotion, has_constraints
from lagjax._interface import Layout, as_arrays, compile_for_one_call
from lagjax._primitives import nan_unless
from lagjax._run import simulate
from lagjax._scene import System, present_system, require_system
from lagjax._show import canonical_summary

Vector = Float[Array, " n"]


class CanonicalTrajectory(NamedTuple):
    """A motion in phase space: times (T,), and q and p in the structure of q with the time axis in front; `ok`."""

    ts: Float[Array, " T"]
    q: PyTree
    p: PyTree
    ok: Bool[Array, ""]

    def __repr__(self) -> str:
        return canonical_summary(self)


class Hamiltonian(NamedTuple):
    """The canonical form of a scene. Momenta p have the structure of q; t is 0.0 and params None by default.

    - `system`: the scene.
    - `energy(q, p, t, params)`: H, a scalar.
    - `momentum(q, qdot, t, params)` and `velocity(q, p, t, params)`: the Legendre transformation in both directions.
      The velocity is found by Newton's method; it is NaN where p determines none (a singular mass matrix).
    - `equations(q, p, t, params)`: (q̇, ṗ).
    - `simulate(q0, p0, ts, params, **options)`: the canonical motion, a `CanonicalTrajectory`; options as of
      `lagjax.simulate`, an event of (q, qdot).
    """

    system: System
    energy: Callable
    momentum: Callable
    velocity: Callable
    equations: Callable
    simulate: Callable

    def __repr__(self) -> str:
        return (
            f"Hamiltonian of {self.system!r}\n"
            "energy, velocity and equations of (q, p, t, params), momentum of (q, qdot, t, params)\n"
            "simulate(q0, p0, ts, params) for canonical motions"
        )


def hamiltonian(system: System) -> Hamiltonian:
    r"""The canonical form of `system`: H(q, p, t) and Hamilton's equations.

        H(q, p, t) = p·q̇ − L,   q̇ = ∂H/∂p,   ṗ = −∂H/∂q + Q

    L need not be quadratic in the velocities. All functions are differentiable and work under `jit` and `vmap`.
    Canonical motions are those of `lagjax.simulate` from v(q, p, t), where M is regular along them.

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

    def velocity(q, p, t: Any = 0.0, params=None):
        return _hamiltonian_equations(system, q, p, t, params)[0]

    def energy(q, p, t=0.0, params=None):
        return _hamiltonian_equations(system, q, p, t, params)[2]

    def equations(q, p, t=0.0, params=None):
        return _hamiltonian_equations(system, q, p, t, params)[:2]

    def run(q0, p0, ts, params=None, **options):
        done = simulate(system, q0, velocity(q0, p0, jnp.asarray(ts)[0], params), ts, params, **options)
        p = jax.vmap(lambda q, qdot, t: system.momentum(q, qdot, t, params))(done.q, done.qdot, done.ts)
        return CanonicalTrajectory(done.ts, done.q, p, done.ok)

    return Hamiltonian(system, energy, system.momentum, velocity, equations, run)


def _hamiltonian_equations(system: System, q: PyTree, p: PyTree, t, params: PyTree) -> tuple[PyTree, PyTree, Array]:
    """Return q̇ and ṗ, in the structure of q, and H."""
    system, layout = present_system(system), Layout.from_state(q, p)
    flat = layout.flatten(q), layout.flatten(p), as_arrays(params, layout.dtype)
    v, force, energy = _flat_hamiltonian_equations(jnp.asarray(t, layout.dtype), system, layout, *flat)
    return layout.restore(v), layout.restore(force), energy


@compile_for_one_call
def _flat_hamiltonian_equations(t, *arguments) -> tuple[Vector, Vector, Array]:
    """Return q̇ from ∂L/∂q̇(q, q̇, t) = p, by Newton's method from rest, ṗ and H; the argument q̇ is p."""
    scene = SceneState.from_arguments(*arguments)
    motion, q, p = scene.motion, scene.q, scene.qdot

    def residual(v):
        return motion.momentum(q, v, t, scene.numbers) - p

    rest = jnp.zeros_like(p)
    if isinstance(motion, SparseMotion):
        v = jax.lax.custom_root(residual, rest, *_sparse_newton(motion, q, t, scene.numbers))
        size = jnp.max(jnp.abs(p), initial=0) + jnp.max(jnp.abs(residual(rest)), initial=0)
        found = jnp.max(jnp.abs(residual(v)), initial=0) <= jnp.finfo(p.dtype).eps ** 0.6 * size
    else:
        v = jax.lax.custom_root(residual, rest, newton, shortest_preimage)
        found = is_root(residual, v, p)
    v = nan_unless(jax.lax.stop_gradient(found), v)
    at = q, v, t, scene.numbers
    return v, motion.generalized_force(*at), motion.energy(*at) - residual(v) @ v


def _sparse_newton(motion: SparseMotion, q: Vector, t, numbers: PyTree) -> tuple[Callable, Callable]:
    """Return functions for `custom_root`: one solves ∂L/∂q̇(q, v) = p for v, one solves with its sparse Jacobian M."""

    def solve(multiply, right):
        mass = motion.structure.mass.prepare(multiply, q.dtype)
        return jax.lax.custom_linear_solve(multiply, right, lambda _, b: mass.solve(b), symmetric=True)

    def find(residual, v):
        def once(carry):
            v, _, count = carry
            step = solve(motion.mass_product(q, v, t, numbers), residual(v))
            return v - step, jnp.max(jnp.abs(step), initial=0) / jnp.max(jnp.abs(v - step), initial=1e-300), count + 1

        def moves(carry):
            return (carry[1] > 1e-14) & (carry[2] < STEPS)

        return jax.lax.while_loop(moves, once, (v, jnp.ones((), q.dtype), 0))[0]

    return find, solve
