"""The call of a user's function: roles by position, extras by name.

Every function a user hands to lagjax takes its main arguments by position, so that they may have any name, and asks
for the time and the parameters by writing `t` and `params` in its signature, functions of a scene that is fitted to
records (`lagjax.fit`) also for their sampled `inputs`:

    def pendulum(q, qdot): ...
    def driven(q, qdot, t, params): ...

`accept` reads the signature once, when the scene is built, and refuses any other one with a sentence. A function that
does not ask for `t` never receives it: such a Lagrangian is autonomous by construction, not by inspection.
"""

import difflib
import functools
import inspect
import linecache
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from lagjax._interface.reads import Edition

_BY_POSITION = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_SHOWN = 40  # characters of a parameter, default and annotation included
_BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


class Function(eqx.Module):
    """A user's function and the optional arguments (`extras`) in its signature; callers pass all extras.

    It is split into its arrays, such as the weights of a neural Lagrangian, and the rest: `code` with what it reads
    (`reads.Edition`). The arrays are leaves, so that a scene can be an argument and a result of JAX transformations.
    """

    arrays: Any
    code: Edition = eqx.field(static=True)
    extras: tuple[str, ...] = eqx.field(static=True)

    @property
    def name(self) -> str:
        """The `__name__` of the user's function, or of its class."""
        code = self.code.function
        while isinstance(code, functools.partial):
            code = code.func
        return getattr(code, "__name__", type(code).__name__)

    def __call__(self, *roles: Any, **extras: Any) -> Any:
        """Call the function with the roles, by position, and with those of the extras that its signature has."""
        function = eqx.combine(self.arrays, self.code.function)
        if "inputs" in self.extras and "inputs" not in extras:
            raise TypeError(
                f"{self.name} asks for `inputs`, and there are none: the records of lagjax.fit have them, and "
                "linearize, System.equations and System.to_c take inputs=…. What is held during a motion is a "
                "parameter: let it read params. For sampled inputs let it ask for `t`, and call lagjax.samples(knots, "
                "values)(t)."
            )
        try:
            with self.code.traced():
                return function(*roles, **{name: extras[name] for name in self.extras})
        except (AttributeError, IndexError, TypeError) as reason:
            if isinstance(reason, _NO_VALUES):
                what = _NO_COUNT if isinstance(reason, jax.errors.TracerIntegerConversionError) else _USE_JAX
                where, text = _failing_expression(reason)
                at = f", {where}, `{text}`" if text else where and f", {where}"
                raise ValueNotKnown(f"{self.name}{at}: {what}") from None
            asks = "params" in self.extras
            if asks and extras["params"] is None and not isinstance(reason, IndexError):  # None has no index to miss
                raise TypeError(
                    f"{self.name} asks for `params`, and none were given ({reason}): pass params in the structure that "
                    "it reads."
                ) from reason
            for name in [x for x in ("params", "inputs") if x in self.extras]:
                if expression := find_expression(reason, name):
                    given = f"the {name} that it is given are {jax.tree.structure(extras[name])}."
                    _add_note(reason, self.name, f"it reads `{expression}`, and {given}")
            raise
        except KeyError as reason:
            _add_note(reason, self.name, _dict_keys(roles, extras))
            raise


# A function, as to call a method of an equinox.Module takes as long as half a motion.
def present(function: Function) -> Function:
    """Return the function with the current `Edition` of its code; the same object if nothing it reads has changed."""
    fields = object.__getattribute__(function, "__dict__")
    code = fields["code"].now()
    return function if code is fields["code"] else Function(fields["arrays"], code, fields["extras"])


class ValueNotKnown(TypeError):
    """Raised where a user's function needs the value of a traced number, as in `if q > 0`."""


# Errors of JAX where that happens; they are TypeErrors, too.
_NO_VALUES = (
    jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError, jax.errors.TracerIntegerConversionError,
)  # fmt: skip
_USE_JAX = (
    "the arguments of a function of a scene have no values while it is differentiated. Write jnp.cos(q) for "
    "math.cos(q) or numpy.cos(q), jnp.where(q > 0, a, b) for `if q > 0`, and no float(q)."
)

_NO_COUNT = (
    "numbers in params have no values while it is traced, so that none can count a loop, index a list or be a shape: "
    "let the function close over that integer (n = 3 beside it, or functools.partial), and keep params for what varies."
)
_OF_A_SCENE = "a function of a scene"
_NOT_USERS = str(Path(__file__).parents[1]), str(Path(jax.__file__).parent)


