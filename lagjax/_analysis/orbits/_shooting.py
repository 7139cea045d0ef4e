"""Multiple shooting for orbits and paths: damped Newton on states along the motion and the period, for many at once.

    φ(y_k; a_k T, a_(k+1) T) − y_(k+1) = 0,  k = 0 … K−1,  y_K = S y_0,  or q_0 and q_K given

S is the identity, or a symmetry of the scene up to which the motion returns; the parts 0 = a_0 < … < a_K = 1 of the
period are those in which the guess takes equally many steps, so that violent moments make short arcs. Of a path both
positions are given and T is its duration. The two differ in how the first and the last state depend on the numbers that
are free, and in what a deficient rank says: an orbit has neighbours, of which the nearest one is taken; ends of a path
are then conjugate, and no step is.

Short arcs keep what one error becomes small, so that orbits close whose errors grow a millionfold in a period. Arcs of
all orbits are rows of one run. Of the alternatives, single shooting loses as many digits as an error grows, and
collocation needs as many unknowns as there are steps. The first states come from both sides: forward from the start for
half the period and backward for the other half, so that errors of the guess grow only half as long.

Source: Stoer & Bulirsch, *Introduction to Numerical Analysis*, §7.3.5; Deuflhard, *Newton Methods for Nonlinear
Problems* (2004), §3.3 and §7.1, for the damping and the rank.
"""

from typing import NamedTuple, TypeVar

import jax
import numpy as np

from lagjax._analysis.orbits._arc_motions import Arcs, Units
from lagjax._analysis.orbits._condensation import Condensed, condense_chain
from lagjax._equations import TruncatedSVD, singular_threshold, truncated_svd

Members = TypeVar("Members")

# Relative to the largest singular value: below, a direction counts as degenerate. Measured on the 695 planar orbits,
# true ones are above 1e-6 and degenerate ones of a closed orbit below 1e-11. Twice as much changes no rank there.
RANK = 1e-8
_PER_DEFECT, _LARGEST_RANK = 30.0, 1e-3  # before it is closed, an orbit's degenerate directions are so by its defect
_TRIALS = 60
# The shares of a step that are tried. Of 64 random paths quarters miss one that halves find.
_SHARES, _SHARES_OF_PATH = 0.25 ** np.arange(8), 0.5 ** np.arange(10)
_ENOUGH = 8e-15  # of the size of the state: round-off, below which trials cannot be told from each other


