"""JAX functions on the host: traced once, then evaluated in NumPy for all members of a batch, without XLA.

XLA would compile for a second what runs here at once, at a microsecond per operation and array. The first axis of every
array is that of the members, or has length one if all members share the values; an operation acts on the other axes.
Primitives of lagjax are evaluated by the functions registered with `compute_on_host`.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from jax.extend import core
from jax.lax import GatherScatterMode

_UFUNCS: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "abs": np.abs, "sign": np.sign, "max": np.maximum, "min": np.minimum, "sqrt": np.sqrt, "cos": np.cos,
    "sin": np.sin, "atan2": np.arctan2, "square": np.square, "is_finite": np.isfinite, "gt": np.greater, "lt": np.less,
    "ge": np.greater_equal, "le": np.less_equal, "eq": np.equal, "ne": np.not_equal, "and": np.bitwise_and,
    "or": np.bitwise_or, "not": np.invert,
}  # fmt: skip
_SAME = ("stop_gradient", "copy", "copy_p", "pvary", "pcast")
_CALLS = ("jit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint")
_FOLDS: dict[str, Callable] = {
    "reduce_sum": lambda x, axis: np.sum(x, axis=axis, dtype=x.dtype),
    "reduce_max": np.max, "reduce_min": np.min, "reduce_or": np.any, "reduce_and": np.all,
}  # fmt: skip


class HostFunction:
    """A JAX function traced at arguments of the shapes of `examples`; calls take their leaves, with a member axis."""

    others: Callable  # of an operation, and what it is given that is known: its function, where none is below

    def __init__(self, function: Callable, *examples):
        with jax.enable_x64(True):
            traced = jax.make_jaxpr(function)(*examples)
        self._values: list[Any] = []
        self._known: set[int] = set()  # the slots of constants
        self._made: dict[tuple, list[int]] = {}  # the slots of what was computed
        calls: list[tuple] = []
        self._outputs = self._write_calls(traced, [self._slot_of() for _ in traced.jaxpr.invars], calls)
        needed, self._calls = set(self._outputs), []
        for call, given, found in reversed(calls):
            if needed.intersection(found):
                needed.update(given)
                self._calls.append((call, given, found))
        self._calls.reverse()

    def __call__(self, *arrays) -> list[np.ndarray]:
        values = self._values.copy()
        values[: len(arrays)] = arrays
        with np.errstate(all="ignore"):
            for call, given, found in self._calls:
                results = call(*[values[i] for i in given])
                if len(found) == 1:
                    values[found[0]] = results[0] if type(results) is list else results
                else:
                    for i, x in zip(found, results, strict=True):
                        values[i] = x
        return [values[i] for i in self._outputs]

    def _slot_of(self, value=None) -> int:
        self._values.append(None if value is None else np.asarray(value)[None])
        if value is not None:
            self._known.add(len(self._values) - 1)
        return len(self._values) - 1

    def _write_calls(self, traced, inputs: list[int], calls: list) -> list[int]:
        """Append the calls of a traced function, with these slots of inputs, to `calls`; the slots of its results."""
        slots = dict(zip(traced.jaxpr.invars, inputs, strict=True))
        slots |= {of: self._slot_of(x) for of, x in zip(traced.jaxpr.constvars, traced.consts, strict=True)}

        def slot(of) -> int:
            if not isinstance(of, core.Literal):
                return slots[of]
            key = str(of.aval), repr(of.val)
            return (self._made.get(key) or self._made.setdefault(key, [self._slot_of(of.val)]))[0]

        for equation in traced.jaxpr.eqns:
            primitive, params, given = equation.primitive, equation.params, [slot(x) for x in equation.invars]
            inner = params.get("jaxpr", params.get("call_jaxpr")) if primitive.name in _CALLS else None
            if composed := getattr(primitive, "composed", None):
                avals = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in equation.invars]
                inner = jax.make_jaxpr(lambda *xs, of=composed, params=params: of(*xs, **params))(*avals)
            if primitive.name in _SAME:
                found = given
            elif inner is not None:
                found = self._write_calls(inner, given, calls)
            else:
                found = self._add_operation(equation, given, calls)
            slots.update(zip(equation.outvars, found, strict=True))
        return [slot(x) for x in traced.jaxpr.outvars]

    def _add_operation(self, equation, given: list[int], calls: list) -> list[int]:
        """The slots of an operation's results; constants are folded and repeated operations are shared."""
        key = equation.primitive.name, str(equation.params), *given
        if key in self._made:
            return self._made[key]
        known = {k: self._values[i][0] for k, i in enumerate(given) if i in self._known}
        call, found = _operation_rule(equation, known), [self._slot_of() for _ in equation.outvars]
        if self._known.issuperset(given):
            results = call(*[self._values[i] for i in given])
            for i, x in zip(found, results if isinstance(results, list | tuple) else [results], strict=True):
                self._values[i] = x
            self._known.update(found)
        else:
            calls.append((call, given, found))
        return self._made.setdefault(key, found)


