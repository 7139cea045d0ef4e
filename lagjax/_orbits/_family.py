"""`family`: periodic orbits that belong together, one after the other, by energy or by a parameter.

    predict   along the null vector of the closing equations that is no symmetry
    correct   by Newton's method within the plane across it, at the same length of arc

A family goes on through folds, where its energy or parameter turns back, because it is followed by its own length of
arc. Orbits of a conservative scene form families by energy at fixed parameters, and by a parameter at a fixed period;
limit cycles and driven orbits form them by a parameter alone.

Source: Keller, *Lectures on Numerical Methods in Bifurcation Problems* (1987), §4; Doedel et al., *Computation of
periodic solutions of conservative systems*, Int. J. Bifurcation and Chaos 13 (2003) 1353; Muñoz-Almaraz et al., Physica
D 181 (2003) 1.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._layout import halves, taken_apart
from lagjax._orbits import _shooting
from lagjax._orbits._arcs import Arcs
from lagjax._orbits._condense import Condensed, condense
from lagjax._orbits._orbit import CLOSED, RTOL, Orbit, arcs_each, told
from lagjax._orbits._rank import decide
from lagjax._orbits._shooting import Chain, Closing
from lagjax._orbits._starts import starts
from lagjax._system import System
from lagjax._validate import require_budget, require_tolerance

PyTree = Any

_TRIALS = 8  # of Newton's method: beyond, the step along the family was too long
_QUICK = 3  # trials after which the next step may be longer
_SHORTEST = 1e-6  # of the first step: a family that asks for shorter ones ends


class Family(NamedTuple):
    """N periodic orbits along a family; the first is the orbit at which the family was begun.

    - `q0`, `qdot0`, `period`, `multipliers`, `closure`, `stable`: those of each orbit (see `Orbit`), with the orbits as
      first axis.
    - `value` (N,): the energy, or the parameter by which the family was followed; `energy` (N,): h = p·q̇ − L.
    - `fold` (N,): whether `value` turns back between this orbit and the one before it.
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
    - `step`: the arc length of the first step, in the units of (q, qdot, T); later steps adapt to the number of Newton
      iterations.

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
    period, layout, y0 = starts(orbit.q0, orbit.qdot0, orbit.period, "period")
    q, qdot = map(layout.restore, halves(y0[0]))
    arcs = Arcs.of(system, q, qdot, params, RTOL, "Families")
    follower = _Follower(arcs, None if by == "energy" else _place(params, by))
    if by == "energy" and not arcs.conserves:
        raise ValueError(
            "The energy of this scene is not conserved, so that there is no family by energy: name a parameter."
        )
    return _told(follower, *_followed(follower, y0, period.ravel(), until, float(step), count))


def _place(params: PyTree, name: str) -> int:
    """Where the parameter stands among all numbers."""
    labels, leaves, _ = taken_apart(params, "params")
    begin = 0
    for label, leaf in zip(labels, leaves, strict=True):
        if name in (label, label.removeprefix("params").strip("[]'."), label.rsplit(".", 1)[-1]):
            if np.size(leaf) != 1:
                raise ValueError(f"{label} has {np.size(leaf)} numbers: a family needs a parameter that is one.")
            return begin
        begin += np.size(leaf)
    raise ValueError(
        f"by must be 'energy' or one of {', '.join(labels) or 'no parameters, for there are none'}; got {name!r}."
    )


class _Point(NamedTuple):
    """An orbit of a family: its chain (of one member), the numbers of the scene, and derivatives by one of them.

    `rate` is that of its value along the family; zero where the family ends.
    """

    chain: Chain
    numbers: np.ndarray
    by_number: np.ndarray
    rate: float = 0.0


