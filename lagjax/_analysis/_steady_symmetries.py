"""The directions in configuration space along which a scene is invariant, if velocities are rotated with them.

A direction d of the coordinates is one if a matrix Ω, of the velocities of coordinates that no function reads,
satisfies

    ∂L/∂q d + p·Ωq̇ = 0,   ∂Q/∂q d + (∂Q/∂q̇) Ωq̇ + ΩᵀQ = 0,   ∂f/∂q d = 0,   ∂a/∂q d + (∂a/∂q̇) Ωq̇ = 0 where a = 0

Ω is zero for the angle of a wheel and for the place of its contact; with its yaw the velocity of that place turns. Most
directions are single coordinates; rotors that springs couple turn together. The equations are linear in d and Ω. They
are tested at random states, as they hold everywhere or nowhere.
"""

from typing import NamedTuple

import jax
import numpy as np

from lagjax._analysis._scene_state import SceneState
from lagjax._equations import Sample, echelon_form, truncated_svd
from lagjax._interface import halves, is_concrete

# States, beside two for each number of Ω, and the numbers of Ω up to which it is sought: of more coordinates that
# nothing reads only those turn that constraints on velocities hold.
_STATES, _MOST_TURNING = 8, 144
# The distance of central differences of fourth order, in sizes of a coordinate, and what they leave of terms that
# cancel, 1e-12, with room for a loss of four digits; the smallest singular value that counts.
_STEP, _CANCELS, _SINGULAR = 2.0**-11, 1e-8, 1e-9

_DIFFERENTIATED = "nonconservative_force", "residual"


class SteadySymmetries(NamedTuple):
    """The `cyclic` coordinates (n,), one for each direction; with coordinate i the others move by `moves[:, i]`

    (n, n), itself by 1, and velocities rotate by Ω = `turns[i]` (n, n, n).
    """

    cyclic: np.ndarray
    moves: np.ndarray
    turns: np.ndarray


class IdentityTerms(NamedTuple):
    """Terms of the identities at S states, and their derivatives by q and q̇, (S, …, n) each."""

    lagrangian_by_q: np.ndarray
    momentum: np.ndarray
    force: np.ndarray
    force_by_q: np.ndarray
    force_by_qdot: np.ndarray
    place_by_q: np.ndarray
    rate_by_q: np.ndarray
    rate_by_qdot: np.ndarray


def find_symmetries(scene: SceneState, preferred: np.ndarray) -> SteadySymmetries:
    """Return the symmetries at the state of a scene; if it is traced, at random numbers.

    Of coordinates that move together a `preferred` one (n,) is cyclic.
    """
    n, random = scene.layout.size, np.random.default_rng(2)
    params = jax.tree.map(
        lambda x: x if is_concrete(x) else random.uniform(0.3, 1.2, x.shape).astype(x.dtype), scene.params
    )
    q, of_q, of_qdot = np.ones(n), 0.5 * np.ones(n), np.ones(n)
    if scene.concrete:
        q, (of_q, of_qdot, *_) = np.asarray(scene.q), scene.scales
    draws = random.uniform(-1, 1, (2, _STATES + 2 * min(n * n, _MOST_TURNING), n))
    states = np.asarray(q + 0.5 * of_q * draws[0]), np.asarray(of_qdot * draws[1])
    steps = _STEP * of_q, _STEP * of_qdot
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        terms, rates = _evaluate_terms(scene, params, steps, *states)
        consistent, of_rates = states[1], terms
        if rates.size:  # one step arrives: a is affine in q̇, as d'Alembert's principle takes it
            consistent = states[1] - truncated_svd(np.nan_to_num(terms.rate_by_qdot), _SINGULAR).least_norm(rates)
            of_rates, _ = _evaluate_terms(scene, params, steps, states[0], np.nan_to_num(consistent))
    terms = terms._replace(rate_by_q=of_rates.rate_by_q, rate_by_qdot=of_rates.rate_by_qdot)
    well = np.logical_and.reduce([np.isfinite(x).reshape(len(x), -1).all(axis=1) for x in (*terms, consistent)])
    if well.sum() < _STATES:
        raise ValueError(
            "The Lagrangian, a force or a constraint, or a derivative of it, is not finite at most states about "
            "(q, qdot): give a state in the middle of where motions take place."
        )
    units = of_q * np.where(preferred, 1.0, 1e3)
    return _solve_identities(IdentityTerms(*(x[well] for x in terms)), states[1][well], consistent[well], of_q, units)


