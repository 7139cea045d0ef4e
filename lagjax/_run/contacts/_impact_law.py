"""The law of impacts: impulses of contacts that touch, and velocities behind them.

With G the rows of k gaps and one-way velocities, and of r d slips, (K, n), q̇⁺ = q̇ + M⁻¹ Gᵀ E Λ, where E adds the
friction −μ c of a contact that slides to its normal impulse. Newton's law of restitution with Coulomb friction, for all
contacts that touch at once, asks for

    ġ⁺ + e ġ⁻ ≥ 0  ⟂  Λ ≥ 0        |F| ≤ μ Λ,  F = −μ Λ s⁺/|s⁺| where s⁺ ≠ 0

`find_pattern` finds which contacts push and stick; `impulse_solver` solves for what they do, and has derivatives. Of
Poisson's law are `find_phases`, without friction, and `construct_impulses`, of one contact with it.
Source: Moreau, in *Nonsmooth Mechanics and Applications* (1988), §11; Glocker, *Set-Valued Force Laws* (2001), ch. 9;
Murty, Linear Algebra Appl. 5 (1972) 65 (pivoting).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import factorize_general
from lagjax._primitives import start_alike

# Pivots for each condition before the law counts as undecided: as many as there are take a few in all.
PIVOTS = 16
# By how much of the largest velocity a solution may miss an inequality: some thousand roundings of a solved system.
MISSES = 1e-11
# What is zero in a tableau whose numbers are of one: some thousand roundings.
SMALL_PIVOT, _TINY = 1e-12, 1e-300
# What is left of a pivot, as a part of it, for a row to depend on those before it: as in `_equations._linear`.
DEPENDENT = float(np.finfo(float).eps) ** (2 / 3)


class ImpactRows(NamedTuple):
    """The rows of contacts at a state: those of the k normals, then those of the slips, d for each of r contacts.

    `gradients` G (K, n), `responses` G M⁻¹ (K, n), `coupling` G M⁻¹ Gᵀ (K, K), the `values` of gaps, one-way velocities
    and slips (K,), the `rates` that impulses change: those of gaps, and the other values; and `bends` (K,), how these
    change while no contact is closed.
    """

    gradients: Any
    responses: Any
    coupling: Any
    values: Any
    rates: Any
    bends: Any


class Pattern(NamedTuple):
    """The part that contacts take: `push` (k,), `sticks` (r,), the unit `direction` (r, d) in which others slide."""

    push: Any
    sticks: Any
    direction: Any


class Friction(NamedTuple):
    """The contacts with friction, `rough` (r,), in how many `directions`, and its coefficients μ (r,)."""

    rough: np.ndarray
    directions: int
    coefficients: Any

    @property
    def still(self) -> "Friction":
        return self._replace(coefficients=jax.lax.stop_gradient(self.coefficients))

    def places(self, count: int) -> np.ndarray:
        """The rows of the slips, (r, d), behind those of the `count` normals."""
        return count + np.arange(len(self.rough) * self.directions).reshape(-1, self.directions)


def impulse_solver(rows: ImpactRows, pattern: Pattern, friction: Friction) -> Callable:
    """The function of `targets` (k,) that gives the impulses (K,) by which rates become these, and slips that stick 0.

    Rates of contacts that push do. Rows that depend on those before them add nothing. The impulse of a row that is
    free is zero, that of a contact that slides brings its friction.
    """
    count, rough, push = len(pattern.push), friction.rough, pattern.push
    places = friction.places(count)
    held = jnp.concatenate([push, jnp.broadcast_to((push[rough] * pattern.sticks)[:, None], places.shape).ravel()])
    if len(held) > 1:
        held = held * independent_rows(jax.lax.stop_gradient(rows.coupling), held)
    slides = friction.coefficients * push[rough] * (1.0 - pattern.sticks)

    def solver_along(direction):
        mixed = jnp.eye(len(held))
        if rough.size:
            mixed = mixed.at[places, rough[:, None]].add(-slides[:, None] * direction)
        solve = factorize_general(held[:, None] * (rows.coupling @ mixed) + jnp.diag(1.0 - held))
        return lambda targets: mixed @ solve(held * (jnp.pad(targets, (0, places.size)) - rows.rates))

    if friction.directions == 1 or not rough.size:
        return solver_along(pattern.direction)

    def solve_in_space(targets):
        return _turn_directions(rows, lambda x: solver_along(x)(targets), pattern.direction, slides > 0, places)

    return solve_in_space


def _turn_directions(rows: ImpactRows, impulses_along, direction, slides, places):
    """The impulses (K,) along directions which are those of the slips behind the impact, also as the state varies.

    Two steps of Newton's method from where they are give derivatives of first and second order.
    """

    def off(angles):
        along = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
        impulses = impulses_along(along)
        after = (rows.rates + rows.coupling @ impulses)[places]
        across = after[:, 0] * along[:, 1] - after[:, 1] * along[:, 0]
        size = jax.lax.stop_gradient(jnp.abs(after).max(axis=1))
        turned = jnp.where(slides & (size > 0), across / jnp.where(size > 0, size, 1.0), 0.0)
        return turned, (turned, impulses)

    def turn(_, carry):
        slopes, (turned, impulses) = jax.jacfwd(off, has_aux=True)(carry[0])
        still = jnp.diag(jnp.where(jnp.diagonal(slopes) == 0, 1.0, 0.0))
        return carry[0] - factorize_general(slopes + still)(turned), impulses

    # XLA compiles one loop sooner than its rounds; the third one has the impulses behind two steps.
    angles = jax.lax.stop_gradient(jnp.arctan2(direction[:, 1], direction[:, 0]))
    first = angles, jnp.zeros_like(rows.rates)
    return jax.lax.fori_loop(0, 3, turn, start_alike(first, rows))[1]


def independent_rows(coupling, held):
    """1 for each of the rows `held` (K,) that does not depend on those before it, by elimination without pivots."""
    if len(held) == 2:
        first, second = jnp.diagonal(coupling)
        left = second - held[0] * coupling[1, 0] ** 2 / jnp.where(first > 0, first, 1.0)
        return jnp.stack([held[0], jnp.where(left > DEPENDENT * second, held[1], 0.0)])

    def eliminate(i, carry):
        matrix, kept = carry
        pivot = matrix[i, i]
        keep = (held[i] > 0) & (pivot > DEPENDENT * coupling[i, i])
        taken = jnp.outer(matrix[:, i], matrix[i]) / jnp.where(keep, pivot, 1.0)
        return matrix - jnp.where(keep, taken, 0.0), kept.at[i].set(keep)

    return jax.lax.fori_loop(0, len(held), eliminate, start_alike((coupling, jnp.zeros(len(held))), held))[1]


def held_slips(rows: ImpactRows, closed, slips, friction: Friction):
    """True for each contact in a plane of which one of the `slips` (r,) is held by the `closed` gaps (k,) already."""
    if friction.directions > 1 or not slips.size:
        return jnp.zeros_like(slips)
    held = jnp.concatenate([closed, slips]).astype(float)
    return slips & (independent_rows(rows.coupling, held)[len(closed) :] == 0)


def find_pattern(rows: ImpactRows, touches, restitution, friction: Friction) -> Pattern:
    """The pattern of contacts that touch (k,) in an impact; `violations` tells whether it solves the law.

    In space by principal pivoting: of what its solution violates, the first is taken back, until nothing is.
    """
    count, rough, places = len(touches), friction.rough, friction.places(len(touches))
    rates = rows.rates
    if count == 1 and not rough.size:
        return Pattern((touches & (rates < 0)).astype(float), jnp.zeros(0), jnp.zeros((0, friction.directions)))
    if count == 1 and friction.directions == 1:
        towards = jnp.concatenate([(1.0 + restitution) * rates[:1], rates[1:]])
        return _pattern_of_one(rows, towards, friction.coefficients)
    targets = -restitution * rates[:count]
    if friction.directions == 1:
        return _complementary_pattern(rows, touches, targets, friction)

    def pivot(carry):
        pattern, _, n = carry
        impulses = impulse_solver(rows, pattern, friction)(targets)
        normal, rubs = violations(rows, pattern, touches, impulses, targets, friction)
        # Friction first: a contact that sticks and pulls is taken back by sliding.
        first = jnp.arange(count + len(rough)) == jnp.where(rubs.any(), count + jnp.argmax(rubs), jnp.argmax(normal))
        wrong = normal.any() | rubs.any()
        push = jnp.where(wrong & first[:count], 1.0 - pattern.push, pattern.push)
        turns, forces = wrong & first[count:], impulses[places]
        size = jnp.sqrt(jnp.sum(forces**2, axis=1, keepdims=True))
        against = jnp.where((turns & (pattern.sticks > 0))[:, None], -forces / jnp.where(size > 0, size, 1.0), 0.0)
        direction = jnp.where(against != 0, against, pattern.direction)
        return Pattern(push, jnp.where(turns, 1.0 - pattern.sticks, pattern.sticks), direction), wrong, n + 1

    pushes = (touches & (rates[:count] <= 0)).astype(float)
    first = Pattern(pushes, jnp.ones(len(rough)), jnp.zeros(places.shape).at[:, 0].set(1.0))
    first, most = start_alike((first, jnp.asarray(True), 0), rows), PIVOTS * (count + len(rough))
    return jax.lax.while_loop(lambda carry: carry[1] & (carry[2] < most), pivot, first)[0]


def violations(rows: ImpactRows, pattern: Pattern, touches, impulses, targets, friction: Friction) -> tuple:
    """The conditions of the law that `impulses` (K,) violate: of normals (k,), whose rates are `targets`, and slips."""
    count, rough, places = len(targets), friction.rough, friction.places(len(targets))
    rates, own = rows.rates, jnp.diagonal(rows.coupling)
    after, pushes, least = rates + rows.coupling @ impulses, pattern.push > 0, MISSES * jnp.max(jnp.abs(rates))
    normal = jnp.where(pushes, impulses[:count] * own[:count], after[:count] - targets) < -least
    forces, slips = impulses[places], after[places]
    size, most = jnp.sqrt(jnp.sum(forces**2, axis=1)), friction.coefficients * impulses[rough]
    beyond = (size - most) * own[rough] > least
    reverse = jnp.sum(slips * pattern.direction, axis=1) < -least
    return touches & normal, pushes[rough] & jnp.where(pattern.sticks > 0, beyond, reverse)


def _complementary_pattern(rows: ImpactRows, touches, targets, friction: Friction) -> Pattern:
    """The pattern of contacts without friction, or in a plane, as a linear complementarity problem.

    With N the normal impulses, s⁺ = s_R − s_L and the friction R − μN, it is

        (ġ⁺ + e ġ⁻, s_R, 2μN − R) ≥ 0  ⟂  (N, R, s_L) ≥ 0
    """
    count, rough = len(touches), friction.rough
    places, own = friction.places(count)[:, 0], jnp.diagonal(rows.coupling)
    scale = 1.0 / jnp.sqrt(jnp.where(own > 0, own, 1.0))
    part = jnp.concatenate([touches, touches[rough]])
    coupling = jnp.where(part[:, None] & part, rows.coupling * jnp.outer(scale, scale), 0.0)
    rates = jnp.where(part, scale * (rows.rates - jnp.pad(targets, (0, len(rough)))), 0.0)
    brought = friction.coefficients * scale[rough] / scale[places]
    mixed = jnp.eye(count + len(rough)).at[places, rough].add(-brought)
    limits = jnp.zeros((len(rough), count)).at[np.arange(len(rough)), rough].set(2.0 * brought)
    one, none = jnp.eye(len(rough)), jnp.zeros((count, len(rough)))
    right = jnp.concatenate([none, one, jnp.zeros_like(one)])
    matrix = jnp.concatenate(
        [jnp.concatenate([coupling @ mixed, jnp.concatenate([limits, -one], axis=1)]), right], axis=1
    )
    chosen = _solve_complementary(matrix, jnp.concatenate([rates, jnp.zeros(len(rough))]))
    push, against, back = jnp.split(chosen, [count, count + len(rough)])
    direction = jnp.where(back, -1.0, 1.0)[:, None]
    return Pattern((touches & push).astype(float), (against & ~back).astype(float), direction)


def _solve_complementary(matrix, values):
    """True for each z (m,) that may be positive in w = values + matrix z, with w, z ≥ 0 and w ⟂ z: Lemke's pivoting.

    Source: Cottle, Pang & Stone, *The Linear Complementarity Problem* (1992), algorithm 4.4.5.
    """
    size = len(values)
    values = values / jnp.max(jnp.abs(values), initial=_TINY)
    cover = 2 * size  # the place of the artificial variable, which makes all w positive
    tableau = jnp.concatenate([jnp.eye(size), -matrix, -jnp.ones((size, 1)), values[:, None]], axis=1)

    def exchange(tableau, basis, row, enters):
        line = tableau[row] / tableau[row, enters]
        return (tableau - jnp.outer(tableau[:, enters], line)).at[row].set(line), basis.at[row].set(enters)

    def pivot(carry):
        tableau, basis, enters, _, n = carry
        column = tableau[:, enters]
        falls = column > SMALL_PIVOT
        ratios = jnp.where(falls, tableau[:, -1] / jnp.where(falls, column, 1.0), jnp.inf)
        ties = falls & (ratios <= jnp.min(ratios) + SMALL_PIVOT)
        row = jnp.argmax(ties + (ties & (basis == cover)).astype(int))
        leaves = basis[row]
        tableau, basis = exchange(tableau, basis, row, enters)
        enters = jnp.where(leaves < size, leaves + size, leaves - size)
        return tableau, basis, enters, falls.any() & (leaves != cover), n + 1

    lowest, basis = jnp.argmin(values), jnp.arange(size)
    first = start_alike((*exchange(tableau, basis, lowest, cover), lowest + size, values[lowest] < 0, 0), matrix)
    done = jax.lax.while_loop(lambda carry: carry[3] & (carry[4] < PIVOTS * size), pivot, first)
    basis = jnp.where(values[lowest] < 0, done[1], basis)
    return (basis[:, None] == size + np.arange(size)).any(axis=0)


def find_phases(rows: ImpactRows, touches, restitution, friction: Friction) -> tuple[Pattern, tuple]:
    """The pattern of contacts without friction by Poisson's law, and that of each phase.

    Compression ends where none moves inwards; each then gives back the part e of its impulse, and more where it would
    move inwards still (Glocker, §9.4). Those that push are those of either phase.
    """
    first = find_pattern(rows, touches, jnp.zeros_like(restitution), friction)
    second = find_pattern(_give_back(rows, first, restitution, friction), touches, 0.0 * restitution, friction)
    return first._replace(push=jnp.maximum(first.push, second.push)), (first, second)


def rates_behind(rows: ImpactRows, phases: tuple, restitution, friction: Friction):
    """The rates (k,) at which contacts that push move apart behind an impact: Newton's, or those of two `phases`."""
    count = len(restitution)
    if not phases:
        return -restitution * rows.rates[:count]
    rows = _give_back(rows, phases[0], restitution, friction)
    return (rows.rates + rows.coupling @ impulse_solver(rows, phases[1], friction)(jnp.zeros(count)))[:count]


