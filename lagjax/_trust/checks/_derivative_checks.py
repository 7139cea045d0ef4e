"""Checks of values and derivatives: finite, and equal to finite differences; if not, which operation is the cause."""

from collections.abc import Iterator

import numpy as np

from lagjax._equations import describe_decisions, find_offenders
from lagjax._interface import join_names
from lagjax._trust.checks._differences import Slopes, slopes, slopes_differ, step_ladder
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._jumps_near import OF_FORCE
from lagjax._trust.checks._scene_at_start import CheckedScene

_SHOWN = 3  # findings of one kind about one function
# Coordinates beyond which derivatives are compared along lines: to go along every one costs their number times all
# operations, 1.5 s for a hanging chain of 100. Doubled, 10.
_ALL_AT_ONCE = 100


def findings(scene: CheckedScene) -> list[Finding]:
    if reported := [*_check_values(scene)] or [*_check_finite_derivatives(scene)]:
        return reported
    if scene.is_large or scene.layout.size > _ALL_AT_ONCE:
        return _compare_along_lines(scene)
    sides = scene.sides()
    return [
        found
        for block in _compared_derivatives(scene, sides.round_off)
        for found in _compare_derivatives(scene, sides, *block)
    ]


# ---- finite ----------------------------------------------------------------------------------------------------------


def _check_values(scene: CheckedScene) -> Iterator[Finding]:
    for role, name, value in (("lagrangian", "L", scene.lagrangian), ("forces", "The force", scene.measured.extra),
                              ("dissipation", "D", scene.dissipation)):  # fmt: skip
        if not np.isfinite(value).all():
            where = () if value.ndim == 0 else _select_names(scene.layout.names, ~np.isfinite(value))
            first, of = value[~np.isfinite(value)].ravel()[0], f" of {join_names(where)}" if where else ""
            message = f"{name}{of} is {first} at this state"
            yield Finding("value_not_finite", "error", where, message + _blame_phrase(scene, role, "value"))


def _check_finite_derivatives(scene: CheckedScene) -> Iterator[Finding]:
    m, n, names = scene.measured, scene.layout.size, scene.names
    first = ~np.isfinite(np.concatenate([m.by_q, m.momentum[0]]))
    drag = ~np.isfinite(m.by_v_of_dissipation)
    second = ~np.isfinite(m.mass[0]).all(axis=1) | ~np.isfinite(scene.drift) & ~drag
    if first.any():
        yield _no_derivative(scene, "lagrangian", "The derivative of L by", _select_names(names[:-1], first), "first")
    elif second.any():
        where = _select_names(names[n:-1], second)
        yield _no_derivative(scene, "lagrangian", "The second derivative of L by", where, "second")
    if drag.any():
        yield _no_derivative(scene, "dissipation", "The derivative of D by", _select_names(names[n:-1], drag), "first")


def _no_derivative(scene: CheckedScene, role: str, what: str, where: tuple[str, ...], order: str) -> Finding:
    message = f"{what} {join_names(where)} is not finite at this state, although the function is"
    return Finding("derivative_not_finite", "error", where, message + _blame_phrase(scene, role, order))


def _select_names(names, chosen) -> tuple[str, ...]:
    return tuple(name for name, yes in zip(names, chosen, strict=True) if yes)


# ---- the operation to blame ------------------------------------------------------------------------------------------

_REMEDIES = {
    "sqrt": "A norm at zero, most often: where its square is wanted write jnp.sum(v**2) and not jnp.linalg.norm(v)**2.",
    "pow": "Powers that are no whole numbers have no derivative of every order at zero: write a polynomial there.",
    "atan2": "An angle has no derivative at the origin: take Cartesian coordinates, or start elsewhere.",
    "div": "Divide by something that is not zero where the motion goes, or cancel the fraction by hand.",
    "log": "Its argument must stay positive.",
}
_REMEDIES |= {"rsqrt": _REMEDIES["sqrt"], "cbrt": _REMEDIES["pow"], "integer_pow": _REMEDIES["div"]}
_BRANCH = (
    "L itself does not see it, as it is a branch that `where` does not take; its derivative does, as zero times NaN is "
    "NaN. Keep the argument good in both: where(ok, f(where(ok, x, 1.0)), other)."
)


def _blame_phrase(scene: CheckedScene, role: str, order: str) -> str:
    """Return the end of a sentence: the operation, its operands, its line of code, and what to write instead."""
    wanted = {"value": ("value",), "first": ("value", "first derivative")}.get(order)
    offending = [
        o for o in find_offenders(getattr(scene.written_motion, role), *scene.state) if not wanted or o.fault in wanted
    ]
    if not offending:
        return ". No single operation is to blame: large numbers may overflow together; look at the units."
    first = offending[0]
    hidden = first.fault == "value" and order != "value"
    remedy = _REMEDIES.get(first.name, "Write it so that it is smooth there, or start elsewhere.")
    return f": {first}. {_BRANCH if hidden else remedy}"


