"""The state of a member of a scene with contacts: lengths, modes, slips, and places at corners of gaps.

The functions are loops on numbers, as those of `_contact_search` are, whose memory `_places` declares.
"""

from math import sqrt

from lagjax._interface import RESULTS, code_of
from lagjax._native import GUARD_NOISE, SMALLEST_STEP, Floats, evaluate, loop
from lagjax._run.contacts._law import EPS
from lagjax._run.contacts._places import Member, Room, Scene
from lagjax._run.jumps import bind_loops, copy, find_sign

(TOO_MANY, UNDECIDED, IN_TURN, MISSED, AT_CORNER, NOT_FINITE, INCONSISTENT, BACKWARDS, NO_RESTITUTION,
 NO_FRICTION) = map(
    code_of,
    (RESULTS.max_transitions_reached, RESULTS.contact_undecided, RESULTS.contacts_in_turn, RESULTS.contact_missed,
     RESULTS.contact_at_corner, RESULTS.nonfinite_state, RESULTS.inconsistent_start, RESULTS.contact_backwards,
     RESULTS.restitution_out_of_range, RESULTS.friction_out_of_range),
)  # fmt: skip
# A gap counts as passed if it is this many local errors of its largest terms below zero.
THROUGH = 100.0
# The response of a contact to its normal force, relative to that without sliding, below which it is zero to rounding:
# Painlevé's paradox.
PARADOX = 1e-12
# After a corner a motion continues from this fraction of the terms of its switching number beyond it. An event stops
# it `BEFORE` the corner: steps that end at a border may be rejected, and halve the rest.
BEYOND, BEFORE = 16.0 * EPS, 64.0 * SMALLEST_STEP
# If crossing a corner takes more than this fraction of the time of the motion, the contact rests on the corner.
ON_CORNER = 1e-10
OPEN, HELD = range(2)  # the modes
write_watches, write_times, write_outputs = bind_loops(globals())


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
