"""A straight line as functions of C99 that give the same digits as its machine code (`_line_handler`).

Every operation is written in the order of the line. A compiler that does not rearrange floating-point operations
(`-ffp-contract=off`, no `-ffast-math`) gives the same digits. Sine and cosine of one angle are computed together, by
the polynomials of `_lanes`; other functions are those of `math.h`.

The time of a compiler grows faster than the length of a function. A long line is therefore divided into several
functions, and a value that a later one reads is stored in an array `w`.
"""

import math
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

from lagjax._native.code._constants import LARGEST_ANGLE
from lagjax._native.series._lanes import COS, PI_2, PI_2_ROUNDED, SIN
from lagjax._program import LOOK_UPS, OPERATIONS, StraightLine, Unlowerable, count_uses, table_of

# Statements of one function. With gcc 12 -O2 a chain of 32 pendulums compiles for 3.4 CPU s, with three times as many
# for 4.8; an arm of seven joints for 1.1, and its acceleration takes 0.88 µs, with three times as many 0.92.
LONGEST_IN_C = 300
MOST_ZEROS = 16  # outputs that are zero and written one by one
LARGEST_EXPRESSION = 16  # operands of an expression that stands where it is used; a larger one has a name

# Types of whole numbers, and what is done with these. Accelerations have few: steps that are counted, and indices.
_WHOLE_TYPES = {
    "int8": "signed char", "int16": "short", "int32": "int", "int64": "long long",
    "uint8": "unsigned char", "uint16": "unsigned short", "uint32": "unsigned", "uint64": "unsigned long long",
}  # fmt: skip
_WHOLE_FORMS = {
    "div": "({1} == 0 ? -1 : {0} / {1})", "rem": "({1} == 0 ? {0} : {0} % {1})", "not": "~{0}",
    "abs": "({0} < 0 ? -{0} : {0})", "sign": "(({0} > 0) - ({0} < 0))",
    "max": "({0} > {1} ? {0} : {1})", "min": "({0} < {1} ? {0} : {1})",
}  # fmt: skip
_FORMS_OF_ALL = frozenset(("add", "sub", "mul", "neg", "select", "and", "or", "xor"))

_ZEROS = re.compile(r"\.?0+p")
_LITERAL, _CALL = re.compile(r"\d+\.\d+"), re.compile(r"\b(?!maximum|minimum|logaddexp)([a-z][a-z0-9]*)\(")

# What a line may call, by name. `maximum` and `minimum` are those of LLVM: NaN where one number is, and 0 above −0.
_HELPERS = {
    "maximum": """\
static double maximum(double a, double b) { return a > b ? a : b > a ? b : a == b ? (signbit(a) ? b : a) : a + b; }
""",
    "minimum": """\
static double minimum(double a, double b) { return a < b ? a : b < a ? b : a == b ? (signbit(a) ? a : b) : a + b; }
""",
    "logaddexp": """\
static double logaddexp(double a, double b)
{
    return (a > b ? a : b) + (a == b ? log1p(1.0) : log1p(exp(-fabs(a - b))));
}
""",
    "take": """\
/* The entry of a table with the whole number x. */
static double take(const double *table, long stride, long count, double x)
{
    return table[stride * (long)(x > 0 ? (x < count - 1 ? x : count - 1) : 0)];
}
""",
    "locate": """\
/* The piece of an increasing table that x is on. */
static double locate(const double *table, long stride, long count, int closed, double x)
{
    long low = 0, high = count;
    if (!(x == x)) return -1;
    if (closed && x == table[stride * (count - 1)]) return count - 2;
    while (low < high) {
        const long middle = (low + high) / 2;
        if (table[stride * middle] <= x) low = middle + 1; else high = middle;
    }
    return low - 1;
}
""",
}

# `_lanes.sincos_function` of one lane.
_TURN = """\
/* Sine and cosine: reduction by Cody and Waite, polynomials of fdlibm. */
static void turn(double x, double *sine, double *cosine)
{{
    if (!(fabs(x) <= {largest})) {{ *sine = sin(x); *cosine = cos(x); return; }}
    const double k = rint(x * {quarters});
    double head = x - k * {parts[0]}, r = head - k * {parts[1]}, tail = (head - r) - k * {parts[1]};
    head = r; r = r - k * {parts[2]}; tail = (tail + ((head - r) - k * {parts[2]})) - k * {parts[3]};
    const double z = r * r, half = 0.5 * z, less = 1.0 - half;
    const double s = r + (r * z * {sine} + tail);
    const double c = less + (((1.0 - less) - half) + (z * z * {cosine} - r * tail));
    const int quarter = (int)((long)k & 3);
    *sine = quarter & 1 ? c : s;
    *cosine = quarter & 1 ? s : c;
    if (quarter > 1) *sine = -*sine;
    if (quarter == 1 || quarter == 2) *cosine = -*cosine;
}}
"""
_SINGLE_TURN = "static void turn(float x, float *sine, float *cosine) { *sine = sinf(x); *cosine = cosf(x); }\n"


