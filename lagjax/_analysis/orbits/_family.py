"""`family`: periodic orbits that belong together, by energy or by a parameter; `branch_off`: from one to another.

A family continues through folds, where its energy or parameter turns back, because it is followed by its own length of
arc. Orbits of a conservative scene form families by energy at fixed parameters, and by a parameter at a fixed period;
limit cycles and driven orbits form them by a parameter alone.

At a branch point the closing equations have one null vector more than elsewhere on the family. The family that crosses
there, or begins with twice the period, is sought at some distance along it, in the plane across, which the old family
does not meet.

Source: Keller, *Lectures on Numerical Methods in Bifurcation Problems* (1987), §4, §5.26 (method III);
Doedel et al., *Computation of periodic solutions of conservative systems*, Int. J. Bifurcation and Chaos 13 (2003)
1353; Muñoz-Almaraz et al., Physica D 181 (2003) 1.
"""

import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._analysis.orbits import _shooting
from lagjax._analysis.orbits._arc_motions import Arcs, check_starts
from lagjax._analysis.orbits._continuation import (
    FamilyPoint,
    FamilyTangent,
    Follower,
    correct_orbit,
    next_step,
    step_along,
    tangent_at,
)
from lagjax._analysis.orbits._floquet import passage_determinant, reduce_arcs
from lagjax._analysis.orbits._orbit import RTOL, FlatOrbits, Orbit, arc_counts, assess_orbits, restore_orbits
from lagjax._equations import span_outside, truncated_svd
from lagjax._interface import Layout, halves, labelled_leaves, require_budget, require_tolerance
from lagjax._primitives import accepts_singles
from lagjax._scene import System

_SHORTEST = 1e-6  # of the first step: a family that asks for shorter ones ends


class Family(NamedTuple):
    """N periodic orbits along a family; the first is the orbit at which the family was begun.

    - `q0`, `qdot0`, `period`, `multipliers`, `closure`, `stable`: those of each orbit (see `Orbit`), with the orbits as
      first axis.
    - `value` (N,): the energy, or the parameter by which the family was followed; `energy` (N,): h = p·q̇ − L.
    - `fold` (N,): whether `value` turns back at this orbit.
    - `branch` (N,): whether two multipliers pass through 1 there without a fold, so that another family crosses this
      one; `doubling` (N,): whether two pass through −1, where a family of twice the period begins.
    - `message`: a sentence that says why it ends there.
    """

    q0: PyTree
    qdot0: PyTree
    period: jax.Array
    value: jax.Array
    energy: jax.Array
    multipliers: jax.Array
    closure: jax.Array
    stable: jax.Array
    fold: jax.Array
    branch: jax.Array
    doubling: jax.Array
    message: str

    def __repr__(self) -> str:
        count, periods = len(self.value), np.asarray(self.period)
        first = f"Family of {count} orbits, {int(np.sum(self.stable))} of them stable"
        span = f"from {float(self.value[0]):.9g} to {float(self.value[-1]):.9g}" if count else "empty"
        span += f", periods from {periods.min():.6g} to {periods.max():.6g}" if count else ""
        events = (("fold", self.fold), ("branch point", self.branch), ("doubling", self.doubling))
        places = [f"{name} at orbit {', '.join(map(str, np.flatnonzero(x)))}" for name, x in events if np.any(x)]
        return "\n".join([first, f"{span}; {'; '.join(places)}" if places else span, self.message])