def construct_impulses(rows: ImpactRows, restitution, coefficients) -> tuple[Any, Any]:
    """The rate (1,) behind an impact of one contact in a plane, and −F/μΛ (1, 1), by Routh's construction.

    As the normal impulse Λ grows, friction acts against the slip of that moment. Where that has stopped the contact
    sticks, if friction suffices, or slides on the other way. Compression ends where the rate is zero, the impact at
    1 + e times its impulse (Wang & Mason, J. Appl. Mech. 59 (1992) 635).
    """
    (normal, mixed), (_, tangential) = rows.coupling
    (rate, slip), most = rows.rates, coefficients[0]
    side = jnp.where(slip < 0, -1.0, 1.0)
    slows = most * tangential - side * mixed  # of the slip, by Λ; it is positive where friction could jam
    stops = jnp.where((slip == 0) | (slows > 0), jnp.abs(slip) / jnp.where(slows > 0, slows, 1.0), jnp.inf)
    held = jnp.clip(mixed / tangential, -most, most)  # −dF/dΛ from there on
    first, then = normal - most * side * mixed, normal - held * mixed
    stays = first * stops >= -rate  # compression ends before the slip does
    before = jnp.where(stays, 0.0, stops)
    compression = before + (-rate - first * before) / jnp.where(stays, first, then)
    impulse = (1.0 + restitution[0]) * compression
    slides = jnp.minimum(impulse, stops)
    force = -most * side * slides - held * (impulse - slides)
    part = most * impulse
    direction = jnp.where(part > 0, -force / jnp.where(part > 0, part, 1.0), 0.0)
    return (rate + normal * impulse + mixed * force)[None], direction[None, None]


