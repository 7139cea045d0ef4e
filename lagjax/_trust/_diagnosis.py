"""The obstacle of a failed motion, in words: `diagnosis`, from the state where it ended and the one where it began.

`_stop_reason` gives a failure its code, from numbers alone and for every member of a batch. Here the author of the
scene is told about one motion: which force is not finite and from when on, the operation and the line of code that it
comes from, a pole that was reached, a mass matrix that has become singular, an escape to infinity, and what `check`
finds at the last state: a kink, a jump, stiff terms.

All but the line and `check` is read off the scene's programs in NumPy, which compiles nothing. Looking for lines stops
at scenes whose functions are longer than `LONGEST`, and `check` is called up to `LARGEST` coordinates: a failure
must not cost more than a motion does.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import AHEAD
from lagjax._equations import (
    Derivation,
    Offender,
    Sample,
    derivation_of,
    eigen,
    is_lowered,
    null_directions,
    numbers_of,
    offenders,
    pieces_of,
    poles,
)
from lagjax._interface import RESULTS, Layout, code_of, halves, join_names, not_finite, numbers_at
from lagjax._primitives import sentence
from lagjax._program import Unlowerable
from lagjax._run import Trajectory
from lagjax._scene import System
from lagjax._trust.checks import check

LARGEST = 128  # coordinates up to which `check` is called: it takes a second there
LONGEST = 4000  # equations of a function up to which they are gone through one by one: some 50 µs each
# A motion that runs away does so on a time scale |q̇|/|q̈| (or |q|/|q̇|) that has shrunk to less than this part of the
# whole: steps have shrunk to 1e-15 of it when they are given up, and smooth motions are followed to 1e-5 in the budget.
RUNAWAY = 1e-8
RUNAWAY_SINGLE = 3e-6  # of float32, whose steps are given up at 5e-7 of the whole
SINGULAR = 1e-9  # the part of its first value to which an eigenvalue of M has come down where M is called singular
# Steps beyond which a budget was spent on crossing borders: one that no step fits over is given up within a hundred
# after those that led there. Twice as many say the same of most scenes.
MANY = 1000
ESCAPED = 1e3  # times its largest coordinate at the start: a motion to infinity

_CODES = {
    code_of(getattr(RESULTS, name)): name
    for name in ("nonfinite_state", "dt_min_reached", "max_steps_reached", "acceleration_discontinuous")
}


_OVERSTEPPED = (
    "The state itself is not finite, from the first output on that is NaN: a step of a fixed length does not stop "
    "where the motion does. Leave dt out, and the message says what it runs into."
)


class Ended(NamedTuple):
    """Beginning and end of one motion, in NumPy: `y` (2n,) at `t`, of `t_first` … `t_last`; `numbers` in params."""

    code: int
    t: float
    y: np.ndarray
    t_last: float
    t_first: float
    y_first: np.ndarray
    steps: int
    numbers: np.ndarray
    by_resets: bool = False  # whether the states of a hybrid motion are reset on the way


class Undefined(NamedTuple):
    """The quantities that are not finite, at a state (2n,) and a time, at the end of a motion or just `ahead` of it."""

    what: str  # "the force on"
    role: str  # of the function of the scene that it comes from
    names: tuple[str, ...]
    values: tuple[float, ...]
    y: np.ndarray
    t: float
    ahead: bool
    by_time: bool  # whether time alone, without the motion, leads there


def describe_failure(trajectory: Trajectory, layout: Layout, why: str | None) -> str:
    """The whole message of a single motion that failed: why it did, its last state and the diagnosis."""
    end, system = trajectory.end, trajectory.system
    y_end = np.concatenate([layout.flatten(end.q), layout.flatten(end.qdot)])
    message = sentence(trajectory.result._value, end.t, trajectory.ts[-1], y_end, layout.names, why) or ""
    if not isinstance(system, System):
        return message
    if trajectory.result == RESULTS.mass_matrix_singular:
        mass = np.asarray(system.mass_matrix(end.q, end.qdot, end.t, trajectory.params))
        message += f"\n{_describe_null(mass, layout.names)}"
    return message + diagnosis(system, layout, trajectory.params, motion_end(trajectory, layout))


def diagnosis(system: System, layout: Layout, params, ended: Ended) -> str:
    """The facts about a failure, as sentences on a line of their own that begins with a line break; or nothing."""
    try:
        return _find_cause(system, layout, params, ended) if ended.code in _CODES else ""
    except Exception as error:  # the message of the failure itself must come out
        return f"\n(No more is known about it: {type(error).__name__}.)"


def _find_cause(system: System, layout: Layout, params, ended: Ended) -> str:
    derivation = derivation_of(system, layout, params)
    state = layout.restore(ended.y[: layout.size]), layout.restore(ended.y[layout.size :])
    first = layout.restore(ended.y_first[: layout.size]), layout.restore(ended.y_first[layout.size :])
    bad = not_finite(params, "params") + not_finite(first[0], "q0") + not_finite(first[1], "qdot0")
    if bad:
        where, value = bad[0]
        return f"\n{where} is {value}: every number must be finite."
    if not np.isfinite(ended.y).all():
        return f"\n{_reset_to_nothing(layout, ended) if ended.by_resets else _OVERSTEPPED}"
    undefined = _undefined(derivation, ended) or _undefined_by_jax(derivation, params, ended)
    if undefined is not None:
        return f"\n{_describe_undefined(undefined)}{_line(derivation, params, undefined)}."
    if text := _singular_mass(derivation, ended):
        return f"\n{text}"
    if (at := _running_away(derivation, ended)) is not None:
        return f"\n{_escape(derivation, ended, at, _pole(derivation, params, ended))}"
    return _run_check(system, derivation, state, params, ended) or _budget(ended)


def _reset_to_nothing(layout: Layout, ended: Ended) -> str:
    names = [*layout.names, *(f"the velocity of {name}" for name in layout.names)]
    bad = [f"{name} ({value})" for name, value in zip(names, ended.y, strict=True) if not np.isfinite(value)]
    return f"The reset of the transition at t = {ended.t:.9g} returned {join_names(bad)}: every number must be finite."


# ---- what is not finite ----------------------------------------------------------------------------------------------

# Quantities of the scene in the order in which they are blamed, what they are called, and the function they come from.
_QUANTITIES = (
    ("given_force", "the force on", "forces"),
    ("dissipation_by_qdot", "the derivative of D by the velocity of", "dissipation"),
    ("lagrangian_by_q", "the derivative of L by", "lagrangian"),
    ("momentum", "the derivative of L by the velocity of", "lagrangian"),
    ("mass_matrix", "the second derivative of L by the velocity of", "lagrangian"),
    ("force", "the right-hand side of the equation of", "lagrangian"),
    ("jacobian", "the gradient of a constraint by", "constraints"),
)


def _states_ahead(ended: Ended, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (S, 2n) and times (S,): at the end, some smallest steps on along the motion, and then in time alone."""
    smallest = 4 * np.finfo(ended.y.dtype).eps * max(abs(ended.t_first), abs(ended.t_last))
    steps = np.array([0.0, *AHEAD]) * np.copysign(smallest, ended.t_last - ended.t_first)
    moved = ended.y + steps[:, None] * np.where(np.isfinite(rate), rate, 0.0)
    alone = np.broadcast_to(ended.y, (len(AHEAD), len(ended.y)))
    return np.concatenate([moved, alone]), ended.t + np.concatenate([steps, steps[1:]])


