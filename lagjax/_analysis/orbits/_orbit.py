"""`periodic_orbit`: periodic motions, from guesses of their start and period."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._analysis.orbits import _shooting
from lagjax._analysis.orbits._arc_motions import Arcs, check_starts
from lagjax._analysis.orbits._floquet import UNCERTAIN, UNSTABLE, multipliers_of, pairing_error, reduce_arcs
from lagjax._analysis.orbits._shooting import Chain, Closing
from lagjax._equations import singular_threshold, truncated_svd
from lagjax._interface import SUCCESSFUL, Layout, SimulationError, halves, require_finite, require_flag, require_number
from lagjax._primitives import accepts_singles
from lagjax._run.hybrid import Scene

# The tolerance of the arcs: their truncation is then below round-off, which is what an orbit closes to.
RTOL = 2.3e-16
# The largest defect of an orbit that counts as closed, in units of its largest number: a thousand roundings of arcs
# along which errors grow a thousandfold. Beyond, Newton's method came to rest at something that is no orbit.
CLOSED = 1e-10
WELL_CLOSED = 1e-12  # of the state, whose rounding a hundred steps magnify so far: more arcs are not tried then
# Steps of one arc: with a series of order twenty some hundred of them make errors grow a thousandfold at most.
_STEPS_OF_ARC, MOST_ARCS, _MORE = 400, 128, 8
_PORTION = 2**13  # arcs that are followed together


class Orbit(NamedTuple):
    """A periodic orbit, or a batch of them with the members as first axis of everything.

    - `q0`, `qdot0`: a state of it, in the user's structure; `period` ().
    - `multipliers` (2n,): the eigenvalues of the monodromy matrix, complex, each beside its reciprocal where the energy
      is conserved, the largest first, and last of all those that are 1 by the time shift and by conserved momenta.
    - `closure` (): the largest defect of its arcs, of a single arc φ(y; T) − y, as a fraction of the size of the
      coordinate, or velocity: the largest at the guess, or what that makes of it in T/2π, alike in kinetic energy.
    - `stable`: whether no multiplier is larger than 1, so that errors do not grow exponentially; False also where
      rounding leaves that open, because the product of a pair that should be 1 is off by more than 1e-3.
    - `ok`: whether it closes; `message`: a sentence that says why not (all numbers are then those of the best trial),
      or that the multipliers are uncertain, and by how much.
    """

    q0: PyTree
    qdot0: PyTree
    period: jax.Array
    multipliers: jax.Array
    closure: jax.Array
    stable: jax.Array
    ok: jax.Array
    message: str | tuple[str, ...]

    def __repr__(self) -> str:
        return "\n".join(_orbit_summary(self))


def _orbit_summary(orbit: Orbit) -> list[str]:
    named = jax.tree_util.tree_leaves_with_path(orbit.q0)
    batch = np.shape(orbit.period)
    contents = ", ".join(f"q0{jax.tree_util.keystr(path)} {np.shape(leaf)}" for path, leaf in named[:_SHOWN])
    more = f", … ({len(named) - _SHOWN} more)" if len(named) > _SHOWN else ""
    first = f"Orbit{f' of {batch[0]} members' if batch else ''}: {contents}{more}, and qdot0"
    if not all(isinstance(leaf, jax.Array | np.ndarray) for leaf in orbit[2:7]) or len(batch) > 1:
        return [first]
    ok, period = (np.atleast_1d(np.asarray(x)) for x in (orbit.ok, orbit.period))
    sizes = np.abs(np.asarray(orbit.multipliers)).reshape(len(ok), -1).max(axis=1, initial=0.0)
    if not batch:
        stable = "stable" if orbit.stable else "not known to be stable" if orbit.message else "unstable"
        verdict = f"closes to {float(orbit.closure):.2g}, {stable}" if ok[0] else "no orbit"
        text = f": {orbit.message}" if orbit.message else ""
        return [first, f"period {period[0]:.9g}, largest |multiplier| {sizes[0]:.6g}", verdict + text]
    if not ok.any():
        return [first, "periods unknown", f"0 of {len(ok)} close: {orbit.message[0]}"]
    closure, stable = np.asarray(orbit.closure), np.asarray(orbit.stable)
    span = f"periods from {period[ok].min():.6g} to {period[ok].max():.6g}, |multipliers| up to {sizes[ok].max():.6g}"
    median = f"to {np.median(closure[ok]):.2g} in the median"
    verdicts = f"{ok.sum()} of {len(ok)} close, {median}, {stable.sum()} are stable"
    if not ok.all():
        verdicts += f"; the first that does not is member {int(np.argmin(ok))}"
    return [first, span, verdicts]


_SHOWN = 6  # leaves of q0, which may have any number of them


@accepts_singles(("q0", "qdot0"), ("period", "params"))
def periodic_orbit(
    system: Scene,
    q0: PyTree,
    qdot0: PyTree,
    period: jax.Array | float,
    params: PyTree = None,
    *,
    energy: float | None = None,
    image: Callable | None = None,
    throw: bool = True,
) -> Orbit:
    r"""The periodic orbit of `system` nearest to a guess (q0, qdot0) of a state of it and `period` of its period.

    Solves φ_T(y) = y, with φ_T the motion over the time T, by Newton's method on states at equal parts of the period
    and on T; for a driven scene, one in which anything reads `t`, the period is kept as given. Derivatives of the arcs
    are exact. Where the orbit is one of many (shifted in time, at another energy, or translated or rotated where
    momenta are conserved), each correction is the one of least norm: of changes of (q, qdot, T) as fractions of their
    sizes, so that the same orbit is found in any units. The rank of the
    equations is decided by their singular values: those below 1e-8 of the largest count as zero.

    - `period`: a number; or an array (N,) for N guesses at once, with the members as first axis of every leaf of `q0`
      and `qdot0`. All guesses share `params`.
    - `energy`: find the orbit with this energy h = p·q̇ − L; by default the nearest one, with whatever energy it has.
    - `image`: an affine function of (q, qdot) that returns (q, qdot), such as an exchange of bodies or a full turn of
      an angle. The motion then has to return to the image of its start, φ_T(y) = image(y), and the multipliers are
      those of image⁻¹ φ_T. It should be a symmetry of the scene.
    - `throw`: raise when a single guess leads to no orbit. A batch never raises: look at `ok` and `message`.

    The scene may have contacts, or be a `Hybrid`: it starts in that one's mode `start`, at a state off its guards, and
    the period is followed as one arc.

    Multipliers that are 1 by symmetry are split off first. The others are computed as K-th roots over K arcs, so that a
    multiplier of 1e-9 beside one of 1e9 is as accurate as any.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, for a scene with constraints, and for
    one that has no machine code; `SimulationError` where there is no orbit near the guess.

    Source: Stoer & Bulirsch, *Introduction to Numerical Analysis*, §7.3.5 (multiple shooting); Muñoz-Almaraz et al.,
    *Continuation of periodic orbits in conservative and Hamiltonian systems*, Physica D 181 (2003) 1, for the rank.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + jnp.cos(q))
    orbit = lagjax.periodic_orbit(pendulum, 1.0, 0.0, 6.5)  # 6.6997 at this amplitude
    ```
    """
    require_flag(throw, "throw")
    periods, layout, y0 = check_starts(q0, qdot0, period, "period")
    arcs = Arcs.from_system(system, layout, params, RTOL, "Periodic orbits", jumps=True)
    found = find_orbits(_closing_conditions(arcs, energy, image), y0, periods.ravel())
    if periods.ndim == 0:
        if throw and not found.ok[0]:
            raise SimulationError(found.message[0], None)
        return restore_orbits(layout, FlatOrbits(*(x[0] for x in found)), found.message[0])
    return restore_orbits(layout, found, tuple(found.message))


def restore_orbits(layout: Layout, found: "FlatOrbits", message: str | tuple[str, ...]) -> Orbit:
    q, qdot = map(layout.restore, halves(found.y))
    return Orbit._make([*jax.tree.map(jnp.asarray, (q, qdot, *found[1:6])), message])


def _closing_conditions(arcs: Arcs, energy, image) -> Closing:
    """Return the conditions on an orbit; raise if the energy is no number, or the image is not affine."""
    if energy is not None:
        require_number(energy, "energy")
        require_finite(energy, "energy")
        energy = float(energy)
        if not arcs.conserves:
            raise ValueError("energy=... asks for an energy, but that of this scene is not conserved: leave it out.")
    plain = Closing.from_arcs(arcs, energy)
    if image is None:
        return plain
    layout, states = arcs.layout, 2 * arcs.size

    def flat(y):
        moved = image(*map(layout.restore, halves(y)))
        return np.concatenate([np.asarray(layout.flatten(part), float) for part in moved])

    shift = flat(np.zeros(states))
    matrix = np.stack([flat(row) - shift for row in np.eye(states)], axis=1)
    somewhere = np.cos(np.arange(1.0, states + 1.0)) * (np.abs(shift) + 1.0)
    terms = np.abs(matrix) @ np.abs(somewhere) + np.abs(shift)
    if not (np.abs(flat(somewhere) - matrix @ somewhere - shift) <= 1e-12 * terms).all():
        raise ValueError("image must be affine in (q, qdot): a linear map and a shift. Use coordinates in which it is.")
    if truncated_svd(matrix, singular_threshold(states, float)).rank < states:
        raise ValueError("image must be invertible: it sends different states to the same one.")
    return plain._replace(matrix=matrix, shift=shift)


class FlatOrbits(NamedTuple):
    """The fields of B `Orbit`s with flat states: `y` (B, 2n), and the others with the members as first axis."""

    y: np.ndarray
    period: np.ndarray
    multipliers: np.ndarray
    closure: np.ndarray
    stable: np.ndarray
    ok: np.ndarray
    message: np.ndarray  # of text


def find_orbits(closing: Closing, y0: np.ndarray, period: np.ndarray) -> FlatOrbits:
    """Return the orbits near these guesses; one that does not close well is tried with more arcs while that helps."""
    arcs = closing.arcs
    counts = arc_counts(arcs, y0, period)
    most = counts if arcs.jumping else np.minimum(MOST_ARCS, _MORE * counts)
    nothing, never, texts = np.full(y0.shape, np.nan), np.zeros(len(y0), bool), np.full(len(y0), "", object)
    found = FlatOrbits(nothing, nothing[:, 0], nothing.astype(complex), nothing[:, 0], never, never, texts)
    waiting, gained = np.arange(len(y0)), np.ones(len(y0), bool)
    while len(waiting):
        for count in np.unique(counts[waiting]).tolist():
            members = waiting[counts[waiting] == count]
            for some in np.array_split(members, -(-len(members) * count // _PORTION)):
                parts, y = _shooting.guess_states(closing, y0[some], period[some], count)
                units = arcs.units(y0[some], period[some])
                trial = assess_orbits(closing, _shooting.close_chains(closing, y, period[some], parts, units))
                better = ~(found.closure[some] <= trial.closure)
                gained[some] = better | ~found.ok[some]
                found = _shooting.replace_members(found, some[better], FlatOrbits(*(x[better] for x in trial)))
        worse = ~(found.closure[waiting] <= WELL_CLOSED) & gained[waiting]
        waiting = waiting[worse & (counts[waiting] < most[waiting])]
        counts[waiting] = np.minimum(MOST_ARCS, 2 * counts[waiting])
    return found


def arc_counts(arcs: Arcs, y0, period) -> np.ndarray:
    """Return the number of arcs into which each orbit is divided, a power of two, from the steps of its guess."""
    if arcs.jumping:  # a state between does not tell the mode
        return np.ones(len(period), int)
    run = arcs.integrate(np.stack([np.zeros(len(period)), period], axis=1), y0)
    share = np.where(run.result == SUCCESSFUL, 1.0, np.clip(run.t_end / period, 1e-3, 1.0))
    count = np.maximum(1.0, run.accepted / share / _STEPS_OF_ARC)
    return np.minimum(MOST_ARCS, 2 ** np.ceil(np.log2(count))).astype(int)


def assess_orbits(closing: Closing, chain: Chain, most: int | None = None) -> FlatOrbits:
    """Return the orbits of the chains, with multipliers, and a message for each chain that is no orbit.

    At most `most` directions count as symmetries, None: the whole null space of monodromy − 1.
    """
    message = np.array([_explain_no_orbit(chain, k) for k in range(len(chain.period))], object)
    ok = np.array([not text for text in message])
    multipliers = np.full((len(ok), chain.y.shape[2]), np.nan, complex)
    if ok.any():
        closed = chain.select(ok)
        known = _shooting.find_null_spaces(closed, most)
        for k, place in enumerate(np.flatnonzero(ok).tolist()):
            multipliers[place] = multipliers_of(reduce_arcs(closed.growth[k], *known[k]), closing.arcs.conserves)
    stable = np.abs(np.where(np.isnan(multipliers), np.inf, multipliers)).max(axis=1) < 1 + UNSTABLE
    off = np.array([pairing_error(row) if closing.arcs.conserves else 0.0 for row in multipliers])
    for place in np.flatnonzero(ok & (off > UNCERTAIN)).tolist():
        stable[place] = False
        message[place] = (
            f"The orbit closes, but its multipliers are uncertain: pairs that should multiply to 1 miss it by "
            f"{off[place]:.2g}, so that nothing is known of its stability."
        )
    return FlatOrbits(chain.states(), chain.periods(), multipliers, chain.closure(), stable & ok, ok, message)


def _explain_no_orbit(chain: Chain, k: int) -> str:
    if not chain.ok[k]:
        return f"The motion from the guess cannot be followed for a period of {chain.periods()[k]:.6g}. {chain.why[k]}"
    if _shooting.is_equilibrium(chain.select(np.array([k])))[0]:
        return (
            "The search ended at an equilibrium, which closes after any time: begin at a larger amplitude, or with a "
            "period nearer to that of the orbit."
        )
    share = chain.merit()[k] / max(chain.size()[k], 1e-300)
    if not share <= CLOSED:
        return (
            f"No periodic orbit was found near the guess: after {chain.y.shape[1]} arcs per period and a period of "
            f"{chain.periods()[k]:.6g} the largest defect is {share:.2g} of the size of the state. Begin nearer: "
            "another state or period. A coordinate that grows from period to period, as the x of a walker, never "
            "closes: give image=lambda q, qdot: (q + step, qdot), or leave it out of L."
        )
    return ""