def _give_back(rows: ImpactRows, compression: Pattern, restitution, friction: Friction) -> ImpactRows:
    impulses = impulse_solver(rows, compression, friction)(jnp.zeros_like(restitution))
    return rows._replace(rates=rows.rates + rows.coupling @ ((1.0 + restitution) * impulses))


def _pattern_of_one(rows: ImpactRows, towards, coefficients) -> Pattern:
    """The pattern of one contact in a plane: it sticks, if friction suffices, or slides against what that takes."""
    pushed, rubbed = factorize_general(rows.coupling)(-towards)
    sticks = jnp.abs(rubbed) <= coefficients[0] * pushed
    one = jnp.ones(1)
    return Pattern(one, sticks * one, (jnp.where(rubbed > 0, -1.0, 1.0) * one)[:, None])


def sliding_margin(rows: ImpactRows, pattern: Pattern, friction: Friction):
    """The part of each contact's response to its normal force that the friction which it brings leaves, (r,).

    Where it is not positive no force, or more than one, keeps the contact closed: Painlevé's paradox.
    """
    places, rough = friction.places(len(pattern.push)), friction.rough
    own = rows.coupling[rough, rough]
    brought = jnp.sum(rows.coupling[rough[:, None], places] * pattern.direction, axis=1)
    slides = pattern.push[rough] * (1.0 - pattern.sticks) * friction.coefficients
    return 1.0 - slides * brought / jnp.where(own > 0, own, 1.0)


def reached(rows: ImpactRows, meets, touches, friction: Friction):
    """The contacts that touch (k,) and that an impulse at those that meet reaches, one through the other."""
    k = len(meets)
    if k == 1:
        return meets
    own = jnp.sqrt(jnp.abs(jnp.diagonal(rows.coupling)))
    linked = (jnp.abs(rows.coupling) > 1e-14 * jnp.outer(own, own)).astype(float)
    contact_of = np.concatenate([np.arange(k), np.repeat(friction.rough, friction.directions)])
    member = (contact_of[:, None] == np.arange(k)).astype(float)
    pairs = ((member.T @ linked @ member) > 0) & touches[:, None] & touches
    return jax.lax.fori_loop(0, k, lambda _, found: found | (pairs & found).any(axis=1), start_alike(meets, pairs))