# ---- against finite differences --------------------------------------------------------------------------------------


def _compared_derivatives(scene: CheckedScene, round_off):
    """Return the derivatives to compare: (name, role, derivatives (directions, outputs), directions, outputs).

    Directions index the 2n + 1 inputs (q, q̇, t), outputs index `Measured.here`.
    """
    m, n = scene.measured, scene.layout.size
    first, dissipates = 1 + n, scene.motion.dissipation is not None
    constraint = first + dissipates
    # Derivatives by automatic differentiation have the rounding of their terms, which may cancel.
    of_q, of_v, of_mass, of_drift, of_drag, of_rows = round_off
    by_y = Slopes(*(np.concatenate(parts)[:, None] for parts in ((m.by_q, m.momentum[0]), (of_q, of_v))))
    of_momentum = Slopes(np.concatenate([m.mass[0], scene.drift[None]]), np.concatenate([of_mass, of_drift[None]]))
    blocks = [
        ("L", "lagrangian", by_y, range(2 * n), range(1)),
        ("p = dL/dqdot", "lagrangian", of_momentum, range(n, 2 * n + 1), range(1, first)),
    ]
    if dissipates:
        by_v = Slopes(m.by_v_of_dissipation[:, None], of_drag[:, None])
        blocks.append(("D", "dissipation", by_v, range(n, 2 * n), range(first, constraint)))
    count = len(scene.residual)
    if np.isfinite(scene.residual).all() and np.isfinite(m.jacobian[0]).all():
        positions = scene.derivation.position_count
        by_q, by_v = (Slopes(m.jacobian[0, k].T, of_rows[k].T) for k in (slice(positions), slice(positions, None)))
        blocks += [
            ("a constraint", "constraints", by_q, range(n), range(constraint, constraint + positions)),
            ("a velocity constraint", "velocity_constraints", by_v, range(n, 2 * n),
             range(constraint + positions, constraint + count)),
        ]  # fmt: skip
    return [block for block in blocks if len(block[-1])]


def _compare_derivatives(scene: CheckedScene, sides, name, role, derivative, directions, outputs) -> Iterator[Finding]:
    m, dtype, names = scene.measured, scene.layout.dtype, scene.names
    chosen = np.ix_(directions, range(sides.plus.shape[1]), outputs)
    place = _input_magnitudes(scene)[list(directions)]
    both, ahead, behind = slopes(
        sides.minus[chosen], m.here[list(outputs)], sides.plus[chosen], scene.steps[:, list(directions)], place,
        float(np.finfo(dtype).eps), sides.noise[list(outputs)],
    )  # fmt: skip
    kinks, n = slopes_differ(ahead, behind, dtype), scene.layout.size
    derivative, wrong = derivative.value, slopes_differ(derivative, both, dtype) & ~kinks
    names = [names[i] for i in directions]
    for i, k in list(zip(*np.nonzero(kinks), strict=True))[:_SHOWN]:
        of_velocity = name == "L" and directions[i] >= n
        values = behind.value[i, k], ahead.value[i, k], derivative[i, k]
        yield _kink_finding(scene, name, role, names[i], values, of_velocity)
    for i, k in list(zip(*np.nonzero(wrong), strict=True))[:_SHOWN]:
        yield _wrong_derivative_finding(name, names[i], derivative[i, k], both.value[i, k], both.error[i, k])


def _kink_finding(scene: CheckedScene, name: str, role: str, along: str, values, of_velocity: bool) -> Finding:
    """Return the finding for different slopes below and above the state; `values` are these and the derivative."""
    below, above, derivative = values
    slope = f"The slope of {name} along {along} is {below:.6g} below this state and {above:.6g} above it"
    if role in ("lagrangian", "dissipation"):
        pieces = describe_decisions([getattr(scene.written_motion, role)], scene.state)
        slope += f" (the function is pieced together by {pieces})" if pieces else ""
    of_force = role == "dissipation" or (role == "lagrangian" and not of_velocity)
    if of_force:
        rest = (
            ": the acceleration jumps here. At this very state `acceleration` and derivatives are those of one "
            f"side, or between them, by the slope {derivative:.6g}. {OF_FORCE}"
        )
    else:
        rest = (
            f": a kink, where automatic differentiation says {derivative:.6g}. No force shows the kick that "
            "it gives to velocities. Smooth it (sqrt(x**2 + w**2) for abs(x)), or make two modes of it with a "
            "Transition for a lagjax.Hybrid."
        )
    return Finding("kink", "advice" if of_force else "error", (along,), slope + rest)


