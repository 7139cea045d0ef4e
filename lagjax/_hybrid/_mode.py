"""One mode of a hybrid motion: its problem, its guards as programs, and the way through a transition.

Where a guard vanishes is found by machine code, without derivatives. Those of the crossing come from the implicit
function: with g the guard and ġ its rate along the motion,

    dt* = −dg / ġ        dy* = dy + ẏ dt*

and the same to second order (`Mode.crossing`), after which the reset is differentiated like any function. Together
these are the jump of a sensitivity at an event ("saltation matrix").
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._arguments import Function, accept
from lagjax._custom import differentiated_as
from lagjax._derivation import Derivation
from lagjax._layout import Layout, halves
from lagjax._machine_code import MachineCode, flow_of
from lagjax._native import Guards
from lagjax._problem import Problem, Solution
from lagjax._program import Program, Unlowerable, lower
from lagjax._system import System

PyTree = Any

MOST_GUARDS = 24  # two bits each in the code of an event, which the kernel keeps in a double of 53


class Transition(eqx.Module):
    """From mode `source` to mode `target` where `guard(q, qdot)` changes sign.

    - `guard`: a real function; it may also ask, by name, for `t`, `params` and `multipliers`, the last as the
      constraints of the mode return them.
    - `direction`: −1 only when it falls, +1 only when it rises, 0 either way. A motion that begins on the surface has
      to leave it first.
    - `reset(q, qdot)` → (q, qdot): the state after the transition; it may also ask for `t` and `params`. None keeps it.

    Raises `TypeError` or `ValueError` for what cannot be a transition.

    ```python
    import lagjax

    floor = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))
    ```
    """

    source: str = eqx.field(static=True)
    target: str = eqx.field(static=True)
    guard: Function
    direction: int = eqx.field(static=True)
    reset: Function | None

    def __init__(self, source: str, target: str, guard: Callable, direction: int = 0, reset: Callable | None = None):
        for role, name in (("source", source), ("target", target)):
            if not isinstance(name, str):
                raise TypeError(f"{role} must be the name of a mode; got {name!r}.")
        if isinstance(direction, bool) or not isinstance(direction, int | np.integer) or abs(direction) > 1:
            raise ValueError(f"direction must be -1 (falling), +1 (rising) or 0 (both); got {direction!r}.")
        if guard is None:
            raise TypeError(f"The transition from {source!r} to {target!r} has no guard: say where it happens.")
        self.source, self.target, self.direction = source, target, int(direction)
        self.guard = accept(guard, "guard", extras=("t", "params", "multipliers"))
        self.reset = None if reset is None else accept(reset, "reset")


class Surfaces(NamedTuple):
    """The guards of a mode as programs of (q, q̇, t, params), and how each has to change sign: −1, 0, +1.

    `values` gives all g. `complete` gives what `_native.Guards` wants: g, then ġ, then the sizes of both, which bound
    their round-off.
    """

    values: Program
    complete: Program
    directions: tuple[int, ...]


class Mode(NamedTuple):
    """One mode: a problem that lacks a state and times, and the transitions that leave it, with their numbers.

    `surfaces` is None where none leaves.
    """

    problem: Problem
    leaving: tuple[tuple[int, Transition], ...]
    surfaces: Surfaces | None
    params: PyTree
    vector: jax.Array  # every number in params, (P,)

    @classmethod
    def of(cls, name: str, problem: Problem, leaving: tuple[tuple[int, Transition], ...]) -> "Mode":
        """A mode that is ready to run. Raises `ValueError` where it has no machine code."""
        if len(leaving) > MOST_GUARDS:
            raise ValueError(f"{len(leaving)} transitions leave the mode {name!r}, more than {MOST_GUARDS}.")
        code, structure = jax.tree.flatten(eqx.filter(problem.params, eqx.is_array_like, inverse=True))
        try:
            if refusal := MachineCode().refuses(problem):
                raise Unlowerable(refusal)
            transitions = tuple(transition for _, transition in leaving)
            surfaces = _surfaces(problem.derivation, problem.system, transitions, tuple(code), structure)
        except Unlowerable as why:
            raise ValueError(f"The mode {name!r} has no machine code: {why}.") from None
        return cls(problem, leaving, surfaces, problem.params, jnp.asarray(problem.vector))

    @property
    def layout(self) -> Layout:
        """The structure of the coordinates."""
        return self.problem.layout

    @property
    def _surfaces(self) -> Surfaces:
        assert self.surfaces is not None, "no transition leaves this mode"
        return self.surfaces

    # ---- along the mode ----

    def solve(self, ts, y0) -> Solution:
        """The motion over the times `ts`, with its derivatives."""
        return MachineCode().solve(dataclasses.replace(self.problem, ts=ts, y0=y0))

    def solve_to_event(self, ts, y0) -> Solution:
        """The motion to the last of the times `ts`, or to the first zero of a guard; it has no derivatives."""
        guards = None if self.surfaces is None else Guards(self.surfaces.complete, self.surfaces.directions)
        solution = MachineCode().solve(dataclasses.replace(self.problem, ts=ts, y0=y0, guards=guards))
        return jax.tree.map(jax.lax.stop_gradient, solution)

    # ---- through a transition ----

    def guards_at(self, t, y) -> tuple:
        """The guards, their rates along the motion and their sizes at a state, without derivatives."""
        t, y, numbers = jax.lax.stop_gradient((t, y, self.vector))
        out, count = self._surfaces.complete(*y, t, *numbers), len(self.leaving)
        return out[:count], out[count : 2 * count], out[2 * count : 3 * count]

    def crossing(self, k: int) -> Callable:
        """`(taken, t, y, numbers)` → (t, y): the state at t, where guard k is zero and stays so as what went in varies.

        With δg the variation of the guard, f the rate of the state and ′ the derivative along the motion, the time
        moves by

            s = −ε − ½ (g″/g′) ε²,  ε = δg/g′        and the state by   f s + ½ f′ s²,

        up to third order in δg, which is zero itself: first and second derivatives are right.
        """
        n, still, count = self.layout.size, jax.lax.stop_gradient, len(self.leaving)
        program, surfaces = flow_of(self.problem).anywhere, self._surfaces

        def rates(t, y, numbers):
            acceleration = jnp.stack(program(*y, t, *numbers)[:n])
            return surfaces.complete(*y, t, *numbers)[count + k], jnp.concatenate([y[n:], acceleration])

        def moved(taken, t, y, numbers):
            value, (rate, slope) = surfaces.values(*y, t, *numbers)[k], rates(t, y, numbers)
            direction = jnp.ones_like(t), slope
            bend, turn = map(still, jax.jvp(lambda t, y: rates(t, y, numbers), (t, y), direction)[1])
            rate = jnp.where(taken & (rate != 0), rate, 1.0)
            part = jnp.where(taken, value - still(value), 0.0) / rate
            later = -part - 0.5 * still(bend / rate) * part**2
            return t + later, y + slope * later + 0.5 * turn * later**2

        return lambda taken, t, y, numbers: differentiated_as(moved, (t, y), taken, t, y, numbers)

    def is_inconsistent(self, t, y):
        """Whether a state is off the constraints of this mode."""
        system = self.problem.system
        if system.constraints is None and system.velocity_constraints is None:
            return jnp.asarray(False)
        motion = system.motion(self.layout, self.params)
        t, y, numbers = jax.lax.stop_gradient((t, y, eqx.filter(self.params, eqx.is_array_like)))
        return motion.constraints.inconsistent(*halves(y), t, numbers)


@functools.lru_cache(maxsize=64)
def _surfaces(
    derivation: Derivation, system: System, leaving: tuple[Transition, ...], code: tuple, structure
) -> Surfaces | None:
    """The guards of the transitions that leave a mode, lowered once; None where none leaves.

    `code` and `structure` are what params hold that is not a number. Raises `Unlowerable`.
    """
    if not leaving:
        return None
    n, layout, numbers = derivation.layout.size, derivation.layout, derivation.numbers
    program, multipliers = derivation.acceleration, derivation.multipliers

    def values(y, numbers):
        q, v, t = y[:n], y[n:-1], y[-1]
        extras = {"t": t, "params": eqx.combine(numbers, structure.unflatten(code))}
        if multipliers is not None:
            flat = jnp.stack(multipliers(*y, *_scalars(numbers)))
            extras["multipliers"] = system.by_constraint(flat, layout, extras["params"])
        return jnp.stack([_value(one.guard, layout.restore(q), layout.restore(v), extras) for one in leaving])

    def complete(y, numbers):
        acceleration = jnp.stack(program.complete(*y, *_scalars(numbers))[:n])
        rate = jnp.concatenate([y[n:-1], acceleration, jnp.ones(1)])
        by_y = jax.jacfwd(values)(y, numbers)
        terms, moving = by_y * y, by_y * rate
        return values(y, numbers), moving.sum(1), jnp.abs(terms).sum(1), jnp.abs(moving).sum(1)

    y = jax.ShapeDtypeStruct((2 * n + 1,), layout.dtype)
    directions = tuple(transition.direction for transition in leaving)
    return Surfaces(lower(values, y, numbers), lower(complete, y, numbers), directions)


def _scalars(numbers: PyTree) -> list[jax.Array]:
    return [x for leaf in jax.tree.leaves(numbers) for x in jnp.ravel(leaf)]


def _value(guard: Function, q, qdot, extras) -> jax.Array:
    """The value of a guard, after checking that it is one real number."""
    if "multipliers" in guard.extras and "multipliers" not in extras:
        raise ValueError("A guard asks for `multipliers`, but its mode has no constraints.")
    value = guard(q, qdot, **extras)
    if len(jax.tree.leaves(value)) != 1 or value is not jax.tree.leaves(value)[0]:
        raise TypeError(f"A guard must return one real number; got {type(value).__name__}.")
    value = jnp.asarray(value)
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"A guard must return one real number; got shape {value.shape} of {value.dtype}.")
    return value


def state_after(transition: Transition, layout: Layout, t, y, params) -> jax.Array:
    """The state (2n,) after the reset of a transition. Raises `TypeError` where that is no state of this layout."""
    if transition.reset is None:
        return y
    result = transition.reset(*map(layout.restore, halves(y)), t=t, params=params)
    where = f"The reset from {transition.source!r} to {transition.target!r}"
    if not isinstance(result, tuple) or len(result) != 2:
        raise TypeError(f"{where} must return the pair (q, qdot); got {type(result).__name__}.")
    try:
        same = Layout.of(*result) == layout
    except (TypeError, ValueError) as why:
        raise TypeError(f"{where} must return (q, qdot) like the initial state: {why}") from None
    if not same:
        raise TypeError(f"{where} must return q and qdot in the structure and the shapes of the initial state.")
    return jnp.concatenate([layout.flatten(part) for part in result])