class CNumbers(NamedTuple):
    """The number type of C for a precision: double for "float64", float for "float32"."""

    dtype: str

    @property
    def is_single(self) -> bool:
        return self.dtype == "float32"

    @property
    def type(self) -> str:
        return "float" if self.is_single else "double"

    def constant(self, x: float) -> str:
        """A number as an exact hexadecimal constant of C."""
        if math.isnan(x):
            return "NAN"
        text = "INFINITY" if math.isinf(x) else _ZEROS.sub("p", abs(x).hex()) + "f" * self.is_single
        return f"(-{text})" if math.copysign(1.0, x) < 0 else text

    def form(self, expression: str) -> str:
        """An expression of double functions and constants, converted to this precision."""
        return _LITERAL.sub(r"\g<0>f", _CALL.sub(r"\1f(", expression)) if self.is_single else expression

    def helpers(self, text: str) -> list[str]:
        """The helper functions that this text calls, as C."""
        parts, quarters = [self.constant(x) for x in PI_2], self.constant(1 / PI_2_ROUNDED[0])
        settings = {"largest": self.constant(LARGEST_ANGLE), "quarters": quarters, "parts": parts}
        turn = _TURN.format(**settings, sine=self._polynomial(SIN), cosine=self._polynomial(COS))
        helpers = _HELPERS | {"turn": _SINGLE_TURN if self.is_single else turn}
        return [helper.replace("double", self.type) for name, helper in helpers.items() if f"{name}(" in text]

    def _polynomial(self, coefficients: Sequence[float]) -> str:
        *lower, total = map(self.constant, coefficients)
        for coefficient in reversed(lower):
            total = f"({coefficient} + z * {total})"
        return total


def write_function(
    name: str, line: StraightLine, arguments: dict[str, str], read: Callable[[int], str], numbers: CNumbers
) -> str:
    """The C text of `name(arguments, out)`; input i of the line is `read(i)`. Raises `Unlowerable`.

    `arguments` maps names to types.
    """
    kind, parts = numbers.type, _FunctionParts(name, line, read, numbers)
    given = ", ".join(arguments)
    taken = ", ".join(f"{of} {key}" if not of.endswith("*") else f"{of}{key}" for key, of in arguments.items())
    texts = [f"static const {kind} {table}[] = {{{entries}}};\n" for entries, table in parts.tables.items()]
    if len(parts.bodies) > 1:
        for k, body in enumerate(parts.bodies):
            texts.append(f"void {name}_{k}({taken}, {kind} *restrict w, {kind} *restrict out)\n{{\n{body}}}\n")
        calls = [f"    {name}_{k}({given}, w, out);\n" for k in range(len(parts.bodies))]
        body = "".join([f"    {kind} w[{max(1, parts.room)}];\n", *calls])
    else:
        body = parts.bodies[0]
    return "\n".join([*texts, f"void {name}({taken}, {kind} *restrict out)\n{{\n{body}}}\n"])


