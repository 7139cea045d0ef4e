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

from math import isfinite, sqrt

from lagjax._interface import RESULTS, SUCCESSFUL, code_of
from lagjax._native import GUARD_NOISE, SMALLEST_STEP, Floats, evaluate, loop
from lagjax._run.contacts._law import (
    EPS,
    LINKED,
    add_rates,
    drop_dependent,
    find_impulses,
    find_pattern,
    find_violations,
    select_rows,
)
from lagjax._run.contacts._places import Entry, Member, Room, Scene
from lagjax._run.jumps import GOING, LEAST, bind_law, bind_loops, copy, find_sign

(TOO_MANY, UNDECIDED, IN_TURN, MISSED, AT_CORNER, NOT_FINITE, INCONSISTENT, BACKWARDS, NO_RESTITUTION,
 NO_FRICTION) = map(
    code_of,
    (RESULTS.max_transitions_reached, RESULTS.contact_undecided, RESULTS.contacts_in_turn, RESULTS.contact_missed,
     RESULTS.contact_at_corner, RESULTS.nonfinite_state, RESULTS.inconsistent_start, RESULTS.contact_backwards,
     RESULTS.restitution_out_of_range, RESULTS.friction_out_of_range),
)  # fmt: skip
CLOSES, OPENS, BOUNCES, STICKS, SLIDES = range(5)  # the kinds of `ContactChanges`
SEQUENTIAL, POISSON = 1, 2
# Remaining bounce time, as a fraction of a step, below which a sequence of bounces is replaced by its limit, and the
# error of that, 1e-14 of a height in a step; doubling `SHORT` gives 4e-9.
SHORT, LEFT_OUT = 1e-4, 1e-14
# Forces that count as zero, as a fraction of those that stop the bodies within a step: some fifty roundings.
FORCELESS = 1e-14
# A gap counts as passed if it is this many local errors of its largest terms below zero.
THROUGH = 100.0
# The response of a contact to its normal force, relative to that without sliding, below which it is zero to rounding:
# Painlevé's paradox.
PARADOX = 1e-12
# A gap may move by this many of its roundings in a step by a force that counts as zero, if no other choice is left.
TIED_MOVES = 1e3
# Below `NO_SLIP` of the largest slip, a spatial slip has no reliable direction. `AT_REST` is the same for a slip caused
# within one step by a force that exceeds friction. Halving `AT_REST` takes √2 times the steps, of some ten thousand:
# near rest friction turns a slip at once, and steps have to resolve that.
NO_SLIP, AT_REST = 1e-11, 1e-8
# Instants of two simultaneous changes may differ in their derivatives by this much, for a tangent of length one.
TOGETHER = 1e-8
HARDLY = 1e-6  # of the largest velocities so far: a contact that moves apart slower may close
GAINED = 1e-12  # of the room of an impact: a gain of energy beyond rounding
# Of the largest slip so far: what is more, where the slip along its first direction ends, has turned.
RATE_JUMP_TOLERANCE = 1e-6
# After a corner a motion continues from this fraction of the terms of its switching number beyond it. An event stops
# it `BEFORE` the corner: steps that end at a border may be rejected, and halve the rest.
BEYOND, BEFORE = 16.0 * EPS, 64.0 * SMALLEST_STEP
# If crossing a corner takes more than this fraction of the time of the motion, the contact rests on the corner.
ON_CORNER = 1e-10
INFINITY, MISSING = float("inf"), float("nan")
OPEN, HELD = range(2)  # the modes
write_watches, write_times, write_outputs = bind_loops(globals())


# ---- what is known at a state ----


@loop
def find_length(x: Floats, count: int) -> float:
    """The Euclidean length of a vector (count,)."""
    total = 0.0
    for i in range(count):
        total += x[i] ** 2
    return sqrt(total)


@loop
def open_all(scene: Scene, x: Floats, opened: Floats):
    """Write into `opened` the inputs of the lines: the state of inputs x, with all contacts open."""
    k, r, d = scene.k, scene.r, scene.d
    first = 2 * scene.n + 1 + scene.numbers
    copy(x, opened, first)
    for i in range(scene.doing):
        opened[first + i] = 1.0 if k <= i and i < k + r + r * d else 0.0


@loop
def find_scene_mode(scene: Scene, x: Floats) -> int:
    """The mode at inputs x: `HELD` if any contact is closed, else `OPEN`."""
    for i in range(scene.k):
        if x[2 * scene.n + 1 + scene.numbers + i] > 0:
            return HELD
    return OPEN


