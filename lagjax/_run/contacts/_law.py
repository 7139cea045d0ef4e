"""The law of impacts on numbers: which contacts push, stick or slide, and the impulses (see `_impact_derivatives`).

There are k normal rows, then those of the slips, d for each of r contacts; `size` = k + r d. Flags are doubles, 0 or 1.
The last argument of a loop is its scratch memory; results are written into array arguments.
"""

from math import atan2, cos, sin, sqrt

from lagjax._native import Floats, Wholes, loop

EPS = 2.0**-52
# A row depends on those before it if no more than this fraction of its pivot is left (as in `_equations._linear`).
DEPENDENT = EPS ** (2 / 3)
# The fraction of the largest velocity by which a solution may miss an inequality: a thousand roundings of a system.
MISSES = 1e-11
# What is zero in a tableau whose numbers are of one: some thousand roundings.
SMALL_PIVOT, TINY = 1e-12, 1e-300
# Pivots for each condition before the law counts as undecided: as many as there are take a few in all.
PIVOTS = 16
# Steps of Newton's method, of which there are some four, and the turn, an angle, below which they end.
TURNS, ALIGNED = 30, 1e-9
LINKED = 1e-14  # a coupling, as a fraction of what two contacts respond to their own impulses, that is none


@loop
def drop_dependent(coupling: Floats, held: Floats, size: int, work: Floats):
    """Set to 0 the flags `held` (size,) of rows that depend on those before them, by elimination without pivoting."""
    for i in range(size * size):
        work[i] = coupling[i]
    for i in range(size):
        pivot = work[i * size + i]
        if held[i] > 0 and pivot > DEPENDENT * coupling[i * size + i]:
            held[i] = 1.0
            for row in range(i + 1, size):
                part = work[row * size + i] / pivot
                for column in range(i + 1, size):
                    work[row * size + column] -= part * work[i * size + column]
        else:
            held[i] = 0.0


@loop
def solve_dense(matrix: Floats, right: Floats, size: int):
    """Overwrite `right` (size,) with the solution of matrix x = right, by elimination with row pivoting."""
    for i in range(size):
        best = i
        for row in range(i + 1, size):
            if abs(matrix[row * size + i]) > abs(matrix[best * size + i]):
                best = row
        if best != i:
            for column in range(size):
                matrix[i * size + column], matrix[best * size + column] = (
                    matrix[best * size + column], matrix[i * size + column]
                )  # fmt: skip
            right[i], right[best] = right[best], right[i]
        for row in range(i + 1, size):
            part = matrix[row * size + i] / matrix[i * size + i]
            if part != 0:
                for column in range(i + 1, size):
                    matrix[row * size + column] -= part * matrix[i * size + column]
                right[row] -= part * right[i]
    for i in range(size - 1, -1, -1):
        for column in range(i + 1, size):
            right[i] -= matrix[i * size + column] * right[column]
        right[i] = right[i] / matrix[i * size + i]


@loop
def select_rows(
    k: int, r: int, d: int, rough: Wholes, coupling: Floats, push: Floats, sticks: Floats, held: Floats, work: Floats
):
    """Write into `held` 1 for the rows with prescribed rates: of contacts that push, and of slips that stick."""
    for i in range(k):
        held[i] = push[i]
    for c in range(r):
        for x in range(d):
            held[k + c * d + x] = push[rough[c]] * sticks[c]
    if k + r * d > 1:
        drop_dependent(coupling, held, k + r * d, work)


@loop
def mix_friction(k: int, r: int, d: int, rough: Wholes, slides: Floats, direction: Floats, impulses: Floats):
    """Add to the tangential impulses the friction of contacts that slide, of which `slides` is μ, else 0."""
    for c in range(r):
        for x in range(d):
            impulses[k + c * d + x] -= slides[c] * direction[c * d + x] * impulses[rough[c]]


@loop
def write_impulse_system(
    k: int, r: int, d: int, rough: Wholes, coupling: Floats, slides: Floats, direction: Floats, held: Floats,
    matrix: Floats
):  # fmt: skip
    """Write into `matrix` the system of the rows `held`: their rates by impulses with their friction."""
    size = k + r * d
    for i in range(size):
        for j in range(size):
            matrix[i * size + j] = coupling[i * size + j] * held[i]
        for c in range(r):
            for x in range(d):
                brought = slides[c] * direction[c * d + x] * coupling[i * size + k + c * d + x]
                matrix[i * size + rough[c]] -= brought * held[i]
        matrix[i * size + i] += 1.0 - held[i]


