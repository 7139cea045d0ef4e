"""`Description`: what a sweep computes for each member; its text, by which stores are compared; how workers get it.

A worker in another process gets the functions by cloudpickle: those of the user's script by value, those of modules by
name, found along the same `sys.path`. Whether they are unchanged since the store was begun is decided by their jaxprs,
with every constant: a change of a global number changes these, though not the text of a function. For what JAX does not
trace here, `keep` above all, `reads.identity` decides it: the code, and all that it uses.
"""

import difflib
import inspect
import json
import pickle
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine.taylor import MachineCode
from lagjax._interface import accept, output_times, require_budget
from lagjax._interface.reads import array_text, hash_of, identity, source_text, strip_addresses
from lagjax._run import directions_of, sections_of
from lagjax._run.hybrid import Hybrid, Scene
from lagjax._scene import ARGUMENTS, ROLES
from lagjax._show import import_package
from lagjax._sweep._members import Axis, describe_axes
from lagjax._sweep._statistics import Statistics

MOTION = (*ROLES, "q0", "qdot0", "params")  # what a motion depends on, besides its tolerances
NOT_TRACEABLE = (jax.errors.JAXTypeError, jax.errors.JAXIndexError)
_OF_EVENTS = ("direction", "root_finder")  # what a diffrax.Event has besides its condition
_ARGUMENTS = ("section", "direction", "count")
_SHOWN = 40  # lines of a difference


class Sections(NamedTuple):
    """Sections whose crossings are recorded: functions of (q, qdot) and, by name, `t` and `params`; directions.

    `names` are those of a dict of sections, None for one function; `count` is the most crossings recorded.
    """

    names: tuple[str, ...] | None
    functions: tuple[Callable, ...]
    directions: tuple[int, ...]
    count: int

    @classmethod
    def from_arguments(cls, crossings: Any, keep: Callable, settings: dict[str, Any]) -> "Sections | None":
        """Return the sections from the arguments of `sweep`; raise `TypeError` or `ValueError` if wrong."""
        takes_crossings = "crossings" in _parameter_names(keep)
        if crossings is None:
            if takes_crossings:
                raise ValueError("keep asks for `crossings`: say which, by crossings={'section': a function}.")
            return None
        if not isinstance(crossings, dict) or "section" not in crossings or not set(crossings) <= set(_ARGUMENTS):
            raise TypeError(
                "crossings must be a dict with arguments of lagjax.crossings: section, perhaps direction and count; "
                f"got {list(crossings) if isinstance(crossings, dict) else crossings!r}."
            )
        if not takes_crossings:
            raise ValueError(
                "crossings are found for keep, which does not ask for them by name: write keep(trajectory, crossings)."
            )
        if settings["event"] is not None:
            raise ValueError("An event ends the motion, and crossings do not: give one of the two.")
        if not isinstance(settings["solver"], MachineCode | None):
            raise ValueError("crossings are found in machine code: leave solver at None.")
        section = crossings["section"]
        names, _ = sections_of(section)
        require_budget(crossings.get("count", 64), "count")
        directions = directions_of(crossings.get("direction", 0), names)
        functions = (section,) if names is None else tuple(section.values())
        return cls(names, functions, directions, int(crossings.get("count", 64)))

    def named_functions(self) -> dict[str, Callable]:
        return dict(zip(self.names or ("section",), self.functions, strict=True))


def _parameter_names(keep: Callable) -> list[str]:
    try:
        return list(inspect.signature(keep).parameters)
    except (TypeError, ValueError):  # of what is written in C
        return []


class FinalStates(NamedTuple):
    """The names, in a member's point, of the leaves of the state from which its motion continues."""

    q: PyTree
    qdot: PyTree