@np.errstate(all="ignore")
def _undefined(derivation: Derivation, ended: Ended) -> Undefined | None:
    """The first of the scene's quantities that is not finite at the end or just ahead; None where all are."""
    try:
        rate = np.concatenate([halves(ended.y)[1], _acceleration(derivation, ended)])
        y, t = _states_ahead(ended, rate)
        values = Sample.from_states(derivation, y, t, ended.numbers).quantities(*(name for name, *_ in _QUANTITIES))
    except Unlowerable:
        return None
    return _first_undefined(derivation.layout, ended, y, t, values)


def _undefined_by_jax(derivation: Derivation, params, ended: Ended) -> Undefined | None:
    """The first quantity that is not finite in a scene without programs, among its forces and the gradient of L."""
    if is_lowered(derivation) or derivation.layout.size > LARGEST:
        return None
    motion, numbers = derivation.motion, jax.tree.map(jnp.asarray, eqx.filter(params, eqx.is_array_like))
    slope = jax.grad(motion.lagrangian)
    functions: dict[str, Callable | None] = {"given_force": motion.forces, "lagrangian_by_q": slope}
    states, times = _states_ahead(ended, np.concatenate([halves(ended.y)[1], np.zeros(derivation.layout.size)]))
    values = {
        name: np.stack(
            [function(*halves(jnp.asarray(y)), jnp.asarray(t), numbers) for y, t in zip(states, times, strict=True)]
        )
        for name, function in functions.items()
        if function is not None and _is_short(function, (*halves(ended.y), ended.t, numbers))
    }
    return _first_undefined(derivation.layout, ended, states, times, values)


