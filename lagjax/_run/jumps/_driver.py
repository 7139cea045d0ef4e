"""The loops of every search, for any law: members side by side, stretch by stretch.

    integrate_members ─► start_member ─► prepare_stretch ─► the kernel ─► process_stretch: the event, a row
                                               ▲                                │
                                               └────────────────────────────────┘

A law declares its fields, and provides the loops `start_member`, `prepare_stretch` (sides and rounding of all watches),
`process_stretch` and `find_mode` (`bind_law`). A flag is 0 or 1. `work` is scratch memory.
"""

from math import isfinite
from typing import Any, TypeAlias, cast

from lagjax._interface import SUCCESSFUL
from lagjax._native import EVENT, GUARD_NOISE, INSTANT, SMALLEST_STEP, Floats, Loop, evaluate, integrate, loop

Scene: TypeAlias = Any  # this and the names that follow are what a law gives
Member: TypeAlias = Any
Entry: TypeAlias = Any
Room: TypeAlias = Any
start_member = prepare_stretch = process_stretch = find_mode = cast(Any, None)

# Results while a motion is followed, when the kernel did not finish its stretch, and before it begins.
GOING, ASKS, NEW = -1, -2, -3
LEAST = 1e-300  # a side that is exactly zero still has a sign


@loop
def copy(given: Floats, into: Floats, count: int):
    """Copy the first `count` numbers of array `given` into array `into`."""
    for i in range(count):
        into[i] = given[i]


@loop
def find_sign(x: float) -> float:
    """The sign of x: 1, −1, or 0."""
    return 1.0 if x > 0 else (-1.0 if x < 0 else 0.0)


@loop
def write_watches(scene: Scene, member: Member, x: Floats, mode: int, out: Floats, work: Floats):
    """Write the watches at inputs x, G each: values, rates, roundings of a value, of it by time, and of a rate."""
    n, total = scene.n, scene.counts[mode]
    evaluate(scene.watch[mode], x, work)
    evaluate(scene.errors[mode], x, work[4 * total :])
    instant = INSTANT * SMALLEST_STEP * max(abs(x[2 * n]), abs(member.last))
    for g in range(total):
        more = work[4 * total + g]
        out[g], out[total + g] = work[g], work[total + g]
        out[2 * total + g] = GUARD_NOISE * work[2 * total + g]
        out[3 * total + g] = abs(work[total + g]) * instant
        out[4 * total + g] = GUARD_NOISE * (work[3 * total + g] + (more if isfinite(more) else 0.0))
    if scene.single > 0:  # the start is known to the rounding of float32
        inputs, widths = scene.inputs, member.widths
        for g in range(total):
            copy(x, work, inputs)
            for j in range(total):
                work[inputs + j] = float(j == g)
            evaluate(scene.slopes[mode], work, work[inputs + total :])
            for i in range(2 * n + 1 + scene.numbers):
                if widths[i] > 0:
                    out[2 * total + g] += abs(work[inputs + total + i]) * widths[i]


@loop
def is_ahead(output: float, t: float, first: float) -> bool:
    """True for an output time that a stretch from t on may cover; at the first time all that equal it."""
    return output > t or (output == t and t == first)


@loop
def write_times(scene: Scene, t: float, ts: Floats, times: Floats):
    """Write the times (T + 2,) of a stretch from t on: its start, its outputs, and the last one."""
    times[0], times[scene.times + 1] = t, ts[scene.times - 1]
    for j in range(scene.times):
        times[1 + j] = ts[j] if is_ahead(ts[j], t, ts[0]) else t


@loop
def write_outputs(
    scene: Scene, ts: Floats, begun: float, end: float, found: Floats, doing: Floats, path: Floats, did: Floats
):
    """Write the outputs of a stretch, `found` (T, 2n), and the contact states or mode (`doing`) then."""
    states = 2 * scene.n
    for j in range(scene.times):
        if is_ahead(ts[j], begun, ts[0]) and ts[j] <= end:
            copy(found[j * states :], path[j * states :], states)
            copy(doing, did[j * scene.doing :], scene.doing)


