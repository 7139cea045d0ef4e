"""The names that code reads, from its byte code: globals, attributes, and modules that it imports."""

import dis
import functools
import types
from typing import NamedTuple

# What makes names up while it runs: where code uses one of these, any attribute may be read.
_REFLECTING = frozenset(
    "getattr setattr hasattr vars dir globals locals eval exec __dict__ __getattribute__ asdict astuple fields "
    "attrgetter inspect".split()
)
_OF_GLOBALS = frozenset("LOAD_NAME STORE_NAME DELETE_NAME LOAD_FROM_DICT_OR_GLOBALS".split())


class ReadNames(NamedTuple):
    """The names in code, those in the functions inside of it included.

    `globals`; `attributes`; `imports`, each (level, module, names taken from it); `stored`: globals, free variables and
    attributes that it sets; `reflects`: whether it makes names up.
    """

    globals: frozenset[str]
    attributes: frozenset[str]
    imports: tuple[tuple[int, str, tuple[str, ...]], ...]
    stored: frozenset[str]
    reflects: bool


@functools.lru_cache(maxsize=4096)
def names_of(code: types.CodeType) -> ReadNames:
    """The names in a code object, found once for each."""
    found: dict[str, set] = {"globals": set(), "attributes": set(), "stored": set()}
    imports: list[tuple[int, str, tuple[str, ...]]] = []
    before: list = [None, None]  # what was loaded last: the level of an import, and what is taken from the module
    for step in dis.get_instructions(code):
        operation, name = step.opname, step.argval
        if operation == "IMPORT_NAME":
            level, taken = before
            imports.append((level if isinstance(level, int) else 0, name, taken if isinstance(taken, tuple) else ()))
        elif operation in _OF_GLOBALS or operation.endswith("_GLOBAL"):
            found["globals"].add(name)
        elif operation.endswith(("_ATTR", "_METHOD")) or operation == "IMPORT_FROM":
            found["attributes"].add(name[-1] if isinstance(name, tuple) else name)
        if operation.startswith(("STORE_", "DELETE_")) and isinstance(name, str):
            found["stored"].add(name)
        if operation.startswith("LOAD_"):
            before = [before[1], name]
    for inner in (names_of(x) for x in code.co_consts if isinstance(x, types.CodeType)):
        for kind, names in found.items():
            names |= getattr(inner, kind)
        imports += inner.imports
    reflects = bool(_REFLECTING & (found["globals"] | found["attributes"]))
    sets = {kind: frozenset(names) for kind, names in found.items()}
    return ReadNames(sets["globals"], sets["attributes"], tuple(imports), sets["stored"], reflects)
