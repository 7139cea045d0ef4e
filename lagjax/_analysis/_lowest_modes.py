"""The lowest modes K x = λ M x of sparse matrices, on the tangent space G x = 0 of constraints.

Lanczos's method with the inverse (K − σM)⁻¹ M, where σ lies below all eigenvalues: those next to it are the lowest, and
zero ones are as good as others. Constraints border the matrix that is inverted, so that no basis of their tangent space
is written down. Lanczos's method may take a multiple eigenvalue for a single one; so the lowest one of what is
orthogonal to the modes at hand is sought, until that is higher than all of them.

Source: Ericsson & Ruhe, *The spectral transformation Lanczos method*, Math. Comp. 35 (1980) 1251.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.sparse import block_array, csc_array
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, SuperLU, eigsh, splu

from lagjax._analysis._eigen import symmetric_modes
from lagjax._equations import truncated_svd

Sparse = Any  # an array of scipy.sparse, of which type checkers do not know that it has two axes

# The first shift, as a fraction of the largest entries of K: above rounding, below the lowest mode of 10⁵ links, 1e-9.
# Closer to zero by a factor of ten, zero modes would cost other shapes a digit.
_SHIFT = 1e-9
# Trials to come closer; a failure costs as much as a success, which gains a factor of two to eight of the distance.
_TRIALS = 24
# How stiff constraints are beside K where it is asked if K − σM is positive on their tangent space. Softer ones only
# make the shift lower than need be.
_STIFF = 1e6
_OFF = 1e-6  # of its length that a shape may be off: the error of its eigenvalue is the square of that


def needs_all(count: int | None, freedoms: int) -> bool:
    """True if `count` is so large a part of all modes that computing all of them is cheaper."""
    return count is None or count > freedoms // 4


NO_MODES = (
    "There are no modes: the mass matrix is singular or not positive definite at q, so that small motions are no "
    "oscillations there. lagjax.check(system, q, qdot) tells which velocity has no kinetic energy."
)


def lowest_modes(
    stiffness: Sparse, mass: Sparse, jacobian: Sparse, count: int | None
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "n k"]]:
    """Return λ (k,), ascending, and X (n, k), in columns, of at least `count` of the lowest modes, XᵀM X = 1.

    K and M have diagonals of order one. Raises `ValueError` if M is not positive definite, or constraints are
    dependent.
    """
    if factorize_positive(mass) is None:
        raise ValueError(NO_MODES)
    n, rows = mass.shape[0], jacobian.shape[0]
    if count is None or needs_all(count, n - rows):
        return _rayleigh_ritz(stiffness, mass, truncated_svd(jacobian.toarray()).null if rows else np.eye(n))
    shift, factors = lowest_shift(stiffness, mass, jacobian)
    slices: list[tuple[float, Any, int, str]] = [(shift, factors, count, "LM")]
    if rows:
        bordered = block_array([[stiffness - shift * mass, jacobian.T], [jacobian, None]], format="csc")
        slices = [(shift, factorize_regular(bordered), count, "LM")]
        if slices[0][1] is None:
            raise ValueError(
                f"The {rows} constraints depend on each other at q, or nearly: of large scenes modes are found "
                "with independent ones. Drop those that follow from others."
            )
    counted = [] if rows else _slice_spectrum(stiffness, mass, shift, factors, count)
    values, shapes = np.zeros(0), np.zeros((n, 0))
    try:
        for of_slice in counted or slices:
            more = _modes_of(stiffness, mass, shapes, *of_slice)
            values, shapes = np.append(values, more[0]), np.column_stack([shapes, more[1]])
        if counted and values.max() > counted[-1][0]:  # instead of a copy of a multiple one another was taken
            counted, (values, shapes) = [], _modes_of(stiffness, mass, np.zeros((n, 0)), *slices[0])
        while not counted and shapes.shape[1] < n - rows:
            value, more = _modes_of(stiffness, mass, shapes, *slices[0][:2], 1, "LM")
            if value[0] >= np.sort(values)[count - 1]:
                break
            values, shapes = np.append(values, value), np.column_stack([shapes, more])
    except ArpackNoConvergence as error:
        raise ValueError(f"The {count} lowest modes were not found: {error}. Ask for fewer.") from None
    values, shapes = _rayleigh_ritz(stiffness, mass, shapes)
    values, shapes, factors = values[:count], shapes[:, :count], slices[0][1]
    again = np.column_stack([_solve_shifted(factors, x) for x in (mass @ shapes).T]) * (values - shift)
    off = np.linalg.norm(again - shapes, axis=0) / np.linalg.norm(shapes, axis=0)
    if not off.max() <= _OFF:
        raise ValueError(f"Mode {np.argmax(off)} was not found: its shape is off by {off.max():.1g} of its length.")
    return values, shapes


def _solve_shifted(factors: SuperLU, b: np.ndarray) -> np.ndarray:
    """Solve (K − σM) x = b for x (n,), by factors of a matrix that may be bordered by constraints."""
    return factors.solve(np.append(b, np.zeros(factors.shape[0] - len(b))))[: len(b)]


def _modes_of(stiffness: Sparse, mass: Sparse, against: np.ndarray, shift: float, factors, modes: int, which: str):
    """Return λ and X of modes next to the shift (with `which` "SA" below it), orthogonal to `against` (n, j)."""
    n, weighted = len(against), mass @ against

    def project_inverse(b):
        x = _solve_shifted(factors, b - weighted @ (against.T @ b))
        return x - against @ (weighted.T @ x)

    start = project_inverse(mass @ np.random.default_rng(0).normal(size=n))
    inverse: Any = LinearOperator((n, n), project_inverse, dtype=float)  # pyright: ignore[reportCallIssue]
    return eigsh(stiffness, modes, mass, shift, which, start, OPinv=inverse)  # pyright: ignore


def _slice_spectrum(
    stiffness: Sparse, mass: Sparse, low: float, factors: SuperLU, count: int
) -> list[tuple[float, Any, int, str]]:
    """Shifts, factors and numbers of modes that together are the lowest `count` to twice as many; none if not found. A
    few modes far below a dense band (of a heavy mass) would cost Lanczos's method thousands of steps there: one shift
    lies inside the band, by Sylvester's law of inertia (a negative pivot of K − σM for each eigenvalue below σ)."""
    far, high, width = (low, factors, 0, "LM"), np.inf, 4 * _SHIFT * (float(abs(stiffness).sum(axis=1).max()) or 1.0)
    for _ in range(2 * _TRIALS):
        trial = low + width if np.isinf(high) else 0.5 * (low + high)
        if (found := _factor_symmetric(stiffness - trial * mass)) is None:
            return []
        below = int(np.sum(found.U.diagonal() < 0))
        if count <= below <= 2 * count:
            few = far[2] if 0 < far[2] <= count // 2 else 0
            return [*([far] if few else []), (trial, found, below - few, "SA")]
        if below < count:
            low, width, far = trial, 8 * width, (*far[:2], below, "LM")
        else:
            high = trial
    return []


