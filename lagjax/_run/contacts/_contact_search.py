"""The search for events of contacts: stretch by stretch of a motion, on numbers, without derivatives.

A contact has watches that stay positive: its gap, or one-way velocity, while it is open, its normal force λ while it is
closed; with friction the slip in its direction while it slides, μ²λ² − f² while it sticks. One program serves all
contacts in any state (`ContactParams`). When a watch becomes negative,

    a gap             impulses, if the contact approaches (`_law`); else the contact closes
    λ                 it opens
    the slip          it sticks
    μ²λ² − f²         it slides, against the force that held it

The kernel finds the instant (`_native.steps._events`), `find_change` the impulses, `apply_change` the velocities.

A wrong guess is a watch that starts negative, or whose first coefficient above rounding is negative: it falls at once,
and the next round takes the guess back (`_native.steps._events`). That is Murty's principal pivoting, over series in
place of numbers (Murty, Linear Algebra Appl. 5 (1972) 65; Heemels, Schumacher & Weiland, ibid. 294 (1999) 93). Bounces
that accumulate end at a closed form of their limit (`end_bounces`).

    start_contacts ─► prepare_stretch ─► the kernel ─► process_stretch ─► change_contacts: a row of the record
                             ▲                                                   │
                             └───────────────────────────────────────────────────┘

`scene` has sizes, addresses of machine code, and the offsets of the fields of a member's memory (`member`) and of a
`row` of the record; they are declared in `_places`. A flag is 0 or 1. `work` is scratch memory. Functions write their
results into their array arguments.
"""

from math import isfinite

from lagjax._interface import SUCCESSFUL
from lagjax._native import GUARD_NOISE, Floats, evaluate, loop
from lagjax._run.contacts._contact_changes import change_contacts
from lagjax._run.contacts._contact_state import (
    AT_CORNER,
    BACKWARDS,
    IN_TURN,
    INCONSISTENT,
    MISSED,
    NO_FRICTION,
    NO_RESTITUTION,
    NOT_FINITE,
    TOO_MANY,
    UNDECIDED,
    find_scene_mode,
    has_missed,
    has_paradox,
    locate_corners,
    measure_slips,
    open_all,
    write_corner_move,
    write_directions,
    write_outputs,
    write_times,
    write_touching,
    write_watches,
)
from lagjax._run.contacts._places import Entry, Member, Room, Scene
from lagjax._run.jumps import GOING, LEAST, bind_law, copy, find_sign

INFINITY, MISSING = float("inf"), float("nan")


@loop
def find_mode(scene: Scene, member: Member) -> int:
    """The mode of the next stretch of a member."""
    return find_scene_mode(scene, member.x)


@loop
def start_contacts(scene: Scene, member: Member, room: Room) -> int:
    """The result of a start, whose inputs and coefficients are set, with all contacts open: `GOING` if it is valid.

    The gaps of contacts that touch and do not separate fall at once.
    """
    n, k, r, total = scene.n, scene.k, scene.r, scene.watches
    x, watches, deciding = member.x, room.watched, total - scene.sections
    for g in range(total):
        member.fresh[g] = 1.0
    for i in range(2 * n):
        member.largest[i] = abs(x[i])
    write_touching(scene, member, x, room)
    for s in range(scene.sections):
        member.came[s] = find_sign(watches[total + deciding + s])
    evaluate(scene.response, x, room.gradients)
    if member.last < member.first:
        return BACKWARDS
    for i in range(k):
        if not (member.restitution[i] >= 0 and member.restitution[i] <= 1):
            return NO_RESTITUTION
    for c in range(r):
        if not (member.mu[c] >= 0 and isfinite(member.mu[c])):
            return NO_FRICTION
    if starts_inside(scene, member, room):
        return INCONSISTENT
    result = GOING
    if r > 0:  # one that slides and touches may stay or leave
        push, slips = room.push, room.slips
        measure_slips(scene, member, room.rates, x[n:], slips, room)
        for i in range(k):
            still = abs(room.parting[i]) <= room.noise[i]
            push[i] = float(room.touches[i] > 0 and still)
        write_directions(scene, room.rates[k:], room.free)
        if has_paradox(scene, member, push, slips, room.free, room):
            result = UNDECIDED
    if scene.corners > 0 and rests_on_corner(scene, member, room) and result == GOING:
        result = AT_CORNER
    return result