@loop
def find_impulses(
    k: int, r: int, d: int, rough: Wholes, mu: Floats, coupling: Floats, rates: Floats, push: Floats, sticks: Floats,
    direction: Floats, targets: Floats, impulses: Floats, work: Floats
):  # fmt: skip
    """Write the impulses (size,) that give pushing contacts the rates `targets` (k,), and sticking slips rate 0.

    In space the directions of sliding slips become those after the impact, by Newton's method.
    """
    size, off = k + r * d, 1.0
    held, slides, system = work, work[size:], work[size + r :]
    rest = system[size * size :]
    select_rows(k, r, d, rough, coupling, push, sticks, held, system)
    for c in range(r):
        slides[c] = mu[c] * push[rough[c]] * (1.0 - sticks[c])
    for _ in range(TURNS):
        write_impulse_system(k, r, d, rough, coupling, slides, direction, held, system)
        for i in range(size):
            impulses[i] = held[i] * ((targets[i] if i < k else 0.0) - rates[i])
        solve_dense(system, impulses, size)
        mix_friction(k, r, d, rough, slides, direction, impulses)
        if d == 1 or r == 0 or off <= ALIGNED:
            break
        off = turn_directions(k, r, rough, coupling, rates, slides, direction, held, impulses, rest)


@loop
def turn_directions(
    k: int, r: int, rough: Wholes, coupling: Floats, rates: Floats, slides: Floats, along: Floats, held: Floats,
    impulses: Floats, work: Floats
) -> float:  # fmt: skip
    """Turn the directions (r, 2) of contacts that slide, given the `impulses` along them: one Newton step.

    Returns the largest of these angles.
    """
    size = k + 2 * r
    after, moved, system = work, work[size:], work[2 * size :]
    across, slopes = system[size * size :], system[size * size + r :]
    add_rates(rates, coupling, impulses, after, size)
    for c in range(r):
        u, w = after[k + 2 * c], after[k + 2 * c + 1]
        length = max(abs(u), abs(w))
        moves = slides[c] > 0 and length > 0
        across[c] = (u * along[2 * c + 1] - w * along[2 * c]) / length if moves else 0.0
    for j in range(r):  # how all turn by the direction of one
        for i in range(size):
            moved[i] = 0.0
            for x in range(2):
                turned = along[2 * j + 1] if x == 0 else -along[2 * j]
                moved[i] -= held[i] * coupling[i * size + k + 2 * j + x] * slides[j] * turned * impulses[rough[j]]
        write_impulse_system(k, r, 2, rough, coupling, slides, along, held, system)
        solve_dense(system, moved, size)
        mix_friction(k, r, 2, rough, slides, along, moved)
        for x in range(2):
            turned = along[2 * j + 1] if x == 0 else -along[2 * j]
            moved[k + 2 * j + x] += slides[j] * turned * impulses[rough[j]]
        for c in range(r):
            dx, dy, length = 0.0, 0.0, max(abs(after[k + 2 * c]), abs(after[k + 2 * c + 1]))
            for i in range(size):
                dx += coupling[(k + 2 * c) * size + i] * moved[i]
                dy += coupling[(k + 2 * c + 1) * size + i] * moved[i]
            slope = dx * along[2 * c + 1] - dy * along[2 * c]
            if c == j:
                slope += after[k + 2 * c] * along[2 * c] + after[k + 2 * c + 1] * along[2 * c + 1]
            slopes[c * r + j] = slope / length if slides[c] > 0 and length > 0 else 0.0
    for c in range(r):
        if slopes[c * r + c] == 0:
            slopes[c * r + c] = 1.0
    solve_dense(slopes, across, r)
    off = 0.0
    for c in range(r):
        if slides[c] > 0:
            angle, off = atan2(along[2 * c + 1], along[2 * c]) - across[c], max(off, abs(across[c]))
            along[2 * c], along[2 * c + 1] = cos(angle), sin(angle)
    return off


@loop
def add_rates(rates: Floats, coupling: Floats, impulses: Floats, after: Floats, size: int):
    """Write the rates after `impulses` into `after` (size,)."""
    for i in range(size):
        after[i] = rates[i]
        for j in range(size):
            after[i] += coupling[i * size + j] * impulses[j]