def _operation_rule(equation, known: dict) -> Callable:
    """The NumPy function of an operation, for arrays with a member axis; `known` has its constant operands."""
    name, params = equation.primitive.name, equation.params
    axes, shape = [x.aval.ndim for x in equation.invars], equation.outvars[0].aval.shape
    if function := getattr(equation.primitive, "on_host", None):
        return lambda *xs: function(*xs, **params)
    whole = np.issubdtype(equation.outvars[0].aval.dtype, np.unsignedinteger)
    if name in _UFUNCS and not (name == "div" and np.issubdtype(equation.outvars[0].aval.dtype, np.signedinteger)):
        call, most = np.floor_divide if name == "div" and whole else _UFUNCS[name], max(axes)
        wide = [(slice(None), *[None] * (most - count)) for count in axes]  # a number of each member stands for all
        return call if min(axes) == most else lambda *xs: call(*(x[at] for x, at in zip(xs, wide, strict=True)))
    if name in _FOLDS:
        fold, over = _FOLDS[name], tuple(axis + 1 for axis in params["axes"])
        return lambda x: fold(x, axis=over)
    if name in ("reshape", "squeeze", "expand_dims"):
        return lambda x: x.reshape((len(x), *shape))
    if name == "broadcast_in_dim":
        return _broadcast(equation.invars[0].aval.shape, shape, params["broadcast_dimensions"])
    if name == "pad":
        return _pad(equation.invars[0].aval.shape, shape, params["padding_config"])
    return _RULES[name](**params) if name in _RULES else HostFunction.others(equation, known)


def _broadcast(begin: tuple, shape: tuple, places: tuple) -> Callable:
    wide = [1] * len(shape)
    for axis, size in zip(places, begin, strict=True):
        wide[axis] = size
    if tuple(wide) == shape:
        return lambda x: x.reshape((len(x), *shape))

    def rule(x):
        out = np.empty((len(x), *shape), x.dtype)
        out[...] = x.reshape((len(x), *wide))
        return out

    return rule


def _select(**_):
    def rule(which, *cases):
        which = which.reshape(*which.shape, *[1] * (cases[0].ndim - which.ndim))
        return np.where(which, cases[1], cases[0]) if len(cases) == 2 else np.choose(which, cases)

    return rule


def _slice(start_indices, limit_indices, strides, **_):
    steps = strides or [1] * len(start_indices)
    place = (slice(None), *map(slice, start_indices, limit_indices, steps))
    return lambda x: x[place]


def _join(axis: int, together: Callable):
    def rule(*xs):
        rows = max(map(len, xs))
        return together([x if len(x) == rows else np.broadcast_to(x, (rows, *x.shape[1:])) for x in xs], axis=axis + 1)

    return rule


def _split(axis: int, sizes, **_):
    ends = np.cumsum(sizes)[:-1]
    return lambda x: np.split(x, ends, axis=axis + 1)