@loop
def rests_on_corner(scene: Scene, member: Member, room: Room) -> bool:
    """True if a contact that starts on its corner rests there; otherwise the state is moved with the motion."""
    n, k, x, corners, passed = scene.n, scene.k, member.x, room.corner, room.passed
    locate_corners(scene, member, x, room)
    for p in range(scene.corners):
        passed[p] = 0.0
        for i in range(k):
            is_there = abs(corners[p]) <= corners[2 * scene.corners + p]
            if scene.touch[p * k + i] > 0 and room.touches[i] > 0 and is_there:
                passed[p] = 1.0
    later = write_corner_move(scene, member, x, room)
    for i in range(2 * n):
        x[i] += room.shift[i]
    x[2 * n] += max(later, 0.0)
    return later < 0


@loop
def starts_inside(scene: Scene, member: Member, room: Room) -> bool:
    """True if a gap is negative at the start, by more than the rounding along a motion that led there."""
    n, total, x, rises, watches = scene.n, scene.watches, member.x, room.free, room.watched
    evaluate(scene.acceleration, x, rises)
    for i in range(scene.gaps):
        width = find_start_width(n, x, room.gradients[i * n :], rises, member.first, member.last)
        if watches[i] + watches[2 * total + i] < -width:
            return True
    return False


@loop
def find_start_width(n: int, x: Floats, slopes: Floats, rises: Floats, first: float, last: float) -> float:
    """The depth at which a gap with these `slopes` (n,) may start: the rounding of a motion that led there.

    A gap that is a coordinate is 1e-16 where it closes, and its rounding that of the height from which it fell. `rises`
    (n,) is the acceleration at the start x.
    """
    furthest, width = 0.0, 0.0
    for j in range(n):
        furthest = max(furthest, abs(x[j]))
    for j in range(n):
        reach = abs(x[n + j]) * max(abs(first), abs(last)) + abs(rises[j]) * (last - first) ** 2 / 8.0
        width += abs(slopes[j]) * (furthest + reach)
    return GUARD_NOISE * width


@loop
def record_rounding(scene: Scene, member: Member, duration: float):
    """Record the largest rounding of each watch so far, also of one that was inactive in between."""
    total, watches, kinds = scene.watches, member.guards, member.kinds
    values, rates = member.rounding, member.rate_rounding
    for g in range(total):
        place = g + (total if kinds[g] > 0 else 0)
        value, rate = watches[2 * total + g], watches[4 * total + g]
        value = value if isfinite(value) else 0.0
        rate = rate if isfinite(rate) else 0.0
        values[place] = max(values[place], value, rate * duration)
        rates[place] = max(rates[place], rate)


@loop
def write_sides(scene: Scene, member: Member, sides: Floats, rates: Floats):
    """Write the sides (G,) of all watches from which the motion comes, and the rounding of their rates, (G,).

    A tie is a contact whose state changes repeatedly at an instant: if closed, its force counts as zero if rounding of
    the gap could cause it; it sticks until the value of its watch falls, whatever the rate.
    """
    k, r, total, rough = scene.k, scene.r, scene.watches, scene.rough
    watches, kinds, tied = member.guards, member.kinds, member.tied
    came, deciding = member.came, total - scene.sections
    lasts = member.longest if member.longest > 0 else 1.0
    for g in range(total):
        place = g + (total if kinds[g] > 0 else 0)
        rounding, of_rate = member.rounding[place], member.rate_rounding[place]
        if g < k + r and kinds[g] > 0 and tied[g] > 0:
            if g < k:
                none = member.force_noise[g]
                rounding, of_rate = max(rounding, none), max(of_rate, 3.0 * none / lasts)
            else:
                most = member.mu[g - k] * watches[rough[g - k]]
                rounding = GUARD_NOISE * most**2
                of_rate = max(watches[4 * total + g], -2.0 * watches[total + g])
        rounding = max(rounding, watches[3 * total + g])
        sides[g], rates[g] = max(rounding, LEAST), of_rate
        if g < k + r:
            if watches[g] < -rounding:
                sides[g] = INFINITY
        elif g < deciding:
            sides[g] = 0.0  # where a corner is met first tells the motion
        else:
            if abs(watches[g]) > rounding:
                came[g - deciding] = 1.0 if watches[g] > 0 else -1.0
            sides[g] *= came[g - deciding]


