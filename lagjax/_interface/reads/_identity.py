"""`Walk`: a function or a value as text, with its code and all values that it uses, directly or through helpers.

Two values with the same text compute the same, so a stored sweep can detect that `keep` has changed. The text is the
same in another process, after cloudpickle: it contains no addresses, no order of sets, and no internal state of
libraries. Of installed packages it has only the names.
"""

import array
import collections
import dataclasses
import dis
import enum
import functools
import hashlib
import importlib.util
import inspect
import math
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import PurePath
from typing import Any

import jax
import numpy as np

from lagjax._interface.reads._marks import ABSENT, SIZE

_LONG = 400  # characters of a value that is shown; of a longer one its hash
_DEEP = 50  # containers within containers: one that is deeper contains itself
_ATOMS = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), slice, range)
_CONSTRUCTING = frozenset(
    "__init__ __new__ __post_init__ __init_subclass__ __class_getitem__ __repr__ __str__ __del__".split()
)
CHANGING = "what the function itself changes"  # in the place of such a value


def identity(value: Any) -> str:
    """Return the text of a function or a value: a line for each function, class and object that is visited."""
    return Walk().text(value)


class Walk:
    """Visits functions, classes and objects, and describes each once; of attributes those in `wanted`, None for all.

    A subclass may intercept `read`; things that are too large or have no text are compared by identity, in `held`.
    """

    containers: tuple[type, ...] = (Mapping, list, tuple, set, frozenset, collections.deque)
    most_things = largest_container = math.inf

    def __init__(self, wanted: set[str] | None = None):
        self.wanted, self.things = wanted, []  # held, so that no address is used twice
        self.held: list[Any] = []
        self.code = ReadNames()  # of all functions that were met
        self.of_libraries: set[int] = set()  # attributes of objects that may remember what they like
        self._numbers: dict[int, int] = {}

    def read(self, place: Any, key: Any, value: Any) -> Any:
        """Return the value found at `key` of a dict or object, or in a cell; or `CHANGING` to leave it out."""
        # With the key None it is the place itself.
        return value

    def describe_array(self, value: Any) -> str:
        return array_text(value)

    def wants(self, name: str, value: Any, owner: Any) -> bool:
        """True if an attribute of a user's object, class or function may be read by the code that was visited."""
        if isinstance(value, functools.cached_property):
            self.code.stored.add(name)
        if self.wanted is None or name in self.wanted or isinstance(owner, enum.EnumType):
            return True
        if isinstance(owner, type) and name in _CONSTRUCTING:
            return owner.__name__ in self.wanted
        return isinstance(owner, type) and name.startswith("__")

    def hold(self, thing: Any) -> str:
        """Add a thing to `held`, to be compared by identity, and return its name."""
        return f"{type(thing).__qualname__} {index_of(self.held, thing)}"

    # ---- the walk ----

    def text(self, value: Any) -> str:
        """Return the description of a value, followed by a line for every numbered thing in it."""
        lines = [self.name(value)]
        for k, thing in enumerate(self.things):  # which grows meanwhile
            lines.append(f"#{k} {self.line(thing)}")
        return "\n".join(lines)

    def name(self, value: Any, deep: int = 0) -> str:
        """Return a short text for a value; for functions, classes and objects a number that refers to their line."""
        kind = type(value)
        if kind in _ATOMS:
            return shorten_text(repr(value))
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return self.describe_array(value)
        if isinstance(value, enum.Enum):
            return f"{self.name(kind)}.{value.name} = {self.name(value.value, deep + 1)}"
        if isinstance(value, _ATOMS):  # of a class of its own
            base: Any = next(base for base in _ATOMS if isinstance(value, base))
            return f"{self.name(kind)} {shorten_text(base.__repr__(value))}"
        if isinstance(value, bytearray | array.array):
            return self.name(type(value)) + self.describe_array(self.read(value, None, np.array(value)))
        if isinstance(value, self.containers) and deep < _DEEP:
            return shorten_text(self.container(value, deep + 1))
        if isinstance(value, types.ModuleType):
            return value.__name__
        if (name := _library_name(value)) is not None:
            return name
        if id(value) not in self._numbers:  # of a function, a class or an object, whose line comes later
            if len(self.things) >= self.most_things:
                return self.hold(value)
            self._numbers[id(value)] = len(self.things)
            self.things.append(value)
        return f"#{self._numbers[id(value)]}"

    def container(self, value: Any, deep: int) -> str:
        """Return the text of a container with all its entries; `deep` is the depth of nesting."""
        if (value := self.read(value, None, value)) is CHANGING:
            return CHANGING
        if len(value) > self.largest_container:
            return f"{len(value)} in {self.hold(value)}"
        kind = "" if type(value) in (dict, list, tuple, set, frozenset) else self.name(type(value))
        if isinstance(value, Mapping):
            pairs = [f"{strip_addresses(repr(k))}: {self.name(x, deep)}" for k, x in list(value.items())]
            return kind + "{" + ", ".join(pairs) + "}"
        if isinstance(value, set | frozenset):
            return kind + "{" + ", ".join(sorted(self.name(x, deep) for x in list(value))) + "}"
        return kind + "[" + ", ".join(self.name(x, deep) for x in list(value)) + "]"

    def line(self, thing: Any) -> str:
        if isinstance(thing, types.FunctionType):
            return self._parts("function", self._function_parts(thing))
        if isinstance(thing, type):
            return self._parts(f"class {thing.__name__}", self._class_parts(thing))
        if isinstance(thing, types.MethodType):
            return self._parts("method", [("of", thing.__self__), ("function", thing.__func__)])
        if isinstance(thing, functools.partial):
            return self._parts("partial", [("of", thing.func), ("args", thing.args), ("keywords", thing.keywords)])
        if isinstance(thing, property):
            return self._parts("property", [("get", thing.fget)])
        if (inner := _unwrap_function(thing)) is not None:
            return self._parts("wrapped", [("function", inner), *self._function_attributes(thing)])
        return self._parts(self.name(type(thing)), self._attribute_values(thing))

    def _parts(self, kind: str, parts) -> str:
        return "\n".join([kind, *(f"    {name} = {self.name(value)}" for name, value in parts)])

    def _function_parts(self, function: types.FunctionType) -> Iterator[tuple[str, Any]]:
        """Yield the byte code, defaults and closure of a function; of a library's function only the closure."""
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        inside = {name: self.read(cell, name, cell.cell_contents) for name, cell in cells if _is_cell_filled(cell)}
        if not _is_users(function.__module__):
            yield "name", f"{function.__module__}.{function.__qualname__}"
            yield "code", code_text(function.__code__)  # functions made by one function have one name
            yield from inside.items()
            return
        names, outer = names_of(function.__code__), function.__globals__
        self.code.add(names)
        outside = {name: self.read(outer, name, outer.get(name, ABSENT)) for name in sorted(names.globals)}
        outside = {name: value for name, value in outside.items() if value is not ABSENT}
        imported = {"." * level + name: _import_module(outer, level, name) for level, name in names.imports}
        used = inside | outside | {name: module for name, module in imported.items() if module is not None}
        yield "code", code_text(function.__code__)
        yield "defaults", (function.__defaults__, function.__kwdefaults__)
        yield from sorted(self._add_module_attributes(used, names.attributes | names.globals).items())
        yield from self._function_attributes(function)

    def _function_attributes(self, function: Any) -> list[tuple[str, Any]]:
        held, is_plain = getattr(function, "__dict__", {}), isinstance(function, types.FunctionType)
        return [
            (f".{name}", self.read(held, name, x))
            for name, x in sorted(held.items())
            if name != "__wrapped__" and (is_plain or not name.startswith("_")) and self.wants(name, x, function)
        ]

    def _add_module_attributes(self, used: dict[str, Any], names: set[str]) -> dict[str, Any]:
        """Add to the values `used` the attributes `names` of the user's modules among them, as of `helpers.f`."""
        found, waiting, modules = dict(used), list(used.items()), set()
        for path, value in waiting:  # which grows meanwhile
            if isinstance(value, types.ModuleType) and _is_users(value.__name__) and value.__name__ not in modules:
                modules.add(value.__name__)
                held = vars(value)
                more = {f"{path}.{name}": self.read(held, name, held[name]) for name in sorted(names) if name in held}
                found |= more
                waiting += more.items()
        return found

    def _class_parts(self, kind: type) -> Iterator[tuple[str, Any]]:
        """Yield the bases and the attributes of a user's class."""
        yield "bases", [*kind.__bases__, *([] if type(kind) is type else [type(kind)])]
        held = kind.__dict__
        for name, value in sorted(held.items()):
            # A method of a module of equinox is wrapped.
            place = "__func__" if isinstance(value, staticmethod | classmethod) else "method"
            inner: Any = getattr(value, place, value)
            if _is_class_boilerplate(name, inner) and self.wants(name, inner, kind):
                yield name, CHANGING if self.read(kind, name, value) is CHANGING else inner

    def _attribute_values(self, thing: Any) -> list[tuple[str, Any]]:
        """Return the attributes of an object by name; of one that converts to an array, its values."""
        inside, users = getattr(thing, "__dict__", {}), _is_users(type(thing).__module__)
        try:
            if hasattr(type(thing), "__array__") and not users:
                return [("values", self.read(thing, None, np.asarray(thing)))]
        except Exception:  # an object of its own kind, such as a set of tables
            pass
        if not isinstance(inside, dict):
            inside = {}
        if dataclasses.is_dataclass(thing):
            fields = [x.name for x in dataclasses.fields(thing)]
            held = {name: inside[name] if name in inside else getattr(thing, name, None) for name in fields}
        else:
            slots = [kind.__dict__.get("__slots__", ()) for kind in type(thing).__mro__]
            slots = [name for names in slots for name in ((names,) if isinstance(names, str) else names)]
            held = {name: getattr(thing, name) for name in slots if hasattr(thing, name)} | inside
            if users:
                held = {name: x for name, x in held.items() if self.wants(name, x, thing)}
            else:  # not its caches, unless there is nothing else, as in what delegates to another object
                held = {
                    name: x
                    for name, x in held.items()
                    if not name.startswith("_") or isinstance(x, (int, float, complex, str, np.ndarray, jax.Array))
                } or held
        held = {name: self.read(inside if name in inside else thing, name, x) for name, x in held.items()}
        if not held and not users:
            return self._describe_opaque(thing)
        self.read(inside, SIZE, None)
        if not users:
            self.of_libraries.add(id(inside))
        return sorted(held.items())

    def _describe_opaque(self, thing: Any) -> list[tuple[str, Any]]:
        """Return the `repr` of an object without readable attributes, added to `held` if that is not unique."""
        try:
            shown = repr(thing)
        except Exception:
            shown = f"{type(thing).__qualname__} at 0x"
        if " at 0x" in shown.lower():
            self.hold(thing)
        return [("shown", strip_addresses(shown))]


