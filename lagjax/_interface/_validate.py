"""Checks of the numbers that a user passes, with a message for each mistake.

Numbers become arrays, so that a new value needs no new compilation. Of values that are being traced, inside the user's
own `jit`, only shapes and dtypes are checked.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from lagjax._interface._layout import dtype_of, labelled_leaves


def as_arrays(tree: PyTree, dtype, name: str = "params") -> PyTree:
    """Return the tree with numbers as arrays, so that new values need no new compilation; floats get `dtype`."""
    # Raises `TypeError` or `ValueError`, with the name of the leaf, for what is neither a number nor can be a part of
    # the program.
    try:
        leaves, structure = jax.tree.flatten(tree)  # the names of leaves cost more than all else
    except ValueError:
        _, leaves, structure = labelled_leaves(tree, name)  # which raises a sentence
    if not all(_is_valid_leaf(leaf, dtype) for leaf in leaves):
        labels, leaves, structure = labelled_leaves(tree, name)
        return structure.unflatten(_leaf_as_array(*of, dtype) for of in zip(leaves, labels, strict=True))
    return structure.unflatten([np.asarray(leaf, dtype) if type(leaf) is float else leaf for leaf in leaves])


def _is_valid_leaf(leaf, dtype) -> bool:
    """True if a leaf needs no check: a Python float, or an array with the dtype of the state."""
    if type(leaf) is float:
        return dtype != _SINGLE or _TINY <= abs(leaf) <= _HUGE or leaf == 0
    return (type(leaf) is np.ndarray or isinstance(leaf, jax.Array)) and leaf.dtype == dtype


def _leaf_as_array(leaf, label: str, dtype):
    if not eqx.is_array_like(leaf):  # a function, a string: part of the program
        try:
            hash(leaf)
        except TypeError:
            raise TypeError(
                f"{label} is a {type(leaf).__name__}, neither a number nor hashable: it can be no part of a program."
            ) from None
        return leaf
    require_numbers(leaf, label)
    if np.ma.is_masked(leaf):
        raise ValueError(f"{label} is masked in places, where it has no number: fill them first.")
    if dtype == _SINGLE and label.startswith("params"):
        _require_float32_range(leaf, label)
    try:
        return _as_array(leaf, dtype if jnp.issubdtype(jnp.result_type(leaf), jnp.floating) else None)
    except OverflowError:
        raise ValueError(f"{label} is too large for an integer of 64 bits: write it as a float.") from None


def _require_float32_range(leaf, label: str) -> None:
    """Raise `ValueError` if the largest number of a leaf is out of the range of float32."""
    largest = float(np.max(np.abs(np.asarray(leaf, float)), initial=0.0)) if is_concrete(leaf) else 0.0
    if largest and np.isfinite(largest) and not _TINY <= largest <= _HUGE and getattr(leaf, "dtype", None) != _SINGLE:
        raise ValueError(
            f"{label} is {largest:.3g}, and float32 holds {_TINY:.1e} to {_HUGE:.1e}: choose other units, or "
            "call jax.config.update('jax_enable_x64', True) and pass a state of float64."
        )


_SINGLE, _TINY, _HUGE = np.dtype("float32"), float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


def _dtype_of(value):
    """Return the dtype of a number or an array of numbers; None for anything else."""
    try:
        kind = dtype_of(value)
    except (TypeError, ValueError):
        return None
    return kind if jnp.issubdtype(kind, jnp.number) or jnp.issubdtype(kind, jnp.bool_) else None


def require_numbers(leaf, label: str) -> None:
    """Raise `TypeError` if a leaf is not a number or an array of numbers of a dtype that JAX has."""
    if _dtype_of(leaf) is None:
        kind = getattr(leaf, "dtype", None)
        got = type(leaf).__name__ if kind is None else f"an array of {kind}"
        raise TypeError(f"{label} must hold numbers that JAX knows; got {got}.")


def _as_array(x, dtype=None):
    """Return an array of JAX as it is, else one of NumPy, which is cheap and stays concrete inside `jit`."""
    if isinstance(x, jax.Array):
        return x if dtype is None or x.dtype == dtype else x.astype(dtype)
    return np.asarray(x, jnp.result_type(x) if dtype is None else dtype)


def is_concrete(value) -> bool:
    return not isinstance(value, Tracer)


def require_concrete(tree: PyTree, what: str, instead: str) -> None:
    """Raise `TypeError` if a number of `what` is being traced; `instead` is the advice in the message."""
    if not all(map(is_concrete, jax.tree.leaves(tree))):
        raise TypeError(f"{what} is being traced by jax.jit, jax.vmap or jax.grad. {instead}")


def not_finite(tree: PyTree, name: str) -> list[tuple[str, Any]]:
    """Return (name, value) of every number that is NaN or infinite; traced numbers are not checked."""
    if all(_is_finite(leaf) for leaf in jax.tree.leaves(tree)):  # the names of leaves cost more than all else
        return []
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if eqx.is_array_like(leaf) and is_concrete(leaf) and _dtype_of(leaf) is not None:
            values, label = np.asarray(leaf), name + jax.tree_util.keystr(path)
            for index in np.argwhere(~np.isfinite(values)):
                found.append((label + (str(index.tolist()) if values.ndim else ""), values[tuple(index)]))
    return found


def _is_finite(leaf) -> bool:
    """True if a leaf is a concrete float array without NaN and infinity; False also where this needs a slower check."""
    return isinstance(leaf, np.ndarray | jax.Array) and is_concrete(leaf) and leaf.dtype in _FLOATS and all_finite(leaf)


_FLOATS = (np.dtype("float64"), np.dtype("float32"))


def all_finite(array) -> bool:
    return bool(np.isfinite(np.asarray(array)).all())


def require_budget(value, name: str) -> None:
    """Raise `ValueError` if a maximum number, of steps for example, is no positive integer of 32 bits."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be a positive integer, so that every run ends; got {value!r}.")
    if value >= 2**31:
        raise ValueError(f"{name} must be less than 2**31, more than any run could use up.")


