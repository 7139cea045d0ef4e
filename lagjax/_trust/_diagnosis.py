"""`diagnose`: sentences on why a motion failed, from its first and its last state.

`_stop_reason` gives a failure its code, from numbers alone and for every member of a batch. Here one motion is
explained to the author of the scene: which force is not finite and from when on, the operation and the line of code
that it comes from, a pole that was reached, a mass matrix that has become singular, an escape to infinity, and what
`check` finds at the last state: a kink, a jump, stiff terms.

All but the line and `check` uses the scene's scalar programs in NumPy, which compiles nothing. These two have limits,
`LONGEST_FUNCTION` and `LARGEST_CHECKED`: a failure must not cost more than a motion does.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import AHEAD
from lagjax._equations import (
    CoupledForces,
    Derivation,
    Motion,
    Sample,
    derivation_of,
    describe_decisions,
    eigen,
    find_offenders,
    find_poles,
    forms,
    null_directions,
    numbers_of,
    sparse_spectrum,
)
from lagjax._interface import RESULTS, Layout, code_of, halves, join_names, not_finite, numbers_at
from lagjax._primitives import sentence
from lagjax._program import MOST_COUPLED, Unlowerable
from lagjax._run import Trajectory
from lagjax._scene import FlatContacts, System
from lagjax._trust.checks import check, describe_direction

LONGEST_FUNCTION = 4000  # equations of a function up to which they are gone through one by one: some 50 µs each
# A motion that runs away does so on a time scale |q̇|/|q̈| (or |q|/|q̇|) that has shrunk to less than this part of the
# whole: steps have shrunk to 1e-15 of it when they are given up, and smooth motions are followed to 1e-5 in the budget.
RUNAWAY = 1e-8
RUNAWAY_SINGLE = 3e-6  # of float32, whose steps are given up at 5e-7 of the whole
SINGULAR = 1e-9  # the part of its first value to which an eigenvalue of M has come down where M is called singular
# Steps beyond which a budget was spent on crossing borders: one that no step fits over is given up within a hundred
# after those that led there. Twice as many say the same of most scenes.
MANY_CROSSINGS = 1000
ESCAPED = 1e3  # times its largest coordinate at the start: a motion to infinity

_CODES = {
    code_of(getattr(RESULTS, name)): name
    for name in ("nonfinite_state", "dt_min_reached", "max_steps_reached", "acceleration_discontinuous")
}
_OVERSTEPPED = (
    "The state itself is not finite, from the first output on that is NaN: a step of a fixed length does not stop "
    "where the motion does. Leave dt out, and the message says what it runs into."
)
_NO_MULTIPLIERS = (
    ". No multipliers satisfy the law of forces there, or several do (Painlevé's paradox, or constraints that depend "
    "on each other): take less friction, or independent constraints"
)
_TOUCHES = 1e-9  # of the largest coordinate, or velocity: a gap of which rounding is left
_AT_CORNER = (
    "A constraint has a corner there: its gradient jumps, and no law says with what velocities the motion continues. "
    "Round the corner off over a width w that the motion resolves, as in jnp.sqrt(x**2 + w**2) for abs(x)."
)


class MotionEnd(NamedTuple):
    """The first and the last state (2n,) of one motion in NumPy, with their times, and its parameters."""

    code: int
    t: float
    y: np.ndarray
    t_last: float
    t_first: float
    y_first: np.ndarray
    steps: int
    numbers: np.ndarray
    by_resets: bool = False  # whether the states of a hybrid motion are reset on the way
    scene: tuple | None = None  # a large scene and its parameters, which XLA evaluates

    def sample(self, derivation: Derivation, y: np.ndarray, t) -> Sample:
        """Return a `Sample` of the scene at states y (S, 2n) and times t, with this motion's parameters."""
        return Sample.from_states(derivation, y, t, self.numbers)._replace(scene=self.scene)


