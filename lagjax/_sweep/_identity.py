"""What a function or a value is, in words: its code, and all that it uses from outside, however far away that is.

Two values with one text compute the same; so a store can tell whether `keep` is still the function it was begun with.
The text of a value that went to another process by cloudpickle is the same there: no address, no order of a set, and
nothing of what libraries keep for themselves enters. What is of an installed package is named, not read.
"""

import dataclasses
import functools
import hashlib
import inspect
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import PurePath
from typing import Any

import jax
import numpy as np

_LONG = 400  # characters of a value that is shown; of a longer one its hash
_DEEP = 50  # containers within containers: one that is deeper contains itself
_ATOMS = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), slice, range)
_OWN_METHODS = ("__call__", "__init__", "__post_init__", "__getitem__", "__getattr__")


def identity(value: Any) -> str:
    """The text of a function or a value: a line for each function, class and object that is met."""
    walk = _Walk()
    lines = [walk.name(value)]
    for k, (thing, _) in enumerate(walk.things):  # which grows meanwhile
        lines.append(f"#{k} {walk.line(thing)}")
    return "\n".join(lines)


class _Walk:
    """Functions, classes and objects in the order in which they are met; each of them is described once."""

    def __init__(self):
        self.things: list[tuple[Any, int]] = []  # held, so that no address is used twice
        self._numbers: dict[int, int] = {}

    def name(self, value: Any, deep: int = 0) -> str:
        """A value in words; of functions, classes and objects a number, by which their line is found."""
        if isinstance(value, _ATOMS):
            return _short(repr(value))
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return array_text(value)
        if isinstance(value, Mapping | list | tuple | set | frozenset) and deep < _DEEP:
            return _short(self._container(value, deep + 1))
        if isinstance(value, types.ModuleType):
            return value.__name__
        if (name := _library_name(value)) is not None:
            return name
        if id(value) not in self._numbers:
            self._numbers[id(value)] = len(self.things)
            self.things.append((value, id(value)))
        return f"#{self._numbers[id(value)]}"

    def _container(self, value: Any, deep: int) -> str:
        kind = "" if type(value) in (dict, list, tuple, set, frozenset) else self.name(type(value))
        if isinstance(value, Mapping):
            return kind + "{" + ", ".join(f"{k!r}: {self.name(x, deep)}" for k, x in value.items()) + "}"
        if isinstance(value, set | frozenset):
            return kind + "{" + ", ".join(sorted(self.name(x, deep) for x in value)) + "}"
        return kind + "[" + ", ".join(self.name(x, deep) for x in value) + "]"

    def line(self, thing: Any) -> str:
        """What a function, a class or an object consists of."""
        if isinstance(thing, types.FunctionType):
            return self._parts("function", self._of_function(thing))
        if isinstance(thing, type):
            return self._parts(f"class {thing.__qualname__}", self._of_class(thing))
        if isinstance(thing, types.MethodType):
            return self._parts("method", [("of", thing.__self__), ("function", thing.__func__)])
        if isinstance(thing, functools.partial):
            return self._parts("partial", [("of", thing.func), ("args", thing.args), ("keywords", thing.keywords)])
        if (inner := _wrapped(thing)) is not None:
            return self._parts("wrapped", [("function", inner)])
        return self._parts(self.name(type(thing)), _state(thing))

    def _parts(self, kind: str, parts) -> str:
        return "\n".join([kind, *(f"    {name} = {self.name(value)}" for name, value in parts)])

    def _of_function(self, function: types.FunctionType) -> Iterator[tuple[str, Any]]:
        """The byte code of a function, its defaults, and what it uses from outside; of a library's the last alone."""
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        inside = {name: cell.cell_contents for name, cell in cells if _is_filled(cell)}
        if not _is_users(function.__module__):
            yield from [("name", f"{function.__module__}.{function.__qualname__}"), *inside.items()]
            return
        names = _names_in(function.__code__)
        outside = {name: function.__globals__[name] for name in sorted(names) if name in function.__globals__}
        yield "code", _code_text(function.__code__)
        yield "defaults", [function.__defaults__, function.__kwdefaults__]
        yield from sorted(_with_attributes(inside | outside, names).items())

    def _of_class(self, kind: type) -> Iterator[tuple[str, Any]]:
        """The methods of a class of the user, its numbers, and the classes that it extends."""
        yield "bases", list(kind.__bases__)
        for name, value in sorted(vars(kind).items()):
            if isinstance(value, staticmethod | classmethod):
                value = value.__func__
            elif isinstance(value, property):
                value = value.fget
            own = name in _OWN_METHODS or not name.startswith("_")
            if own and (callable(value) or isinstance(value, (*_ATOMS, np.ndarray, tuple, list, dict))):
                yield name, getattr(value, "method", value)  # equinox wraps those of its modules


