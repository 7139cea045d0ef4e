"""LLVM's intermediate representation, written like arithmetic.

`Code` appends instructions to one function; a `Value` is the result of one, with the operators of Python:

    with code.loop(n) as i:
        y = code.load(row + i * width, VECTOR)
        code.store(y * y + 1.0, row + i * width)

emits the loop. A number is a double, an integer (64 bits) or a vector of doubles, one for each lane. Products and sums
may be contracted to fused multiply-adds, unless the code `rounds` each operation; no further relaxation is allowed.
"""

import ctypes
import ctypes.util
import functools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import llvmlite
import llvmlite.binding as llvm
from llvmlite import ir

from lagjax._native.code._objects import load_or_make

DOUBLE, INTEGER, BIT, POINTER = ir.DoubleType(), ir.IntType(64), ir.IntType(1), ir.PointerType()
LINE_ARGUMENTS = [POINTER, POINTER, INTEGER, POINTER, INTEGER]  # those of a `LineCode`
COUNTED = "counted"  # the name of the blocks at which counted loops begin
_COMPARISONS = {"<": "lt", "<=": "le", ">": "gt", ">=": "ge", "==": "eq", "!=": "ne"}  # LLVM's names
# What LLVM itself calls for an intrinsic that the processor has no instruction for.
_BEHIND_INTRINSICS = ("rint", "round", "floor", "ceil", "trunc", "fma", "fmod")


