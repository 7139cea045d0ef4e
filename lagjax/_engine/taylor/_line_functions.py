"""Straight lines as functions of JAX that XLA does not compile: machine code of our own evaluates them, or NumPy.

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
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, mlir

from lagjax._engine.taylor._call import NO_HANDLER, capsule
from lagjax._equations import forms
from lagjax._native import LARGEST_LINE, LineCode, compilation_work, line_handler, make_once
from lagjax._primitives import HostFunction, LinearMap, call_host, compute_on_host, is_zero, share_rows
from lagjax._program import Graph, StraightLine, Unlowerable, copy_nodes, pullback, pushforward
from lagjax._tracing import Program, emit, lower, lowers

_TARGET = "lagjax_line"
# Machine code takes some 20 µs a node to make, and NumPy 1 µs a node for a call: that of a line which XLA does not wait
# for is made after as many calls as take that long, so that one call is not slow, and a thousand are not.
_CALLS = 20
# What LLVM may take for a line of a program of XLA, in additions, which take 70 µs each, beyond 12 000 of them 40.
# Behind 4200 of them a call takes 0.5 µs in place of 13; behind 39 000 a row of many 6 in place of 100.
WORK_OF_JIT = 60_000
LANES = 8  # rows of a line that one call evaluates side by side: as many as there are of numbers in widest registers
MOST_IN_LANES = 2048  # numbers of a row, in all lanes 128 kB of the stack of a thread


def outputs(program: Program, count: int, first, numbers):
    """The first `count` outputs (…, count) for the first inputs (…, m) and the others (…, P)."""
    floats = all(dtype.kind == "f" for dtype in program.dtypes) and jnp.result_type(first) == np.dtype(float)
    if program.looks_up or not floats:
        return jnp.stack(program.compute_outputs(first, numbers)[:count], axis=-1)
    return line_of(program, count)(first, numbers)


def join_columns(*parts):
    """The columns of arrays (…, m), side by side; what lies in front is broadcast."""
    shape = jnp.broadcast_shapes(*(x.shape[:-1] for x in parts))
    return jnp.concatenate([jnp.broadcast_to(x, (*shape, x.shape[-1])) for x in parts], axis=-1)


def line_of(program: Program, count: int | None = None) -> "Line":
    """The first `count` outputs of a program, by default all; other inputs than floats are given as floats."""
    return _line_of(program.line, count, program.dtypes)


@functools.lru_cache(maxsize=64)
def _line_of(line: StraightLine, count: int | None, dtypes: tuple[np.dtype, ...]) -> "Line":
    line = line.replace(outputs=line.outputs[:count])
    if any(dtype.kind != "f" for dtype in dtypes):
        graph, ids = Graph(3 * len(line.nodes) + len(dtypes)), []
        for i, dtype in enumerate(dtypes):
            x = graph.input(i, "float")
            ids.append(x if dtype.kind == "f" else graph.apply("convert", x, attribute=dtype.name))
        nodes = copy_nodes(graph, line, ids)
        line = StraightLine(tuple(graph.nodes), tuple(graph.kinds), tuple(nodes[i] for i in line.outputs))
    return Line(line, len(dtypes), len(dtypes))


class Line:
    """A straight line from `size` floats x, with the lines of its derivatives by the first `count`; by identity.

    What a line of derivatives is linear in comes after its first `count` inputs. By the first that are `fixed` there
    are no derivatives.
    """

    def __init__(self, line: StraightLine, size: int, count: int, fixed: int = 0):
        self.line, self.size, self.count, self.fixed, self._calls = line, size, count, fixed, 0

    @property
    def outputs(self) -> int:
        return len(self.line.outputs)

    @property
    def width(self) -> int:
        """The number of inputs by which there are derivatives."""
        return self.count - self.fixed

    @functools.cached_property
    def code(self) -> LineCode | None:
        return self._make_code()

    @functools.lru_cache(maxsize=2)  # noqa: B019  # those of a few
    def code_of_jit(self, is_wide: bool) -> LineCode | None:
        """The code for a program of XLA, which is called often; LLVM may take longer for it."""
        for lanes in (LANES, 1) if is_wide and self.size + self.outputs <= MOST_IN_LANES else (1,):
            if compilation_work(self.line, lanes) <= WORK_OF_JIT:
                return self._make_code(largest=len(self.line.nodes) + self.outputs, lanes=lanes)
        return self.code

    def _make_code(self, **settings: int) -> LineCode | None:
        try:
            makes = NO_HANDLER is None and not self.line.looks_up
            return LineCode(self.line, self.size, **settings) if makes else None
        except Unlowerable:
            return None

    def evaluate(self, *parts: np.ndarray) -> np.ndarray:
        """Outputs (…, outputs) at inputs in parts (…, some): by NumPy until that took as long as to make code."""
        batch = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        parts = tuple(np.broadcast_to(part, (*batch, part.shape[-1])) for part in parts)
        rows = np.concatenate([part.reshape(math.prod(batch), part.shape[-1]) for part in parts], axis=1)
        self._calls += 1
        is_short = len(self.line.nodes) <= LARGEST_LINE
        code = self.code if is_short and self._calls >= _CALLS else None
        found = self.line.evaluate(list(rows.T)).T if code is None else code(rows)
        return found.reshape(*batch, self.outputs)

    @functools.cached_property
    def forward(self) -> "Line":
        """(x, v) ↦ D(x) v, v (width,)."""
        return self._derivative(pushforward, self.width)

    @functools.cached_property
    def back(self) -> "Line":
        """(x, w) ↦ D(x)ᵀ w, w (outputs,)."""
        return self._derivative(pullback, self.outputs)

    @functools.cached_property
    def with_derivative(self) -> "Line":
        """(x, v) ↦ g(x), D(x) v, one behind the other."""
        line, size = self.forward.line, self.forward.size
        graph = Graph(2 * len(line.nodes) + len(self.line.nodes) + size)
        ids = [graph.input(i, "float") for i in range(size)]
        copies = [(of, copy_nodes(graph, of, ids[:count])) for of, count in ((self.line, self.size), (line, size))]
        found = tuple(nodes[i] for of, nodes in copies for i in of.outputs)
        return Line(StraightLine(tuple(graph.nodes), tuple(graph.kinds), found), size, size)

    def _derivative(self, differentiate: Callable, linear: int) -> "Line":
        by = range(self.fixed, self.count)
        line = differentiate(self.line, [np.dtype(float)] * self.size, by, range(self.outputs))
        return Line(line, self.size + linear, self.size, self.fixed)

    def __call__(self, *parts):
        """g(x) of rows x (…, inputs) in parts (…, some), under every transformation of JAX."""
        batch = jnp.broadcast_shapes(*(x.shape[:-1] for x in parts))
        return value_p.bind(*(jnp.broadcast_to(x, (*batch, x.shape[-1])) for x in parts), line=self)[0]

    @functools.lru_cache(maxsize=8)  # noqa: B019  # those of a few
    def vary_first(self, count: int) -> "Line":
        """The line whose derivatives are by the first `count` inputs."""
        return Line(self.line, self.size, count, min(self.fixed, count))


# ---- primitives ------------------------------------------------------------------------------------------------------


class _LineMap(LinearMap):
    """The line `of(line)` of rows of arrays that stand side by side, with `width(line)` results a row."""

    def __init__(self, name: str, of: Callable, width: Callable, linear: int = 0, transpose: Callable | None = None):
        def shape(x, *_, line: Line):
            return [ShapedArray((*x.shape[:-1], width(line)), np.dtype(float))]

        def vary(primals, tangents, _, *, line: Line):
            by = of(line)
            if len(tangents) > 1:  # parts of x, of which the last ones may stand still
                moving = 1 + max(i for i, tangent in enumerate(tangents) if not is_zero(tangent))
                tangents = tangents[:moving]
                by = by.vary_first(sum(x.shape[-1] for x in primals[:moving]))
            along = jnp.concatenate(list(map(ad.instantiate_zeros, tangents)), axis=-1)[..., line.fixed :]
            return forward_p.bind(jnp.concatenate(primals, axis=-1), along, line=by)

        super().__init__(f"lagjax_line_{name}", shape, vary, linear, transpose)
        self.of, self.shape = of, shape
        compute_on_host(self, self.evaluate)
        lowers(self.name)(self._place)
        mlir.register_lowering(self, self._lower_on_cpu, platform="cpu")
        mlir.register_lowering(self, mlir.lower_fun(self._call_from_gpu, multiple_results=True), platform="cuda")

    def _place(self, expansion, params: dict, *arrays):
        """Its nodes in the graph of a function that is lowered."""
        of, batch = self.of(params["line"]), arrays[0].shape[:-1]
        rows = np.concatenate([expansion.real(x).reshape(math.prod(batch), -1) for x in arrays], axis=1)
        expansion.work(len(rows) * len(of.line.nodes))
        nodes = [copy_nodes(expansion.graph, of.line, row.tolist()) for row in rows]
        found = np.array([[of_row[i] for i in of.line.outputs] for of_row in nodes], dtype=np.int64)
        return [found.reshape(*batch, of.outputs)]

    def evaluate(self, *arrays, line: Line):
        """By NumPy, or machine code, at once."""
        return [self.of(line).evaluate(*map(np.asarray, arrays))]

    def _lower_on_cpu(self, context, *arrays, line: Line):
        of, call = self.of(line), self._compile_operations
        if not context.module_context.lowering_parameters.for_export:  # where it runs elsewhere
            code = of.code_of_jit(_is_wide(context.avals_in[0].shape[:-1]))
            call = self._call_host if code is None else self._call_code
            if code is not None:
                _register_handler()
                # What XLA compiled keeps its callbacks; this one is never called, and keeps the machine code.
                context.module_context.add_host_callback(functools.partial(id, code))
        return mlir.lower_fun(call, multiple_results=True)(context, *arrays, line=line)

    def _call_host(self, *arrays, line: Line):
        return call_host(functools.partial(self.evaluate, line=line), self.shape(*arrays, line=line), *arrays)

    def _call_code(self, *arrays, line: Line):
        x, of = jnp.concatenate(arrays, axis=-1), self.of(line)
        code = of.code_of_jit(_is_wide(x.shape[:-1]))
        assert code is not None
        rows = jax.ShapeDtypeStruct((math.prod(x.shape[:-1]), of.outputs), np.float64)
        result = jax.ffi.ffi_call(_TARGET, rows)(x.reshape(-1, x.shape[-1]), line=np.int64(code.address))
        return [result.reshape(*x.shape[:-1], of.outputs)]

    def _compile_operations(self, *arrays, line: Line):
        columns = tuple(x[..., i] for x in arrays for i in range(x.shape[-1]))
        return [jnp.stack(emit(self.of(line).line, columns), axis=-1)]

    def _call_from_gpu(self, *arrays, line: Line):
        if len(self.of(line).line.nodes) <= forms.LARGEST_COMPILED:
            return self._compile_operations(*arrays, line=line)

        def evaluate(*arrays):
            with jax.enable_x64(True):
                return jax.device_put(self.evaluate(*arrays, line=line))

        return jax.pure_callback(evaluate, self.shape(*arrays, line=line), *arrays)


def _is_wide(batch: tuple[int, ...]) -> bool:
    """True if there are enough rows for a vector of lanes to pay."""
    return math.prod(batch) >= LANES // 2


@make_once
def _register_handler() -> None:
    jax.ffi.register_ffi_target(_TARGET, capsule(line_handler()), platform="cpu", api_version=1)


def _push(x, w, _, line: Line):
    return forward_p.bind(*x, *w, line=line)


def _pull(x, w, _, line: Line):
    return back_p.bind(*x, *w, line=line)


value_p = _LineMap("value", lambda line: line, lambda line: line.outputs)
forward_p = _LineMap("forward", lambda line: line.forward, lambda line: line.outputs, 1, _pull)
back_p = _LineMap("back", lambda line: line.back, lambda line: line.width, 1, _push)


# ---- operations of functions on the host -----------------------------------------------------------------------------


def _evaluate_scalars(equation, known: dict) -> Callable:
    """An operation as scalars, for rows of NumPy: what reads tables, and all that is rare."""
    avals = [x.aval for x in equation.invars]
    moving, results = [k for k in range(len(avals)) if k not in known], [x.aval for x in equation.outvars]
    ends = np.cumsum([math.prod(x.shape) for x in results])[:-1]

    def apply(*arrays):
        given = known | dict(zip(moving, arrays, strict=True))
        return equation.primitive.bind(*(jnp.asarray(given[k]) for k in range(len(avals))), **equation.params)

    program = lower(apply, *(jax.ShapeDtypeStruct(avals[k].shape, avals[k].dtype) for k in moving))

    def evaluate(*arrays):
        arrays = share_rows(*(arrays[k] for k in moving))
        columns = [column for x in arrays for column in x.reshape(len(x), -1).T]
        parts = np.split(program.evaluate_many(columns).T, ends, axis=-1)
        return [x.reshape(-1, *of.shape).astype(of.dtype) for x, of in zip(parts, results, strict=True)]

    return evaluate


HostFunction.others = staticmethod(_evaluate_scalars)