def _first_undefined(layout: Layout, ended: Ended, y, t, values: dict[str, np.ndarray]) -> Undefined | None:
    along = 1 + len(AHEAD)
    for row in range(along):
        for name, what, role in _QUANTITIES:
            if name not in values or not values[name][row].size:
                continue
            numbers = _coordinate_values(name, values[name])
            bad = ~np.isfinite(numbers[row])
            if bad.any():
                by_time = bool(row and not np.isfinite(numbers[row - 1 + along][bad]).any())
                names = tuple(name for name, is_bad in zip(layout.names, bad, strict=True) if is_bad)
                shown = tuple(float(x) for x in numbers[row][bad])
                return Undefined(what, role, names, shown, y[row], float(t[row]), row > 0, by_time)
    return None


def _coordinate_values(name: str, values: np.ndarray) -> np.ndarray:
    """Values (S, n) as they are; of matrices (S, n, n) one number a column: 0 where the column is finite, else NaN."""
    if values.ndim == 2:
        return values
    return np.where(np.isfinite(values).all(axis=1), 0.0, np.nan)


def _describe_undefined(undefined: Undefined) -> str:
    quantities = join_names([f"{n} ({x})" for n, x in zip(undefined.names, undefined.values, strict=True)])
    since = f", from t = {undefined.t:.9g} on, whatever the state" if undefined.by_time else ""
    return f"Not finite {'just ahead' if undefined.ahead else 'there'}: {undefined.what} {quantities}{since}"


def _line(derivation: Derivation, params, undefined: Undefined) -> str:
    """The operation to blame, and its line, as the end of a sentence."""
    arguments = (*halves(undefined.y), undefined.t, eqx.filter(params, eqx.is_array_like))
    offender = _offender(_function(derivation, undefined.role), arguments, undefined.role)
    return "" if offender is None else f". It comes from {offender}"


def _offender(function: Callable | None, arguments: tuple, role: str) -> Offender | None:
    if function is None or not _is_short(function, arguments):
        return None
    found = offenders(function, *arguments, derivatives=role != "forces")
    return found[0] if found else None


def _function(derivation: Derivation, role: str) -> Callable | None:
    motion = derivation.motion
    if role == "constraints":
        on = motion.constraints.on_positions
        return None if on is None else lambda q, qdot, t, params: on(q, t, params)
    return getattr(motion, role)


def _is_short(function: Callable, arguments: tuple) -> bool:
    """True if a function has few enough equations to be gone through one by one."""
    return _equations(jax.make_jaxpr(function)(*arguments).jaxpr) <= LONGEST


def _equations(jaxpr) -> int:
    count = 0
    for equation in jaxpr.eqns:
        inner = [x for x in equation.params.values() if hasattr(x, "eqns") or hasattr(x, "jaxpr")]
        count += 1 + sum(_equations(getattr(x, "jaxpr", x)) for x in inner)
    return count


# ---- where it runs to ------------------------------------------------------------------------------------------------