@loop
def prepare_stretch(scene: Scene, member: Member, ts: Floats, times: Floats, y: Floats, numbers: Floats, room: Room):
    """Write the run of a member's next stretch: its times (T + 2,), its start, and its numbers with the sides."""
    n, k, r, total = scene.n, scene.k, scene.r, scene.watches
    x, kinds, stays = member.x, member.kinds, member.stays
    did, t = x[2 * n + 1 + scene.numbers :], x[2 * n]
    if scene.corners > 0:
        x[scene.inputs - 1] = locate_corners(scene, member, x, room)
    watches = member.guards
    write_watches(scene, member, x, find_scene_mode(scene, x), watches, room.free)
    member.missed = 0.0
    for g in range(total):
        kinds[g] = did[g] if g < k + r else 0.0
        if g < k and member.fresh[g] == 0 and has_missed(scene, member, watches, g, did[g] > 0):
            member.missed = 1.0
    record_rounding(scene, member, 0.0)
    used = scene.inputs - 2 * n - 1
    copy(x[2 * n + 1 :], numbers, used)
    sides, rates = numbers[used:], numbers[used + total :]
    write_sides(scene, member, sides, rates)
    for g in range(total):  # what starts on a gap and moves inwards comes from in front of it
        falls = g < k and t == ts[0] and watches[total + g] < -rates[g] and kinds[g] == 0
        beyond = g < k + r and sides[g] == INFINITY
        stays[g] = float((member.fresh[g] > 0 or beyond) and not falls)
    copy(x, y, 2 * n)
    write_times(scene, t, ts, times)


@loop
def process_stretch(
    scene: Scene, member: Member, ts: Floats, path: Floats, did: Floats, record: Entry, found: Floats, y_end: Floats,
    t_end: float, fell: Floats, event: int, result: int, accepted: float, rejected: float, room: Room
):  # fmt: skip
    """Process a stretch, with outputs `found` (T + 2, 2n) and its end: the new contact states, and a row of the record.

    `fell` (G,) tells which watches fell or rose, if it is an `event`; `result` is that of a run without one.
    """
    n, k, total, x = scene.n, scene.k, scene.watches, member.x
    row = record[int(member.rounds) * scene.row :]
    deciding, start, begun = total - scene.sections, x[2 * n], x[2 * n + 1 + scene.numbers :]
    for i in range(scene.row):
        row[i] = 0.0
    happens, decides, first = event > 0, False, deciding
    for g in range(deciding):
        decides = decides or (happens and fell[g] > 0)
    if not happens and result == SUCCESSFUL:
        t_end = ts[scene.times - 1]
    at_once = t_end == start
    write_outputs(scene, ts, start, t_end, found[2 * n :], begun, path, did)
    if decides:
        first = find_first(scene, fell, at_once, begun)
    elif happens:
        while fell[first] == 0:
            first += 1
    crosses = happens and not (at_once and member.stays[first] > 0)
    row.end, row.watch, row.crosses = t_end, float(first), float(crosses)
    row.happens, row.decides = float(happens), float(decides)
    row.ran, row.t_impact = 1.0, MISSING
    copy(begun, row.did, scene.doing)
    if crosses or not happens:
        copy(y_end, x, 2 * n)
        x[2 * n] = t_end
    record_stretch(scene, member, first if happens else -1, at_once, t_end - start, accepted)
    member.accepted += accepted
    member.rejected += rejected
    reached = SUCCESSFUL if happens else result
    row.at = x[2 * n]
    copy(x[n:], row.before, n)
    copy(x, row.stop, 2 * n)
    if decides:
        reached = change_contacts(scene, member, first, row, room)
    elif happens:  # a section, of which a note is made
        member.came[first - deciding] = 2.0 * fell[first] - 3.0
        row.contact, row.change = float(k + first - deciding), -1.0
    copy(x, row.behind, 2 * n)
    if scene.corners > 0 and happens:
        write_passed_outputs(scene, member, ts, path, did, row)
    member.rounds += float(happens)
    member.rows += 1.0
    reached = find_result(scene, member, reached, happens)
    member.result = float(reached)
    if reached == SUCCESSFUL:
        check_outputs(scene, member, ts, path, did, room)


