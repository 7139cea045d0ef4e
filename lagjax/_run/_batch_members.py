"""`Members`: the members of a trajectory along one axis, in NumPy: their states, their times and their parameters."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._interface import Layout, is_concrete, numbers_at
from lagjax._run._trajectory import EACH, Trajectory

_SHARED = "shared"  # stands for the batch axis of what all members share


def _numbers_in_front(trajectory: Trajectory, batch: tuple[int, ...]) -> tuple[PyTree, PyTree]:
    """The numbers in params with the batch axes first, of size 1 where members share them; and the rest of params."""
    axes, rank = trajectory.params_axes, len(batch)
    # Of the axes of a batch, the innermost may share some parameters (`Trajectory.map_members`).
    outer = rank - (rank > 0 and axes != EACH)
    numbers, code = eqx.partition(trajectory.params, eqx.is_array_like)
    if outer == rank:
        axes = EACH
    axis_of_leaf = jax.tree.map(
        lambda axis, part: jax.tree.map(lambda _: _SHARED if axis is None else axis, part),
        axes, numbers, is_leaf=lambda axis: axis is None,
    )  # fmt: skip

    def move(leaf, axis):
        library: Any = np if is_concrete(leaf) else jnp
        leaf = library.asarray(leaf)
        if outer == rank:
            return leaf
        if axis is _SHARED:
            return library.expand_dims(leaf, outer)
        return library.moveaxis(leaf, axis + outer if axis >= 0 else axis, outer)

    return jax.tree.map(move, numbers, axis_of_leaf), code


def spread_params(trajectory: Trajectory, member: np.ndarray) -> tuple[PyTree, PyTree]:
    """The params for lanes of which each follows a `member` (L,), and per leaf the axis of lanes, None if shared."""
    batch = np.shape(trajectory.result._value)
    numbers, code = _numbers_in_front(trajectory, batch)

    def lanes(x):
        own = x.shape[len(batch) :]
        if math.prod(x.shape[: len(batch)]) == 1:
            return x.reshape(own)
        return (np if is_concrete(x) else jnp).broadcast_to(x, batch + own).reshape(-1, *own)[member]

    axes = jax.tree.map(lambda x: None if math.prod(x.shape[: len(batch)]) == 1 else 0, numbers)
    return eqx.combine(jax.tree.map(lanes, numbers), code), axes


def spread_rows(x, batch: tuple[int, ...], dimensions: int):
    """An array of this many `dimensions` for every member of a batch, (N, …), also where all share it."""
    library: Any = np if is_concrete(x) else jnp
    x = library.asarray(x)
    if x.ndim < len(batch) + dimensions:
        x = library.expand_dims(x, x.ndim - dimensions)
    own = x.shape[x.ndim - dimensions :]
    return library.broadcast_to(x, batch + own).reshape(math.prod(batch), *own)


class Members:
    def __init__(self, trajectory: Trajectory):
        self.batch = np.shape(trajectory.result._value)
        self.count, rank = math.prod(self.batch), len(self.batch)
        first = jax.tree.map(lambda leaf: numbers_at(leaf, (0,) * (rank + 1)), (trajectory.q, trajectory.qdot))
        self.layout, self.trajectory = Layout.from_state(*first), trajectory
        self.numbers, self.params = self._parameters()

    def _parameters(self) -> tuple[list[np.ndarray], PyTree]:
        """Every number in params, () if all members share it, else (N,); and the params of one member."""
        numbers, code = _numbers_in_front(self.trajectory, self.batch)
        leaves, structure = jax.tree.flatten(numbers)
        columns, of_one = [], []
        for each in leaves:
            leading, shape = each.shape[: len(self.batch)], each.shape[len(self.batch) :]
            of_one.append(each[(0,) * len(self.batch)])
            if math.prod(leading) == 1:
                columns += list(each.reshape(-1))
            else:
                columns += list(np.broadcast_to(each, self.batch + shape).reshape(self.count, -1).T)
        return columns, eqx.combine(jax.tree.unflatten(structure, of_one), code)

    def flat(self, tree: PyTree, axes: int = 1) -> np.ndarray:
        """The leaves of q or qdot concatenated, (N, S, n)."""
        lead = len(self.batch) + axes
        parts = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
        parts = [x.reshape(self.count, *x.shape[len(self.batch) : lead], -1) for x in parts]
        return np.concatenate(parts, axis=-1)

    def shared(self, x, dimensions: int) -> np.ndarray:
        """Times or tolerances, arrays of this many dimensions, broadcast to all members: (N, …)."""
        return spread_rows(np.asarray(x), self.batch, dimensions)

    def numbers_of(self, k: int) -> np.ndarray:
        return np.array([x if np.ndim(x) == 0 else x[k] for x in self.numbers])

    def params_of(self, k: int) -> PyTree:
        own, rest = eqx.partition(self.params, eqx.is_array_like)
        leaves, structure = jax.tree.flatten(own)
        if not leaves:
            return self.params
        ends = np.cumsum([np.size(leaf) for leaf in leaves])[:-1]
        parts = [
            part.reshape(np.shape(leaf)).astype(np.result_type(leaf))
            for part, leaf in zip(np.split(self.numbers_of(k), ends), leaves, strict=True)
        ]
        return eqx.combine(jax.tree.unflatten(structure, parts), rest)