def _factor_symmetric(matrix: Sparse) -> SuperLU | None:
    """Factor a symmetric matrix without pivoting; None if a pivot is zero."""
    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    try:
        factors = splu(csc_array(matrix), **options)
    except RuntimeError:
        return None
    return factors if np.array_equal(factors.perm_r, factors.perm_c) else None


def _rayleigh_ritz(stiffness: Sparse, mass: Sparse, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return λ (k,) and X (n, k) of the modes within the span of a basis (n, k)."""
    values, shapes = symmetric_modes(basis.T @ (stiffness @ basis), basis.T @ (mass @ basis))
    return np.asarray(values), basis @ np.asarray(shapes)


def lowest_shift(stiffness: Sparse, mass: Sparse, jacobian: Sparse = None) -> tuple[float, SuperLU]:
    """σ just below all eigenvalues, and the factors of K − σM, with stiff springs for constraints; M positive definite.
    Lanczos's method converges faster the nearer σ is; Rayleigh quotients bound it from above, positive factors from
    below."""
    size = float(abs(stiffness).sum(axis=1).max()) or 1.0
    shift, held = -_SHIFT * size, stiffness
    if jacobian is not None and jacobian.shape[0]:
        held = stiffness + _STIFF * size / float(jacobian.power(2).sum(axis=1).max()) * (jacobian.T @ jacobian)
    while (factors := factorize_positive(held - shift * mass)) is None:
        shift *= 4
    x, near = np.random.default_rng(0).normal(size=mass.shape[0]), 0.125
    for _ in range(_TRIALS):
        for _ in range(4):
            x = factors.solve(mass @ x)
            x /= np.sqrt(x @ (mass @ x))
        gap = x @ (held @ x) - shift
        if gap <= 4 * _SHIFT * size:
            break
        trial = shift + (1 - near) * gap
        closer = factorize_positive(held - trial * mass)
        near = 0.5 if closer is None else 0.125
        if closer is not None:
            shift, factors = trial, closer
    return shift, factors


def factorize_positive(matrix: Sparse) -> SuperLU | None:
    """Factor a matrix by elimination without pivoting; None if it is not positive definite."""
    factors = _factor_symmetric(matrix)
    return factors if factors is not None and (factors.U.diagonal() > 0).all() else None


def factorize_regular(matrix: Sparse) -> SuperLU | None:
    """Factor a matrix by elimination with pivoting; None if it is singular to working precision."""
    try:
        factors = splu(csc_array(matrix))
    except RuntimeError:
        return None
    pivots = np.abs(factors.U.diagonal())
    return factors if pivots.min() > _SINGULAR * pivots.max() else None


_SINGULAR = 1e-14  # of the largest pivot, below which others are rounding: some hundred roundings of sums
