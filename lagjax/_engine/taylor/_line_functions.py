"""Straight lines as JAX functions that XLA does not compile: evaluated by machine code of lagjax, or by NumPy.

With y = g(x) a line and D its derivative by x, there are three functions,

    value     g(x)
    forward   D(x) v      linear in v, transposed: back
    back      D(x)ᵀ w     linear in w, transposed: forward

and their own derivatives are these again, of other lines, so that there are derivatives of every order in every mode:

    d value   = forward(x, dx)
    d forward = forward(x, dv) + forward of the line (x, v) ↦ D(x) v, along dx
    d back    = back(x, dw)    + forward of the line (x, w) ↦ D(x)ᵀ w, along dx

A line is differentiated on its graph (`_program._differentiation`), which takes milliseconds. XLA takes that for each
operation: derivatives of a motion by its duration compiled for 14 s longer with 188 operations, for minutes with 672.
"""

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, mlir

from lagjax._engine.taylor._call import NO_HANDLER, capsule
from lagjax._equations import forms
from lagjax._native import LARGEST_LINE, LineCode, compilation_work, line_handler, make_once
from lagjax._primitives import HostFunction, LinearMap, broadcast_members, call_host, compute_on_host, is_zero
from lagjax._program import (
    Graph,
    LinearSystem,
    StraightLine,
    Unlowerable,
    copy_nodes,
    eliminate_dead_code,
    pullback,
    pushforward,
)
from lagjax._tracing import Program, emit, lower, lowers

_TARGET = "lagjax_line"
# Machine code takes some 20 µs a node to make, and NumPy 1 µs a node for a call: that of a line which XLA does not wait
# for is made after as many calls as take that long, so that one call is not slow, and a thousand are not.
# A long one is interpreted: it takes 2 µs a node to make, and of 80 rows a fortieth of what NumPy takes.
_CALLS, _LONG_CALLS = 20, 3
# What LLVM may take for a line of a program of XLA, in additions, which take 70 µs each, beyond 12 000 of them 40.
# Behind 4200 of them a call takes 0.5 µs in place of 13; behind 39 000 a row of many 6 in place of 100.
WORK_OF_JIT = 60_000
LANES = 8  # rows of a line that one call evaluates side by side: as many as there are of numbers in widest registers
MOST_IN_LANES = 2048  # numbers of a row, in all lanes 128 kB of the stack of a thread


def program_outputs(program: Program, count: int, first, numbers):
    """The first `count` outputs (…, count) at inputs in two parts, `first` (…, m) and `numbers` (…, P)."""
    floats = all(dtype.kind == "f" for dtype in program.dtypes) and jnp.result_type(first) == np.dtype(float)
    if program.looks_up or not floats:
        return jnp.stack(program.compute_outputs(first, numbers)[:count], axis=-1)
    return line_of(program, count)(first, numbers)


def join_columns(*parts):
    """Arrays (…, m) concatenated along the last axis; leading axes broadcast."""
    shape = jnp.broadcast_shapes(*(x.shape[:-1] for x in parts))
    return jnp.concatenate([jnp.broadcast_to(x, (*shape, x.shape[-1])) for x in parts], axis=-1)


def line_of(program: Program, count: int | None = None) -> "Line":
    """The first `count` outputs of a program (by default all) as a `Line`; all inputs are passed as floats."""
    return _simplified_line(program, count)


@functools.lru_cache(maxsize=64)
def _simplified_line(program: Program, count: int | None) -> "Line":
    line, dtypes = program.line.replace(outputs=program.line.outputs[:count]), program.dtypes
    root, linear = None, program.linear
    if any(dtype.kind != "f" for dtype in dtypes):
        graph, ids = Graph(3 * len(line.nodes) + len(dtypes)), []
        for i, dtype in enumerate(dtypes):
            x = graph.input(i, "float")
            ids.append(x if dtype.kind == "f" else graph.apply("convert", x, attribute=dtype.name))
        nodes = copy_nodes(graph, line, ids)
        line = StraightLine(tuple(graph.nodes), tuple(graph.kinds), tuple(nodes[i] for i in line.outputs))
    elif program.residual is not None and linear is not None and not linear.others and count is None:
        root, line = Root(linear, program.residual), line.replace(outputs=(*line.outputs, *linear.factors))
    return Line(line, len(dtypes), len(dtypes), root=root)


