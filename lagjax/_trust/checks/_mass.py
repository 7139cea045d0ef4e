"""Checks of the mass matrix: velocities that carry no kinetic energy, and why; its signs and its condition.

With constraints M may be singular along directions that they exclude. Then the augmented matrix K = M + GᵀW G is
examined, which is regular when the saddle point is (`_linear`). A direction u with K u = 0 is classified by K at states
nearby:

    the row of M is zero everywhere, and p too             a velocity that L does not contain
    the row of M is zero everywhere, p is not              L is linear in it
    K is regular where q is another                        the chart is singular here: r = 0, a pole
    K is regular where q̇ is another                        kinetic energy of a higher order than the second
    K is singular everywhere, u the same                   a combination of velocities is missing
    K is singular everywhere, u another                    a gauge: some motion is left undetermined, as the
                                                           parametrisation of a path where L is of degree one in q̇
"""

from collections.abc import Sequence

import numpy as np

from lagjax._engine import DEFAULT_RTOL
from lagjax._equations import eigen, null_directions, null_space, singular_threshold, sparse_spectrum, unit_diagonal
from lagjax._interface import join_names
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._scene_at_start import CheckedScene


def findings(scene: CheckedScene) -> list[Finding]:
    m, names = scene.measured, scene.layout.names
    if scene.is_large:
        return _large_findings(scene, names)
    augmented = scene.augmented
    usable = [k for k in range(1, len(augmented)) if np.isfinite(augmented[k]).all()]
    if not np.isfinite(augmented[0]).all():
        return []  # a derivative is not finite, which was said already
    if len(null_velocities(augmented[0])):
        return _check_singular(scene, augmented, usable)
    others = [augmented[k] for k in usable]
    condition = _check_condition(augmented[0], names, DEFAULT_RTOL)
    return [
        *_check_nearly_singular(augmented[0], others, names),
        *_check_signs(m.mass[0], m.jacobian[0], names),
        *condition,
    ]


def null_velocities(matrix: np.ndarray) -> np.ndarray:
    """Return unit vectors (k, n), one a row, that span the null space of a symmetric matrix, up to rounding."""
    # The entries are derivatives with some units of round-off each: more is allowed for here than in `_linear`, where a
    # matrix is solved with that is taken to be exact.
    return null_directions(matrix, _rounding_fraction(matrix))


def _rounding_fraction(matrix: np.ndarray) -> float:
    """Return the largest ratio to the largest eigenvalue that counts as zero: 32 round-offs per row."""
    return 32 * singular_threshold(len(matrix), matrix.dtype)


_NO_ENERGY = (
    "L has no kinetic energy along this combination of velocities. Add it (a missing mass?), or use fewer coordinates."
)


# ---- singular --------------------------------------------------------------------------------------------------------


def _check_singular(scene: CheckedScene, augmented: np.ndarray, usable: list[int]) -> list[Finding]:
    """Return findings for K (states, n, n), singular at the state; K is finite at the `usable` states nearby."""
    names, constrained = scene.layout.names, scene.motion.constrained
    empty = [i for i in range(len(names)) if all(not augmented[k][i].any() for k in [0, *usable])]
    momenta = scene.measured.momentum[[0, *usable]]
    empty_rows = [_massless_finding((names[i],), bool(momenta[:, i].any()), constrained) for i in empty]
    rest = [i for i in range(len(names)) if i not in empty]

    def among_rest(k):
        return null_velocities(augmented[k][np.ix_(rest, rest)])

    if not rest or not len(here := among_rest(0)):
        return empty_rows
    where = tuple(names[rest[i]] for i in np.flatnonzero(np.abs(here).max(axis=0) > 1e-6))
    combinations = "; ".join(describe_direction(u, [names[i] for i in rest]) for u in here)
    what = "The saddle point of M and the constraints" if constrained else "The mass matrix d2L/dqdot2"
    kind, why = _classify_singularity(scene, here, {k: among_rest(k) for k in usable})
    return [*empty_rows, Finding(kind, "error", where, f"{what} is singular along {combinations}, {why}")]


