"""`Trajectory`: the result of a simulation, in the user's own pytree.

Time is the first axis of `q` and `qdot`; the members of a batch are an axis before it. Quantities derived from the
states are methods: they cost nothing until they are called, and they are differentiable. Rooms that judge and show a
motion (`_trust`, `_show`) import this one: its methods call them through `_interface._registered`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import AbstractEngine, Problem
from lagjax._equations import has_constraints
from lagjax._interface import (
    ENDED_WELL,
    RESULTS,
    Layout,
    SimulationError,
    flatten_numbers,
    is_concrete,
    is_known,
    registered,
    show_str,
)
from lagjax._primitives import DOUBLE, allows_nan, compute_in_doubles, raise_where_failed
from lagjax._scene import System, describe_violation

if TYPE_CHECKING:
    import lagjax

Number = jax.Array | np.ndarray


EACH = "each"  # in place of axes of params: every motion has its own, as under `jax.vmap(simulate)`


class State(NamedTuple):
    """A time and the state at it."""

    t: jax.Array
    q: PyTree
    qdot: PyTree


class Transitions(NamedTuple):
    """The changes of mode of a hybrid motion, in order: NaN or −1 beyond the last of `count`.

    `t`, `q`, `qdot` are those just before the reset, `q_next` and `qdot_next` just after it; `source` and `target` are
    places in `Trajectory.mode_names`, `number` is that of the transition in the list.
    `order_matters` is true where blows meet at one instant that do not commute: read from its end, the list of
    transitions leads to another state. `let_out`, for each transition of that list: the first time at which its guard
    was beyond zero where a mode began, and came back instead of a blow; NaN where that never was.
    """

    t: jax.Array
    q: PyTree
    qdot: PyTree
    source: jax.Array
    target: jax.Array
    number: jax.Array
    count: jax.Array
    order_matters: jax.Array
    let_out: jax.Array
    q_next: PyTree
    qdot_next: PyTree

    _repr_pretty_ = show_str

    def __repr__(self) -> str:
        def describe(t, source, target):
            return f"{source} → {target} at t = {t:.6g}"

        numbers = self.t, self.source, self.target
        return _list_first(self, "transitions", " between places in mode_names: ", describe, numbers)


class Impacts(NamedTuple):
    """The impacts of a motion with contacts, in order: NaN beyond the last of `count`.

    There is room for `max_transitions` of them; in a batch, outside of `jax.jit`, for no more than its members need.
    `t` (N,) are their times. `impulse`: the normal impulses, in the structure that `contacts` returns with an axis of N
    in front, zero of a contact that took no part. `energy_lost` (N,): the kinetic energy that each took away. Bounces
    that accumulate end in one impact, with all that they would still have given; its time is that of their limit.

    `to_pandas()` makes a table of them.
    """

    t: jax.Array
    impulse: PyTree
    energy_lost: jax.Array
    count: jax.Array

    _repr_pretty_ = show_str

    def __repr__(self) -> str:
        return _list_first(self, "impacts", ", at t = ", lambda t: f"{t:.6g}", (self.t,))

    def to_pandas(self):
        """A `pandas.DataFrame` with a row per impact: the columns impulse['floor'], … and energy_lost.

        The index is `t`, or (member, t) for a batch. Raises `ImportError` when pandas is not installed.
        """
        return registered().impact_frame(self)


def _list_first(record: Any, what: str, joint: str, describe: Callable, numbers: tuple, between: str = ", ") -> str:
    """One line that counts the entries of a record and describes the first ten; the fields of a traced record."""
    count = record.count
    if not (eqx.is_array_like(count) and is_known(count) and all(map(is_known, jax.tree.leaves(numbers)))):
        return f"{type(record).__name__}({', '.join(f'{name}={x!r}' for name, x in record._asdict().items())})"
    count = np.asarray(count)
    if count.ndim:
        return f"{count.sum()} {what} of {' × '.join(map(str, count.shape))} motions"
    listed = [describe(*row) for row in zip(*(np.asarray(x)[: min(count, 10)] for x in numbers), strict=True)]
    listed += [f"… ({count - 10} more)"] if count > 10 else []
    return f"{count} {what}{joint}{between.join(listed)}" if count else f"no {what}"


@jax.tree_util.register_static
class Names(tuple):
    """A tuple of names that is part of a pytree with arrays, under every transformation of JAX."""


CHANGE_WORDS = ("closes", "opens", "bounces", "sticks", "slides")  # in words
_WATCHED = ("gap", "force", "gap", "slip", "friction left")  # what vanishes there


class ContactChanges(NamedTuple):
    """The changes of contacts along a motion, in order: NaN and −1 beyond the last of `count`.

    `t` (N,), `q`, `qdot` are those just before it, `q_next`, `qdot_next` just behind it; `contact` is its place in
    `Trajectory.contact_names`, and `change` is 0 where it closes, 1 where it opens, 2 where it bounces, 3 where it
    sticks, 4 where it slides. Several at one instant lead from one guess to the next. `doubts` (3,) are how many
    impacts gained energy, and how many changes lack derivatives: where contacts that share an impact close at one
    instant by themselves, or bounced less than rounding before it, and where a slip begins at a start at rest (by the
    slip there), or in space; `doubted` (3,) are the first times. `impulse` (N, k) are the normal ones of an impact, in
    the order of `contact_names`, zero without one.

    Printed, they are lines of text: when, what changes and why, by which impulses. `to_pandas()` makes a table of them.
    """

    t: jax.Array
    q: PyTree
    qdot: PyTree
    q_next: PyTree
    qdot_next: PyTree
    contact: jax.Array
    change: jax.Array
    count: jax.Array
    doubts: jax.Array
    doubted: jax.Array
    impulse: jax.Array
    names: tuple[str, ...] = Names()  # `Trajectory.contact_names`

    _repr_pretty_ = show_str

    def __repr__(self) -> str:
        def describe(t, contact, change, impulse, wait):
            why = "is 0" if wait > 0 else "would fall below 0 at once"
            blows = [f"{x:.4g} at {self.names[i]}" for i, x in enumerate(impulse) if x > 1e-12 * impulse.max()]
            more = f"; impulse {', '.join(blows)}" if blows else ""
            return f"t = {t:<10.6g} {self.names[contact]} {CHANGE_WORDS[change]}: its {_WATCHED[change]} {why}{more}"

        numbers = self.t, self.contact, self.change, self.impulse
        if is_known(self.t):
            numbers = *numbers, np.diff(np.asarray(self.t), prepend=-np.inf)
        return _list_first(self, "changes of contacts", ":\n  ", describe, numbers, "\n  ")

    def to_pandas(self):
        """A `pandas.DataFrame` with a row per change: what `contact` it is, the `change` in words, and the states.

        The states have the columns q['x'], …, qdot['x'], … just before it, and q_next['x'], …, qdot_next['x'], … just
        behind it. The index is `t`, or (member, t) for a batch. Raises `ImportError` when pandas is not installed.
        """
        return registered().change_frame(self)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, eq=False)
class RunSettings:
    """The engine of a motion and its options, for further runs of its scene. Compared by value.

    - `engine`: that which integrated it; None if numbers of its solver were traced.
    - `tolerances`: rtol and atol as they were given; None if they were traced.
    - `max_steps`, `max_transitions`: the budgets of a run; `transitions`: those of a `Hybrid`.
    """

    engine: AbstractEngine | None
    tolerances: tuple[float | None, float | None] | None
    max_steps: int
    max_transitions: int | None = None
    transitions: tuple = ()

    @classmethod
    def from_problem(cls, problem: Problem, engine: AbstractEngine, **more: Any) -> "RunSettings":
        known = all(map(is_concrete, jax.tree.leaves(engine)))
        rtol, atol = problem.tolerances
        of_numbers = lambda x: None if x is None else float(x)  # noqa: E731
        given = (of_numbers(rtol), of_numbers(atol)) if is_concrete(rtol) and is_concrete(atol) else None
        return cls(engine if known else None, given, problem.max_steps, **more)

    @functools.cached_property
    def _settings_key(self) -> tuple:
        leaves, structure = jax.tree.flatten(self.engine)
        numbers = [(np.shape(x), np.asarray(x).tobytes()) if eqx.is_array_like(x) else x for x in leaves]
        return structure, *numbers, self.tolerances, self.max_steps, self.max_transitions, self.transitions

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RunSettings) and self._settings_key == other._settings_key

    def __hash__(self) -> int:
        return hash(self._settings_key)


class Trajectory(eqx.Module):
    """The motion of a system at the times `ts`, one trajectory or a batch of them.

    - `ts`: the output times, shape (T,), or (batch, T) where members have times of their own.
    - `q`, `qdot`: the structure of the initial state, with the time axis in front of every leaf, and the batch axis,
      if there is one, in front of that. NaN at times that were not reached.
    - `result`: how each member ended, one of `lagjax.RESULTS`; `ok`: whether it ended well, at the last time or at an
      event.
    - `end`: where each member ended, a `State` of `t`, `q`, `qdot`: at `ts[-1]`, at the event, or at the last accepted
      step before it failed.
    - `stats`: counts of steps, per member: `num_steps`, `num_accepted_steps`, `num_rejected_steps`.
    - `tolerances`: rtol and atol of a step; None where it had a fixed size.
    - `engine`: the engine that integrated it, "MachineCode" or "Diffrax"; "" for a hybrid motion. `settings` are its
      options, for `at`.
    - `mode`, `transitions`: for the motion of a `Hybrid` the mode at every output time and its
      `Transitions`; otherwise None. `system` is then the dict of modes, and quantities are those of the mode at every
      time, NaN where the mode is −1. A mode is a place in `mode_names`, because the dict loses its order in `jax.jit`.
    - `impacts`, `contact_changes`: of a scene with contacts its `Impacts` and all `ContactChanges`, otherwise None;
      `contact_names` names the contacts. `contacts` holds what they did at every output time.
    - `event`: with an `event=`, for each of its functions, in their structure, whether it ended the motion; None
      without one.
    """

    ts: jax.Array
    q: PyTree
    qdot: PyTree
    result: RESULTS
    end: State
    stats: dict[str, jax.Array]
    system: System | dict[str, System]
    params: PyTree
    params_axes: PyTree = eqx.field(static=True, default=EACH)  # how `simulate_batch` mapped over params
    mode: jax.Array | None = None
    transitions: "Transitions | None" = None
    mode_names: tuple[str, ...] = eqx.field(static=True, default=())
    tolerances: tuple[Number, Number] | None = None
    settings: RunSettings | None = None
    impacts: "Impacts | None" = None
    contacts: Any = None
    contact_changes: "ContactChanges | None" = None
    contact_names: tuple[str, ...] = eqx.field(static=True, default=())
    event: PyTree = None

    @classmethod
    def from_fields(cls, **fields) -> "Trajectory":
        """A trajectory with these fields, made as equinox makes one from its leaves."""
        # The constructor checks every field for mistakes, which takes a tenth of the time of a short motion.
        trajectory = object.__new__(cls)
        for name in cls.__dataclass_fields__:
            object.__setattr__(trajectory, name, fields.pop(name) if name in fields else getattr(cls, name))
        assert not fields, f"a Trajectory has no {', '.join(fields)}"
        return trajectory

    if not TYPE_CHECKING:

        def __getattr__(self, name: str):
            text = f"A Trajectory has no attribute {name!r}."
            if name in ("t", "y", "ys", "sol"):
                text += " Its times are `ts`, its states `q` and `qdot`; `at(t)` gives states at other times."
            raise AttributeError(text)

    def __repr__(self) -> str:
        """Three lines; `equinox.tree_pprint` prints the fields."""
        return registered().summary(self)

    def _repr_html_(self) -> str | None:
        """The three lines and a small figure, for notebooks; None, and they show the lines, where there is none."""
        return registered().trajectory_html(self)

    @property
    def engine(self) -> str:
        if self.settings is None or self.mode is not None:
            return ""
        return "Diffrax" if self.settings.engine is None else type(self.settings.engine).__name__

    @property
    def ok(self) -> jax.Array:
        """True where a member reached the last time or its event."""
        code = self.result._value
        return (code == RESULTS.successful._value) | (code == RESULTS.event_occurred._value)

    @allows_nan
    def at(self, t) -> State:
        """The states at times t between the outputs, as exact as these: each by a run from the output before it.

        q(t), q̇(t) for t in [ts[0], ts[-1]]: a number or an array of any shape. In the `State` the axes of t stand in
        front of those of a leaf, behind the axes of the batch. For a batch of shape B, t is a number or times (K,) for
        all members, or what broadcasts with (*B, K): (*B, K) or (*B, 1) for times of each. All times are followed at
        once, as one batch, by the engine, the tolerances and budgets of the motion; its event is left out.

        A time that is an output gives that output. NaN where the motion had not come to, or had ended by an event or a
        failure, as at the outputs there. At the time of an impact or a transition it is the state that `simulate` gives
        for an output then. Under every transformation of JAX; the derivative by t is (q̇, q̈), that by q0 and params is
        the derivative of the motion.

        **Raises** `ValueError` for t outside of [ts[0], ts[-1]], within `jax.jit` it is NaN there; for a trajectory
        without its system. `SimulationError` where the motion cannot be followed from an output.

        ```python
        import jax.numpy as jnp, lagjax

        spring = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
        run = lagjax.simulate(spring, 1.0, 0.0, jnp.linspace(0.0, 10.0, 11))
        assert abs(run.at(2.5).q - jnp.cos(2.5)) < 1e-6
        ```
        """
        return registered().find_states(self, t)

    def energy(self) -> jax.Array:
        """h = p·q̇ − L at every output time, shape (T,) or (batch, T)."""
        return self._map_outputs("energy")

    def momentum(self) -> PyTree:
        """p = ∂L/∂q̇ at every output time, in the structure of `q`."""
        return self._map_outputs("momentum")

    @property
    def multipliers(self) -> PyTree:
        """λ at every output time, in the structure that the constraint functions return."""
        return self._map_outputs("multipliers") if self.contacts is None else self._forces_in_contact("multipliers")

    @property
    def contact_forces(self) -> PyTree:
        """The normal forces λ ≥ 0 at every output time, in the structure that `contacts` returns; zero of open ones.

        The gradient of its gap times λ is the force that a contact exerts. Raises `ValueError` without contacts.
        """
        if self.contacts is None:
            raise ValueError("This motion has no contacts: give contacts=... or one_way=... to its System.")
        return self._forces_in_contact("contact_forces")

    @allows_nan
    def _forces_in_contact(self, name: str) -> PyTree:
        self._require_present()
        return registered().contact_forces(self, name)

    def constraint_force(self) -> PyTree:
        """(∂f/∂q)ᵀλ + (∂a/∂q̇)ᵀμ at every output time, in the structure of `q`."""
        name = "constraint_force"
        return self._map_outputs(name) if self.contacts is None else self._forces_in_contact(name)

    def required_forces(self, qddot: PyTree) -> PyTree:
        """The generalised forces that accelerations along this path take, in the structure of `q`, as its leaves.

        At every output time they are those of `lagjax.inverse_dynamics`; `qddot` has the structure and the shapes of
        `q`. The motion's own accelerations take none. NaN where `q` is.

        **Raises** `ValueError` for a `qddot` of other shapes, for one that violates a constraint (NaN where values are
        being traced), and for a motion with contacts.

        ```python
        import jax.numpy as jnp, lagjax

        pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q))
        run = lagjax.simulate(pendulum, 1.0, 0.0, jnp.linspace(0.0, 10.0, 101))
        run.required_forces(jnp.zeros(101))  # 9.81 sin(q): what holds the acceleration at zero
        ```
        """
        if self.contacts is not None:
            raise ValueError(
                "required_forces is for motions without contacts, whose share of the forces changes along the way: "
                "take lagjax.inverse_dynamics at a state, or write contacts that stay closed as constraints=...."
            )
        if jax.tree.map(jnp.shape, qddot) != jax.tree.map(jnp.shape, self.q):
            raise ValueError("qddot must have the structure and the shapes of trajectory.q: a number at every output.")
        forces, places = self._map_outputs("_required_force", qddot)
        if is_known(places) and (violated := np.argwhere(np.asarray(places) >= 0)).size:
            first = tuple(violated[0])
            t, place = np.broadcast_to(self.ts, places.shape)[first], int(places[first])
            raise ValueError(f"At t = {t:.6g} {describe_violation(f'number {place} of the multipliers')}")
        return forces

    def constraint_residual(self) -> PyTree:
        """f and a at every output time, in the structure of `multipliers`: the drift off the constraints."""
        return self._map_outputs("constraint_residual")

    @allows_nan
    def health(self, reference: "Trajectory | None" = None) -> "lagjax.results.Health":
        """The trust that this motion deserves: conservation laws, constraints, the mass matrix, gradients.

        Print the result for a report with a verdict, or read its fields, which have the batch axes of the trajectory
        (`lagjax.Health`). `reference` is a trajectory of the same system from the same start at the same times, with a
        tolerance tighter by ten or more; with it the error of the whole motion is estimated. The drift of conserved
        quantities does not bound that error, which may grow along the motion.

        Raises `ValueError` for a reference that cannot be compared or is not tighter.

        ```python
        import jax.numpy as jnp, lagjax

        pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q))
        run = lagjax.simulate(pendulum, 1.0, 0.0, jnp.linspace(0.0, 10.0, 101), rtol=1e-4)
        print(run.health(reference=lagjax.simulate(pendulum, 1.0, 0.0, run.ts, rtol=1e-6)))
        ```
        """
        self._require_present()
        return registered().examine(self, reference)

    def to_xarray(self, units: PyTree = None, time_unit: str | None = None):
        """An `xarray.Dataset` with a variable per leaf of `q` and `qdot` and the dimensions (member,) time, ...

        Of a scene with contacts, their normal forces are variables, too: contact_forces.floor, …. What happens between
        the outputs has tables of its own: `trajectory.impacts.to_pandas()`, `trajectory.contact_changes.to_pandas()`.

        - `units`: a pytree prefix of `q` of texts or None: "m" for all coordinates, {"x": "m", "theta": "rad"} for
          each. They are stored in the `attrs` of the variables; the units of velocities are these per `time_unit`.
        - `time_unit`: the unit of the times, such as "s" or "year".

        Nested batches have the dimensions member_0, member_1, …. Where members have times of their own, as under
        `jax.vmap`, the times are a coordinate `t`.

        Raises `ImportError` when xarray is not installed.
        """
        return registered().dataset(self, units, time_unit)

    def to_pandas(self, units: PyTree = None, time_unit: str | None = None):
        """A `pandas.DataFrame` with a row per output and a column per number: q['x'], q[1], …, qdot['x'], ….

        The columns have the names that messages use. The index is `t`, or (member, t) for a batch. Hybrid motions have
        a column `mode` of names, missing where there is none, scenes with contacts one for each normal force,
        contact_forces['floor'], …; their impacts and changes are `trajectory.impacts.to_pandas()` and
        `trajectory.contact_changes.to_pandas()`. `units` and `time_unit` are those of `to_xarray`; the units are in
        `frame.attrs["units"]`, by column.

        Raises `ImportError` when pandas is not installed.

        ```python
        import jax.numpy as jnp, lagjax

        spring = lagjax.System(lambda q, qdot: 0.5 * qdot["x"] ** 2 - 0.5 * q["x"] ** 2)
        run = lagjax.simulate(spring, {"x": 1.0}, {"x": 0.0}, jnp.linspace(0.0, 10.0, 101))
        table = run.to_pandas(units="m", time_unit="s")
        print(table["q['x']"].max(), table.attrs["units"])
        ```
        """
        return registered().frame(self, units, time_unit)

    def animate(
        self, points: Callable, trace: Any = None, *, speed: float = 1.0, fps: float = 30.0
    ) -> "lagjax.results.Animation":
        """A film of this motion: an `Animation`, which `save` writes to a GIF, an MP4 or a page of HTML.

        - `points`: a function of q, and of `t` and `params` by name, that says where things are: an array (2,) or (3,)
          for a point, (k, 2) or (k, 3) for a line through k points, or a dict of such arrays by name. All in the plane,
          or all in space.
        - `trace`: which points leave a trace that fades: a place among the points, a name in the dict (the last point
          of that line), a pair (name, place), or a list of these.
        - `speed`: units of time that pass in a second; `fps`: frames in a second.

        Frames are evenly spaced in time, whatever the outputs are. Between outputs the motion is the Hermite cubic
        through q and q̇, so that closer outputs make a better film; transitions are where and when they were. A line
        that never moves is drawn without dots. Both axes have the same scale. The first 50 members of a batch are drawn
        into one picture.

        Raises `ImportError` without matplotlib; `ValueError` for points, traces and speeds that cannot be shown.

        ```python
        import jax.numpy as jnp, lagjax

        pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q))
        run = lagjax.simulate(pendulum, 2.0, 0.0, jnp.linspace(0.0, 2.0, 41))
        film = run.animate(lambda q: jnp.array([[0.0, 0.0], [jnp.sin(q), -jnp.cos(q)]]), trace=1)
        film.save("pendulum.gif")
        ```
        """
        return registered().make_animation(self, points, trace, speed, fps)

    def map_members(self, function, *more) -> PyTree:
        """Map `function(q, qdot, (ts, tolerances), params, mode, *more)` over the batch axes, those of `more` too."""
        numbers, code = eqx.partition(self.params, eqx.is_array_like)  # JAX maps over no function in params
        rank = jnp.ndim(self.result._value)

        def mapped(q, qdot, times_and_tolerances, numbers, mode, *more):
            return function(q, qdot, times_and_tolerances, eqx.combine(numbers, code), mode, *more)

        for outer in range(rank):
            # The innermost batch axis of `simulate_batch` shares its tolerances, some parameters, and mostly its times;
            # axes that the user's own `jax.vmap(simulate)` added are on everything.
            axes = (0, 0), 0
            if outer == 0 and self.params_axes != EACH:
                axes = (0 if self.ts.ndim == 1 + rank else None, None), self.params_axes
            mapped = jax.vmap(mapped, in_axes=(0, 0, *axes, 0, *[0] * len(more)))
        return mapped(self.q, self.qdot, (self.ts, self.tolerances), numbers, self.mode, *more)

    def _require_present(self) -> None:
        """Raise `ValueError` if values that the scene's functions read have changed since this motion."""
        for system in (self.system,) if isinstance(self.system, System) else self.system.values():
            system._require_present()

    @allows_nan
    def _map_outputs(self, name: str, *more: PyTree) -> PyTree:
        """Map a method (q, qdot, t, params, *more) of the system over time, and over the batch axes before it."""
        self._require_present()

        def evaluate_member(q, qdot, times_and_tolerances, params, mode, *more):
            evaluate = functools.partial(self._evaluate_output, name, params)
            return jax.vmap(evaluate)(q, qdot, times_and_tolerances[0], mode, *more)

        return self.map_members(evaluate_member, *more)

    def _evaluate_output(self, name: str, params, q, qdot, t, mode, *more) -> PyTree:
        if isinstance(self.system, System):
            return getattr(self.system, name)(q, qdot, t, params, *more)
        if name not in ("energy", "momentum", "_required_force"):  # which every mode has
            _require_equal_constraints(self.system, name, q, qdot, params)
        total = None
        for index, which in enumerate(self.mode_names):
            # Laws of another mode may be singular here: their NaN must not reach a derivative.
            state = constant_unless(mode == index, (q, qdot, t, params, *more))
            value = getattr(self.system[which], name)(*state)
            total = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), value) if total is None else total
            total = jax.tree.map(lambda new, old, here=mode == index: jnp.where(here, new, old), value, total)
        return total


