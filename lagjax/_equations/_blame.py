"""The operation of a user's function that is to blame: its jaxpr, followed one equation at a time.

Every equation is evaluated by itself. One whose result is not finite although its operands are, or whose own first
or second derivative is not finite, is an `Offender`; comparisons and their like (|x|, max, sign, floor) are `borders`,
where a function may have a kink or a jump. Both know the line of the user's code that they come from.
"""

import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core, source_info_util

from lagjax._interface import join_names
from lagjax._program import OPERATIONS
from lagjax._tracing import apply_in_jax, expand_primitive

_PACKAGE = str(Path(__file__).parents[1])


class Offender(NamedTuple):
    """An operation, the operands at which it fails, the line it stands in, and what is not finite there."""

    name: str
    operands: str
    place: str
    fault: str  # "value", "first derivative" or "second derivative"

    def __str__(self) -> str:
        return f"{self.name}({self.operands}){self.place}, whose {self.fault} is not finite there"


def offenders(function: Callable, *arguments, derivatives: bool = True) -> list[Offender]:
    """The operations of `function(q, qdot, t, params)` that are not finite, or whose derivatives by q, q̇, t are not."""
    # In the order in which they are evaluated. Derivatives take a hundred times as long as values.
    collected = []

    def visit(equation, operands, moves, results, place):
        chosen = [i for i, x in enumerate(operands) if moves[i] and _floating(x)]
        if not all(_are_finite(x) for x, moved in zip(operands, moves, strict=True) if moved):
            return
        # A NaN that is written into the function counts where it is taken, as in where(t > 1, nan, force). An infinity
        # does not: where(mask, q, -inf) is meant.
        if not all(map(_are_finite, operands)) and not any(_floating(x) and np.isnan(x).any() for x in results):
            return
        name = _name(equation)
        if not all(_are_finite(x) for x in results):
            if equation.primitive.name == "select_n" and len(operands) == 3:
                operands = [operands[0], operands[2], operands[1]]  # as users write it: condition, if true, if not
            collected.append(Offender(name, _failing_operands(operands, results), place, "value"))
        elif derivatives and chosen and all(map(_are_finite, operands)) and any(_floating(x) for x in results):
            first, second = _operation_derivatives(equation, operands, chosen)
            for fault, values in (("first derivative", first), ("second derivative", second)):
                if not all(_are_finite(x) for x in values):
                    collected.append(Offender(name, _failing_operands(operands, values), place, fault))
                    break

    _visit_equations(function, arguments, visit, into_rules=False)
    return collected


def poles(function: Callable, *arguments) -> list[Offender]:
    """The operations of `function(q, qdot, t, params)` that are next to a pole or a branch point, in order."""
    collected = []

    def visit(equation, operands, moves, results, place):
        chosen = [i for i, x in enumerate(operands) if moves[i] and _floating(x)]
        # The result may be NaN, as that of log(x) for x < 0, whose derivatives are those of log(-x).
        if equation.primitive.name not in _WITH_POLES or not chosen or not all(map(_are_finite, operands)):
            return
        _, second = _operation_derivatives(equation, operands, chosen)
        large = [np.where(np.abs(x) > _AT_A_POLE, np.inf, 0.0) for x in map(np.asarray, second)]
        if equation.primitive.name in _POWERS:  # x⁴ is as curved at 1e13, where there is no pole
            large = [np.where(np.abs(operands[i]) < 1, x, 0.0) for i, x in zip(chosen, large, strict=True)]
        if not all(map(_are_finite, large)):
            collected.append(Offender(_name(equation), _failing_operands(operands, large), place, "second derivative"))

    _visit_equations(function, arguments, visit, into_rules=False)
    return collected


# Second derivatives of operations that no smooth one has: 1/x at 1e-5 has 2e15, a square root of x² there 2.5e14.
_AT_A_POLE = 1e14
_POWERS = ("pow", "integer_pow")
_WITH_POLES = frozenset(("div", "sqrt", "rsqrt", "cbrt", "pow", "integer_pow", "log", "log1p", "tan", "atan2", "acos"))


def borders(functions: Sequence[Callable], *arguments) -> list[tuple[str, str, Any]]:
    """The operations that piece functions together: name, place, and the side on which a state is, traced or not."""
    collected = []

    def visit(equation, operands, moves, results, place):
        name, row = _name(equation), OPERATIONS.get(equation.primitive.name)
        side = _SIDES.get(equation.primitive.name)
        if row is not None and row.side is not None:
            side = functools.partial(row.side, apply_in_jax, float)
        of_floats = any(m and _floating(x) for m, x in zip(moves, operands, strict=True))
        if side is not None and (of_floats or (name == "cond" and moves[0])):
            collected.append((name, place, jnp.asarray(side(results[0], *operands), float)))
        if name in _LOOPS and of_floats:
            whole = [jnp.ravel(jnp.asarray(x, float)) for x in results if not _floating(x)]
            collected.extend([(name, place, jnp.concatenate(whole))] if whole else [])

    for function in functions:
        _visit_equations(function, arguments, visit, into_rules=True)
    return collected


def border_places(functions: Sequence[Callable], *arguments) -> list[tuple[str, str, int]]:
    """The name and place of every border of functions, and how many numbers it compares; nothing is evaluated."""
    collected = []

    def traced(*arguments):
        collected.extend((name, place, np.size(x)) for name, place, x in borders(functions, *arguments))
        return 0.0

    jax.eval_shape(traced, *arguments)
    return collected


