"""Continuation of a family of periodic orbits: its unknowns, its tangent, and steps with a check against jumps.

    predict   along the null vector of the closing equations that is no symmetry
    correct   by Newton's method within the plane across it, at the same length of arc

The rank of the closing equations is decided at closed orbits, where degenerate directions are so to rounding, and is
kept for the trials between them. Decided anew at every trial it would have to leave out all that the trial's defect may
hide, which of an orbit with a multiplier of a thousand is everything but that one direction. Nor are these corrections
damped, as those of `_shooting` are: how they contract is what judges a step.

A step is accepted if Newton's method contracts, if its first correction is short beside the step, and if the chord lies
midway between tangents that turned little. An orbit of another family that happens to be near fails one of these, or is
as near as the family bends; the ratios to these bounds determine the next step.

Source: Allgower & Georg, *Numerical Continuation Methods* (1990), §6.1 (steps by contraction, distance and angle), §8
(branch points).
"""

from typing import NamedTuple

import jax
import numpy as np

from lagjax._analysis.orbits import _shooting
from lagjax._analysis.orbits._arc_motions import Arcs
from lagjax._analysis.orbits._condensation import Condensed, condense_chain
from lagjax._analysis.orbits._orbit import CLOSED, MOST_ARCS
from lagjax._analysis.orbits._shooting import Chain, Closing
from lagjax._equations import span_outside, truncated_svd

_TRIALS = 8  # of Newton's method: beyond, the step along the family was too long
# A step is repeated at half its length beyond these: the ratio of the second correction to the first, the first one in
# parts of the step, the turn of the tangent, and how far the chord is from midway between the tangents.
_CONTRACTION, _DISTANCE, _TURN, _ASKEW = 0.5, 0.4, 0.6, 0.1
_USUAL = 0.4  # of them, for which the next step is chosen
# Of the largest number of a state: orbits of a family along a straight line are some way apart, no more.
_LONGEST_STEP = 0.3
# Singular values of closed orbits beyond this share of the largest are no rounding, whatever the rank was before: about
# branch points they pass through zero.
_ROUNDING = 1e-11
# Of an error along one arc: more arcs where it is larger, so that all digits are left to close.
_LONGEST_GROWTH = 1e3


class FamilyPoint(NamedTuple):
    """An orbit of a family: its chain (of one member), the numbers of the scene, and the closing equations.

    `matrix` (2n, 2n + F) is their Jacobian by the first state and the other unknowns, `right` (2n,) their right-hand
    side.
    """

    chain: Chain
    numbers: np.ndarray
    matrix: np.ndarray
    condensed: Condensed
    right: np.ndarray

    @property
    def unknowns(self) -> "FamilyUnknowns":
        return FamilyUnknowns(self.chain.y, self.chain.period, self.numbers)

    def closed(self, share: float) -> bool:
        """True if all arcs were integrated and close to this fraction of the size of the state."""
        return bool(self.chain.ok[0] and self.chain.closure()[0] <= share * self.chain.size()[0])


class FamilyTangent(NamedTuple):
    """The direction of a family: a unit `vector` (2n + F,), the rank of the closing equations, and its symmetries.

    The symmetries (2n + F, k) are an orthonormal basis.
    """

    vector: np.ndarray
    rank: int
    symmetries: np.ndarray


class FamilyUnknowns(NamedTuple):
    """All numbers of a point, or a change of them: `y` (1, K, 2n), `period` (1,), `numbers` (P,) of the scene."""

    y: np.ndarray
    period: np.ndarray
    numbers: np.ndarray


