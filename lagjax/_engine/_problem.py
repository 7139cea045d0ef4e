"""`Problem → engine → Solution`: a question that every engine understands, and its answer, both flat.

    Problem   a scene, its parameters, an initial state (2n,), output times (T,), tolerances, a budget, an event
    Solution  the states (T, 2n) at the output times, the last state, how the motion ended, counts of steps

An engine is a value. It says which problems it refuses, and solves the others, one or a batch, under every
transformation of JAX. Pytrees of the user exist on both sides of this module, but not behind it: the state is one
vector (q, q̇), and the programs of a scene take the parameters as one vector too (`Problem.vector`).
"""

import abc
import functools
import itertools
import types
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core
from jaxtyping import Array, Float, Int, PyTree

from lagjax._equations import Derivation, derivation_of
from lagjax._interface import (
    Layout,
    accept,
    all_finite,
    as_arrays,
    dtype_of,
    flatten_numbers,
    halves,
    is_concrete,
    labelled_leaves,
    output_times,
    require_budget,
    require_finite,
    require_numbers,
    require_tolerance,
)
from lagjax._interface.reads import Edition
from lagjax._native import ATOL_OVER_MOTION, ATOL_OVER_RTOL
from lagjax._primitives import DOUBLE, SINGLE, compute_in_doubles

Numbers = Array | np.ndarray

# The default, also for a state in float32, for which machine code computes in float64: 1e-7 would leave roundings alone
# of the last digit there, and saves a quarter of the time; 1e-9 gives the digits of the run in float64. The absolute
# tolerance is far below the relative one, and smaller still in a motion that is as small itself: it is there for
# components that pass through zero.
DEFAULT_RTOL = 1e-9
# The smallest rtol, in units of round-off. Machine code sums with the rounding errors carried along: below one unit its
# truncation, which has a sign, does not add up to more than the round-off of a long run, which has none.
LEAST_RTOL = 0.25


