"""`Signals`: what the sensors show of a motion, with derivatives.

`observe(q, qdot)` makes signals of a state, by default q itself. It may ask for `t` and `params`, so that a gain, a
bias or a mounting position can be fitted, too.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._arguments import accept
from lagjax._fit._motions import Motion
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Record
from lagjax._layout import Layout, halves

PyTree = Any
_AT_ONCE = 2048  # samples in one call of the compiled sensors: one program for records of any length


class Signals:
    """The sensors of a fit: `names` (S,), and the map from motions to signals and their derivatives."""

    def __init__(self, observe: Callable | None, layout: Layout, parameters: Parameters, record: Record):
        self.layout, self.parameters = layout, parameters
        if observe is None:
            self.names, self._at = layout.names, None
            if record.structure != (layout.tree, layout.shapes):
                raise ValueError(
                    f"values must have the structure of q, {layout.tree} of shapes {layout.shapes}, where there is no "
                    f"`observe`; records[0] has {record.structure[0]} of {record.structure[1]}."
                )
            return
        function = accept(observe, "observe")
        self.names = tuple("values" + name for name in record.names)

        def observed(y, t, numbers):
            q, qdot = map(layout.restore, halves(y))
            leaves, begin = [], 0
            for leaf in parameters.leaves:
                if hasattr(leaf, "shape"):
                    leaves.append(numbers[begin : begin + leaf.size].reshape(leaf.shape))
                    begin += leaf.size
                else:
                    leaves.append(leaf)
            return function(q, qdot, t=t, params=jax.tree.unflatten(parameters.tree, leaves))

        _require_signals(observed, layout, parameters, record)
        flat = lambda *state: jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(observed(*state))])  # noqa: E731

        def with_derivatives(y, t, numbers):
            return flat(y, t, numbers), *jax.jacfwd(flat, argnums=(0, 2))(y, t, numbers)

        self._at = jax.jit(jax.vmap(with_derivatives, in_axes=(0, 0, None)))

    def of(self, motion: Motion, ts: np.ndarray, numbers: np.ndarray, directions: np.ndarray):
        """The signals (N, T, S) of motions at `ts` (N, T), and their derivatives (N, T, S, D) along all directions."""
        tangents = motion.tangents
        if self._at is None:
            n = self.layout.size
            return motion.path[..., :n], np.ascontiguousarray(np.moveaxis(tangents[..., :n], 1, -1))
        (rows, times, states), free = motion.path.shape, len(directions)
        values, by_state, by_numbers = self._in_portions(motion.path.reshape(-1, states), ts.ravel(), numbers)
        shape = rows, times, values.shape[1]
        by_state = by_state.reshape(*shape, states)
        slopes = np.matmul(by_state, np.moveaxis(tangents, 1, -1))
        slopes[..., states:] += (by_numbers @ directions.T).reshape(*shape, free)
        return values.reshape(shape), slopes

    def _in_portions(self, y, t, numbers):
        assert self._at is not None
        parts = []
        for begin in range(0, len(y), _AT_ONCE):
            some, times = y[begin : begin + _AT_ONCE], t[begin : begin + _AT_ONCE]
            count = len(some)
            some, times = np.resize(some, (_AT_ONCE, y.shape[1])), np.resize(times, _AT_ONCE)
            inputs = (np.asarray(x, self.layout.dtype) for x in (some, times, numbers))
            parts.append([np.asarray(x, float)[:count] for x in self._at(*inputs)])
        return [np.concatenate(columns) for columns in zip(*parts, strict=True)]


def _require_signals(observed, layout: Layout, parameters: Parameters, record: Record) -> None:
    """Raise `ValueError` where `observe` does not return what the records hold."""
    of = jax.ShapeDtypeStruct
    out = jax.eval_shape(
        observed, of((2 * layout.size,), layout.dtype), of((), layout.dtype), of(parameters.first.shape, layout.dtype)
    )
    leaves, tree = jax.tree.flatten(out)
    got = tree, tuple(getattr(leaf, "shape", ()) for leaf in leaves)
    if got != record.structure:
        raise ValueError(
            f"observe returns {got[0]} of shapes {got[1]} at one time, but the values of a record have "
            f"{record.structure[0]} of shapes {record.structure[1]} after their axis of times."
        )


def looks_like_positions(observe: Callable | None, record: Record, layout: Layout) -> bool:
    """Whether the signals are positions, or something of their structure (with a gain, a bias): a start for q."""
    return observe is None or record.structure == (layout.tree, layout.shapes)
