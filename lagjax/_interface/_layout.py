"""`Layout`: conversion between the user's pytree of coordinates and the flat vector that is used inside the package.

A `Layout` is read off one state (q, qdot): the tree, the shape of every leaf, one floating dtype, and a name for each
scalar coordinate, such as `q['theta']` or `q.r` or `q[1]`, for error messages.
"""

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax._interface._results import join_names


@jax.tree_util.register_static
@dataclass(frozen=True)
class Layout:
    """The structure of a state's coordinates: `flatten` turns a pytree into a vector, `restore` turns it back."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    paths: tuple[str, ...]
    dtype: np.dtype

    @classmethod
    def from_state(cls, q: PyTree, qdot: PyTree, name: str = "qdot") -> "Layout":
        """Read the layout off a state; raise `TypeError` or `ValueError` if q and qdot do not fit together.

        `name` is what messages call the second pytree.
        """
        paths, tree, shapes, dtypes = _checked_structure(q, "q")
        _, qdot_tree, qdot_shapes, qdot_dtypes = _checked_structure(qdot, name)
        if tree != qdot_tree:
            raise ValueError(f"q and {name} must have the same structure; got {tree} for q and {qdot_tree} for {name}.")
        rate = "velocity" if name == "qdot" else "acceleration"
        for path, shape, qdot_shape in zip(paths, shapes, qdot_shapes, strict=True):
            if shape != qdot_shape:
                raise ValueError(f"{path} has shape {shape}, but its {rate} has shape {qdot_shape}: they must agree.")
        if not sum(math.prod(shape) for shape in shapes):
            raise ValueError("q has no coordinates: it must hold at least one number.")
        dtypes = {*dtypes, *qdot_dtypes}
        dtype = dtypes.pop() if len(dtypes) == 1 else jnp.result_type(*dtypes)
        if dtype not in (jnp.float32, jnp.float64):
            raise TypeError(f"Coordinates must be float32 or float64; got {dtype}.")
        return cls(tree, shapes, paths, np.dtype(dtype))

    @classmethod
    def from_numbers(cls, tree: PyTree, name: str, dtype) -> "Layout":
        """Return the layout of any pytree of real floats; raise `TypeError` for other leaves, under `name`."""
        paths, structure, shapes, _ = _checked_structure(tree, name)
        return cls(structure, shapes, paths, np.dtype(dtype))

    @property
    def size(self) -> int:
        return sum(math.prod(shape) for shape in self.shapes)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """The name of each of the n coordinates, in the order of the flat vector."""
        return tuple(
            path + (f"[{', '.join(map(str, index))}]" if shape else "")
            for path, shape in zip(self.paths, self.shapes, strict=True)
            for index in np.ndindex(shape)
        )

    def flatten(self, tree: PyTree) -> Float[Array, " n"]:
        """Concatenate the leaves of one state's q or qdot to a vector (n,)."""
        leaves = jax.tree.leaves(tree)
        if not any(isinstance(leaf, jax.Array) for leaf in leaves):  # one transfer instead of some operations
            return jnp.asarray(np.concatenate([np.ravel(np.asarray(leaf, self.dtype)) for leaf in leaves]))
        leaves = [jnp.ravel(jnp.asarray(leaf, self.dtype)) for leaf in leaves]
        return leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves)

    def restore(self, flat: Float[Array, "... n"] | np.ndarray) -> PyTree:
        """Split a vector (n,), or many (..., n), into the user's pytree: leaves (..., *the shape of the leaf)."""
        leaves, begin = [], 0
        for shape in self.shapes:
            end = begin + math.prod(shape)
            leaves.append(flat[..., begin:end].reshape(flat.shape[:-1] + shape))
            begin = end
        return jax.tree.unflatten(self.tree, leaves)


def halves(y):
    """Split states y (…, 2n) into (q, q̇), each (…, n)."""
    n = y.shape[-1] // 2
    return y[..., :n], y[..., n:]


@functools.partial(jax.jit, static_argnums=1, inline=True)  # outside of `jit` one program
def flatten_numbers(numbers: PyTree, dtype) -> Float[Array, " P"]:
    """Concatenate all numbers of a pytree, in the order of its leaves, to (P,)."""
    leaves = [jnp.ravel(jnp.asarray(leaf)).astype(dtype) for leaf in jax.tree.leaves(numbers)]
    return jnp.concatenate(leaves) if leaves else jnp.zeros(0, dtype)


def _checked_structure(tree: PyTree, name: str) -> tuple[tuple[str, ...], Any, tuple[tuple[int, ...], ...], list]:
    """Return the paths, the tree, the shapes and the dtypes of a pytree; raise if a leaf is no real float."""
    paths, leaves, structure = labelled_leaves(tree, name)
    dtypes = []
    for path, leaf in zip(paths, leaves, strict=True):
        try:
            dtype = dtype_of(leaf)
        except (TypeError, ValueError):
            more = ""
            if dataclasses.is_dataclass(leaf):
                name = type(leaf).__name__
                more = f" JAX does not know the fields of {name}: call jax.tree_util.register_dataclass({name}) once."
            raise TypeError(f"{path} must be a real number or array; got {leaf!r}.{more}") from None
        if dtype != _DOUBLE and not jnp.issubdtype(dtype, jnp.floating):
            raise TypeError(f"{path} must hold real floating-point numbers; got {dtype} (write 1.0 instead of 1).")
        dtypes.append(dtype)
    return paths, structure, tuple(np.shape(leaf) for leaf in leaves), dtypes


_DOUBLE = np.dtype("float64")


def dtype_of(x):
    """Return the dtype that JAX computes with for a number or an array; raise `TypeError` or `ValueError` if none."""
    # An array of JAX has it already, and tells at a tenth of what `jnp.result_type` costs; a weak one does not. One of
    # NumPy in double precision has it where JAX has doubles.
    if isinstance(x, jax.Array) and not getattr(x, "weak_type", True):  # arrays of random keys have no such attribute
        return x.dtype
    if type(x) is np.ndarray and x.dtype == _DOUBLE == jax.dtypes.canonicalize_dtype(_DOUBLE):
        return _DOUBLE
    return jnp.result_type(x)


def describe_numbers(tree: PyTree, name: str) -> str:
    """Return the first numbers of a pytree by name, as text: "q['x'] = 1, q['y'] = 2"."""
    found = [
        f"{label}{list(place) if place else ''} = {value:.6g}"
        for label, leaf in zip(*labelled_leaves(tree, name)[:2], strict=True)
        for place, value in np.ndenumerate(np.asarray(leaf))
    ]
    return join_names(found)


def number_names(tree: PyTree, name: str) -> list[str]:
    """Return a name for each number in a pytree, such as params['m'][0], in the order of its leaves."""
    labels, leaves, _ = labelled_leaves(tree, name)
    shapes = [(label, np.shape(leaf)) for label, leaf in zip(labels, leaves, strict=True) if eqx.is_array_like(leaf)]
    return [label + str(list(at)) * bool(shape) for label, shape in shapes for at in np.ndindex(shape)]


def labelled_leaves(tree: PyTree, name: str, is_leaf=None) -> tuple[tuple[str, ...], list, Any]:
    """Return the names of a pytree's leaves, such as `params['m']`, the leaves, and the tree structure."""
    try:
        leaves, structure = jax.tree_util.tree_flatten_with_path(tree, is_leaf)
    except ValueError as why:  # a dict whose keys have no order
        raise ValueError(f"{name} cannot be taken apart: {why}") from None
    return tuple(name + jax.tree_util.keystr(path) for path, _ in leaves), [leaf for _, leaf in leaves], structure
