"""PTX on the CPU: the assembly language of NVIDIA's GPUs, translated back into LLVM, so that it can be run and counted.

It knows the some eighty instructions that lagjax's kernels have: no calls, no barriers.
"""

import ctypes
import re
import struct

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

I1, I32, I64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)
F, D, P = ir.FloatType(), ir.DoubleType(), ir.PointerType()


def jitted(module, *names):
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(cpu=llvm.get_host_cpu_name(), opt=1)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine, *(engine.get_function_address(name) for name in names)


def outputs_of(entry, arrays, shapes):
    """Copies of the arguments of a launch, and its results: NaN but for those that are arguments, too."""
    arrays = [np.array(x) for x in arrays]
    of_name = dict(zip(entry.arguments, arrays, strict=True))
    outputs = [np.full(shape, np.nan) for shape in shapes]
    outputs = [of_name.get(name, x) for name, x in zip(entry.results, [None, *outputs], strict=True)]
    return arrays, outputs


_NUMBERS = {
    "f64": D,
    "b64": I64,
    "s64": I64,
    "u64": I64,
    "f32": F,
    "b8": ir.IntType(8),
    "u8": ir.IntType(8),
    "b16": ir.IntType(16),
    "u16": ir.IntType(16),
    "b32": I32,
    "s32": I32,
    "u32": I32,
    "pred": I1,
}
COUNTED = "float64", "float32", "local loads", "local stores"
_ARITHMETIC = frozenset(("add", "sub", "mul", "div", "fma", "max", "min", "sqrt", "rcp", "setp"))
_SPECIAL = ("%tid.x", "%ntid.x", "%ctaid.x", "%nctaid.x")


