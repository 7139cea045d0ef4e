"""The gauge G(q, t) of a symmetry: the function whose time derivative is the change Λ of L.

Λ = ∂G/∂q·q̇ + ∂G/∂t is affine in q̇, so that ∂G/∂q = ∂Λ/∂q̇ and ∂G/∂t = Λ(q, 0, t). G is their integral along the
straight line from a reference state, where it is zero; if ∂G/∂q is constant, G = ∂G/∂q·q. `verify_gauge` verifies the
numerical integral.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lagjax._analysis._noether import FlatState, charge_at, variation
from lagjax._analysis._potential import line_integral
from lagjax._analysis._scene_state import SceneState
from lagjax._analysis._transformations import Fields
from lagjax._interface import compile_for_one_call
from lagjax._primitives import accepts_singles

# Parts of the terms of Λ that count as zero, and what the gradient of G may be off.
_ZERO, _RIGHT = 1e-10, 1e-9


class Changes(NamedTuple):
    """Changes of L by D transformations at S states: Λ (S, D), ∂Λ/∂q̇ (S, D, n), Λ at rest, the size of its terms.

    ∂Λ/∂q̇ is by velocities in units of their sizes, so that it compares with Λ. `gradients` (S, D, 2n) are those of the
    charges p·ξ − h τ − G by q and q̇.
    """

    values: np.ndarray
    slopes: np.ndarray
    at_rest: np.ndarray
    sizes: np.ndarray
    gradients: np.ndarray


def changes_of(scene: SceneState, fields: Fields, weights: np.ndarray, states: FlatState) -> tuple[Changes, FlatState]:
    """Return the changes of L by transformations with weights (D, K), and the states at which they are finite."""
    parts = [np.asarray(x) for x in _changes_at_states(jnp.asarray(weights), fields, states, *scene.arguments)]
    well = np.logical_and.reduce([np.isfinite(x).all(axis=tuple(range(1, x.ndim))) for x in parts])
    if not well.any():
        raise ValueError(
            "The Lagrangian is finite at no state about (q, qdot), although derivatives are: give a state in "
            "the middle of where motions take place."
        )
    return Changes(*(x[well] for x in parts)), FlatState(*(x[well] for x in states))


def gauge_of(scene: SceneState, fields: Fields, weights: np.ndarray, k: int, changes: Changes) -> Callable | None:
    """Return G(q, t=0.0, params=None) of symmetry k with these weights (K,); None if L does not change."""
    values, slopes, at_rest, sizes = (x[:, k] for x in changes[:4])
    size = sizes.max()
    if np.abs(values).max() <= _ZERO * size:
        return None
    spread = np.ptp(slopes, axis=0).max() <= _ZERO * (np.abs(slopes).max() + size)
    return _gauge_function(scene, fields, weights, bool(spread and np.abs(at_rest).max() <= _ZERO * size))


def verify_gauge(
    gauge: Callable, scene: SceneState, fields: Fields, k: int, changes: Changes, states: FlatState
) -> bool:
    """True if ∂G/∂q and ∂G/∂t are those of transformation k at some states: each piece of L may have its own G."""
    restore, speeds = scene.layout.restore, fields.scale / fields.time

    @jax.jit
    def gradient(q, t):
        return jax.vmap(jax.grad(lambda q, t: gauge(restore(q), t, scene.params), argnums=(0, 1)))(q, t)

    some = slice(0, 16)
    by_q, by_t = map(np.asarray, gradient(states.q[some], states.t[some]))
    by_q = by_q * speeds
    allowed, pairs = _ZERO * changes.sizes[:, k].max(), ((by_q, changes.slopes), (by_t, changes.at_rest))
    return all(np.abs(x - of[some, k]).max() <= _RIGHT * np.abs(of[:, k]).max() + allowed for x, of in pairs)


def _gauge_function(scene: SceneState, fields: Fields, weights: np.ndarray, constant: bool) -> Callable:
    layout, system, reference = scene.layout, scene.system, np.asarray(scene.q)

    @accepts_singles(("q",), ("t", "params"))
    def gauge(q, t=0.0, params=None):
        q, rest = layout.flatten(q), jnp.zeros(layout.size, layout.dtype)
        there = SceneState.from_arguments(system, layout, q, rest, params)
        transform = fields.combine(jnp.asarray(weights, layout.dtype), params)
        start, t = jnp.asarray(reference, layout.dtype), jnp.asarray(t, layout.dtype)

        def change(q, qdot, t):
            return variation(there, transform, q, qdot, t)

        def slope(q, t):
            return jax.grad(change, argnums=1)(q, rest, t)

        if constant:
            return slope(start, jnp.zeros_like(t)) @ q
        in_time = line_integral(lambda t: change(start, rest, t), jnp.zeros_like(t), t)
        return line_integral(lambda q: slope(q, t), start, q) + in_time

    return gauge


@compile_for_one_call
def _changes_at_states(weights: Array, fields: Fields, states: FlatState, *arguments) -> tuple:
    scene = SceneState.from_arguments(*arguments)

    def changes_at(state):
        return jax.lax.map(lambda w: _change_at_state(scene, fields, fields.combine(w, scene.params), state), weights)

    return jax.lax.map(changes_at, states)


def _change_at_state(scene: SceneState, fields: Fields, transform: Callable, state: FlatState) -> tuple:
    """Return the fields of `Changes` of one transformation at one state."""
    q, qdot, t = state.q, state.qdot, state.t

    def change(qdot):
        return variation(scene, transform, q, qdot, t)

    def charge(q, qdot):
        return charge_at(scene.motion, transform, q, qdot, t, scene.numbers)

    place = q, qdot, t, scene.numbers
    (moved, of_time), slope = transform(q, t), jax.grad(change)(jnp.zeros_like(qdot))
    by_q, by_qdot = jax.grad(charge, argnums=(0, 1))(q, qdot)
    # Terms of Λ, and what they would be where it has none: translations of a cyclic coordinate.
    size = jnp.abs(scene.motion.generalized_force(*place)) @ jnp.abs(moved)
    size = size + jnp.abs(scene.motion.momentum(*place)) @ jnp.abs(moved) / fields.time
    size = size + jnp.abs(of_time * scene.motion.lagrangian(*place)) / fields.time
    speeds, gradient = fields.scale / fields.time, jnp.concatenate([by_q - slope, by_qdot])
    return change(qdot), slope * speeds, change(jnp.zeros_like(qdot)), size, gradient
