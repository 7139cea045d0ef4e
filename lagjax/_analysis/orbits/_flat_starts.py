"""Starts of one motion or of many, each with a time of its own, as the user gives them and as flat rows."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import concatenate_leaves, rows
from lagjax._interface import Layout, as_arrays, require_concrete, require_finite, require_number

PyTree = Any


def starts(q0: PyTree, qdot0: PyTree, time, name: str) -> tuple[np.ndarray, Layout, np.ndarray]:
    """The times, () or (N,), the layout of one state, and all states, (1, 2n) or (N, 2n).

    `time`, called `name`, is one number, or an array of as many as there are members on the first axis of every leaf.
    Raises `TypeError` or `ValueError` where that is not so, or a number is not finite or not there yet.
    """
    require_untraced((q0, qdot0, time), "The start")
    if isinstance(time, dict | eqx.Module):
        require_number(time, name)
    for label, value in ((name, time), ("q0", q0), ("qdot0", qdot0)):
        require_finite(value, label)
    times = np.asarray(time, float)
    if times.ndim > 1 or not times.size:
        raise ValueError(f"{name} must be one number, or an array (N,) of a batch; got shape {times.shape}.")
    if not (times > 0).all():
        raise ValueError(f"{name} must be positive; got {times.min()}.")
    shapes, dtype = sorted({np.shape(leaf) for leaf in jax.tree.leaves((q0, qdot0))}), np.dtype(float)
    if times.ndim and any(shape[:1] != times.shape for shape in shapes):
        raise ValueError(
            f"{name} has shape {times.shape}, a batch: every leaf of q0 and qdot0 must have that many members as its "
            f"first axis; got shapes {shapes}."
        )
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], (q0, qdot0)) if times.ndim else (q0, qdot0)
    layout = Layout.from_state(*first)
    arrays = jax.tree.leaves(as_arrays((q0, qdot0), layout.dtype, "state"))
    if not times.ndim:
        return times, layout, np.asarray(concatenate_leaves(arrays, dtype))[None]
    return times, layout, np.asarray(rows(arrays, [0] * len(arrays), len(times), dtype))


def require_untraced(tree: PyTree, what: str) -> None:
    require_concrete(
        tree,
        what,
        "Orbits are searched for with numbers, how often depends on what is met: search outside of jit, and give many "
        "starts as arrays with the members as first axis, instead of jax.vmap.",
    )