class Root(NamedTuple):
    """The outputs z of a line (except its constant last one) as the root of r(x, z) = 0, with ∂r/∂z = A of `linear`.

    From A dz = −dr, a derivative of r takes a third of the operations of one of the elimination. Its line takes the
    outputs and the factors of A, which the line of values returns, instead.
    """

    linear: LinearSystem
    residual: Callable[[], Program]

    def derive(self, of: "Line", differentiate: Callable, by: range, linear: int) -> StraightLine:
        """The line of `differentiate`, `pushforward` or `pullback`, from (x, outputs, factors, v), by inputs `by`."""
        n, memo = of.outputs - 1, of.outputs + len(self.linear.factors)
        of_residual = differentiate(self.residual().line, [np.dtype(float)] * (of.size + n), by, range(n))
        solve = self.linear.solve()
        graph = Graph(2 * (len(of_residual.nodes) + len(solve.nodes)) + of.size + memo + linear)
        x, left, along = _inputs_of(graph, of.size, memo, linear)
        zero, factors = graph.number(0.0), left[of.outputs :]

        def solve_negative(right: list[int]) -> list[int]:
            right = [graph.apply("neg", i) for i in right] + [zero] * (len(self.linear.right) - n)
            return _place_line(graph, solve, [*factors, *right])[:n]

        with np.errstate(all="ignore"):
            if differentiate is pushforward:
                found = [*solve_negative(_place_line(graph, of_residual, [*x, *left[:n], *along])), zero]
            else:
                found = _place_line(graph, of_residual, [*x, *left[:n], *solve_negative(along[:n])])
            return eliminate_dead_code(graph, found)


def _inputs_of(graph: Graph, *counts: int) -> list[list[int]]:
    ends = np.cumsum([0, *counts]).tolist()
    return [[graph.input(i, "float") for i in range(*pair)] for pair in itertools.pairwise(ends)]


def _place_line(graph: Graph, line: StraightLine, inputs: list[int]) -> list[int]:
    """The output nodes of a line that is copied into a graph with these inputs."""
    found = copy_nodes(graph, line, inputs)
    return [found[i] for i in line.outputs]