@dataclass(frozen=True)
class Description:
    """The computation of each member: the scene, its start as values or functions of a point, and what is kept."""

    system: Scene
    ts: Any  # output times (T,), or a function of a point
    q0: Any
    qdot0: Any
    params: Any
    keep: Callable
    reduce: dict[str, Statistics]
    settings: dict[str, Any]  # of `simulate_batch`: rtol, atol, max_steps, event, solver
    sections: Sections | None = None  # whose crossings keep gets
    starts: FinalStates | None = None  # of motions that continue those of another store, instead of q0 and qdot0

    def evaluate_start(self, point: dict[str, Any]) -> tuple[PyTree, ...]:
        """Return (q0, qdot0, params) of the member at a point; raise `ValueError` if they use an unknown name."""
        return _evaluate_at(point, self.q0, self.qdot0, self.params)

    def count_outputs(self, point: dict[str, Any]) -> int:
        """Return the number of output times of every member; raise if those at this point are invalid."""
        (ts,) = _evaluate_at(point, self.ts)
        return len(output_times(ts, float))

    def shapes(self, names: list[str]) -> tuple[PyTree, ...]:
        """Return shapes of (q0, qdot0, params) for points with these names; values if they cannot be traced."""
        try:
            return jax.eval_shape(self.evaluate_start, {name: jnp.zeros(()) for name in names})
        except NOT_TRACEABLE:
            return self.evaluate_start({name: 0.5 for name in names})

    def described(self) -> dict:
        ts, solver, watched = self.ts, self.settings["solver"], self.sections
        shared = (
            None if callable(ts) else {"ends": [*map(float, ts[[0, -1]])], "outputs": len(ts), "sha256": hash_of(ts)}
        )
        return {
            "ts": shared,
            **{name: _value_text(self.settings[name]) for name in ("rtol", "atol", "max_steps")},
            "solver": None if solver is None else identity(solver),
            "crossings": watched and {name: getattr(watched, name) for name in ("names", "directions", "count")},
            "reduce": {name: how.described() for name, how in self.reduce.items()},
        }


def _evaluate_at(point: dict[str, Any], *values) -> tuple[PyTree, ...]:
    """Return the values; of functions, their values at a point. Raise `ValueError` if they use an unknown name."""
    try:
        return tuple(x(point) if callable(x) else x for x in values)
    except KeyError as why:
        if why.args[:1] and why.args[0] in point:
            raise
        raise ValueError(
            f"ts, q0, qdot0 or params asks for {why}: a point has the names of `over`, which are {', '.join(point)}."
        ) from why


def uses_doubles() -> bool:
    return jax.dtypes.canonicalize_dtype(np.float64) == np.float64


# ---- text and hash ---------------------------------------------------------------------------------------------------


def describe_functions(description: Description, names: list[str]) -> dict[str, dict[str, str]]:
    """Return the text of every function and value, and its jaxpr as text (its code where JAX cannot trace it)."""
    point = {name: jnp.zeros(()) for name in names}
    q, qdot, params = description.shapes(names)
    entries = {}
    for name, function in _scene_functions(description.system).items():
        arguments = (q, qdot)[: len(ARGUMENTS.get(name.split()[0], (q, qdot)))]
        entries[name] = _entry(function.code.function, _defer_trace(function, arguments, params), function.arrays)
    if isinstance(scene := description.system, Hybrid):  # its modes and transitions without their functions
        arrows = [(t.source, t.target, t.direction) for t in scene.transitions]
        entries["transitions"] = _entry([list(scene.modes), scene.start, scene.max_transitions, arrows], None)
    if (event := description.settings.get("event")) is not None:
        condition = getattr(event, "cond_fn", event)
        of_event = _defer_trace(accept(condition, "event"), (q, qdot), params) if callable(condition) else None
        entries["event"] = _entry(condition, of_event)
        entries["event"]["program"] += "\n" + identity([getattr(event, name, None) for name in _OF_EVENTS])
    for name, section in description.sections.named_functions().items() if description.sections else ():
        of_section = _defer_trace(accept(section, "section"), (q, qdot), params)
        entries[f"crossings of {name}"] = _entry(section, of_section)
    for role in ("q0", "qdot0", "params", *(["ts"] if callable(description.ts) else [])):
        value = getattr(description, role)
        entries[role] = _entry(value, (lambda f=value: jax.make_jaxpr(f)(point)) if callable(value) else None)
    entries["keep"] = _entry(description.keep, None)
    return entries


def _scene_functions(scene: Scene) -> dict[str, Any]:
    """Return the functions of a scene by role; of a hybrid scene by role and mode, or by role and transition."""
    if not isinstance(scene, Hybrid):
        named = {role: getattr(scene, role) for role in ROLES}
    else:
        named = {f"{role} of {mode}": getattr(law, role) for mode, law in scene.modes.items() for role in ROLES}
        for k, transition in enumerate(scene.transitions):
            named |= {f"{role} of transition {k}": getattr(transition, role) for role in ("guard", "reset")}
    return {name: function for name, function in named.items() if function is not None}


def _defer_trace(function, arguments: tuple, params) -> Callable:
    def call(*roles, t, params):
        return function(*roles, t=t, params=params)

    return lambda: jax.make_jaxpr(call)(*arguments, t=jnp.zeros(()), params=params)


