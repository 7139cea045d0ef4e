"""From a jaxpr to a graph: what every JAX primitive does to arrays of node ids.

An array in the traced function becomes a NumPy array of ids here. An elementwise primitive maps `Graph.apply` over the
ids; a primitive that only moves data is NumPy's own function of the ids; a loop or a call runs its body again.

To support another primitive: an elementwise one needs a row in `_operations`, one that moves data a line in `MOVES`,
anything else a function marked `@lowers("its_name")`, which gets the expansion, the parameters of the equation and the
id arrays, and returns an id array (or a list of them). Each needs a row in `tests/program/test_program.py`.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core

from lagjax._program import INPUTS, OPERATIONS, PAIRS, Graph, Unlowerable, arctangent, inverse, is_nonnegative
from lagjax._tracing.lowering._indexing import are_numbers, count_knots, kind_of_ids, locate_knots, look_up_windows

# Scalars that are looked at for each one that the budget allows, as most of a derivative folds away; and in all, which
# takes some minutes.
WORK_PER_OPERATION = 50
# Numbers of an array beyond which they become nodes one by one only when something computes with them; and numbers in
# all. Both only decide what a lowering costs.
LARGEST_UNFOLDED, MOST_NUMBERS = 256, 2000
LARGEST_WORK = 20_000_000


class Expansion:
    """A jaxpr under conversion to a graph, with a count of the work done so far."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self.traced_operations = 0
        self.squares: dict[int, int] = {}  # of lengths: smooth at zero, where these are not
        self._pairs: list[tuple[int, int]] = []
        self._work = 0

    def run(self, jaxpr, constants, arguments) -> list[np.ndarray]:
        """The outputs of a jaxpr as id arrays; equations on which no output depends are skipped."""
        scope = dict(zip(jaxpr.constvars, constants, strict=True)) | dict(zip(jaxpr.invars, arguments, strict=True))

        def read(atom):
            return self.constants(atom.val) if isinstance(atom, core.Literal) else scope[atom]

        for equation in live_equations(jaxpr):
            results = self._equation(equation, [read(atom) for atom in find_variables(equation)])
            scope |= zip(equation.outvars, results, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def run_closed(self, jaxpr, arguments) -> list[np.ndarray]:
        return self.run(jaxpr.jaxpr, [self.constants(value) for value in jaxpr.consts], arguments)

    def real(self, array: np.ndarray) -> np.ndarray:
        """The array with a node for every scalar: entries of long arrays get nodes when they are computed with."""
        if not array.size or array.max() < INPUTS:
            return array
        self.work(array.size)
        return _scalar_ids([i if i >= PAIRS else self.graph.real(i) for i in array.ravel().tolist()], array.shape)

    def constants(self, value) -> np.ndarray:
        if isinstance(value, Tracer):
            raise Unlowerable("the function closes over a traced value; pass it as an argument")
        dtype = value.dtype if hasattr(value, "dtype") else np.asarray(value).dtype
        if is_complex(dtype):
            return self.pair(self.constants(np.real(value)), self.constants(np.imag(value)))
        kind, value = kind_of(dtype), np.asarray(value)
        if kind == "float" and value.size > LARGEST_UNFOLDED:
            return self.graph.array(value)
        self.work(value.size)
        return _scalar_ids([self.graph.constant(x, kind) for x in value.ravel().tolist()], value.shape)

    def pair(self, re: np.ndarray, im: np.ndarray) -> np.ndarray:
        first = PAIRS + len(self._pairs)
        self._pairs += zip(self.real(re).ravel().tolist(), self.real(im).ravel().tolist(), strict=True)
        self.work(re.size)
        return np.arange(first, first + re.size, dtype=np.int64).reshape(re.shape)

    def parts(self, array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The real and the imaginary parts of an array that may contain complex numbers."""
        zero = self.graph.constant(0.0, "float")
        ids = self.real(array).ravel().tolist()
        pairs = [self._pairs[i - PAIRS] if i >= PAIRS else (i, zero) for i in ids]
        return _scalar_ids([re for re, _ in pairs], array.shape), _scalar_ids([im for _, im in pairs], array.shape)

    @staticmethod
    def has_pairs(array: np.ndarray) -> bool:
        return bool(array.size) and array.max() >= PAIRS

    def map(self, op: str, *arrays: np.ndarray, attribute=None) -> np.ndarray:
        return self.map_ids(functools.partial(self.graph.apply, op, attribute=attribute), *arrays)

    def map_ids(self, function: Callable[..., int], *arrays: np.ndarray) -> np.ndarray:
        """Apply a function of scalar ids to each element of arrays that broadcast."""
        arrays = np.broadcast_arrays(*map(self.real, arrays))
        self.work(arrays[0].size)
        self.traced_operations += arrays[0].size
        columns = zip(*(array.ravel().tolist() for array in arrays), strict=True)
        return _scalar_ids([function(*of) for of in columns], arrays[0].shape)

    def fold(self, op: str, array: np.ndarray) -> np.ndarray:
        """Reduce an array along its first axis by the operation `op`, from the left."""
        return functools.reduce(lambda total, row: self.map(op, total, row), array)

    def require_numbers(self, array: np.ndarray, what: str) -> np.ndarray:
        """The values of an array of constants; raises `Unlowerable`, naming `what`, if one depends on inputs."""
        values = [self.graph.value(i) for i in array.ravel().tolist()]
        if None in values:
            raise Unlowerable(f"{what} depends on the values of the inputs")
        return np.array(values, dtype=np.int64).reshape(array.shape)

    def work(self, count: int) -> None:
        """Count work; raise `Unlowerable` before too much of it is done."""
        self._work += count
        if self._work > min(WORK_PER_OPERATION * self.graph.budget, LARGEST_WORK):
            raise Unlowerable(
                f"expanded to scalars, the function takes far more than the {self.graph.budget} operations allowed by "
                "`budget`"
            )

    def _equation(self, equation, arguments) -> list[np.ndarray]:
        name = formula_of(equation) or equation.primitive.name
        for variable in equation.outvars:
            self.work(variable.aval.size)
        if name == "mul" and equation.invars[0] is equation.invars[1]:
            name, arguments = "square", arguments[:1]
        atoms = () if name in MOVES or name in _WITH_BODIES else (*equation.invars, *equation.outvars)
        if not any(is_complex(atom.aval.dtype) for atom in atoms):
            result = self.lower_primitive(name, equation.params, arguments)
        elif name in COMPLEX:
            result = COMPLEX[name](self, equation.params, *arguments)
        else:
            raise Unlowerable(f"the primitive `{name}` of complex numbers has no scalar form here")
        return list(result) if equation.primitive.multiple_results else [result]

    def lower_primitive(self, name: str, params, arguments):
        """The result of a primitive of real numbers, or of one that calls functions or only moves numbers."""
        if name not in MOVES and name not in _PASSING_ON:
            arguments = [self.real(x) for x in arguments]
        if name in MOVES:
            return MOVES[name](params, *arguments)
        if name in LOWER:
            return LOWER[name](self, params, *arguments)
        if name in OPERATIONS:
            return self.map(name, *arguments)
        raise Unlowerable(f"the primitive `{name}` has no scalar form here")


def is_complex(dtype) -> bool:
    return jnp.issubdtype(dtype, jnp.complexfloating)


def kind_of(dtype) -> str:
    """The kind of a scalar of this type; all floats share one, since a program has the precision of its inputs."""
    if jnp.issubdtype(dtype, jnp.floating):
        return "float"
    if dtype == np.bool_ or jnp.issubdtype(dtype, jnp.integer):
        return np.dtype(dtype).name
    raise Unlowerable(f"values of type {dtype} have no scalar form here")


def inputs_of(graph: Graph, shapes) -> list[np.ndarray]:
    """The inputs of a graph as id arrays of these shapes; elements of long arrays get no nodes yet."""
    arguments, count, many, kinds = [], 0, len(shapes) > MOST_NUMBERS, {}
    for shape in shapes:
        if (kind := kinds.get(shape.dtype)) is None:
            kind = kinds[shape.dtype] = kind_of(shape.dtype)
        places = range(count, count + shape.size)
        if kind == "float" and (many or shape.size > LARGEST_UNFOLDED):
            arguments.append((np.array(places, dtype=np.int64) + INPUTS).reshape(shape.shape))
        else:
            arguments.append(_scalar_ids([graph.input(k, kind) for k in places], shape.shape))
        count += shape.size
    return arguments


def _scalar_ids(ids: list[int], shape) -> np.ndarray:
    return np.array(ids, dtype=np.int64).reshape(shape)


def live_equations(jaxpr) -> list:
    needed, equations = {v for v in jaxpr.outvars if isinstance(v, core.Var)}, []
    for equation in reversed(jaxpr.eqns):
        if needed.intersection(equation.outvars):
            equations.append(equation)
            needed.update(v for v in find_variables(equation) if isinstance(v, core.Var))
    return equations[::-1]


def find_variables(equation) -> list:
    """The operands of a lowered equation: for a linear system the matrix and right side, not JAX's factors."""
    if equation.primitive.name != "custom_linear_solve":
        return equation.invars
    lengths = equation.params["const_lengths"]
    return equation.invars[: lengths.matvec] + equation.invars[sum(lengths) :]


def formula_of(equation) -> str | None:
    """The name of the JAX function that a call is, if it has a formula here ("det", "hypot" …); else None.

    JAX has derivative rules of its own for these, which agree with those of any formula.
    """
    name, operands = equation.primitive.name, [variable.aval for variable in equation.invars]
    if name in ("jit", "pjit"):
        called, floats = equation.params["name"], [jnp.issubdtype(x.dtype, jnp.floating) for x in operands]
        suits = called in _FORMULAS and len(floats) == _FORMULAS[called] and (all if called == "hypot" else any)(floats)
        return called if suits and _match_library_call(called, equation.params["jaxpr"]) is not None else None
    if name == "custom_jvp_call" and len(operands) == 2:
        return "logaddexp" if _match_library_call("logaddexp", equation.params["call_jaxpr"]) is not None else None
    if name != "custom_jvp_call" or len(operands) != 1:
        return None
    shape, dtype = operands[0].shape, operands[0].dtype
    if len(shape) < 2 or shape[-2] != shape[-1] or not jnp.issubdtype(dtype, jnp.floating):
        return None
    text = str(equation.params["call_jaxpr"])
    return next((name for name in ("det", "slogdet") if text in _determinant(name, shape, dtype)), None)


# How many operands they have.
_WORK_OF_EXCHANGE = 20  # of two numbers of a sort, each in arrays of its own
_FORMULAS = {"remainder": 2, "floor_divide": 2, "divmod": 2, "trunc": 1, "signbit": 1, "hypot": 2}


def _match_library_call(called: str, body: core.ClosedJaxpr, options: Sequence[dict] = ({},)) -> dict | None:
    """The options with which the JAX function `called` has this body, if the call is that function; else None.

    The texts of both bodies are compared or, as that differs under `vmap`, the scalar programs of both.
    """
    operands = [(x.shape, x.dtype, x.weak_type) for x in body.in_avals]
    bodies = [lambda of=of: _function_body(called, *operands, **of) for of in options]
    text = str(body)
    for is_own in (lambda own: str(own) == text, lambda own: own is not None and _check_same_body(own, body)):
        for of, own in zip(options, bodies, strict=True):
            if is_own(own()):
                return of
    return None


def _check_same_body(*bodies: core.ClosedJaxpr) -> bool:
    trial = Expansion(Graph(100_000))
    try:
        given = inputs_of(trial.graph, bodies[0].in_avals)
        found = [[trial.real(ids) for ids in trial.run_closed(body, given)] for body in bodies]
    except Unlowerable:
        return False
    return len(found[0]) == len(found[1]) and all(map(np.array_equal, *found))


@functools.cache
def _function_body(called: str, *operands, **options) -> core.ClosedJaxpr | None:
    """The body of a JAX function for operands of these shapes and types."""
    given = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in operands]
    equations = jax.make_jaxpr(functools.partial(getattr(jnp, called), **options))(*given).eqns
    rules = (e.params["call_jaxpr"] for e in equations if "call_jaxpr" in e.params)
    return next((e.params["jaxpr"] for e in equations if e.params.get("name") == called), next(rules, None))


_OWN_RULES = frozenset(("stop_gradient", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"))


def has_own_rules(jaxpr) -> bool:
    """True if a jaxpr, or one that it calls, has custom derivative rules."""
    for equation in live_equations(jaxpr):
        name = equation.primitive.name
        inner = equation.params["call_jaxpr"].eqns if name == "custom_jvp_call" else ()
        if formula_of(equation) or (len(inner) == 1 and formula_of(inner[0])):  # nothing but a call of a formula
            continue
        if name in _OWN_RULES or any(map(has_own_rules, _inner_jaxprs(equation))):
            return True
    return False


def _inner_jaxprs(equation) -> list:
    params = equation.params
    if equation.primitive.name == "custom_linear_solve":  # how JAX solves it is not what is lowered
        params = {"matvec": params["jaxprs"].matvec}
    return list(core.jaxprs_in_params(params))


@functools.cache
def _determinant(name: str, shape: tuple[int, ...], dtype) -> tuple[str, ...]:
    """The bodies, as texts, of calls with custom rules in one of JAX's determinants, also under `vmap`."""
    function, texts = getattr(jnp.linalg, name), []
    for _ in range(len(shape) - 1):
        (equation,) = jax.make_jaxpr(function)(jax.ShapeDtypeStruct(shape, dtype)).eqns
        bodies = [e.params.get("call_jaxpr") for e in equation.params["jaxpr"].eqns]
        texts += [str(body) for body in bodies if body is not None]
        function = jax.vmap(function)
    return tuple(texts)


# ---- primitives that only move data ---------------------------------------------------------------------------------


def _slice(params, x):
    strides = params["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _broadcast_in_dim(params, x):
    new = [axis for axis in range(len(params["shape"])) if axis not in params["broadcast_dimensions"]]
    return np.broadcast_to(np.expand_dims(x, new), params["shape"])


def _pad(params, x, value):
    """The padded array; `padding_config` is (before, after, between) for each axis, and a negative margin crops."""
    shape, source, target = [], [], []
    for size, (before, after, between) in zip(x.shape, params["padding_config"], strict=True):
        length = before + after + size + max(size - 1, 0) * between
        places = before + np.arange(size) * (between + 1)
        kept = (0 <= places) & (places < length)
        shape.append(max(length, 0))
        source.append(np.flatnonzero(kept))
        target.append(places[kept])
    result = np.full(shape, value)
    result[np.ix_(*target)] = x[np.ix_(*source)]
    return result


MOVES: dict[str, Callable] = {
    **dict.fromkeys(
        ("copy", "copy_p", "stop_gradient", "reduce_precision", "sharding_constraint"), lambda params, x: x
    ),
    "optimization_barrier": lambda params, *xs: xs,
    "slice": _slice,
    "broadcast_in_dim": _broadcast_in_dim,
    "pad": _pad,
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda params, x: np.squeeze(x, params["dimensions"]),
    "expand_dims": lambda params, x: np.expand_dims(x, params["dimensions"]),
    "transpose": lambda params, x: np.transpose(x, params["permutation"]),
    "rev": lambda params, x: np.flip(x, params["dimensions"]),
    "tile": lambda params, x: np.tile(x, params["reps"]),
    "concatenate": lambda params, *xs: np.concatenate(xs, params["dimension"]),
    "stack": lambda params, *xs: np.stack(xs, params["axis"]),
    "unstack": lambda params, x: list(np.moveaxis(x, params["axis"], 0)),
    "split": lambda params, x: np.split(x, np.cumsum(params["sizes"])[:-1], params["axis"]),
}

# ---- primitives that compute ----------------------------------------------------------------------------------------

LOWER: dict[str, Callable] = {}
COMPLEX: dict[str, Callable] = {}  # the same for complex operands or results (`_complex`)
_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call",
          "custom_vjp_call", "custom_vjp_call_jaxpr")  # fmt: skip
_WITH_BODIES = frozenset((*_CALLS, "scan", "while", "cond"))
# What passes arrays on, or looks up entries in them: these may have ids without nodes.
_PASSING_ON = frozenset(("gather", "dynamic_slice", "lagjax_locate", "convert_element_type", *_WITH_BODIES))


def lowers(*names, table: dict = LOWER):
    def register(rule):
        table.update(dict.fromkeys(names, rule))
        return rule

    return register


LOWER.update({
    "add_any": lambda expansion, params, x, y: expansion.map("add", x, y),
    "lt_to": lambda expansion, params, x, y: expansion.map("lt", x, y),
    "le_to": lambda expansion, params, x, y: expansion.map("le", x, y),
    "round": lambda expansion, params, x: expansion.map("round", x, attribute=int(params["rounding_method"])),
    "signbit": lambda expansion, params, x: [expansion.map("lt", x, expansion.constants(0.0))],
    "polynomial": lambda expansion, params, x, *coefficients: functools.reduce(  # Σ cₖ xᵏ, by Horner's rule
        lambda total, c: expansion.map("add", expansion.map("mul", total, x), c), coefficients[::-1]
    ),
    "call_hi_primitive": lambda expansion, params, *xs: expansion.run_closed(expand_primitive(params["_prim"]), xs),
})  # fmt: skip


@lowers("one_minus_square")
def _one_minus_square(expansion, params, x):
    one = expansion.constants(1.0)
    return expansion.map("mul", expansion.map("add", one, x), expansion.map("sub", one, x))


@lowers("hypot")
def _hypotenuse(expansion, params, x, y):
    """√(x² + y²), smooth except at zero; JAX divides by the larger one, which is a border where both are equal."""
    return [expansion.map_ids(functools.partial(take_length, expansion), x, y)]


def take_length(expansion, x: int, y: int) -> int:
    """The node of √(x² + y²), with slope zero where it is zero, as |z| has in JAX."""
    f, numbers = expansion.graph.apply, [expansion.graph.value(i) for i in (x, y)]
    if 0.0 in numbers:
        return f("abs", y if numbers[0] == 0.0 else x)
    square = f("add", f("mul", x, x), f("mul", y, y))
    if numbers == [None, None]:
        zero, one = map(expansion.graph.number, (0.0, 1.0))
        is_zero = f("eq", square, zero)
        length = f("select", is_zero, f("sqrt", f("select", is_zero, square, one)), zero)
    else:
        length = f("sqrt", square)
    expansion.squares[length] = square
    return length


def _divide(expansion, params, x, y):
    """x // y and x mod y, each with one border, where JAX's formulas have five and three."""
    x, y = (expansion.map("convert", z, attribute="float") for z in (x, y))
    whole = expansion.map("floor", expansion.map("div", x, y))
    return [whole, expansion.map("sub", x, expansion.map("mul", whole, y))]


def _powers_of_two(expansion, x, places):
    """The constants 2ᵏ in the kinds of x, where k = `places` is the number of places of a shift."""
    places = np.broadcast_to(expansion.require_numbers(places, "by how many places a number is shifted"), x.shape)
    pairs = [(2**k, expansion.graph.kinds[i]) for k, i in zip(places.ravel().tolist(), x.ravel().tolist(), strict=True)]
    if not all(1 <= power <= np.iinfo(kind).max for power, kind in pairs):
        raise Unlowerable("a number is shifted by more places than it has, or by fewer than none")
    return _scalar_ids([expansion.graph.constant(*pair) for pair in pairs], x.shape)


def _shift_right(expansion, params, x, places):
    power, zero = _powers_of_two(expansion, x, places), expansion.map("sub", x, x)
    rest = expansion.map("rem", x, power)
    rest = expansion.map("select", expansion.map("lt", rest, zero), rest, expansion.map("add", rest, power))
    return expansion.map("div", expansion.map("sub", x, rest), power)


LOWER.update({
    "shift_left": lambda expansion, params, x, k: expansion.map("mul", x, _powers_of_two(expansion, x, k)),
    "shift_right_arithmetic": _shift_right,
    "divmod": _divide, "floor_divide": lambda *of: _divide(*of)[:1], "remainder": lambda *of: _divide(*of)[1:],
    "trunc": lambda expansion, params, x: [expansion.map("trunc", x)],
    "logaddexp": lambda expansion, params, x, y: [expansion.map("logaddexp", x, y)],  # JAX's has borders
})  # fmt: skip


def _raise_to_power(expansion, exponent: float, i: int) -> int:
    """The node of uᵖ for a number p; for u = √s, or a length, and p ≥ 2 that is s^(p/2), smooth at s = 0."""
    graph = expansion.graph
    square = expansion.squares.get(i, graph.operand_of("sqrt", i))
    if exponent >= 2 and square is not None and is_nonnegative(graph, square):
        i, exponent = square, exponent / 2
    return graph.apply("pow", i, graph.number(exponent)) if exponent % 1 else graph.power(i, int(exponent))


def _power(expansion, params, x, y):
    numbers = {expansion.graph.value(i) for i in y.ravel().tolist()}
    if len(numbers) == 1 and (number := numbers.pop()) is not None:
        return expansion.map_ids(functools.partial(_raise_to_power, expansion, number), x)
    return expansion.map("pow", x, expansion.map("convert", y, attribute="float"))


# Inverse functions by what they are the inverse of: as it is written, for its derivatives too.
LOWER.update({
    "integer_pow": lambda of, params, x: of.map_ids(functools.partial(_raise_to_power, of, params["y"]), x),
    "square": lambda of, params, x: of.map_ids(functools.partial(_raise_to_power, of, 2), x),
    "pow": _power,
    "atan": lambda of, params, x: of.map_ids(functools.partial(arctangent, of.graph), x),
    **{op: lambda of, params, x, op=op: of.map_ids(functools.partial(inverse, of.graph, op=op), x)
       for op in ("asin", "acos")},
})  # fmt: skip


@lowers("convert_element_type")
def _convert_element_type(expansion, params, x):
    kind = kind_of(params["new_dtype"])
    if kind == "float" and x.size and x.min() >= INPUTS:  # of floats without nodes
        return x
    x = expansion.real(x)
    if kind == "bool":
        zeros = [expansion.graph.constant(0, expansion.graph.kinds[i]) for i in x.ravel().tolist()]
        return expansion.map("ne", x, _scalar_ids(zeros, x.shape))
    return expansion.map("convert", x, attribute=kind)


@lowers("clamp")
def _clamp(expansion, params, low, x, high):
    # Not min and max, whose derivatives at the bounds are a half where JAX has none.
    above = expansion.map("select", expansion.map("le", x, low), x, low)
    return expansion.map("select", expansion.map("ge", x, high), above, high)


@lowers("select_n")
def _select_n(expansion, params, which, *cases):
    if len(cases) == 1:
        return cases[0]
    if all(expansion.graph.kinds[i] == "bool" for i in which.ravel().tolist()):
        return expansion.map("select", which, *cases)
    return _choose(expansion, which, cases)


def _choose(expansion, which, cases):
    """The case with number `which`, clipped to the first and the last."""
    if any(map(expansion.has_pairs, cases)):
        parts = zip(*map(expansion.parts, cases), strict=True)
        return expansion.pair(*(_choose(expansion, which, list(of)) for of in parts))
    result = cases[0]
    for k, case in enumerate(cases[1:], 1):
        bound = [expansion.graph.constant(k, expansion.graph.kinds[i]) for i in which.ravel().tolist()]
        result = expansion.map("select", expansion.map("ge", which, _scalar_ids(bound, which.shape)), result, case)
    return result


@lowers("iota")
def _iota(expansion, params):
    shape = [1] * len(params["shape"])
    shape[params["dimension"]] = -1
    numbers = np.arange(params["shape"][params["dimension"]]).astype(params["dtype"])
    return np.broadcast_to(expansion.constants(numbers).reshape(shape), params["shape"])


@lowers("platform_index")
def _platform_index(expansion, params):
    # Which of the equivalent branches: that for CPUs, or the default. A program has no platform of its own.
    cases = params["platforms"]
    fits = [i for i, platforms in enumerate(cases) if platforms is not None and "cpu" in platforms]
    return expansion.constants(np.int32((fits + [i for i, platforms in enumerate(cases) if platforms is None])[0]))


@lowers("dot_general")
def _dot_general(expansion, params, x, y):
    if (dtype := params["preferred_element_type"]) is not None:  # JAX multiplies matrices of two dtypes
        kind, kinds = kind_of(dtype), expansion.graph.kinds
        x, y = (
            z if all(kinds[i] == kind for i in z.ravel().tolist()) else expansion.map("convert", z, attribute=kind)
            for z in (x, y)
        )
    (contract_x, contract_y), (batch_x, batch_y) = params["dimension_numbers"]
    free_x = [i for i in range(x.ndim) if i not in (*contract_x, *batch_x)]
    free_y = [i for i in range(y.ndim) if i not in (*contract_y, *batch_y)]
    shape = [x.shape[i] for i in (*batch_x, *free_x)] + [y.shape[i] for i in free_y]
    length = math.prod(x.shape[i] for i in contract_x)
    expansion.work(math.prod(shape) * length)
    left = np.transpose(x, (*contract_x, *batch_x, *free_x)).reshape(
        length, *(x.shape[i] for i in (*batch_x, *free_x)), *(1 for _ in free_y)
    )
    right = np.transpose(y, (*contract_y, *batch_y, *free_y)).reshape(
        length, *(y.shape[i] for i in batch_y), *(1 for _ in free_x), *(y.shape[i] for i in free_y)
    )
    if not length:
        return np.broadcast_to(expansion.constants(0.0), shape)
    return expansion.fold("add", expansion.map("mul", left, right))


def reduction(op, empty, fold: Callable = Expansion.fold):
    def rule(expansion, params, x):
        rows = np.moveaxis(x, params["axes"], range(len(params["axes"])))
        shape = rows.shape[len(params["axes"]) :]
        rows = rows.reshape(math.prod(rows.shape[: len(params["axes"])]), *shape)
        return fold(expansion, op, rows) if len(rows) else np.broadcast_to(expansion.constants(empty), shape)

    return rule


def _cumulation(op):
    def rule(expansion, params, x):
        way = slice(None, None, -1 if params["reverse"] else 1)
        rows = np.moveaxis(x, params["axis"], 0)[way]
        sums = list(itertools.accumulate(rows, functools.partial(expansion.map, op)))
        return np.stack(sums[way], params["axis"]) if sums else x

    return rule


def _first_extreme(better):
    """Rule of argmax or argmin: the index of the extreme element along an axis, the first of equal ones."""

    def rule(expansion, params, x):
        (axis,), kind = params["axes"], kind_of(params["index_dtype"])
        rows = np.moveaxis(x, axis, 0)
        best, place = rows[0], np.full(rows.shape[1:], expansion.graph.constant(0, kind))
        for k, row in enumerate(rows[1:], 1):
            is_better = expansion.map(better, row, best)
            here = np.full(row.shape, expansion.graph.constant(k, kind))
            best = expansion.map("select", is_better, best, row)
            place = expansion.map("select", is_better, place, here)
        return place

    return rule


LOWER.update({
    "reduce_sum": reduction("add", 0.0), "reduce_prod": reduction("mul", 1.0), "reduce_or": reduction("or", False),
    "reduce_max": reduction("max", -np.inf), "reduce_min": reduction("min", np.inf),
    "reduce_and": reduction("and", True), "reduce_xor": reduction("xor", False),
    "cumsum": _cumulation("add"), "cumprod": _cumulation("mul"), "cummax": _cumulation("max"),
    "cummin": _cumulation("min"), "argmax": _first_extreme("gt"), "argmin": _first_extreme("lt"),
})  # fmt: skip


@lowers("sort")
def _sort(expansion, params, *operands):
    """Rule of `sort`: a bubble sort of n (n − 1) / 2 comparisons, for few numbers.

    Equal ones keep their order, and with it their derivatives, as in JAX.
    """
    if params["num_keys"] != 1:
        raise Unlowerable("the primitive `sort` by several keys has no scalar form here")
    rows = [list(np.moveaxis(x, params["dimension"], 0)) for x in operands]
    expansion.work(_WORK_OF_EXCHANGE * len(rows[0]) ** 2 * len(rows))
    for end in range(len(rows[0]) - 1, 0, -1):
        for k in range(end):
            wrong = expansion.map("lt", rows[0][k + 1], rows[0][k])
            for row in rows:
                pair = row[k], row[k + 1]
                row[k], row[k + 1] = (expansion.map("select", wrong, *of) for of in (pair, pair[::-1]))
    return [np.stack(row, params["dimension"]) if row else x for row, x in zip(rows, operands, strict=True)]


# ---- indexing with arrays: the indices must fold to numbers ---------------------------------------------------------


@lowers("dynamic_slice")
def _dynamic_slice(expansion, params, x, *starts):
    sizes, starts = params["slice_sizes"], expansion.real(np.array(starts[: x.ndim]))
    if not are_numbers(expansion, starts):
        return look_up_windows(expansion, x, starts, range(x.ndim), sizes, None)
    return x[_window(expansion, starts, x.shape, sizes)]


def _window(expansion, starts, shape, sizes) -> tuple[slice, ...]:
    starts = expansion.require_numbers(starts, "the start of a slice")
    starts = np.clip(starts, 0, np.array(shape, np.int64) - np.array(sizes, np.int64)).tolist()
    return tuple(slice(start, start + size) for start, size in zip(starts, sizes, strict=True))


@lowers("dynamic_update_slice")
def _dynamic_update_slice(expansion, params, x, update, *starts):
    result = x.copy()
    result[_window(expansion, np.array(starts), x.shape, update.shape)] = update
    return result


def _gather_places(indices, shape, offset_dims, collapsed, index_map, operand_batch, indices_batch, sizes, clip):
    """The index in the flattened operand of each element of a gather's result; −1 for a window outside of it.

    For a scatter the updates take the place of the result.
    """
    batch_shape = indices.shape[:-1]
    starts = np.zeros((*batch_shape, len(shape)), dtype=np.int64)
    starts[..., list(index_map)] = indices
    for axis, batch_axis in zip(operand_batch, indices_batch, strict=True):
        starts[..., axis] = np.indices(batch_shape)[batch_axis]
    room = np.array(shape, dtype=np.int64) - np.array(sizes, dtype=np.int64)
    inside = ((0 <= starts) & (starts <= room)).all(-1)
    if clip:
        starts, inside = np.clip(starts, 0, room), np.ones_like(inside)
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    first = (starts * np.array(strides, dtype=np.int64)).sum(-1)
    window = sum((np.indices(sizes)[axis] * stride for axis, stride in enumerate(strides)), np.zeros(sizes, np.int64))
    window = window.squeeze((*collapsed, *operand_batch))
    shape_of_starts = batch_shape + (1,) * window.ndim
    places = first.reshape(shape_of_starts) + window
    places = np.where(inside.reshape(shape_of_starts), places, -1)
    return np.moveaxis(places, range(len(batch_shape), places.ndim), offset_dims)


def _clips(mode) -> bool:
    return jax.lax.GatherScatterMode.from_any(mode) == jax.lax.GatherScatterMode.CLIP


@lowers("lagjax_locate")
def _locate(expansion, params, knots, x):
    if (found := locate_knots(expansion, knots, x, params["closed"])) is not None:
        return found
    at_most = expansion.map("le", knots.reshape(-1, *[1] * x.ndim), np.broadcast_to(x, (len(knots), *x.shape)))
    counted = expansion.fold("add", expansion.map("convert", at_most, attribute="int32"))
    found = expansion.map("sub", counted, expansion.constants(np.int32(1)))
    if not params["closed"]:
        return found
    at_end = expansion.map("eq", x, expansion.real(knots[-1]))
    return expansion.map("select", at_end, found, expansion.constants(np.int32(len(knots) - 2)))


@lowers("gather")
def _gather(expansion, params, x, indices):
    d, indices, clips = params["dimension_numbers"], expansion.real(indices), _clips(params["mode"])
    missing = np.nan if params["fill_value"] is None else params["fill_value"]
    if not are_numbers(expansion, indices) and not d.operand_batching_dims:
        sizes = params["slice_sizes"]
        found = look_up_windows(expansion, x, indices, d.start_index_map, sizes, None if clips else missing)
        found = np.squeeze(found, tuple(indices.ndim - 1 + axis for axis in d.collapsed_slice_dims))
        return np.moveaxis(found, range(indices.ndim - 1, found.ndim), d.offset_dims)
    indices = expansion.require_numbers(indices, "an index")
    places = _gather_places(
        indices, x.shape, d.offset_dims, d.collapsed_slice_dims, d.start_index_map, d.operand_batching_dims,
        d.start_indices_batching_dims, params["slice_sizes"], clips,
    )  # fmt: skip
    if (places >= 0).all():
        return x.ravel()[places]
    return np.append(x.ravel(), expansion.graph.constant(missing, kind_of_ids(expansion.graph, x)))[places]


def _scatter(op):
    def rule(expansion, params, x, indices, updates):
        indices, d = expansion.require_numbers(indices, "an index"), params["dimension_numbers"]
        window = iter(updates.shape[axis] for axis in d.update_window_dims)
        fixed = (*d.inserted_window_dims, *d.operand_batching_dims)
        sizes = [1 if axis in fixed else next(window) for axis in range(x.ndim)]
        places = _gather_places(
            indices, x.shape, d.update_window_dims, d.inserted_window_dims, d.scatter_dims_to_operand_dims,
            d.operand_batching_dims, d.scatter_indices_batching_dims, sizes, _clips(params["mode"]),
        )  # fmt: skip
        result = x.ravel().copy()
        for place, update in zip(places.ravel().tolist(), updates.ravel().tolist(), strict=True):
            if place >= 0:
                result[place] = update if op is None else expansion.map(op, result[place], np.array(update))
        return result.reshape(x.shape)

    return rule


LOWER.update({f"scatter-{op}": _scatter(op) for op in ("add", "sub", "mul", "min", "max")}, scatter=_scatter(None))

# ---- calls, loops and branches --------------------------------------------------------------------------------------


@lowers(*_CALLS)
def _call(expansion, params, *arguments):
    body = next(params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in params)
    if params.get("name") == "searchsorted" and (side := _side_of_search(body, arguments)) is not None:
        if (found := count_knots(expansion, *arguments, side=side)) is not None:
            return [found]
    if isinstance(body, core.ClosedJaxpr):
        return expansion.run_closed(body, arguments)
    return expansion.run(body, (), arguments)


def expand_primitive(primitive) -> core.ClosedJaxpr:
    """The jaxpr of a primitive that JAX itself writes by others, such as `searchsorted` since 0.12."""

    def call_expansion(*flat):
        return jax.tree.leaves(primitive.expand(*jax.tree.unflatten(primitive.in_tree, flat)))

    return jax.make_jaxpr(call_expansion)(*primitive.in_avals_flat)


def _side_of_search(body, arguments) -> Literal["right", "left"] | None:
    """The side of `jnp.searchsorted(knots, x, side)`, if a call of that name is this function; else None."""
    shapes = body.in_avals
    if len(shapes) != 2 or arguments[0].ndim != 1 or not len(arguments[0]):
        return None
    if not all(jnp.issubdtype(shape.dtype, jnp.floating) for shape in shapes):
        return None
    ways = itertools.product(("scan", "scan_unrolled", "compare_all", "sort"), ("left", "right"))
    found = _match_library_call("searchsorted", body, [{"method": way, "side": side} for way, side in ways])
    return None if found is None else found["side"]


@lowers("scan")
def _scan(expansion, params, *arguments):
    if "num_carry" in params:
        consts, carry = params["num_consts"], params["num_carry"]
    else:  # since JAX 0.11
        consts, carry, _ = map(len, params["ft_in"].unpack())
    constants, state, columns = arguments[:consts], arguments[consts : consts + carry], arguments[consts + carry :]
    order = range(params["length"])[:: -1 if params["reverse"] else 1]
    rows = {}
    for k in order:
        expansion.work(1)
        results = expansion.run_closed(params["jaxpr"], [*constants, *state, *(column[k] for column in columns)])
        state, rows[k] = results[:carry], results[carry:]
    outputs = params["jaxpr"].out_avals[carry:]
    empty = [np.zeros((0, *aval.shape), dtype=np.int64) for aval in outputs]
    return [*state, *(map(np.stack, zip(*(rows[k] for k in sorted(rows)), strict=True)) if rows else empty)]


@lowers("while")
def _while(expansion, params, *arguments):
    split = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    condition, body, state = arguments[: split[0]], arguments[split[0] : split[1]], arguments[split[1] :]
    while True:
        expansion.work(1)
        (go_on,) = expansion.run_closed(params["cond_jaxpr"], [*condition, *state])
        if not expansion.require_numbers(go_on, "when a `while` loop ends"):
            return state
        state = expansion.run_closed(params["body_jaxpr"], [*body, *state])


@lowers("cond")
def _cond(expansion, params, which, *operands):
    branches = params["branches"]
    if (value := expansion.graph.value(int(which))) is not None:
        return expansion.run_closed(branches[min(max(int(value), 0), len(branches) - 1)], operands)
    results, last = [], len(branches) - 1
    for k, branch in enumerate(branches):
        comparison = "le" if k == 0 else "ge" if k == last else "eq"
        bound = expansion.graph.constant(k, expansion.graph.kinds[int(which)])
        with expansion.graph.branch(expansion.graph.apply(comparison, int(which), bound)):
            results.append(expansion.run_closed(branch, operands))
    return [_choose(expansion, np.broadcast_to(which, cases[0].shape), cases) for cases in zip(*results, strict=True)]
