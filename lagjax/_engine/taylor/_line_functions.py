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

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir

from lagjax._engine.taylor._call import NO_HANDLER, call_host, capsule
from lagjax._native import LARGEST_LINE, LineCode, line_handler
from lagjax._primitives import VaryingPrimitive, batch_in_front
from lagjax._program import (
    Graph,
    Program,
    StraightLine,
    Unlowerable,
    copy_nodes,
    emit,
    pullback,
    pushforward,
)

_TARGET = "lagjax_line"
# Operations of a line on a GPU that XLA compiles; NumPy on the host evaluates a longer one. Twice as many would cost
# several seconds of compilation.
LARGEST_COMPILED = 100
# Machine code takes some 70 µs a node to make, and NumPy 1 to 2 µs a node for a call: that of a line which XLA does not
# wait for is made after as many calls as take that long, so that one call is not slow, and a thousand are not.
_NODES_PER_CALL = 40


def outputs(program: Program, count: int, first, numbers):
    """The first `count` outputs (…, count) for the first inputs (…, m) and the others (…, P)."""
    floats = all(dtype.kind == "f" for dtype in program.dtypes) and jnp.result_type(first) == np.dtype(float)
    if program.looks_up or not floats:
        return jnp.stack(program.compute_outputs(first, numbers)[:count], axis=-1)
    return line_of(program, count)(join_columns(first, numbers))


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

    What a line of derivatives is linear in comes after its first `count` inputs.
    """

    def __init__(self, line: StraightLine, size: int, count: int):
        self.line, self.size, self.count, self._calls = line, size, count, 0

    @property
    def outputs(self) -> int:
        return len(self.line.outputs)

    @functools.cached_property
    def code(self) -> LineCode | None:
        """Its machine code; None where it has none."""
        try:
            return None if NO_HANDLER is not None else LineCode(self.line, self.size)
        except Unlowerable:
            return None

    def evaluate(self, *parts: np.ndarray) -> np.ndarray:
        """The outputs (…, outputs) at inputs that are given in parts (…, some): by NumPy at first.

        When that has taken about as long as machine code takes to make, it is made.
        """
        rows = np.concatenate([part.reshape(-1, part.shape[-1]) for part in parts], axis=1)
        self._calls += 1
        if self._calls * _NODES_PER_CALL >= len(self.line.nodes) and self.code is not None:
            found = self.code(rows)
        else:
            found = self.line.evaluate(list(rows.T)).T
        return found.reshape(*parts[0].shape[:-1], self.outputs)

    @functools.cached_property
    def forward(self) -> "Line":
        """(x, v) ↦ D(x) v, v (count,)."""
        return self._derivative(
            pushforward(self.line, self._dtypes, range(self.count), range(self.outputs)), self.count
        )

    @functools.cached_property
    def back(self) -> "Line":
        """(x, w) ↦ D(x)ᵀ w, w (outputs,)."""
        return self._derivative(pullback(self.line, self._dtypes, range(self.count), range(self.outputs)), self.outputs)

    @property
    def _dtypes(self) -> list[np.dtype]:
        return [np.dtype(float)] * self.size

    def _derivative(self, line: StraightLine, linear: int) -> "Line":
        return Line(line, self.size + linear, self.size)

    def __call__(self, x):
        """g(x) of rows x (…, inputs), under every transformation of JAX."""
        return value_p.bind(x, line=self)


# ---- primitives ------------------------------------------------------------------------------------------------------

value_p, forward_p, back_p = (VaryingPrimitive(f"lagjax_line_{name}") for name in ("value", "forward", "back"))


def _derivative_of_value(primals, tangents, *, line: Line):
    (x,), (dx,) = primals, tangents
    return value_p.bind(x, line=line), forward_p.bind(x, ad.instantiate_zeros(dx), line=line)


def _derivative_of_linear(primitive, of):
    """The derivative rule of `primitive`, (x, v) ↦ A(x) v, whose line with inputs (x, v) is `of(line)`."""

    def rule(primals, tangents, *, line: Line):
        (x, v), (dx, dv) = primals, tangents
        total = None if isinstance(dv, ad.Zero) else primitive.bind(x, dv, line=line)
        if not isinstance(dx, ad.Zero):
            more = forward_p.bind(jnp.concatenate([x, v], axis=-1), dx, line=of(line))
            total = more if total is None else total + more
        return primitive.bind(x, v, line=line), total

    return rule


def _transpose_rule(primitive):
    return lambda cotangent, x, v, *, line: [None, primitive.bind(x, ad.instantiate_zeros(cotangent), line=line)]


def _batch_rule(primitive):
    return lambda arrays, axes, *, line: (primitive.bind(*batch_in_front(arrays, axes), line=line), 0)


def _register(primitive, of, width) -> None:
    """A primitive, the line `of(line)` in NumPy, `width(line)` numbers a row: at once, or in a callback of XLA's."""

    def host(*arrays, line: Line):
        return [of(line).evaluate(*arrays)]

    def shape(x, *_, line: Line):
        return ShapedArray((*x.shape[:-1], width(line)), np.dtype(float))

    def evaluate(*arrays, line: Line):
        with jax.enable_x64(True):
            return jax.device_put(compute(*arrays, line=line))

    def compute(*arrays, line: Line):
        return host(*map(np.asarray, arrays), line=line)[0]

    def call_back(*arrays, line: Line):
        return call_host(functools.partial(host, line=line), [shape(*arrays, line=line)], *arrays)[0]

    def call_code(*arrays, line: Line):
        x = jnp.concatenate(arrays, axis=-1)
        result, code = shape(*arrays, line=line), of(line).code
        assert code is not None
        rows = jax.ShapeDtypeStruct((math.prod(x.shape[:-1]), of(line).outputs), np.float64)
        found = jax.ffi.ffi_call(_TARGET, rows)(x.reshape(-1, x.shape[-1]), line=np.int64(code.address))
        return found.reshape(result.shape)

    def lower_on_cpu(context, *arrays, line: Line):
        if context.module_context.lowering_parameters.for_export:  # it runs elsewhere
            return mlir.lower_fun(compile_operations, multiple_results=False)(context, *arrays, line=line)
        code = of(line).code if len(of(line).line.nodes) <= LARGEST_LINE else None
        if code is None:
            return mlir.lower_fun(call_back, multiple_results=False)(context, *arrays, line=line)
        _register_handler()
        # What XLA compiled keeps its callbacks; this one is never called, and keeps the machine code.
        context.module_context.add_host_callback(functools.partial(id, code))
        return mlir.lower_fun(call_code, multiple_results=False)(context, *arrays, line=line)

    def compile_operations(*arrays, line: Line):
        return jnp.stack(emit(of(line).line, tuple(x[..., i] for x in arrays for i in range(x.shape[-1]))), axis=-1)

    def call_from_gpu(*arrays, line: Line):
        if len(of(line).line.nodes) <= LARGEST_COMPILED:
            return compile_operations(*arrays, line=line)
        return jax.pure_callback(functools.partial(compute, line=line), shape(*arrays, line=line), *arrays)

    primitive.def_abstract_eval(shape)
    primitive.def_impl(evaluate)
    mlir.register_lowering(primitive, lower_on_cpu, platform="cpu")
    mlir.register_lowering(primitive, mlir.lower_fun(call_from_gpu, multiple_results=False), platform="cuda")
    batching.primitive_batchers[primitive] = _batch_rule(primitive)


@functools.cache
def _register_handler() -> None:
    jax.ffi.register_ffi_target(_TARGET, capsule(line_handler()), platform="cpu", api_version=1)


_register(value_p, lambda line: line, lambda line: line.outputs)
_register(forward_p, lambda line: line.forward, lambda line: line.outputs)
_register(back_p, lambda line: line.back, lambda line: line.count)
ad.primitive_jvps[value_p] = _derivative_of_value
ad.primitive_jvps[forward_p] = _derivative_of_linear(forward_p, lambda line: line.forward)
ad.primitive_jvps[back_p] = _derivative_of_linear(back_p, lambda line: line.back)
ad.primitive_transposes[forward_p] = _transpose_rule(back_p)
ad.primitive_transposes[back_p] = _transpose_rule(forward_p)
