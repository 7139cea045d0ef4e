"""Checks that the forces of a scene are smooth at a state, which every linearisation requires.

At a jump of the force (dry friction at rest) or a kink (a spring that only pushes, where it begins) the two sides of a
state have different derivatives, or none. Such places are borders of piecewise functions (`_blame.borders`); the force
may still be smooth there, as max(q, 0)**2 is: its values on both sides decide that.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from lagjax._analysis._scene_state import SceneState
from lagjax._equations import Derivation, find_sides, list_decisions

# Where forces are compared, in sizes of a coordinate. A border within the first distance is at the state: equilibria
# are known to the square root of rounding at worst, to 1e-12 as a rule. Friction that is rounded off over ten times as
# much is smooth, and what has another slope within a tenth of the last distance counts as a kink.
_AT, _BESIDE = 1e-9, 1e-4
# From one distance to another, ten or sixteen times as large, what is smooth grows as much and a jump stays: half lies
# far from either.
_STAYS = 0.5
_SLIGHT = 1e-6  # a change of the slope, in units of it, that is a kink and not the rounding of forces, which is 1e-11
_ROUNDING = 1e4  # units of rounding of the force one size away; below it a jump is rounding of terms that cancel


class _Roughness(NamedTuple):
    """Flags of jumps and kinks of the force along each coordinate and velocity, and the borders that change side."""

    jumps: Bool[Array, " 2n"]
    kinks: Bool[Array, " 2n"]
    changed: Bool[Array, "2n sides"]


def is_smooth(scene: SceneState, outputs: Callable | None = None) -> Bool[Array, ""]:
    """True if the force is smooth at the state, or the function `outputs` (q, q̇, t, ()), (p,), instead of it."""
    if not _find_pieces(scene, outputs):
        return jnp.asarray(True)
    rough = _measure_roughness(scene, outputs)
    return ~jnp.any(rough.jumps | rough.kinks)


def require_smooth(scene: SceneState, what: str, outputs: Callable | None = None) -> None:
    """Raise `ValueError` if the force jumps or has a kink at the state, naming the coordinate and the line.

    So it is with `outputs` instead of the force.
    """
    if not scene.concrete or not (pieces := _find_pieces(scene, outputs)):
        return
    rough = jax.tree.map(np.asarray, _measure_roughness(scene, outputs))
    names = (*scene.layout.names, *(f"d{name}" for name in scene.layout.names))
    jump, kink, rest = "the force jumps there", "the force has another slope on either side", ""
    if outputs is not None:
        jump, kink = "outputs jump there", "outputs have another slope on either side"
    for k in np.flatnonzero(rough.jumps | rough.kinks).tolist():
        if outputs is None:
            written = scene.system._motion(scene.layout, scene.params)  # whose lines are to be named
            pieces = list_decisions(written.functions, *scene.derivation.state_shapes)
            if k >= len(names) // 2:
                rest = " Dry friction holds a scene at rest: nothing small oscillates."
        operation = [f"{name}{place}" for name, place, size in pieces for _ in range(size)][rough.changed[k].argmax()]
        raise ValueError(
            f"{what} does not exist at this state, which is on a border along {names[k]}: "
            f"{jump if rough.jumps[k] else kink}, at {operation}.{rest} "
            "Ask for it beside the border, leave the piecewise term out, or round it off (tanh(v / w) for sign(v)). "
            "Motions across the border are right: simulate follows them."
        )


def _find_pieces(scene: SceneState, outputs: Callable | None) -> list:
    return _pieces_of_force(scene.derivation) if outputs is None else list_decisions([outputs], *_state_of(scene), ())


@functools.lru_cache(maxsize=64)
def _pieces_of_force(derivation: Derivation) -> list:
    return list_decisions(derivation.motion.functions, *derivation.state_shapes)


def _state_of(scene: SceneState) -> tuple:
    return jax.lax.stop_gradient((scene.q, scene.qdot, jnp.zeros((), scene.q.dtype)))


def _measure_roughness(scene: SceneState, outputs: Callable | None) -> _Roughness:
    (q, v, t), numbers = _state_of(scene), jax.lax.stop_gradient(scene.numbers)
    n, eps = len(q), jnp.finfo(q.dtype).eps

    def sides(y):
        functions, params = (scene.motion.functions, numbers) if outputs is None else ([outputs], ())
        return jnp.concatenate([jnp.ravel(x) for *_, x in find_sides(functions, y[:n], y[n:], t, params)])

    def force(y):
        return scene.force(y[:n], y[n:]) if outputs is None else outputs(y[:n], y[n:], t, ())

    def sizes(x):
        largest = jnp.max(jnp.abs(x))
        return jnp.maximum(jnp.abs(x), jnp.where(largest > 0, 1e-3 * largest, 1.0))

    y, units = jnp.concatenate([q, v]), jnp.diag(jnp.concatenate([sizes(q), sizes(v)]))

    def evaluate_displaced(function, distance):
        return [jax.vmap(lambda unit, s=s: function(y + s * distance * unit))(units) for s in (1, -1)]

    at = max(_AT, 16 * float(eps))
    ahead, behind = evaluate_displaced(sides, at)
    changed, here = ahead != behind, force(y)

    def steps(distance):
        ahead, behind = (moved - here for moved in evaluate_displaced(force, distance))
        return ahead, behind, jnp.maximum(jnp.abs(ahead), jnp.abs(behind)).max(axis=1)

    def bends(distance):
        ahead, behind, step = steps(distance)
        return jnp.abs(ahead + behind).max(axis=1) / jnp.where(step > 0, step, 1.0), step / distance

    is_border, nearest, near = changed.any(axis=1), steps(at)[2], steps(10 * at)[2]
    jump = is_border & (nearest > _STAYS * near) & (nearest > _ROUNDING * eps * steps(1.0)[2].max())
    (bend, slope), (nearer, slope_nearer) = bends(_BESIDE), bends(_BESIDE / 16)
    stays = (nearer > _STAYS * bend) & (slope_nearer > _STAYS * slope)  # of max(q, 0)² both sides have slope zero
    kink = is_border & ~jump & stays & (nearer > jnp.maximum(_SLIGHT, jnp.sqrt(eps)))
    return _Roughness(jump, kink, changed)
