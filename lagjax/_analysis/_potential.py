"""Move forces that have a potential into L: conserved quantities must not depend on where the author wrote them.

Forces Q(q, t) are ∂W/∂q of their work W = ∫ Q·dq where ∂Qᵢ/∂qⱼ = ∂Qⱼ/∂qᵢ and nothing depends on q̇. The integral is
taken from a reference state along a straight line and along curves beside it, as the line may pass through a centre of
force; the most accurate one is used.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lagjax._analysis._noether import FlatState
from lagjax._analysis._scene_state import SceneState
from lagjax._equations import Scales
from lagjax._interface import compile_for_one_call
from lagjax._scene import System

_NODES = 32  # of Gauss's rule: exact for polynomials of degree 63

# How far off the straight line curves lead, as a fraction of its length; into how many parts they are divided; what
# rules over parts of two lengths may differ by.
_BESIDE, _PARTS, _RESOLVED = (0.0, 0.5, -0.5), 4, 1e-10
_CURL = 1e-12  # of forces, by which they may fail to have a potential: some tens of roundings of sums


def line_integral(slope: Callable, start: Array, end: Array) -> Array:
    """Return ∫ slope(q)·dq from `start` to `end`, (n,) or (), along a straight line."""
    way = end - start
    return _integral(lambda s: jnp.vdot(slope(start + s * way), way), 1, end.dtype)


def _integral(rate: Callable, parts: int, dtype) -> Array:
    """Return ∫ rate(s) ds from 0 to 1 by Gauss's rule on this many parts."""
    nodes, shares = np.polynomial.legendre.leggauss(_NODES)
    places = (np.arange(parts)[:, None] + 0.5 * (nodes + 1)).ravel() / parts
    values = jax.vmap(rate)(jnp.asarray(places, dtype))
    return jnp.asarray(np.tile(0.5 * shares / parts, parts), dtype) @ values


def _work(force: Callable, start: Array, end: Array, scale: np.ndarray) -> Array:
    """Return ∫ force(q)·dq from `start` to `end` (n,) by the best of some curves; NaN if inaccurate or they differ."""
    way, size = end - start, jnp.asarray(scale, end.dtype)
    across = jnp.cos(jnp.arange(1.0, len(scale) + 1)).astype(end.dtype)
    length = jnp.sqrt(jnp.sum((way / size) ** 2))
    along = (way / size) / jnp.where(length > 0, length, 1)
    across = across - (across @ along) * along
    across = size * length * across / jnp.maximum(jnp.sqrt(jnp.sum(across**2)), 1e-3)

    def curve_work(beside, parts):
        def rate(s):
            place = start + s * way + beside * jnp.sin(jnp.pi * s) * across
            return force(place) @ (way + beside * jnp.pi * jnp.cos(jnp.pi * s) * across)

        return jnp.stack([_integral(rate, parts, end.dtype), _integral(lambda s: jnp.abs(rate(s)), parts, end.dtype)])

    curves = jnp.asarray(_BESIDE, end.dtype)
    coarse, fine = (jax.vmap(lambda x, parts=parts: curve_work(x, parts))(curves) for parts in (_PARTS, 2 * _PARTS))
    error = jnp.abs(fine[:, 0] - coarse[:, 0]) / jnp.where(fine[:, 1] > 0, fine[:, 1], 1)
    error = jnp.where(jnp.isfinite(error), error, jnp.inf)
    best = jnp.argmin(error)
    others = jnp.abs(fine[:, 0] - fine[best, 0]) <= 1e3 * _RESOLVED * fine[:, 1]
    sure = (error[best] <= _RESOLVED) & jnp.all(others | (error > _RESOLVED))
    return jnp.where(sure, fine[best, 0], jnp.nan)


def absorb_potential_forces(scene: SceneState, scales: Scales, states: FlatState) -> SceneState:
    """Return the scene with its forces in L if they have a potential at all of `states`; else the scene."""
    if scene.motion.forces is None or not _have_potential(scene, scales, states):
        return scene
    system, layout, reference = scene.system, scene.layout, np.asarray(scene.q)

    def lagrangian(q, qdot, t, params):
        motion, numbers = system._motion(layout, params), eqx.filter(params, eqx.is_array_like)
        place = layout.flatten(q), layout.flatten(qdot), t, numbers

        def force(q):
            return motion.forces(q, jnp.zeros_like(q), t, numbers)  # pyright: ignore[reportOptionalCall]

        # The value is that of a long way; by q it changes as along the last, vanishing part of it, to every order.
        here = jax.lax.stop_gradient(place[0])
        start = jnp.asarray(reference, layout.dtype)
        return motion.lagrangian(*place) + _work(force, start, here, scales.q) + line_integral(force, here, place[0])

    kept = {role: getattr(system, role) for role in ("dissipation", "constraints", "velocity_constraints")}
    whole = System(lagrangian, **kept)
    return SceneState.from_state(whole, layout.restore(scene.q), layout.restore(scene.qdot), scene.params)


def _have_potential(scene: SceneState, scales: Scales, states: FlatState) -> bool:
    terms = [np.asarray(x) for x in _force_and_slopes(states, *scene.arguments)]
    well = np.logical_and.reduce([np.isfinite(x).all(axis=tuple(range(1, x.ndim))) for x in terms])
    if not well.any():
        return False
    force, by_q, by_qdot = (x[well] for x in terms)
    work = np.abs(force) @ scales.q
    by_q, by_qdot = by_q * scales.q[:, None] * scales.q, by_qdot * scales.q[:, None] * scales.qdot
    off = max(np.abs(by_q - np.swapaxes(by_q, 1, 2)).max(), np.abs(by_qdot).max())
    return bool(off <= _CURL * max(work.max(), np.abs(by_q).max()))


@compile_for_one_call
def _force_and_slopes(states: FlatState, *arguments) -> tuple[Array, Array, Array]:
    """Return Q (S, n), ∂Q/∂q and ∂Q/∂q̇ (S, n, n)."""
    scene = SceneState.from_arguments(*arguments)

    def force_and_derivatives(state):
        def force(q, qdot):
            return scene.motion.forces(q, qdot, state.t, scene.numbers)  # pyright: ignore[reportOptionalCall]

        return force(state.q, state.qdot), *jax.jacfwd(force, argnums=(0, 1))(state.q, state.qdot)

    return jax.lax.map(force_and_derivatives, states)