@accepts_singles(("orbit",), ("params",))
def family(
    system: System,
    orbit: Orbit,
    params: PyTree = None,
    *,
    by: str = "energy",
    until: float | None = None,
    step: float = 0.05,
    count: int = 100,
) -> Family:
    """The family of periodic orbits that begins at `orbit`: at most `count` of them.

    - `by`: "energy"; or the name of a parameter, such as "g" for `params["g"]`, one number.
    - `until`: the energy or the parameter at which the family ends; it also fixes the direction of the first step.
      Without it the family begins towards larger values and ends after `count` orbits.
    - `step`: the first step's arc length, as a fraction of the size of `orbit` (of its coordinates, its velocities,
      its period over 2π and the parameter); it and later steps adapt to how fast Newton's method contracts, how far it
      moves an orbit, and how much the family turns.

    Folds, branch points and doublings between two orbits are located on the arc between them, as well as multipliers
    and slopes are known there, and are orbits of the family as others are. `branch_off` continues from there.

    A nonlinear normal mode is the family by energy that begins at a linear mode: begin with the periodic orbit near
    q + a·shape at rest, whose period is 2π/frequency, for a small amplitude a (`lagjax.normal_modes`).

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right: an orbit that is not `ok`, a name that no
    parameter has, a scene with constraints or without machine code.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + jnp.cos(q))
    swings = lagjax.family(pendulum, lagjax.periodic_orbit(pendulum, 0.3, 0.0, 6.3), count=10)
    ```
    """
    require_budget(count, "count")
    require_tolerance(step, "step")
    if jnp.ndim(orbit.period) or not bool(orbit.ok):
        raise ValueError("orbit must be one periodic orbit that is ok: of a batch take one member, and see why not.")
    period, layout, y0 = check_starts(orbit.q0, orbit.qdot0, orbit.period, "period")
    arcs = Arcs.from_system(system, layout, params, RTOL, "Families")
    place = None if by == "energy" else _parameter_index(params, by)
    follower = Follower(arcs, place, y0, period.ravel(), until)
    if by == "energy" and not arcs.conserves:
        raise ValueError("This scene does not conserve its energy, so that there is no family by it: name a parameter.")
    return _build_family(follower, *_follow_family(follower, y0, period.ravel(), float(step), count))


def _parameter_index(params: PyTree, name: str) -> int:
    (labels, leaves, _), begin = labelled_leaves(params, "params"), 0
    for label, leaf in zip(labels, leaves, strict=True):
        if name in (label, label.removeprefix("params").strip("[]'."), label.rsplit(".", 1)[-1]):
            if np.size(leaf) != 1:
                raise ValueError(f"{label} has {np.size(leaf)} numbers: a family needs a parameter that is one.")
            return begin
        begin += np.size(leaf)
    raise ValueError(f"by must be 'energy' or one of {', '.join(labels) or 'no parameters at all'}; got {name!r}.")


class _Member(NamedTuple):
    """An orbit of a family: `found` (of one orbit), the number of its `symmetries`, and test functions.

    `tests` (4,) change sign at a fold, at a branch point or fold, at a doubling, and at the value where the family
    ends.
    """

    point: FamilyPoint
    tangent: FamilyTangent
    symmetries: int
    found: FlatOrbits
    tests: np.ndarray
    events: tuple[bool, bool, bool] = (False, False, False)


def _build_member(follower: Follower, point: FamilyPoint, tangent: FamilyTangent, most: int | None) -> _Member:
    """Return an orbit with its multipliers; at most `most` directions count as symmetries."""
    (symmetries,) = _shooting.find_null_spaces(point.chain, most)
    count = symmetries.null.shape[2]
    found = assess_orbits(follower.closing_conditions(point.numbers), point.chain, count)
    reduced = reduce_arcs(point.chain.growth[0], *symmetries)
    through = [passage_determinant(reduced, sign) if not found.message[0] else np.nan for sign in (1, -1)]
    beyond = np.nan if follower.until is None else (follower.value(point) - follower.until) / follower.of_value
    return _Member(point, tangent, count, found, np.array([follower.ascent(point) @ tangent.vector, *through, beyond]))