class Line:
    """A straight line of `size` floats x, with lines of its derivatives by the first `count`; compared by identity.

    Arguments in which a line of derivatives is linear come after its first `count` inputs. The first `fixed` inputs
    have no derivatives. If it is the `root` of an equation, derivatives are those of that, and a `memo` of numbers for
    them follows the outputs; lines of derivatives take both after x, `plain` ones do not.
    """

    def __init__(self, line: StraightLine, size: int, count: int, fixed: int = 0, root: Root | None = None):
        self.line, self.size, self.count, self.fixed, self.root, self._calls = line, size, count, fixed, root, 0
        self.memo, self.make_plain = len(root.linear.factors) if root else 0, lambda: self

    @property
    def outputs(self) -> int:
        return len(self.line.outputs) - self.memo

    @property
    def width(self) -> int:
        """The number of inputs with derivatives."""
        return self.count - self.fixed

    @functools.cached_property
    def plain(self) -> "Line":
        return self.make_plain()

    @functools.cached_property
    def code(self) -> LineCode | None:
        return self._make_code(lanes=1 if len(self.line.nodes) <= LARGEST_LINE else LANES)

    @functools.lru_cache(maxsize=2)  # noqa: B019  # those of a few
    def code_of_jit(self, is_wide: bool, shared: tuple[int, ...] = ()) -> LineCode | None:
        """The machine code for use in XLA programs, which are called often, so that LLVM may take longer."""
        for lanes in (LANES, 1) if is_wide and self.size + len(self.line.outputs) <= MOST_IN_LANES else (1,):
            if compilation_work(self.line, lanes) <= WORK_OF_JIT:
                return self._make_code(
                    largest=len(self.line.nodes) + len(self.line.outputs), lanes=lanes, shared=shared
                )
        return self.code

    def _make_code(self, **settings: Any) -> LineCode | None:
        try:
            makes = NO_HANDLER is None and not self.line.looks_up
            return LineCode(self.line, self.size, **settings) if makes else None
        except Unlowerable:
            return None

    def evaluate(self, *parts: np.ndarray) -> np.ndarray:
        """Outputs (…, outputs) at inputs in parts (…, some): by NumPy until machine code would have been cheaper, which
        interprets a long line."""
        batch = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        parts = tuple(np.broadcast_to(part, (*batch, part.shape[-1])) for part in parts)
        rows = np.concatenate([part.reshape(math.prod(batch), part.shape[-1]) for part in parts], axis=1)
        self._calls += 1
        code = self.code if self._calls >= (_CALLS if len(self.line.nodes) <= LARGEST_LINE else _LONG_CALLS) else None
        found = self.line.evaluate(list(rows.T)).T if code is None else code(rows)
        return found.reshape(*batch, self.outputs + self.memo)

    @functools.cached_property
    def forward(self) -> "Line":
        """The line (x, v) ↦ D(x) v, v (width,)."""
        return self._derivative(pushforward, self.width)

    @functools.cached_property
    def back(self) -> "Line":
        """The line (x, w) ↦ D(x)ᵀ w, w (outputs,)."""
        return self._derivative(pullback, self.outputs)

    @functools.cached_property
    def with_derivative(self) -> "Line":
        """The line (x, v) ↦ g(x), D(x) v, concatenated."""
        line, size = self.forward.plain.line, self.forward.plain.size
        graph = Graph(2 * len(line.nodes) + len(self.line.nodes) + size)
        (ids,) = _inputs_of(graph, size)
        found = *_place_line(graph, self.line, ids[: self.size])[: self.outputs], *_place_line(graph, line, ids)
        return Line(StraightLine(tuple(graph.nodes), tuple(graph.kinds), found), size, size)

    def _derivative(self, differentiate: Callable, linear: int) -> "Line":
        by = range(self.fixed, self.count)
        if self.root is None:
            line = differentiate(self.line, [np.dtype(float)] * self.size, by, range(self.outputs))
            return Line(line, self.size + linear, self.size, self.fixed)
        line = self.root.derive(self, differentiate, by, linear)
        found = Line(line, self.size + len(self.line.outputs) + linear, self.size, self.fixed)

        def compose() -> Line:
            graph = Graph(2 * (len(self.line.nodes) + len(line.nodes)) + self.size + linear)
            x, along = _inputs_of(graph, self.size, linear)
            outputs = _place_line(graph, line, [*x, *_place_line(graph, self.line, x), *along])
            return Line(eliminate_dead_code(graph, outputs), self.size + linear, self.size, self.fixed)

        found.make_plain = compose
        return found

    def __call__(self, *parts):
        """The outputs at rows x (…, inputs), given in parts (…, some), under every transformation of JAX."""
        rank = max(x.ndim for x in parts)
        return value_p.bind(*(x.reshape((*[1] * (rank - x.ndim), *x.shape)) for x in parts), line=self)[0]

    @functools.lru_cache(maxsize=8)  # noqa: B019  # those of a few
    def vary_first(self, count: int) -> "Line":
        """The line with derivatives by the first `count` inputs only."""
        return Line(self.line, self.size, count, min(self.fixed, count), self.root)


# ---- primitives ------------------------------------------------------------------------------------------------------