@functools.cache
def _host_target() -> llvm.Target:
    """LLVM's target for this kind of processor; initialises LLVM."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    for name in _BEHIND_INTRINSICS:
        _link_math_function(name)
    return llvm.Target.from_default_triple()


@functools.cache
def _link_math_function(name: str) -> None:
    if os.name == "nt":
        library = ctypes.CDLL("ucrtbase")
    else:
        library = ctypes.CDLL(ctypes.util.find_library("m"))  # None, the process itself, serves as well
    llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)


# Characters of a module's text beyond which code is generated at the second of the levels. On chains of pendulums that
# runs as fast to a few per cent, forward and back, and of 4 MB is made in 26 s instead of 134 s. Level 0 halves that
# once more and runs up to 1.8 times as long.
_LARGE, LEVELS = 2**20, [2, 1]


def _target_machine(level: int) -> llvm.TargetMachine:
    """A new target machine for this processor, at an optimisation level; an engine owns and frees its own."""
    return _host_target().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=level
    )


@functools.cache
def lanes() -> int:
    """The number of doubles per vector of a kernel: 8 with AVX-512, else 4; several registers if these are short."""
    return 8 if llvm.get_host_cpu_features().get("avx512f", False) else 4


# Loops over lanes and orders are written out by hand and every operation is shared already, so that little is left to
# do: variables become registers, and unused results go. More gains nothing measurable in how a kernel runs, and
# `new_gvn` and `simplify_cfg` end the process by failed assertions on straight lines of some thousand operations.
# LLVM's default pipeline and `instruction_combine` lose some memory for every module in llvmlite.
_PASSES = ("sroa", "dead_code_elimination")


def compile_module(
    module: ir.Module, functions: tuple[str, ...], level: int | None = None
) -> tuple[llvm.ExecutionEngine, dict[str, int]]:
    """Compile a module: the engine, which owns the code, and the addresses of `functions`. Empties the module."""
    text = str(module)
    for function in module.functions:  # its instructions are freed at once
        for block in function.blocks:
            block.instructions.clear()
    return compile_text(lambda: text, functions, text, LEVELS[len(text) > _LARGE] if level is None else level)


def compile_text(
    write: Callable[[], str], functions: tuple[str, ...], known_by: str, level: int
) -> tuple[llvm.ExecutionEngine, dict[str, int]]:
    """Compile the text of a module, or load the object kept under `known_by`: `write()` is called only without one."""
    machine = _target_machine(level)
    by = llvm.llvm_version_info, llvmlite.__version__, machine.triple, _PASSES, level
    processor = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    made = load_or_make(lambda: _compile_object(write(), level), known_by, repr(by), *processor)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(made))
    engine.finalize_object()
    return engine, {name: engine.get_function_address(name) for name in functions}


def _compile_object(text: str, level: int) -> bytes:
    parsed, machine = llvm.parse_assembly(text), _target_machine(level)
    parsed.verify()
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    manager = llvm.create_new_module_pass_manager()
    for name in _PASSES:
        getattr(manager, f"add_{name}_pass")()
    manager.run(parsed, builder)
    try:
        return machine.emit_object(parsed)
    finally:
        parsed.close()  # what the code is made from takes ten times its memory


def unroll_loops(module: ir.Module) -> None:
    """Mark the counted loops of a module for full unrolling, by metadata at the branches that close them."""
    loop: Any = module.add_metadata([module.add_metadata(["llvm.loop.unroll.full"])])
    loop.operands = (loop, *loop.operands)  # a loop is known by a node that names itself
    for function in module.functions:
        entered = set()
        for block in function.blocks:
            target = block.terminator.operands[0] if isinstance(block.terminator, ir.Branch) else None
            if target is not None and target.name.startswith(COUNTED):
                if target in entered:  # the first branch to it enters the loop
                    block.instructions[-1] = block.terminator = ir.Branch(block, "br", [target])
                    block.terminator.set_metadata("llvm.loop", loop)
                entered.add(target)


def _arithmetic_operators(op: str) -> "tuple[Callable[[Value, Any], Value], Callable[[Value, Any], Value]]":
    """The operator `op` of values, and its reflected form for a Python number on the left."""
    return lambda x, y: x.code.arithmetic(op, x, y), lambda x, y: x.code.arithmetic(op, y, x)


class Instruction(str):
    """The text of one of the instructions that most of a kernel is, and the name of its result.

    llvmlite's own hold their operands and their block until a module is written: that took 11 µs for each of them
    instead of 4, and more for Python's search for circles among them.
    """

    type: ir.Type | None  # None of a store, which has no result
    reference: str

    def get_reference(self) -> str:
        return self.reference


@dataclass(slots=True, eq=False)
class Value:
    """The result of an instruction; `it` is llvmlite's value, or an `Instruction`. None of its fields ever changes."""

    code: "Code"
    it: Any

    __add__, __radd__ = _arithmetic_operators("add")
    __sub__, __rsub__ = _arithmetic_operators("sub")
    __mul__, __rmul__ = _arithmetic_operators("mul")
    __truediv__, __rtruediv__ = _arithmetic_operators("div")
    __lt__, __le__, __gt__, __ge__ = (lambda x, y, op=op: x.code.compare(op, x, y) for op in ("<", "<=", ">", ">="))

    def __abs__(self):
        return self.code.intrinsic("fabs", self)

    def __neg__(self):
        return self.code.operate("fneg", self)

    def __and__(self, other):
        return self.code.operate("and", self, other)

    def __or__(self, other):
        return self.code.operate("or", self, other)

    def __invert__(self):
        return Value(self.code, self.code.builder.not_(self.it))


class Variable:
    """A mutable number or vector of a function: read and set `value`. LLVM turns it into a register."""

    def __init__(self, place: Value, kind: ir.Type):
        self._place, self._kind = place, kind

    @property
    def value(self) -> Value:
        return self._place.code.load(self._place, self._kind)

    @value.setter
    def value(self, x: "Value | float") -> None:
        code = self._place.code
        code.store(code.as_value(x, self._kind), self._place)


@functools.cache
def vector_type(kind: ir.Type, lanes: int) -> ir.VectorType:
    return ir.VectorType(kind, lanes)  # keeps its text


def _typed(x: Value) -> str:
    return f"{x.it.type} {x.it.get_reference()}"


def element_of(kind: ir.Type) -> ir.Type:
    """The element type of a vector type; a scalar type itself."""
    return kind.element if isinstance(kind, ir.VectorType) else kind


@functools.cache
def _splat_constants(kind: ir.Type, lanes: int) -> tuple[ir.Constant, ...]:
    """The constants of the instructions that copy a number of type `kind` into all lanes."""
    undefined = ir.Constant(ir.VectorType(kind, lanes), ir.Undefined)
    return undefined, ir.Constant(INTEGER, 0), ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)