def _require_equal_constraints(modes: dict[str, System], name: str, q, qdot, params) -> None:
    """Raise if modes have different constraints, so that their results have no common structure."""
    constrained = [which for which, system in modes.items() if has_constraints(system)]
    structures = [modes[which]._constraint_structure(Layout.from_state(q, qdot), params) for which in constrained]
    if len(constrained) < len(modes) or any(structure != structures[0] for structure in structures):
        one = constrained[0] if constrained else next(iter(modes))
        raise ValueError(
            f"The modes differ in their constraints, so there is no {name} of the whole motion: take the times of one "
            f"mode and jax.vmap(trajectory.system[{one!r}].{name}, (0, 0, 0, None))(q, qdot, t, params)."
        )


def constant_unless(varies, tree: PyTree) -> PyTree:
    """The numbers of a pytree, without derivatives unless `varies` is true."""

    def constant(x):
        if not eqx.is_array_like(x):
            return x
        still = jax.lax.stop_gradient(x)
        return still if varies is False else jnp.where(varies, x, still)

    return jax.tree.map(constant, tree)


def run_in_doubles(motion: Callable, problem: Problem, *more) -> Any:
    """`motion(layout, ts, y0, params, *more)` of a problem in float64, converted to the problem's precision."""
    given = problem.ts, problem.y0, problem.params, *more
    if not problem.is_single:
        return motion(problem.layout, *given)
    layout = dataclasses.replace(problem.layout, dtype=DOUBLE)
    return compute_in_doubles(functools.partial(motion, layout), *given)