class _LineMap(LinearMap):
    """A primitive that applies the line `of(line)` to rows of concatenated arrays; results have `widths(line)`.

    Axes of rows broadcast: an array that all rows of an axis share has length 1 there.
    """

    def __init__(self, name: str, of: Callable, widths: Callable, linear: int = 0, transpose: Callable | None = None):
        def shape(*arrays, line: Line):
            return [ShapedArray((*_rows_of(arrays), width), np.dtype(float)) for width in widths(line) if width]

        def vary(primals, tangents, results, *, line: Line):
            by = of(line).plain
            if line.root is not None and linear:  # the derivative of one is by x alone
                first = len(primals) - linear - 2
                primals, tangents = [*primals[:first], *primals[first + 2 :]], tangents[:first]
            if len(tangents) > 1:  # parts of x, of which the last ones may stand still
                moving = 1 + max(i for i, tangent in enumerate(tangents) if not is_zero(tangent))
                tangents = tangents[:moving]
                by = by.vary_first(sum(x.shape[-1] for x in primals[:moving]))
            along = join_columns(*map(ad.instantiate_zeros, tangents))[..., line.fixed :]
            left = map(jax.lax.stop_gradient, results if by.root is not None else ())
            return [*forward_p.bind(*primals, *left, along, line=by), *[None] * (len(results) - 1)]

        super().__init__(f"lagjax_line_{name}", shape, vary, linear, transpose)
        self.of, self.shape, self.widths = of, shape, widths
        compute_on_host(self, self.evaluate)
        lowers(self.name)(self._place)
        mlir.register_lowering(self, self._lower_on_cpu, platform="cpu")
        mlir.register_lowering(self, mlir.lower_fun(self._call_from_gpu, multiple_results=True), platform="cuda")

    def _place(self, expansion, params: dict, *arrays):
        """The nodes of the line in the graph of a function that is being lowered."""
        of, batch = self.of(params["line"]), _rows_of(arrays)
        arrays = [np.broadcast_to(expansion.real(x), (*batch, x.shape[-1])) for x in arrays]
        rows = np.concatenate([x.reshape(math.prod(batch), -1) for x in arrays], axis=1)
        expansion.work(len(rows) * len(of.line.nodes))
        nodes = [copy_nodes(expansion.graph, of.line, row.tolist()) for row in rows]
        found = np.array([[of_row[i] for i in of.line.outputs] for of_row in nodes], dtype=np.int64)
        return self._split(found.reshape(*batch, -1), params["line"])

    def _split(self, found, line: Line) -> list:
        ends = np.cumsum([0, *self.widths(line)]).tolist()
        return [found[..., begin:end] for begin, end in itertools.pairwise(ends)]

    def evaluate(self, *arrays, line: Line):
        """Evaluate at once, by NumPy or machine code."""
        return self._split(self.of(line).evaluate(*map(np.asarray, arrays)), line)

    def _lower_on_cpu(self, context, *arrays, line: Line):
        of, call = self.of(line), self._compile_operations
        if not context.module_context.lowering_parameters.for_export:  # where it runs elsewhere
            code = self._code_for(context.avals_in, of)[0]
            call = self._call_host if code is None else self._call_code
            if code is not None:
                _register_handler()
                # What XLA compiled keeps its callbacks; this one is never called, and keeps the machine code.
                context.module_context.add_host_callback(functools.partial(id, code))
        return mlir.lower_fun(call, multiple_results=True)(context, *arrays, line=line)

    def _call_host(self, *arrays, line: Line):
        return call_host(functools.partial(self.evaluate, line=line), self.shape(*arrays, line=line), *arrays)

    def _code_for(self, arrays, of: Line) -> tuple[LineCode | None, list[int], list[int]]:
        """The machine code for arrays of these shapes; which of them rows share, and the axes of these rows."""
        batch = _rows_of(arrays)
        missing = [frozenset(i for i, size in enumerate(x.shape[:-1]) if size < batch[i]) for x in arrays]
        axes = sorted(frozenset.intersection(*filter(None, missing))) if any(missing) else []
        if not axes:  # of a single row the longest array: the numbers of a scene, which are often constants to XLA
            axes, longest = list(range(len(batch))), max(range(len(arrays)), key=lambda k: arrays[k].shape[-1])
            given = [longest] if math.prod(batch) == 1 < len(arrays) else []
        else:
            given = [k for k, absent in enumerate(missing) if absent]
        ends = np.cumsum([0, *(x.shape[-1] for x in arrays)]).tolist()
        shared = tuple(i for k in given for i in range(ends[k], ends[k + 1]))
        code = of.code_of_jit(math.prod(batch[i] for i in axes) >= LANES // 2, shared)
        return code, given if code is not None and code.shared else [], axes

    def _call_code(self, *arrays, line: Line):
        of, batch = self.of(line), _rows_of(arrays)
        code, given, axes = self._code_for(arrays, of)
        assert code is not None
        outer = [i for i in range(len(batch)) if i not in axes]
        times, rows = (math.prod(batch[i] for i in some) for some in (outer, axes))

        def place(some: list, sizes: list[int], count: int):
            some = [jnp.broadcast_to(x, (*sizes, x.shape[-1])) for x in some] or [jnp.zeros((*sizes, 0))]
            return jnp.concatenate(some, axis=-1).transpose(*outer, *axes, len(batch)).reshape(times, count, -1)

        still = place([arrays[k] for k in given], [1 if i in axes else size for i, size in enumerate(batch)], 1)
        moving = place([x for k, x in enumerate(arrays) if k not in given], list(batch), rows)
        result = jax.ShapeDtypeStruct((times, rows, len(of.line.outputs)), np.float64)
        result = jax.ffi.ffi_call(_TARGET, result)(moving, still, line=np.int64(code.address))
        back = np.argsort([*outer, *axes, len(batch)]).tolist()
        return self._split(result.reshape(*(batch[i] for i in (*outer, *axes)), -1).transpose(*back), line)

    def _batch(self, arrays, axes, **settings):
        arrays = [x[None] if at is None else jnp.moveaxis(x, at, 0) for x, at in zip(arrays, axes, strict=True)]
        outs = self.bind(*arrays, **settings)
        return outs, [0] * len(outs)

    def _compile_operations(self, *arrays, line: Line):
        columns = tuple(x[..., i] for x in arrays for i in range(x.shape[-1]))
        return self._split(jnp.stack(emit(self.of(line).line, columns), axis=-1), line)

    def _call_from_gpu(self, *arrays, line: Line):
        if len(self.of(line).line.nodes) <= forms.LARGEST_COMPILED:
            return self._compile_operations(*arrays, line=line)

        def evaluate(*arrays):
            with jax.enable_x64(True):
                return jax.device_put(self.evaluate(*arrays, line=line))

        return jax.pure_callback(evaluate, self.shape(*arrays, line=line), *arrays)


def _rows_of(arrays) -> tuple[int, ...]:
    """The shape of the leading axes, rows, to which arrays broadcast."""
    return np.broadcast_shapes(*(x.shape[:-1] for x in arrays))


@make_once
def _register_handler() -> None:
    jax.ffi.register_ffi_target(_TARGET, capsule(line_handler()), platform="cpu", api_version=1)


def _push_tangents(x, w, _, line: Line):
    return forward_p.bind(*x, *w, line=line)


def _pull_cotangents(x, w, _, line: Line):
    return back_p.bind(*x, *w, line=line)


value_p = _LineMap("value", lambda line: line, lambda line: [line.outputs, *filter(None, [line.memo])])
forward_p = _LineMap("forward", lambda line: line.forward, lambda line: [line.outputs], 1, _pull_cotangents)
back_p = _LineMap("back", lambda line: line.back, lambda line: [line.width], 1, _push_tangents)


# ---- operations of functions on the host -----------------------------------------------------------------------------


def _evaluate_scalars(equation, known: dict) -> Callable:
    """A NumPy function for one JAX operation on rows, by scalars: for table look-ups, and rare cases."""
    avals = [x.aval for x in equation.invars]
    moving, results = [k for k in range(len(avals)) if k not in known], [x.aval for x in equation.outvars]
    ends = np.cumsum([math.prod(x.shape) for x in results])[:-1]

    def apply(*arrays):
        given = known | dict(zip(moving, arrays, strict=True))
        return equation.primitive.bind(*(jnp.asarray(given[k]) for k in range(len(avals))), **equation.params)

    program = lower(apply, *(jax.ShapeDtypeStruct(avals[k].shape, avals[k].dtype) for k in moving))

    def evaluate(*arrays):
        arrays = broadcast_members(*(arrays[k] for k in moving))
        columns = [column for x in arrays for column in x.reshape(len(x), -1).T]
        parts = np.split(program.evaluate_many(columns).T, ends, axis=-1)
        return [x.reshape(-1, *of.shape).astype(of.dtype) for x, of in zip(parts, results, strict=True)]

    return evaluate


HostFunction.others = staticmethod(_evaluate_scalars)
