"""Loops and decisions over numbers, written in a subset of Python and compiled once, independent of the scene.

    @loop
    def total(x: Floats, count: int) -> float:
        found = 0.0
        for i in range(count):
            found += x[i]
        return found

A loop may use doubles, integers, arrays of both with one index (`x[3:]` is the array from that element on) and the
constants of its module; `if`, `while`, `for` over a range, arithmetic, comparisons, `and`, `or`, `not`, the functions
in `_FUNCTIONS`, and calls of other loops. A variable keeps the type of its first value. The function can also be run by
Python on NumPy arrays, with the same result: so it is tested, and there an index out of range is an error, which
machine code does not detect. Integers divide as in C.
"""

import ast
import ctypes
import functools
import hashlib
import inspect
import textwrap
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir

from lagjax._native.code._ir import BIT, DOUBLE, INTEGER, LEVELS, LINE_ARGUMENTS, POINTER, Code, Value, compile_text

if TYPE_CHECKING:
    Floats = Wholes = Any
else:
    Floats = Wholes = np.ndarray  # arrays of doubles, and of integers, as annotations name them


@dataclass(frozen=True, eq=False)
class Struct:
    """The named fields of an array, used as an annotation: `places` maps a field to an integer in the array `table`.

    That integer is where the field begins; `table` is an argument of the loop. Without a table the array itself holds
    these integers. A field in `scalars` is a number, any other one the array from there on.
    """

    places: dict[str, int]
    scalars: frozenset[str]
    table: str | None


_KINDS = {"float": DOUBLE, "int": INTEGER, "Floats": POINTER, "Wholes": POINTER, "bool": BIT}
_ELEMENTS = {"Floats": "float", "Wholes": "int"}
_NUMBERS = ("float", "int", "bool")
_COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_OPERATORS = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.FloorDiv: "div", ast.Mod: "srem", ast.Div: "div"}
_FUNCTIONS = ("abs", "min", "max", "float", "int", "sqrt", "cos", "sin", "log", "atan2", "isfinite", "evaluate",
              "integrate")  # fmt: skip


def evaluate(address: int, x: np.ndarray, out: np.ndarray) -> None:
    """Call machine code `(x, out, rows)`, made for a straight line, on one row."""
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(int(address))
    call(x.ctypes.data, out.ctypes.data, 1)


def integrate(
    begin, plan, ts, y0, numbers, path, y_end, t_end, code, steps, rejected, changes, rest, members, times
) -> None:
    """Run a kernel from its address `begin` and its `plan`, with one row of times and of parameters per member."""
    arrays = ts, y0, numbers, path, y_end, t_end, code, steps, rejected, changes, rest
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 12, *[ctypes.c_int64] * 4)
    kind(int(begin))(int(plan), *(x.ctypes.data for x in arrays), members, times, members, members)


def _parse_python(text: str, mode: str) -> Any:
    for _ in range(9):
        try:
            return ast.parse(text, mode=mode)
        except SystemError:  # before CPython 3.11.8 two threads may count the depth of one another (issue 106905)
            continue
    return ast.parse(text, mode=mode)


class Loop:
    """A Python function in the subset, to be compiled by `compile_loops`; a call runs it in Python."""

    def __init__(self, function: Callable):
        self.function, self.name = function, function.__name__
        functools.update_wrapper(self, function)

    def __call__(self, *arguments):
        return self.function(*arguments)

    def bind(self, **names) -> "Loop":
        """A copy of the loop with new values for some global names that it reads."""
        code, known = self.function.__code__, {**self.names, **names}
        return Loop(types.FunctionType(code, known, self.name, self.function.__defaults__))

    @functools.cached_property
    def tree(self) -> ast.FunctionDef:
        found = _parse_python(textwrap.dedent(inspect.getsource(self.function)), "exec").body[0]
        assert isinstance(found, ast.FunctionDef)
        return found

    @functools.cached_property
    def arguments(self) -> dict[str, str]:
        return {argument.arg: ast.unparse(argument.annotation) for argument in self.tree.args.args}  # type: ignore

    @functools.cached_property
    def result(self) -> str | None:
        return None if self.tree.returns is None else ast.unparse(self.tree.returns)

    @property
    def names(self) -> dict[str, Any]:
        return self.function.__globals__


loop = Loop


_C_KINDS = {"int": ctypes.c_int64, "float": ctypes.c_double}