def _state(thing: Any) -> list[tuple[str, Any]]:
    """What an object holds; where it is of a library's class, what that shows."""
    try:
        return [("values", np.asarray(thing))] if hasattr(thing, "__array__") else _attributes(thing)
    except Exception:  # an object of its own kind, such as a set of tables
        return _attributes(thing)


def _attributes(thing: Any) -> list[tuple[str, Any]]:
    if dataclasses.is_dataclass(thing):
        return [(x.name, getattr(thing, x.name, None)) for x in dataclasses.fields(thing)]
    slots = [name for kind in type(thing).__mro__ for name in _as_tuple(kind.__dict__.get("__slots__", ()))]
    held = {name: getattr(thing, name) for name in slots if hasattr(thing, name)} | getattr(thing, "__dict__", {})
    if not _is_users(type(thing).__module__):
        held = {name: x for name, x in held.items() if not name.startswith("_") or _is_plain(x)}  # not its caches
    return sorted(held.items()) if held else [("shown", without_addresses(repr(thing)))]


def _is_plain(value: Any) -> bool:
    return isinstance(value, int | float | complex | str | np.ndarray | jax.Array)


def _as_tuple(slots: Any) -> tuple[str, ...]:
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _with_attributes(used: dict[str, Any], names: set[str]) -> dict[str, Any]:
    """What is used by name, with what is asked of the user's modules among it: of `helpers.f` the function."""
    found, waiting, modules = dict(used), list(used.items()), set()
    for path, value in waiting:  # which grows meanwhile
        if isinstance(value, types.ModuleType) and _is_users(value.__name__) and value.__name__ not in modules:
            modules.add(value.__name__)
            more = {f"{path}.{name}": vars(value)[name] for name in sorted(names) if name in vars(value)}
            found |= more
            waiting += more.items()
    return found


def _wrapped(thing: Any) -> Any:
    """The function within one that `functools.wraps` or `jax.jit` made; None of others.

    What jax.jit returns has no `__wrapped__` any more once it came from another process.
    """
    state = thing.__getstate__() if type(thing).__name__ == "PjitFunction" else {}
    return getattr(thing, "__wrapped__", state.get("fun"))


def _is_filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:  # of a name that is assigned later
        return False


def _library_name(value: Any) -> str | None:
    """The name of a function or a class of a library, or of one that is written in C; None of others."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str):
        return None
    if isinstance(value, types.FunctionType) and (value.__closure__ or "<locals>" in name):
        return None
    compiled = not isinstance(value, type | types.FunctionType | types.MethodType) and _wrapped(value) is None
    return f"{module}.{name}" if compiled or not _is_users(module) else None


@functools.lru_cache(maxsize=1024)
def _is_users(module: str | None) -> bool:
    """Whether a module is the user's: not of Python, and not of an installed package."""
    root = (module or "__main__").split(".")[0]
    if root == "__main__":  # whatever started it
        return True
    if root in sys.stdlib_module_names or root == "lagjax":
        return False
    places = getattr(sys.modules.get(root), "__file__", None) or ""
    return not {"site-packages", "dist-packages"} & set(PurePath(places).parts)


# ---- words -----------------------------------------------------------------------------------------------------------


def source(function: Callable) -> str:
    """The lines of a function, or its name where there are none to be read."""
    while isinstance(function, functools.partial):
        function = function.func
    try:
        return inspect.cleandoc("\n" + inspect.getsource(function))
    except Exception:  # written in C, or at a prompt; of an object with __call__ its class is read
        name = getattr(function, "__qualname__", type(function).__qualname__)
        return f"<{name}, whose text cannot be read>"


def array_text(value: Any) -> str:
    """An array in words, a large one by its hash."""
    try:
        array = np.asarray(value)
    except TypeError:  # keys of jax.random
        array = np.asarray(jax.random.key_data(value))
    if array.dtype == object:
        return without_addresses(_short(repr(array.tolist())))
    return f"{array.dtype} {array.tolist()}" if array.size <= 16 else f"{array.dtype}{array.shape} {hash_of(array)}"


def hash_of(array: np.ndarray) -> str:
    """Sixteen digits of the SHA-256 of an array's bytes."""
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def without_addresses(text: str) -> str:
    """A text without the places of objects in memory."""
    return re.sub(r"0x[0-9a-f]+", "0x", text)


def _short(text: str) -> str:
    return text if len(text) <= _LONG else f"{text[:40]}… {hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _names_in(code: types.CodeType) -> set[str]:
    inner = (_names_in(x) for x in code.co_consts if isinstance(x, types.CodeType))
    return set(code.co_names).union(*inner)


def _code_text(code: types.CodeType) -> str:
    """A hash of what a function does, its numbers and names included; not of where it stands."""
    inner = [_code_text(x) if isinstance(x, types.CodeType) else _constant(x) for x in code.co_consts]
    text = "\n".join([code.co_code.hex(), repr(code.co_names), repr(code.co_varnames), *inner])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _constant(x: Any) -> str:
    return repr(sorted(map(repr, x))) if isinstance(x, frozenset) else repr(x)
