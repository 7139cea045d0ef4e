"""A change of contacts at an instant: impulses, and which contacts close, open, stick and slide from then on.

`change_contacts` is called where a watch fell (`_contact_search`); what happens is a row of the record. The functions
are loops on numbers, whose memory `_places` declares.
"""

from math import sqrt

from lagjax._interface import SUCCESSFUL
from lagjax._native import Floats, evaluate, loop
from lagjax._run.contacts._contact_state import (
    AT_CORNER,
    MISSED,
    UNDECIDED,
    find_length,
    has_missed,
    has_paradox,
    locate_corners,
    measure_slips,
    open_all,
    write_corner_move,
    write_directions,
    write_touching,
)
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
from lagjax._run.jumps import LEAST, copy

CLOSES, OPENS, BOUNCES, STICKS, SLIDES = range(5)  # the kinds of `ContactChanges`
SEQUENTIAL, POISSON = 1, 2
# Remaining bounce time, as a fraction of a step, below which a sequence of bounces is replaced by its limit, and the
# error of that, 1e-14 of a height in a step; doubling `SHORT` gives 4e-9.
SHORT, LEFT_OUT = 1e-4, 1e-14
# Forces that count as zero, as a fraction of those that stop the bodies within a step: some fifty roundings.
FORCELESS = 1e-14
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