class PtxOnCpu:
    """One kernel of a PTX text as a function `(tid, ntid, ctaid, nctaid, *arguments)`, one thread a call.

    A register is a variable of its bits; all spaces of addresses are one, that of the host. No calls, no barriers.
    Where it is `counting`, `counts` has how many instructions of the kinds in `COUNTED` it has executed so far: those
    of the arithmetic of float64 and float32, and numbers read from and written to local memory.
    """

    def __init__(self, ptx, counting=False):
        text = re.sub(r"//[^\n]*", "", ptx)
        header, body = re.search(r"\.entry\s+(\w+\(.*?\))[^{]*\{(.*?)\n\}", text, re.DOTALL).groups()
        self.parameters = re.findall(r"(\w+_param_\d+)", header)
        self.module = ir.Module("ptx")
        self.module.triple = llvm.get_default_triple()
        self.names, self._counters = {}, None
        if counting:
            kind = ir.ArrayType(I64, len(COUNTED))
            self._counters = ir.GlobalVariable(self.module, kind, "counters")
            self._counters.initializer = ir.Constant(kind, [0] * len(COUNTED))
        for name, size, data in re.findall(
            r"\.(?:global|const)[^;{]*?.b8\s+([\w$]+)\[(\d+)\](?:\s*=\s*\{([^}]*)\})?", text
        ):
            kind = ir.ArrayType(ir.IntType(8), int(size))
            place = ir.GlobalVariable(self.module, kind, name)
            given = [int(x) for x in data.split(",")] if data else []
            place.initializer = ir.Constant(kind, bytearray(given + [0] * (int(size) - len(given))))
            place.align = 16
            self.names[name] = place
        count = len(_SPECIAL)
        function = ir.Function(
            self.module, ir.FunctionType(ir.VoidType(), [I32] * count + [I64] * len(self.parameters)), "thread"
        )
        self.b = b = ir.IRBuilder(function.append_basic_block("entry"))
        self.registers = dict(zip(_SPECIAL, function.args, strict=False))
        self.arguments = dict(zip(self.parameters, function.args[count:], strict=True))
        labels = {
            name: function.append_basic_block(name.strip("$")) for name in re.findall(r"^\s*(\$L__\w+):", body, re.M)
        }
        for kind, name, many in re.findall(r"\.reg \.(\w+)\s+(%\w+)(?:<(\d+)>)?", body):
            for register in [name] if not many else [f"{name}{i}" for i in range(int(many))]:
                self.registers[register] = b.alloca(_NUMBERS[kind])
        for name, size in re.findall(r"\.local[^;]*?\.b8\s+(\w+)\[(\d+)\]", body):
            place = b.alloca(ir.ArrayType(ir.IntType(8), int(size)))
            place.align, self.names[name] = 64, place
        self.tables = {
            name: re.findall(r"\$\w+", targets)
            for name, targets in re.findall(r"(\$L_brx_\d+): \.branchtargets(.*?);", body, re.DOTALL)
        }
        body = re.sub(r"\$L_brx_\d+: \.branchtargets.*?;", "", body, flags=re.DOTALL)
        word = r"\{\s*\.reg \.b32 \w+;\s*mov\.b64 \{%s\}, (%%\w+);\s*\}"  # one half of a register
        body = re.sub(word % r"(%\w+), \w+", r"cvt.u32.u64 \1, \2;", body)
        body = re.sub(word % r"\w+, (%\w+)", r"high.b32 \1, \2;", body)
        for line in re.split(r";|(?<=:)\n", re.sub(r"^\s*\.(?:reg|local|pragma|loc|file)[^;]*;", "", body, flags=re.M)):
            if line := line.strip():
                self._line(line, labels, function)
        if not b.block.is_terminated:
            b.ret_void()
        text = str(self.module)
        module = llvm.parse_assembly(text)
        module.verify()
        machine = llvm.Target.from_default_triple().create_target_machine(opt=1)
        builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1))
        passes = llvm.create_new_module_pass_manager()
        passes.add_sroa_pass()
        passes.run(module, builder)
        self.engine, address = jitted(module, "thread")
        self.address = address
        if counting:
            place = self.engine.get_global_value_address("counters")
            self._totals = (ctypes.c_int64 * len(COUNTED)).from_address(place)
        self.thread = ctypes.CFUNCTYPE(None, *[ctypes.c_uint32] * count, *[ctypes.c_void_p] * len(self.parameters))(
            address
        )

    @property
    def counts(self):
        return dict(zip(COUNTED, self._totals, strict=True))

    def _count(self, name, parts, registers):
        """Count an instruction; local memory is that of `.local` and of the thread's own pointers."""
        kind = None
        if name in ("ld", "st") and parts[1] == "local":
            kind = "local loads" if name == "ld" else "local stores"
        elif name in _ARITHMETIC and parts[-1] in ("f64", "f32"):
            kind = "float64" if parts[-1] == "f64" else "float32"
        elif name == "cvt" and "f64" in parts[-2:]:
            kind = "float64"
        if self._counters is not None and kind is not None:
            place = self.b.gep(self._counters, [I32(0), I32(COUNTED.index(kind))], inbounds=True)
            self.b.store(self.b.add(self.b.load(place), I64(registers)), place)

    def _line(self, line, labels, function):
        b = self.b
        if line.endswith(":"):
            if not b.block.is_terminated:
                b.branch(labels[line[:-1]])
            b.position_at_end(labels[line[:-1]])
            return
        guard, negated, op, rest = re.match(r"(?:@(!?)(%\w+)\s+)?([\w.]+)\s*(.*)", line, re.DOTALL).group(2, 1, 3, 4)
        operands = [part.strip() for part in re.findall(r"\{[^}]*\}|\[[^\]]*\]|[^,\s][^,]*", rest)]
        parts = op.split(".")
        if parts[0] == "brx":
            targets = self.tables[operands[1]]
            switch = b.switch(self._read(operands[0], "b32"), labels[targets[0]])
            for i, target in enumerate(targets[1:], start=1):
                switch.add_case(I32(i), labels[target])
            b.position_at_end(function.append_basic_block("after"))
            return
        if parts[0] in ("bra", "ret", "exit"):
            target = labels[operands[0]] if parts[0] == "bra" else None
            if guard is None:
                b.branch(target) if target else b.ret_void()
                b.position_at_end(function.append_basic_block("after"))
                return
            condition = b.load(self.registers[guard], typ=I1)
            after, target = function.append_basic_block("after"), target or self._return(function)
            b.cbranch(b.not_(condition) if negated else condition, target, after)
            b.position_at_end(after)
            return
        assert guard is None, line
        self._operation(parts, operands, line)

    def _return(self, function):
        block = function.append_basic_block("return")
        ir.IRBuilder(block).ret_void()
        return block

    def _read(self, x, kind):
        b, t = self.b, _NUMBERS[kind]
        if x.startswith("%"):
            place = self.registers[x]
            value = b.load(place, typ=place.allocated_type) if hasattr(place, "allocated_type") else place
            bits = ir.IntType(64 if t is D else t.width if isinstance(t, ir.IntType) else 32)
            if isinstance(value.type, ir.IntType) and value.type.width > bits.width:
                value = b.trunc(value, bits)
            return b.bitcast(value, t) if value.type != t else value
        if x in self.names:
            return b.ptrtoint(self.names[x], I64)
        if x.startswith("0f"):
            number = struct.unpack(">f", bytes.fromhex(x[2:]))[0]
            return ir.Constant(t, number) if isinstance(t, ir.FloatType) else ir.Constant(I32, int(x[2:], 16))
        if x.startswith("0d"):
            number = struct.unpack(">d", bytes.fromhex(x[2:]))[0]
            return ir.Constant(D, number) if t is D else ir.Constant(I64, int(x[2:], 16))
        return ir.Constant(t, int(x, 0))

    def _write(self, x, value):
        place, b = self.registers[x], self.b
        t = place.allocated_type
        if t == I64 and isinstance(value.type, ir.IntType) and value.type.width < 64:  # the upper half becomes zero
            value = b.zext(value, I64)
        b.store(b.bitcast(value, t) if value.type != t else value, place)

    def _address(self, x):
        base, _, offset = x.strip("[] ").partition("+")
        if base in self.arguments:
            return None, base
        where = self.b.add(self._read(base, "b64"), I64(int(offset or 0)))
        return self.b.inttoptr(where, P), None

    def _intrinsic(self, name, *xs):
        kind, width = xs[0].type, "f64" if xs[0].type == D else "f32"
        kind, full = ir.FunctionType(kind, [kind] * len(xs)), f"llvm.{name}.{width}"
        f = self.module.globals.get(full) or ir.Function(self.module, kind, full)
        return self.b.call(f, xs)

    def _operation(self, parts, operands, line):
        b, name, kind = self.b, parts[0], parts[-1]
        if name in ("stacksave", "stackrestore"):  # nothing is put on the stack later
            return
        if name in ("ld", "st"):
            vector = operands[0 if name == "ld" else 1].startswith("{")
            registers = (
                re.findall(r"[%\w]+", operands[0 if name == "ld" else 1])
                if vector
                else [operands[0 if name == "ld" else 1]]
            )
            place, argument = self._address(operands[1 if name == "ld" else 0])
            self._count(name, parts, len(registers))
            for i, register in enumerate(registers):
                t = _NUMBERS[kind]
                if argument:
                    self._write(register, self.arguments[argument])
                    continue
                at = b.gep(place, [I64(i)], source_etype=t)
                if name == "ld":
                    self._write(register, b.load(at, typ=t, align=1))
                else:
                    b.store(self._read(register, kind), at, align=1)
            return
        self._count(name, parts, 1)
        to, *others = operands

        def read(i, k=kind):
            return self._read(others[i], k)

        floating, signed = kind.startswith("f"), kind.startswith("s")
        if name == "high":
            value = b.trunc(b.lshr(self._read(others[0], "b64"), I64(32)), I32)
        elif name == "bfe":
            assert kind == "u32", line
            value = b.and_(b.lshr(read(0), I32(int(others[1]))), I32(2 ** int(others[2]) - 1))
        elif name == "mov" and others[0].startswith("{"):
            low, high = (b.zext(self._read(x, "b32"), I64) for x in re.findall(r"[%\w]+", others[0]))
            value = b.or_(low, b.shl(high, I64(32)))
        elif name in ("mov", "cvta"):
            k = "b64" if name == "cvta" else kind
            value = self._read(others[0], k)
        elif name == "setp":
            relation = parts[1]
            x, y = read(0), read(1)
            sign = {
                "eq": "==",
                "ne": "!=",
                "lt": "<",
                "le": "<=",
                "gt": ">",
                "ge": ">=",
                "lo": "<",
                "ls": "<=",
                "hi": ">",
                "hs": ">=",
            }
            if not floating:
                value = (b.icmp_signed if signed else b.icmp_unsigned)(sign[relation], x, y)
            elif relation in ("nan", "num"):
                value = b.fcmp_unordered("uno", x, y) if relation == "nan" else b.fcmp_ordered("ord", x, y)
            elif relation.endswith("u"):
                value = b.fcmp_unordered(sign[relation[:-1]], x, y)
            else:
                value = b.fcmp_ordered(sign[relation], x, y)
        elif name == "selp":
            value = b.select(self._read(others[2], "pred"), read(0), read(1))
        elif name in ("and", "or", "xor"):
            value = getattr(b, name + ("" if name == "xor" else "_"))(read(0), read(1))
        elif name == "not":
            value = b.not_(read(0))
        elif name in ("shl", "shr"):
            by = self._read(others[1], "b32")
            by = b.zext(by, I64) if _NUMBERS[kind] is I64 else by
            value = getattr(b, {"shl": "shl", "shr": "ashr" if signed else "lshr"}[name])(read(0), by)
        elif floating and name in ("add", "sub", "mul", "div"):
            value = getattr(b, "f" + name)(read(0), read(1))
        elif floating and name in ("fma", "max", "min", "abs", "sqrt"):
            known = {
                "fma": "fma",
                "max": "maximum" if "NaN" in parts else "maxnum",
                "min": "minnum",
                "abs": "fabs",
                "sqrt": "sqrt",
            }
            value = self._intrinsic(known[name], *(read(i) for i in range(len(others))))
        elif name == "neg":
            value = b.fneg(read(0)) if floating else b.neg(read(0))
        elif name == "rcp":
            value = b.fdiv(ir.Constant(_NUMBERS[kind], 1.0), read(0))
        elif name in ("min", "max"):
            compare = b.icmp_signed if signed else b.icmp_unsigned
            value = b.select(compare("<" if name == "min" else ">", read(0), read(1)), read(0), read(1))
        elif name in ("add", "sub"):
            value = getattr(b, name)(read(0), read(1))
        elif name == "mul" and "lo" in parts:
            value = b.mul(read(0), read(1))
        elif name == "mul" and "hi" in parts:
            wide, extend = ir.IntType(2 * _NUMBERS[kind].width), b.sext if signed else b.zext
            product = b.mul(extend(read(0), wide), extend(read(1), wide))
            value = b.trunc(b.lshr(product, ir.Constant(wide, wide.width // 2)), _NUMBERS[kind])
        elif name in ("mul", "mad") and "wide" in parts:
            extend = b.sext if signed else b.zext
            value = b.mul(extend(read(0), I64), extend(read(1), I64))
            value = b.add(value, self._read(others[2], "b64")) if name == "mad" else value
        elif name == "mad" and "lo" in parts:
            value = b.add(b.mul(read(0), read(1)), read(2))
        elif name == "atom":
            place, _ = self._address(others[0])
            value = b.atomic_rmw("add", place, self._read(others[1], kind), "monotonic")
        elif name == "cvt":
            value = self._convert(parts, others[0])
        else:
            raise NotImplementedError(line)
        self._write(to, value)

    def _convert(self, parts, x):
        b, (after, before) = self.b, parts[-2:]
        value, t, floats = self._read(x, before), _NUMBERS[after], ("f64", "f32")
        if before == after and before in floats:
            return self._intrinsic({"rni": "rint", "rmi": "floor", "rpi": "ceil", "rzi": "trunc"}[parts[1]], value)
        if before in floats and after in floats:
            return (b.fptrunc if after == "f32" else b.fpext)(value, t)
        if before in floats:
            if parts[1] == "rni":
                value = self._intrinsic("rint", value)
            return (b.fptosi if after.startswith("s") else b.fptoui)(value, t)
        if after in floats:
            return (b.sitofp if before.startswith("s") else b.uitofp)(value, t)
        if t.width < value.type.width:
            return b.trunc(value, t)
        return (b.sext if before.startswith("s") else b.zext)(value, t) if t.width > value.type.width else value