class Code:
    """One function under construction; instructions are appended at its end."""

    def __init__(
        self, module: ir.Module, name: str, arguments: Sequence[ir.Type], lanes: int, result=None, public=False,
        rounds=False,
    ):  # fmt: skip
        self.lanes, self.vector, self._flags = lanes, vector_type(DOUBLE, lanes), "" if rounds else " contract"
        self.module = module
        self.function = ir.Function(module, ir.FunctionType(result or ir.VoidType(), arguments), name)
        if not public:
            self.function.linkage = "internal"
        self.builder: Any = ir.IRBuilder(self.function.append_basic_block("entry"))
        self.arguments = [Value(self, argument) for argument in self.function.args]

    def _append(self, text: str, kind: ir.Type | None = None) -> Value:
        """An instruction, at the end of the block: by its text, and the type of its result."""
        name = self.function.scope.register("", deduplicate=True)
        written = Instruction(text if kind is None else f'%"{name}" = {text}')
        written.type, written.reference = kind, f'%"{name}"'
        self.builder._insert(written)
        return Value(self, written)

    def operate(self, name: str, *xs: Value, kind: ir.Type | None = None) -> Value:
        """An instruction on operands of one type, which is that of its result unless another is given."""
        of = xs[0].it.type
        return self._append(f"{name} {of} {', '.join([x.it.get_reference() for x in xs])}", kind or of)

    # ---- numbers ----

    def as_value(self, x, like: ir.Type) -> Value:
        """A Python number or a value as a value of type `like`; a scalar is copied into all lanes of a vector."""
        if not isinstance(x, Value):
            return Value(self, self._constant(x, like))
        if isinstance(like, ir.VectorType) and not isinstance(x.it.type, ir.VectorType):
            undefined, begin, zeros = _splat_constants(x.it.type, self.lanes)
            first = self.builder.insert_element(undefined, x.it, begin)
            return Value(self, self.builder.shuffle_vector(first, undefined, zeros))
        return x

    def _constant(self, x, like):
        if isinstance(like, ir.VectorType):
            scalar = bool if like.element == BIT else float
            return ir.Constant(like, [ir.Constant(like.element, scalar(x))] * like.count)
        return ir.Constant(like, int(x) if isinstance(like, ir.IntType) else float(x))

    def lanes_of(self, x) -> Value:
        """A vector of doubles: a number copied into all lanes, or a vector as it is."""
        return self.as_value(x, self.vector)

    def arithmetic(self, op: str, a, b) -> Value:
        """The value a op b for doubles, vectors or integers; of a scalar and a vector, the scalar fills all lanes."""
        a, b = self._match_types(a, b)
        if isinstance(a.it.type, ir.IntType):
            return self.operate("sdiv" if op == "div" else op, a, b)
        return self.operate(f"f{op}" if op == "div" else f"f{op}{self._flags}", a, b)

    def compare(self, op: str, a, b) -> Value:
        """The bits of a comparison; a comparison with NaN is false, except `!=`."""
        a, b = self._match_types(a, b)
        kind, name = a.it.type, _COMPARISONS[op]
        if element_of(kind) == DOUBLE:
            name = f"fcmp {'u' if op == '!=' else 'o'}{name}"
        else:
            signs = "" if op in ("==", "!=") else "s" if isinstance(kind, ir.IntType) else "u"
            name = f"icmp {signs}{name}"
        return self.operate(name, a, b, kind=vector_type(BIT, kind.count) if isinstance(kind, ir.VectorType) else BIT)

    def _match_types(self, a, b) -> tuple[Value, Value]:
        types = [x.it.type for x in (a, b) if isinstance(x, Value)]
        like = next((t for t in types if isinstance(t, ir.VectorType)), types[0])
        return self.as_value(a, like), self.as_value(b, like)

    def select(self, condition: Value, yes, no) -> Value:
        """`yes` where the condition is true, else `no`; two Python numbers become doubles of its shape."""
        if not isinstance(yes, Value) and not isinstance(no, Value):
            vector = isinstance(condition.it.type, ir.VectorType)
            yes = self.as_value(yes, self.vector if vector else DOUBLE)
        yes, no = self._match_types(yes, no)
        return self._append(f"select  {', '.join(_typed(x) for x in (condition, yes, no))}", yes.it.type)

    def flag(self, condition: Value) -> Value:
        return self.select(condition, 1.0, 0.0)

    def maximum(self, a, b) -> Value:
        """The larger of two values; `b` if one is NaN."""
        a, b = self._match_types(a, b)
        return self.select(a > b, a, b)

    def total(self, terms: Iterable[Value], start: "Value | float" = 0.0) -> Value:
        """The sum of `start` and of the vectors `terms`, whose iteration may emit a loop."""
        total = self.variable(self.lanes_of(start))
        for term in terms:
            total.value += term
        return total.value

    def largest_or_nan(self, a: Value, b: Value) -> Value:
        """The larger of two values; NaN where `b` is NaN."""
        return self.select(b <= a, a, b)

    def as_number(self, i: Value) -> Value:
        """Integers, or bits, converted to doubles; the integers must be below 2⁵³."""
        if isinstance(i.it.type, ir.VectorType):
            convert = self.builder.uitofp if i.it.type.element == BIT else self.builder.sitofp
            return Value(self, convert(i.it, self.vector))
        return self.as_double(i)

    def as_double(self, i: Value) -> Value:
        return Value(self, self.builder.sitofp(i.it, DOUBLE))

    def as_integer(self, x: Value) -> Value:
        return Value(self, self.builder.fptosi(x.it, INTEGER))

    def bits(self, x: Value) -> Value:
        return Value(self, self.builder.bitcast(x.it, ir.VectorType(INTEGER, self.lanes)))

    def from_bits(self, x: Value) -> Value:
        whole = self.builder.fptosi(x.it, ir.VectorType(INTEGER, self.lanes))
        return Value(self, self.builder.bitcast(whole, self.vector))

    # ---- memory ----

    def element(self, base: Value, index, kind: ir.Type = DOUBLE) -> Value:
        """The address of `base[index]` in an array of type `kind`."""
        index = self.as_value(index, INTEGER)
        return self._append(f"getelementptr {kind}, {_typed(base)}, {_typed(index)}", base.it.type)

    def load(self, address: Value, kind: ir.Type) -> Value:
        return self._append(f"load {kind}, {_typed(address)}, align {self._alignment(kind)}", kind)

    def store(self, x: Value, address: Value) -> None:
        self._append(f"store {_typed(x)}, {_typed(address)}, align {self._alignment(x.it.type)}")

    def variable(self, start: Value) -> "Variable":
        with self.builder.goto_entry_block():
            place = self.builder.alloca(start.it.type)
        place.align = self._alignment(start.it.type)
        variable = Variable(Value(self, place), start.it.type)
        variable.value = start
        return variable

    def stack(self, words: int, align: int = 8) -> Value:
        """The address of uninitialised stack memory of `words` × 8 bytes."""
        with self.builder.goto_entry_block():
            place = self.builder.alloca(ir.ArrayType(INTEGER, words))
        place.align = align
        # A pointer of no kind, which llvmlite has no other way to make of one to an array.
        return Value(self, self.builder.inttoptr(self.builder.ptrtoint(place, INTEGER), POINTER))

    def _alignment(self, kind) -> int:
        return 8 * self.lanes if kind == self.vector else 8

    # ---- flow ----

    @contextmanager
    def loop(self, stop, start=0) -> Iterator[Value]:
        """A context that emits a loop: it yields the integers from `start` up to, excluding, `stop`."""
        counter = self.variable(self.as_value(start, INTEGER))
        with self.repeat_while(lambda: counter.value < stop, name=COUNTED):
            i = counter.value
            yield i
            counter.value = i + 1

    def fill(self, address: Value, count: "Value | int", number: float | int = 0.0) -> None:
        """Set `count` doubles (for a float `number`) or integers at an address to a number."""
        kind = DOUBLE if isinstance(number, float) else INTEGER
        with self.loop(self.as_value(count, INTEGER)) as i:
            self.store(self.as_value(number, kind), self.element(address, i))

    def copy(self, source: Value, address: Value, count: "Value | int") -> None:
        """Copy `count` doubles from one address to another."""
        with self.loop(self.as_value(count, INTEGER)) as i:
            self.store(self.load(self.element(source, i), DOUBLE), self.element(address, i))

    def cases(self, number: Value, values: range) -> Iterator[int]:
        """Emit a switch on an integer: yields each of `values`; the code emitted meanwhile is its case."""
        end = self.function.append_basic_block("end")
        switch = self.builder.switch(number.it, end)
        for value in values:
            block = self.function.append_basic_block(f"case{value}")
            switch.add_case(ir.Constant(INTEGER, value), block)
            self.builder.position_at_end(block)
            yield value
            self.builder.branch(end)
        self.builder.position_at_end(end)

    @contextmanager
    def repeat_while(self, condition, at_most: "Value | int | None" = None, name: str = "head") -> Iterator[None]:
        """A context that emits a loop while `condition()` holds before its body, of at most `at_most` rounds."""
        left = None if at_most is None else self.variable(self.as_value(at_most, INTEGER))
        head, body, done = (self.function.append_basic_block(name) for name in (name, "body", "done"))
        self.builder.branch(head)
        self.builder.position_at_end(head)
        again = condition()
        self.builder.cbranch((again if left is None else again & (left.value > 0)).it, body, done)
        self.builder.position_at_end(body)
        if left is not None:
            left.value -= 1
        yield
        self.builder.branch(head)
        self.builder.position_at_end(done)

    def count_up(self, counter: Value) -> Value:
        """Increment, atomically, an integer shared by all threads; its value before that."""
        return Value(self, self.builder.atomic_rmw("add", counter.it, ir.Constant(INTEGER, 1), "monotonic"))

    def only_if(self, condition: Value):
        """A context whose body is executed if the bit `condition` is set."""
        return self.builder.if_then(condition.it)

    def call(self, other: "Code", *arguments: Value) -> Value:
        return Value(self, self.builder.call(other.function, [argument.it for argument in arguments]))

    def finish(self, result: Value | None = None) -> "Code":
        self.builder.ret_void() if result is None else self.builder.ret(result.it)
        return self

    # ---- functions ----

    def intrinsic(self, name: str, *xs: Value) -> Value:
        xs = self._match_types(*xs) if len(xs) == 2 else xs
        kind = xs[0].it.type
        full = f"llvm.{name}." + (f"v{self.lanes}f64" if isinstance(kind, ir.VectorType) else "f64")
        return self._call_by_name(full, kind, xs)

    def library(self, name: str, *xs: Value) -> Value:
        """Call a function of the C library on scalars, or on each lane of vectors."""
        xs = self._match_types(*xs) if len(xs) == 2 else xs
        kind, number = xs[0].it.type, element_of(xs[0].it.type)
        _link_math_function(name)
        if not isinstance(kind, ir.VectorType):
            return self._call_by_name(name, number, xs)
        result = ir.Constant(kind, ir.Undefined)
        for lane in range(self.lanes):
            index = ir.Constant(INTEGER, lane)
            elements = [Value(self, self.builder.extract_element(x.it, index)) for x in xs]
            result = self.builder.insert_element(result, self._call_by_name(name, number, elements).it, index)
        return Value(self, result)

    def _call_by_name(self, name, kind, xs):
        function = self.module.globals.get(name)
        if function is None:
            function = ir.Function(self.module, ir.FunctionType(kind, [kind] * len(xs)), name)
        return Value(self, self.builder.call(function, [x.it for x in xs]))

    def any_lane(self, bits: Value) -> Value:
        each = (self.builder.extract_element(bits.it, ir.Constant(INTEGER, lane)) for lane in range(self.lanes))
        return functools.reduce(Value.__or__, [Value(self, bit) for bit in each])