@loop
def integrate_members(
    scene: Scene, members: int, ts: Floats, path: Floats, did: Floats, record: Entry, memory: Member, room: Room
):
    """Integrate members to their ends, or to a stretch that the kernel does not finish (`ASKS`).

    `ts` (T,) are the same for all if `scene` has one row of them, or (members, T). Members run side by side: the active
    ones are packed for one call of the kernel, those of each mode separately.
    """
    size, times, states = scene.memory, scene.times, 2 * scene.n
    for m in range(members):
        if memory[m * size :].result == NEW:
            ours = did[m * times * scene.doing :]
            start_member(scene, memory[m * size :], ts[m * scene.stride :], path[m * times * states :], ours, room)
    while True:
        any_going = False
        for mode in range(scene.modes):
            count, places = 0, room.order
            for m in range(members):
                mine = memory[m * size :]
                if mine.result == GOING and find_mode(scene, mine) == mode:
                    if mine.rows >= scene.room:
                        continue
                    places[count] = float(m)
                    count += 1
            if count > 0:
                any_going = True
                integrate_stretch(scene, mode, count, ts, path, did, record, memory, room)
        if not any_going:
            return


@loop
def integrate_stretch(
    scene: Scene, mode: int, count: int, ts: Floats, path: Floats, did: Floats, record: Entry, memory: Member,
    room: Room
):  # fmt: skip
    """Integrate a stretch of `count` members, whose numbers are in `ORDER`, in one call of the kernel."""
    size, times, states = scene.memory, scene.times, 2 * scene.n
    outputs, each = times + 2, scene.room * scene.row
    numbers = scene.inputs - states - 1 + 2 * scene.counts[mode]
    places, job = room.order, room.jobs
    given_y, given_numbers = job[count * outputs :], job[count * (outputs + states) :]
    found = given_numbers[count * numbers :]
    y_end, t_end = found[count * outputs * states :], found[count * (outputs + 1) * states :]
    code, steps, rejected, fell = t_end[count:], t_end[2 * count :], t_end[3 * count :], t_end[4 * count :]
    left = fell[count * scene.counts[mode] :]
    plan = scene.plans[2 * mode + (0 if count == 1 else 1)]
    for i in range(count):
        m = int(places[i])
        mine, code[i] = memory[m * size :], -1.0  # until it has ended
        if plan != 0:
            prepare_stretch(
                scene, mine, ts[m * scene.stride :], job[i * outputs :], given_y[i * states :],
                given_numbers[i * numbers :], room
            )  # fmt: skip
        else:
            mine.result = float(ASKS)
    if plan == 0:
        return
    integrate(
        scene.begin, plan, job, given_y, given_numbers, found, y_end, t_end, code, steps, rejected, fell, left, count,
        outputs
    )  # fmt: skip
    for i in range(count):
        m = int(places[i])
        mine, result = memory[m * size :], int(code[i])
        sound = result == SUCCESSFUL or result == EVENT
        for j in range(states):
            sound = sound and isfinite(y_end[i * states + j])
        if not sound:
            mine.result = float(ASKS)
        else:
            process_stretch(
                scene, mine, ts[m * scene.stride :], path[m * times * states :], did[m * times * scene.doing :],
                record[m * each :], found[i * outputs * states :], y_end[i * states :], t_end[i],
                fell[i * scene.counts[mode] :], int(result == EVENT), SUCCESSFUL, steps[i], rejected[i], room
            )  # fmt: skip


def bind_loops(names: dict[str, Any]) -> tuple[Loop, ...]:
    """`write_watches`, `write_times` and `write_outputs` for the fields of a law, from its module's `names`."""
    given = {name: names[name] for name in ("Scene", "Member")}
    return tuple(of.bind(**given) for of in (write_watches, write_times, write_outputs))


def bind_law(names: dict[str, Any]) -> tuple[Loop, ...]:
    """The loops of a law, from its module's `names`: `integrate_members`, and those that it provides but the first."""
    loops = "start_member", "prepare_stretch", "process_stretch", "find_mode"
    given = {name: names[name] for name in ("Scene", "Member", "Entry", "Room", "__name__", *loops)}
    whole = integrate_members.bind(**given, integrate_stretch=integrate_stretch.bind(**given))
    return whole, *(names[name] for name in loops[1:])