def _massless_finding(where: tuple[str, ...], linear: bool, constrained: bool) -> Finding:
    """Return the finding for coordinates with zero rows of M; `linear`: L is linear in their velocities."""
    kind, name = "linear_in_velocity" if linear else "velocity_unused", join_names(where)
    velocity = join_names([f"d{name}" for name in where])
    what = f"L is linear in {velocity}" if linear else f"L does not contain the velocity {velocity}"
    nor = ", and no constraint holds it" if constrained else ""
    message = (
        f"{what}{nor}: the mass matrix has a zero row, and nothing determines the acceleration of {name}. Add its "
        f"kinetic energy, or take {name} out of q"
        + (": an equation of first order is not one of motion." if linear else " and give it as a parameter.")
    )
    return Finding(kind, "error", where, message)


def _classify_singularity(scene: CheckedScene, here: np.ndarray, nearby: dict[int, np.ndarray]) -> tuple[str, str]:
    """Return (kind, end of the message) of a singularity with null directions `here` and `nearby`."""
    m = scene.measured
    if any(not len(directions) for k, directions in nearby.items() if not (m.velocity[k] != m.velocity[0]).any()):
        return "coordinate_singularity", (
            "but regular at positions nearby: these coordinates are singular here (polar ones at r = 0, spherical ones "
            "and Euler angles at a pole, a slack variable s² at s = 0). Use others that are regular where the motion "
            "goes, such as Cartesian ones with a constraint, or start elsewhere."
        )
    if any(not len(directions) for directions in nearby.values()):
        return "singular_at_velocity", (
            "but regular at other velocities: L has no second order in them here. Start with another velocity, or "
            "write a kinetic energy that is quadratic in small velocities."
        )
    if scene.motion.constrained:
        return "singular_saddle_point", (
            "here and nearby: neither L nor a constraint determines the acceleration there. Add the kinetic energy of "
            "these velocities or a constraint on them, or take a coordinate out."
        )
    if _is_homogeneous(scene, [0, *nearby]):
        return "gauge", (
            "the velocity itself: L is of degree one in the velocities, and every parametrisation of the path is as "
            "good as another. Take one of the coordinates as t, or, where L is a length alone, integrate its square."
        )
    if nearby and all(_span_same_space(here, directions) for directions in nearby.values()):
        return "velocity_combination", f"here and nearby: {_NO_ENERGY}"
    return "gauge", (
        "and nearby along directions that change with the state: a part of the motion is left free. Fix it by a "
        "constraint, or use fewer coordinates."
    )


def _is_homogeneous(scene: CheckedScene, states: list[int]) -> bool:
    """True if M q̇ = 0 at all of these states: L is of degree one in the velocities."""
    pairs = [(scene.measured.mass[k], v) for k in states if (v := scene.measured.velocity[k]).any()]
    least = np.sqrt(np.finfo(scene.layout.dtype).eps)
    return bool(pairs) and all(np.abs(m @ v).max() <= least * np.abs(m).max() * np.abs(v).max() for m, v in pairs)


def _span_same_space(one: np.ndarray, other: np.ndarray) -> bool:
    """True if the rows of two arrays (k, n) span the same space, up to √eps."""
    beyond = one - one @ (basis := np.linalg.qr(other.T)[0]) @ basis.T if one.shape == other.shape else np.inf
    return bool(np.abs(beyond).max() < np.sqrt(np.finfo(one.dtype).eps))


def describe_direction(direction: np.ndarray, names: Sequence[str]) -> str:
    """Return a direction as text, such as "+1 dq[0] -0.3 dq[1]"."""
    direction = direction / direction[np.argmax(np.abs(direction))]
    terms = [f"{c:+.3g} d{name}" for c, name in zip(direction, names, strict=True) if abs(c) > 1e-6]
    return " ".join(terms[:8]) + (" …" if len(terms) > 8 else "")


# ---- regular ---------------------------------------------------------------------------------------------------------

# The smallest eigenvalue of K over that at states nearby, below which the state is called next to a singularity. The
# states are a tenth of a size away, and eigenvalues vanish like r²: 1e-6 is a ten-thousandth of a size from the pole.
_NEARLY = 1e-6