def require_flag(value, name: str) -> None:
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False; got {value!r}.")


def require_finite(tree: PyTree, name: str) -> None:
    if bad := not_finite(tree, name):
        where, value = bad[0]
        raise ValueError(f"{where} is {value}: every number given must be finite.")


def require_number(value, name: str) -> None:
    kind = _dtype_of(value) if eqx.is_array_like(value) else None
    if kind is None or kind == jnp.bool_ or jnp.issubdtype(kind, jnp.complexfloating):
        raise TypeError(f"{name} must be a real number; got {value!r}.{_suggest_params(value)}")
    if isinstance(value, int) and abs(value) >= 2**63:
        raise ValueError(f"{name} is too large for an integer of 64 bits: write it as a float.")
    if jnp.ndim(value) != 0:
        raise ValueError(f"{name} must be one number; got shape {jnp.shape(value)}.")


def _suggest_params(value) -> str:
    """Return advice for the message if `value` looks like params passed in another argument's place; else ""."""
    if not isinstance(value, dict | list | tuple | eqx.Module):
        return ""
    return " Parameters come behind it; or name them, params=…."


def output_times(ts, dtype, rows: bool = False) -> jax.Array | np.ndarray:
    """Return the output times as an array (T,) of this dtype; with `rows` also (N, T), a row for each of N members.

    Raises if they are not strictly monotonic, or fewer than two.
    """
    known = isinstance(ts, np.ndarray | jax.Array) and _is_valid_leaf(ts, dtype) and is_concrete(ts)
    if known and (ts.ndim == 1 or (rows and ts.ndim == 2)):
        values = np.asarray(ts)  # most often there is nothing to say
        if values.shape[-1] > 1 and len(values) and _is_monotonic(values) and all_finite(values):
            return ts
    if getattr(getattr(ts, "dtype", None), "kind", None) in ("m", "M"):
        raise TypeError(
            f"ts holds {ts.dtype}, dates or spans of time: give numbers in the unit of time of L, as of seconds "
            "(ts - ts[0]) / numpy.timedelta64(1, 's')."
        )
    try:
        kind = dtype_of(ts if isinstance(ts, jax.Array) else np.asarray(ts))
    except (TypeError, ValueError):
        got = f"{type(ts).__name__}.{_suggest_params(ts)}"
        raise TypeError(f"ts must be an array of output times; got {got}") from None
    if np.ndim(ts) == 2 and not rows:
        raise ValueError(
            f"ts must be one row of output times; got shape {np.shape(ts)}. lagjax.simulate_batch(system, q0, qdot0, "
            "ts) takes a row of times for each of its members."
        )
    if np.ndim(ts) not in (1, 2) or np.shape(ts)[-1] < 2 or not np.size(ts):
        raise ValueError(f"ts must hold at least two output times, ts[0] the start; got shape {np.shape(ts)}.")
    if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise TypeError(f"ts must hold real numbers; got {kind}.")
    whole = ts if isinstance(ts, jax.Array) else np.asanyarray(ts)
    times = whole if _is_valid_leaf(whole, dtype) else _as_array(_leaf_as_array(whole, "ts", dtype), dtype)
    require_finite(times, "ts")
    if is_concrete(times):
        values = np.asarray(times)
        if not _is_monotonic(values):
            gaps = np.sign(np.diff(values))
            wrong = (gaps != gaps[..., :1]) | (gaps == 0)
            place = ", ".join(map(str, np.argwhere(wrong)[0]))
            raise ValueError(
                f"ts must be strictly increasing or strictly decreasing, in {np.dtype(dtype).name}; it is not between "
                f"ts[{place}] and the next."
            )
    return times


def _is_monotonic(values: np.ndarray) -> bool:
    later, earlier = values[..., 1:], values[..., :-1]
    return bool(((later > earlier).all(-1) | (later < earlier).all(-1)).all())


def require_tolerance(value, name: str):
    """Return the value of `rtol` or `atol`; raise if it is not one positive number, or an rtol ≥ 1."""
    require_number(value, name)
    if is_concrete(value) and not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be positive; got {value}.")
    if name == "rtol" and is_concrete(value) and value >= 1:
        raise ValueError(f"rtol must be less than 1, which would leave no digit of the motion; got {value}.")
    return value
