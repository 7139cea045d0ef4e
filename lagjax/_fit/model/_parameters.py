"""Parameters: the numbers that are fitted, their names, and the transform of each.

The scene's parameters are a pytree of any structure. Its P numbers end to end are one vector; F of them are free, and
the search moves these through their transforms.
"""

import functools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from lagjax._fit.model._transforms import AbstractTransform, Unbounded
from lagjax._interface import as_arrays, labelled_leaves, require_finite

PyTree = Any


class Part(NamedTuple):
    """The numbers of one leaf that are free: where they stand among all numbers, and how they may move."""

    label: str
    shape: tuple[int, ...]
    places: np.ndarray
    transform: AbstractTransform


@dataclass(frozen=True)
class Parameters:
    """The numbers of a pytree of parameters, and those among them that are free.

    - `leaves`, `tree`: the pytree with arrays for numbers; a leaf that is no number is a part of the program.
    - `first` (P,): all numbers at the start of the search.
    - `names` (X,): what the free numbers are called, `params['m']`.
    - `parts`: the leaves among them, each with its transform. All of their u end to end are the F unknowns.
    """

    leaves: list
    tree: Any
    first: np.ndarray
    names: tuple[str, ...]
    parts: tuple[Part, ...]

    @classmethod
    def from_pytree(cls, params: PyTree, free: PyTree = None, transforms: PyTree = None) -> "Parameters":
        """The parameters of the user; `free` and `transforms` are prefixes. Raises, and names the wrong one."""
        require_finite(params, "params0")
        labels, leaves, tree = labelled_leaves(as_arrays(params, np.float64, "params0"), "params")
        is_free = _broadcast_prefix(True if free is None else free, tree, leaves, "free")
        moved_by = _broadcast_prefix(Unbounded() if transforms is None else transforms, tree, leaves, "transforms")
        numbers, names, parts, count = [], [], [], 0
        for label, leaf, may_move, transform in zip(labels, leaves, is_free, moved_by, strict=True):
            if not eqx.is_array_like(leaf):
                continue
            values = np.asarray(leaf, np.float64).ravel()
            numbers.append(values)
            fitted = _fitted_mask(label, leaf, may_move, free)
            if fitted.any():
                shape = np.shape(leaf)
                for one, some in _split_by_transform(label, transform, fitted, shape):
                    if isinstance(one, AbstractTransform) and not (len(some) == values.size or one.separable):
                        raise ValueError(f"{label} is free as a whole or not at all: its transform is {one!r}.")
                    one = _specialize_transform(label, one, values[some], shape)
                    parts.append(Part(label, shape, count + some, one))
                ends = [f"[{', '.join(map(str, index))}]" if shape else "" for index in np.ndindex(shape)]
                names += [label + end for end, free_too in zip(ends, fitted, strict=True) if free_too]
            count += values.size
        if not names and free is None:
            raise ValueError(
                "No parameter is free: give params0 at least one float for which `free` is True, or free=False to fit "
                "starts and noise alone."
            )
        return cls(leaves, tree, np.concatenate([np.zeros(0), *numbers]), tuple(names), tuple(parts))

    @functools.cached_property
    def _cuts(self) -> list[tuple[slice, slice, Part]]:
        cuts, begin, u_begin = [], 0, 0
        for part in self.parts:
            size = part.transform.count_unknowns(len(part.places))
            cuts.append((slice(u_begin, u_begin + size), slice(begin, begin + len(part.places)), part))
            begin, u_begin = begin + len(part.places), u_begin + size
        return cuts

    @functools.cached_property
    def places(self) -> np.ndarray:
        """The places of the free numbers among all (X,)."""
        return np.concatenate([np.zeros(0, int), *(part.places for part in self.parts)])

    def __len__(self) -> int:
        """F, the number of unknowns."""
        return self._cuts[-1][0].stop if self.parts else 0

    def inverse(self, values: np.ndarray) -> np.ndarray:
        """The unknowns u (F,) at which the free ones among all `values` (P,) stand."""
        return np.concatenate([np.zeros(0), *(part.transform.inverse(values[part.places]) for part in self.parts)])

    def numbers(self, u, xp: Any = np):
        """All numbers (P,) where the free ones stand at u (F,)."""
        if xp is np:
            values = self.first.copy()
            values[self.places] = self.values(u)
            return values
        return xp.asarray(self.first, u.dtype).at[self.places].set(self.values(u, xp))

    def values(self, u, xp: Any = np):
        """The free numbers (X,) at u (F,); infinite where a step of the search led too far, which is a lost trial."""
        with np.errstate(over="ignore", invalid="ignore"):
            return xp.concatenate([u[:0], *[part.transform.value(u[own], xp) for own, _, part in self._cuts]])

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """The derivative of the free numbers by u, (X, F)."""
        matrix = np.zeros((len(self.names), len(self)))
        for own, rows, part in self._cuts:
            with np.errstate(over="ignore", invalid="ignore"):
                matrix[rows, own] = part.transform.jacobian(u[own])
        return matrix

    def directions(self, u: np.ndarray) -> np.ndarray:
        """The derivative of all numbers by u, with a row for each unknown, (F, P)."""
        rows = np.zeros((len(self), len(self.first)))
        rows[:, self.places] = self.jacobian(u).T
        return rows

    def ends(self, u: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The ends (X,) of intervals of the free numbers at u (F,), of half widths `spread` (X,), inside their sets."""
        x, low, high = self.values(u), np.empty(len(spread)), np.empty(len(spread))
        for _, rows, part in self._cuts:
            low[rows], high[rows] = part.transform.ends(x[rows], spread[rows])
        return low, high

    def covariance(self, u: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """The covariance (X, X) of free numbers from that of u (F, F): infinite, with NaN beside it, where u's is."""
        jacobian, unseen = self.jacobian(u), ~np.isfinite(np.diag(matrix))
        finite = np.where(unseen[:, None] | unseen, 0.0, matrix)
        moved = jacobian @ finite @ jacobian.T
        lost = (jacobian[:, unseen] != 0).any(axis=1)
        moved[lost], moved[:, lost] = np.nan, np.nan
        moved[lost, lost] = np.inf
        return moved

    def log_volume(self, u, xp: Any = np):
        """log of the volume of the free numbers per volume of u, up to a constant."""
        return sum(part.transform.log_volume(u[own], xp) for own, _, part in self._cuts)

    def draw(self, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.concatenate([u[:0], *(part.transform.draw(u[own], rng) for own, _, part in self._cuts)])

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the unknowns (F,): as their numbers, or as the whole leaf that they move together."""
        found = []
        for own, rows, part in self._cuts:
            found += self.names[rows] if part.transform.separable else [part.label] * (own.stop - own.start)
        return tuple(found)

    def limits(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) between which one step of the search from u (F,) may lie."""
        pairs = [part.transform.limits(u[own]) for own, _, part in self._cuts]
        low, high = (np.concatenate([np.zeros(0), *ends]) for ends in zip(*pairs, strict=True)) if pairs else (u, u)
        return low, high

    def take_step(self, u: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The end of a step (F,) from u (F,): along the tangent of x(u), where every number moves by itself."""
        parts = [part.transform.take_step(u[own], step[own]) for own, _, part in self._cuts]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def maps(self) -> tuple[AbstractTransform, ...]:
        return tuple(part.transform for own, _, part in self._cuts for _ in range(own.stop - own.start))

    @property
    def reach(self) -> np.ndarray:
        """The largest change of each u (F,) in one step."""
        return np.array([transform.reach for transform in self.maps])

    @property
    def room(self) -> np.ndarray:
        """The distance from one value of each u (F,) at which others are distinct."""
        return np.array([transform.room for transform in self.maps])

    def sizes(self, u: np.ndarray) -> np.ndarray:
        """Changes of u (F,), each of which changes the free numbers by about their own size."""
        x, jacobian = self.values(u), self.jacobian(u)
        size = np.where(x != 0, np.abs(x), 1.0)
        return np.minimum(1.0 / (np.abs(jacobian) / size[:, None]).max(axis=0, initial=1e-300), self.reach)

    def row(self, name: str) -> int:
        """The place among the free numbers of the one of this name, or of the only one whose name ends in it. `dry` is
        `params['joint']['dry']`, `l[1]` is `params['l'][1]`. Raises `ValueError` where none or several are."""
        if name in self.names:
            return self.names.index(name)
        cut = name.rfind("[") if name.endswith("]") else len(name)
        key, index = name[:cut], name[cut:]
        ends = f"[{key!r}]{index}", f".{key}{index}"
        rows = [k for k, own in enumerate(self.names) if own.endswith(ends)]
        if len(rows) != 1:
            several = [self.names[k] for k in rows]
            reason = f"{name!r} may be {', '.join(several)}" if rows else f"No free parameter is called {name!r}"
            raise ValueError(f"{reason}; there are {', '.join(self.names) or 'none: all are kept'}.")
        return rows[0]

    def unknown(self, name: str) -> int:
        """The place of the unknown that moves the free number of this name (`row`) alone. Raises `ValueError`."""
        row = self.row(name)
        name = self.names[row]
        own, rows, part = next(cut for cut in self._cuts if cut[1].start <= row < cut[1].stop)
        if not part.transform.separable:
            raise ValueError(
                f"{name} moves only together with the other numbers of {part.label}, whose transform is "
                f"{part.transform!r}: one of them cannot be kept while the others move."
            )
        return own.start + row - rows.start

    def fix(self, u: np.ndarray, which: int | None = None) -> "Parameters":
        """The parameters at u (F,), where the unknown `which` of a number of its own is kept there; None: all are."""
        parts, names = [], []
        for own, rows, part in [] if which is None else self._cuts:
            keep = np.ones(len(part.places), bool)
            if own.start <= which < own.stop:
                keep[which - own.start] = False
            if keep.any():
                parts.append(part._replace(places=part.places[keep]))
            names += [name for name, stays in zip(self.names[rows], keep, strict=True) if stays]
        return replace(self, first=self.numbers(u), parts=tuple(parts), names=tuple(names))

    def restore(self, numbers) -> PyTree:
        leaves, begin = [], 0
        for leaf in self.leaves:
            if eqx.is_array_like(leaf):
                end = begin + np.size(leaf)
                leaf = numbers[begin:end].reshape(np.shape(leaf)).astype(np.asarray(leaf).dtype)
                begin = end
            leaves.append(leaf)
        return jax.tree.unflatten(self.tree, leaves)


def _broadcast_prefix(prefix: PyTree, tree, leaves: list, name: str) -> list:
    whole = jax.tree.unflatten(tree, leaves)
    try:
        spread = jax.tree.broadcast(prefix, whole, is_leaf=lambda leaf: leaf is None)
        return tree.flatten_up_to(spread)
    except ValueError:
        raise ValueError(
            f"{name} must be one value for all parameters, or name every one of them as params0 does; got {prefix!r}. "
            f"The parameters are {', '.join(labelled_leaves(whole, 'params')[0][:12])}."
        ) from None


def _fitted_mask(label: str, leaf, may_move, free) -> np.ndarray:
    """True for each number of a leaf (n,) that is fitted. Raises where the user asks to fit one that cannot move."""
    wanted = np.asarray(may_move)
    if wanted.dtype != bool:
        raise TypeError(f"free must hold True or False; got {may_move!r} for {label}.")
    if wanted.shape not in ((), np.shape(leaf)):
        raise ValueError(
            f"free must hold True, False, or an array of them of the shape {np.shape(leaf)} for {label}; got one of "
            f"the shape {wanted.shape}."
        )
    if not np.issubdtype(np.asarray(leaf).dtype, np.floating):
        if wanted.any() and free is not None and free is not True:
            raise TypeError(f"{label} is free but not a float: write 1.0 instead of 1, or leave it out of `free`.")
        return np.zeros(np.size(leaf), bool)
    return np.broadcast_to(wanted, np.shape(leaf)).ravel()


def _split_by_transform(
    label: str, transform, fitted: np.ndarray, shape: tuple[int, ...]
) -> list[tuple[Any, np.ndarray]]:
    """Neighbours among the fitted numbers of a leaf that share a transform, each with their places in it, in order."""
    places = np.flatnonzero(fitted)
    if not isinstance(transform, np.ndarray):
        return [(transform, places)]
    if transform.shape != shape:
        raise ValueError(
            f"transforms must hold one for {label}, or an array of them of its shape {shape}; got one of the shape "
            f"{transform.shape}."
        )
    each = transform.ravel()
    edges = [k for k in range(1, len(places)) if each[places[k]] != each[places[k - 1]]]
    return [(each[some[0]], some) for some in np.split(places, edges)]


def _specialize_transform(label: str, transform, values: np.ndarray, shape: tuple[int, ...]) -> AbstractTransform:
    """The transform of a free leaf. Raises where it is none, or where the values start outside of its set."""
    transform = Unbounded() if transform is None else transform
    if not isinstance(transform, AbstractTransform):
        raise TypeError(
            "transforms must hold lagjax.positive, lagjax.between(a, b), lagjax.angle, lagjax.simplex, lagjax.inertia "
            f"or None; got {transform!r} for {label}."
        )
    if reason := transform.refuses(values):
        raise ValueError(f"{label} {reason}; got {values if values.size > 1 else values[0]}.")
    return transform.specialize(values, shape)