@functools.cache
def compile_loops(*entries: Loop) -> tuple[Callable, ...]:
    """Compile loops together; the result are functions that take numbers and addresses of arrays."""
    names = tuple(entry.name for entry in entries)
    level, laws = LEVELS[0], [(entry.function.__module__, entry.name) for entry in entries]
    engine, places = compile_text(lambda: _write_module(entries), names, f"{_digest_sources(entries)} {laws}", level)
    _engines.append(engine)
    kinds = [[_C_KINDS.get(kind, ctypes.c_void_p) for kind in entry.arguments.values()] for entry in entries]
    results = [_C_KINDS[entry.result] if entry.result else None for entry in entries]
    return tuple(
        ctypes.CFUNCTYPE(result, *of)(places[entry.name])
        for entry, of, result in zip(entries, kinds, results, strict=True)
    )


_engines: list = []  # which hold the code


def _digest_sources(entries: tuple[Loop, ...]) -> str:
    """A digest of the sources of the package and of the files of these loops: the key of the compiled object."""
    digest, own = hashlib.sha256(), {Path(inspect.getfile(entry.function)) for entry in entries}
    for path in sorted({*Path(__file__).parents[2].rglob("*.py"), *own}):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _write_module(entries: tuple[Loop, ...]) -> str:
    module, written = ir.Module("loops"), {}
    module.triple = ""
    for entry in entries:
        _write_loop(module, entry, written).function.linkage = ""
    return str(module)


def _write_loop(module: ir.Module, of: Loop, written: dict) -> Code:
    if of not in written:
        kinds = [_KINDS.get(kind, POINTER) for kind in of.arguments.values()]
        code = Code(module, of.name, kinds, 1, _KINDS[of.result] if of.result else None)
        written[of] = code
        _LoopWriter(code, of, lambda other: _write_loop(module, other, written)).write_all()
    return written[of]


