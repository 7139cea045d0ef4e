"""`equilibrium`: where a scene stays, at rest or in steady motion."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lagjax._analysis._scene import Scene
from lagjax._analysis._solve import shortest_preimage, shortest_solution
from lagjax._doubles import accepts_singles
from lagjax._failures import nan_unless
from lagjax._linear import factorize, least_norm
from lagjax._system import System
from lagjax._validate import require_flag

PyTree = Any
Vector = Float[Array, " n"]
Unknowns = Float[Array, " n+m"]  # q, then λ


class Equilibrium(NamedTuple):
    """Where a scene stays.

    - `q`: the coordinates, in the user's pytree; NaN where no equilibrium was found.
    - `multipliers`: λ there, in the structure the constraints return; None without constraints.
    - `ok`: whether an equilibrium was found.
    """

    q: PyTree
    multipliers: PyTree
    ok: Bool[Array, ""]


@accepts_singles(("q", "qdot"), ("params",))
def equilibrium(
    system: System, q: PyTree, params: PyTree = None, *, qdot: PyTree = None, throw: bool = True
) -> Equilibrium:
    r"""The equilibrium of `system` that Newton's method reaches from `q`.

        ∂L/∂q + Q − ∂D/∂q̇ + (∂f/∂q)ᵀλ = 0,   f(q) = 0,   at q̇ = 0

    - `q`: the guess, in the user's pytree.
    - `qdot`: for a steady motion, its velocities in the structure of `q`: those of the cyclic coordinates, and zero for
      all others. The other coordinates are found: they then stay constant (a top that precesses, a bead on a hoop).
    - `throw`: whether to raise where no equilibrium is found. With False, and inside `jit` and `vmap`, `ok` is False
      and q is NaN.

    Stable and unstable equilibria are found alike; `normal_modes` tells which it is. Where equilibria form a family
    (along a coordinate that no force acts on), the result is the member that minimum-norm Newton steps reach, and its
    derivatives are those of the nearest member. Far from an equilibrium the steps are damped (Levenberg–Marquardt). The
    result is differentiated implicitly with respect to `params`, to every order. The function works under `jit`, `vmap`
    and `grad`.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, a scene that depends on the time, a
    velocity of a coordinate that is not cyclic, or where no equilibrium is found.

    Source: Landau & Lifshitz, *Mechanics*, §21; Nocedal & Wright, *Numerical Optimization*, §10.3, §11.2.

    ```python
    import jax.numpy as jnp, lagjax

    hoop = lagjax.System(lambda q, v, params: 0.5 * v**2 + 0.5 * (params * jnp.sin(q)) ** 2 + 9.81 * jnp.cos(q))
    rest = lagjax.equilibrium(hoop, 1.0, 5.0)  # cos q = 9.81 / 25
    ```
    """
    require_flag(throw, "throw")
    scene = Scene.of(system, q, qdot, params)
    scene.require_autonomous("An equilibrium")
    require_steady(scene)
    place, multipliers, ok = _found(*scene.arguments)
    if throw and scene.concrete and not ok:
        raise ValueError(_sentence(scene))
    of_user = None
    if scene.constrained:
        of_user = scene.system.by_constraint(multipliers, scene.layout, scene.params)
    return Equilibrium(scene.layout.restore(place), of_user, ok)


def require_steady(scene: Scene) -> None:
    """Raise `ValueError` where a coordinate that something depends on has a velocity."""
    if not scene.concrete or scene.lowered is None:
        return
    turning = np.flatnonzero(np.asarray(scene.qdot))
    cyclic = scene.conserved
    if wrong := [scene.layout.names[i] for i in turning if i not in cyclic]:
        raise ValueError(
            f"{', '.join(wrong)}: has a velocity, but is not cyclic (L, a force or a constraint depends on it or acts "
            "on it), so that it cannot move steadily. Give velocities to cyclic coordinates alone."
        )


# ---- Newton's method -------------------------------------------------------------------------------------------------

# Damped steps; 10 to 30 are usual. Twice as many change nothing where there is an equilibrium.
_STEPS = 200

# A step that is nothing, in parts of the numbers of z; and Newton steps at the end, of which two reach rounding.
_AT_REST, _POLISH = 1e-10, 3

# A multiplier that counts as rounding of the others.
_TINY = 1e-6


@eqx.filter_jit
def _found(*arguments) -> tuple[Vector, Array, Bool[Array, ""]]:
    """q (n,), λ (m,) and whether they are an equilibrium, of a scene made of `Scene.arguments`."""
    scene = Scene.flat(*arguments)
    n = scene.layout.size

    def residual(z: Unknowns) -> Unknowns:
        return balance(scene, z[:n], z[n:])

    start = jax.lax.stop_gradient(jnp.concatenate([scene.q, least_multipliers(scene, scene.q)]))
    unit = _units(jax.lax.stop_gradient(scene.mass_matrix(scene.q, scene.qdot)), jax.jacfwd(residual)(start))

    # A multiplier that is nothing beside the others is rounding.
    least = jnp.abs(start).at[n:].max(_TINY * unit[n:] * jnp.max(jnp.abs(start / unit)[n:], initial=0.0))

    def find(_, start):
        return _polished(residual, _damped(residual, start, least, unit), start, least, unit)

    def shortest(linear, right):
        return unit * shortest_preimage(lambda x: linear(unit * x), right)

    z = jax.lax.custom_root(residual, start, find, shortest)
    q = z[:n]
    ok = _is_root(residual, jax.lax.stop_gradient(z), least)
    multipliers = least_multipliers(scene, q)
    return nan_unless(ok, q), nan_unless(ok, multipliers), ok


def _units(mass: Float[Array, "n n"], jacobian: Float[Array, "n+m n+m"]) -> Unknowns:
    """A unit of each number of z, so that lengths of z mean the same in all units of a user: 1/√Mᵢᵢ for qᵢ.

    λ has those that make as much of the forces as q does.
    """
    inertia, n = jnp.abs(jnp.diagonal(mass)), len(mass)
    root = jnp.sqrt(jnp.where((inertia > 0) & jnp.isfinite(inertia), inertia, 1))
    scaled = jax.lax.stop_gradient(jacobian)[:n] / root[:, None]
    of_q, of_multipliers = jnp.max(jnp.abs(scaled[:, :n] / root), initial=0.0), jnp.max(jnp.abs(scaled[:, n:]), axis=0)
    found = (of_q > 0) & (of_multipliers > 0)
    return jnp.concatenate([1 / root, jnp.where(found, of_q / jnp.where(found, of_multipliers, 1), 1)])


def balance(scene: Scene, q: Vector, multipliers: Array) -> Unknowns:
    """F + Gᵀλ (n,), then the constraints on positions and a zero for each on velocities (m,): zero in equilibrium."""
    force, jacobian = scene.force(q, scene.qdot), scene.jacobian(q, scene.qdot)
    rows = scene.motion.constraints.residual(q, scene.qdot, jnp.zeros((), q.dtype), scene.numbers)
    return jnp.concatenate([force + jacobian.T @ multipliers, rows])


def least_multipliers(scene: Scene, q: Vector) -> Array:
    """λ (m,) that leave the smallest force F + Gᵀλ; of least norm where constraints are redundant."""
    if not scene.constrained:
        return jnp.zeros(0, q.dtype)
    jacobian = scene.jacobian(q, scene.qdot)
    return -least_norm(jacobian @ jacobian.T, jacobian @ scene.force(q, scene.qdot))


def _damped(residual, start: Unknowns, least: Unknowns, unit: Unknowns) -> Unknowns:
    """z after steps of Levenberg and Marquardt for |r|², until they are small or nothing helps.

    Rows are weighed by the size of their gradient at the start, columns by the largest they had so far (Moré): a
    change of units changes nothing. The damping goes down with |r|, which keeps the convergence quadratic where
    solutions are not isolated (Fan & Yuan, Computing 74 (2005) 23).
    """
    lengths = jnp.sqrt(jnp.sum((jax.jacfwd(residual)(start) * unit) ** 2, axis=1))
    weights = jnp.where(lengths > 0, 1 / jnp.where(lengths > 0, lengths, 1), 1)

    def weighted(z):
        return weights * residual(z)

    def moves(carry):
        _, value, moved, _, _, count = carry
        return (moved > _AT_REST) & (count < _STEPS) & (jnp.max(jnp.abs(value)) > 0)

    def once(carry):
        z, value, moved, damping, scale, count = carry
        jacobian = jax.jacfwd(weighted)(z)
        scale = jnp.maximum(scale, jnp.sqrt(jnp.sum(jacobian**2, axis=0)))
        d = jnp.where(scale > 0, scale, unit)
        scaled = jacobian / d
        size = jnp.sqrt(jnp.sum(value**2))
        part = size / (size + jnp.max(jnp.abs(jacobian) @ jnp.maximum(least, jnp.abs(z))))
        normal = scaled.T @ scaled + (damping * part + 1e-15) * jnp.eye(z.size, dtype=z.dtype)
        step = -factorize(normal).solve(scaled.T @ value) / d
        new = weighted(z + step)
        gain = jnp.sum(value**2) - jnp.sum(new**2)
        expected = jnp.sum(value**2) - jnp.sum((value + jacobian @ step) ** 2)
        ratio = jnp.where(expected > 0, gain / jnp.where(expected > 0, expected, 1), 0.0)
        better = (gain > 0) & jnp.all(jnp.isfinite(new))
        damping = jnp.where(ratio > 0.75, damping / 4, jnp.where((ratio < 0.25) | ~better, damping * 4, damping))
        length = _relative(jacobian, step, z, least)
        stuck = ~better & ((length < _AT_REST) | ~jnp.isfinite(length))
        moved = jnp.where(better, length, jnp.where(stuck, 0.0, moved))
        return jnp.where(better, z + step, z), jnp.where(better, new, value), moved, damping, scale, count + 1

    one = jnp.ones((), start.dtype)
    carry = start, weighted(start), one, 0.1 * one, jnp.zeros_like(start), jnp.zeros((), int)
    return jax.lax.while_loop(moves, once, carry)[0]


def _polished(residual, z: Unknowns, start: Unknowns, least: Unknowns, unit: Unknowns) -> Unknowns:
    """z after Newton steps, as exact as rounding allows; each is taken where it is small.

    What converges to zero ends at any tiny number: zero is what is nothing beside the start even after three roundings.
    """

    def once(_, z):
        jacobian = jax.jacfwd(residual)(z)
        step = unit * shortest_solution(jacobian * unit, residual(z))
        return jnp.where(_relative(jacobian, step, z, least) < 1e-3, z - step, z)

    z = jax.lax.fori_loop(0, _POLISH, once, z)
    return jnp.where(jnp.abs(z) < jnp.finfo(z.dtype).eps ** 3 * jnp.abs(start), 0.0, z)


def _relative(jacobian: Float[Array, "n+m n+m"], step: Unknowns, z: Unknowns, least: Unknowns) -> Float[Array, ""]:
    """The size of a step: the most that it makes of a number of r, in parts of what the numbers of z make of it."""
    change = jnp.abs(jacobian) @ jnp.abs(step)
    whole = jnp.abs(jacobian) @ jnp.maximum(jnp.maximum(least, jnp.abs(z)), jnp.abs(step))
    return jnp.max(jnp.where(change == 0, 0.0, change / jnp.where(whole == 0, 1, whole)))


def _is_root(residual, z: Unknowns, least: Unknowns) -> Bool[Array, ""]:
    """Whether r(z) is zero: each number below √eps of what the numbers of z, or the `least` ones, make of it.

    A converged one is at some eps of it; where forces only fade away with the distance it is of order one.
    """
    size = jnp.abs(jax.jacfwd(residual)(z)) @ jnp.maximum(least, jnp.abs(z))
    return jnp.all(jnp.abs(residual(z)) <= jnp.sqrt(jnp.finfo(z.dtype).eps) * size)


def _sentence(scene: Scene) -> str:
    """What is wrong where no equilibrium was found from the guess."""
    force = scene.force(scene.q, scene.qdot)
    gradient = jax.jacfwd(scene.force)(scene.q, scene.qdot)
    names = scene.layout.names
    pushed = [names[i] for i in np.flatnonzero((np.asarray(force) != 0) & ~np.asarray(gradient).any(axis=1))]
    if pushed and not scene.constrained:
        return (
            f"There is no equilibrium near the guess: the force of {', '.join(pushed)} is not zero, and no coordinate "
            "changes it. What keeps it there is missing from L: a spring, a support, a constraint."
        )
    shown = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names[:8], np.asarray(scene.q)[:8], strict=False))
    return (
        f"No equilibrium was found from {shown}: Newton's method does not come to a point where the forces balance. "
        "There may be none, or the force is largest at the guess (its slope vanishes): begin nearer to one."
    )