def _follow_family(follower: Follower, y0, period, step: float, count: int) -> tuple[list[_Member], str]:
    """Return the orbits of a family, at most `count`, from one of them, and the sentence on its end."""
    point, shortest, until = _first_point(follower, y0, period, follower.arcs.numbers), _SHORTEST * step, follower.until
    if until is not None:
        follower.of_value = abs(until - follower.value(point)) or 1.0
    tangent = tangent_at(follower, point, None)
    if tangent is None:
        alone = FamilyTangent(np.zeros(point.matrix.shape[1]), 0, np.zeros((point.matrix.shape[1], 0)))
        message = "The orbit is alone: it closes at no other energy, or parameter, near its own."
        return [_build_member(follower, point, alone, None)], message
    wanted = until is None or until > follower.value(point)
    tangent = tangent if wanted else tangent._replace(vector=-tangent.vector)
    members = [_build_member(follower, point, tangent, None)]
    while len(members) < count:
        last = members[-1]
        there = step_along(follower, last.point, last.tangent, step)
        if there is None or _shooting.is_equilibrium(there.point.chain)[0]:
            step /= 2
            if step < shortest:
                return members, _end_of_family(follower, last.point, there is not None)
            continue
        following = _build_member(follower, there.point, there.tangent, last.symmetries)
        members += _locate_events(follower, last, following, step)
        if until is not None and (follower.value(there.point) > until) == wanted:
            return members[:count], f"The family was followed until {until:.6g}."
        members.append(_refine_member(follower, following))
        step = next_step(step, there)
    return members[:count], f"{count} orbits were found; the family continues: raise count to follow it further."


def _first_point(follower: Follower, y0: np.ndarray, period: np.ndarray, numbers: np.ndarray) -> FamilyPoint:
    """Return the orbit at which a family begins, in as many arcs as its steps and its growth need."""
    count = int(arc_counts(follower.arcs.with_numbers(numbers), y0, period)[0])
    return follower.refine_arcs(follower.divide_orbit(y0, period, count, numbers))


def _refine_member(follower: Follower, member: _Member) -> _Member:
    """Divide the member's orbit into more arcs if errors grow much along one; else return the member itself."""
    if (point := follower.refine_arcs(member.point)) is member.point:
        return member
    there = correct_orbit(follower, point, member.tangent)
    return member if there is None else member._replace(point=there[0])


def _end_of_family(follower: Follower, last: FamilyPoint, stopped: bool) -> str:
    where = f"{follower.value(last):.9g}, with a period of {last.chain.periods()[0]:.6g}"
    if stopped:
        return f"The family ends at an equilibrium, near {where}."
    return (
        f"The family could not be followed beyond {where}. It ends there, as at a collision or at an orbit that takes "
        "for ever, or begins to depend on its value so steeply that no step is short enough."
    )


# ---- what happens between two orbits ---------------------------------------------------------------------------------

_SAME = 1e-3  # of a step: within, a fold and a branch point are one, where both tests change sign
_NOISE = 1e-9  # of tests, which are of order one: what is all degenerate, as an isotropic oscillator, passes nothing
# How far from a branch point orbits are computed, as a fraction of the bracket, and the bracket that ends that, of the
# step: the inverse polynomial through four orbits is then right to its fourth power.
_BESIDE, _BRACKET = 0.02, 1e-3


def _locate_events(follower: Follower, last: _Member, following: _Member, step: float) -> list[_Member]:
    """Return the folds, branch points and doublings between two orbits, in order, up to the end of the family."""
    turned = (last.tests * following.tests < 0) & (np.maximum(abs(last.tests), abs(following.tests)) > _NOISE)
    located = {k: _locate_event(follower, last, following, step, k) for k in np.flatnonzero(turned).tolist()}
    if 0 in located and 1 in located and abs(located[0][0] - located[1][0]) < _SAME * step:
        del located[1]
    ordered, end = sorted(located.items(), key=lambda item: item[1][0]), located[3][0] if 3 in located else np.inf
    return [one._replace(events=tuple(k == j for j in range(3))) for k, (place, one) in ordered if place <= end]