@loop
def find_violations(
    k: int, r: int, d: int, rough: Wholes, mu: Floats, coupling: Floats, rates: Floats, touches: Floats, push: Floats,
    sticks: Floats, direction: Floats, targets: Floats, impulses: Floats, wrong: Floats, work: Floats
):  # fmt: skip
    """Write into `wrong` (k + r,) 1 for conditions of the law that `impulses` violate: of normals, then of slips."""
    size, fastest = k + r * d, 0.0
    add_rates(rates, coupling, impulses, work, size)
    for i in range(size):
        fastest = max(fastest, abs(rates[i]))
    for i in range(k):
        left = impulses[i] * coupling[i * size + i] if push[i] > 0 else work[i] - targets[i]
        wrong[i] = float(touches[i] > 0 and left < -MISSES * fastest)
    for c in range(r):
        force, along, own = 0.0, 0.0, coupling[rough[c] * size + rough[c]]
        for x in range(d):
            force += impulses[k + c * d + x] ** 2
            along += work[k + c * d + x] * direction[c * d + x]
        left = (mu[c] * impulses[rough[c]] - sqrt(force)) * own if sticks[c] > 0 else along
        wrong[k + c] = float(push[rough[c]] > 0 and left < -MISSES * fastest)


@loop
def pivot_tableau(tableau: Floats, basis: Floats, row: int, enters: int, size: int):
    """Pivot a tableau: column `enters` replaces the basic variable of `row`."""
    width, pivot = 2 * size + 2, tableau[row * (2 * size + 2) + enters]
    for column in range(width):
        tableau[row * width + column] = tableau[row * width + column] / pivot
    for other in range(size):
        part = tableau[other * width + enters]
        if other != row and part != 0:
            for column in range(width):
                tableau[other * width + column] -= part * tableau[row * width + column]
    basis[row] = float(enters)


@loop
def solve_complementarity(matrix: Floats, values: Floats, size: int, chosen: Floats, tableau: Floats):
    """Write into `chosen` (size,) 1 for each z that may be positive in w = values + matrix z, w, z ≥ 0, w ⟂ z.

    By Lemke's pivoting: Cottle, Pang & Stone, *The Linear Complementarity Problem* (1992), algorithm 4.4.5.
    """
    width, cover, lowest, largest = 2 * size + 2, 2 * size, 0, TINY
    basis = tableau[size * width :]
    for i in range(size):
        largest = max(largest, abs(values[i]))
        if values[i] < values[lowest]:
            lowest = i
    for i in range(size):
        basis[i], chosen[i] = float(i), 0.0
        for j in range(size):
            tableau[i * width + j] = float(i == j)
            tableau[i * width + size + j] = -matrix[i * size + j]
        tableau[i * width + cover] = -1.0
        tableau[i * width + cover + 1] = values[i] / largest
    if not values[lowest] < 0:
        return
    pivot_tableau(tableau, basis, lowest, cover, size)
    enters = lowest + size
    for _ in range(PIVOTS * size):
        row, least = -1, 0.0
        for i in range(size):
            if tableau[i * width + enters] > SMALL_PIVOT:
                ratio = tableau[i * width + cover + 1] / tableau[i * width + enters]
                if row < 0 or ratio < least:
                    row, least = i, ratio
        if row < 0:
            break
        row = -1
        for i in range(size):  # of those that tie the cover goes first, it ends the search
            if tableau[i * width + enters] > SMALL_PIVOT:
                ratio = tableau[i * width + cover + 1] / tableau[i * width + enters]
                if ratio <= least + SMALL_PIVOT and (row < 0 or basis[i] == cover):
                    row = i
        leaves = int(basis[row])
        pivot_tableau(tableau, basis, row, enters, size)
        if leaves == cover:
            break
        enters = leaves + size if leaves < size else leaves - size
    for i in range(size):
        if basis[i] >= size and basis[i] < cover:
            chosen[int(basis[i]) - size] = 1.0


