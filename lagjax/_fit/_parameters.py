"""`Parameters`: which numbers among the user's parameters are fitted, what they are called, and how they may move.

The scene's parameters are a pytree of any structure. Its P numbers end to end are one vector; F of them are free, and
the search moves these through their transforms.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from lagjax._fit._transforms import AbstractTransform, Unbounded
from lagjax._layout import taken_apart
from lagjax._validate import as_arrays, require_finite

PyTree = Any


@dataclass(frozen=True)
class Parameters:
    """The numbers of a pytree of parameters, and those among them that are free.

    - `leaves`, `tree`: the pytree with arrays for numbers; a leaf that is no number is a part of the program.
    - `first` (P,): all numbers at the start of the search.
    - `places` (F,): where the free numbers stand among all; `names` (F,): what they are called, `params['m']`.
    - `transforms` (F,): how each free number may move.
    """

    leaves: list
    tree: Any
    first: np.ndarray
    places: np.ndarray
    names: tuple[str, ...]
    transforms: tuple[AbstractTransform, ...]

    @classmethod
    def of(
        cls, params: PyTree, free: PyTree = None, transforms: PyTree = None, dtype: Any = np.float64
    ) -> "Parameters":
        """The parameters as the user gives them; `free` and `transforms` are prefixes of the same structure.

        Raises `TypeError` or `ValueError` with the name of the parameter that cannot be right.
        """
        require_finite(params, "params0")
        labels, leaves, tree = taken_apart(as_arrays(params, dtype, "params0"), "params")
        is_free = _spread(True if free is None else free, tree, leaves, "free")
        moved_by = _spread(Unbounded() if transforms is None else transforms, tree, leaves, "transforms")
        numbers, places, names, maps = [], [], [], []
        count = 0
        for label, leaf, may_move, transform in zip(labels, leaves, is_free, moved_by, strict=True):
            if not eqx.is_array_like(leaf):
                continue
            values = np.asarray(leaf, np.float64).ravel()
            numbers.append(values)
            if _is_fitted(label, leaf, may_move, free):
                transform = _transform_of(label, transform, values)
                places += range(count, count + values.size)
                names += _names(label, np.shape(leaf))
                maps += [transform] * values.size
            count += values.size
        if not names:
            raise ValueError("No parameter is free: give params0 at least one float for which `free` is True.")
        return cls(leaves, tree, np.concatenate(numbers), np.array(places), tuple(names), tuple(maps))

    def __len__(self) -> int:
        return len(self.names)

    def moved(self, values: np.ndarray) -> np.ndarray:
        """u (F,) of the free numbers among all `values` (P,)."""
        free = values[self.places]
        return np.array([float(map_.inverse(x)) for map_, x in zip(self.transforms, free, strict=True)])

    def numbers(self, u: np.ndarray) -> np.ndarray:
        """All numbers (P,) where the free ones stand at u (F,)."""
        values = self.first.copy()
        values[self.places] = self.values(u)
        return values

    def values(self, u: np.ndarray) -> np.ndarray:
        """The free numbers (F,) at u (F,)."""
        return np.array([float(map_.value(x)) for map_, x in zip(self.transforms, u, strict=True)])

    def slopes(self, u: np.ndarray) -> np.ndarray:
        """dx/du of each free number (F,)."""
        return np.array([float(map_.slope(x)) for map_, x in zip(self.transforms, u, strict=True)])

    def directions(self, u: np.ndarray) -> np.ndarray:
        """The derivative of all numbers by u, with a row for each free one, (F, P)."""
        rows = np.zeros((len(self), len(self.first)))
        rows[np.arange(len(self)), self.places] = self.slopes(u)
        return rows

    @property
    def reach(self) -> np.ndarray:
        """How far one step may change each u (F,)."""
        return np.array([map_.reach for map_ in self.transforms])

    def restore(self, numbers: np.ndarray) -> PyTree:
        """The user's pytree of all numbers (P,)."""
        leaves, begin = [], 0
        for leaf in self.leaves:
            if eqx.is_array_like(leaf):
                end = begin + np.size(leaf)
                leaf = numbers[begin:end].reshape(np.shape(leaf)).astype(np.asarray(leaf).dtype)
                begin = end
            leaves.append(leaf)
        return jax.tree.unflatten(self.tree, leaves)


def _spread(prefix: PyTree, tree, leaves: list, name: str) -> list:
    """A prefix of the parameters spread over every leaf. Raises `ValueError` where it is no prefix."""
    whole = jax.tree.unflatten(tree, leaves)
    try:
        spread = jax.tree.broadcast(prefix, whole, is_leaf=lambda leaf: leaf is None)
        return tree.flatten_up_to(spread)
    except ValueError:
        raise ValueError(
            f"{name} must be one value for all parameters, or have the structure of params0 down to some depth; got "
            f"{prefix!r} for {jax.tree.unflatten(tree, ['*'] * len(leaves))}."
        ) from None


def _is_fitted(label: str, leaf, may_move, free) -> bool:
    """Whether a leaf is fitted. Raises where the user asks for that of one that cannot move."""
    if not isinstance(may_move, bool | np.bool_):
        raise TypeError(f"free must hold True or False; got {may_move!r} for {label}.")
    if not np.issubdtype(np.asarray(leaf).dtype, np.floating):
        if may_move and free is not None and free is not True:
            raise TypeError(f"{label} is free but not a float: write 1.0 instead of 1, or leave it out of `free`.")
        return False
    return bool(may_move)


def _transform_of(label: str, transform, values: np.ndarray) -> AbstractTransform:
    """The transform of a free leaf. Raises where it is none, or where the values start outside of its set."""
    transform = Unbounded() if transform is None else transform
    if not isinstance(transform, AbstractTransform):
        raise TypeError(
            f"transforms must hold lagjax.positive, lagjax.between(a, b) or None; got {transform!r} for {label}."
        )
    if reason := transform.refuses(values):
        raise ValueError(f"{label} {reason}; got {values if values.size > 1 else values[0]}.")
    return transform


def _names(label: str, shape: tuple[int, ...]) -> list[str]:
    return [label + (f"[{', '.join(map(str, index))}]" if shape else "") for index in np.ndindex(shape)]
