"""Borders nearby: where a piecewise function changes its piece, and something jumps there.

Only a scene with comparisons in it (|x|, max, where, sign, floor, ...) is looked at. From the state one goes along
every coordinate and velocity, along the time, and along the motion, until a comparison changes its result; the border
is found by bisection, and L, p, M and the forces are compared on both sides of it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._check._findings import Finding
from lagjax._check._measure import Scene
from lagjax._check._operations import borders

_REACH = 10  # looked at are 2⁻⁹ … 1 sizes of a coordinate


class Jump(NamedTuple):
    """How far along which direction, in sizes of it and in its units, at which operation, and what jumps there."""

    sizes: float
    direction: str
    distance: float
    operation: str
    what: str


def findings(scene: Scene) -> list[Finding]:
    """The nearest jump, if there is one."""
    motion, state = scene.motion, scene.state
    functions = [f for f in (motion.lagrangian, motion.forces, motion.dissipation) if f is not None]
    *y, params = state
    pieces = [piece for function in functions for piece in borders(function, *state)]
    if not pieces:
        return []
    n, start = len(y[0]), jnp.concatenate([y[0], y[1], jnp.reshape(y[2], 1)])

    def at(point):
        return point[:n], point[n:-1], point[-1], params

    @jax.jit
    def sides(point):
        found = [piece for function in functions for piece in borders(function, *at(point))]
        return jnp.concatenate([jnp.ravel(side) for _, _, side in found])

    @jax.jit
    def look(point):
        mass, force = motion.mass_matrix_and_force(*at(point))
        return motion.lagrangian(*at(point)), motion.momentum(*at(point)), mass, force

    labels = [f"{name}{place}" for name, place, side in pieces for _ in range(np.size(side))]
    jumps = [jump for name, size, vector in _directions(scene) for sign in (1, -1)
             if (jump := _first_jump(sides, look, start, sign * vector, (name, size), labels)) is not None]  # fmt: skip
    return [_finding(min(jumps))] if jumps else []


def _directions(scene: Scene) -> list[tuple[str, float, np.ndarray]]:
    """Every coordinate and velocity by its size, and the motion by the time in which it moves by that."""
    m, n = scene.measured, scene.layout.size
    axes = np.diag(scene.sizes)
    axes[-1, :n], axes[-1, n:-1] = scene.sizes[-1] * m.velocity[0], scene.sizes[-1] * scene.solved()[0]
    return list(zip(scene.names, scene.sizes, axes, strict=True))


def _first_jump(sides: Callable, look: Callable, start, vector, axis, labels: list[str]) -> Jump | None:
    """The nearest border along `vector`, if something jumps there."""
    here, eps = np.asarray(sides(start)), float(jnp.finfo(start.dtype).eps)
    vector = jnp.asarray(vector, start.dtype)
    # One step so small that only a border at the state itself lies within it, then longer and longer ones.
    reach = [4 * eps * (1 + float(jnp.max(jnp.abs(start)))), *2.0 ** np.arange(1 - _REACH, 1)]
    past = next((k for k, s in enumerate(reach) if not np.array_equal(sides(start + s * vector), here, True)), None)
    if past is None:
        return None
    inside, beyond = (reach[past - 1] if past else 0.0), reach[past]
    for _ in range(60 if past else 0):
        middle = 0.5 * (inside + beyond)
        same = np.array_equal(sides(start + middle * vector), here, True)
        inside, beyond = (middle, beyond) if same else (inside, middle)
    there = np.asarray(sides(start + beyond * vector))
    place = int(np.argmax(there != here))
    # What changes, against its size here, there, and on a little: a force that sets in at zero does not jump.
    seen = [look(start + s * vector) for s in (inside if past else -beyond, beyond, 0.0, beyond + 0.1)]
    for what, *values in zip(("L", "the momentum", "the mass matrix", "the force"), *seen, strict=True):
        one, other, *_ = values = [np.asarray(value) for value in values]
        if np.isfinite(one).all() and np.isfinite(other).all():
            if np.abs(one - other).max() > np.sqrt(eps) * np.nanmax([np.abs(value).max() for value in values]):
                sizes = beyond if past else 0.0
                return Jump(sizes, axis[0], sizes * axis[1], labels[place], what)
    return None


def _finding(jump: Jump) -> Finding:
    here = jump.sizes == 0
    where = "at this state" if here else f"{jump.distance:.3g} away along {jump.direction}"
    serious = here or jump.what in ("L", "the momentum")
    seen = {
        "L": "No force shows a jump of L itself: the motion goes through it as if it were not there.",
        "the momentum": "The kick that a jump of the momentum gives to the velocity is not seen.",
    }.get(jump.what, "Steps shrink there; a motion that comes to rest on it (dry friction) does not get on.")
    return Finding(
        "discontinuity", "warning" if serious else "advice", (jump.direction,),
        f"{jump.what[0].upper()}{jump.what[1:]} jumps {where}, at {jump.operation}. {seen} Smooth it (tanh(v/w) for "
        "sign(v)), or make two modes of it with a Transition for lagjax.simulate_hybrid.",
    )  # fmt: skip