class _Follower:
    """What is free along a family: the first state; the period, unless it is held; a parameter, if it has a place."""

    def __init__(self, arcs: Arcs, place: int | None):
        self.arcs, self.place = arcs, place
        self.period_is_free = not arcs.driven and (place is None or not arcs.conserves)

    def closing(self, numbers: np.ndarray) -> Closing:
        return Closing.plain(self.arcs.with_numbers(numbers))

    def point(self, y, period, parts, numbers) -> _Point:
        """The chain through these states, (1, K, 2n), and its derivative by the parameter (1, K, 2n, 1 or 0)."""
        closing = self.closing(numbers)
        chain = _shooting.follow(closing, y, period, parts)
        if self.place is None:
            return _Point(chain, numbers, np.zeros((*y.shape, 0)))
        direction = np.eye(len(numbers))[self.place : self.place + 1]
        spans = period[:, None] * parts[0] if self.arcs.driven else np.zeros((1, len(parts[0])))
        times = np.stack([spans[0, :-1], spans[0, 1:]], axis=1)
        if not self.arcs.driven:
            times[:, 1] = period[0] * np.diff(parts[0])
        arc = closing.arcs.follow(times, y[0], direction)
        return _Point(chain, numbers, arc.by_params[None])

    def equations(self, point: _Point) -> tuple[np.ndarray, Condensed, np.ndarray]:
        """The matrix (2n, 2n + F) of the first state and what else is free; the chain; the right-hand side (2n,)."""
        chain = point.chain
        columns = [chain.rate[..., None] * np.diff(chain.parts)[..., None, None]] if self.period_is_free else []
        columns = [*columns, point.by_number, chain.defect[..., None]]
        condensed = condense(chain.growth, np.concatenate(columns, axis=3))
        matrix = np.concatenate([condensed.first + condensed.last, condensed.more[..., :-1]], axis=2)
        return matrix[0], condensed, condensed.more[0, :, -1]

    def tangent(self, point: _Point) -> np.ndarray | None:
        """The unit null vector (2n + F,) that is orthogonal to the symmetries; None where there is none."""
        matrix, condensed, _ = self.equations(point)
        states = matrix.shape[0]
        still, whole = (
            decide(x[None], np.array([_shooting.RANK])) for x in ((condensed.first + condensed.last)[0], matrix)
        )
        symmetries = np.zeros((matrix.shape[1], states - still.rank[0]))
        symmetries[:states] = still.right[0][:, still.rank[0] :]
        null = whole.right[0][:, whole.rank[0] :]
        left = null - symmetries @ (symmetries.T @ null)
        vectors, sizes, _ = np.linalg.svd(left, full_matrices=False)
        return vectors[:, 0] if len(sizes) and sizes[0] > 0.5 else None

    def moved(self, point: _Point, first: np.ndarray, right: float) -> _Point:
        """The point after a change (2n + F,) of what is free, and of the inner states with it."""
        _, condensed, _ = self.equations(point)
        states = point.chain.y.shape[2]
        z = np.append(first[states:], right)[None, :, None]
        dy = condensed.inner(first[None, :states, None], first[None, :states, None], z)[..., 0]
        period, numbers = point.chain.period.copy(), point.numbers.copy()
        if self.period_is_free:
            period += first[states]
        if self.place is not None:
            numbers[self.place] += first[-1]
        return self.point(point.chain.y + dy, period, point.chain.parts, numbers)

    def along(self, point: _Point, tangent: np.ndarray) -> _Point:
        """The same with the rate of its value along a tangent (2n + F,)."""
        if self.place is not None:
            return point._replace(rate=float(tangent[-1]))
        slope = self.arcs.energy_slope(0.0, point.chain.y[:, 0])[0]
        return point._replace(rate=float(slope @ tangent[: len(slope)]))

    def value(self, point: _Point) -> float:
        """The energy, or the parameter."""
        if self.place is not None:
            return float(point.numbers[self.place])
        return float(self.arcs.energy(0.0, point.chain.y[:, 0])[0])


def _corrected(follower: _Follower, point: _Point, tangent: np.ndarray) -> tuple[_Point | None, int]:
    """The orbit in the plane across the tangent, and after how many trials; None where there is none."""
    for trial in range(_TRIALS):
        chain = point.chain
        if not chain.ok[0] or not chain.period[0] > 0:
            return None, trial
        if chain.closure()[0] <= 1e-2 * CLOSED * chain.size()[0]:
            return point, trial
        matrix, _, right = follower.equations(point)
        matrix, right = np.concatenate([matrix, tangent[None]]), np.append(right, 0.0)
        threshold = _shooting.threshold_of(chain)
        point = follower.moved(point, -decide(matrix[None], threshold).least_norm(right[None])[0], 1.0)
    done = point.chain.ok[0] and point.chain.closure()[0] <= CLOSED * point.chain.size()[0]
    return (point if done else None), _TRIALS


