"""The search for transitions: stretch by stretch of a hybrid motion, on numbers, without derivatives.

A stretch ends at the next zero of a guard of its mode. The first transition of the list whose guard changes there
happens: its reset, then the new mode. The values of guards just before are remembered (see `_transition_places`).
"""

from math import isfinite, log

from lagjax._interface import RESULTS, SUCCESSFUL, code_of
from lagjax._native import Floats, evaluate, loop
from lagjax._run.hybrid._transition_places import Entry, Member, Room, Scene
from lagjax._run.jumps import GOING, LEAST, bind_law, bind_loops, copy, find_sign

TOO_MANY, INCONSISTENT, ZENO, IN_TURN, NOT_FINITE = map(
    code_of,
    (RESULTS.max_transitions_reached, RESULTS.inconsistent_start, RESULTS.zeno, RESULTS.transitions_in_turn,
     RESULTS.nonfinite_state),
)  # fmt: skip
BY_TARGET, BEYOND, CROSSING = range(3)  # how a transition fires
EPS = 2.0**-52
# The relative difference that is allowed between the logarithms of two ratios of a geometric sequence. Times of a Zeno
# motion approach a geometric sequence; doubled, a slowly changing rhythm would count as one.
STEADY = 0.05
# This many transitions at one instant alternate for ever: a chain of blows among a few balls is shorter. `APART` is the
# minimal pause before them, relative to t; shorter pauses mean accumulating bounces.
IN_ONE_PLACE, APART = 8, 1e-9
# Up to this many blows at one instant are computed in both orders of the list. `SAME` is the difference of a number of
# the state after them that is allowed, relative to its largest value: far more than the rounding of thirty blows. Twice
# as many blows would settle more cases of restitution below one, whose last blows are small.
MOST_BLOWS, SAME = 32, 1e-9
INFINITY, MISSING = float("inf"), float("nan")
write_watches, write_times, write_outputs = bind_loops(globals())


@loop
def find_mode(scene: Scene, member: Member) -> int:
    """The mode of a member."""
    return int(member.mode[0])


@loop
def start_member(scene: Scene, member: Member, ts: Floats, path: Floats, did: Floats, room: Room):
    """Initialise a member. A mode number that is no mode, such as −1, comes with a state that was not reached."""
    member.latest = -1.0
    for j in range(scene.k):
        member.let_out[j], member.values[j] = MISSING, MISSING
    copy(member.x, member.begun, 2 * scene.n + 1)
    if not (member.mode[0] >= 0 and member.mode[0] < float(scene.modes)):
        member.result = float(NOT_FINITE)
    else:
        member.result = float(
            INCONSISTENT if is_inconsistent(scene, find_mode(scene, member), member.x, room) else GOING
        )


@loop
def is_inconsistent(scene: Scene, mode: int, x: Floats, room: Room) -> bool:
    """True if the state at inputs x violates the constraints of a mode."""
    if scene.checks[mode] == 0:
        return False
    evaluate(scene.checks[mode], x, room.free)
    return room.free[0] > 0


@loop
def zero_rounding(rate: float, rounding: float, largest: float) -> float:
    """The rate, or 0 if it is below its rounding, or below the `largest` rounding so far."""
    return rate if abs(rate) > max(rounding, largest) else 0.0


@loop
def apply_reset(scene: Scene, member: Member, j: int, x: Floats, after: Floats):
    """Write into `after` the inputs after transition j, from inputs x."""
    copy(x, after, scene.inputs)
    if scene.resets[j] != 0:
        evaluate(scene.resets[j], x, after)


# ---- where a stretch begins ----


@loop
def prepare_stretch(scene: Scene, member: Member, ts: Floats, times: Floats, y: Floats, numbers: Floats, room: Room):
    """Write the run of a member's next stretch: its times (T + 2,), its start, and its numbers with the sides."""
    mode, x, n = find_mode(scene, member), member.x, scene.n
    count, first = scene.counts[mode], scene.first_of[mode]
    record_rounding(scene, member, mode, room)
    for g in range(count):
        write_side(scene, member, mode, g, room)
    copy(x[2 * n + 1 :], numbers, scene.numbers)
    copy(member.came, numbers[scene.numbers :], count)
    copy(member.rate_rounding[first:], numbers[scene.numbers + count :], count)
    copy(x, y, 2 * n)
    write_times(scene, x[2 * n], ts, times)