def describe_failure(trajectory: Trajectory, layout: Layout, why: str | None) -> str:
    """Return the whole message of a single motion that failed: its result code, last state and diagnosis."""
    end, system = trajectory.end, trajectory.system
    y_end = np.concatenate([layout.flatten(end.q), layout.flatten(end.qdot)])
    message = sentence(trajectory.result._value, end.t, trajectory.ts[-1], y_end, layout.names, why) or ""
    if not isinstance(system, System):
        return message
    ended, params = motion_end(trajectory, layout), trajectory.params
    if trajectory.result == RESULTS.mass_matrix_singular:
        derivation = derivation_of(system, layout, params)
        if not derivation.form.is_sparse:
            mass = np.asarray(system.mass_matrix(end.q, end.qdot, end.t, params))
            unused = [name for name, row in zip(layout.names, mass, strict=True) if not row.any()]
            directions = [] if unused else null_directions(mass)
        else:
            rows = Sample.from_scene(system, layout, *halves(ended.y[None]), ended.t, params).quantities("mass_by_some")
            unused = [layout.names[i] for i in np.flatnonzero(rows["mass_by_some"][0] == 0)]
            state = *halves(ended.y), ended.t, eqx.filter(params, eqx.is_array_like)
            spectrum = None if unused else sparse_spectrum(derivation, state)
            directions = [] if spectrum is None else [spectrum[0][1]]
        message += f"\n{_describe_null(unused, directions, layout.names)}"
    return message + diagnose(system, layout, params, ended)


def diagnose(system: System, layout: Layout, params, ended: MotionEnd) -> str:
    """Return what is known about a failure, as text that begins with a line break; "" if nothing is."""
    try:
        undefined, closed = _describe_gaps(system, layout, params, ended)
        if undefined or ended.code not in _CODES:
            return undefined
        return _find_cause(system, layout, params, ended) + closed
    except Exception as error:  # the message of the failure itself must come out
        return f"\n(No more is known about it: {type(error).__name__}.)"


def _find_cause(system: System, layout: Layout, params, ended: MotionEnd) -> str:
    derivation = derivation_of(system, layout, params)
    if derivation.form.is_sparse:
        ended = ended._replace(scene=(system, params))
    q0, qdot0 = map(layout.restore, halves(ended.y_first))
    of_start = [] if np.isfinite(ended.y).all() else not_finite(q0, "q0") + not_finite(qdot0, "qdot0")
    if bad := not_finite(params, "params") + of_start:
        where, value = bad[0]
        return f"\n{where} is {value}: every number must be finite."
    if not np.isfinite(ended.y).all():
        if np.isfinite(halves(ended.y)[0]).all() and derivation.kicks:
            return f"\n{_AT_CORNER}"
        return f"\n{_reset_to_nothing(layout, ended) if ended.by_resets else _OVERSTEPPED}"
    text = _describe_undefined(system, derivation, params, ended) or _describe_singular_mass(derivation, ended)
    if not text and (at := _describe_runaway(derivation, ended)) is not None:
        text = _escape_place(system, derivation, params, ended, at)
    return f"\n{text}" if text else _run_check(system, derivation, params, ended) or _budget_end(ended)


def _describe_gaps(system: System, layout: Layout, params, ended: MotionEnd) -> tuple[str, str]:
    """Return a sentence on the first gap or one-way velocity that is not finite at the end; one on closed contacts."""
    if not system.touches or not np.isfinite(ended.y).all():
        return "", ""
    q, qdot = map(layout.restore, halves(ended.y))
    called, touching = ((system.contacts, (q,), 0), (system.one_way, (q, qdot), 1)), []
    names = iter(system.contact_names(layout, params))
    for function, state, part in called:
        values = jax.tree.leaves(function(*state, t=ended.t, params=params) if function else ())
        for value in np.concatenate([np.zeros(0), *map(np.ravel, values)]):
            name = next(names)
            if not np.isfinite(value):
                return f"\nThe gap {name} is {value} there: contacts and one_way must return finite numbers.", ""
            if abs(value) <= _TOUCHES * np.abs(halves(ended.y)[part]).max():
                touching.append(name)
    if not touching:
        return "", ""
    law = _NO_MULTIPLIERS if system.reads_multipliers and _CODES.get(ended.code) == "nonfinite_state" else ""
    return "", f"\nIn touch there: {join_names(touching)}, whose gaps and slips may have corners as L has{law}."


