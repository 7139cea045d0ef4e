"""`Course`: a motion as a function of time between its outputs, for figures and animations.

Its knots are the outputs, the states just before and just after transitions, and the event that ended the motion.
Between two knots the state is the cubic with q and q̇ of both (Hermite interpolation). Where a transition resets the
state, two knots have the same time, and the curve is interrupted.
"""

from typing import NamedTuple

import jax
import numpy as np

from lagjax._interface import RESULTS, Layout, numbers_at
from lagjax._run import CHANGE_WORDS, Members

# Points of a curve, at least: four times as many as dots of a figure that is printed, because a planet passes its
# perihelion in a fraction of them. Half as many show corners there.
POINTS = 2400


class Course(NamedTuple):
    """The course of one member: times (K,), q (K, n) and q̇ (K, n) at outputs and transitions, in order."""

    t: np.ndarray
    q: np.ndarray
    qdot: np.ndarray

    def states_at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate q and q̇ (F, n) at `times`; at a jump the state before it; NaN outside of the motion."""
        low, high = sorted((self.t[0], self.t[-1]))
        slack, sign = 1e-6 * (high - low), np.sign(self.t[-1] - self.t[0])
        place = np.clip(np.searchsorted(sign * self.t, sign * times, side="left") - 1, 0, len(self.t) - 2)
        h = (self.t[place + 1] - self.t[place])[:, None]
        inside = ((times >= low - slack) & (times <= high + slack))[:, None]
        a, b, begin, end = self.q[place], self.q[place + 1], self.qdot[place], self.qdot[place + 1]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = np.where(h == 0, 0.0, (times - self.t[place])[:, None] / h)
            second, third = 3 * (b - a) - h * (2 * begin + end), h * (begin + end) - 2 * (b - a)
            q = a + x * (h * begin + x * (second + x * third))
            qdot = begin + x * (2 * second + 3 * x * third) / h
        q = np.where(x == 1, b, np.where(x == 0, a, q))
        qdot = np.where(x == 1, end, np.where(x == 0, begin, qdot))
        return np.where(inside, q, np.nan), np.where(inside, qdot, np.nan)

    def curve(self, times: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return t (F,), q, q̇ (F, n) at knots and `times`, by default `POINTS` even ones; a row of NaN at jumps."""
        if times is None:
            count = len(self.t) - 1
            parts = np.arange(1, max(2, -(-POINTS // count))) / max(2, -(-POINTS // count))
            times = np.interp((np.arange(count)[:, None] + parts).ravel(), np.arange(count + 1), self.t)
        t = np.concatenate([times, self.t])  # a time at which the state jumps is before the jump
        order = np.argsort(np.sign(self.t[-1] - self.t[0]) * t, kind="stable")
        t, states = t[order], np.vstack([np.hstack(self.states_at(times)), np.hstack([self.q, self.qdot])])[order]
        jumps = np.flatnonzero((t[1:] == t[:-1]) & (states[1:] != states[:-1]).any(axis=1)) + 1
        q, qdot = np.hsplit(np.insert(states, jumps, np.nan, axis=0), 2)
        return np.insert(t, jumps, t[jumps]), q, qdot


def join_curve(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the curve (2, F) of x and y without the NaN at jumps across which both are continuous."""
    xy = np.stack([x, y])
    gaps = 1 + np.flatnonzero(np.isnan(y[1:-1]))
    return np.delete(xy, gaps[(xy[:, gaps - 1] == xy[:, gaps + 1]).all(axis=0)], axis=1)


def wrap_curve(x: np.ndarray, y: np.ndarray, of_x: float | None, of_y: float | None = None) -> tuple:
    """Wrap x and y to −P/2 … P/2, for the period P of each or None, with a NaN where the curve changes the edge."""
    if of_x is not None:
        x, y = _wrap_angle(x, y, of_x)
    return (x, y) if of_y is None else _wrap_angle(y, x, of_y)[::-1]


def _wrap_angle(angle: np.ndarray, other: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    turns = np.floor(angle / period + 0.5)
    steps = np.nan_to_num(np.diff(turns))
    left = np.flatnonzero(steps)
    edge = period * (np.maximum(turns[left], turns[left + 1]) - 0.5)
    at = other[left] + (edge - angle[left]) / (angle[left + 1] - angle[left]) * (other[left + 1] - other[left])
    side, gap = period / 2 * np.sign(steps[left]), np.full(len(left), np.nan)
    places = np.repeat(left + 1, 3)
    wrapped = np.insert(angle - period * turns, places, np.stack([side, gap, -side], axis=1).ravel())
    return wrapped, np.insert(other, places, np.stack([at, gap, at], axis=1).ravel())


def spans_of(trajectory) -> dict[str, list[tuple[float, float]]]:
    """Return {name: [(from, to), …]}: the time intervals of one motion in each mode, or with each contact closed."""
    names = trajectory.mode_names or trajectory.contact_names
    begin, end = (float(np.ravel(x)[0]) for x in (trajectory.ts, trajectory.end.t))
    since, spans = {}, {name: [] for name in names}
    if not names:
        return spans
    if (changes := trajectory.transitions) is not None:
        t, left, entered = (np.ravel(x) for x in (changes.t, changes.source, changes.target))
        since[next((mode for mode in left if mode >= 0), np.ravel(trajectory.mode)[0])] = begin
    else:
        changes = trajectory.contact_changes
        t, contact, words = np.ravel(changes.t), np.ravel(changes.contact), np.array(CHANGE_WORDS)[changes.change]
        left, entered = (np.where(np.ravel(words) == word, contact, -1) for word in ("opens", "closes"))
    for when, one, other in zip(t, left, entered, strict=True):
        if one != other and one in since:
            spans[names[one]].append((since.pop(one), float(when)))
        if one != other and other >= 0:
            since.setdefault(other, float(when))
    for k, first in since.items():
        spans[names[k]].append((first, end))
    return {name: [(first, last) for first, last in found if first != last] for name, found in spans.items()}


def courses_of(trajectory, places) -> tuple[Layout, list[Course]]:
    """Return the layout and the `Course` of each of the members `places` of a batch; of one motion, place 0."""
    members = Members(trajectory)
    return members.layout, [course_of_member(members, k) for k in places]


def course_of(trajectory) -> tuple[Layout, Course]:
    """Return the layout and the `Course` of one motion; raise `ValueError` for a batch."""
    members = Members(trajectory)
    if members.batch:
        raise ValueError(
            "Compare one motion, not a batch: jax.tree.map(lambda x: x[k], (batch.q, batch.qdot)) are the states of "
            "member k; simulate follows it alone."
        )
    return members.layout, course_of_member(members, 0)


def course_of_member(members: Members, k: int) -> Course:
    trajectory, place = members.trajectory, np.unravel_index(k, members.batch) if members.batch else ()
    changes, end = trajectory.transitions or trajectory.contact_changes, trajectory.end

    def flatten_member(tree, rows: int) -> np.ndarray:
        leaves = [numbers_at(leaf, place).reshape(rows, -1) for leaf in jax.tree.leaves(tree)]
        return np.concatenate(leaves, axis=1).astype(float)

    t = members.shared(trajectory.ts, 1)[k].astype(float)
    knots = [(t, *(flatten_member(tree, len(t)) for tree in (trajectory.q, trajectory.qdot)))]
    if changes is not None:
        when = numbers_at(changes.t, place).astype(float)
        pairs = [
            np.stack([flatten_member(tree, len(when)) for tree in both], axis=1).reshape(2 * len(when), -1)
            for both in ((changes.q, changes.q_next), (changes.qdot, changes.qdot_next))
        ]
        knots.append((np.repeat(when, 2), *pairs))
    if numbers_at(trajectory.result._value, place) == RESULTS.event_occurred._value:
        knots.append((numbers_at(end.t, place).reshape(1), flatten_member(end.q, 1), flatten_member(end.qdot, 1)))
    t, q, qdot = (np.concatenate(parts) for parts in zip(*knots, strict=True))
    ahead = t[0] <= knots[0][0][-1]
    order = np.argsort(t if ahead else -t, kind="stable")[: np.isfinite(t).sum()]  # NaN comes last
    order = np.resize(order, max(2, len(order)))
    return Course(t[order], q[order], qdot[order])
