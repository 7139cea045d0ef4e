"""Weak form of Lagrange's equations, for states that were read off the data.

With a bump φ that vanishes at both ends of a window, integration by parts takes the time derivative off the momentum:

    ∫ (φ̇ p + φ F) dt = 0,      p = ∂L/∂q̇,   F = ∂L/∂q + Q

which asks for q and q̇ of the data and for no second derivative of them. It is linear where the parameters are, and has
one minimum where long motions have many. It is not scaled like the noise, and biased by that of q̇: a start, from which
the search then continues. Each coordinate is divided by the size of its own ∫ φ̇ p, or else all masses would shrink to
nothing together.
Source: Messenger & Bortz, *Weak SINDy*, J. Comput. Phys. 443 (2021) 110525; Bortz, Messenger & Dukic, Bull. Math.
Biol. 85 (2023) 110, for parameters.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from lagjax._equations import has_constraints
from lagjax._fit.model._inputs import Driven, constant_tables, input_functions
from lagjax._fit.model._residuals import SystemResiduals
from lagjax._fit.search._reader import Reader, choose_places
from lagjax._interface import halves
from lagjax._run.hybrid import Hybrid
from lagjax._scene import System

_SAMPLES = 2000  # of all records, at most
_FEWEST_IN_WINDOW = 9  # samples in a window
_POWER = 4  # of the bump (1 − s²)ᵖ, whose first derivatives vanish at its ends
_TRIALS = 100
_WIDE = 3.0  # time scales in half a window: a bump sees what turns over within it


def fit_weak_form(
    systems: Sequence[tuple[SystemResiduals, Sequence[Reader | None], float]], u: np.ndarray
) -> np.ndarray | None:
    """The u (F,) that balances the weak forms of systems best, in a search from `u`; None where nothing is to balance.

    Each system comes with readers of its records and the motion's time scale. One with constraints, or where nothing
    moves, says nothing, and so does hybrid motion, whose velocities jump.
    """
    telling = [
        one
        for one in systems
        if not (isinstance(one[0].scene, Hybrid) or has_constraints(one[0].scene)) and np.isfinite(one[2])
    ]
    if not telling:
        return None
    each, dtype = [weak_form_residuals(*one) for one in telling], telling[0][0].layout.dtype

    def residuals(u):
        return jnp.concatenate([one(u) for one in each])

    value, slope = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
    if jax.eval_shape(residuals, u.astype(dtype)).size < 2 * len(u):
        return None  # a network would follow the noise of so few windows
    to_host: Any = lambda f: lambda u: np.asarray(f(u.astype(dtype)), float)  # noqa: E731
    if not (np.isfinite(to_host(value)(u)).all() and np.isfinite(to_host(slope)(u)).all()):
        return None
    try:
        done = least_squares(to_host(value), u, to_host(slope), x_scale="jac", max_nfev=_TRIALS)
    except (ValueError, np.linalg.LinAlgError):  # a trial that is not finite
        return None
    return done.x if np.isfinite(done.x).all() else None


def weak_form_residuals(system: SystemResiduals, readers: Sequence[Reader | None], scale: float):
    """∫ (φ̇ p + φ F) dt of all windows and coordinates, over the size of ∫ φ̇ p: a function of u (F,) for JAX."""
    layout, parameters, form, scene = system.layout, system.parameters, system.signals.form, system.scene
    assert isinstance(scene, System)
    form = form if form is not None and input_functions(scene) else None
    scene = scene if form is None else form.drive_scene(scene)
    pieces, reading = [], [reader for reader in readers if reader is not None]
    for reader in reading:
        record = reader.record
        places = choose_places(record, min(max(_FEWEST_IN_WINDOW + 1, _SAMPLES // len(reading)), len(record)))
        ts = record.ts[places]
        if len(ts) > 2:
            pieces.append((reader.states(places), ts, record.input_matrix[places], *_bumps(ts, _WIDE * scale)))
    y, t, inputs = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
    rate, inside = (block_diag(*[piece[k] for piece in pieces]) for k in (3, 4))
    table = tuple(constant_tables(t, inputs)) if form is not None else None

    def momentum_and_force(y, t, table, numbers):
        params = parameters.restore(numbers)
        params = params if form is None else Driven(params, *table)
        motion = scene._motion(layout, params)
        state = (*halves(y), t, params)
        return jnp.stack([motion.momentum(*state), motion.generalized_force(*state)])

    at_all = jax.vmap(momentum_and_force, in_axes=(0, 0, 0 if form is not None else None, None))

    def residuals(u):
        p, force = jnp.moveaxis(at_all(y, t, table, parameters.numbers(u, jnp)), 1, 0)
        moved, forced = rate @ p, inside @ force
        return ((moved + forced) / jnp.sqrt(jnp.sum(moved**2, axis=0))).ravel()

    return residuals


def _bumps(ts: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Bumps on the samples of one record, (W, T) each, which integrate with φ̇ and φ by trapezia."""
    spans = np.gradient(ts)
    spans[0], spans[-1] = 0.5 * (ts[1] - ts[0]), 0.5 * (ts[-1] - ts[-2])
    half = min(max(half, 0.5 * _FEWEST_IN_WINDOW * np.max(np.diff(ts))), 0.5 * (ts[-1] - ts[0]))
    count = max(1, int(np.ceil(2 * (ts[-1] - ts[0]) / half)) - 3)  # each begins a quarter behind the one before
    centres = np.linspace(ts[0] + half, ts[-1] - half, count)
    s = np.clip((ts - centres[:, None]) / half, -1.0, 1.0)
    return -2 * _POWER / half * spans * s * (1 - s**2) ** (_POWER - 1), spans * (1 - s**2) ** _POWER
