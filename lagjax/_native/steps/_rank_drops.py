"""Steps near a configuration where constraints become dependent.

Because of rounding no step there is longer than the distance to that configuration, so that steps shrink and never pass
it. Then the last long step is repeated, slightly shorter, to step over it.
"""

from lagjax._native.code._constants import MOST_RETURNS, RETAKEN, RUNNING, SHORTER
from lagjax._native.code._frame import Fields, Frame
from lagjax._native.series._lanes import Lines
from lagjax._native.series._tables import Tables
from lagjax._native.steps._events import MEMORY


def start_fields(states: int, guards: int, borders: int) -> dict[str, int]:
    """The sizes of the fields that define the start of a step, for `guards` of events and guards of `borders`."""
    of_guards = dict.fromkeys(MEMORY, guards) | {"touch": borders}
    return dict.fromkeys(("y", "low"), states) | of_guards | dict.fromkeys(("t", "t_low", "steps"), 1)


def fields(begins: dict[str, int]) -> Fields:
    # Where the last long step began: the fields without `_before`, then.
    return {f"{name}_before": size for name, size in begins.items()} | {
        "h_before": 1,  # the size of that step; 0 without any
        "returns": 1,  # the number of returns to it
        "returned": 1,  # 1 if the motion has just returned
    }


AT_FIRST_ZERO = ("h_before", "returns", "returned")  # for every new member


def retry_last_long_step(frame: Frame, form: Lines | Tables, begins: dict[str, int]) -> None:
    """Return to the start of the last long step if steps have become too short since; else store this start."""
    code = frame.code
    size, long = (abs(frame[name]) for name in ("h", "h_before"))
    returns, steps = frame["returns"], frame["steps"]
    active, last, returned = (frame[name] > 0.0 for name in ("active", "last", "returned"))
    back = (size < SHORTER * long) & active & ~last & (returns < float(MOST_RETURNS))
    forth = (size > 0.0) & ~back
    away = abs(frame["t"] - frame["t_before"])
    new = forth & ~returned & ((size >= 0.5 * long) | (away > 2.0 * long))
    undone = steps - frame["steps_before"]
    frame["h_before"] = code.select(new, size, long)
    frame["returns"] = code.select(back, returns + 1.0, code.select(new, 0.0, returns))
    frame["returned"] = back
    frame["rejected"] = frame["rejected"] + code.select(back, undone + 1.0, 0.0)
    frame.assign(back, code=float(RUNNING), h=0.0)
    for name, count in begins.items():
        for i in form.each(code, count):
            now, then = (name, i), (name + "_before", i)
            here, there = frame[now], frame[then]
            frame[now] = code.select(back, there, here)
            frame[then] = code.select(new, here, there)


def shorten_returned(frame: Frame) -> None:
    """Limit the next step of the lanes that have just returned."""
    code, returned = frame.code, frame["returned"] > 0.0
    size, returns = frame["h_before"], frame["returns"]
    for k in range(1, MOST_RETURNS + 1):
        size = code.select(returns >= float(k), RETAKEN * size, size)
    for name in ("h", "longest"):
        frame.assign(returned, **{name: size})