def run_single(follow: Callable, problem: Problem, *more) -> Any:
    """The result of `run_rows` for a problem of one member, without the axis of members."""
    rows = (np.asarray(x)[None] for x in (problem.ts, problem.y0, problem.vector))
    found = run_rows(follow, problem, *rows, *more)
    return jax.tree.map(lambda x: np.asarray(x)[0], found)


def run_rows(follow: Callable, member: Problem, ts, y0, vectors, *more) -> Any:
    """`integrate(layout, params, ts, y0, vectors, *more)` for members with concrete numbers, in their precision.

    They have `ts` (N, T) or (1, T), `y0` (N, 2n), `vectors` (N, P) or (1, P); the rest is that of one `member`.
    """

    def run(ts, y0, vectors):
        wide = member.double_precision if member.is_single else member
        return follow(wide.layout, wide.params, ts, y0, vectors, *more)

    given = tuple(map(np.asarray, (ts, y0, vectors)))
    return compute_in_doubles(run, *given) if member.is_single else run(*given)


def step_counts(accepted, rejected) -> dict:
    return {"num_steps": accepted + rejected, "num_accepted_steps": accepted, "num_rejected_steps": rejected}


def raise_unless_ok(trajectory: Trajectory, layout: Layout, why: Callable[[], str | None]) -> Trajectory:
    """Raise `SimulationError` for a trajectory that did not reach its end; at run time if it is traced."""
    # `why()` are the words for what stopped it, where they are known better than by the result.
    end, code = trajectory.end, trajectory.result._value
    if is_known(code) and int(code) in ENDED_WELL:
        return trajectory
    t_last = trajectory.ts[-1]
    if not all(is_known(leaf) for leaf in jax.tree.leaves((end, code, t_last))):
        y_end = flatten_numbers((end.q, end.qdot), layout.dtype)
        states = trajectory.q, trajectory.qdot, end
        states = raise_where_failed(states, code, (end.t, y_end), t_last, layout.names)
        return eqx.tree_at(lambda t: (t.q, t.qdot, t.end), trajectory, states)
    raise SimulationError(registered().describe_failure(trajectory, layout, why()), trajectory)