class _FunctionParts:
    """The statements of a line in `bodies` of several functions, the size `room` of the shared array, and `tables`."""

    def __init__(self, name: str, line: StraightLine, read: Callable[[int], str], numbers: CNumbers):
        self.name, self.line, self.read, self.numbers = name, line, read, numbers
        self.uses = count_uses(line.nodes, line.outputs)
        self.inlined = self._find_inlined()
        reads = {i for i, (op, _, _) in enumerate(line.nodes) if op == "input"} - set(line.outputs)
        named = [i for i, count in enumerate(self.uses) if count and not (self.inlined[i] or i in reads)]
        self.home = {i: k // LONGEST_IN_C for k, i in enumerate(named)}
        self.last = self._last_readers(named)
        self.bodies, self.room, self.free = [], 0, []
        self.tables: dict[str, str] = {}  # names by what they hold
        self.slots: dict[int, int] = {}
        for part in range(max(1, math.ceil(len(named) / LONGEST_IN_C))):
            self.here, self.text, self.known = part, [], set()
            self._write_function_body(named[part * LONGEST_IN_C : (part + 1) * LONGEST_IN_C])
            self.bodies.append("".join(f"    {statement}\n" for statement in self.text))

    def _find_inlined(self) -> list[bool]:
        """For each node: True if its expression is written where it is used (constants, arithmetic used once)."""
        nodes, size = self.line.nodes, [1] * len(self.line.nodes)
        inlined, repeated = [False] * len(nodes), set(self.line.outputs)
        for op, operands, _ in nodes:
            form = OPERATIONS[op].c or "" if op not in ("input", "constant", *LOOK_UPS) else ""
            repeated |= {x for k, x in enumerate(operands) if form.count(f"{{{k}}}") > 1 or op in ("sin", "cos")}
        for i, (op, operands, _) in enumerate(nodes):
            arithmetic = op in ("add", "sub", "mul", "div", "neg") and self.line.kinds[i] == "float"
            if arithmetic and self.uses[i] == 1 and i not in repeated:
                size[i] = 1 + sum(size[x] for x in operands if inlined[x])
                inlined[i] = size[i] <= LARGEST_EXPRESSION
            inlined[i] |= op == "constant"
        return inlined

    def _last_readers(self, named: list[int]) -> dict[int, int]:
        """For each named node, the last function that reads it."""
        last = dict(self.home)
        for i in named:
            waiting = list(self.line.nodes[i][1])
            while waiting:
                x = waiting.pop()
                if self.inlined[x]:
                    waiting += self.line.nodes[x][1]
                elif x in last:  # not an input, which is read where it is used
                    last[x] = max(last[x], self.home[i])
        return last

    def _write_function_body(self, named: list[int]) -> None:
        places: dict[int, list[int]] = {}
        for k, i in enumerate(self.line.outputs):
            places.setdefault(i, []).append(k)
        if not self.here:
            constants = [i for i in places if self.line.nodes[i][0] == "constant"]
            zero = self.numbers.constant(0.0)
            zeros = [i for i in constants if len(places[i]) > MOST_ZEROS and self._operand(i) == zero]
            self.text += [f"for (long i = 0; i < {len(self.line.outputs)}; i++) out[i] = 0;" for _ in zeros]
            self.text += [f"out[{k}] = {self._operand(i)};" for i in constants if i not in zeros for k in places[i]]
        for i in named:
            self._write_statement(i)
            self.text += [f"out[{k}] = v{i};" for k in places.get(i, ())]
            if self.last[i] > self.here and self.line.nodes[i][0] != "input":
                if not self.free:
                    self.free.append(self.room)
                    self.room += 1
                self.slots[i] = self.free.pop()
                self.text.append(f"w[{self.slots[i]}] = v{i};")
        self.free += [slot for i, slot in self.slots.items() if self.last[i] == self.here]

    def _write_statement(self, i: int) -> None:
        op, operands, _ = self.line.nodes[i]
        if op not in ("sin", "cos"):
            self._declare_number(i, self._expression_text(i))
            return
        angle, kind = operands[0], self.numbers.type
        if -1 - angle not in self.known:
            self.known.add(-1 - angle)
            self.text.append(f"{kind} s{angle}, c{angle}; turn({self._operand(angle)}, &s{angle}, &c{angle});")
        self._declare_number(i, f"{op[0]}{angle}")

    def _declare_number(self, i: int, expression: str) -> None:
        self.known.add(i)
        kinds = {"float": self.numbers.type, "bool": "int"} | _WHOLE_TYPES
        self.text.append(f"const {kinds[self.line.kinds[i]]} v{i} = {expression};")

    def _operand(self, i: int) -> str:
        """The name of a node, or its expression; a value of another function is first read from the array."""
        op, _, attribute = self.line.nodes[i]
        if op == "constant":
            is_float = self.line.kinds[i] == "float"
            return self.numbers.constant(attribute) if is_float else f"({int(attribute)})"
        if self.inlined[i]:
            return f"({self._expression_text(i)})"
        if i not in self.known:
            truth = " != 0" * (self.line.kinds[i] == "bool")
            self._declare_number(i, self._expression_text(i) if op == "input" else f"w[{self.slots[i]}]{truth}")
        return f"v{i}"

    def _expression_text(self, i: int) -> str:
        op, operands, attribute = self.line.nodes[i]
        if op == "input":
            return self.read(attribute) + " != 0" * (self.line.kinds[i] == "bool")
        xs = [self._operand(x) for x in operands]
        if op == "convert":
            return f"{xs[0]} != 0" if self.line.kinds[i] == "bool" else xs[0]
        if op in LOOK_UPS:
            return self._look_up(op, attribute, xs[0])
        if self.line.kinds[i] in _WHOLE_TYPES and op not in _FORMS_OF_ALL:
            if op not in _WHOLE_FORMS:
                raise Unlowerable(f"`{op}` of whole numbers is not written in C")
            return _WHOLE_FORMS[op].format(*xs)
        places = (f"{{{k}}}" for k in range(len(xs)))
        return self.numbers.form(OPERATIONS[op].write_c(*places, attribute=attribute)).format(*xs)

    def _look_up(self, op: str, attribute, x: str) -> str:
        """The expression of a look-up in a table of parameters or of constants."""
        table = table_of(attribute)
        if table.numbers is None:
            where, stride = f"&{self.read(table.first)}", table.stride
        else:
            entries = ", ".join(map(self.numbers.constant, table.entries.tolist()))
            where, stride = self.tables.setdefault(entries, f"{self.name}_table_{len(self.tables)}"), 1
        closed = f"{int(attribute.closed)}, " if op == "locate" else ""
        return f"{op}({where}, {stride}, {table.count}, {closed}{x})"