@loop
def write_passed_outputs(scene: Scene, member: Member, ts: Floats, path: Floats, did: Floats, row: Entry):
    """Write the outputs between a corner and the state beyond it, where the motion continues."""
    n, x, doing = scene.n, member.x, scene.doing
    for j in range(scene.times):
        if ts[j] <= x[2 * n] and did[j * doing] < 0:
            copy(x, path[j * 2 * n :], 2 * n)
            copy(row.did, did[j * doing :], doing)


@loop
def find_result(scene: Scene, member: Member, reached: int, happens: bool) -> int:
    """The result of a motion so far, after a stretch with the result `reached`: `GOING` if all is well."""
    if happens and member.turns > 16 + 8 * scene.watches:
        return IN_TURN
    if member.missed > 0:
        return MISSED
    for i in range(2 * scene.n):
        if not isfinite(member.x[i]) and reached == SUCCESSFUL:
            return NOT_FINITE
    if happens and reached == SUCCESSFUL:
        return TOO_MANY if member.rounds >= scene.most else GOING
    return reached


@loop
def record_stretch(scene: Scene, member: Member, first: int, at_once: bool, duration: float, accepted: float):
    """Record, after a stretch, ties, its longest step, and rounding; watch `first` fell at its end."""
    k, r, total = scene.k, scene.r, scene.watches
    tied, refuted, did = member.tied, member.refuted, member.kinds
    member.turns = member.turns + 1.0 if at_once else 0.0
    turns_in_plane = scene.d == 1 and member.turns > total
    for g in range(k + r):
        ties = g == first and did[g] == 0 and (refuted[g] > 0 if g < k else turns_in_plane)
        tied[g] = float(at_once and (tied[g] > 0 or ties))
    for i in range(k):
        refuted[i] = float(at_once and (refuted[i] > 0 or (i == first and did[i] > 0)))
    record_rounding(scene, member, duration)
    for g in range(total):
        member.fresh[g] *= float(at_once)
    if not at_once:
        member.longest = max(member.longest, duration / max(accepted, 1.0))


@loop
def check_outputs(scene: Scene, member: Member, ts: Floats, path: Floats, did: Floats, room: Room):
    """Set the result of a motion if outputs are missing, or a gap is negative at one."""
    n, k, times, doing = scene.n, scene.k, scene.times, scene.doing
    x, watches = room.free, room.free[scene.inputs :]
    copy(member.x, x, scene.inputs)
    for j in range(times):
        for i in range(2 * n):
            if did[j * doing] < 0 or not isfinite(path[j * 2 * n + i]):
                member.result = float(NOT_FINITE)
                return
        if scene.may_miss > 0:
            copy(path[j * 2 * n :], x, 2 * n)
            x[2 * n] = ts[j]
            copy(did[j * doing :], x[2 * n + 1 + scene.numbers :], doing)
            write_watches(scene, member, x, find_scene_mode(scene, x), watches, watches[5 * scene.watches :])
            for i in range(k):
                if has_missed(scene, member, watches, i, did[j * doing + i] > 0):
                    member.result = float(MISSED)
                    return


@loop
def find_first(scene: Scene, fell: Floats, at_once: bool, did: Floats) -> int:
    """The index of the watch to process first among those that `fell` (G,): corners before friction before the rest."""
    k, r, rough = scene.k, scene.r, scene.rough
    for g in range(k + r, k + r + 2 * scene.corners):
        if fell[g] > 0:
            return g
    for c in range(r):
        if fell[k + c] > 0 or (at_once and fell[rough[c]] > 0 and did[rough[c]] > 0 and did[k + c] > 0):
            return k + c
    for i in range(k):
        if fell[i] > 0:
            return i
    return 0


@loop
def start_member(scene: Scene, member: Member, ts: Floats, path: Floats, did: Floats, room: Room):
    """Initialise a member with outputs at `ts`, including those that lie before its first corner."""
    n, x, first = scene.n, member.x, member.first
    open_all(scene, x, x)
    for i in range(3):
        member.doubted[i] = MISSING
    member.result = float(start_contacts(scene, member, room))
    copy(x, member.begun, 2 * n + 1)
    for j in range(scene.times):
        if x[2 * n] > first and ts[j] <= x[2 * n]:
            copy(x, path[j * 2 * n :], 2 * n)
            copy(x[2 * n + 1 + scene.numbers :], did[j * scene.doing :], scene.doing)


LOOPS = bind_law(globals())