@loop
def find_mode(scene: Scene, member: Member) -> int:
    """The mode of the next stretch of a member."""
    return find_scene_mode(scene, member.x)


@loop
def has_missed(scene: Scene, member: Member, watches: Floats, i: int, closed: bool) -> bool:
    """True for an open contact whose gap is negative: its series did not show the root."""
    if scene.may_miss == 0 or i >= scene.gaps or closed:
        return False
    total = scene.watches
    rounding = max(watches[2 * total + i], watches[3 * total + i], member.rounding[i])
    return watches[i] < -rounding * max(1.0, THROUGH * member.rtol / GUARD_NOISE)


@loop
def write_touching(scene: Scene, member: Member, opened: Floats, room: Room):
    """Write the contacts that touch, their separation speeds, and the rounding of these; all are open in the inputs."""
    total, watches = scene.watches, room.watched
    write_watches(scene, member, opened, OPEN, watches, room.free)
    for i in range(scene.k):
        value, noise, is_gap = watches[i], watches[2 * total + i] + watches[3 * total + i], i < scene.gaps
        room.touches[i] = float((abs(value) if is_gap else value) <= noise)
        room.parting[i] = watches[total + i] if is_gap else value
        room.noise[i] = watches[4 * total + i] if is_gap else noise


@loop
def measure_slips(scene: Scene, member: Member, rates: Floats, v: Floats, slips: Floats, room: Room):
    """Write into `slips` 1 for each slip that is zero relative to the largest so far, then all lengths: (r,) each."""
    k, r, d, n, gradients = scene.k, scene.r, scene.d, scene.n, room.gradients
    for c in range(r):
        terms = 0.0
        for i in range(k + c * d, k + c * d + d):
            moves = 0.0
            for j in range(n):
                moves += abs(gradients[i * n + j]) * abs(v[j])
            terms = max(terms, moves)
        slips[r + c] = find_length(rates[k + c * d :], d)
        slips[c] = float(slips[r + c] <= max(1e-12 * terms, 1e-13 * member.slip[c]))


# ---- corners of gaps ----


@loop
def locate_corners(scene: Scene, member: Member, x: Floats, room: Room) -> float:
    """Write the sides of corners at inputs x, their rates, and the distance to move beyond: (corners,) each.

    Returns the distance below which a state counts as on a corner.
    """
    n, count, inputs, found = scene.n, scene.corners, scene.inputs, room.corner
    t, largest, near = x[2 * n], member.largest, 0.0
    terms, along = room.free, room.free[count:]
    slopes = along[2 * inputs :]
    evaluate(scene.sides, x, found)
    for p in range(count):
        found[count + p], found[2 * count + p], terms[p] = 0.0, abs(found[p]), 0.0
    copy(x, along, inputs)
    for i in range(n + 1):  # by each coordinate, and by time
        for j in range(inputs):
            along[inputs + j] = float(j == (i if i < n else 2 * n))
        evaluate(scene.side_slopes, along, slopes)
        size, rate, speed = abs(t), 1.0, 1.0
        if i < n:
            size, rate, speed = max(largest[i], abs(x[i])), x[n + i], max(largest[n + i], abs(x[n + i]))
        for p in range(count):
            found[count + p] += slopes[p] * rate
            found[2 * count + p] += abs(slopes[p]) * size
            terms[p] += abs(slopes[p]) * speed
    for p in range(count):
        found[2 * count + p] = BEYOND * found[2 * count + p]
        soon = BEFORE * max(abs(t), abs(member.last)) * terms[p]
        near = max(near, found[2 * count + p] + soon)
    return near


@loop
def write_corner_move(scene: Scene, member: Member, x: Floats, room: Room) -> float:
    """Write the displacement of the state beyond the corners that are passed; the time that it takes.

    Negative if the motion rests on one.
    """
    n, count, corners, shift = scene.n, scene.corners, room.corner, room.shift
    later, rests = 0.0, False
    for p in range(count):
        if room.passed[p] > 0:
            rate = corners[count + p]
            left = corners[2 * count + p] - corners[p] * find_sign(rate)
            if rate != 0:
                left = left / abs(rate)
            if rate == 0 or left > ON_CORNER * (member.last - member.first):
                rests = True
            else:
                later = max(later, left)
    evaluate(scene.acceleration, x, shift[n:])
    for i in range(n):
        a = shift[n + i]
        shift[i], shift[n + i] = later * (x[n + i] + 0.5 * later * a), later * a
    return -1.0 if rests else later