def _pad(begin: tuple, shape: tuple, config) -> Callable:
    """Rule of `lax.pad`: entry j of an axis moves to `low` + j (`inner` + 1), entries outside the shape are dropped."""
    taken, placed = [slice(None)], [slice(None)]
    for size, total, (low, _, inner) in zip(begin, shape, config, strict=True):
        step = int(inner) + 1
        first, last = max(0, -(int(low) // step)), min(size, -((int(low) - total) // step))
        taken.append(slice(first, max(first, last)))
        placed.append(slice(low + first * step, low + first * step + (max(first, last) - first) * step, step))
    source, target = tuple(taken), tuple(placed)

    def rule(x, value):
        out = np.full((len(x), *shape), value.ravel()[0], x.dtype)
        out[target] = x[source]
        return out

    return rule


def _product(dimension_numbers, **_):
    (left, right), (left_batch, right_batch) = dimension_numbers

    def rule(a, b):
        names = iter("abcdefghijklmnopqrstuvwxy")
        of_a = [next(names) for _ in a.shape[1:]]
        of_b = [next(names) for _ in b.shape[1:]]
        for i, j in [*zip(left_batch, right_batch, strict=True), *zip(left, right, strict=True)]:
            of_b[j] = of_a[i]
        batch = [of_a[i] for i in left_batch]
        free = [x for i, x in enumerate(of_a) if i not in (*left, *left_batch)]
        free += [x for i, x in enumerate(of_b) if i not in (*right, *right_batch)]
        return np.einsum(f"z{''.join(of_a)},z{''.join(of_b)}->z{''.join(batch + free)}", a, b)

    return rule


def _map_members(rule: Callable) -> Callable:
    """The rule of an operation for all members, from its rule for one member."""

    def rule_of_all(*xs):
        rows = broadcast_members(*xs)
        return np.stack([rule(*(x[m] for x in rows)) for m in range(len(rows[0]))])

    return rule_of_all


def _window_slices(shape, sizes, starts) -> tuple[slice, ...]:
    begins = [min(max(int(k), 0), whole - size) for k, whole, size in zip(starts, shape, sizes, strict=True)]
    return tuple(slice(begin, begin + size) for begin, size in zip(begins, sizes, strict=True))


def _dynamic_slice(slice_sizes, **_):
    return _map_members(lambda x, *starts: x[_window_slices(x.shape, slice_sizes, starts)])


def _dynamic_update_slice(**_):
    def rule(x, update, *starts):
        out = x.copy()
        out[_window_slices(x.shape, update.shape, starts)] = update
        return out

    return _map_members(rule)


def _window_places(shape, indices, sizes, of_index, batching, of_batch, mode) -> tuple[tuple, Any]:
    """The index arrays of windows of `sizes` in an array of this `shape`, and a mask of those that lie inside it."""
    batch, k, places, inside = indices.shape[:-1], len(shape), [], np.array(True)
    for d, (whole, size) in enumerate(zip(shape, sizes, strict=True)):
        start = np.zeros(batch, int)
        if d in of_index:
            start = indices[..., of_index.index(d)].astype(int)
        elif d in batching:
            axis = of_batch[batching.index(d)]
            start = start + np.arange(batch[axis]).reshape([-1 if i == axis else 1 for i in range(len(batch))])
        if mode != GatherScatterMode.CLIP:
            inside = inside & (start >= 0) & (start <= whole - size)
        start = np.clip(start, 0, whole - size).reshape(*batch, *[1] * k)
        places.append(start + np.arange(size).reshape([-1 if i == d else 1 for i in range(k)]))
    return tuple(np.broadcast_arrays(*places)), np.broadcast_to(inside, batch).reshape(*batch, *[1] * k)


def _gather(dimension_numbers, slice_sizes, mode, **_):
    of = dimension_numbers
    batching = of.operand_batching_dims, of.start_indices_batching_dims
    lost = (*of.collapsed_slice_dims, *of.operand_batching_dims)

    def rule(x, indices):
        places, inside = _window_places(x.shape, indices, slice_sizes, of.start_index_map, *batching, mode)
        count = indices.ndim - 1
        found = np.where(inside, x[places], np.nan) if np.issubdtype(x.dtype, np.floating) else x[places]
        found = found.squeeze(tuple(count + d for d in lost))
        return np.moveaxis(found, range(count, found.ndim), of.offset_dims)

    return _map_members(rule)


def _scatter_add(dimension_numbers, mode, **_):
    of = dimension_numbers
    batching = of.operand_batching_dims, of.scatter_indices_batching_dims
    lost = (*of.inserted_window_dims, *of.operand_batching_dims)

    def rule(x, indices, updates):
        count, out = indices.ndim - 1, x.copy()
        updates = np.moveaxis(updates, of.update_window_dims, range(count, updates.ndim))
        updates = np.expand_dims(updates, tuple(count + d for d in lost))
        of_index = of.scatter_dims_to_operand_dims
        places, inside = _window_places(x.shape, indices, updates.shape[count:], of_index, *batching, mode)
        np.add.at(out, places, np.where(inside, updates, 0))
        return out

    return _map_members(rule)


def _scan(jaxpr, length: int, num_consts: int, num_carry: int, reverse: bool, **_):
    examples = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jaxpr.in_avals]
    body, behind = HostFunction(core.jaxpr_as_fun(jaxpr), *examples), num_consts + num_carry

    def rule(*xs):
        carry, rows = list(xs[num_consts:behind]), []
        for k in range(length)[:: -1 if reverse else 1]:
            results = body(*xs[:num_consts], *carry, *(x[:, k] for x in xs[behind:]))
            carry, more = results[:num_carry], results[num_carry:]
            rows.append(more)
        columns = zip(*(rows[::-1] if reverse else rows), strict=True)
        return [*carry, *(np.stack(broadcast_members(*column), axis=1) for column in columns)]

    return rule


def _less_in_order(**_):
    """Rule of the total order x < y, in which −0 is less than 0 and NaN is greater than all numbers."""

    def rule(x, y):
        between = np.signbit(x) & ~np.signbit(y) & (x == y)
        return (x < y) | between | (np.isnan(y) & ~np.isnan(x))

    return rule


_RULES: dict[str, Callable] = {
    "scan": _scan,
    "lt_to": _less_in_order,
    "select_n": _select,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter-add": _scatter_add,
    "scatter_add": _scatter_add,
    "slice": _slice,
    "split": _split,
    "unstack": lambda axis, **_: lambda x: list(np.moveaxis(x, axis + 1, 0)),
    "dot_general": _product,
    "concatenate": lambda dimension, **_: _join(dimension, np.concatenate),
    "stack": lambda axis, **_: _join(axis, np.stack),
    "transpose": lambda permutation, **_: lambda x: x.transpose(0, *(axis + 1 for axis in permutation)),
    "convert_element_type": lambda new_dtype, **_: lambda x: x.astype(new_dtype),
    "integer_pow": lambda y, **_: lambda x: x**y,
    "iota": lambda dtype, shape, dimension, **_: (
        lambda: np.broadcast_to(
            np.arange(shape[dimension], dtype=dtype).reshape([-1 if i == dimension else 1 for i in range(len(shape))]),
            shape,
        )[None]
    ),
    "argmin": lambda axes, index_dtype, **_: lambda x: np.argmin(x, axis=axes[0] + 1).astype(index_dtype),
}


def broadcast_members(*arrays) -> list[np.ndarray]:
    """The arrays, broadcast along the member axis to the length of the longest."""
    rows = max(map(len, arrays), default=1)
    return [x if len(x) == rows else np.broadcast_to(x, (rows, *x.shape[1:])) for x in arrays]


def call_host(host: Callable, shapes, *arrays) -> tuple:
    """Call `host` with NumPy arrays from XLA code; `shapes` are those of its results."""

    # Not `jax.pure_callback`: it puts its arguments on the device once more and waits for that, on the threads that
    # the callbacks themselves may occupy.
    def callback(_, places, *arrays):
        with jax.enable_x64(True):  # another thread; a program may be made here
            results = host(*map(np.asarray, arrays))
        for place, values in zip(places, results, strict=True):
            np.asarray(place)[...] = values

    return tuple(buffer_callback(callback, tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in shapes))(*arrays))