@loop
def record_rounding(scene: Scene, member: Member, mode: int, room: Room):
    """Record the rounding of the guards at the start of a stretch: of its mode, and of other modes.

    A guard of another mode may be the same function. Quantities of that mode's equations are left out.
    """
    for of in range(scene.modes):
        count, first, watches = scene.counts[of], scene.first_of[of], room.other
        if count > 0:
            write_watches(scene, member, member.x, of, watches, room.free)
        for g in range(count):
            j, value, rate = first + g, watches[2 * count + g], watches[4 * count + g]
            if (of == mode or scene.alike[j] > 0) and isfinite(value):
                member.rounding[j] = max(member.rounding[j], value)
            if of == mode and isfinite(rate):
                member.rate_rounding[j] = max(member.rate_rounding[j], rate)
        if of == mode:
            copy(watches, member.guards, 5 * count)


@loop
def write_side(scene: Scene, member: Member, mode: int, g: int, room: Room):
    """Write the side of guard g where a stretch starts in this mode; for one beyond zero see `Transition`."""
    total, j, guards = scene.counts[mode], scene.first_of[mode] + g, member.guards
    value, way, rounding = guards[g], float(scene.way[j]), member.rounding[j]
    rate = zero_rounding(guards[total + g], guards[4 * total + g], member.rate_rounding[j])
    noise, last = rounding + guards[3 * total + g], member.sides[j]
    # It comes from the side where it is; on its surface it can change in its direction, if it has one.
    side = find_sign(value) if abs(value) > noise else -way
    # What the reset has not moved comes from where it was. The one that fired last goes to the side of its rate.
    # Without a rate it stays where it was, unless it was crossed: without a reset, and by a jump.
    if abs(value - member.values[j]) <= rounding and last != 0:
        side = last
        if int(member.latest) == j:
            side = find_sign(rate) if rate != 0 else (-last if scene.passes[j] > 0 else last)
    back, is_beyond = scene.target[j] == mode, value * way > noise
    by_target = is_beyond and scene.fires[j] == BY_TARGET
    at_once = (is_beyond and scene.fires[j] == BEYOND) or (by_target and not back)
    is_blow = by_target and back and reverses_guard(scene, member, mode, g, rate, room)
    member.came[g] = (-way if is_blow else side) * max(noise, LEAST)
    if at_once:
        member.came[g] = -way * INFINITY
    member.lasting[g] = member.x[2 * scene.n] + (0.0 if rate == 0 else 2.0 * noise / abs(rate))
    member.beyond[g], member.blows[g] = float(at_once or is_blow), float(is_blow)


@loop
def reverses_guard(scene: Scene, member: Member, mode: int, g: int, rate: float, room: Room) -> bool:
    """True for a guard whose reset keeps it off its surface: it reverses its rate, or puts it back.

    A kick after which it continues does not, nor does a section without a reset.
    """
    total, j, watches, way = scene.counts[mode], scene.first_of[mode] + g, room.watched, 0.0
    if scene.resets[j] == 0 or scene.way[j] == 0:
        return False
    way = float(scene.way[j])
    apply_reset(scene, member, j, member.x, room.after)
    write_watches(scene, member, room.after, mode, watches, room.free)
    later = zero_rounding(watches[total + g], watches[4 * total + g], 0.0) * way
    turned = later >= 0 if rate * way < 0 else later <= 0
    return turned or (member.guards[g] - watches[g]) * way > watches[2 * total + g]


# ---- where it ends ----