# ---- a round ----


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
def write_directions(scene: Scene, vectors: Floats, units: Floats):
    """Write into `units` the unit vectors along `vectors` (r, d), zero for a zero vector."""
    d = scene.d
    for c in range(scene.r):
        length = find_length(vectors[c * d :], d)
        for i in range(c * d, c * d + d):
            units[i] = vectors[i] / length if length > 0 else 0.0


@loop
def has_paradox(scene: Scene, member: Member, push: Floats, sticks: Floats, direction: Floats, room: Room) -> bool:
    """True if friction cancels a contact's response to its normal force.

    Then no force, or more than one, keeps it closed: Painlevé's paradox.
    """
    k, r, d, rough, coupling = scene.k, scene.r, scene.d, scene.rough, room.coupling
    size = k + r * d
    for c in range(r):
        if push[rough[c]] > 0 and sticks[c] == 0:
            own, brought = coupling[rough[c] * size + rough[c]], 0.0
            for i in range(d):
                brought += coupling[rough[c] * size + k + c * d + i] * direction[c * d + i]
            if not 1.0 - member.mu[c] * brought / (own if own > 0 else 1.0) > PARADOX:
                return True
    return False


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


# ---- what happens at a watch that fell ----


@loop
def change_contacts(scene: Scene, member: Member, first: int, row: Entry, room: Room) -> int:
    """Update a member after watch `first` fell, record the change in the row, and return the result code."""
    n, k, r, x, meets, opening = scene.n, scene.k, scene.r, member.x, row.meets, room.opening
    closed = x[2 * n + 1 + scene.numbers :]
    copy(closed, room.closed, k)
    copy(closed[k:], room.stuck, r)
    for i in range(k):
        meets[i], opening[i] = float(i == first and closed[i] == 0), 0.0
    later, at_corner = 0.0, 0
    if scene.corners > 0:
        at_corner = pass_corners(scene, member, meets, room)
        later = room.later
    open_all(scene, x, member.opened)
    evaluate(scene.response, member.opened, room.gradients)
    missed = write_participants(scene, member, meets, row, room)
    hits = row.hits > 0
    measure_slips(scene, member, room.rates, x[n:], room.slips, room)
    close_contacts(scene, member, first, hits, meets, room)
    undecided = find_change(scene, member, hits, row, room)
    close_pressing(scene, member, hits, room)
    record_changes(scene, member, first, hits, row, room)
    if r > 0:
        decide_sticking(scene, member, first, hits, room)
        write_directions(scene, closed[k + r :], room.free)
        if has_paradox(scene, member, closed, closed[k:], room.free, room):
            undecided = True
    fits = write_independent_rows(scene, closed, room)
    count_doubts(scene, member, hits, row, room)
    apply_change(scene, member, first, meets, row, room)
    x[2 * n] += later
    row.later_on = later
    write_change_name(scene, first, hits, closed, row, room)
    if at_corner == 2 or (missed and at_corner == 1):
        return AT_CORNER
    if missed:
        return MISSED
    return UNDECIDED if undecided or not fits else SUCCESSFUL


@loop
def write_independent_rows(scene: Scene, did: Floats, room: Room) -> bool:
    """Write the independent rows by which contacts are held; returns whether there are enough slots.

    `did` has the contact states. Scenes with fewer rows than coordinates hold all rows.
    """
    k, r, d, gaps = scene.k, scene.r, scene.d, 0
    if scene.gap_slots + scene.slots == 0:
        return True
    held, velocities = did[k + r + r * d :], 0
    select_rows(k, r, d, scene.rough, room.coupling, did, did[k:], held, room.free)
    for i in range(k + r * d):
        if i < scene.gaps:
            gaps += int(held[i])
        else:
            velocities += int(held[i])
    return gaps <= scene.gap_slots and velocities <= scene.slots


@loop
def record_changes(scene: Scene, member: Member, first: int, hits: bool, row: Entry, room: Room):
    """Record which contacts have changed, as `CHANGED`, which watches restart, and which slips start at rest."""
    n, k, x, leaves_rest = scene.n, scene.k, member.x, False
    closed = x[2 * n + 1 + scene.numbers :]
    for i in range(k):
        room.changed[i] = float(closed[i] != room.closed[i] or (hits and room.involved[i] > 0))
        if room.changed[i] > 0:
            member.fresh[i] = 1.0
        if room.opening[i] > 0:  # at a corner
            for g in range(k + scene.r, scene.watches):
                member.fresh[g] = 1.0
    for c in range(scene.r):
        breaks = first == k + c and room.stuck[c] > 0
        leaves_rest = leaves_rest or (breaks and scene.d > 1)
        row.starts[c] = 0.0
        if breaks and x[2 * n] == member.first:
            for j in range(scene.d * n):
                row.starts[c] += TOGETHER * abs(room.gradients[(k + c * scene.d) * n + j])
    row.leaves_rest = float(leaves_rest)