class Follower:
    """Evaluates orbits of a family by its unknowns: first state, the period if free, a parameter if it has a `place`.

    They are in units of the first orbit, (1, 2n) and (1,), and of the parameter's first value. The family ends at
    `until`.
    """

    def __init__(self, arcs: Arcs, place: int | None, y0: np.ndarray, period: np.ndarray, until: float | None = None):
        self.arcs, self.place, self.until = arcs, place, until
        self.units = arcs.units(y0, period)
        self.of_parameter = 1.0 if place is None else abs(float(arcs.numbers[place])) or 1.0
        self.of_value = 1.0
        self.period_is_free = not arcs.driven and (place is None or not arcs.conserves)

    def closing_conditions(self, numbers: np.ndarray) -> Closing:
        return Closing.from_arcs(self.arcs.with_numbers(numbers))

    def orbit_point(self, y, period, parts, numbers) -> FamilyPoint:
        """Return the orbit through states y (1, K, 2n), with its closing equations."""
        closing = self.closing_conditions(numbers)
        chain = _shooting.integrate_chain(closing, y, period, parts, self.units)
        columns = [chain.rate[..., None] * np.diff(chain.parts)[..., None, None]] if self.period_is_free else []
        if self.place is not None:
            columns.append(self._parameter_derivatives(closing, y, period, parts, self.place))
        if not chain.ok[0]:
            nothing = np.zeros((0, 0))
            return FamilyPoint(chain, numbers, nothing, Condensed(nothing, nothing, nothing, ()), nothing)
        condensed = condense_chain(chain.growth, np.concatenate([*columns, chain.defect[..., None]], axis=3))
        matrix = np.concatenate([condensed.first + condensed.last, condensed.more[..., :-1]], axis=2)[0]
        return FamilyPoint(chain, numbers, matrix, condensed, condensed.more[0, :, -1])

    def _parameter_derivatives(self, closing: Closing, y, period, parts, place: int) -> np.ndarray:
        """Return the derivatives (1, K, 2n, 1) of the ends of the arcs by the parameter at this place."""
        direction = np.eye(len(closing.arcs.numbers))[place][None]
        whole, state = period[0] * self.units.time[0], self.units.state[0]
        spans = whole * parts[0] if self.arcs.driven else np.zeros(len(parts[0]))
        times = np.stack([spans[:-1], spans[1:]], axis=1)
        if not self.arcs.driven:
            times[:, 1] = whole * np.diff(parts[0])
        by_params = closing.arcs.differentiate(times, y[0] * state, direction).by_params
        return by_params[None] * self.of_parameter / state[:, None]

    def complete_change(self, point: FamilyPoint, first: np.ndarray, right: float) -> "FamilyUnknowns":
        """Return the change of all numbers that follows linearly from a change `first` (2n + F,) of the unknowns."""
        states = point.chain.y.shape[2]
        z = np.append(first[states:], right)[None, :, None]
        dy = point.condensed.expand_solution(first[None, :states, None], first[None, :states, None], z)[..., 0]
        by = np.zeros(len(point.numbers))
        if self.place is not None:
            by[self.place] = self.of_parameter * first[-1]
        return FamilyUnknowns(dy, first[states : states + 1] if self.period_is_free else np.zeros(1), by)

    def apply_change(self, point: FamilyPoint, first: np.ndarray, right: float) -> FamilyPoint:
        """Return the point after a change (2n + F,) of its unknowns; states of inner arcs change with them."""
        return self.build_point(point, jax.tree.map(np.add, point.unknowns, self.complete_change(point, first, right)))

    def build_point(self, point: FamilyPoint, whole: "FamilyUnknowns") -> FamilyPoint:
        """Return the point with the numbers `whole`, its arcs at the same fractions of the period as `point`."""
        return self.orbit_point(whole.y, whole.period, point.chain.parts, whole.numbers)

    def refine_arcs(self, point: FamilyPoint) -> FamilyPoint:
        """Divide the orbit into more arcs if errors grow much along one arc; else return the point itself."""
        count = point.chain.y.shape[1]
        growth = np.log(max(np.linalg.norm(one, 2) for one in point.chain.growth[0])) / np.log(_LONGEST_GROWTH)
        more = int(2 ** np.ceil(np.log2(max(growth, 1.0))))
        if more == 1 or count * more > MOST_ARCS:
            return point
        return self.divide_orbit(point.chain.states(), point.chain.periods(), count * more, point.numbers)

    def divide_orbit(self, y0: np.ndarray, period: np.ndarray, count: int, numbers: np.ndarray) -> FamilyPoint:
        """Divide the orbit from a state (1, 2n) with a period (1,), both in the user's units, into `count` arcs."""
        parts, y = _shooting.guess_states(self.closing_conditions(numbers), y0, period, count)
        return self.orbit_point(y / self.units.state[:, None], period / self.units.time, parts, numbers)

    def ascent(self, point: FamilyPoint) -> np.ndarray:
        """Return the unit vector (2n + F,) along which the value increases."""
        slope = np.zeros(point.matrix.shape[1])
        if self.place is not None:
            slope[-1] = 1.0
        else:
            by_state = self.arcs.energy_slope(point.chain.states())[0] * self.units.state[0]
            slope[: len(by_state)] = by_state / (np.linalg.norm(by_state) or 1.0)
        return slope

    def value(self, point: FamilyPoint) -> float:
        if self.place is not None:
            return float(point.numbers[self.place])
        return float(self.arcs.energy(0.0, point.chain.states())[0])

    def energy(self, point: FamilyPoint) -> float:
        return float(self.arcs.with_numbers(point.numbers).energy(0.0, point.chain.states())[0])