def _dict_keys(roles: tuple, extras: dict[str, Any]) -> str:
    first = {"q": roles[0]} if roles else {}
    dicts = {name: value for name, value in (first | extras).items() if isinstance(value, dict)}
    if not dicts:
        return "it reads a key that is not there."
    keys = "; ".join(f"{name} has {', '.join(map(repr, list(value)[:12]))}" for name, value in dicts.items())
    return f"it reads a key that is not there: {keys}."


def find_expression(reason: Exception, name: str) -> str | None:
    """Return the expression in the failing line of a user's function if it begins with this `name`, else None."""
    _, text = _failing_expression(reason)
    return text if text.startswith((name, f"({name}")) else None


def _failing_expression(reason: Exception) -> tuple[str, str]:
    """Return (file and line, expression) of the user's code that raised `reason`; empty strings if not known."""
    frames = traceback.extract_tb(reason.__traceback__)
    theirs = [frame for frame in frames if not frame.filename.startswith(_NOT_USERS)]
    if not theirs or theirs[-1].lineno is None:
        return "", ""
    last = theirs[-1]
    text = linecache.getline(last.filename, last.lineno or 0).encode()[last.colno : last.end_colno].decode()
    return f"line {last.lineno} of {Path(last.filename).name}", text.strip()


def _add_note(error: Exception, name: str, text: str) -> None:
    """Add a note to an error of Python or JAX: which function of the scene it came from, and what that means."""
    if not any(_OF_A_SCENE in note for note in getattr(error, "__notes__", ())):
        error.add_note(f"This is {name}, {_OF_A_SCENE}: {text}")


def accept(
    function: Callable, role: str, roles: tuple[str, ...] = ("q", "qdot"), extras: tuple[str, ...] = ("t", "params")
) -> Function:
    """Check that `function` has the signature of its `role` in a scene; return it as a `Function`.

    Raises `TypeError` when it is not callable, when its leading positional parameters are not the `roles`, or when it
    has required parameters other than the `extras`. Keywords bound with `functools.partial` are left alone, and so are
    those with a default, as `m` in `lambda q, v, m=2.0: …`, unless they look like one of the extras.
    """
    *others, last = (f"`{extra}`" for extra in extras)
    by_name = f"{', '.join(others)} and {last}" if others else last
    expected = f"{role}({', '.join(roles)}), which may also ask by name for {by_name}"
    if not callable(function):
        raise TypeError(f"{role} must be a function {expected}; got {type(function).__name__}.")
    try:
        signature = inspect.signature(function)
    except ValueError:
        raise TypeError(f"The signature of {role} cannot be read; wrap it in a plain function {expected}.") from None

    parameters = [_parameter_text(p) for p in signature.parameters.values()]
    leading, rest = parameters[: len(roles)], parameters[len(roles) :]
    positional = [p for p in leading if p.kind in _BY_POSITION and p.name not in extras]
    if len(positional) < len(roles):
        raise TypeError(f"{role} must have the form {expected}; got {role}({', '.join(map(str, parameters))}).")

    bound = function.keywords if isinstance(function, functools.partial) else {}
    wanted = [p for p in rest if p.name not in bound]
    given = [p for p in wanted if p.name in extras and p.kind in _BY_NAME]
    needed = {p.name for p in signature.parameters.values() if p.default is p.empty or _resembles_extra(p.name, extras)}
    unknown = [str(p) for p in wanted if p not in given and p.name in needed]
    if unknown:
        raise TypeError(
            f"{role} asks for {', '.join(f'`{name}`' for name in unknown)}, which lagjax does not provide: it must "
            f"have the form {expected}. Put constants into `params`, or bind them with functools.partial."
        )
    arrays, code = eqx.partition(function, eqx.is_array)
    return Function(arrays, Edition.from_function(code), tuple(p.name for p in given))


def restrict_signature(function: Callable, extras: set[str], roles: int = 2) -> Callable:
    """Wrap `function(*roles, t, params)` in a signature with only these `extras`: without `t` it is autonomous."""

    def restricted(*state, t=0.0, params=None, **more):
        return function(*state, t, params, **more)

    names = *("q", "qdot")[:roles], *(name for name in ("t", "params", "inputs", "multipliers") if name in extras)
    parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in names]
    restricted.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    return restricted


def _resembles_extra(name: str, extras: tuple[str, ...]) -> bool:
    """True if a name is probably a misspelling of one of the extras: its default would then be used silently."""
    known = [*extras, *(["time"] if "t" in extras else [])]
    return bool(difflib.get_close_matches(name.lower(), known, cutoff=0.7))


def _parameter_text(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return a parameter as an error message shows it: without its default if that is long."""
    short = len(str(parameter)) <= _SHOWN
    return parameter if short else parameter.replace(default=parameter.empty, annotation=parameter.empty)