@loop
def pass_corners(scene: Scene, member: Member, meets: Floats, room: Room) -> int:
    """Write which contacts reach a corner, and open there; move the state beyond it.

    Returns 2 if one is struck at its corner, or stays there, 1 if one closes behind its corner, else 0.
    """
    k, count, x, touches = scene.k, scene.corners, member.x, scene.touch
    corners, passed, opening = room.corner, room.passed, room.opening
    near, answer, closed = x[scene.inputs - 1], 0, room.closed
    locate_corners(scene, member, x, room)
    for p in range(count):
        away, new, is_closed, is_met = abs(corners[p]), member.fresh[k + scene.r + p] == 0, False, False
        for i in range(k):
            if touches[p * k + i] > 0:
                is_closed, is_met = is_closed or closed[i] > 0, is_met or meets[i] > 0
        passed[p] = float(away <= 2.0 * near and new and is_closed)
        if is_met and away <= 4.0 * corners[2 * count + p]:
            answer = max(answer, 2 if new else 1)
        for i in range(k):
            if passed[p] > 0 and touches[p * k + i] > 0 and closed[i] > 0:
                opening[i] = 1.0
    later = write_corner_move(scene, member, x, room)
    room.later = max(later, 0.0)
    return 2 if later < 0 else answer


@loop
def write_participants(scene: Scene, member: Member, meets: Floats, row: Entry, room: Room) -> bool:
    """Write which contacts take part in the change at contacts `meets`, and their roles.

    The row tells if it is an impact.

    Returns whether its root was missed before.
    """
    k, touches, involved, noise = scene.k, room.touches, room.involved, room.noise
    parting, push, linked = room.parting, room.push, room.stay
    closed, fastest, hits, missed = room.closed, 0.0, False, False
    write_touching(scene, member, member.opened, room)
    for i in range(k):
        if meets[i] > 0 or closed[i] > 0 or i >= scene.gaps:
            touches[i] = 1.0
        noise[i] = max(noise[i], 0.01 * member.rate_rounding[i])
        hits = hits or (meets[i] > 0 and parting[i] < -noise[i])
        missed = missed or (meets[i] > 0 and has_missed(scene, member, room.watched, i, closed[i] > 0))
    spread_impulse(scene, meets, linked, room)
    for i in range(k):
        involved[i] = meets[i] if scene.law == SEQUENTIAL else linked[i]
    if hits:
        find_pushes(scene, member, row, room)
    for i in range(k):
        presses = parting[i] > noise[i] and push[i] > 0 and i < scene.gaps
        closes = parting[i] < -noise[i] or presses
        alone = linked[i] > 0 and meets[i] == 0 and closed[i] == 0 and member.fresh[i] == 0
        row.shares[i] = TOGETHER * abs(room.rates[i]) if hits and alone and closes else 0.0
        fastest = max(fastest, abs(parting[i]))
    for i in range(k):
        noise[i] = max(noise[i], 1e-12 * fastest)
    row.hits = float(hits)
    return missed


