"""Search for borders nearby, where a piecewise function changes its piece and something is discontinuous.

Only scenes with comparisons (|x|, max, where, sign, floor, ...) have borders. From the state the search goes along
every coordinate and velocity, and along the motion, until a comparison changes its result; the border is located by
bisection, and L, p, M and the forces are compared on both sides of it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import border_places, borders, numbers_of
from lagjax._program import Unlowerable
from lagjax._tracing import lower
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._scene_at_start import CheckedScene

# What a jump of the acceleration means for a motion.
OF_FORCE = (
    "A motion across it is right: machine code ends a step there, and what is pushed onto it from both sides rests on "
    "it; steps of diffrax shrink, and a motion of diffrax that crosses it has no derivatives."
)
# What a jump of L, or of its momentum, means.
OF_L = (
    "The velocities jump there in machine code, so that the momentum along the border and the energy are the same on "
    "both sides, at an instant the whole momentum; where the energy does not suffice, the motion is reflected. Solvers "
    "of diffrax refuse it."
)
_COMPARED = {
    "lagrangian": "L", "momentum": "the momentum", "mass_matrix": "the mass matrix", "force": "the force",
}  # fmt: skip
_REACH = 10  # the steps of the search: 2⁻⁹, 2⁻⁸ … 1 sizes of a coordinate, and a little more
_BEYOND = 1.01  # so much more, for a border at zero that is a side by itself, as that of q > 0 is seen from below


class Discontinuity(NamedTuple):
    """A jump: distance in sizes of the direction, the direction, distance in its units, operation, what jumps."""

    sizes: float
    direction: str
    distance: float
    operation: str
    what: str


def findings(scene: CheckedScene) -> list[Finding]:
    if not border_places(scene.motion.functions, *scene.state):
        return []
    pieces, sides = border_places(scene.written_motion.functions, *scene.state), _sides_of_states(scene)
    labels = [f"{name}{place}" for name, place, size in pieces for _ in range(size)]
    jumps = [
        _first_jump(scene, sides, scene.point, sign * vector, (name, size), labels)
        for name, size, vector in _search_directions(scene)
        for sign in (1, -1)
    ]
    nearest = min((jump for jump in jumps if jump is not None), default=None)
    return [] if nearest is None else [_jump_finding(nearest, scene)]


def _sides_of_states(scene: CheckedScene) -> Callable:
    """Return a function of states (S, 2n + 1): on which side of each border they are. By a program, else compiled."""
    n, params = scene.layout.size, scene.state[3]

    def sides_at(q, v, t, params):
        of_motion = borders(scene.motion.functions, q, v, t, params)
        return jnp.concatenate([jnp.ravel(side) for _, _, side in of_motion])

    if scene.derivation.is_lowered:
        try:
            program, numbers = lower(sides_at, *scene.state), numbers_of(params)
            return lambda points: program.evaluate_many([*points.T, *numbers]).T
        except Unlowerable:
            pass
    return jax.jit(jax.vmap(lambda point: sides_at(point[:n], point[n:-1], point[-1], params)))


def _search_directions(scene: CheckedScene) -> list[tuple[str, float, np.ndarray]]:
    """Return (name, size, vector (2n + 1,)) of each direction: coordinates, velocities, and the motion itself."""
    m, n = scene.measured, scene.layout.size
    axes = np.diag(scene.sizes)
    axes[-1, :n], axes[-1, n:-1] = scene.sizes[-1] * m.velocity[0], scene.sizes[-1] * scene.solve_saddle()[0]
    return list(zip(scene.names, scene.sizes, axes, strict=True))


def _first_jump(scene: CheckedScene, sides: Callable, start, vector, axis, labels: list[str]) -> Discontinuity | None:
    """Return the nearest border along `vector` if a function is discontinuous there, else None."""
    eps, vector = float(np.finfo(start.dtype).eps), np.asarray(vector, start.dtype)

    def displaced_states(steps):
        return start + np.asarray(steps, start.dtype)[:, None] * vector

    # One step so small that only a border at the state itself lies within it, then longer and longer ones.
    moving = vector != 0
    least = 4 * eps * float(np.max(np.abs(start[moving] / vector[moving]), initial=1.0))
    reach = [min(least, 2.0**-_REACH), *_BEYOND * 2.0 ** np.arange(1 - _REACH, 1)]
    here, *ahead = np.asarray(sides(displaced_states([0.0, *reach])))
    past = next((k for k, side in enumerate(ahead) if not np.array_equal(side, here, True)), None)
    if past is None:
        return None
    inside, beyond = (reach[past - 1] if past else 0.0), reach[past]
    for _ in range(12 if past else 0):  # five halvings at once
        between = np.linspace(inside, beyond, 33)[1:]
        changed = [not np.array_equal(side, here, True) for side in np.asarray(sides(displaced_states(between)))]
        first = changed.index(True) if True in changed else len(between) - 1
        inside, beyond = (between[first - 1] if first else inside), between[first]
    there = np.asarray(sides(displaced_states([beyond])))[0]
    place = int(np.argmax(there != here))
    # The change is compared with the size at the state, at the border and a little beyond: a force that sets in at zero
    # does not jump.
    both_sides = displaced_states([inside if past else -beyond, beyond, 0.0, beyond + 0.1])
    values_of = scene.sample_at(both_sides).quantities(*_COMPARED)
    for name, what in _COMPARED.items():
        one, other, *_ = values = values_of[name]
        if np.isfinite(one).all() and np.isfinite(other).all():
            if np.abs(one - other).max() > np.sqrt(eps) * np.nanmax(np.abs(values)):
                sizes = beyond if past else 0.0
                return Discontinuity(sizes, axis[0], sizes * axis[1], labels[place], what)
    return None


def _jump_finding(jump: Discontinuity, scene: CheckedScene) -> Finding:
    here, derivation = jump.sizes == 0, scene.derivation
    where = "at this state" if here else f"{jump.distance:.3g} away along {jump.direction}"
    of_l, refusal = jump.what in ("L", "the momentum"), derivation.kick_refusal
    serious, consequence = of_l and (refusal is not None or not derivation.kicks), OF_FORCE
    if serious and refusal is not None:
        consequence = f"{refusal[0].upper()}{refusal[1:]}."
    elif serious:
        consequence = (
            "No force shows it, and diffrax goes through it: smooth it, 0.5 * (1 + jnp.tanh(x / w)) for x > 0, or make "
            "two modes of it with a Transition for a lagjax.Hybrid."
        )
    elif of_l:
        consequence = OF_L
    elif here:
        consequence = "At this very state `acceleration` is that of one side or between them. " + consequence
    message = f"{jump.what[0].upper()}{jump.what[1:]} jumps {where}, at {jump.operation}. {consequence}"
    return Finding("discontinuity", "warning" if serious else "advice", (jump.direction,), message)