def _wrong_derivative_finding(name: str, along: str, derivative, slope, error) -> Finding:
    message = (
        f"The derivative of {name} along {along} is {derivative:.6g} by automatic differentiation, and "
        f"{slope:.6g} ± {error:.0e} by finite differences: a custom derivative is wrong, or "
        "stop_gradient, a round or a cast to integers hides a dependence."
    )
    return Finding("wrong_derivative", "error", (along,), message)


# ---- along lines ----------------------------------------------------------------------------------------------------

# Random directions of q, as many of q̇, and the motion: half a thousand evaluations of L and p. A derivative that is
# wrong by less than a hundred thousandth of the slope along such a direction is not seen.
_LINES = 2
_OF_LINES = (
    ("L", "lagrangian"), ("p = dL/dqdot", "lagrangian"), ("D", "dissipation"), ("a constraint", "constraints"),
    ("a velocity constraint", "velocity_constraints"),
)  # fmt: skip


def _compare_along_lines(scene: CheckedScene) -> list[Finding]:
    """Return findings where derivatives differ from slopes along random directions in q or in q̇."""
    # What is compared is a sum over all outputs of a function. A second look leaves out what the first one blames.
    n, reported = scene.layout.size, {}
    directions = np.zeros((2 * _LINES + 1, 2 * n + 1))
    random = np.random.default_rng(0).standard_normal((2, _LINES, n)) * scene.sizes[:-1].reshape(2, 1, n)
    directions[:_LINES, :n], directions[_LINES:-1, n:-1] = random
    directions[-1, -1] = 1.0
    for direction in directions:
        for _ in range(_SHOWN):
            off = np.flatnonzero(_compare_line(scene, direction)[0].any(axis=0)).tolist()
            blamed = [(k, i) for k in off if (i := _blamed_coordinate(scene, direction, k)) is not None]
            for k, i in blamed:
                found = _describe_coordinate(scene, _restrict(direction, i), i, k)
                reported.setdefault((found.kind, _OF_LINES[k]), found)
            direction[[i for _, i in blamed]] = 0.0
            if not blamed:
                break
    return list(reported.values())


def _blamed_coordinate(scene: CheckedScene, direction: np.ndarray, k: int) -> int | None:
    """Return by bisection the coordinate whose own derivative is wrong along a direction; None if there is none."""
    part = np.flatnonzero(direction)
    while len(part) > 1:
        halves = part[: len(part) // 2], part[len(part) // 2 :]
        part = next((of for of in halves if _compare_line(scene, _restrict(direction, of))[0][:, k].any()), part[:0])
    return int(part[0]) if len(part) else None


def _describe_coordinate(scene: CheckedScene, direction: np.ndarray, i: int, k: int) -> Finding:
    (kinks, _), both, ahead, behind, derivative = _compare_line(scene, direction)
    size, along, (name, role) = direction[i], scene.names[i], _OF_LINES[k]
    sides = (behind, ahead) if size > 0 else (ahead, behind)
    values = (*(of.value[0, k] / size for of in sides), derivative[k] / size)
    if kinks[k]:
        return _kink_finding(scene, name, role, along, values, name == "L" and i >= scene.layout.size)
    return _wrong_derivative_finding(name, along, values[-1], both.value[0, k] / size, both.error[0, k] / abs(size))


def _restrict(direction: np.ndarray, part) -> np.ndarray:
    return np.where(np.isin(np.arange(direction.size), part), direction, 0.0)


def _compare_line(scene: CheckedScene, direction: np.ndarray) -> tuple[np.ndarray, Slopes, Slopes, Slopes, np.ndarray]:
    """Return flags (2, 5) of kinks and wrong derivatives along a direction; one-sided slopes; derivatives."""
    n, dtype = scene.layout.size, scene.layout.dtype
    steps = step_ladder(np.array([scene.sizes[-1] if direction[-1] else 1.0]), dtype)
    line, eps = scene.line(direction, steps[:, 0]), float(np.finfo(dtype).eps)
    place = np.abs(direction) @ (_input_magnitudes(scene) / scene.sizes**2)
    sides = slopes(line.minus[None], line.here, line.plus[None], steps, np.array([place]), eps, 4 * eps * line.terms)
    both, ahead, behind = sides
    kinks = slopes_differ(ahead, behind, dtype)[0]
    wrong = slopes_differ(Slopes(line.derivative[None], 0 * line.derivative[None]), both, dtype)[0] & ~kinks
    if direction[:n].any() or direction[-1]:
        kinks[2] = wrong[2] = False  # of D only the slope by velocities counts
    return np.stack([kinks, wrong]), both, ahead, behind, line.derivative


def _input_magnitudes(scene: CheckedScene) -> np.ndarray:
    """Return |q|, |q̇| and the time, (2n + 1,): magnitudes that determine the rounding error of results."""
    q, v, t = (np.abs(np.asarray(x, float)) for x in scene.state[:3])
    speed = v.max()
    return np.concatenate([q, v, [max(t, q.max() / speed if speed > 0 else 0)]])