class _LoopWriter:
    """The code generator of one loop; an expression is a pair (type name, a key of `_KINDS`; value)."""

    def __init__(self, code: Code, of: Loop, write: Callable):
        self.code, self.of, self.write, self.builder = code, of, write, code.builder
        self.variables: dict[str, tuple] = {}
        self.targets: list[tuple] = []  # of `continue` and `break`
        for (name, kind), value in zip(of.arguments.items(), code.arguments, strict=True):
            self.assign(name, kind, value)

    def write_all(self) -> None:
        self.statements(self.of.tree.body)
        if not self.builder.block.is_terminated:
            self.builder.ret_void() if self.of.result is None else self.builder.unreachable()

    def fail(self, node: ast.AST, why: str):
        return TypeError(f"{self.of.name}: {ast.unparse(node)}: {why}")

    def find_writer(self, prefix: str, node: ast.AST) -> Callable:
        found = getattr(self, prefix + type(node).__name__, None)
        if found is None:
            raise self.fail(node, "a loop has no such thing")
        return found

    # ---- statements ----

    def statements(self, nodes) -> None:
        for node in nodes:
            if isinstance(node, ast.Pass) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
                continue  # a docstring
            self.find_writer("do_", node)(node)
            if self.builder.block.is_terminated:
                return

    def do_Expr(self, node: ast.Expr):
        self.value(node.value)

    def do_Assign(self, node: ast.Assign):
        (target,) = node.targets
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            found = [self.value(x) for x in node.value.elts]
            for place, x in zip(target.elts, found, strict=True):
                self.store(place, x)
        else:
            self.store(target, self.value(node.value))

    def do_AugAssign(self, node: ast.AugAssign):
        read = _parse_python(ast.unparse(node.target), "eval").body
        self.store(node.target, self.value(ast.BinOp(read, node.op, node.value)))

    def store(self, target, found: tuple[str, Value]) -> None:
        if isinstance(target, ast.Name):
            self.assign(target.id, *found)
        elif isinstance(target, ast.Attribute | ast.Subscript):
            wanted, address = self.field(target) if isinstance(target, ast.Attribute) else self.element(target)
            self.code.store(self.convert(target, found, wanted), address)
        else:
            raise self.fail(target, "it is no place for a number")

    def assign(self, name: str, kind: str, value: Value) -> None:
        if name not in self.variables:
            with self.builder.goto_entry_block():
                place = Value(self.code, self.builder.alloca(_KINDS.get(kind, POINTER)))
            self.variables[name] = kind, place
        wanted, place = self.variables[name]
        if kind != wanted and not (kind, wanted) == ("int", "float"):
            raise TypeError(f"{self.of.name}: {name} begins as {wanted}, and becomes {kind}")
        self.builder.store(self.convert(None, (kind, value), wanted).it, place.it)

    def do_Return(self, node: ast.Return):
        if (node.value is None) != (self.of.result is None):
            raise self.fail(node, f"the result is {self.of.result}")
        if node.value is None or self.of.result is None:
            self.builder.ret_void()
        else:
            self.builder.ret(self.convert(node, self.value(node.value), self.of.result).it)

    def do_If(self, node: ast.If):
        names = "then", "otherwise", "behind"
        then, otherwise, behind = (self.code.function.append_basic_block(name) for name in names)
        self.builder.cbranch(self.condition(node.test).it, then, otherwise)
        for block, body in ((then, node.body), (otherwise, node.orelse)):
            self.builder.position_at_end(block)
            self.statements(body)
            if not self.builder.block.is_terminated:
                self.builder.branch(behind)
        self.builder.position_at_end(behind)

    def do_While(self, node: ast.While):
        self.repeat(lambda: self.condition(node.test), lambda: self.statements(node.body), lambda: None)

    def do_For(self, node: ast.For):
        of = node.iter
        if not (isinstance(of, ast.Call) and ast.unparse(of.func) == "range" and isinstance(node.target, ast.Name)):
            raise self.fail(of, "`for` goes over a range")
        bounds, step = [self.value(x) for x in of.args[:2]], 1
        if any(kind != "int" for kind, _ in bounds):
            raise self.fail(of, "a range is of integers")
        if len(of.args) == 3:
            step = ast.literal_eval(of.args[2])
        begin, stop = bounds if len(bounds) == 2 else (("int", self.number(0)), bounds[0])
        name = node.target.id
        with self.builder.goto_entry_block():
            counter, last = (Value(self.code, self.builder.alloca(INTEGER)) for _ in range(2))
        self.builder.store(begin[1].it, counter.it)
        self.builder.store(stop[1].it, last.it)
        load = lambda place: self.code.load(place, INTEGER)  # noqa: E731

        def run():
            self.assign(name, "int", load(counter))
            self.statements(node.body)

        self.repeat(
            lambda: self.code.compare("<" if step > 0 else ">", load(counter), load(last)),
            run,
            lambda: self.builder.store((load(counter) + step).it, counter.it),
        )

    def repeat(self, goes_on: Callable, run: Callable, move_on: Callable) -> None:
        head, inside, latch, behind = (self.code.function.append_basic_block(name) for name in ("", "", "", ""))
        self.builder.branch(head)
        self.builder.position_at_end(head)
        self.builder.cbranch(goes_on().it, inside, behind)
        self.builder.position_at_end(inside)
        self.targets.append((latch, behind))
        run()
        self.targets.pop()
        if not self.builder.block.is_terminated:
            self.builder.branch(latch)
        self.builder.position_at_end(latch)
        move_on()
        self.builder.branch(head)
        self.builder.position_at_end(behind)

    def do_Continue(self, node):
        self.builder.branch(self.targets[-1][0])

    def do_Break(self, node):
        self.builder.branch(self.targets[-1][1])

    # ---- expressions ----

    def number(self, x) -> Value:
        return self.code.as_value(x, INTEGER if isinstance(x, int) else DOUBLE)

    def value(self, node) -> tuple[str, Value]:
        return self.find_writer("read_", node)(node)

    def condition(self, node) -> Value:
        kind, value = self.value(node)
        if kind in ("int", "float"):
            return self.code.compare("!=", value, 0)
        if kind != "bool":
            raise self.fail(node, "an array is no condition")
        return value

    def convert(self, node, found: tuple[str, Value], wanted: str) -> Value:
        kind, value = found
        if kind == wanted or (kind == "Floats" and isinstance(self.of.names.get(wanted), Struct)):
            return value
        if kind == "int" and wanted == "float":
            return self.code.as_double(value)
        if kind == "bool" and wanted in ("int", "float"):
            return self.code.select(value, self.number(1 if wanted == "int" else 1.0), 0)
        if kind == "float" and wanted == "int":
            return self.code.as_integer(value)
        raise self.fail(node, f"{kind} is no {wanted}")

    def same_kind(self, node, *found: tuple[str, Value]) -> tuple[str, list[Value]]:
        if any(kind not in _NUMBERS for kind, _ in found):
            raise self.fail(node, "it is of numbers")
        kind = "float" if any(kind == "float" for kind, _ in found) else found[0][0]
        return kind, [self.convert(node, x, kind) for x in found]

    def read_Constant(self, node: ast.Constant):
        x: Any = node.value
        if isinstance(x, bool):
            return "bool", Value(self.code, ir.Constant(BIT, x))
        return type(x).__name__, self.number(x)

    def read_Name(self, node: ast.Name):
        if node.id in self.variables:
            kind, place = self.variables[node.id]
            return kind, Value(self.code, self.builder.load(place.it, typ=_KINDS.get(kind, POINTER)))
        if node.id not in self.of.names:
            raise self.fail(node, "it has no value yet")
        return self.constant(self.of.names[node.id])

    def read_Attribute(self, node: ast.Attribute):
        kind, address = self.field(node)
        is_scalar = kind in ("int", "float")
        return kind, self.code.load(address, _KINDS[kind]) if is_scalar else address

    def field(self, node: ast.Attribute) -> tuple[str, Value]:
        """The type of a field (an array unless it is a scalar) and its address."""
        kind, base = self.value(node.value)
        struct = self.of.names.get(kind)
        if not isinstance(struct, Struct) or node.attr not in struct.places:
            raise self.fail(node, "there is no such field")
        element, of_array = ("int", "Wholes") if struct.table is None else ("float", "Floats")
        place, is_scalar = self.number(struct.places[node.attr]), node.attr in struct.scalars
        if struct.table is not None or not is_scalar:
            table = base if struct.table is None else self.value(ast.Name(struct.table))[1]
            place = self.code.load(self.code.element(table, place, INTEGER), INTEGER)
        return element if is_scalar else of_array, self.code.element(base, place, _KINDS[element])

    def constant(self, x) -> tuple[str, Value]:
        return ("int", self.number(int(x))) if isinstance(x, (int, np.integer)) else ("float", self.number(float(x)))

    def element(self, node: ast.Subscript) -> tuple[str, Value]:
        kind, base = self.value(node.value)
        if kind in _KINDS and kind not in _ELEMENTS:
            raise self.fail(node, "it is no array")
        element = _ELEMENTS.get(kind, "float")
        index = self.value(node.slice)
        if index[0] != "int":
            raise self.fail(node, "an index is an integer")
        return element, self.code.element(base, index[1], _KINDS[element])

    def read_Subscript(self, node: ast.Subscript):
        if isinstance(node.slice, ast.Slice):
            if node.slice.lower is None or node.slice.upper is not None:
                raise self.fail(node, "a part of an array goes from an index on")
            begin = ast.Subscript(node.value, node.slice.lower)
            return self.value(node.value)[0], self.element(begin)[1]
        kind, address = self.element(node)
        return kind, self.code.load(address, _KINDS[kind])

    def read_BinOp(self, node: ast.BinOp):
        kind, (a, b) = self.same_kind(node, self.value(node.left), self.value(node.right))
        if isinstance(node.op, ast.Pow):
            if not (isinstance(node.right, ast.Constant) and node.right.value == 2):
                raise self.fail(node, "the only power is the second")
            return kind, a * a
        if isinstance(node.op, ast.Div) and kind != "float":
            a, b, kind = self.convert(node, (kind, a), "float"), self.convert(node, (kind, b), "float"), "float"
        if type(node.op) not in _OPERATORS or kind not in _C_KINDS:
            raise self.fail(node, f"there is no such operation of a {kind}")
        if isinstance(node.op, ast.FloorDiv | ast.Mod) and kind != "int":
            raise self.fail(node, "only integers divide with a rest")
        return kind, self.code.arithmetic(_OPERATORS[type(node.op)], a, b)

    def read_UnaryOp(self, node: ast.UnaryOp):
        if isinstance(node.op, ast.Not):
            return "bool", ~self.condition(node.operand)
        kind, x = self.value(node.operand)
        return kind, -x if kind == "float" else 0 - x

    def read_Compare(self, node: ast.Compare):
        found, bits = [self.value(x) for x in (node.left, *node.comparators)], []
        for op, a, b in zip(node.ops, found, found[1:], strict=False):
            if type(op) not in _COMPARISONS:
                raise self.fail(node, "there is no such comparison")
            _, (x, y) = self.same_kind(node, a, b)
            bits.append(self.code.compare(_COMPARISONS[type(op)], x, y))
        return "bool", functools.reduce(Value.__and__, bits)

    def read_BoolOp(self, node: ast.BoolOp):
        """Emit `and` or `or`: later operands are evaluated only if they decide the result."""
        result = self.code.variable(self.condition(node.values[0]))
        for x in node.values[1:]:
            goes_on = result.value if isinstance(node.op, ast.And) else ~result.value
            with self.code.only_if(goes_on):
                result.value = self.condition(x)
        return "bool", result.value

    def read_IfExp(self, node: ast.IfExp):
        """Emit `a if c else b`: only one branch is evaluated, since the other may read outside of an array."""
        begins, ends, found = [], [], []
        blocks = [self.code.function.append_basic_block() for _ in range(3)]
        self.builder.cbranch(self.condition(node.test).it, *blocks[:2])
        for block, x in zip(blocks, (node.body, node.orelse), strict=False):
            self.builder.position_at_end(block)
            found.append(self.value(x))
            ends.append(self.builder.block)
        kind = "float" if "float" in (found[0][0], found[1][0]) else found[0][0]
        for end, x in zip(ends, found, strict=True):
            self.builder.position_at_end(end)
            begins.append(self.convert(node, x, kind).it)
            self.builder.branch(blocks[2])
        self.builder.position_at_end(blocks[2])
        chosen = self.builder.phi(begins[0].type)
        for end, it in zip(ends, begins, strict=True):
            chosen.add_incoming(it, end)
        return kind, Value(self.code, chosen)

    def read_Call(self, node: ast.Call):
        name = ast.unparse(node.func)
        given = [self.value(x) for x in node.args]
        other = self.of.names.get(name)
        if isinstance(other, Loop):
            if len(given) != len(other.arguments):
                raise self.fail(node, f"it takes {len(other.arguments)} arguments")
            values = [self.convert(node, x, kind) for x, kind in zip(given, other.arguments.values(), strict=True)]
            return other.result, self.code.call(self.write(other), *values)
        if name not in _FUNCTIONS or node.keywords:
            raise self.fail(node, "it is no loop")
        return getattr(self, "call_" + name)(node, *given)

    def call_abs(self, node, x):
        return ("float", abs(x[1])) if x[0] == "float" else ("int", self.code.select(x[1] < 0, 0 - x[1], x[1]))

    def call_min(self, node, *xs):
        return self.choose(node, "<", xs)

    def call_max(self, node, *xs):
        return self.choose(node, ">", xs)

    def choose(self, node, op: str, xs):
        kind, (first, *others) = self.same_kind(node, *xs)
        for x in others:
            first = self.code.select(self.code.compare(op, x, first), x, first)
        return kind, first

    def call_float(self, node, x):
        return "float", self.convert(node, x, "float")

    def call_int(self, node, x):
        return "int", self.convert(node, x, "int")

    def call_sqrt(self, node, x):
        return "float", self.code.intrinsic("sqrt", self.convert(node, x, "float"))

    def call_cos(self, node, x):
        return "float", self.code.library("cos", self.convert(node, x, "float"))

    def call_sin(self, node, x):
        return "float", self.code.library("sin", self.convert(node, x, "float"))

    def call_log(self, node, x):
        return "float", self.code.library("log", self.convert(node, x, "float"))

    def call_atan2(self, node, y, x):
        return "float", self.code.library("atan2", self.convert(node, y, "float"), self.convert(node, x, "float"))

    def call_isfinite(self, node, x):
        x = self.convert(node, x, "float")
        return "bool", self.code.compare("==", x - x, 0.0)

    def call_evaluate(self, node, address, x, out):
        kind, one = ir.FunctionType(ir.VoidType(), LINE_ARGUMENTS), ir.Constant(INTEGER, 1)
        place = self.builder.inttoptr(address[1].it, kind.as_pointer())
        return None, Value(self.code, self.builder.call(place, [x[1].it, out[1].it, one, x[1].it, one]))

    def call_integrate(self, node, begin, plan, *given):
        arrays, (members, times) = [x.it for _, x in given[:-2]], [x.it for _, x in given[-2:]]
        kind = ir.FunctionType(ir.VoidType(), [POINTER] * 12 + [INTEGER] * 4)
        place = self.builder.inttoptr(begin[1].it, kind.as_pointer())
        to_plan = self.builder.inttoptr(plan[1].it, POINTER)
        call = self.builder.call(place, [to_plan, *arrays, members, times, members, members])
        return None, Value(self.code, call)
