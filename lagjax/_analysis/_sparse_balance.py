"""The equilibrium equations of a large scene, F + Gᵀλ = 0 and f = 0, their sparse Jacobian by z = (q, λ), and roots.

It is for scenes with a `SparseStructure`. Derivatives are computed from products (`sparse_jacobian`), linear systems by
SuperLU on the host, so that nothing here is traced. The steps are those of `_solve`: damped ones until they are small,
then those of Newton's method; a singular Newton step is replaced by one of the least damping.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.sparse import block_array, diags_array, eye_array
from scipy.sparse.linalg import splu

from lagjax._analysis._lowest_modes import Sparse, factorize_regular, lowest_shift
from lagjax._analysis._scene_state import SceneState
from lagjax._analysis._solve import DAMPED_STEPS, NO_STEP, reciprocal
from lagjax._equations import sparse_jacobian

Unknowns = Float[np.ndarray, " n+m"]


class SparseBalance(NamedTuple):
    """The residual (n + m,), F + Gᵀλ then f, its sparse Jacobian, and λ (m,) at the state of the scene."""

    residual: Callable[[Unknowns], Unknowns]
    jacobian: Callable[[Unknowns], Sparse]
    multipliers: np.ndarray


def balance_of(scene: SceneState, what: str) -> SparseBalance:
    """Return the equations of a large scene; raise `ValueError`, about `what` they are for, if not possible."""
    motion, n = scene.motion, scene.layout.size
    large = f"{what} of {n} coordinates is found with sparse matrices on the host"
    if not scene.concrete:
        raise ValueError(f"{large}: call it outside of jit, vmap and grad.")
    if motion.constraints.on_velocities is not None:
        raise ValueError(f"{large}, and not with velocity constraints: give constraints on positions alone.")
    rest, t = jnp.zeros_like(scene.q), jnp.zeros((), scene.q.dtype)

    @jax.jit
    def residual(z, numbers):
        state = z[:n], rest, t, numbers
        _, pull = motion.constraints.products(*state)
        return jnp.concatenate([motion.force(*state) + pull(z[n:]), motion.constraints.residual(*state)])

    multipliers = multipliers_at_rest(scene)
    shape = jax.ShapeDtypeStruct((n + len(multipliers),), scene.q.dtype)
    jacobian = sparse_jacobian(residual, (shape, scene.numbers))
    if jacobian is None:
        raise ValueError(
            f"{large}, and the derivatives of its forces are not sparse, or hold products of large matrices: write "
            "forces as sums over neighbours, in slices and with jnp.roll, or give the scene fewer coordinates."
        )
    at = scene.numbers
    return SparseBalance(lambda z: np.asarray(residual(z, at)), lambda z: jacobian(jnp.asarray(z), at), multipliers)


def multipliers_at_rest(scene: SceneState) -> np.ndarray:
    """Return λ (m,) of a scene at rest at q, as in a motion that starts there."""
    if not scene.constrained:
        return np.zeros(0)
    state = scene.q, jnp.zeros_like(scene.q), jnp.zeros((), scene.q.dtype), scene.numbers
    return np.asarray(jax.jit(scene.motion.multipliers)(*state))


# ---- roots -----------------------------------------------------------------------------------------------------------


def constraints_nearby(scene: SceneState, place: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return a q (n,) that satisfies, or nearly, the constraints f of a large scene, near `place` (n,)."""
    function = jax.jit(scene.position_constraints)
    if (jacobian := sparse_jacobian(function, (scene.q,))) is None:
        return place
    return descend(function, jacobian, place, np.abs(place), unit)


def descend(residual: Callable, jacobian_at: Callable, start: Unknowns, least: Unknowns, unit: Unknowns) -> Unknowns:
    """Minimise |f(z)|², f (m,), from `start` (n,) by damped steps, as `_solve.levenberg_marquardt`; return z."""
    z, value, jacobian = start, np.asarray(residual(start)), jacobian_at(start)
    weights = reciprocal(_column_lengths(jacobian @ diags_array(unit), 1))
    damping, scale = 0.1, np.zeros(len(z))
    for _ in range(DAMPED_STEPS):
        weighted, error = diags_array(weights) @ jacobian, weights * value
        if not error.any():
            break
        scale = np.maximum(scale, _column_lengths(weighted, 0))
        d = np.where(scale > 0, scale, unit)
        scaled, size = weighted @ diags_array(1 / d), np.linalg.norm(error)
        part = size / (size + (abs(weighted) @ np.maximum(least, np.abs(z))).max())
        step = -_damped_solution(scaled, error, damping * part + 1e-15)
        new = np.asarray(residual(z + step / d))
        gain = size**2 - np.linalg.norm(weights * new) ** 2
        expected = size**2 - np.linalg.norm(error + scaled @ step) ** 2
        ratio, better = gain / expected if expected > 0 else 0.0, gain > 0 and np.isfinite(new).all()
        damping *= 0.25 if ratio > 0.75 else 4.0 if ratio < 0.25 or not better else 1.0
        change, sizes = abs(weighted) @ np.abs(step / d), np.maximum(np.abs(z), np.abs(step / d))
        length = np.max(change * reciprocal(abs(weighted) @ np.maximum(least, sizes)))
        if better:
            z, value, jacobian = z + step / d, new, jacobian_at(z + step / d)
        if not length >= NO_STEP:
            break
    return z


def is_balanced(of: SparseBalance, z: Unknowns, least: Unknowns) -> bool:
    """True if z is a root: each residual is below √eps times the sum of its terms."""
    size = abs(of.jacobian(z)) @ np.maximum(least, np.abs(z))
    return bool((np.abs(of.residual(z)) <= np.finfo(float).eps ** 0.5 * size).all())


def has_falling_direction(of: SparseBalance, z: Unknowns, unit: np.ndarray) -> bool:
    """True if an equilibrium is no minimum of the potential on the constraints; `unit`: of each coordinate."""
    whole, n, scale = of.jacobian(z), len(unit), diags_array(unit)
    forces, jacobian = scale @ whole[:n, :n] @ scale, whole[n:, :n] @ scale
    shift = lowest_shift(-0.5 * (forces + forces.T), eye_array(n), jacobian)[0]
    return shift < -_FALLS * abs(forces).sum(axis=1).max()


# The lowest eigenvalue that is none, as a fraction of the largest: ten times how near its bound comes.
_FALLS = 1e-7


def _damped_solution(matrix: Sparse, b: np.ndarray, damping: float) -> np.ndarray:
    """Return the x that minimises |A x − b|² + `damping` |x|², without forming AᵀA."""
    m, n = matrix.shape
    above, below = (damping**0.5 * eye_array(k) for k in (m, n))
    bordered = block_array([[above, matrix], [matrix.T, -below]], format="csc")
    return splu(bordered).solve(np.concatenate([b, np.zeros(n)]))[m:]


def _column_lengths(matrix: Sparse, axis: int) -> np.ndarray:
    return np.sqrt((matrix**2).sum(axis=axis))


def singular_direction(matrix: Sparse) -> np.ndarray | None:
    """Return a unit vector x with A x = 0 to working precision, for a square A; None if A is regular."""
    if factorize_regular(matrix) is not None:
        return None
    x = np.random.default_rng(0).normal(size=matrix.shape[0])
    for _ in range(3):
        x = _damped_solution(matrix / abs(matrix).max(), x, 1e-15)
        x /= np.linalg.norm(x)
    return x