@loop
def spread_impulse(scene: Scene, meets: Floats, found: Floats, room: Room):
    """Write into `found` (k,) the touching contacts that an impulse at `meets` reaches, or spreads to."""
    k, r, d, coupling, rough = scene.k, scene.r, scene.d, room.coupling, scene.rough
    size, touches, reached, done, count = k + r * d, room.touches, room.free, 0, 0
    copy(meets, found, k)
    for i in range(k):
        if meets[i] > 0 and touches[i] > 0:
            reached[count] = float(i)
            count += 1
    while done < count:
        for b in range(size):
            if (b if b < k else rough[(b - k) // d]) == int(reached[done]):
                for a in range(size):
                    i = a if a < k else rough[(a - k) // d]
                    own = sqrt(abs(coupling[a * size + a])) * sqrt(abs(coupling[b * size + b]))
                    if found[i] == 0 and touches[i] > 0 and abs(coupling[a * size + b]) > LINKED * own:
                        found[i], reached[count] = 1.0, float(i)
                        count += 1
        done += 1


@loop
def find_pushes(scene: Scene, member: Member, row: Entry, room: Room):
    """Write the pattern of an impact: which contacts push, which slips stick, and the directions of the rest."""
    k, r, d, rough = scene.k, scene.r, scene.d, scene.rough
    mu, e, coupling, rates = member.mu, member.restitution, room.coupling, room.rates
    involved, push = room.involved, room.push
    stuck, direction = row.slides, row.direction
    rest = room.free
    if scene.law != POISSON:
        find_pattern(k, r, d, rough, mu, coupling, rates, involved, e, push, stuck, direction, rest)
        return
    if r > 0:  # one contact in a plane
        push[0], stuck[0], direction[0] = 1.0, 0.0, 0.0
        return
    none, second, impulses, behind = rest, rest[k:], rest[2 * k :], rest[3 * k :]
    more = rest[4 * k :]
    for i in range(k):
        none[i] = 0.0
    find_pattern(k, r, d, rough, mu, coupling, rates, involved, none, push, stuck, direction, more)
    select_rows(k, r, d, rough, coupling, push, stuck, row.compressed, more)
    find_impulses(k, r, d, rough, mu, coupling, rates, push, stuck, direction, none, impulses, more)
    for i in range(k):
        impulses[i] *= 1.0 + e[i]
    add_rates(rates, coupling, impulses, behind, k)
    find_pattern(k, r, d, rough, mu, coupling, behind, involved, none, second, stuck, direction, more)
    select_rows(k, r, d, rough, coupling, second, stuck, row.returned, more)
    find_impulses(k, r, d, rough, mu, coupling, behind, second, stuck, direction, none, impulses, more)
    add_rates(behind, coupling, impulses, room.targets, k)
    for i in range(k):
        push[i] = max(push[i], second[i])


@loop
def close_contacts(scene: Scene, member: Member, first: int, hits: bool, meets: Floats, room: Room):
    """Update which contacts are closed, stick and slide after watch `first`; `PARTS` are those that separate.

    A gap that falls although its contacts separate is zero to more than the rounding of its terms: it continues. If it
    hardly moves, as at the end of many bounces, it closes. A spatial slip that has turned continues. If one stops,
    others of the same body may, and stick as well. When parts align, a slip that gaps determine passes through zero,
    and turns.
    """
    n, k, r, d, x, rough = scene.n, scene.k, scene.r, scene.d, member.x, scene.rough
    closed, was_closed, was_stuck = x[2 * n + 1 + scene.numbers :], room.closed, room.stuck
    sticks, parts, slips, turns = closed[k:], room.parts, room.slips, room.turns_back
    for i in range(k):
        moves = 0.0
        for j in range(n):
            moves += abs(room.gradients[i * n + j]) * member.largest[n + j]
        away = room.rates[i] > max(room.noise[i], HARDLY * moves)
        parts[i] = float(meets[i] > 0 and not hits and i < scene.gaps and away)
        stays = was_closed[i] > 0 and i != first and room.opening[i] == 0
        closed[i] = float(stays or (meets[i] > 0 and parts[i] == 0))
    stops = False
    for c in range(r):
        if k + c == first and was_stuck[c] == 0 and (d == 1 or slips[r + c] <= RATE_JUMP_TOLERANCE * member.slip[c]):
            stops = True
    for c in range(r):
        fell = k + c == first and (was_stuck[c] > 0 or d == 1 or slips[r + c] <= RATE_JUMP_TOLERANCE * member.slip[c])
        if closed[rough[c]] != was_closed[rough[c]]:
            sticks[c] = slips[c]
        else:
            does = was_stuck[c] > 0 or fell or (stops and slips[c] > 0)
            sticks[c] = float(does and not (fell and was_stuck[c] > 0))
        turns[c] = 0.0
    if d == 1 and first >= k and first < k + r and sticks[first - k] > 0:
        held, rest = room.free, room.free[k + r :]
        for i in range(k + r):
            held[i] = closed[i] if i < k else float(i == first)
        drop_dependent(room.coupling, held, k + r, rest)
        if held[first] == 0:
            turns[first - k], sticks[first - k] = 1.0, 0.0


@loop
def find_change(scene: Scene, member: Member, hits: bool, row: Entry, room: Room) -> bool:
    """Write the impulses, the rates after them, and the change of velocities; returns whether the law is violated.

    After an impact they follow its law; else velocities are projected onto those that the closed contacts allow.
    """
    n, k, r, d, rough = scene.n, scene.k, scene.r, scene.d, scene.rough
    coupling, rates, push, targets, impulses = room.coupling, room.rates, room.push, room.targets, room.impulses
    stuck, direction, size, wrong = row.slides, row.direction, k + r * d, False
    mu, rest = member.mu, room.free
    if not hits:
        mu, rest = room.free, room.free[r:]
        for c in range(r):
            mu[c] = 0.0
    require_rates(scene, member, hits, row, room)
    find_impulses(k, r, d, rough, mu, coupling, rates, push, stuck, direction, targets, impulses, rest)
    if hits:
        wrong = is_violated(scene, member, row, room)
        row.t_impact = member.x[2 * n]
        if end_bounces(scene, member, row, room):
            for i in range(k):
                targets[i] = 0.0 if row.ends[i] > 0 else targets[i]
            find_impulses(k, r, d, rough, mu, coupling, rates, push, stuck, direction, targets, impulses, rest)
    select_rows(k, r, d, rough, coupling, push, stuck, row.held, rest)
    for c in range(r):
        stuck[c] = (1.0 - stuck[c]) * push[rough[c]] if hits else 0.0  # from here on those that slide
    add_rates(rates, coupling, impulses, room.apart, size)
    for j in range(n):
        room.jump[j] = 0.0
        for i in range(size):
            room.jump[j] += impulses[i] * room.responses[i * n + j]
    return wrong


@loop
def require_rates(scene: Scene, member: Member, hits: bool, row: Entry, room: Room):
    """Write the rates required after an impact by its law, unless set; else zero for closed and sticking contacts."""
    k, d, e, targets = scene.k, scene.d, member.restitution, room.targets
    did = member.x[2 * scene.n + 1 + scene.numbers :]
    if not hits:
        for i in range(k):
            room.push[i], targets[i] = did[i], 0.0
        for c in range(scene.r):
            row.slides[c] = did[k + c]
            for i in range(d):
                row.direction[c * d + i] = 0.0
    elif scene.law != POISSON:
        for i in range(k):
            targets[i] = -e[i] * room.rates[i]
    elif scene.r > 0:
        x = room.free
        copy(room.coupling, x, 4)
        copy(room.rates, x[4:], 2)
        x[6], x[7] = e[0], member.mu[0]
        evaluate(scene.construct, x, x[8:])
        targets[0], row.direction[0] = x[8], x[9]


@loop
def is_violated(scene: Scene, member: Member, row: Entry, room: Room) -> bool:
    """True if the impulses of an impact violate the law; for Poisson's the rates are what compression leaves."""
    k, r, targets, flags, rest = scene.k, scene.r, room.targets, room.free, room.free[scene.k + scene.r :]
    if scene.law == POISSON:
        if r > 0:  # by construction
            return False
        targets, rest = rest, rest[k:]
        for i in range(k):
            targets[i] = 0.0
    find_violations(
        k, r, scene.d, scene.rough, member.mu, room.coupling, room.rates, room.involved, room.push, row.slides,
        row.direction, targets, room.impulses, flags, rest
    )  # fmt: skip
    for i in range(k + r):
        if flags[i] > 0:
            return True
    return False


@loop
def end_bounces(scene: Scene, member: Member, row: Entry, room: Room) -> bool:
    """Write which bouncing contacts come to rest at once, and add the time that it takes; returns whether any does.

    With gap″ = −b − b′ s the bounces take 2u/(b (1 − e)) (1 − ⅔ k), k = b′ u / b² (1 − e), up to k².
    """
    n, k, size, inputs = scene.n, scene.k, scene.k + scene.r * scene.d, scene.inputs
    e, targets, ends, any_ends = member.restitution, room.targets, row.ends, False
    x, behind = room.free, room.free[2 * inputs :]
    may_end = False
    for i in range(k):
        ends[i] = 0.0
        may_end = may_end or (e[i] < 1 and room.push[i] > 0 and i < scene.gaps)
    if not may_end:
        return False
    copy(member.opened, x, inputs)
    for j in range(n):
        for i in range(size):
            x[n + j] += room.impulses[i] * room.responses[i * n + j]
    for j in range(inputs):
        x[inputs + j] = 0.0
    copy(x[n:], x[inputs:], n)
    evaluate(scene.acceleration, x, x[inputs + n :])
    x[inputs + 2 * n] = 1.0
    evaluate(scene.bends, x, behind)  # how gaps bend, and how that changes
    for i in range(k):
        b, bounced, rest = -behind[i], targets[i], 1.0 - e[i] if e[i] < 1 else 1.0
        if b > 0 and e[i] < 1 and i < scene.gaps and room.push[i] > 0:
            uneven = -behind[k + i] * bounced / (b**2 * rest)
            left = 2.0 * bounced / (b * rest) * (1.0 - 2.0 / 3.0 * uneven)
            short = left >= 0 and left <= SHORT * member.longest
            if short and uneven**2 * left <= LEFT_OUT * (1.0 + abs(x[2 * n])):
                ends[i], any_ends = 1.0, True
                row.t_impact += left
    return any_ends


@loop
def close_pressing(scene: Scene, member: Member, hits: bool, room: Room):
    """Close the contacts that stay in touch after an impact, and press upon each other there.

    Their accelerations decide, without friction; with friction, or where these are zero, later rounds do. All redundant
    contacts stay closed.
    """
    n, k, r, coupling = scene.n, scene.k, scene.r, room.coupling
    closed, stay, rest = member.x[2 * n + 1 + scene.numbers :], room.stay, room.free
    if not hits:
        return
    count = 0
    for i in range(k):
        still = abs(room.apart[i]) <= room.noise[i]
        stay[i] = float(room.touches[i] > 0 and still)
        closed[i] = stay[i]
        count += int(stay[i])
    if r > 0 or k == 1 or count == 0:
        return
    held, more, none = rest, rest[k:], rest[2 * k :]
    x, behind = rest[3 * k :], rest[3 * k + scene.inputs :]
    copy(stay, held, k)
    left = behind[2 * k * n + k * k + 3 * k :]
    drop_dependent(coupling, held, k, left)
    for i in range(k):
        none[i] = 0.0
        if held[i] < stay[i]:
            return
    copy(member.opened, x, scene.inputs)
    for j in range(n):
        x[n + j] += room.jump[j]
    evaluate(scene.response, x, behind)
    bends = behind[2 * k * n + k * k + 2 * k :]
    find_pattern(
        k, 0, 1, scene.rough, none, coupling, bends, stay, none, more, none, none, left
    )  # fmt: skip
    for i in range(k):
        closed[i] = float(stay[i] > 0 and more[i] > 0)


@loop
def decide_sticking(scene: Scene, member: Member, first: int, hits: bool, room: Room):
    """Write which contacts stick after a change, and the directions of those that slide; `CHANGED` marks changes.

    Contacts that start to slide move against the force that held them, or along their slip.
    """
    n, k, r, d, x, rough = scene.n, scene.k, scene.r, scene.d, member.x, scene.rough
    did, flags, behind = x[2 * n + 1 + scene.numbers :], room.changed, room.slips_behind
    sticks, direction, apart = did[k:], did[k + r :], room.apart
    slip, v, forces, was_stuck = member.slip, room.free, room.forces, room.stuck
    if first >= k and first < k + r and was_stuck[first - k] > 0:
        write_held_force(scene, member, first - k, v, room)
    for j in range(n):
        v[j] = x[n + j] + room.jump[j]
    measure_slips(scene, member, apart, v, behind, room)
    lasts = member.longest if member.longest > 0 else member.last - member.first
    for c in range(r):
        renewed, breaks = flags[rough[c]] > 0, first == k + c and was_stuck[c] > 0
        if hits and renewed:
            sticks[c] = behind[c]
        if breaks or ((renewed or d > 1) and behind[c] == 0):
            moving = forces if breaks else apart[k + c * d :]
            if d == 1:
                direction[c] = -1.0 if moving[0] < 0 else 1.0
            else:
                length, soon = NO_SLIP * find_length(moving, d), 0.0
                if breaks:
                    for i in range(d):
                        place = k + c * d + i
                        soon = max(soon, room.coupling[place * (k + r * d) + place])
                    length = AT_REST * max(slip[c], find_length(moving, d) * soon * lasts)
                whole = find_length(moving, d)
                for i in range(d):
                    direction[c * d + i] = moving[i] / (whole if whole > 0 else 1.0) * (length if length > 0 else LEAST)
        if room.turns_back[c] > 0:
            for i in range(d):
                direction[c * d + i] = -direction[c * d + i]
        slip[c] = max(slip[c], room.slips[r + c])
        if renewed or first == k + c or sticks[c] != was_stuck[c]:
            member.fresh[k + c] = 1.0


@loop
def write_held_force(scene: Scene, member: Member, c: int, x: Floats, room: Room):
    """Write the direction −f (d,) in which contact c starts to slide: against the force that held it before."""
    n, k, r, d, inputs, rows = scene.n, scene.k, scene.r, scene.d, scene.inputs, scene.tangential
    copy(member.x, x, inputs)
    copy(room.closed, x[2 * n + 1 + scene.numbers :], k)
    copy(room.stuck, x[2 * n + 1 + scene.numbers + k :], r)
    evaluate(scene.multipliers, x, x[inputs:])
    for i in range(d):
        room.forces[i] = -x[inputs + rows[c * d + i]]


@loop
def count_doubts(scene: Scene, member: Member, hits: bool, row: Entry, room: Room):
    """Count doubtful events: an impact that gains energy, a shared one, derivatives that do not exist."""
    k, r, d, n = scene.k, scene.r, scene.d, scene.n
    total, terms, shares, starts = 0.0, 0.0, False, row.leaves_rest > 0
    for i in range(k + r * d):
        total += room.impulses[i] * (room.rates[i] + room.apart[i])
        terms += abs(room.impulses[i]) * (abs(room.rates[i]) + abs(room.apart[i]))
    for i in range(k):
        shares = shares or row.shares[i] > 0
    for c in range(r):
        starts = starts or row.starts[c] > 0
    for i in range(3):
        doubt = (hits and total > GAINED * terms) if i == 0 else ((hits and shares) if i == 1 else starts)
        if doubt:
            if member.doubts[i] == 0:
                member.doubted[i] = member.x[2 * n]
            member.doubts[i] += 1.0


@loop
def apply_change(scene: Scene, member: Member, first: int, meets: Floats, row: Entry, room: Room):
    """Change the state by the change of velocities, where contacts `meets` close; record what rounding leaves.

    The gap that closes is set to zero, also for its derivatives: its rounding would grow with each bounce. A number
    below its own rounding is set to zero: otherwise steps would be short enough to resolve it.
    """
    n, k, size, x = scene.n, scene.k, scene.k + scene.r * scene.d, member.x
    responses, coupling, largest = room.responses, room.coupling, member.largest
    offset, change, lost = row.offset, room.jump, 0.0
    for i in range(size):
        for j in range(n):
            part = room.impulses[i] * room.gradients[i * n + j]
            lost -= part * (x[n + j] + 0.5 * change[j])
    row.lost = lost
    copy(room.impulses, row.impulse, k)
    for j in range(2 * n):
        offset[j] = room.shift[j] if scene.corners > 0 else 0.0
        x[j] += offset[j]
        largest[j] = max(largest[j], abs(x[j]))
    record_force_noise(scene, member, first, room)
    for i in range(k):
        if meets[i] > 0 and i < scene.gaps:
            for j in range(n):
                x[j] -= room.values[i] / coupling[i * size + i] * responses[i * n + j]
    for j in range(n):
        x[n + j] += change[j]
    for j in range(2 * n):
        if abs(x[j]) <= 2.0 * EPS * largest[j]:
            offset[j] -= x[j]
            x[j] = 0.0
    for i in range(k):
        if room.parts[i] > 0:
            for j in range(n):
                beyond = 4.0 * member.rounding[i] / coupling[i * size + i] * responses[i * n + j]
                x[j] += beyond
                offset[j] += beyond


@loop
def record_force_noise(scene: Scene, member: Member, first: int, room: Room):
    """Record which forces are zero before a change of velocities, and the rounding that could cause some."""
    n, total, x, longest = scene.n, scene.watches, member.x, member.longest
    values, rates = member.rounding, member.rate_rounding
    lasts = longest if longest > 0 else member.last - member.first
    for i in range(scene.k):
        own, fast = room.coupling[i * (scene.k + scene.r * scene.d) + i], 0.0
        for j in range(n):
            fast += abs(room.gradients[i * n + j]) * max(abs(x[n + j]), abs(x[n + j] + room.jump[j]))
        if longest > 0:
            least = FORCELESS * (fast / own) / longest
            values[total + i] = max(values[total + i], least)
            rates[total + i] = max(rates[total + i], least / longest)
        noise = values[i] + lasts * rates[i]
        member.force_noise[i] = 2.0 * TIED_MOVES * noise / (own * lasts**2)
        if i == first and room.closed[i] > 0:
            rates[i] = max(rates[i], longest * own * values[total + i])


@loop
def write_change_name(scene: Scene, first: int, hits: bool, did: Floats, row: Entry, room: Room):
    """Write into the row which contact changed at watch `first`, and the kind of the change."""
    k, r, rough = scene.k, scene.r, scene.rough
    contact, change = -1, -1
    if first < k:
        contact, change = first, CLOSES if did[first] > 0 else (BOUNCES if hits else OPENS)
    elif first < k + r:
        contact, change = rough[first - k], STICKS if did[first] > 0 else SLIDES
    else:
        for i in range(k - 1, -1, -1):
            if room.opening[i] > 0:
                contact, change = i, OPENS
    row.contact, row.change = float(contact), float(change)


# ---- a member ----


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