def tangent_at(
    follower: Follower, point: FamilyPoint, before: FamilyTangent | None, left_out: int = 0
) -> FamilyTangent | None:
    """Return the tangent of the family at a closed orbit, continued from `before`; None if the orbit is isolated.

    Without `before` the value increases along it. At a branch point the smallest `left_out` singular values are zero;
    the tangent is then the direction nearest to `before`.
    """
    states = point.matrix.shape[0]
    whole, still = truncated_svd(point.matrix, _shooting.RANK), truncated_svd(point.matrix[:, :states], _shooting.RANK)
    slope, count, rank = follower.ascent(point), states - int(still.rank), int(whole.rank)
    if before is not None:  # a rank that falls short of itself in passing a branch point
        at_least = whole.values[before.rank - 1] > _ROUNDING * whole.values[0]
        rank = max(rank, before.rank) if at_least else rank
        count = min(count, before.symmetries.shape[1]) if at_least else count
    symmetries = np.zeros((point.matrix.shape[1], count))
    symmetries[:states] = still.right[:, states - count :]
    if before is None:  # that in which the value rises is no symmetry
        along = symmetries.T @ slope
        symmetries = symmetries @ truncated_svd(along[None], absolute=1e-6 * float(np.linalg.norm(slope))).null
    across = span_outside(whole.right[:, rank - left_out :], symmetries)
    vector = across @ (across.T @ (slope if before is None else before.vector))
    length = np.linalg.norm(vector)
    if not length > 1e-6 * (np.linalg.norm(slope) if before is None else 1.0):
        return None
    return FamilyTangent(vector / length, rank, symmetries)


class FamilyStep(NamedTuple):
    """A corrected orbit with its tangent, and the largest ratio of the step to its bounds, at most 1."""

    point: FamilyPoint
    tangent: FamilyTangent
    share: float


def correct_orbit(
    follower: Follower, point: FamilyPoint, across: FamilyTangent, left_out: int = 0
) -> tuple[FamilyPoint, np.ndarray] | None:
    """Return the orbit in the plane across a tangent, and the sizes of Newton's corrections; None if none is found.

    The smallest `left_out` singular values of the equations are left out, as at a branch point, where one is zero.
    """
    sizes, before = [], np.inf
    for _ in range(_TRIALS):
        if not point.chain.ok[0] or not point.chain.period[0] > 0:
            return None
        closure = point.chain.closure()[0]
        if point.closed(1e-2 * CLOSED) or (closure > 0.5 * before and point.closed(CLOSED)):
            return point, np.array(sizes)
        before = closure
        matrix, right = np.concatenate([point.matrix, across.vector[None]]), np.append(point.right, 0.0)
        change = -truncated_svd(matrix)._replace(rank=np.array(across.rank + 1 - left_out)).least_norm(right)
        sizes.append(np.linalg.norm(change))
        point = follower.apply_change(point, change, 1.0)
    return (point, np.array(sizes)) if point.closed(CLOSED) else None


def step_along(follower: Follower, last: FamilyPoint, tangent: FamilyTangent, step: float) -> FamilyStep | None:
    """Return the orbit one step further; None if the step was too long for the family."""
    there = correct_orbit(follower, follower.apply_change(last, step * tangent.vector, 0.0), tangent)
    if there is None:
        return None
    point, sizes = there
    following = tangent_at(follower, point, tangent)
    if following is None:
        return None
    sizes = np.append(sizes, [0.0, 0.0])
    contraction = sizes[1] / sizes[0] if sizes[1] > 1e-8 * step else 0.0
    cosine = np.clip(tangent.vector @ following.vector, -1.0, 1.0)
    askew = _scaled_chord(follower, last, point, step) - (tangent.vector + following.vector) / 2
    for one in (tangent, following):
        askew -= one.symmetries @ (one.symmetries.T @ askew)
    share = max(
        np.sqrt(contraction / _CONTRACTION),
        np.sqrt(sizes[0] / step / _DISTANCE),
        np.arccos(cosine) / _TURN,
        np.sqrt(np.linalg.norm(askew) / _ASKEW),
    )
    return FamilyStep(point, following, float(share)) if share <= 1 else None


def _scaled_chord(follower: Follower, last: FamilyPoint, point: FamilyPoint, step: float) -> np.ndarray:
    """Return the change of the unknowns, (2n + F,), in units of the step."""
    change = jax.tree.map(np.subtract, point.unknowns, last.unknowns)
    period = change.period if follower.period_is_free else []
    parameter = [] if follower.place is None else change.numbers[[follower.place]] / follower.of_parameter
    return np.concatenate([change.y[0, 0], period, parameter]) / step


def next_step(step: float, there: FamilyStep) -> float:
    """Return the length of the next step, half to twice this one, for the usual ratio to its bounds."""
    longer = step * float(np.clip(_USUAL / max(there.share, 1e-300), 0.5, 2.0))
    return min(longer, _LONGEST_STEP * there.point.chain.size()[0])
