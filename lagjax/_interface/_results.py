"""The outcomes of a trajectory: result codes, their messages and advice, and the exception `SimulationError`.

The codes are those of diffrax, by the same names and numbers, and ours. They travel inside `jit` and `vmap` as arrays,
one per member of a batch; only `simulate` turns one into an exception.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

_TO_REST = (
    "let it come to rest in a mode whose constraint holds it. That transition stands in the list before the bounce and "
    "has its surface: Transition('flight', 'rest', lambda q, v: jnp.where(v > -0.01, q, 1.0), -1, lambda q, v: "
    "(0 * q, 0 * v))."
)
PUSHED = (
    "The guard is pushed at its surface: the reset leaves the motion there, at rest, and nothing holds it, so that the "
    f"transition is due again at once. No budget of transitions leads beyond it: {_TO_REST}"
)


class _WordedEnum(type(eqx.Enumeration)):
    def __getitem__(cls, item) -> str:
        """Return the message of a result, or its name if it has none; of an array of results, counts by name."""
        code = item._value
        if isinstance(code, Tracer) or not isinstance(code, np.ndarray | jax.Array):
            return super().__getitem__(item)
        if np.ndim(code) == 0:
            return super().__getitem__(item) or name_of(code)
        return ", ".join(
            f"{count} {name_of(value)}" for value, count in zip(*np.unique(code, return_counts=True), strict=True)
        )


class RESULTS(eqx.Enumeration, metaclass=_WordedEnum):  # pyright: ignore[reportGeneralTypeIssues]
    """The result codes of diffrax, extended; compare with `trajectory.result == lagjax.RESULTS.successful`."""

    __module__ = "lagjax"  # as it is printed

    # Those of diffrax, in their order; a subclass of `diffrax.RESULTS` would import diffrax for every motion, which
    # takes half as long as JAX. Those that only its solvers return are told in `_engine/diffrax/_integrate`.
    successful = ""
    max_steps_reached = "The budget of steps was spent."
    singular = "A linear equation of an implicit step is singular."
    breakdown = "An iterative solution of a linear equation of an implicit step broke down."
    stagnation = "An iterative solution of a linear equation of an implicit step stagnated."
    conlim = "A linear equation of an implicit step is nearly singular."
    nonfinite_input = "A linear equation of an implicit step holds NaN or an infinite number."
    nonlinear_max_steps_reached = "The equation of an implicit step was not solved in its budget of iterations."
    nonlinear_divergence = "The iteration for the equation of an implicit step diverged."
    nonfinite = "The iteration for the equation of an implicit step met NaN or an infinite number."
    dt_min_reached = "The step size shrank to nothing."
    event_occurred = "An event ended the motion."
    max_steps_rejected = "The budget of rejected steps that a controller of diffrax remembers was spent."
    internal_error = (
        "A solver of diffrax failed in a way that its author holds to be impossible: please report it there."
    )
    nonfinite_state = (
        "The state or its acceleration is NaN or infinite there, or just ahead. Look at the gaps of contacts, the "
        "Lagrangian, its gradient, the forces and the parameters at that time and state: a root or norm at zero, a "
        "logarithm of a negative number, a branch of `where` that is not taken, knots of a look-up that do not "
        "increase, an integer beyond its type or beyond 2**53, which JAX wraps around."
    )
    acceleration_discontinuous = (
        "The acceleration has a jump or a corner there, and the budget of steps was spent on such places, or no step "
        "fits over it. Where the motion merely crosses them, as one that is switched fast does, raise max_steps: each "
        "takes a step of machine code, and some forty of diffrax. Where it rests on one, as on abs(q) at zero or, with "
        "a solver of diffrax, by dry friction, make its two sides modes of a lagjax.Hybrid, or round it off over a "
        "width that steps resolve."
    )
    derivatives_lost = (
        "The acceleration jumps on the way, where the steps of diffrax go across: a derivative over these steps lacks "
        "what the jump adds, and is another one. Machine code ends a step there and has it: leave solver at None, in "
        "float64 on a CPU (`System.explain` says why a scene is not for it). Or make the two sides modes of a "
        "lagjax.Hybrid, or round the jump off over a width that steps resolve, tanh(v / w) for sign(v)."
    )
    max_transitions_reached = (
        "The budget of transitions was spent. Raise max_transitions (of crossings it is fixed), or end ts earlier."
    )
    max_crossings_reached = "There are more crossings after that than room for them. Raise `count`, or end ts earlier."
    zeno = (
        "Transitions follow each other at ever shorter times that add up to a finite one (Zeno), as the bounces of a "
        "ball do, or at once, as where it lies on the floor: no budget of transitions leads beyond it. End ts before "
        f"that time, or {_TO_REST}"
    )
    transitions_in_turn = (
        "Transitions follow each other at one instant, and time does not move: behind each of them the guard of the "
        "next is beyond zero, or goes there. Let the guards leave room between them, as a thermostat's do, or say "
        'fires="crossing" of one that is to wait until it changes sign. What both sides push towards, as a relay does '
        "that rests on its switching line, is one System with sign or where, which slides along it."
    )
    contact_undecided = (
        "The law of contacts has no continuation there, or more than one: with much friction none of open, sliding and "
        "sticking is possible, or several are (Painleve's paradox). Less friction, a contact that gives way (a spring "
        "in its place), or other impacts=... decides it."
    )
    contacts_in_turn = (
        "Contacts open and close, stick and slide, or strike one after the other at one instant without end, and time "
        'does not move. impacts="sequential" may pass an impact on for ever, where "simultaneous" ends it. Else put a '
        "spring in place of a contact among those that lie together, or leave some room between them at the start."
    )
    contact_missed = (
        "A gap is negative that did not fall through zero on its series: it has a corner that no series shows, as "
        "sqrt(x**2) has at x = 0. Write it without a root of squares: r**2 - x**2 for r - sqrt(x**2), or with abs, "
        "maximum, where, whose corners are followed."
    )
    inconsistent_start = (
        "The initial state does not satisfy the constraints, or a gap of contacts= is negative there, or that behind a "
        "transition does not satisfy those of its mode. Put it there first: system.project(q0, qdot0, t, params), a "
        "start with gaps >= 0, or give the transition a reset."
    )
    constraint_rank_lost = (
        "The constraints became dependent on each other, and no longer determine how the motion continues: a dead "
        "point or a branching of the mechanism, or a constraint whose gradient vanishes. Stop before it with "
        "event=..., give the constraint a form whose gradient stays away from zero, or drop one that follows from the "
        "others."
    )
    projection_failed = (
        "The state could not be brought back to its constraints. Look whether they can still be met there: a rod that "
        "is too short, a wire that ends. With fixed steps take a smaller dt. At a dead point of a mechanism, where "
        "constraints are almost dependent, a looser rtol steps across it."
    )
    mass_matrix_singular = (
        "The mass matrix d2L/dqdot2 became singular. Some velocity, or combination of velocities, has no kinetic "
        "energy there: add it, drop the coordinate, or use coordinates that are regular there (polar coordinates are "
        "not at r = 0, spherical ones and Euler angles are not at a pole)."
    )
    contact_at_corner = (
        "A contact is struck, or rests, at a corner or a jump of its gap (abs, minimum, maximum, where, an entry of a "
        "table): the gap has more than one gradient there, and none says in which direction it pushes. Give each side "
        "a gap of its own: contacts a and b for minimum(a, b), the side of a step beside its top. Round off an edge "
        "that sticks out, as that of maximum(a, b). A gap that was off, infinite, must not be negative where it is on "
        "again."
    )
    restitution_out_of_range = "restitution must be between 0 and 1 for every contact: more would add energy."
    friction_out_of_range = "friction must be finite and not negative for every contact."
    contact_backwards = (
        "A scene with contacts goes forward in time: an impact cannot be undone. Let ts increase, also where "
        "they are computed under jax.jit."
    )


def code_of(result: RESULTS) -> int:
    return int(result._value)


SUCCESSFUL = code_of(RESULTS.successful)
EVENT_OCCURRED = code_of(RESULTS.event_occurred)
ENDED_WELL = (SUCCESSFUL, EVENT_OCCURRED)
_STRUCTURE = jax.tree.structure(RESULTS.successful)


def result_from(codes) -> RESULTS:
    return jax.tree.unflatten(_STRUCTURE, [codes if isinstance(codes, jax.Array) else jnp.asarray(codes)])


_NAMES = {int(item._value): name for name, item in RESULTS._name_to_item.items()}


def name_of(code) -> str:
    """Return the name of a result code, an integer: 'nonfinite_state', as in `lagjax.RESULTS`."""
    return _NAMES[int(code)]


def advice(result: RESULTS, is_implicit: bool = False) -> str:
    """Return the message for one concrete result, with advice that depends on whether the solver is implicit."""
    if result == RESULTS.dt_min_reached:
        return (
            "The step size shrank to nothing. The motion runs into a singularity or a discontinuity there (a "
            "collision, a root of a negative number, a force that jumps), or the tolerance is tighter than round-off "
            "allows. Stop before it with event=..., smooth it, or loosen rtol and atol."
        )
    if result == RESULTS.max_steps_reached:
        damped = "" if is_implicit else "use an implicit solver such as diffrax.Kvaerno5() for what is damped, and "
        return (
            "The budget of steps was spent. Raise max_steps or loosen rtol; if the steps are far shorter than the "
            f"motion needs, it is stiff: {damped}make a constraint of what swings fast without damping, as a stiff rod "
            "does."
        )
    return RESULTS[result]


class SimulationError(RuntimeError):
    """A trajectory did not reach its end; `.trajectory` holds what there is of it, None inside transformations."""

    def __init__(self, message, trajectory):
        super().__init__(message)
        self.trajectory = trajectory


def show_str(result, printer, cycle: bool) -> None:
    """Print `str(result)` in IPython: the `_repr_pretty_` of result classes."""
    try:
        text = str(result)
    except Exception:  # a display must not fail, as where `str` has no values to show inside `jax.jit`
        text = repr(result)
    printer.text(text)


def join_names(names: Sequence[str], longest: int = 8) -> str:
    """Return names separated by commas: the first `longest` of them, and how many more there are."""
    return ", ".join(names[:longest]) + (f" and {len(names) - longest} more" if len(names) > longest else "")