@np.errstate(all="ignore")
def _singular_mass(derivation: Derivation, ended: Ended) -> str:
    """A sentence where an eigenvalue of M has come down to next to nothing on the way; for scenes without constraints.

    With constraints M may be singular where they hold what L does not.
    """
    if derivation.motion.constrained:
        return ""
    try:
        y, t = np.stack([ended.y_first, ended.y]), np.array([ended.t_first, ended.t])
        first, last = Sample.from_states(derivation, y, t, ended.numbers).quantities("mass_matrix")["mass_matrix"]
    except Unlowerable:
        return ""
    if not np.isfinite([first, last]).all():
        return ""
    (before, _), (after, vectors) = eigen(first), eigen(last)
    place = int(np.argmin(np.abs(after)))
    usual, left = np.abs(before).min(), np.abs(after[place])
    # A mass matrix of which all has shrunk is a change of units on the way, and no pole.
    if not left < SINGULAR * usual or (len(last) > 1 and np.abs(last).max() < SINGULAR * np.abs(first).max()):
        return ""
    names = derivation.layout.names
    along = [f"d{name}" for name, c in zip(names, vectors[:, place], strict=True) if abs(c) > 0.1]
    return (
        f"The mass matrix is nearly singular there: along {join_names(along)} it has come down from {usual:.1e} to "
        f"{left:.1e}. The coordinates are singular where the motion went (polar ones at r = 0, spherical ones and "
        "Euler angles at a pole), or the kinetic energy vanishes: use coordinates that are regular there."
    )


def _describe_null(mass: np.ndarray, names: tuple[str, ...]) -> str:
    """The coordinates, or their combinations, that carry no kinetic energy."""
    unused = [name for name, row in zip(names, mass, strict=True) if not row.any()]
    if unused:
        return (
            f"Singular there: L has no kinetic energy in the velocity of {', '.join(unused)} (absent from L, or linear "
            "in it)."
        )
    combinations = []
    for direction in null_directions(mass):
        direction = direction / direction[np.argmax(np.abs(direction))]
        terms = [f"{c:+.3g} d{name}" for c, name in zip(direction, names, strict=True) if abs(c) > 1e-6]
        combinations.append(" ".join(terms))
    if not combinations:
        return (
            "It is regular there, but not positive definite, and more than two coordinates are solved for without "
            "pivoting: turn the sign of L, or give path='array' to System."
        )
    return f"Singular there: no kinetic energy along {'; '.join(combinations)}."


@np.errstate(all="ignore")
def _running_away(derivation: Derivation, ended: Ended) -> int | None:
    """The coordinate that runs away, to a pole or to infinity; None where none does."""
    if _CODES[ended.code] not in ("dt_min_reached", "nonfinite_state"):
        return None
    try:
        acceleration = np.abs(_acceleration(derivation, ended))
    except Unlowerable:
        return None
    _, velocity = halves(np.abs(ended.y))
    if not np.isfinite(acceleration).all() or not acceleration.any():
        return None
    fastest = int(np.argmax(acceleration))
    scale = velocity[fastest] / acceleration[fastest]
    part = RUNAWAY if derivation.layout.dtype == np.float64 else RUNAWAY_SINGLE
    return fastest if scale < part * abs(ended.t_last - ended.t_first) and velocity[fastest] > 0 else None


def _escape(derivation: Derivation, ended: Ended, place: int, pole: Offender | None) -> str:
    """The place that a coordinate runs away to; `pole` is the operation that is near one, where that is known."""
    name, (q, v), (q_first, v_first) = derivation.layout.names[place], halves(ended.y), halves(ended.y_first)
    grown = f"its velocity was {v_first[place]:.3g} at the start and is {v[place]:.3g} where {name} = {q[place]:.3g}"
    if pole is not None:
        return (
            f"The acceleration of {name} grows without bound, near a pole of {pole.name}({pole.operands}){pole.place}: "
            f"{grown}. Keep the motion away from there, by other initial values or an event=..., or give the force a "
            "finite core."
        )
    far = np.abs(q).max() > ESCAPED * np.abs(q_first).max()
    if not far and np.abs(v[place]) * abs(ended.t - ended.t_first) < ESCAPED * np.abs(q[place] - q_first[place]):
        return (
            f"The acceleration of {name} grows without bound, and its velocity does not: {grown}. The force has a pole "
            "there: keep the motion away from it, by other initial values or an event=..., or give the force a finite "
            "core."
        )
    return (
        f"{name if far else f'The velocity of {name}'} runs to infinity within a finite time: {grown}. The force grows "
        "faster than in proportion to the state, as that of q' = q**2 or of a collision does: look at its sign, or end "
        "ts before."
    )


