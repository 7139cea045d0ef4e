"""Constraints: whether they are satisfied, whether they have a gradient, and whether one follows from others."""

import numpy as np

from lagjax._equations import dependent_rows, require_consistent
from lagjax._interface import Layout, join_names
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._mass import null_velocities
from lagjax._trust.checks._scene_at_start import CheckedScene


def findings(scene: CheckedScene) -> list[Finding]:
    if not scene.motion.constrained:
        return []
    residual, jacobian = scene.residual, scene.measured.jacobian
    names = scene.system.constraint_names(scene.layout, scene.arguments[3])
    bad = [k for k in range(len(names)) if not (np.isfinite(residual[k]) and np.isfinite(jacobian[0, k]).all())]
    if bad:
        return [_not_finite(names[k], residual[k]) for k in bad]
    positions = scene.derivation.position_count
    idle = [k for k in range(len(names)) if not jacobian[0, k].any()]
    reported = [_idle(names[k], k >= positions, residual[k], jacobian[:, k]) for k in idle]
    reported += _not_affine(names, jacobian, positions, scene.layout)
    if idle:
        return reported
    q, qdot, t, params = scene.arguments
    try:
        require_consistent(scene.system, scene.layout, np.asarray([t], scene.layout.dtype), q, qdot, params)
    except ValueError as error:
        where = tuple(name for name in names if name in str(error))
        return [*reported, Finding("inconsistent_start", "error", where, str(error))]
    if scene.is_large:
        return reported
    augmented = scene.augmented[0]
    if not np.isfinite(augmented).all() or len(null_velocities(augmented)):
        return reported
    return [*reported, *_dependent(jacobian[0] @ np.linalg.solve(augmented, jacobian[0].T), names)]


def _not_finite(name: str, value) -> Finding:
    what = f"is {value}" if not np.isfinite(value) else "has a gradient that is not finite"
    message = f"{name} {what} at this state: look for a root or a norm at zero; constrain the square instead."
    return Finding("constraint_not_finite", "error", (name,), message)


def _idle(name: str, of_velocities: bool, value, rows: np.ndarray) -> Finding:
    """A constraint whose gradient is zero: of no use here, and often an inequality or a square."""
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
            "modes of simulate_hybrid, with a guard on the multiplier."
        )
    return Finding("constraint_zero_gradient", "error", (name,), message)


def _not_affine(names, jacobian, positions: int, layout: Layout) -> list[Finding]:
    """Warnings where ∂a/∂q̇ changes with q̇; the last half of the states differs from the state itself in q̇ alone."""
    reported = []
    for k in range(positions, len(names)):
        others = jacobian[(len(jacobian) + 1) // 2 :, k]
        others = others[np.isfinite(others).all(axis=1)]
        size = max(np.abs(jacobian[0, k]).max(), np.abs(others).max(initial=0))
        if np.abs(others - jacobian[0, k]).max(initial=0) > np.sqrt(np.finfo(layout.dtype).eps) * size:
            message = (
                f"{names[k]} is not affine in qdot: its derivative by qdot changes with qdot. The principle of "
                "d'Alembert and Lagrange is for a(q, qdot) = A(q) qdot + b(q); write it so, or take it out."
            )
            reported.append(Finding("velocity_constraint_not_affine", "warning", (names[k],), message))
    return reported


def _dependent(schur: np.ndarray, names: list[str]) -> list[Finding]:
    """Advice for each constraint that is a combination of others, from the Schur complement (m, m)."""
    reported = []
    for row, factors in dependent_rows(schur).items():
        others = tuple(name for name, factor in zip(names, factors, strict=True) if factor)
        message = (
            f"{names[row]} follows from {join_names(others)} here. The motion is right, but how their forces are "
            "shared is not determined; the shortest multipliers are given. Drop it if its force is wanted."
        )
        reported.append(Finding("dependent_constraints", "advice", (names[row], *others), message))
    return reported
