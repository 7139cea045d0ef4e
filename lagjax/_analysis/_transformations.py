"""The transformations among which symmetries are searched, as vectors of coefficients (weights).

    ξ = b + c t + A q,   τ = α + β t,   and the user's own

For few coordinates every matrix A is tried; for many only those that a leaf of the coordinates suggests: rotations in
the planes of its last axis and its scaling, for each leaf. A symmetry is any linear combination of them.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._interface import Layout

_ALL_MAPS = 12  # coordinates up to which every linear map is tried, 144 of them
_SPACE = (2,), (3,)  # last axes of leaves that are vectors, which can be rotated


class Fields(NamedTuple):
    """A basis of K transformations of n coordinates: time shift, translations, boosts, maps A, time scale, the user's.

    - `scale` (n,), `time`: the sizes of the coordinates and of the time, by which transformations are of order one.
    - `matrices` (M, n, n): the matrices A; `names`: of all K = 2 + 2n + M + U.
    - `own`: the U of the user, functions (q, t, params) → (ξ, τ).
    """

    scale: np.ndarray
    time: float
    matrices: np.ndarray
    names: tuple[str, ...]
    own: tuple[Callable, ...]

    @property
    def count(self) -> int:
        return len(self.names)

    def split_weights(self, weights):
        """Split weights (K,) by kind: time (), translations (n,), boosts (n,), maps (M,), time scale (), own (U,)."""
        n, m = len(self.scale), len(self.matrices)
        first, last = 1 + 2 * n, 1 + 2 * n + m
        shift, drift = weights[1:first].reshape(2, n)
        return weights[0], shift, drift, weights[first:last], weights[last], weights[last + 1 :]

    def combine(self, weights, params) -> Callable:
        """Return the linear combination with these weights (K,), a function (q, t) → (ξ, τ)."""
        alpha, b, c, of_maps, beta, of_own = self.split_weights(weights)

        def combined(q, t):
            shift = (b + c * t / self.time) * jnp.asarray(self.scale, q.dtype)
            change, of_time = shift + jnp.tensordot(of_maps, self.matrices, 1) @ q, alpha * self.time + beta * t
            for k, function in enumerate(self.own):
                more, more_time = function(q, t, params)
                change, of_time = change + of_own[k] * more, of_time + of_own[k] * more_time
            return change, of_time

        return combined

    def weights(self, b=None, c=None, a=None, alpha: float = 0.0, beta: float = 0.0) -> np.ndarray | None:
        """Return the weights (K,) of one transformation; None if it is no combination of the basis."""
        n, m = len(self.scale), len(self.matrices)
        of_maps = np.zeros(m)
        if a is not None:
            flat = self.matrices.reshape(m, -1).T
            used = np.flatnonzero((flat != 0)[a.ravel() != 0].any(axis=0))
            of_maps[used] = np.linalg.lstsq(flat[:, used], a.ravel(), rcond=None)[0]
            if np.abs(flat @ of_maps - a.ravel()).max() > 1e-12 * np.abs(a).max():
                return None
        shift, drift = (np.zeros(n) if x is None else x / self.scale for x in (b, c))
        return np.concatenate([[alpha / self.time], shift, drift * self.time, of_maps, [beta], np.zeros(len(self.own))])


def fields_of(layout: Layout, scale: np.ndarray, time: float, own: dict[str, Callable]) -> Fields:
    """Return the basis for this layout, given the sizes (n,) of coordinates and of the time."""
    named, maps = zip(*_transformation_maps(layout, scale), strict=True)
    moved = [f"{how} of {name}" for how in ("translation", "boost") for name in layout.names]
    names = "time translation", *moved, *named, "scaling of the time", *own
    return Fields(scale, time, np.array(maps, float), names, tuple(own.values()))


def _transformation_maps(layout: Layout, scale: np.ndarray) -> list[tuple[str, np.ndarray]]:
    n, one, names = layout.size, np.eye(layout.size), layout.names
    if n <= _ALL_MAPS:
        pairs = np.ndindex(n, n)
        return [(f"d{names[i]} = {names[j]}", scale[i] / scale[j] * np.outer(one[i], one[j])) for i, j in pairs]
    # Rotations of each leaf in every plane of its last axis, and its scaling.
    maps = []
    for path, place in zip(layout.paths, _leaf_places(layout), strict=True):
        maps.append((f"scaling of {path}", np.diag(np.isin(np.arange(n), place).astype(float))))
        if place.shape[-1:] in _SPACE:
            for i, j in itertools.combinations(range(place.shape[-1]), 2):
                maps.append((f"rotation in the plane {i}{j} of {path}", _rotation(n, place[..., i], place[..., j])))
    return maps


def _leaf_places(layout: Layout) -> list[np.ndarray]:
    """Return the indices of coordinates in the flat vector, in the shape of each leaf."""
    return jax.tree.leaves(layout.restore(np.arange(layout.size)))


# ---- those that have a name in textbooks -----------------------------------------------------------------------------


def textbook_symmetries(layout: Layout, fields: Fields) -> list[tuple[str, np.ndarray]]:
    """Return (name of the conserved quantity, weights (K,)) of the transformations that textbooks name."""
    n, axes, first_own = layout.size, _vector_axes(layout), fields.count - len(fields.own)
    one, each = np.eye(n), [(i, d, vectors[:, i]) for d, vectors in axes.items() for i in range(d)]
    along = [(i, d, np.isin(np.arange(n), places).astype(float)) for i, d, places in each]
    space = {d: "" if len(axes) == 1 else f" of {d}" for d in axes}
    # The signs are those of what is conserved: h, p, M X − P t.
    known = [("energy", fields.weights(alpha=-1.0))]
    known += [(f"momentum of {name}", fields.weights(b=one[i])) for i, name in enumerate(layout.names)]
    known += [(f"momentum along axis {i}{space[d]}", fields.weights(b=b)) for i, d, b in along]
    known += [("total momentum", fields.weights(b=np.ones(n)))]
    known += [(f"angular momentum {name}", fields.weights(a=a)) for name, a in _rotations(layout, axes)]
    known += [(f"centre of mass along axis {i}{space[d]}", fields.weights(c=-c)) for i, d, c in along]
    known += [("centre of all coordinates", fields.weights(c=-np.ones(n)))]
    known += [(f"start of {name}", fields.weights(c=-one[i])) for i, name in enumerate(layout.names)]
    known += [("dilation", fields.weights(a=-0.5 * one, beta=-1.0))]  # h t − ½ p·q
    known += [(name, np.eye(fields.count)[first_own + k]) for k, name in enumerate(fields.names[first_own:])]
    return [(name, weights) for name, weights in known if weights is not None]


def _vector_axes(layout: Layout) -> dict[int, np.ndarray]:
    """Return {d: indices (vectors, d)} of all 2- and 3-vectors, leaves whose last axis has length d."""
    vectors = {}
    for place in _leaf_places(layout):
        if place.shape[-1:] in _SPACE:
            vectors.setdefault(place.shape[-1], []).append(place.reshape(-1, place.shape[-1]))
    return {d: np.concatenate(parts) for d, parts in vectors.items()}


def _rotations(layout: Layout, axes: dict[int, np.ndarray]) -> list[tuple[str, np.ndarray]]:
    """Return rotations of all vectors together; with few coordinates also of pairs of scalar ones."""
    n, rotations = layout.size, []
    for d, vectors in axes.items():
        for i, j in itertools.combinations(range(d), 2):
            rotations.append((f"in the plane {i}{j}", _rotation(n, vectors[:, i], vectors[:, j])))
    if n <= _ALL_MAPS:
        for i, j in itertools.combinations(range(n), 2):
            rotations.append((f"of {layout.names[i]}, {layout.names[j]}", _rotation(n, i, j)))
    return rotations


def _rotation(n: int, first, second) -> np.ndarray:
    """Return A (n, n) that rotates the coordinates `first` into `second`."""
    a = np.zeros((n, n))
    a[first, second], a[second, first] = -1.0, 1.0
    return a