def _locate_event(follower: Follower, last: _Member, following: _Member, step: float, k: int) -> tuple[float, _Member]:
    """Return the arc length of the zero of test k between two orbits, and the orbit there.

    Near a branch point Newton's method finds orbits of either family: so orbits are computed beside it, ever nearer,
    from cubic guesses; that at the zero is interpolated and corrected in all directions but the singular one.
    """
    across, found = last.tangent, {0.0: last, step: following}
    a, b = 0.0, step
    while b - a > _BRACKET * step:
        zero, width = _interpolate_zero(found, a, b, k), b - a
        for s in (max(zero, a + 2 * _BESIDE * width) - _BESIDE * width, zero + _BESIDE * width):
            if not a < s < b:
                continue
            member = _orbit_between(follower, found, a, b, s, across, 0, last.symmetries)
            if member is None or not np.isfinite(member.tests[k]):
                return a, found[a]
            found[s] = member
            a, b = (s, b) if member.tests[k] * found[a].tests[k] > 0 else (a, s)
        if b - a > 0.9 * width:
            break
    zero = _interpolate_zero(found, a, b, k)
    member = _orbit_between(follower, found, a, b, zero, across, int(k == 1), last.symmetries)
    return zero, found[a] if member is None else member


def _interpolate_zero(found: dict[float, _Member], a: float, b: float, k: int) -> float:
    """Return the zero of the inverse polynomial through the four orbits nearest to a bracket, within the bracket."""
    near = sorted(found, key=lambda s: abs(s - (a + b) / 2))[:4]
    values = [found[s].tests[k] for s in near]
    shares = [np.prod([w / (w - v) for w in values[:j] + values[j + 1 :]]) for j, v in enumerate(values)]
    zero = float(np.dot(near, shares))
    if a < zero < b:
        return zero
    return (a * found[b].tests[k] - b * found[a].tests[k]) / (found[b].tests[k] - found[a].tests[k])


def _orbit_between(
    follower: Follower, found: dict[float, _Member], a: float, b: float, s: float, across: FamilyTangent, left_out: int,
    most: int,
) -> _Member | None:  # fmt: skip
    """Return the orbit at arc length s between members of `found` at a and b; None if it is of another family."""
    u, width = (s - a) / (b - a), b - a
    shares = (1 + 2 * u) * (1 - u) ** 2, u**2 * (3 - 2 * u), width * u * (1 - u) ** 2, width * u**2 * (u - 1)
    ends = (found[x].point.unknowns for x in (a, b))
    # Tangents of unit length along `across`.
    along = ((found[x].point, found[x].tangent.vector) for x in (a, b))
    slopes = (follower.complete_change(point, vector / (vector @ across.vector), 0.0) for point, vector in along)
    guess = jax.tree.map(lambda *parts: sum(map(operator.mul, shares, parts)), *ends, *slopes)
    there = correct_orbit(follower, follower.build_point(found[a].point, guess), across, left_out)
    tangent = None if there is None else tangent_at(follower, there[0], found[a].tangent, left_out)
    if there is None or tangent is None or tangent.vector @ across.vector < _ALONG:
        return None
    return _build_member(follower, there[0], tangent, most)


_ALONG = 0.7  # the cosine of the turn of a tangent between two neighbours, more than which they have by `step_along`


def _build_family(follower: Follower, members: list[_Member], message: str) -> Family:
    found = FlatOrbits(*map(np.concatenate, zip(*(member.found for member in members), strict=True)))
    points, layout = [member.point for member in members], follower.arcs.layout
    value, energy = (np.array([of(point) for point in points]) for of in (follower.value, follower.energy))
    q, qdot = map(layout.restore, halves(found.y))
    events = np.array([member.events for member in members]).T
    columns = q, qdot, found.period, value, energy, found.multipliers, found.closure, found.stable, *events
    return Family._make([*jax.tree.map(jnp.asarray, columns), message])


# ---- from one family to another --------------------------------------------------------------------------------------