def _reset_to_nothing(layout: Layout, ended: MotionEnd) -> str:
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
_OF_LARGE = {"mass_matrix": "mass_by_some", "jacobian": "jacobian_columns"}  # sums over the rows, or columns


def _states_ahead(ended: MotionEnd, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return states (S, 2n) and times (S,): the last, some a few round-offs later, and some with only t advanced."""
    smallest = 4 * np.finfo(ended.y.dtype).eps * max(abs(ended.t_first), abs(ended.t_last))
    steps = np.array([0.0, *AHEAD]) * np.copysign(smallest, ended.t_last - ended.t_first)
    moved = ended.y + steps[:, None] * np.where(np.isfinite(rate), rate, 0.0)
    alone = np.broadcast_to(ended.y, (len(AHEAD), len(ended.y)))
    return np.concatenate([moved, alone]), ended.t + np.concatenate([steps, steps[1:]])


@np.errstate(all="ignore")
def _quantities_ahead(derivation: Derivation, numbers, ended: MotionEnd) -> tuple[np.ndarray, np.ndarray, dict]:
    """Return states, times and quantities there by name; without scalar programs, only forces and ∂L/∂q, by JAX."""
    (_, v), motion, values = halves(ended.y), derivation.motion, {}
    try:
        y, t = _states_ahead(ended, np.concatenate([v, _end_acceleration(derivation, ended)]))
        names = {name: name if ended.scene is None else _OF_LARGE.get(name, name) for name, *_ in _QUANTITIES}
        of = ended.sample(derivation, y, t).quantities(*names.values())
        return y, t, {name: of[there] for name, there in names.items()}
    except Unlowerable:
        y, t = _states_ahead(ended, np.concatenate([v, np.zeros(len(v))]))
    for name, function in (("given_force", motion.forces), ("lagrangian_by_q", jax.grad(motion.lagrangian))):
        state = *halves(ended.y), ended.t, numbers
        if function is not None and len(v) <= forms.LARGEST_CHECKED and _is_short(function, state):
            found = [function(*map(jnp.asarray, (*halves(y[k]), t[k])), numbers) for k in range(len(y))]
            values[name] = np.stack(found)
    return y, t, values


def _describe_undefined(system: System, derivation: Derivation, params, ended: MotionEnd) -> str:
    """Return a sentence on the first quantity that is not finite at the end or just after it; "" if none is."""
    numbers, along = eqx.filter(params, eqx.is_array_like), 1 + len(AHEAD)
    y, t, values = _quantities_ahead(derivation, numbers, ended)
    for row in range(along):
        for name, what, role in _QUANTITIES:
            of = values.get(name, np.zeros((len(y), 0)))
            # Of a matrix one number a column: 0 where the column is finite, else NaN.
            of = of if of.ndim == 2 or not of.size else np.where(np.isfinite(of).all(axis=1), 0.0, np.nan)
            bad = np.flatnonzero(~np.isfinite(of[row]))
            if bad.size:
                shown = join_names([f"{derivation.layout.names[i]} ({of[row, i]})" for i in bad])
                by_time = row and not np.isfinite(of[row - 1 + along, bad]).any()
                since = f", from t = {t[row]:.9g} on, whatever the state" if by_time else ""
                motion = system._motion(derivation.layout, params)
                offender = _blame_operation(motion, role, (*halves(y[row]), float(t[row]), numbers))
                return f"Not finite {'just ahead' if row else 'there'}: {what} {shown}{since}{offender}."
    return ""


def _blame_operation(motion: Motion, role: str, arguments: tuple) -> str:
    """Return ". It comes from …": the operation and line that are not finite in a function of the scene; or ""."""
    function, on = getattr(motion, role), motion.constraints.on_positions
    if role == "constraints":
        function = on and (lambda q, qdot, t, params: on(q, t, params))
    if function is None or not _is_short(function, arguments):
        return ""
    to_blame = find_offenders(function, *arguments, derivatives=role != "forces")
    if isinstance(function, CoupledForces) and to_blame and not to_blame[0].place:
        return _NO_MULTIPLIERS
    return f". It comes from {to_blame[0]}" if to_blame else ""


def _short_functions(system: System, layout: Layout, params, ended: MotionEnd) -> tuple[list[Callable], tuple]:
    """Return the forces and L, those given and at most `LONGEST_FUNCTION` long, and their arguments at the end."""
    # The functions of this very system: its derivation may be that of another one, whose text stands in another line.
    motion = system._motion(layout, params)
    arguments = *halves(ended.y), ended.t, eqx.filter(params, eqx.is_array_like)
    return [f for f in (motion.forces, motion.lagrangian) if f is not None and _is_short(f, arguments)], arguments


def _is_short(function: Callable, arguments: tuple) -> bool:
    return _equations_at_end(jax.make_jaxpr(function)(*arguments).jaxpr) <= LONGEST_FUNCTION


def _equations_at_end(jaxpr) -> int:
    count = 0
    for equation in jaxpr.eqns:
        inner = [x for x in equation.params.values() if hasattr(x, "eqns") or hasattr(x, "jaxpr")]
        count += 1 + sum(_equations_at_end(getattr(x, "jaxpr", x)) for x in inner)
    return count


# ---- where it runs to ------------------------------------------------------------------------------------------------


@np.errstate(all="ignore")
def _describe_singular_mass(derivation: Derivation, ended: MotionEnd) -> str:
    """Return a sentence if an eigenvalue of M has become almost zero between the first and the last state."""
    if derivation.motion.constrained:  # which may hold what L does not
        return ""
    try:
        y, t = np.stack([ended.y_first, ended.y]), np.array([ended.t_first, ended.t])
        name = "mass_matrix" if ended.scene is None else "mass_diagonal"
        first, last = ended.sample(derivation, y, t).quantities(name)[name]
    except Unlowerable:
        return ""
    if not np.isfinite([first, last]).all():
        return ""
    if ended.scene is not None:
        place = int(np.argmin(np.abs(last / first)))
        direction, usual = np.arange(len(last)) == place, np.abs(first[place])
        left = np.abs(last[place])
    else:
        (before, _), (after, vectors) = eigen(first), eigen(last)
        place = int(np.argmin(np.abs(after)))
        direction, usual, left = vectors[:, place], np.abs(before).min(), np.abs(after[place])
    # A mass matrix of which all has shrunk is a change of units on the way, and no pole.
    if not left < SINGULAR * usual or (len(last) > 1 and np.abs(last).max() < SINGULAR * np.abs(first).max()):
        return ""
    names = derivation.layout.names
    along = [f"d{name}" for name, c in zip(names, direction, strict=True) if abs(c) > 0.1]
    return (
        f"The mass matrix is nearly singular there: along {join_names(along)} it has come down from {usual:.1e} to "
        f"{left:.1e}. The coordinates are singular where the motion went (polar ones at r = 0, spherical ones and "
        "Euler angles at a pole), or the kinetic energy vanishes: use coordinates that are regular there."
    )


def _describe_null(unused: list[str], directions, names: tuple[str, ...]) -> str:
    """Return a sentence on the coordinates, or their combinations, that carry no kinetic energy."""
    if unused:
        return (
            f"Singular there: L has no kinetic energy in the velocity of {join_names(unused)} (absent from L, or "
            "linear in it)."
        )
    combinations = [describe_direction(direction, names) for direction in directions]
    if not combinations:
        return (
            "It is regular there, but not positive definite, and more than two coordinates are solved for without "
            "pivoting: turn the sign of L, or give path='array' to System."
        )
    return f"Singular there: no kinetic energy along {'; '.join(combinations)}."


@np.errstate(all="ignore")
def _describe_runaway(derivation: Derivation, ended: MotionEnd) -> int | None:
    """Return the index of the coordinate that diverges, to a pole or to infinity; None if none does."""
    if _CODES[ended.code] not in ("dt_min_reached", "nonfinite_state"):
        return None
    try:
        acceleration = np.abs(_end_acceleration(derivation, ended))
    except Unlowerable:
        return None
    _, velocity = halves(np.abs(ended.y))
    if not np.isfinite(acceleration).all() or not acceleration.any():
        return None
    fastest = int(np.argmax(acceleration))
    scale = velocity[fastest] / acceleration[fastest]
    part = RUNAWAY if derivation.layout.dtype == np.float64 else RUNAWAY_SINGLE
    return fastest if scale < part * abs(ended.t_last - ended.t_first) and velocity[fastest] > 0 else None


def _escape_place(system: System, derivation: Derivation, params, ended: MotionEnd, place: int) -> str:
    """Return a sentence on where coordinate number `place` diverges to: a pole of the force or L, or infinity."""
    functions, arguments = _short_functions(system, derivation.layout, params, ended)
    pole = next((near for function in functions for near in find_poles(function, *arguments)), None)
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


# ---- what else there is ----------------------------------------------------------------------------------------------

# Findings of `check` that explain why steps became short, in the order in which they are reported.
_EXPLAIN = (
    "kink", "derivative_not_finite", "discontinuity", "coordinate_singularity", "near_coordinate_singularity",
    "singular_at_velocity", "wrong_derivative", "acceleration_not_finite", "creates_energy", "stiff",
)  # fmt: skip


def _run_check(system: System, derivation: Derivation, params, ended: MotionEnd) -> str:
    """Return a sentence with the first finding of `check` at the end that explains the failure."""
    jumps = _CODES[ended.code] == "acceleration_discontinuous"
    if jumps and (unheld := _count_unheld(derivation)):
        return (
            f"\nIt may rest, or slide, along {unheld} borders there, which dry friction makes: machine code follows at "
            f"most {MOST_COUPLED} that M couples to each other, and none that change differently what others hold. "
            "Round sign(v) off, as jnp.tanh(v / w) with a speed w that does not matter."
        )
    largest = forms.LARGEST_CHECKED if derivation.is_lowered else forms.LARGEST_CHECKED_BY_XLA
    if ended.scene is None and derivation.layout.size > largest:
        return ""
    q, qdot = map(derivation.layout.restore, halves(ended.y))
    found = {finding.kind: finding for finding in reversed(list(check(system, q, qdot, ended.t, params)))}
    if (kind := next((kind for kind in _EXPLAIN if kind in found), None)) is not None:
        return f"\nThere check says: {found[kind].message}{_budget_end(ended)}"
    functions, arguments = _short_functions(system, derivation.layout, params, ended)
    if system.touches:
        flat = FlatContacts.from_system(system, derivation.layout, params)
        of_contacts = (lambda q, qdot, t, p: flat.gaps(q, t, p)), flat.one_way, flat.slips
        functions += [f for f in of_contacts if _is_short(f, arguments)]
    pieces = describe_decisions(functions, arguments) if jumps else ""
    return f"\nThe scene is pieced together by {pieces}.{_budget_end(ended)}" if pieces else ""


def _count_unheld(derivation: Derivation) -> int:
    """Return how many borders the motion could slide along without machine code following that."""
    try:
        return 0 if derivation.lowered.borders is None else derivation.lowered.borders.holding.unheld
    except Unlowerable:
        return 0


def _budget_end(ended: MotionEnd) -> str:
    """Return a sentence on the time that was reached when the maximum number of steps was used up."""
    reached, whole = abs(ended.t - ended.t_first), abs(ended.t_last - ended.t_first)
    crossed = _CODES[ended.code] == "acceleration_discontinuous" and ended.steps > MANY_CROSSINGS
    if not (crossed or _CODES[ended.code] == "max_steps_reached") or not reached > 0:
        return ""
    needed = ended.steps * whole / reached
    return (
        f"\n{ended.steps} steps led over {reached:.3g} of {whole:.3g}, {reached / ended.steps:.1e} each: at that rate "
        f"the whole takes some {float(f'{needed:.1e}'):.9g}."
    )


def _end_acceleration(derivation: Derivation, ended: MotionEnd) -> np.ndarray:
    """Return q̈ (n,) at the end."""
    return ended.sample(derivation, ended.y[None], ended.t).acceleration()[0]


# ---- of a trajectory -------------------------------------------------------------------------------------------------


def motion_end(
    trajectory: Trajectory, layout: Layout, member: tuple = (), numbers: np.ndarray | None = None
) -> MotionEnd:
    """Return the `MotionEnd` of a trajectory, or of one member of a batch; `numbers` (P,) are its parameters."""

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
    return MotionEnd(int(code), float(t), y, float(ts[-1]), float(ts[0]), y_first, int(steps), numbers, by_resets)