@loop
def process_stretch(
    scene: Scene, member: Member, ts: Floats, path: Floats, did: Floats, record: Entry, found: Floats, y_end: Floats,
    t_end: float, changes: Floats, event: int, result: int, accepted: float, rejected: float, room: Room
):  # fmt: skip
    """Process a stretch, with outputs `found` (T + 2, 2n) and its end: the new mode, and a row of the record.

    `changes` tell which guards fell or rose, if it is an `event`; `result` is that of a run without one.
    """
    n, x, mode, fell, k = scene.n, member.x, find_mode(scene, member), room.fell, -1
    row, begun, first = record[int(member.rounds) * scene.row :], x[2 * n], scene.first_of[mode]
    for i in range(scene.row):
        row[i] = 0.0
    for g in range(scene.counts[mode]):
        fell[g] = changes[g] if event > 0 else 0.0
        if fell[g] > 0 and k < 0:
            k = g
    if k < 0 and result == SUCCESSFUL:
        t_end = ts[scene.times - 1]
    at_once = t_end == begun
    write_outputs(scene, ts, begun, t_end, found[2 * n :], member.mode, path, did)
    for g in range(scene.counts[mode]):
        if member.blows[g] > 0 and not (fell[g] > 0 and at_once) and not isfinite(member.let_out[first + g]):
            member.let_out[first + g] = begun
    # One that the motion was put beyond is no crossing: it happens when the mode begins, however that varies.
    put = False
    if k >= 0:
        put = at_once and member.beyond[k] > 0
    if not put:
        copy(y_end, x, 2 * n)
        x[2 * n] = t_end
    row.ran, row.end, row.watch, row.crosses, row.at = 1.0, t_end, float(k), float(k >= 0 and not put), x[2 * n]
    row.mode[0] = float(mode)
    copy(x, row.before, 2 * n)
    copy(x, row.stop, 2 * n)
    member.accepted += accepted
    member.rejected += rejected
    member.rows += 1.0
    reached = pass_transition(scene, member, mode, k, at_once and not put, result, row, room)
    if row.happens > 0:
        member.rounds += 1.0
        if member.rounds >= scene.most:
            reached = find_end_result(scene, record, ts[scene.times - 1])
    member.result = float(reached)


@loop
def pass_transition(
    scene: Scene, member: Member, mode: int, k: int, turns: bool, result: int, row: Entry, room: Room
) -> int:
    """The result after guard k fired (none if k is −1): apply its transition to the member.

    If a transition `turns` a guard at once, against its rate, repetition shows a motion lost in rounding.
    """
    n, x, after, total = scene.n, member.x, room.after, scene.counts[mode]
    j, fell, watched, sound, against = scene.first_of[mode] + k, room.fell, room.watched, True, False
    member.latest = float(j if k >= 0 else -1)
    if total > 0:
        write_watches(scene, member, x, mode, watched, room.free)
    for g in range(total):
        largest = member.rate_rounding[scene.first_of[mode] + g]
        room.clear[g] = zero_rounding(watched[total + g], watched[4 * total + g], largest)
        sound = sound and watched[g] == watched[g]
    if k >= 0:
        against = turns and (room.clear[k] < 0 if fell[k] == 2 else room.clear[k] > 0)
    record_sides(scene, member, mode, room)
    copy(x, after, scene.inputs)
    happens = k >= 0 and not against
    if happens:
        row.order_matters = float(order_matters(scene, member, mode, room))
        apply_reset(scene, member, j, x, after)
    for i in range(2 * n):
        sound = sound and isfinite(after[i])
    if against:
        result = ZENO
    if not sound and (happens or result == SUCCESSFUL):  # a reset may give NaN, and a guard that is NaN never fires
        result = NOT_FINITE
    elif happens:
        result = INCONSISTENT if is_inconsistent(scene, scene.target[j], after, room) else GOING
    if happens:
        row.happens, row.decides, row.number, row.target = 1.0, 1.0, float(scene.number[j]), float(scene.target[j])
        copy(after, x, 2 * n)
        member.mode[0] = float(scene.target[j])
    copy(x, row.behind, 2 * n)
    return result


@loop
def record_sides(scene: Scene, member: Member, mode: int, room: Room):
    """Record the sides before a reset of the guards of this mode, and their rounding; others are unknown.

    Guards that fired: the side they left. Guards on their surface: the side they started on if they have stayed or have
    no rate; otherwise the side opposite to their rate.
    """
    total, first, watched, fell = scene.counts[mode], scene.first_of[mode], room.watched, room.fell
    for j in range(scene.k):
        member.values[j], member.sides[j] = MISSING, 0.0
    for g in range(total):
        j, rate = first + g, room.clear[g]
        member.values[j] = watched[g]
        member.rounding[j] = max(member.rounding[j], watched[2 * total + g])
        member.rate_rounding[j] = max(member.rate_rounding[j], watched[4 * total + g])
        noise = member.rounding[j] + watched[3 * total + g]
        room.there[g] = float(fell[g] > 0 or abs(watched[g]) <= noise)
        stays = member.x[2 * scene.n] <= member.lasting[g] or rate == 0
        member.sides[j] = find_sign(member.came[g]) if stays else -find_sign(rate)
        if abs(watched[g]) > noise:
            member.sides[j] = find_sign(watched[g])
        if fell[g] > 0:
            member.sides[j] = 1.0 if fell[g] == 1 else -1.0


