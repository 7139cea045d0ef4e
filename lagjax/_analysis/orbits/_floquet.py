"""Floquet multipliers: the eigenvalues of the monodromy matrix, from the derivatives of K arcs.

The multipliers that are 1 because an orbit may begin anywhere along itself, and because momenta are conserved, are
known from the null space of monodromy − 1, and eigenvalues of such Jordan blocks would come out with half the digits.
They are split off at every state of the chain: with W the null vectors and ℓ those of the transpose, the arcs map
ker ℓ ⊃ W into each other, and the quotient ker ℓ / W holds the others. These are eigenvalues of a cyclic matrix of the
arcs, whose K-th powers they are: none drowns in the rounding of a larger one.

Source: Meyer & Offin, *Introduction to Hamiltonian Dynamical Systems*, §8.5; Bojanczyk, Golub & Van Dooren, *The
periodic Schur decomposition* (1992), for products of matrices.
"""

from typing import NamedTuple

import numpy as np

from lagjax._equations import truncated_svd

# |multiplier| − 1 above this makes an orbit unstable. Multipliers on the unit circle come out within 1e-9 of it, where
# two of them meet within the square root of their accuracy, 1e-6.
UNSTABLE = 1e-5
# Pairs that multiply to one within this have multipliers that a judgement about stability may rest on.
UNCERTAIN = 1e-3


class ReducedArcs(NamedTuple):
    """The arcs restricted to unknown multipliers, `growth` (K, m, m), and the number of those known to be 1."""

    growth: np.ndarray
    known: int


def reduce_arcs(growth: np.ndarray, null: np.ndarray, of_transpose: np.ndarray) -> ReducedArcs:
    """Restrict arcs `growth` (K, 2n, 2n) of a closed chain to ker ℓ / W, W = `null` and ℓ = `of_transpose`.

    Both are (K, 2n, k); where W is empty, the arcs stay as they are.
    """
    count, states, _ = growth.shape
    if not null.shape[2]:
        return ReducedArcs(growth, 0)
    bases = [_quotient_basis(w, ell) for w, ell in zip(null, of_transpose, strict=True)]
    width, *others = {basis.shape[1] for basis in bases}
    if others:
        return ReducedArcs(growth, 0)
    moved = [bases[(k + 1) % count].T @ growth[k] @ bases[k] for k in range(count)]
    return ReducedArcs(np.stack(moved), states - width)


def _quotient_basis(null: np.ndarray, of_transpose: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (2n, m) of the part of ker ℓ that is orthogonal to W ∩ ker ℓ."""
    w, ell = np.linalg.qr(null)[0], np.linalg.qr(of_transpose)[0]
    # Directions of W that ℓ does not see; those it sees are simple multipliers, outside of ker ℓ.
    inside = w @ truncated_svd(ell.T @ w, absolute=_SEEN).null
    return truncated_svd(np.concatenate([ell, inside], axis=1).T).null


_SEEN = 1e-5  # the cosine of W and ℓ that tells a simple multiplier 1 from a Jordan block


def multipliers_of(reduced: ReducedArcs, paired: bool) -> np.ndarray:
    """Return all 2n multipliers, the largest first; `paired` puts each beside its reciprocal."""
    m = reduced.growth.shape[1]
    values = _product_eigenvalues(reduced.growth) if m else np.zeros(0, complex)
    values = values[np.argsort(-np.abs(values), kind="stable")]
    return np.concatenate([_pair_reciprocals(values) if paired else values, np.ones(reduced.known, complex)])


def passage_determinant(reduced: ReducedArcs, sign: int) -> float:
    """Return det(1 − sign·G_(K−1) … G_0): zero where a multiplier passes through 1 (`sign` 1) or −1.

    It is that of the cyclic matrix, accurate to all digits where two multipliers that meet are known to half of them.
    """
    growth = reduced.growth.copy()
    growth[0] *= sign
    cyclic = _cyclic_matrix(growth)
    return float(np.linalg.det(np.eye(len(cyclic)) - cyclic))


def _cyclic_matrix(growth: np.ndarray) -> np.ndarray:
    """Return the matrix (K m, K m) with blocks G_k (K, m, m), each of which maps part k to the next part."""
    count, m, _ = growth.shape
    cyclic = np.zeros((count, m, count, m))
    for k in range(count):
        cyclic[(k + 1) % count, :, k, :] = growth[k]
    return cyclic.reshape(count * m, count * m)


def pairing_error(multipliers: np.ndarray) -> float:
    """Return max |μᵢ μᵢ₊₁ − 1| over pairs of neighbours in the result of `multipliers_of`."""
    firsts, seconds = multipliers[0::2], multipliers[1::2]
    return float(np.abs(firsts[: len(seconds)] * seconds - 1).max(initial=0.0))


def _product_eigenvalues(growth: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of G_(K−1) … G_0, as K-th powers of those of the cyclic matrix of these blocks."""
    growth = _merge_factors(growth)
    count, roots = len(growth), np.linalg.eigvals(_cyclic_matrix(growth)).astype(complex)
    if count == 1:
        return roots
    # The roots of one multiplier stand on a circle, a turn divided by K apart: sorting by power gives one of each.
    return _group_means(np.exp(count * np.log(np.where(roots == 0, 1e-300, roots))), count)


def _merge_factors(growth: np.ndarray) -> np.ndarray:
    """Multiply neighbouring factors while their product stays small: fewer factors of the same product."""
    merged = [growth[0]]
    for matrix in growth[1:]:
        product = matrix @ merged[-1]
        merged[-1:] = [product] if np.linalg.norm(product) <= _LITTLE else [merged[-1], matrix]
    return np.stack(merged)


# How much the product of some arcs may make of an error, so that the multiplication loses the square of this, four
# digits of what shrinks beside it. Measured on the planar orbits of three bodies: with ten times as much the pairs are
# as good, with a tenth the eigenvalues cost twice as long.
_LITTLE = 100.0


def _group_means(powers: np.ndarray, count: int) -> np.ndarray:
    """Return the mean of each group of `count` values that belong to one multiplier."""
    means, rest = [], powers[np.argsort(-np.abs(powers), kind="stable")]
    while len(rest):
        near = np.argsort(np.abs(rest - rest[0]), kind="stable")
        means.append(np.mean(rest[near[:count]]))
        rest = rest[np.sort(near[count:])]
    return np.array(means)


def _pair_reciprocals(values: np.ndarray) -> np.ndarray:
    """Order the values (m,) so that each is followed by the one nearest to its reciprocal."""
    left, ordered = list(values), []
    while left:
        first = left.pop(0)
        ordered.append(first)
        if left:
            ordered.append(left.pop(min(range(len(left)), key=lambda i: abs(left[i] * first - 1))))
    return np.array(ordered)