def _entry(value: Any, program: Callable | None, *more: Any) -> dict[str, str]:
    """Return {"text", "program"} of a function or value: the program is its jaxpr, else its code and all it uses."""
    text = source_text(value) if callable(value) else _value_text(value)
    try:
        closed = program() if program else None
    except Exception:  # not written in jax.numpy, or it needs leaves that are no numbers
        closed = None
    if closed is None:
        return {"text": text, "program": identity(value)}
    shown = strip_addresses(str(closed))
    constants = [_value_text(x) for x in [*closed.consts, *jax.tree.leaves(more)]]
    called = [identity(value)] if "callback" in shown else []  # functions that a program names, and does not hold
    return {"text": text, "program": "\n".join([shown, *constants, *called])}


def _value_text(value: PyTree) -> str:
    """Return a pytree of numbers as text, large arrays by their hash."""
    lines = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        text = array_text(leaf) if isinstance(leaf, jax.Array | np.ndarray) else strip_addresses(repr(leaf))
        lines.append(f"{jax.tree_util.keystr(path)} {text}".strip())
    return "\n".join(lines) or "None"


def _text_difference(before: dict[str, dict[str, str]], now: dict[str, dict[str, str]]) -> str | None:
    """Return the differences between the texts in a store and those of a call, line by line; None if none."""
    parts = []
    for role in dict.fromkeys([*before, *now]):
        old, new = (x.get(role, {"text": "", "program": ""}) for x in (before, now))
        if old["program"] == new["program"]:
            continue
        kind = "text" if old["text"] != new["text"] else "program"
        why = "" if kind == "text" else " (its text is the same; a value that it uses is not)"
        lines = list(difflib.unified_diff(old[kind].split("\n"), new[kind].split("\n"), "store", "now", "", "", 1, ""))
        parts.append("\n".join([f"{role}{why}:", *lines[2 : 2 + _SHOWN]]))
    return "\n".join(parts) or None


def compared_entries(axes: tuple[Axis, ...], description: Description) -> dict:
    """Return the entries of a store's description that are compared, as JSON stores them."""
    names = [name for axis in axes for name in axis.names]
    entries = {"axes": [axis.described() for axis in axes], "x64": uses_doubles(), **description.described()}
    return json.loads(json.dumps(entries | {"scene": describe_functions(description, names)}))


def differences(spec: dict, here: dict, entries: Iterable[str], roles: Iterable[str] | None = None) -> list[str]:
    """Return the differences between these entries of a store and of a call, as text; of the scene for some `roles`."""
    lines = []
    for name in entries:
        if name == "scene":
            before, now = ({x: of["scene"][x] for x in roles or of["scene"] if x in of["scene"]} for of in (spec, here))
            lines += [change] if (change := _text_difference(before, now)) else []
        elif spec[name] != here[name]:
            before, now = (describe_axes(x[name]) if name == "axes" else x[name] for x in (spec, here))
            lines.append(f"{name}: {before} in the store, now {now}")
    return lines


# ---- to another process ----------------------------------------------------------------------------------------------


def pack_description(description: Description) -> bytes:
    cloudpickle = import_package("sweep()", "cloudpickle", "cloudpickle")
    try:
        return cloudpickle.dumps(description)
    except Exception as why:
        raise TypeError(f"A function of this sweep cannot be sent to another process: {why}") from why


def unpack_description(data: bytes, path: list[str]) -> Description:
    """Unpickle a description, with the user's `path` for modules; raise `ImportError` if one is not found."""
    sys.path += [place for place in path if place not in sys.path]
    try:
        return pickle.loads(data)
    except (pickle.UnpicklingError, EOFError, ValueError, IndexError, KeyError, TypeError) as why:
        raise ValueError(
            f"The functions of this sweep, in its .sweep/scene.pkl, cannot be read ({type(why).__name__}: {why}): the "
            "file is damaged. Call `sweep` as before, without an executor: that does not read it."
        ) from why
    except (ImportError, AttributeError) as why:
        raise ImportError(
            f"The functions of this sweep cannot be rebuilt here: {why}. They were defined in a module that this "
            f"process does not find; put its folder on PYTHONPATH."
        ) from why


def users_path() -> list[str]:
    """Return the folders of `sys.path` that do not belong to Python or to installed packages."""
    own = {str(Path(sys.prefix).resolve()), str(Path(sys.base_prefix).resolve())}
    places = [str(Path(place or ".").resolve()) for place in sys.path]
    return [place for place in dict.fromkeys(places) if not any(place.startswith(prefix + "/") for prefix in own)]
