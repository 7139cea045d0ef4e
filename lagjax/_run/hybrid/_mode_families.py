"""Families: modes whose functions differ by numbers alone are one program, which takes these numbers as parameters.

Each function of a mode, of its system and of the transitions that leave it, is traced once. Modes of one trace but for
floats in sums, products, comparisons and results are a `SystemFamily`: its functions are those of the first of them,
with the numbers that differ beside the user's parameters (`_closed_over.Lifted`), a row of them for each mode.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core

from lagjax._interface import Function, Layout
from lagjax._interface.reads import Edition
from lagjax._run.hybrid._mode import Transition
from lagjax._scene import ROLES, System, Unchanged, function_from_trace, open_jaxpr, replace_functions

PyTree = Any

# Operations whose operands may be parameters as well as constants: a program stays as smooth with one as with the
# other, and has the same structure.
_ARITHMETIC = frozenset("add add_any sub mul div max min lt le gt ge eq ne select_n dot_general".split())
MOST_NUMBERS = 64  # of a family: of more, as of matrices, zeros and ones would be worth more than a shared program


class SystemFamily(NamedTuple):
    """Modes that share a program: their places, a system and the transitions that leave it, and the numbers of each.

    The first axis of each of the `rows` is that of the modes; without any, the functions take the user's parameters.
    """

    modes: tuple[int, ...]
    system: System
    leaving: tuple[Transition, ...]
    rows: tuple[np.ndarray, ...]


class _Traced(NamedTuple):
    """A function of a mode, its trace, and the structure of what it returns."""

    function: Function
    closed: core.ClosedJaxpr
    structure: Any


class _Site(NamedTuple):
    """A number of a trace, in the place ("constant", k), ("operand", i, j) of equation i, or ("result", j)."""

    place: tuple
    value: Any
    may_differ: bool


def families(
    systems: Sequence[System], leaving: Sequence[tuple[Transition, ...]], layout: Layout, params
) -> list[SystemFamily]:
    """The modes of these systems, each with the transitions that `leave` it, as families in the order of the first."""
    found: list[tuple[list[int], list[list[_Traced | None]]]] = []
    for k, (system, transitions) in enumerate(zip(systems, leaving, strict=True)):
        traces = _traces(system, transitions, layout, params) if len(systems) > 1 else None
        if traces is None:
            found.append(([k], []))
            continue
        for modes, of_modes in found:
            first = modes[0]
            alike = of_modes and _outline(systems[first], leaving[first]) == _outline(system, transitions)
            if alike and all(map(_differ_by_numbers, of_modes[0], traces)) and _few([*of_modes, traces]):
                modes.append(k)
                of_modes.append(traces)
                break
        else:
            found.append(([k], [traces]))
    return [_family(modes, traces, systems[modes[0]], leaving[modes[0]]) for modes, traces in found]


def _family(modes, traces, system: System, leaving: tuple[Transition, ...]) -> SystemFamily:
    """The family of modes of these traces; `system` and `leaving` are those of the first."""
    if len(modes) == 1:
        return SystemFamily(tuple(modes), system, leaving, ())
    rows: list[np.ndarray] = []
    functions = iter([_share_function(column, rows) for column in zip(*traces, strict=True)])
    system = replace_functions(system, {role: next(functions) for role in ROLES})
    rest: list[Any] = list(functions)
    shared = map(Transition.with_functions, leaving, rest[::2], rest[1::2])
    return SystemFamily(tuple(modes), system, tuple(shared), tuple(rows))


def _share_function(column: tuple, rows: list[np.ndarray]) -> Function | None:
    """One function for all modes from its traces in each, with the numbers that differ added to the `rows`."""
    first = column[0]
    if first is None:
        return None
    if all(traced.function == first.function for traced in column):
        unchanged = Unchanged(first.function)
        extras = tuple(dict.fromkeys((*first.function.extras, "params")))
        return Function(None, Edition.from_function(unchanged), extras)
    places = {}
    for of_modes in _different(column):
        places[of_modes[0].place] = len(rows)
        rows.append(np.stack([np.asarray(site.value) for site in of_modes]))
    jaxpr, constants, values = _promote_numbers(first.closed, places)
    how = f"numbers {places} {first.closed.in_avals}"
    return function_from_trace(first.function, jaxpr, constants, values, first.structure, how)


def _promote_numbers(closed: core.ClosedJaxpr, places: dict) -> tuple[core.Jaxpr, tuple, tuple]:
    """A trace whose numbers at `places` are arguments, its constants, and the row of numbers that each stands for."""
    jaxpr, more, rows = closed.jaxpr, [], []

    def argument(place, atom):
        if place not in places:
            return atom
        more.append(core.Var(atom.aval))
        rows.append(places[place])
        return more[-1]

    equations = [
        equation.replace(invars=[argument(("operand", i, j), x) for j, x in enumerate(equation.invars)])
        for i, equation in enumerate(jaxpr.eqns)
    ]
    results = [argument(("result", j), x) for j, x in enumerate(jaxpr.outvars)]
    own = [places.get(("constant", k)) for k in range(len(closed.consts))]
    constants = [None if row is not None else x for x, row in zip(closed.consts, own, strict=True)]
    jaxpr = open_jaxpr(closed, more, eqns=equations, outvars=results)
    return jaxpr, (*constants, *[None] * len(more)), (*own, *rows)


# ---- traces ----------------------------------------------------------------------------------------------------------


def _traces(system: System, leaving: tuple[Transition, ...], layout: Layout, params) -> list[_Traced | None] | None:
    """The traces of all functions of a mode, None in the place of an absent one; None where some have none to share.

    What is wrong with a function is said where it is used.
    """
    functions = [(getattr(system, role), 1 + (role != "constraints")) for role in ROLES]
    functions += [(function, 2) for transition in leaving for function in (transition.guard, transition.reset)]
    try:
        return [None if function is None else _trace(function, roles, layout, params) for function, roles in functions]
    except Exception:
        return None


def _trace(function: Function, roles: int, layout: Layout, params) -> _Traced:
    if function.code.tracers or not set(function.extras) <= {"t", "params"}:
        raise TypeError
    numbers, rest = eqx.partition(params, eqx.is_array_like)
    state, t = layout.restore(jnp.zeros(layout.size, layout.dtype)), jnp.zeros((), layout.dtype)

    def call_with_numbers(states, t, numbers):
        return function(*states, t=t, params=eqx.combine(numbers, rest))

    closed, shapes = jax.make_jaxpr(call_with_numbers, return_shape=True)((state,) * roles, t, numbers)
    if any(isinstance(x, Tracer) for x in closed.consts):
        raise TypeError
    return _Traced(function, closed, jax.tree.structure(shapes))


def _outline(system: System, leaving) -> tuple:
    """The functions and transitions that a mode has, but for what the functions give."""
    roles = [getattr(system, role) is None for role in ROLES]
    return system.path, roles, [(t.direction, t.reset is None, t.fires) for t in leaving]


def _few(traces: Sequence[list]) -> bool:
    columns = [column for column in zip(*traces, strict=True) if column[0] is not None]
    return sum(np.size(sites[0].value) for column in columns for sites in _different(column)) <= MOST_NUMBERS


def _different(column: Sequence[_Traced]) -> Iterator[tuple[_Site, ...]]:
    """The numbers, with one site for each mode, that are not the same in all of its traces."""
    for of_modes in zip(*(_sites(traced.closed) for traced in column), strict=True):
        if not all(_equal(of_modes[0].value, site.value) for site in of_modes):
            yield of_modes


def _sites(closed: core.ClosedJaxpr) -> Iterator[_Site]:
    """All numbers of a trace. Those in sums, products, comparisons and results may be others in another mode."""
    jaxpr = closed.jaxpr
    elsewhere = {x for e in jaxpr.eqns if e.primitive.name not in _ARITHMETIC for x in e.invars if _is_variable(x)}
    for k, (variable, value) in enumerate(zip(jaxpr.constvars, closed.consts, strict=True)):
        yield _Site(("constant", k), value, variable not in elsewhere and _is_float(variable))
    for i, equation in enumerate(jaxpr.eqns):
        for j, x in enumerate(equation.invars):
            if not _is_variable(x):
                free = equation.primitive.name in _ARITHMETIC and _is_float(x)
                yield _Site(("operand", i, j), x.val, free)
    for j, x in enumerate(jaxpr.outvars):
        if not _is_variable(x):
            yield _Site(("result", j), x.val, _is_float(x))


def _is_variable(x) -> bool:
    return not isinstance(x, core.Literal)


def _is_float(x) -> bool:
    return jnp.issubdtype(x.aval.dtype, jnp.floating)


# ---- whether two traces are one --------------------------------------------------------------------------------------


def _differ_by_numbers(one: _Traced | None, other: _Traced | None) -> bool:
    """True if two functions are the same but for numbers that may differ."""
    if one is None or other is None:
        return one is other
    if one.function == other.function:
        return True
    if one.structure != other.structure or not _same_jaxpr(one.closed.jaxpr, other.closed.jaxpr):
        return False
    pairs = zip(_sites(one.closed), _sites(other.closed), strict=True)
    return all(a.may_differ or _equal(a.value, b.value) for a, b in pairs)


def _same_jaxpr(one: core.Jaxpr, other: core.Jaxpr, numbers: Callable = lambda a, b: True) -> bool:
    """True if two jaxprs are the same operations on the same variables; literals as `numbers` compares them."""
    names: dict = {}

    def same(a, b) -> bool:
        if _is_variable(a) != _is_variable(b) or a.aval != b.aval:
            return False
        return names.setdefault(a, b) is b if _is_variable(a) else numbers(a.val, b.val)

    def same_all(xs, ys) -> bool:
        return len(xs) == len(ys) and all(map(same, xs, ys))

    def same_equation(a, b) -> bool:
        if a.primitive is not b.primitive or a.params.keys() != b.params.keys() or a.effects or b.effects:
            return False
        parameters = all(_same_parameter(a.params[name], b.params[name]) for name in a.params)
        return parameters and same_all(a.invars, b.invars) and same_all(a.outvars, b.outvars)

    return (
        same_all(one.constvars, other.constvars)
        and same_all(one.invars, other.invars)
        and len(one.eqns) == len(other.eqns)
        and all(map(same_equation, one.eqns, other.eqns))
        and same_all(one.outvars, other.outvars)
        and len(set(names.values())) == len(names)
    )


def _same_parameter(a, b) -> bool:
    """True if two parameters of an operation are known to be the same."""
    if a is b:
        return True
    if isinstance(a, core.ClosedJaxpr) and isinstance(b, core.ClosedJaxpr):
        same = len(a.consts) == len(b.consts) and all(map(_equal, a.consts, b.consts))
        return same and _same_jaxpr(a.jaxpr, b.jaxpr, _equal)
    if isinstance(a, core.Jaxpr) and isinstance(b, core.Jaxpr):
        return _same_jaxpr(a, b, _equal)
    if isinstance(a, tuple | list) and type(a) is type(b):
        return len(a) == len(b) and all(map(_same_parameter, a, b))
    if eqx.is_array_like(a) and eqx.is_array_like(b):
        return _equal(a, b)
    return type(a) is type(b) and not callable(a) and bool(a == b)


def _equal(a, b) -> bool:
    """True if two constants are the same, down to the sign of zero."""
    if a is b:
        return True
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