def _check_nearly_singular(here: np.ndarray, others: list[np.ndarray], names) -> list[Finding]:
    """Return a warning near a pole: K is regular, but nearly singular when scaled by the diagonal at other states."""
    if not others:
        return []
    usual = 1 / np.sqrt(np.maximum(np.median([np.abs(np.diagonal(k)) for k in others], axis=0), 1e-300))

    def smallest(matrix):
        values, vectors = eigen(usual[:, None] * matrix * usual)
        place = np.argmin(np.abs(values))
        return np.abs(values[place]) / np.abs(values).max(), vectors[:, place]

    lowest, direction = smallest(here)
    if all(np.array_equal(k, here) for k in others) or lowest >= _NEARLY * np.median([smallest(k)[0] for k in others]):
        return []
    where = tuple(name for name, c in zip(names, direction, strict=True) if abs(c) > 0.1)
    message = (
        f"The mass matrix is {lowest:.1g} of its usual size along {join_names([f'd{name}' for name in where])}: the "
        "state is next to a singularity of the coordinates (r = 0, a pole, a gimbal), where accelerations and steps "
        "become extreme (or a length is in units far too large for it). Use coordinates that are regular there, such "
        "as Cartesian ones with a constraint."
    )
    return [Finding("near_coordinate_singularity", "warning", where, message)]


def _check_signs(mass: np.ndarray, rows: np.ndarray, names) -> list[Finding]:
    """Return a finding if the kinetic energy is negative along velocities that the constraints allow."""
    scaled, scale = unit_diagonal(mass)
    free = null_space(rows * scale)
    if not free.shape[1]:
        return []
    values, vectors = eigen(free.T @ scaled @ free)
    negative = values < -_rounding_fraction(mass) * np.abs(values).max()
    if not negative.any():
        return []
    return [_indefinite_finding(scale * (free @ vectors[:, 0]), bool(negative.all()), names)]


def _indefinite_finding(direction: np.ndarray, everywhere: bool, names) -> Finding:
    combination = describe_direction(direction, names)
    where = tuple(name for name, c in zip(names, direction, strict=True) if abs(c) > 1e-6 * np.abs(direction).max())
    whole = "negative definite" if everywhere else "indefinite"
    return Finding(
        "indefinite_mass_matrix", "warning", where,
        f"The mass matrix is {whole}: d2L is negative along {combination}. The motion is that of L all the same, but "
        "if L is meant to be T - U, a sign is wrong, or a mass is negative.",
    )  # fmt: skip


def _check_condition(matrix: np.ndarray, names, default_rtol: float) -> list[Finding]:
    values, vectors = eigen(unit_diagonal(matrix)[0])
    with np.errstate(divide="ignore"):
        condition, raw = (np.abs(x).max() / np.abs(x).min() for x in (values, eigen(matrix)[0]))
    return _ill_conditioned(condition, f" ({raw:.1e} before)", vectors[:, 0], names, default_rtol)


def _ill_conditioned(condition: float, more: str, direction: np.ndarray, names, default_rtol: float) -> list[Finding]:
    lost = condition * np.finfo(direction.dtype).eps
    if lost <= default_rtol:
        return []
    where = tuple(name for name, c in zip(names, direction, strict=True) if abs(c) > 0.1)
    message = (
        f"The mass matrix has the condition {condition:.1e} after scaling each coordinate{more}: "
        f"accelerations are good to {lost:.0e} only, through {join_names(where)}. Use coordinates that are less "
        "coupled (absolute angles instead of joint angles), masses less far apart, or do not ask for a tighter rtol."
    )
    return [Finding("ill_conditioned", "advice", where, message)]


# ---- of a large scene ------------------------------------------------------------------------------------------------


def _large_findings(scene: CheckedScene, names) -> list[Finding]:
    """Return findings about M of a large scene, also with constraints, from its entries if they are known."""
    m = scene.measured
    empty = np.isfinite(m.mass[0]).all() and ~m.mass.any(axis=(0, 2))
    if np.any(empty):
        linear = m.momentum.any(axis=0)
        groups = [(np.flatnonzero(empty & (linear == kind)), kind) for kind in (True, False)]
        return [_massless_finding(tuple(names[i] for i in of), kind, False) for of, kind in groups if len(of)]
    spectrum = sparse_spectrum(scene.derivation, scene.state)
    if spectrum is None:
        return []
    (smallest, null), (lowest, downward), largest = spectrum
    if np.abs(smallest) <= 32 * singular_threshold(2, null.dtype) * np.abs(largest):
        where = tuple(name for name, c in zip(names, null, strict=True) if abs(c) > 1e-6 * np.abs(null).max())
        message = f"The mass matrix d2L/dqdot2 is singular along {describe_direction(null, names)}: {_NO_ENERGY}"
        return [Finding("velocity_combination", "error", where, message)]
    condition = abs(largest / smallest)
    reported = [_indefinite_finding(downward, False, names)] if lowest < 0 else []
    return reported + _ill_conditioned(condition, "", null, names, DEFAULT_RTOL)