def _evaluate_terms(
    scene: SceneState, params, steps, q: np.ndarray, qdot: np.ndarray
) -> tuple[IdentityTerms, np.ndarray]:
    """Return the terms at states (S, n), with second derivatives by central differences; and a."""

    def evaluate(y, *names):
        sample = Sample.from_scene(scene.system, scene.layout, *halves(y.reshape(-1, y.shape[-1])), 0.0, params)
        found = sample.quantities(*names)
        return [found[name].reshape(*y.shape[:-1], *found[name].shape[1:]) for name in names]

    y, unit = np.concatenate([q, qdot], axis=1), np.diag(np.concatenate(steps))
    by_q, momentum, jacobian = evaluate(y, "lagrangian_by_q", "momentum", "jacobian")
    force, residual = evaluate(y, *_DIFFERENTIATED)
    moved = [evaluate(y[:, None] + k * unit, *_DIFFERENTIATED) for k in (1, -1, 2, -2)]
    ahead, behind, far_ahead, far_behind = ([np.swapaxes(x, 1, 2) for x in of] for of in moved)
    derivatives = [
        (8 * (a - b) - (c - d)) / (12 * np.concatenate(steps))
        for a, b, c, d in zip(ahead, behind, far_ahead, far_behind, strict=True)
    ]
    (force_by_q, force_by_qdot), (residual_by_q, _) = map(halves, derivatives)
    count = scene.derivation.position_count
    of_rates = residual_by_q[:, count:], jacobian[:, count:]
    terms = IdentityTerms(by_q, momentum, force, force_by_q, force_by_qdot, jacobian[:, :count], *of_rates)
    return terms, residual[:, count:]


def _solve_identities(of: IdentityTerms, qdot, consistent, of_q, units) -> SteadySymmetries:
    """Solve for the symmetries, given terms at states with velocities `qdot` (S, n), `consistent` ones for a.

    `of_q` (n,) are sizes of coordinates; of coordinates that move together that with the largest unit is cyclic.
    """
    n = qdot.shape[1]
    right = [x.reshape(-1, n) for x in (of.lagrangian_by_q, of.force_by_q, of.place_by_q, of.rate_by_q)]
    unread = np.logical_and.reduce([(x == 0).all(axis=0) for x in right])
    if unread.sum() ** 2 > _MOST_TURNING:
        unread = unread & (of.rate_by_qdot != 0).any(axis=(0, 1))
    turning = np.flatnonzero(unread) if unread.sum() ** 2 <= _MOST_TURNING else np.zeros(0, int)
    of_l = of.momentum[:, turning, None] * qdot[:, None, turning]
    of_force = of.force_by_qdot[:, :, turning, None] * qdot[:, None, None, turning]
    of_force = of_force + of.force[:, None, turning, None] * np.eye(n)[:, None, turning]
    of_place = np.zeros((*of.place_by_q.shape[:2], len(turning), len(turning)))
    of_rates = of.rate_by_qdot[:, :, turning, None] * consistent[:, None, None, turning]
    of_turns = of_l, of_force, of_place, of_rates
    parts = [x.reshape(len(y), len(turning) ** 2) for x, y in zip(of_turns, right, strict=True)]
    left, right = np.concatenate(parts), -np.concatenate(right) * of_q
    sizes = np.maximum(np.abs(left).max(axis=1, initial=0), np.abs(right).max(axis=1))
    left, right = (x[sizes > 0] / sizes[sizes > 0, None] for x in (left, right))
    found = np.zeros((len(turning) ** 2, n))
    if left.size:
        found = np.linalg.lstsq(left, right, rcond=_SINGULAR)[0]
    # Columns that nothing but Ω balances are single directions; others may balance each other.
    null = truncated_svd(left @ found - right, absolute=_CANCELS * len(left) ** 0.5).null if len(left) else np.eye(n)
    directions = echelon_form((null * (of_q / units)[:, None]).T) * units  # by rows, in the user's units
    pivots = np.array([int(np.argmax(np.abs(row / units))) for row in directions], int)
    cyclic, moves, turns = np.zeros(n, bool), np.zeros((n, n)), np.zeros((n, n, n))
    cyclic[pivots] = True
    directions = directions / directions[np.arange(len(pivots)), pivots][:, None]
    moves[:, pivots] = directions.T
    among = len(turning), len(turning)
    turns[np.ix_(pivots, turning, turning)] = (directions / of_q @ found.T).reshape(len(pivots), *among)
    # Of a matrix that is known to ten digits, what is nothing beside its largest entry is nothing.
    turns[np.abs(turns) <= _CANCELS * np.abs(turns).max(initial=0)] = 0.0
    return SteadySymmetries(cyclic, moves, turns)
