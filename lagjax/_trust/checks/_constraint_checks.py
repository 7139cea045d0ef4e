"""Checks of constraints and contacts: satisfied, independent, with a gradient, and not violated at the start."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import ROUNDINGS, dependent_rows, require_consistent
from lagjax._interface import Layout, join_names
from lagjax._scene import FlatContacts
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._mass import null_velocities
from lagjax._trust.checks._scene_at_start import CheckedScene


def findings(scene: CheckedScene) -> Iterator[Finding]:
    if not scene.motion.constrained:
        return
    residual, jacobian = scene.residual, scene.measured.jacobian
    names = scene.system.constraint_names(scene.layout, scene.arguments[3])
    bad = [k for k in range(len(names)) if not (np.isfinite(residual[k]) and np.isfinite(jacobian[0, k]).all())]
    if bad:
        yield from (_check_finite(names[k], residual[k]) for k in bad)
        return
    positions = scene.derivation.position_count
    idle = [k for k in range(len(names)) if not jacobian[0, k].any()]
    yield from (_check_zero_gradients(names[k], k >= positions, residual[k], jacobian[:, k]) for k in idle)
    yield from _check_affine(names, jacobian, positions, scene.layout)
    if idle:
        return
    q, qdot, t, params = scene.arguments
    try:
        require_consistent(scene.system, scene.layout, np.asarray([t], scene.layout.dtype), q, qdot, params)
    except ValueError as error:
        where = tuple(name for name in names if name in str(error))
        yield Finding("inconsistent_start", "error", where, str(error))
        return
    if not scene.is_large:
        augmented = scene.augmented[0]
        if np.isfinite(augmented).all() and not len(null_velocities(augmented)):
            yield from _check_independent(jacobian[0] @ np.linalg.solve(augmented, jacobian[0].T), names)


def _check_finite(name: str, value) -> Finding:
    what = f"is {value}" if not np.isfinite(value) else "has a gradient that is not finite"
    message = f"{name} {what} at this state: look for a root or a norm at zero; constrain the square instead."
    return Finding("constraint_not_finite", "error", (name,), message)


def _check_zero_gradients(name: str, of_velocities: bool, value, rows: np.ndarray) -> Finding:
    """Return the finding for a constraint with zero gradient, which is often an inequality or a square."""
    if of_velocities:
        message = (
            f"{name} does not depend on qdot here, so that no force can keep it. Give what depends on q alone as "
            "constraints=..., and multiply out what divides by a speed."
        )
    else:
        nearby = rows[1:][np.isfinite(rows[1:]).all(axis=1)]
        where = (
            "but not nearby: it is a square or a product whose gradient vanishes where it holds, or a singular point"
            if nearby.any()
            else "and nearby: it is slack, as max(0, x) is where x < 0, or does not contain q"
        )
        message = (
            f"{name} is {value:.3g} and has zero gradient here, {where}. A constraint is an equality with a gradient "
            "where it holds: write f and not f**2; a motion that may leave it (a string, a contact) is one of two "
            "modes of a lagjax.Hybrid, with a guard on the multiplier."
        )
    return Finding("constraint_zero_gradient", "error", (name,), message)


def _check_affine(names, jacobian, positions: int, layout: Layout) -> Iterator[Finding]:
    """Yield warnings where ∂a/∂q̇ changes with q̇; the last half of the sampled states differs in q̇ alone."""
    for k in range(positions, len(names)):
        others = jacobian[(len(jacobian) + 1) // 2 :, k]
        others = others[np.isfinite(others).all(axis=1)]
        size = max(np.abs(jacobian[0, k]).max(), np.abs(others).max(initial=0))
        if np.abs(others - jacobian[0, k]).max(initial=0) > np.sqrt(np.finfo(layout.dtype).eps) * size:
            message = (
                f"{names[k]} is not affine in qdot: its derivative by qdot changes with qdot. The principle of "
                "d'Alembert and Lagrange is for a(q, qdot) = A(q) qdot + b(q); write it so, or take it out."
            )
            yield Finding("velocity_constraint_not_affine", "warning", (names[k],), message)


def _check_independent(schur: np.ndarray, names: list[str]) -> Iterator[Finding]:
    """Yield advice for each constraint that depends linearly on others, from the Schur complement (m, m)."""
    for row, factors in dependent_rows(schur).items():
        others = tuple(name for name, factor in zip(names, factors, strict=True) if factor)
        message = (
            f"{names[row]} follows from {join_names(others)} here. The motion is right, but how their forces are "
            "shared is not determined; the shortest multipliers are given. Drop it if its force is wanted."
        )
        yield Finding("dependent_constraints", "advice", (names[row], *others), message)


def contact_findings(scene: CheckedScene) -> Iterator[Finding]:
    if scene.system.contacts is None:
        return
    (q, qdot, t, numbers), layout = scene.state, scene.layout
    flat = FlatContacts.from_system(scene.system, layout, scene.arguments[3])
    gaps, rates = jax.jvp(lambda q, t: flat.gaps(q, t, numbers), (q, t), (qdot, jnp.ones_like(t)))
    slopes = jax.jacfwd(lambda q: flat.gaps(q, t, numbers))(q)
    gaps, rates, slopes = (np.asarray(x) for x in (gaps, rates, slopes))
    closed = ROUNDINGS * np.finfo(layout.dtype).eps
    near_zero = closed * (np.abs(slopes) @ np.abs(np.asarray(q)) + np.abs(gaps))
    at_rest = closed * (np.abs(slopes) @ np.abs(np.asarray(qdot)))
    measured = zip(flat.shapes.names, gaps, rates, slopes, near_zero, at_rest, strict=False)
    for name, gap, rate, slope, near, slow in measured:
        if not slope.any():
            message = (
                f"The gradient of the gap {name} is zero here: where it closes it has no direction to push in. Write "
                "it as a distance, not as a square or a product."
            )
            level = "error" if abs(gap) <= near else "warning"
            yield Finding("contact_zero_gradient", level, (name,), message)
        elif gap < -near:
            message = f"The gap {name} is {gap:.6g}: the motion starts inside. Gaps stay >= 0."
            yield Finding("contact_inside", "error", (name,), message)
        elif abs(gap) <= near and rate < -slow:
            message = (
                f"The gap {name} is closed and changes by {rate:.6g} per unit of time: the motion begins with an "
                "impact at once. Start it with a velocity along the contact if that is not meant."
            )
            yield Finding("contact_inwards", "advice", (name,), message)