class Event(NamedTuple):
    """Functions of the user's state that end a motion, in the user's structure, as `diffrax.Event` has them.

    - `directions`, in the same structure: True for a root with a rising sign, False for a falling one, None for both.
    - `root_finder`: that of diffrax which the user chose for the instant, or None.
    """

    conditions: PyTree
    directions: PyTree
    root_finder: Any = None

    @property
    def functions(self) -> list[Callable]:
        return jax.tree.leaves(self.conditions, is_leaf=callable)

    @property
    def ways(self) -> list[bool | None]:
        """The direction of each function of `functions`."""
        return jax.tree.leaves(self.directions, is_leaf=lambda leaf: leaf is None)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Problem:
    """The motion of a scene from one state, as a question to an engine.

    - `system`, `layout`, `params`: the scene, the structure of its coordinates, and its parameters as the user gave
      them, every number an array.
    - `ts` (T,): the output times, of which the first is that of the initial state `y0` (2n,), q and then q̇.
    - `tolerances`: rtol and atol of a step as they were given, None where those of the engine hold by default
      (`AbstractEngine.tolerances`).
    - `max_steps`: the budget of steps, rejected ones included.
    - `event`: functions of the user's state that end the motion.
    - `guards`: the same as a program for machine code (`_native.Guards`), whose signs end the motion.
    - `is_rounded`: whether the solution, in float64, is rounded to float32 in the end.
    """

    system: Any
    layout: Layout
    params: PyTree
    ts: Float[Numbers, " T"]
    y0: Float[Numbers, " states"]
    tolerances: tuple[Float[Numbers, ""] | None, Float[Numbers, ""] | None]
    max_steps: int = field(metadata={"static": True})
    event: "Event | None" = None
    guards: Hashable = field(metadata={"static": True}, default=None)
    is_rounded: bool = field(metadata={"static": True}, default=False)

    @classmethod
    def from_arguments(
        cls, system, layout: Layout, q0, qdot0, ts, params=None, rtol=None, atol=None, max_steps=65_536, event=None
    ) -> "Problem":
        """The problem of the arguments of `simulate`, after checks of all that does not depend on an engine.

        Raises `TypeError` or `ValueError` with the name of the argument that cannot be right.
        """
        dtype, given = layout.dtype, _check_fields(layout.dtype, params, ts, rtol, atol, max_steps, event)
        y0 = concatenate_leaves(jax.tree.leaves(as_arrays((q0, qdot0), dtype, "state")), dtype)
        problem = cls(system=system, layout=layout, y0=y0, **given)
        vectors = y0, problem.vector
        if not all(isinstance(x, np.ndarray) and all_finite(x) for x in vectors):  # leaf by leaf, with their names
            for name, value in (("q0", q0), ("qdot0", qdot0), ("params", problem.params)):
                require_finite(value, name)
        return problem

    @classmethod
    def from_system(
        cls, system, layout: Layout, params, ts=(0.0, 1.0), rtol=None, atol=None, max_steps=65_536, event=None
    ) -> "Problem":
        """A problem of this scene that starts at q = q̇ = 0: enough to choose an engine and to make its program."""
        given = _check_fields(layout.dtype, params, ts, rtol, atol, max_steps, event)
        return cls(system=system, layout=layout, y0=np.zeros(2 * layout.size, layout.dtype), **given)

    # What follows from the fields is looked up once: an engine is chosen and then solves the same problem.

    @functools.cached_property
    def derivation(self) -> Derivation:
        """The derivation of the scene: made once for all problems whose scene and structure are equal."""
        return derivation_of(self.system, self.layout, self.params).with_numbers(self.vector)

    @functools.cached_property
    def engine_parts(self) -> dict:
        """A cache, by name, of the objects that engines build from this problem and use more than once."""
        return {}

    @property
    def numbers(self) -> PyTree:
        """The parameters with None in place of everything that is no number: what JAX may trace."""
        return eqx.filter(self.params, eqx.is_array_like)

    @functools.cached_property
    def vector(self) -> Float[Numbers, " P"]:
        """Every number in the parameters, shape (P,), in the dtype of the state."""
        return concatenate_leaves(list(filter(eqx.is_array_like, jax.tree.leaves(self.params))), self.layout.dtype)

    @property
    def is_known(self) -> bool:
        """True if all times, states and parameters are concrete arrays, so that the problem can be solved at once."""
        return all(map(is_concrete, (self.ts, self.y0, self.vector)))

    @property
    def varies(self) -> bool:
        """True if a traced input differs between devices, by the types of `jax.shard_map`."""
        inputs = self.ts, self.y0, *jax.tree.leaves(self.numbers)
        return any(isinstance(x, Tracer) and bool(jax.typeof(x).mat.varying) for x in inputs)

    @property
    def is_single(self) -> bool:
        return self.layout.dtype == SINGLE

    @functools.cached_property
    def double_precision(self) -> "Problem":
        """The problem in float64; numbers that are being traced become zeros."""

        def wide(leaf):
            if not eqx.is_array_like(leaf) or dtype_of(leaf) != SINGLE:
                return leaf
            return np.asarray(leaf, DOUBLE) if is_concrete(leaf) else _zeros(np.shape(leaf), DOUBLE)

        params, ts, y0 = jax.tree.map(wide, (self.params, self.ts, self.y0))
        layout = replace(self.layout, dtype=DOUBLE)
        return replace(self, layout=layout, params=params, ts=ts, y0=y0, is_rounded=True)


def solve_in_doubles(solve: Callable, problem: Problem):
    """The solution by `solve(problem)` computed in float64, rounded to the precision of the problem."""

    def solve_numbers(ts, y0, params):
        return solve(replace(problem.double_precision, ts=ts, y0=y0, params=params))

    return compute_in_doubles(solve_numbers, problem.ts, problem.y0, problem.params)