def _pole(derivation: Derivation, params, ended: Ended) -> Offender | None:
    """The first operation of the force or of L that is next to a pole at the end of the motion."""
    arguments = (*halves(ended.y), ended.t, eqx.filter(params, eqx.is_array_like))
    for role in ("forces", "lagrangian"):
        function = getattr(derivation.motion, role)
        if function is not None and _is_short(function, arguments) and (near := poles(function, *arguments)):
            return near[0]
    return None


# ---- what else there is ----------------------------------------------------------------------------------------------

# Findings of `check` that explain why steps became short, in the order in which they are reported.
_EXPLAIN = (
    "kink", "derivative_not_finite", "discontinuity", "coordinate_singularity", "near_coordinate_singularity",
    "singular_at_velocity", "wrong_derivative", "acceleration_not_finite", "creates_energy", "stiff",
)  # fmt: skip


def _run_check(system: System, derivation: Derivation, state, params, ended: Ended) -> str:
    """The first finding of `check` at the end that explains the failure."""
    if derivation.layout.size > (LARGEST if is_lowered(derivation) else 16):
        return ""
    q, qdot = state
    found = {finding.kind: finding for finding in reversed(list(check(system, q, qdot, ended.t, params)))}
    kinds = (*_EXPLAIN, "border") if _CODES[ended.code] == "acceleration_discontinuous" else _EXPLAIN
    kind = next((kind for kind in kinds if kind in found), None)
    if kind is None:
        return ""
    where = _borders(derivation, params, ended) if kind == "border" else ""
    return f"\nThere check says: {found[kind].message}{where}{_budget(ended)}"


def _borders(derivation: Derivation, params, ended: Ended) -> str:
    """A sentence about the operations at which the force and L are pieced together."""
    arguments = (*halves(ended.y), ended.t, eqx.filter(params, eqx.is_array_like))
    functions = [f for f in (derivation.motion.forces, derivation.motion.lagrangian) if f is not None]
    functions = [f for f in functions if _is_short(f, arguments)]
    places = list(dict.fromkeys(f"{name}{place}" for f in functions for name, place, _ in pieces_of(f, *arguments)))
    return f" The scene is pieced together by {join_names(places, 3)}." if places else ""


def _budget(ended: Ended) -> str:
    """The time that was reached when the budget of steps was spent."""
    reached, whole = abs(ended.t - ended.t_first), abs(ended.t_last - ended.t_first)
    crossed = _CODES[ended.code] == "acceleration_discontinuous" and ended.steps > MANY
    if not (crossed or _CODES[ended.code] == "max_steps_reached") or not reached > 0:
        return ""
    needed = ended.steps * whole / reached
    return (
        f"\n{ended.steps} steps led over {reached:.3g} of {whole:.3g}, {reached / ended.steps:.1e} each: at that rate "
        f"the whole takes some {float(f'{needed:.1e}'):.9g}."
    )


def _acceleration(derivation: Derivation, ended: Ended) -> np.ndarray:
    """q̈ (n,) at the end."""
    return Sample.from_states(derivation, ended.y[None], ended.t, ended.numbers).acceleration()[0]


# ---- of a trajectory -------------------------------------------------------------------------------------------------


def motion_end(
    trajectory: Trajectory, layout: Layout, member: tuple[int, ...] = (), numbers: np.ndarray | None = None
) -> Ended:
    """The end of a trajectory, or of one member of a batch, and where it began; `numbers` (P,) are its parameters."""

    def flatten_member(tree, *index):
        leaves = [numbers_at(leaf, (*member, *index)) for leaf in jax.tree.leaves(tree)]
        return np.concatenate([np.ravel(leaf) for leaf in leaves]).astype(layout.dtype)

    ts, end = np.asarray(trajectory.ts), trajectory.end
    ts = ts[member[: ts.ndim - 1]]
    code, t, steps = (np.asarray(x)[member] for x in (trajectory.result._value, end.t, trajectory.stats["num_steps"]))
    if numbers is None:
        numbers = np.array(numbers_of(eqx.filter(trajectory.params, eqx.is_array_like)), layout.dtype)
    y, y_first = flatten_member((end.q, end.qdot)), flatten_member((trajectory.q, trajectory.qdot), 0)
    by_resets = trajectory.transitions is not None
    return Ended(int(code), float(t), y, float(ts[-1]), float(ts[0]), y_first, int(steps), numbers, by_resets)
