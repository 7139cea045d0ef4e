"""`Members`: the members of a trajectory along one axis, in NumPy: their states, their times and their parameters."""

import math
from typing import Any

import equinox as eqx
import jax
import numpy as np

from lagjax._interface import Layout, numbers_at
from lagjax._run._trajectory import EACH, Trajectory

PyTree = Any


_SHARED = "shared"  # stands for the batch axis of what all members share


class Members:
    def __init__(self, trajectory: Trajectory):
        self.batch = np.shape(trajectory.result._value)
        self.count, rank = math.prod(self.batch), len(self.batch)
        first = jax.tree.map(lambda leaf: numbers_at(leaf, (0,) * (rank + 1)), (trajectory.q, trajectory.qdot))
        self.layout, self.trajectory = Layout.from_state(*first), trajectory
        # Of the axes of a batch, the innermost may share some parameters (`Trajectory.map_members`).
        self._outer = rank - (rank > 0 and trajectory.params_axes != EACH)
        self.numbers, self.params = self._parameters()

    def _parameters(self) -> tuple[list[np.ndarray], PyTree]:
        """Every number in params, () where all members share it, else (N,); and the params of one member."""
        axes = self.trajectory.params_axes
        numbers, code = eqx.partition(self.trajectory.params, eqx.is_array_like)
        axis_of_leaf = jax.tree.map(
            lambda axis, part: jax.tree.map(lambda _: _SHARED if axis is None else axis, part),
            axes, numbers, is_leaf=lambda axis: axis is None,
        )  # fmt: skip
        leaves, structure = jax.tree.flatten(numbers)
        columns, of_one = [], []
        for leaf, axis in zip(leaves, jax.tree.leaves(axis_of_leaf), strict=True):
            each = np.asarray(leaf)
            if self._outer < len(self.batch) and axis is _SHARED:
                each = np.expand_dims(each, self._outer)
            elif self._outer < len(self.batch):
                each = np.moveaxis(each, axis + self._outer if axis >= 0 else axis, self._outer)
            leading, shape = each.shape[: len(self.batch)], each.shape[len(self.batch) :]
            of_one.append(each[(0,) * len(self.batch)])
            if math.prod(leading) == 1:
                columns += list(each.reshape(-1))
            else:
                columns += list(np.broadcast_to(each, self.batch + shape).reshape(self.count, -1).T)
        return columns, eqx.combine(jax.tree.unflatten(structure, of_one), code)

    def flat(self, tree: PyTree, axes: int = 1) -> np.ndarray:
        """The leaves of q or qdot end to end, (N, S, n)."""
        lead = len(self.batch) + axes
        parts = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
        parts = [x.reshape(self.count, *x.shape[len(self.batch) : lead], -1) for x in parts]
        return np.concatenate(parts, axis=-1)

    def shared(self, x, dimensions: int) -> np.ndarray:
        """Times or tolerances, arrays of this many dimensions, for every member: (N, …), also where all share them."""
        x = np.asarray(x)
        if x.ndim < len(self.batch) + dimensions:
            x = np.expand_dims(x, x.ndim - dimensions)
        own = x.shape[len(self.batch) :]
        return np.broadcast_to(x, self.batch + own).reshape(self.count, *own)

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