class Batch(eqx.Module):
    """Many problems of one scene, which differ in their initial states, in numbers of their parameters, and in times.

    `member` is a problem of the structure of all. `ts` (N, T) are their output times, or (1, T) those of all; `y0`
    (N, 2n) holds the initial states, and `params` the parameters, with the members as first axis of every leaf whose
    entry in `axes` is 0. Those whose entry is None are for all.
    """

    member: Problem
    ts: Float[Numbers, "times_of T"]
    y0: Float[Numbers, "N states"]
    params: PyTree
    axes: tuple[int | None, ...] = eqx.field(static=True)

    @classmethod
    def from_values(
        cls, system, values: dict, axes: dict, size: int, ts, rtol=None, atol=None, max_steps=65_536, event=None
    ) -> "Batch":
        """The batch of `values` by name, q0, qdot0, params, with the axis of members of every leaf (`axes_per_leaf`).

        `ts` are the output times (T,) of all, or (N, T) of each.

        Raises `TypeError` or `ValueError` as `Problem.from_arguments`; a number of one member alone may be NaN.
        """
        member = {name: jax.tree.map(_member_shape, value, axes[name]) for name, value in values.items()}
        layout = Layout.from_state(member["q0"], member["qdot0"])
        times = output_times(ts, layout.dtype, rows=True)
        each = times if times.ndim == 2 else times[None]
        first = np.asarray(each)[0] if _is_on_host(each) else each[0]
        one = Problem.from_system(system, layout, member["params"], first, rtol, atol, max_steps, event)
        arrays = {name: as_arrays(value, layout.dtype, name) for name, value in values.items()}
        for name, value in arrays.items():
            require_finite(jax.tree.map(lambda leaf, axis: leaf if axis is None else None, value, axes[name]), name)
        state = jax.tree.leaves((arrays["q0"], arrays["qdot0"]))
        params, structure = jax.tree.flatten(arrays["params"])
        of_params = structure.flatten_up_to(axes["params"])
        pairs = zip(params, of_params, strict=True)
        in_front = [x if k is None else (xp := _array_library(x)).moveaxis(xp.asarray(x), k, 0) for x, k in pairs]
        of_state = (jax.tree.structure(values[name]).flatten_up_to(axes[name]) for name in ("q0", "qdot0"))
        y0 = stack_members(state, itertools.chain(*of_state), size, layout.dtype)
        spread = tuple(None if axis is None else 0 for axis in of_params)
        return cls(one, each, y0, structure.unflatten(in_front), spread)

    def __len__(self) -> int:
        return len(self.y0)

    def map_members(self, solve: Callable[..., Any], *more: Any) -> Any:
        """`jax.vmap` of `solve(problem, *more)` over the members; each array of `more` has them as first axis."""
        axes = jax.tree.unflatten(jax.tree.structure(self.params), self.axes)

        def solve_member(ts, y0, params, *more):
            return solve(replace(self.member, ts=ts, y0=y0, params=params), *more)

        ts, of_ts = (self.member.ts, None) if self.shares_times else (self.ts, 0)
        return jax.vmap(solve_member, in_axes=(of_ts, 0, axes, *[0] * len(more)))(ts, self.y0, self.params, *more)

    def map_in_turn(self, solve: Callable[[Problem], "Solution"]) -> "Solution":
        """The solutions `solve(problem)` of the members, computed one after the other."""
        structure = jax.tree.structure(self.params)

        def solve_member(i):
            leaves = zip(jax.tree.leaves(self.params), self.axes, strict=True)
            params = structure.unflatten([x if axis is None else jnp.asarray(x)[i] for x, axis in leaves])
            ts = self.member.ts if self.shares_times else jnp.asarray(self.ts)[i]
            return solve(replace(self.member, ts=ts, y0=jnp.asarray(self.y0)[i], params=params))

        return jax.lax.map(solve_member, jnp.arange(len(self)))

    @property
    def is_known(self) -> bool:
        numbers = eqx.filter(self.params, eqx.is_array_like)
        return all(is_concrete(leaf) for leaf in jax.tree.leaves((self.ts, self.y0, numbers)))

    @property
    def shares_times(self) -> bool:
        return len(self.ts) == 1

    @property
    def with_all_times(self) -> Problem:
        """The problem of one member with the times of all, as a trajectory of the batch has them."""
        return self.member if self.shares_times else replace(self.member, ts=self.ts)

    @property
    def vectors(self) -> Float[Numbers, "members P"]:
        """The numbers in the parameters of each member, shape (N, P), or (1, P) where all share them."""
        leaves = jax.tree.leaves(self.params)
        numbers = [(leaf, axis) for leaf, axis in zip(leaves, self.axes, strict=True) if eqx.is_array_like(leaf)]
        if all(axis is None for _, axis in numbers):
            return concatenate_leaves([leaf for leaf, _ in numbers], self.member.layout.dtype)[None]
        return stack_members(
            [leaf for leaf, _ in numbers], [axis for _, axis in numbers], len(self), self.member.layout.dtype
        )


class Solution(NamedTuple):
    """The motion that answers a problem, from its first output time to where it ended; of a batch, N of them."""

    path: Float[Any, "*N T states"]  # at the output times, NaN where not reached; or what was noted on the way
    y_end: Float[Any, "*N states"]
    t_end: Float[Any, "*N"]
    result: Int[Any, "*N"]  # how it ended, as the integer of a `lagjax.RESULTS`
    accepted: Int[Any, "*N"]  # steps
    rejected: Int[Any, "*N"]
    # Of an event, which of its functions ended the motion, (*N, G); of guards, which of them changed sign at the end: 1
    # where it fell, 2 where it rose, else 0.
    event: Any = None
    idle: Int[Any, ""] = None  # of a batch as a whole, the steps for which a lane was idle