def index_of(things: list, thing: Any) -> int:
    """Return the index of this very object in a list; append it if it is not there."""
    for k, other in enumerate(things):
        if other is thing:
            return k
    things.append(thing)
    return len(things) - 1


def _is_cell_filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is cell.cell_contents
    except ValueError:  # of a name that is assigned later
        return False


# Attributes of every class, which say nothing that its code does not: methods of that kind enter, values do not.
def _is_class_boilerplate(name: str, value: Any) -> bool:
    is_dunder = name.startswith("__") and name.endswith("__")
    if is_dunder:
        return isinstance(value, types.FunctionType | property)
    return not isinstance(value, types.MemberDescriptorType | types.GetSetDescriptorType) and name != "_abc_impl"


def _import_module(names: dict[str, Any], level: int, name: str) -> types.ModuleType | None:
    """Import the module that an import inside a function with these globals names; None if there is none."""
    try:
        full = name if not level else importlib.util.resolve_name("." * level + name, names.get("__package__"))
        return importlib.import_module(full) if _is_users(full) else sys.modules.get(full)
    except Exception:  # whatever the user's module raises, it will raise again where the function is called
        return None


def _unwrap_function(thing: Any) -> Any:
    """Return the function inside one made by `functools.wraps` or `jax.jit`; None for others."""
    # What jax.jit returns has no `__wrapped__` any more once it came from another process.
    state = thing.__getstate__() if type(thing).__name__ == "PjitFunction" else {}
    return getattr(thing, "__wrapped__", state.get("fun"))