@accepts_singles(("family",), ("params",))
def branch_off(
    system: System, family: Family, index: int, params: PyTree = None, *, by: str = "energy", size: float = 0.01
) -> Orbit:
    """A periodic orbit of the family that crosses `family` at its orbit `index`, near that orbit.

    Follow it on by `family(system, branch_off(…), params)`: the halo orbits from the planar ones of Lyapunov, say.

    - `index`: of an orbit where `family.branch` or `family.doubling` is True; of the latter the new orbits have twice
      the period.
    - `params`, `by`: those with which `family` was followed.
    - `size`: how far off the new orbit is, as a fraction of the size of the old one, as `step` of `family`.

    By symmetry there often are two such families, mirror images, of which this is one.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, an orbit at which no family crosses, and
    where no orbit is found at that distance.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    star = lagjax.System(lambda q, v: 0.5 * (v @ v - q @ q) - q[0] ** 2 * q[1] + q[1] ** 3 / 3)
    orbit = lagjax.periodic_orbit(star, jnp.array([0.0, 0.1]), jnp.zeros(2), 6.3)
    along = lagjax.family(star, orbit, until=0.15)
    twice = lagjax.branch_off(star, along, int(jnp.argmax(along.doubling)))
    ```
    """
    require_tolerance(size, "size")
    places = np.flatnonzero(np.asarray(family.branch | family.doubling)).tolist()
    if index not in places:
        raise ValueError(
            f"No family crosses at orbit {index}: index must be that of a branch point or a doubling, "
            f"{' or '.join(map(str, places)) or 'of which this family has none'}."
        )
    turns = 2 if bool(family.doubling[index]) else 1
    beside = next(k for k in (index - 1, index + 1, index) if 0 <= k < len(family.value))
    (y0, period, layout), (y0_beside, period_beside, _) = (_orbit_start(family, k, turns) for k in (index, beside))
    place = None if by == "energy" else _parameter_index(params, by)
    arcs = Arcs.from_system(system, layout, params, RTOL, "Families")
    numbers, numbers_beside = (np.array(arcs.numbers) for _ in range(2))
    if place is not None:
        numbers[place], numbers_beside[place] = (float(family.value[k]) for k in (index, beside))
    follower = Follower(arcs.with_numbers(numbers), place, y0, period)
    here = _first_point(follower, y0, period, numbers)
    before = tangent_at(follower, _first_point(follower, y0_beside, period_beside, numbers_beside), None)
    point = None if before is None else _branching_orbit(follower, here, before, float(size))
    if before is None or point is None:
        raise ValueError(
            f"No orbit of another family was found {size:.3g} from orbit {index}: try another size, or follow the "
            "family again with another first step, so that its neighbours lie elsewhere."
        )
    found = assess_orbits(follower.closing_conditions(point.numbers), point.chain, before.symmetries.shape[1])
    return restore_orbits(follower.arcs.layout, FlatOrbits(*(x[0] for x in found)), found.message[0])


def _orbit_start(family: Family, k: int, turns: int) -> tuple[np.ndarray, np.ndarray, Layout]:
    """Return the first state (1, 2n) of orbit k and its period (1,) times `turns`, and the layout."""
    q0, qdot0 = jax.tree.map(lambda x: x[k], (family.q0, family.qdot0))
    period, layout, y0 = check_starts(q0, qdot0, turns * family.period[k], "period")
    return y0, period.ravel(), layout


def _branching_orbit(follower: Follower, here: FamilyPoint, before: FamilyTangent, size: float) -> FamilyPoint | None:
    """Return the orbit at a distance from a branch point along the null vector of the other family.

    Symmetries are known from a neighbour: at the branch point singular values do not distinguish them.
    """
    states, count = here.matrix.shape[0], before.symmetries.shape[1]
    still = truncated_svd(here.matrix[:, :states]).right[:, states - count - 1 :]
    null = truncated_svd(here.matrix).right[:, before.rank - 1 :]
    known = np.zeros((null.shape[0], count + 1))
    known[:states, :count] = still @ (still.T @ before.symmetries[:states])
    known[:, count] = null @ (null.T @ before.vector)
    directions = span_outside(null, np.linalg.qr(known)[0])
    if not directions.shape[1]:
        return None
    across = FamilyTangent(directions[:, 0], before.rank, before.symmetries)
    there = correct_orbit(follower, follower.apply_change(here, size * across.vector, 0.0), across)
    return None if there is None else there[0]