class AbstractEngine(abc.ABC):
    """The integrator: `MachineCode` or `Diffrax`. `default_rtol` is its tolerance where none is given."""

    default_rtol: ClassVar[Mapping[np.dtype, float]] = {DOUBLE: DEFAULT_RTOL, SINGLE: DEFAULT_RTOL}

    @property
    def is_implicit(self) -> bool:
        """True if a step solves an equation."""
        return False

    def rtol(self, problem: Problem) -> Float[Numbers, ""]:
        """rtol of a step: that of the problem, or by default that of this engine."""
        rtol, dtype = problem.tolerances[0], problem.layout.dtype
        return np.asarray(self.default_rtol[dtype], dtype) if rtol is None else as_arrays(rtol, dtype)

    def tolerances(self, problem: Problem, y0: Float[Numbers, "*N states"]) -> tuple | None:
        """rtol, and atol where it was given; by default at most a sixteenth of rtol times the size of motions.

        Their size is, in these first states, the largest coordinate, or where they begin at zero how far the largest
        velocity would lead; or the largest velocity, if that is smaller and not zero.
        """
        rtol, atol = self.rtol(problem), problem.tolerances[1]
        if atol is not None:
            return rtol, as_arrays(atol, problem.layout.dtype, "atol")
        given = problem.ts, rtol, y0
        if not all(map(_is_on_host, given)):  # a bound does not vary: where only derivatives are traced, it is known
            given = jax.lax.stop_gradient(given)
        # Within `jit` an operation on an array of JAX is traced, even where its numbers are known.
        compute = _absolute_tolerance if all(map(_is_on_host, given)) else _traced_absolute_tolerance
        return rtol, compute(*map(np.asarray, given) if compute is _absolute_tolerance else given)

    @abc.abstractmethod
    def refuses(self, problem: Problem) -> str | None:
        """Why this engine cannot solve the problem, as the end of a sentence; None where it can."""

    @abc.abstractmethod
    def solve(self, problem: Problem) -> Solution:
        """The motion of one member, under `jax.jit`, `jax.vmap` and derivatives."""

    @abc.abstractmethod
    def solve_batch(self, batch: Batch) -> Solution:
        """The motions of all members."""


def _absolute_tolerance(ts, rtol, y0, library: Any = np):
    far, fast = (library.abs(half).max(axis=-1) for half in halves(y0))
    far = library.where(far > 0, far, fast * abs(ts[..., -1] - ts[..., 0]))
    size = library.minimum(*(library.where(x > 0, x, library.inf) for x in (far, fast))).min(initial=library.inf)
    return rtol * library.minimum(ATOL_OVER_RTOL, ATOL_OVER_MOTION * size)


_traced_absolute_tolerance = jax.jit(functools.partial(_absolute_tolerance, library=jnp), inline=True)


# ---- vectors ---------------------------------------------------------------------------------------------------------


def _is_on_host(leaf) -> bool:
    """True if NumPy can read an array without moving it between devices, or gathering it from several."""
    if not isinstance(leaf, jax.Array):
        return True
    return is_concrete(leaf) and [device.platform for device in leaf.devices()] == ["cpu"]


def _array_library(*leaves) -> Any:
    """NumPy where it can read all of them, else JAX's."""
    return np if all(map(_is_on_host, leaves)) else jnp


def concatenate_leaves(leaves: list, dtype) -> Float[Numbers, " count"]:
    """All numbers of the leaves as one vector; by NumPy where it can read them, at a tenth of the cost of JAX.

    Of a complex number, which has no place in machine code, that is the real part.
    """
    if not all(map(_is_on_host, leaves)):
        return flatten_numbers(leaves, dtype)
    arrays = (leaf.real if np.iscomplexobj(leaf) else leaf for leaf in leaves)
    return np.concatenate([np.zeros(0, dtype), *(np.asarray(leaf, dtype).ravel() for leaf in arrays)])