def _library_name(value: Any) -> str | None:
    """Return the qualified name of a library's or C function or class; None for the user's own."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str):
        return None
    if isinstance(value, types.FunctionType) and (value.__closure__ or "<" in name):
        return None
    compiled = not isinstance(value, type | types.FunctionType | types.MethodType) and _unwrap_function(value) is None
    return f"{module}.{name}" if compiled or not _is_users(module) else None


@functools.lru_cache(maxsize=1024)
def _is_users(module: str | None) -> bool:
    """True if a module is the user's: not of Python's library, and not of an installed package."""
    root = (module or "__main__").split(".")[0]
    if root == "__main__":  # whatever started it
        return True
    if root in sys.stdlib_module_names or root == "lagjax":
        return False
    places = getattr(sys.modules.get(root), "__file__", None) or ""
    return not {"site-packages", "dist-packages"} & set(PurePath(places).parts)


# ---- names in code ---------------------------------------------------------------------------------------------------

# What makes names up while it runs: where code uses one of these, any attribute may be read.
_REFLECTING = frozenset(
    "getattr setattr hasattr vars dir globals locals eval exec __dict__ __getattribute__ asdict astuple fields "
    "attrgetter inspect".split()
)
_OF_GLOBALS = frozenset("LOAD_NAME STORE_NAME DELETE_NAME LOAD_FROM_DICT_OR_GLOBALS".split())


@dataclasses.dataclass
class ReadNames:
    """The names that occur in code, including its inner functions."""

    globals: set[str] = dataclasses.field(default_factory=set)
    attributes: set[str] = dataclasses.field(default_factory=set)
    stored: set[str] = dataclasses.field(default_factory=set)  # globals, free variables and attributes that it sets
    imports: set[tuple[int, str]] = dataclasses.field(default_factory=set)  # level and module

    @property
    def reflects(self) -> bool:
        return bool(_REFLECTING & (self.globals | self.attributes))

    def add(self, other: "ReadNames") -> None:
        for field in dataclasses.fields(self):
            getattr(self, field.name).update(getattr(other, field.name))


@functools.lru_cache(maxsize=4096)
def names_of(code: types.CodeType) -> ReadNames:
    names, last_but_one, last = ReadNames(), None, None  # loaded before an import: its level, and what is taken
    for step in dis.get_instructions(code):
        operation, name = step.opname, step.argval
        if operation == "IMPORT_NAME":
            names.imports.add((last_but_one if isinstance(last_but_one, int) else 0, name))
        elif operation in _OF_GLOBALS or operation.endswith("_GLOBAL"):
            names.globals.add(name)
        elif operation.endswith(("_ATTR", "_METHOD")) or operation == "IMPORT_FROM":
            names.attributes.add(name[-1] if isinstance(name, tuple) else name)
        if operation.startswith(("STORE_", "DELETE_")) and isinstance(name, str):
            names.stored.add(name)
        if operation.startswith("LOAD_"):
            last_but_one, last = last, name
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            names.add(names_of(inner))
    return names


# ---- words -----------------------------------------------------------------------------------------------------------


def source_text(function: Callable) -> str:
    """Return the source text of a function, or its name if there is none."""
    while isinstance(function, functools.partial):
        function = function.func
    try:
        return inspect.cleandoc("\n" + inspect.getsource(function))
    except Exception:  # written in C, or at a prompt; of an object with __call__ its class is read
        name = getattr(function, "__qualname__", type(function).__qualname__)
        return f"<{name}, whose text cannot be read>"


def array_text(value: Any) -> str:
    try:
        array = np.asarray(value)
    except TypeError:  # keys of jax.random
        array = np.asarray(jax.random.key_data(value))
    if array.dtype == object:
        return strip_addresses(shorten_text(repr(array.tolist())))
    return f"{array.dtype} {array.tolist()}" if array.size <= 16 else f"{array.dtype}{array.shape} {hash_of(array)}"


def hash_of(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def strip_addresses(text: str) -> str:
    return re.sub(r"0x[0-9a-f]+", "0x", text)


def shorten_text(text: str) -> str:
    return text if len(text) <= _LONG else f"{text[:40]}… {hashlib.sha256(text.encode()).hexdigest()[:16]}"


@functools.lru_cache(maxsize=4096)
def code_text(code: types.CodeType) -> str:
    """Return a hash of what a function does, with its constants and names; independent of its line numbers."""
    shown = [sorted(map(repr, x)) if isinstance(x, frozenset) else x for x in code.co_consts]
    inner = [code_text(x) if isinstance(x, types.CodeType) else repr(x) for x in shown]
    text = "\n".join([code.co_code.hex(), repr(code.co_names), repr(code.co_varnames), *inner])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
