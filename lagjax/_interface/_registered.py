"""Functions of rooms above that a trajectory or a scene calls, such as those for display and explanation of a failure.

No room imports from a room above it. `lagjax/__init__`, above all of them, registers these functions; each imports its
room when it is called.
"""

from collections.abc import Callable
from typing import Any, NamedTuple


class Registered(NamedTuple):
    """The functions of rooms above that a scene, a trajectory or one of its tables calls.

    `dataset` and `frame` take the `units` and the `time_unit` of `to_xarray`.
    """

    summary: Callable[[Any], str]
    trajectory_html: Callable[[Any], str | None]
    dataset: Callable[[Any, Any, str | None], Any]
    frame: Callable[[Any, Any, str | None], Any]
    impact_frame: Callable[[Any], Any]
    change_frame: Callable[[Any], Any]
    write_equations: Callable[..., Any]
    write_c: Callable[..., str]
    make_animation: Callable[[Any, Callable, Any, float, float], Any]
    examine: Callable[[Any, Any], Any]
    contact_forces: Callable[[Any, str], Any]
    find_states: Callable[[Any, Any], Any]
    describe_failure: Callable[[Any, Any, str | None], str]


_registered: list[Registered] = []


def register(functions: Registered) -> None:
    _registered[:] = [functions]


def registered() -> Registered:
    return _registered[0]