@loop
def order_matters(scene: Scene, member: Member, mode: int, room: Room) -> bool:
    """True if the guards at zero have blows whose result differs when the list is applied in reverse order.

    Blows are transitions into their own mode, with a direction and a reset.
    """
    first, there, blows = scene.first_of[mode], room.there, 0
    for g in range(scene.counts[mode]):
        j = first + g
        if scene.target[j] != mode or scene.resets[j] == 0 or scene.way[j] == 0:
            there[g] = 0.0
        blows += int(there[g])
    if blows < 2:
        return False
    for i in range(2 * scene.n):
        room.largest[i] = abs(member.x[i])
    apply_blows(scene, member, mode, False, room.one, room)
    apply_blows(scene, member, mode, True, room.after, room)
    for i in range(2 * scene.n):
        if abs(room.one[i] - room.after[i]) > SAME * room.largest[i]:
            return True
    return False


@loop
def apply_blows(scene: Scene, member: Member, mode: int, backwards: bool, x: Floats, room: Room):
    """Apply the blows of the guards at zero to the inputs x, each while its guard still moves in its direction.

    Each is applied at least once.
    """
    total, first, watches = scene.counts[mode], scene.first_of[mode], room.other
    armed, goes = room.armed, room.goes
    copy(member.x, x, scene.inputs)
    for g in range(total):
        armed[g], goes[g] = 1.0, float(room.there[g] > 0 and room.clear[g] * float(scene.way[first + g]) > 0)
    for _ in range(MOST_BLOWS):
        k = -1
        for g in range(total):
            if armed[g] > 0 and goes[g] > 0 and (k < 0 or backwards):
                k = g
        if k < 0:
            return
        copy(x, room.free, scene.inputs)
        evaluate(scene.resets[first + k], room.free, x)
        armed[k] = 0.0
        write_watches(scene, member, x, mode, watches, room.free)
        for g in range(total):
            rate = zero_rounding(watches[total + g], watches[4 * total + g], 0.0)
            goes[g] = float(room.there[g] > 0 and rate * float(scene.way[first + g]) > 0)
            armed[g] = max(armed[g], 1.0 - goes[g])
        for i in range(2 * scene.n):
            room.largest[i] = max(room.largest[i], abs(x[i]))


# ---- where the budget is spent ----


@loop
def find_end_result(scene: Scene, record: Entry, end: float) -> int:
    """The result of a motion that has used up its budget of transitions before `end`."""
    if repeats_at_instant(scene, record):
        return IN_TURN
    return ZENO if bounces_converge(scene, record, end) else TOO_MANY


@loop
def bounces_converge(scene: Scene, record: Entry, end: float) -> bool:
    """True if the times of a used-up budget of transitions converge geometrically to a limit before `end`.

    Aitken's extrapolation of the last times, taken far enough apart that a pattern of two, three or six transitions (a
    flight and a contact, say) repeats in between: three intervals whose two ratios agree, and are below one. Or the
    time does not increase any more. One interval alone may be that of two transitions at the same instant.
    """
    size = scene.most - 1
    apart = 6 if size > 18 else (2 if size > 6 else 1)
    if size <= 3:
        return False  # too few to tell
    t = record[(size - 1) * scene.row :].at
    before, earlier = record[(size - 1 - apart) * scene.row :].at, record[(size - 1 - 2 * apart) * scene.row :].at
    third, second, first = t - before, before - earlier, earlier - record[(size - 1 - 3 * apart) * scene.row :].at
    if third <= 4.0 * EPS * abs(t) and apart > 1:
        return True
    last_ratio, ratio = second / first, third / second
    agree = abs(log(ratio) - log(last_ratio)) <= STEADY * abs(log(last_ratio))
    return ratio < 1 and agree and t + third * ratio / (1.0 - ratio) < end


@loop
def repeats_at_instant(scene: Scene, record: Entry) -> bool:
    """True if the last transitions of a used-up budget, of several kinds, are at one instant without convergence."""
    size, several, before = scene.most - 1, False, -INFINITY
    if size < IN_ONE_PLACE:
        return False
    last = record[(size - 1) * scene.row :]
    for i in range(size):
        row = record[i * scene.row :]
        if abs(row.at - last.at) > 4.0 * EPS * abs(last.at):
            before = max(before, row.at)
            if i >= size - IN_ONE_PLACE:
                return False
        if i >= size - IN_ONE_PLACE and (row.mode[0] != last.mode[0] or row.target != last.target):
            several = True
    return several and last.at - before > APART * abs(last.at)


LOOPS = bind_law(globals())