# The sides of primitives that are several operations; those of single ones stand in the table of operations.
_SIDES = {
    "argmax": lambda result, x: result,
    "argmin": lambda result, x: result,
    "clamp": lambda result, low, x, high: 1.0 * (x > low) + (x > high),
    "reduce_max": lambda result, x: jnp.argmax(x),
    "reduce_min": lambda result, x: jnp.argmin(x),
    "lagjax_locate": lambda result, *operands: result,
    "cond": lambda result, which, *operands: which,
}
_LOOPS = ("scan", "while", "sort")  # which decide inside: the whole numbers that come out tell on which side


def describe_pieces(functions: Sequence[Callable], arguments: tuple) -> str:
    """The operations at which functions are pieced together, and their lines: three at most; empty where none is."""
    return join_names(
        list(dict.fromkeys(f"{name}{place}" for name, place, _ in border_places(functions, *arguments))), 3
    )


# ---- following a jaxpr -----------------------------------------------------------------------------------------------

_CALLS = ("jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2", "call_hi_primitive")
_RULES = ("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr")


def _visit_equations(function: Callable, arguments: tuple, visit: Callable, into_rules: bool) -> None:
    """Evaluate `function(q, qdot, t, params)`, and show every equation that q, q̇ or t moves to `visit`."""
    # A function with a custom rule for its derivative counts as one operation, unless `into_rules`.
    closed = jax.make_jaxpr(function)(*arguments)
    *state, params = arguments
    moves = [True] * len(jax.tree.leaves(state)) + [False] * len(jax.tree.leaves(params))
    inside = (*_CALLS, *_RULES) if into_rules else _CALLS
    with np.errstate(all="ignore"):
        _run(closed.jaxpr, closed.consts, jax.tree.leaves(arguments), moves, "", visit, inside)


def _run(jaxpr, constants, arguments, moves, outer: str, visit: Callable, inside: tuple[str, ...]) -> tuple[list, list]:
    """The results of a jaxpr, and which of them depend on q, q̇ or t."""
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True))
    depends = {v for v, m in zip(jaxpr.invars, moves, strict=True) if m}

    def read(atom):
        return atom.val if isinstance(atom, core.Literal) else values[atom]

    def is_dependent(atom):
        return not isinstance(atom, core.Literal) and atom in depends

    for equation in jaxpr.eqns:
        operands, moved = [read(x) for x in equation.invars], [is_dependent(x) for x in equation.invars]
        # A jitted library function keeps the source line of its first caller: the line is that of the outermost call.
        place = outer or _line_phrase(equation)
        body = _called_body(equation) if equation.primitive.name in inside else None
        if body is not None:
            results, out_moved = _run(body[0], body[1], operands, moved, place, visit, inside)
        else:
            results = _evaluate_equation(equation, operands)
            out_moved = [any(moved)] * len(results)
            if any(moved):
                visit(equation, operands, moved, results, place)
        values |= zip(equation.outvars, results, strict=True)
        depends |= {v for v, m in zip(equation.outvars, out_moved, strict=True) if m}
    return [read(x) for x in jaxpr.outvars], [is_dependent(x) for x in jaxpr.outvars]


def _called_body(equation) -> tuple | None:
    if equation.primitive.name == "call_hi_primitive":
        closed = expand_primitive(equation.params["_prim"])
        return closed.jaxpr, closed.consts
    body = next((equation.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in equation.params), None)
    if body is None:
        return None
    return (body.jaxpr, body.consts) if hasattr(body, "consts") else (body, ())


def _evaluate_equation(equation, operands) -> list:
    bound = equation.primitive.get_bind_params(equation.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)  # before and since jax 0.10
    results = equation.primitive.bind(*functions, *operands, **params)
    return list(results) if equation.primitive.multiple_results else [results]


def _operation_derivatives(equation, operands, chosen: list[int]) -> tuple[list, list]:
    """The first and second derivatives of one operation, summed over its results, by the `chosen` operands."""
    # Reverse mode, then forward over reverse, as the derivation of the equations takes them.

    def local(*xs):
        filled = list(operands)
        for i, x in zip(chosen, xs, strict=True):
            filled[i] = x
        return [x for x in _evaluate_equation(equation, filled) if _floating(x)]

    def slopes(*xs):
        results, pull_back = jax.vjp(local, *xs)
        return pull_back([jnp.ones_like(x) for x in results])

    point = [jnp.asarray(operands[i]) for i in chosen]
    first, second = jax.jvp(slopes, point, [jnp.ones_like(x) for x in point])
    return list(first), list(second)


def _name(equation) -> str:
    body = _called_body(equation) if equation.primitive.name in _RULES else None
    own = getattr(getattr(body[0], "debug_info", None), "func_name", None) if body else None
    return own or {"select_n": "where"}.get(equation.primitive.name, equation.primitive.name)  # as users call it


def _line_phrase(equation) -> str:
    """The user's line, as the end of a sentence; empty where it is one of lagjax."""
    summary = source_info_util.summarize(equation.source_info)  # file:line (function)
    file = summary.partition(":")[0]
    own = not file or os.path.relpath(file, _PACKAGE).startswith("_")
    return "" if own or file == summary else f" at {os.path.basename(summary)}"


def _floating(x) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _are_finite(x) -> bool:
    return not _floating(x) or bool(np.isfinite(np.asarray(x)).all())


def _failing_operands(operands, failing) -> str:
    """The operands where the first of `failing` is not finite, number by number if they have its shape."""
    bad = next(np.asarray(x) for x in failing if not _are_finite(x))
    index = tuple(np.argwhere(~np.isfinite(bad))[0])

    def show(x):
        x = np.asarray(x)
        if x.shape == bad.shape:
            x = x[index]
        return f"{x:.6g}" if x.ndim == 0 and _floating(x) else str(x) if x.ndim == 0 else f"array of shape {x.shape}"

    return ", ".join(map(show, operands))