def _followed(follower: _Follower, y0, period, until, step: float, count: int) -> tuple[list[_Point], str]:
    """The orbits of a family, and why it ends."""
    closing = follower.closing(follower.arcs.numbers)
    parts, y = _shooting.guesses(closing, y0, period, int(arcs_each(follower.arcs, y0, period)[0]))
    points = [follower.point(y, period, parts, follower.arcs.numbers)]
    tangent, shortest = follower.tangent(points[0]), _SHORTEST * step
    if tangent is None:
        return points, "The orbit is alone: it closes at no other energy, or parameter, near its own."
    rising = follower.value(follower.moved(points[0], 1e-4 * step * tangent, 0.0)) > follower.value(points[0])
    wanted = until is None or until > follower.value(points[0])
    tangent = tangent if rising == wanted else -tangent
    points[0] = follower.along(points[0], tangent)
    while len(points) < count:
        point, trials = _corrected(follower, follower.moved(points[-1], step * tangent, 0.0), tangent)
        if point is None or _shooting.stopped(point.chain)[0]:
            step /= 2
            if step < shortest:
                return points, _end(follower, points[-1], point)
            continue
        points.append(point)
        following = follower.tangent(point)
        if following is None:
            return points, "The family ends where its orbits lose the direction in which they had neighbours."
        tangent = following * np.sign(following @ tangent)
        points[-1] = follower.along(point, tangent)
        step *= 1.5 if trials <= _QUICK else 0.7
        if until is not None and (follower.value(point) > until) == wanted:
            return points, f"The family was followed until {follower.value(point):.6g}, beyond {until:.6g}."
    return points, f"{count} orbits were found; the family goes on: raise count to follow it further."


def _end(follower: _Follower, last: _Point, trial: _Point | None) -> str:
    where = f"{follower.value(last):.9g}, with a period of {last.chain.period[0]:.6g}"
    if trial is not None:
        return f"The family ends at an equilibrium, near {where}."
    return (
        f"The family could not be followed beyond {where}. It ends there, as at a collision or at an orbit that takes "
        "for ever, or begins to depend on its value so steeply that no step is short enough."
    )


def _told(follower: _Follower, points: list[_Point], message: str) -> Family:
    """The family in the user's structure, with what happens between its orbits."""
    found = [told(follower.closing(point.numbers), point.chain) for point in points]
    multipliers = np.concatenate([one.multipliers for one in found])
    value = np.array([follower.value(point) for point in points])
    energy = [follower.arcs.with_numbers(point.numbers).energy(0.0, point.chain.y[:, 0])[0] for point in points]
    rate = np.array([point.rate for point in points])
    fold = np.append(False, rate[1:] * rate[:-1] < 0)
    through = [_passed(multipliers, sign) for sign in (1, -1)]
    q, qdot = map(follower.arcs.layout.restore, halves(np.concatenate([one.y for one in found])))
    period, closure, stable = (
        np.concatenate([getattr(one, name) for one in found]) for name in ("period", "closure", "stable")
    )
    near_fold = fold | np.append(fold[1:], False) | np.append(False, fold[:-1])
    columns = q, qdot, period, value, np.array(energy), multipliers, closure, stable, fold
    return Family._make([*jax.tree.map(jnp.asarray, (*columns, through[0] & ~near_fold, through[1])), message])


def _passed(multipliers: np.ndarray, sign: int) -> np.ndarray:
    """Whether Π (1 − sign·μ) over those that are not 1 by symmetry changes its sign before each orbit, (N,)."""
    known = int((multipliers == 1).sum(axis=1).min())
    others = multipliers[:, : multipliers.shape[1] - known]
    product = np.prod(1 - sign * others, axis=1).real
    return np.append(False, product[1:] * product[:-1] < 0)