def stack_members(leaves, axes, size: int, dtype) -> Float[Numbers, "size numbers"]:
    """The numbers of `size` members, (size, numbers); `axes` has the member axis of each leaf, None if shared."""
    library = _array_library(*leaves)
    columns = [library.zeros((size, 0), dtype)]
    for leaf, axis in zip(leaves, axes, strict=True):
        array = library.asarray(leaf, dtype)
        if axis is None:
            columns.append(library.broadcast_to(array.reshape(1, -1), (size, array.size)))
        else:
            columns.append(library.moveaxis(array, axis, 0).reshape(size, array.size // size))
    return library.concatenate(columns, axis=1)


def _member_shape(leaf, axis):
    """One member's leaf: zeros of its shape, or the leaf itself if all members share it (axis None)."""
    if axis is None:
        return leaf
    shape = np.shape(leaf)
    return _zeros((*shape[:axis], *shape[axis:][1:]), np.dtype(dtype_of(leaf)))


@functools.lru_cache(maxsize=256)
def _zeros(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    return np.broadcast_to(np.zeros((), dtype), shape)


def axes_per_leaf(values: dict[str, PyTree], batch_axes, ts=()) -> tuple[dict[str, PyTree], int]:
    """`batch_axes` spread over every leaf, and the size of the batch, which must be the same everywhere.

    Members may have times of their own, `ts` (N, T).
    """
    if not isinstance(batch_axes, tuple) or len(batch_axes) != 3:
        raise ValueError(f"batch_axes must be a tuple of three, for (q0, qdot0, params); got {batch_axes!r}.")
    axes, sizes = {}, {"ts": np.shape(ts)[0]} if np.ndim(ts) == 2 else {}
    for (name, value), prefix in zip(values.items(), batch_axes, strict=True):
        labels, leaves, tree = labelled_leaves(value, name)
        try:
            axes[name] = jax.tree.broadcast(prefix, value, is_leaf=lambda axis: axis is None)
        except ValueError:
            raise ValueError(
                f"batch_axes for {name} is {prefix!r}, which does not fit its structure: give one axis for all of it, "
                f"or one for each of {', '.join(labels[:12])}, None for what all members share."
            ) from None
        spread = tree.flatten_up_to(axes[name])
        spread = [axis if eqx.is_array_like(leaf) else None for leaf, axis in zip(leaves, spread, strict=True)]
        axes[name] = tree.unflatten(spread)  # a function or a string, as networks have them, is no part of a batch
        for label, leaf, axis in zip(labels, leaves, spread, strict=True):
            if axis is not None:
                require_numbers(leaf, label)
                if not -jnp.ndim(leaf) <= axis < jnp.ndim(leaf):
                    raise ValueError(
                        f"{label} has shape {jnp.shape(leaf)}: it has no axis {axis} for the batch. Where all members "
                        "share it, let batch_axes have None in its place."
                    )
                sizes[label] = jnp.shape(leaf)[axis]
    if not sizes:
        raise ValueError("batch_axes maps over nothing: name the axis of the members in q0, qdot0 or params.")
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{label} has {size}" for label, size in sizes.items())
        raise ValueError(f"All batched arguments must have the same number of members; {listed}.")
    if 0 in sizes.values():
        listed = ", ".join(label for label, size in sizes.items() if size == 0)
        raise ValueError(f"The batch is empty: {listed} has no member along its batch axis.")
    return axes, next(iter(sizes.values()))


# ---- what can be wrong -----------------------------------------------------------------------------------------------


def _check_fields(dtype, params, ts, rtol, atol, max_steps, event) -> dict[str, Any]:
    """The fields of a problem that depend neither on its scene nor on its state. Raises where they cannot be right."""
    ts = output_times(ts, dtype)
    require_budget(max_steps, "max_steps")
    if rtol is not None and (reason := explain_tight_rtol(require_tolerance(rtol, "rtol"), DOUBLE, LEAST_RTOL)):
        raise ValueError(f"{reason}.")
    if atol is not None:
        require_tolerance(atol, "atol")

    def array(x):
        return np.asarray(x, DOUBLE) if x is not None and is_concrete(x) else as_arrays(x, dtype)

    tolerances, event = (array(rtol), array(atol)), _checked_event(event)
    return dict(params=as_arrays(params, dtype), ts=ts, tolerances=tolerances, max_steps=max_steps, event=event)


def explain_tight_rtol(rtol, dtype, least: float) -> str | None:
    """The sentence that rtol is below `least` units of round-off; None if it is not."""
    eps = float(jnp.finfo(dtype).eps)
    if not is_concrete(rtol) or float(rtol) >= least * eps:
        return None
    more = "; call jax.config.update('jax_enable_x64', True) and pass float64 states" if dtype == np.float32 else ""
    return (
        f"{dtype.name} cannot meet rtol={float(rtol):.3g}: its round-off is {eps:.1e}, so rtol must be at least "
        f"{least * eps:.1e}{more}"
    )


def _checked_event(event) -> Event | None:
    """The event with its functions' signatures checked."""
    if isinstance(event, types.FunctionType):
        return _cached_event(Edition.from_function(event))
    return None if event is None else _make_event(event)


@functools.lru_cache(maxsize=64)  # a signature takes as long to read as a short motion
def _cached_event(event: Edition) -> Event:
    return _make_event(event.function)


def _make_event(event) -> Event:
    condition = getattr(event, "cond_fn", event)  # of a `diffrax.Event`
    _, functions, _ = labelled_leaves(condition, "event", is_leaf=lambda leaf: leaf is None or callable(leaf))
    if not functions or not all(map(callable, functions)):
        raise TypeError(f"event must be a function event(q, qdot), or a pytree of such; got {condition!r}.")
    directions = event.direction if condition is not event else jax.tree.map(lambda _: None, event, is_leaf=callable)
    conditions = jax.tree.map(lambda function: accept(function, "event"), condition, is_leaf=callable)
    return Event(conditions, directions, getattr(event, "root_finder", None))


# The sign of the difference of two numbers where the one is less, or more, than the other.
_SIGNS = {"lt": -1, "le": -1, "gt": 1, "ge": 1}
_PASSING_ON = ("squeeze", "reshape", "broadcast_in_dim", "copy")


def evaluate_condition(function: Callable, *arguments) -> tuple[Any, int]:
    """An event's value, and 0; of a comparison a > b the number a − b, and the sign for which it holds."""
    leaves, structure = jax.tree.flatten(arguments)
    numbers = [i for i, x in enumerate(leaves) if eqx.is_array_like(x)]  # params may hold words as well

    def call(*given):
        new = dict(zip(numbers, given, strict=True))
        return function(*jax.tree.unflatten(structure, [new.get(i, x) for i, x in enumerate(leaves)]))

    given = [leaves[i] for i in numbers]
    closed, shape = jax.make_jaxpr(call, return_shape=True)(*given)
    is_bool = getattr(shape, "dtype", None) == np.dtype(bool) and shape.shape == ()
    found = _traced_difference(closed.jaxpr, closed.consts, given) if is_bool else None
    return (function(*arguments), 0) if found is None else found


def _traced_difference(jaxpr, constants, arguments) -> tuple[Any, int] | None:
    """a − b and the sign for which a jaxpr's comparison of a and b holds; None if it is no comparison."""
    (out,) = jaxpr.outvars
    equation = next((e for e in jaxpr.eqns if out in e.outvars), None)
    if equation is None:
        return None

    def with_outputs(atoms):
        return jaxpr.replace(outvars=list(atoms), debug_info=jaxpr.debug_info.with_unknown_names())

    name = equation.primitive.name
    if name in ("jit", "pjit", "closed_call"):
        inner, run = equation.params["jaxpr"], core.ClosedJaxpr(with_outputs(equation.invars), constants)
        return _traced_difference(inner.jaxpr, inner.consts, core.jaxpr_as_fun(run)(*arguments))
    if name in (*_PASSING_ON, "not"):
        found = _traced_difference(with_outputs(equation.invars[:1]), constants, arguments)
        return found and (found[0], -found[1] if name == "not" else found[1])
    if name not in _SIGNS or not jnp.issubdtype(equation.invars[0].aval.dtype, jnp.floating):
        return None
    more, less = core.jaxpr_as_fun(core.ClosedJaxpr(with_outputs(equation.invars), constants))(*arguments)
    return jnp.reshape(more - less, ()), _SIGNS[name]


def signs_of_event(problem: Problem) -> list[int | None]:
    """For each event function the sign for which its comparison holds; 0 for a number, None for others."""
    assert problem.event is not None
    signs: list[int | None] = []
    for function in problem.event.functions:

        def evaluate(y, t, numbers, function=function):
            value, sign = evaluate_condition(flat_condition(function, problem), y, t, numbers)
            is_bool = not sign and jnp.result_type(value) == np.dtype(bool)
            signs.append(None if is_bool else sign)
            return value

        jax.eval_shape(evaluate, problem.y0, problem.ts[0], problem.numbers)
    return signs


def flat_condition(function: Callable, problem: Problem) -> Callable:
    """The event function as one of the flat state (2n,), t and the numbers among the parameters."""

    def condition(y, t, numbers):
        return function(*map(problem.layout.restore, halves(y)), t=t, params=eqx.combine(numbers, problem.params))

    return condition