class Closing(NamedTuple):
    """The conditions on a chain. Those of an orbit: S y = `matrix` y + `shift`, and an energy if given.

    A path has the given positions: `q_end` (n,), and the one it begins with, at the time `t_first`.
    """

    arcs: Arcs
    matrix: np.ndarray
    shift: np.ndarray
    energy: float | None = None
    t_first: float = 0.0
    q_end: np.ndarray | None = None

    @classmethod
    def from_arcs(cls, arcs: Arcs, energy: float | None = None) -> "Closing":
        return cls(arcs, np.eye(2 * arcs.size), np.zeros(2 * arcs.size), energy)

    @property
    def has_given_duration(self) -> bool:
        """True if the duration is given: that of a path, and the period of a driven scene."""
        return self.arcs.driven or self.q_end is not None

    def free_directions(self) -> tuple[np.ndarray, np.ndarray]:
        """E and F (2n, 2n): unknowns u (2n,) change the first state by E u and the last one by F u."""
        whole, n = np.eye(2 * self.arcs.size), self.arcs.size
        if self.q_end is None:
            return whole, whole
        return np.roll(whole, n, axis=0) * (np.arange(2 * n) < n), whole * (np.arange(2 * n) >= n)

    def arc_targets(self, y: np.ndarray, end: np.ndarray, of_state: np.ndarray) -> np.ndarray:
        """Return the states (B, K, 2n) where arcs from `y` that end at `end` should end, in units of (B, 2n)."""
        target, n = np.roll(y, -1, axis=1), self.arcs.size
        if self.q_end is not None:
            target[:, -1] = np.concatenate([self.q_end / of_state[:, :n], end[:, -1, n:]], axis=1)
        return target

    def energy_condition(self, y0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the energy error of first states (B, 2n), (B, m), and its gradient (B, m, 2n); m is 0 or 1."""
        if self.energy is None:
            return np.zeros((len(y0), 0)), np.zeros((len(y0), 0, y0.shape[1]))
        off = self.arcs.energy(0.0, y0) - self.energy
        return off[:, None], self.arcs.energy_slope(y0)[:, None]


class Chain(NamedTuple):
    """B chains of K arcs: states `y` (B, K, 2n) at fractions `parts` (B, K + 1) of the periods `period` (B,).

    All is in the `units` of each chain, so that the user's units do not matter. `defect` (B, K, 2n) is the end of an
    arc minus the next state, `growth` (B, K, 2n, 2n) the derivatives of the arcs, `rate` (B, K, 2n) that of the ends in
    time; those of the last arc are multiplied by S⁻¹. `off` (B, m) and `slope` (B, m, 2n) are conditions on the first
    state. `ok` (B,): True if all arcs were integrated; `why` (B,), of text, why not.
    """

    y: np.ndarray
    period: np.ndarray
    parts: np.ndarray
    units: Units
    defect: np.ndarray
    growth: np.ndarray
    rate: np.ndarray
    off: np.ndarray
    slope: np.ndarray
    ok: np.ndarray
    why: np.ndarray

    def states(self) -> np.ndarray:
        """Return the first states (B, 2n) in the units of the user."""
        return self.y[:, 0] * self.units.state

    def periods(self) -> np.ndarray:
        """Return the periods (B,) in the unit of the user."""
        return self.period * self.units.time

    def size(self) -> np.ndarray:
        """Return the largest number of a state, (B,)."""
        return np.abs(self.y).max(axis=(1, 2))

    def closure(self) -> np.ndarray:
        """Return the largest defect of each chain, (B,)."""
        return np.where(self.ok, np.abs(self.defect).max(axis=(1, 2)), np.inf)

    def merit(self) -> np.ndarray:
        """Return the larger of the closure and the violation of the conditions on the first state, (B,)."""
        steep = np.maximum(np.abs(self.slope).max(axis=2, initial=0.0), 1e-300)
        return np.maximum(self.closure(), np.max(np.abs(self.off) / steep, axis=1, initial=0.0))

    def select(self, chosen: np.ndarray) -> "Chain":
        """Return the chains at `chosen`: indices, or a mask (B,)."""
        return jax.tree.map(lambda x: x[chosen], self)


def replace_members(members: Members, places: np.ndarray, others: Members) -> Members:
    """Replace the members at indices `places` by `others`, in arrays with a first axis of members."""

    def replace(x: np.ndarray, new: np.ndarray) -> np.ndarray:
        x = x.copy()
        x[places] = new
        return x

    return jax.tree.map(replace, members, others)


def guess_states(closing: Closing, y0: np.ndarray, period: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return fractions (B, K + 1) of the period and states (B, K, 2n) there, from starts (B, 2n).

    The motion is integrated from both ends to the middle, if the scene is not driven. K is a power of two.
    """
    arcs = closing.arcs
    if count == 1:
        return np.broadcast_to([0.0, 1.0], (len(y0), 2)), y0[:, None].copy()
    if arcs.driven:
        parts = arcs.divide_evenly(period, y0, count)
        return parts, arcs.integrate(period[:, None] * parts, y0).path[:, :count]
    half, images = count // 2, y0 @ closing.matrix.T + closing.shift
    ahead, back = arcs.divide_evenly(period / 2, y0, half), arcs.divide_evenly(-period / 2, images, half)
    first = arcs.integrate(period[:, None] / 2 * ahead, y0).path
    second = arcs.integrate(-period[:, None] / 2 * back, images).path
    parts = np.concatenate([ahead / 2, 1 - back[:, -2::-1] / 2], axis=1)
    return parts, np.concatenate([first, second[:, -2:0:-1]], axis=1)


def integrate_chain(closing: Closing, y: np.ndarray, period: np.ndarray, parts: np.ndarray, units: Units) -> Chain:
    """Integrate the arcs from these states, (B, K, 2n), all in these units: a `Chain`."""
    arcs, (chains, count, states) = closing.arcs, y.shape
    of_state, spans = units.state[:, None], (period * units.time)[:, None]
    times = closing.t_first + np.stack([spans * parts[:, :-1], spans * parts[:, 1:]], axis=2).reshape(-1, 2)
    rows = (y * of_state).reshape(-1, states)
    if not closing.has_given_duration:  # each begins at zero, where times have the most digits
        times = (spans * np.diff(parts)).reshape(-1, 1) * np.array([0.0, 1.0])
    arc = arcs.differentiate(times, rows)
    rate = arc.rate.reshape(y.shape)
    ok = np.asarray((arc.ok & arc.returns).reshape(chains, count).all(axis=1))
    end, growth = arc.end.reshape(y.shape), arc.by_start.reshape(*y.shape, states)
    inverse = np.linalg.inv(closing.matrix)
    end[:, -1], rate[:, -1] = np.linalg.solve(closing.matrix, (end[:, -1] - closing.shift).T).T, rate[:, -1] @ inverse.T
    growth[:, -1] = inverse @ growth[:, -1]
    end = end / of_state
    defect = end - closing.arc_targets(y, end, units.state)
    off, slope = closing.energy_condition(y[:, 0] * units.state)
    rate, slope = rate * units.time[:, None, None] / of_state, slope * of_state
    why = np.full(chains, "", object)
    for k in np.flatnonzero(~ok).tolist():
        row = k * count + int(np.argmin((arc.ok & arc.returns)[k * count : (k + 1) * count]))
        why[k] = arcs.explain_failure(row, arc, rows, times[row, 1])
    return Chain(y, period, parts, units, defect, units.scale_growth(growth), rate, off, slope, ok, why)


class NewtonEquations(NamedTuple):
    """Newton's equations of B chains, condensed to both ends, with the rank decided; `right` (B, 2n + m).

    The unknowns are u (2n,) of `Closing.free_directions`, and the period if it is free.
    """

    condensed: Condensed
    decided: TruncatedSVD
    right: np.ndarray


def condense_equations(closing: Closing, chain: Chain) -> NewtonEquations:
    condensed = condense_chain(
        chain.growth, np.stack([chain.rate * np.diff(chain.parts)[..., None], chain.defect], axis=3)
    )
    of_first, of_last = closing.free_directions()
    regular, of_period = condensed.first @ of_first + condensed.last @ of_last, condensed.more[..., :1]
    # A condition in units of the state, as the defects are.
    unit = 1 / np.maximum(np.abs(chain.slope).max(axis=2), 1e-300)
    matrix = np.concatenate([regular, unit[:, :, None] * chain.slope], axis=1)
    right = np.concatenate([condensed.more[..., 1], unit * chain.off], axis=1)
    if not closing.has_given_duration:
        none = np.zeros((len(matrix), chain.off.shape[1], 1))
        matrix = np.concatenate([matrix, np.concatenate([of_period, none], axis=1)], axis=2)
    if closing.q_end is None:
        threshold = np.clip(_PER_DEFECT * chain.merit() / np.maximum(chain.size(), 1e-300), RANK, _LARGEST_RANK)
    else:
        threshold = singular_threshold(chain.y[0].size, float)
    return NewtonEquations(condensed, truncated_svd(matrix, threshold), right)


def newton_correction(closing: Closing, chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Return the Newton step of least norm: dy (B, K, 2n), dT (B,); 0 if the ends of a path are conjugate."""
    condensed, decided, right = condense_equations(closing, chain)
    step, states = -decided.least_norm(right), chain.y.shape[2]
    period = np.zeros(len(step)) if closing.has_given_duration else step[:, -1]
    first, last = (step[:, :states] @ of.T for of in closing.free_directions())
    z = np.stack([period, np.ones(len(step))], axis=1)[:, :, None]
    dy = condensed.expand_solution(first[..., None], last[..., None], z)[..., 0]
    if closing.q_end is not None:
        dy[decided.rank < states] = 0.0
    return dy, period


def close_chains(closing: Closing, y: np.ndarray, period: np.ndarray, parts: np.ndarray, units: Units) -> Chain:
    """Find the closed chains, or joined paths, near these states; `Chain.closure` is the remaining error."""
    chain = integrate_chain(closing, y / units.state[:, None], period / units.time, parts, units)
    active = chain.ok.copy()
    for _ in range(_TRIALS):
        active &= chain.merit() > _ENOUGH * chain.size()
        if not active.any():
            break
        places = np.flatnonzero(active)
        better = _damped_newton_step(closing, chain.select(places))
        after, before = better.merit(), chain.merit()[places]
        chain = replace_members(chain, places[after < before], better.select(after < before))
        active[places[~(after < 0.9 * before)]] = False
    return chain


def _damped_newton_step(closing: Closing, chain: Chain) -> Chain:
    """Return each chain after the largest fraction of a Newton step that lowers its defect."""
    dy, dperiod = newton_correction(closing, chain)
    longest = np.minimum(1.0, 0.25 * chain.period / np.maximum(np.abs(dperiod), 1e-300))
    best, waiting = chain, np.arange(len(chain.period))
    for share in _SHARES if closing.q_end is None else _SHARES_OF_PATH:
        here, scale = chain.select(waiting), share * longest[waiting]
        y, period = here.y + scale[:, None, None] * dy[waiting], here.period + scale * dperiod[waiting]
        trial = integrate_chain(closing, y, period, here.parts, here.units)
        lower = trial.merit() < (1 - 0.25 * scale) * here.merit()
        near = here.merit() < 1e3 * _ENOUGH * here.size()  # where rounding decides
        best = replace_members(best, waiting[lower], trial.select(lower))
        waiting = waiting[~lower & ~near]
        if not len(waiting):
            break
    return best


class Symmetries(NamedTuple):
    """The null spaces of monodromy − 1 of a closed chain and of its transpose: (K, 2n, k) at every state."""

    null: np.ndarray
    of_transpose: np.ndarray


def find_null_spaces(chain: Chain, most: int | None = None) -> list[Symmetries]:
    """Return the null spaces of closed chains, of at most `most` dimensions, by the smallest singular values.

    A branch point has one more dimension than the symmetries, which `most` excludes.
    """
    forward, null = _closure_null_vectors(chain.growth)
    # ℓ_k = G_kᵀ ℓ_(k+1): the same chain, walked back from the end.
    back, of_transpose = _closure_null_vectors(np.swapaxes(chain.growth[:, ::-1], 2, 3))
    found, states = [], chain.y.shape[2]
    for k in range(len(chain.period)):
        first = max(forward.rank[k], back.rank[k], 0 if most is None else states - most)
        right, left = null[k][..., first:], of_transpose[k][..., first:]
        found.append(Symmetries(right, np.roll(left[::-1], 1, axis=0)))
    return found


def _closure_null_vectors(growth: np.ndarray) -> tuple[TruncatedSVD, np.ndarray]:
    """Return the rank of A + B of closed chains, and the right singular vectors at all states, (B, K, 2n, 2n)."""
    chains, count, states, _ = growth.shape
    condensed = condense_chain(growth, np.zeros((chains, count, states, 0)))
    rank = truncated_svd(condensed.first + condensed.last, RANK)
    return rank, condensed.expand_solution(rank.right, rank.right, np.zeros((chains, 0, states)))


def is_equilibrium(chain: Chain) -> np.ndarray:
    """True if the rates along a chain are negligible: an equilibrium satisfies the conditions with any period."""
    return np.abs(chain.rate).max(axis=(1, 2)) * chain.period <= 1e-6 * np.maximum(chain.size(), 1.0)