@loop
def find_pattern_in_plane(
    k: int, r: int, rough: Wholes, mu: Floats, coupling: Floats, rates: Floats, touches: Floats, targets: Floats,
    push: Floats, sticks: Floats, direction: Floats, work: Floats
):  # fmt: skip
    """Write the pattern of contacts without friction, or in a plane: a linear complementarity problem.

    With N the normal impulses, s⁺ = s_R − s_L and the friction R − μN, it is

        (ġ⁺ + e ġ⁻, s_R, 2μN − R) ≥ 0  ⟂  (N, R, s_L) ≥ 0
    """
    rows, size = k + r, k + 2 * r
    scale, values, chosen, matrix = work, work[rows:], work[rows + size :], work[rows + 2 * size :]
    tableau = matrix[size * size :]
    for i in range(rows):
        own = coupling[i * rows + i]
        scale[i] = 1.0 / sqrt(own) if own > 0 else 1.0
    for i in range(size * size):
        matrix[i] = 0.0
    for i in range(size):
        values[i] = 0.0
    for i in range(rows):
        if touches[i if i < k else rough[i - k]] > 0:
            values[i] = scale[i] * (rates[i] - (targets[i] if i < k else 0.0))
            for j in range(rows):
                if touches[j if j < k else rough[j - k]] > 0:
                    matrix[i * size + j] = coupling[i * rows + j] * scale[i] * scale[j]
    for c in range(r):
        brought = mu[c] * scale[rough[c]] / scale[k + c]
        for i in range(rows):
            matrix[i * size + rough[c]] -= brought * matrix[i * size + k + c]
        matrix[(k + c) * size + rows + c] = 1.0
        matrix[(rows + c) * size + rough[c]] = 2.0 * brought
        matrix[(rows + c) * size + k + c] = -1.0
    solve_complementarity(matrix, values, size, chosen, tableau)
    for i in range(k):
        push[i] = float(touches[i] > 0 and chosen[i] > 0)
    for c in range(r):
        sticks[c] = float(chosen[k + c] > 0 and chosen[rows + c] == 0)
        direction[c] = -1.0 if chosen[rows + c] > 0 else 1.0


@loop
def find_pattern_in_space(
    k: int, r: int, d: int, rough: Wholes, mu: Floats, coupling: Floats, rates: Floats, touches: Floats,
    targets: Floats, push: Floats, sticks: Floats, direction: Floats, work: Floats
):  # fmt: skip
    """Write the pattern of contacts in space, by principal pivoting: the first violated condition is exchanged.

    It starts with all sticking; if that cycles, as for contacts that depend on each other, with all sliding on as they
    arrive.
    """
    size = k + r * d
    impulses, wrong, rest = work, work[size:], work[size + k + r :]
    for step in range(2 * PIVOTS * (k + r)):
        if step % (PIVOTS * (k + r)) == 0:
            for i in range(k):
                push[i] = float(touches[i] > 0 and rates[i] <= 0)
            for c in range(r):
                length = 0.0
                for x in range(d):
                    length += rates[k + c * d + x] ** 2
                sticks[c] = float(step == 0 or length == 0)
                for x in range(d):
                    direction[c * d + x] = float(x == 0) if sticks[c] > 0 else rates[k + c * d + x] / sqrt(length)
        find_impulses(k, r, d, rough, mu, coupling, rates, push, sticks, direction, targets, impulses, rest)
        find_violations(
            k, r, d, rough, mu, coupling, rates, touches, push, sticks, direction, targets, impulses, wrong, rest
        )
        first = -1
        for i in range(k + r):  # friction first: a contact that sticks and pulls is taken back by sliding
            c = i - r if i >= r else k + i
            if first < 0 and wrong[c] > 0:
                first = c
        if first < 0:
            return
        if first < k:
            push[first] = 1.0 - push[first]
        else:
            c, length = first - k, 0.0
            for x in range(d):
                length += impulses[k + c * d + x] ** 2
            if sticks[c] > 0 and length > 0:
                for x in range(d):
                    direction[c * d + x] = -impulses[k + c * d + x] / sqrt(length)
            sticks[c] = 1.0 - sticks[c]


@loop
def find_pattern(
    k: int, r: int, d: int, rough: Wholes, mu: Floats, coupling: Floats, rates: Floats, touches: Floats,
    restitution: Floats, push: Floats, sticks: Floats, direction: Floats, work: Floats
):  # fmt: skip
    """Write the pattern of touching contacts (k,) in an impact by Newton's law; if undecided, it may violate it."""
    targets, rest = work, work[k:]
    for i in range(k):
        targets[i] = -restitution[i] * rates[i]
    if k == 1 and r == 0:
        push[0] = float(touches[0] > 0 and rates[0] < 0)
    elif k == 1 and d == 1:  # it sticks, if friction suffices, or slides against what that takes
        for i in range(4):
            rest[i] = coupling[i]
        rest[4], rest[5] = -(1.0 + restitution[0]) * rates[0], -rates[1]
        solve_dense(rest, rest[4:], 2)
        push[0], sticks[0] = 1.0, float(abs(rest[5]) <= mu[0] * rest[4])
        direction[0] = -1.0 if rest[5] > 0 else 1.0
    elif d == 1:
        find_pattern_in_plane(k, r, rough, mu, coupling, rates, touches, targets, push, sticks, direction, rest)
    else:
        find_pattern_in_space(k, r, d, rough, mu, coupling, rates, touches, targets, push, sticks, direction, rest)
