"""One mode of a hybrid motion: its problem, its guards as programs, and the reset of a transition.

The reset is differentiated like any function. Together with the crossing of the guard (`taylor._surfaces`)
this is the jump of a sensitivity at an event ("saltation matrix").
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import Problem
from lagjax._engine.taylor import Line, MachineCode, Surfaces, line_of, make_flow, require_one_number
from lagjax._equations import Derivation, forms, has_constraints, is_inconsistent
from lagjax._interface import Function, Layout, accept, halves, present
from lagjax._primitives import DOUBLE, SINGLE
from lagjax._program import Unlowerable
from lagjax._scene import System
from lagjax._tracing import lower

FIRES = None, "beyond", "crossing"


class Transition(eqx.Module):
    """A switch from mode `source` to mode `target` where `guard(q, qdot)` changes sign, or has done so.

    - `guard`: a real function; it may also ask, by name, for `t`, `params` and `multipliers`, the last as the
      constraints of the mode return them.
    - `direction`: −1 only where the guard falls, +1 only where it rises, 0 for both. A guard that is zero where a mode
      begins, to the rounding of the numbers that came in, and continues in that direction, has been met: the transition
      happens at once, that of a ball on the floor with a velocity into it. One that goes the other way, or a guard of
      both directions, has to leave zero first. Where it goes is decided by the first coefficient of its series that is
      not rounding. Give contacts a direction.
    - `reset(q, qdot)` → (q, qdot): the state after the transition; it may also ask for `t` and `params`. None keeps it.
      It runs in machine code: `linalg.solve` is possible, a loop whose end depends on the state, or `eigh`, is not.
    - `fires`: what happens where the guard is beyond zero in its direction when the mode begins, at the start or behind
      a transition. "beyond": it happens at once. "crossing": it waits until the guard has come back and crosses. None
      decides by the target. To another mode, beyond zero is where `source` ends: at once, whatever the rate. Back into
      its own mode it is a blow if its reset turns the guard round, or puts it back: at once where the guard continues;
      where it comes back it is let out, which `Transitions.let_out` and `health` say. A section, or a kick after which
      the guard continues, waits.

    Raises `TypeError` or `ValueError` for names, guards and directions that are invalid.

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
    fires: str | None = eqx.field(static=True)

    def __init__(
        self,
        source: str,
        target: str,
        guard: Callable,
        direction: int = 0,
        reset: Callable | None = None,
        fires: str | None = None,
    ):
        for role, name in (("source", source), ("target", target)):
            if not isinstance(name, str):
                raise TypeError(f"{role} must be the name of a mode; got {name!r}.")
        if isinstance(direction, bool) or not isinstance(direction, int | np.integer) or abs(direction) > 1:
            raise ValueError(f"direction must be -1 (falling), +1 (rising) or 0 (both); got {direction!r}.")
        if guard is None:
            raise TypeError(f"The transition from {source!r} to {target!r} has no guard: say where it happens.")
        if fires not in FIRES:
            raise ValueError(f'fires must be "beyond", "crossing" or None; got {fires!r}.')
        if fires == "beyond" and not direction:
            raise ValueError('fires="beyond" needs a direction, -1 or +1: zero is left on both sides.')
        self.source, self.target, self.direction, self.fires = source, target, int(direction), fires
        known = isinstance(guard, Function)
        self.guard = guard if known else accept(guard, "guard", extras=("t", "params", "multipliers"))
        self.reset = reset if reset is None or isinstance(reset, Function) else accept(reset, "reset")

    def __repr__(self) -> str:
        way = {-1: "falls through", 0: "passes", 1: "rises through"}[self.direction]
        more = "" if self.reset is None else f", with the reset {self.reset.name}"
        more += "" if self.fires is None else f", fires={self.fires!r}"
        return f"Transition({self.source!r} → {self.target!r} where {self.guard.name} {way} zero{more})"

    def now(self) -> "Transition":
        guard, reset = present(self.guard), None if self.reset is None else present(self.reset)
        if guard is self.guard and reset is self.reset:
            return self
        return eqx.tree_at(lambda t: (t.guard, t.reset), self, (guard, reset), is_leaf=lambda x: x is None)


class ModeParts:
    """One mode prepared for runs: its flow, its guards, the transitions that leave it; compared by identity.

    `numbers` are the indices of these transitions in the list. A reset is None if the state is kept. `reset_lines` and
    `check`, which is 1 off the constraints, are lines of (q, q̇, t) and the numbers of params.
    """

    def __init__(
        self, derivation: Derivation, system: System, leaving: dict[int, Transition], surfaces, restore, is_rounded
    ):
        self._dtype = SINGLE if is_rounded else DOUBLE
        self.numbers, self.surfaces, self._derivation, self._restore = tuple(leaving), surfaces, derivation, restore
        n, size = derivation.layout.size, derivation.accelerations.program.size
        self.sizes = {"N": n, "NUMBERS": size - 2 * n - 1, "INPUTS": size}
        guards = surfaces and surfaces.guards(remembers=True)
        self.make_flow = functools.partial(make_flow, derivation, system.path, None)
        self.make_guarded = functools.partial(make_flow, derivation, system.path, guards)
        self._resets = [transition if transition.reset else None for transition in leaving.values()]
        self.reset_lines = [of and self._lower_reset(of) for of in self._resets]
        self.check = (
            self._lower_function(functools.partial(self._is_disabled, system)) if has_constraints(system) else None
        )

    def _lower_function(self, function: Callable) -> Line:
        y = jax.ShapeDtypeStruct((2 * self._derivation.layout.size + 1,), float)
        return line_of(lower(function, y, self._derivation.numbers, budget=forms.OPERATION_BUDGET))

    def _lower_reset(self, transition: Transition) -> Line:
        try:
            return self._lower_function(functools.partial(self._reset_value, transition))
        except Unlowerable as why:
            raise Unlowerable(f"of {transition!r}, {why}") from None

    def _reset_value(self, transition: Transition, y, numbers):
        return state_after(transition, self._derivation.layout, y[-1], y[:-1], self._restore(numbers))

    def _is_disabled(self, system: System, y, numbers):
        layout, state = self._derivation.layout, (*halves(y[:-1]), y[-1], numbers)
        terms = self._derivation.term_sizes(*state)
        off = is_inconsistent(system._motion(layout, self._restore(numbers)), state, jnp.inf, self._dtype, terms)
        return jnp.where(off, 1.0, 0.0)

    def resets(self) -> list[Callable | None]:
        """The resets as functions of t, y and all numbers in params, (P,)."""
        leaves, structure = jax.tree.flatten(self._derivation.numbers)
        ends = np.cumsum([math.prod(leaf.shape) for leaf in leaves], dtype=int)

        def reset(transition: Transition, t, y, vector):
            parts = zip(jnp.split(vector, ends)[: len(leaves)], leaves, strict=True)
            numbers = structure.unflatten([part.reshape(leaf.shape).astype(leaf.dtype) for part, leaf in parts])
            return self._reset_value(transition, jnp.append(y, t), numbers)

        return [of and functools.partial(reset, of) for of in self._resets]


def make_mode(name: str, transitions: tuple[Transition, ...], problem: Problem) -> ModeParts:
    """A mode prepared for runs. Raises `ValueError` if it has no machine code."""
    leaving = {k: transition for k, transition in enumerate(transitions) if transition.source == name}
    code, structure = jax.tree.flatten(eqx.filter(problem.params, eqx.is_array_like, inverse=True))
    given = tuple(leaving.values()), tuple(code), structure, tuple(leaving), problem.is_rounded
    try:
        if refusal := MachineCode().refuses(problem):
            raise Unlowerable(refusal)
        parts = _make_parts(problem.derivation.lowered, problem.system, *given)
        guarded = dataclasses.replace(problem, guards=parts.surfaces and parts.surfaces.guards(remembers=True))
        if refusal := MachineCode().refuses(guarded):
            raise Unlowerable(refusal)
        return parts
    except Unlowerable as why:
        raise ValueError(f"The mode {name!r} has no machine code: {why}.") from None


@functools.lru_cache(maxsize=64)
def _make_parts(derivation: Derivation, system: System, leaving, code, structure, numbers, is_rounded) -> ModeParts:
    surfaces = _guard_surfaces(derivation, system, leaving, code, structure)
    surfaces = surfaces and surfaces._replace(is_rounded=is_rounded)
    others = structure.unflatten(code)
    of = dict(zip(numbers, leaving, strict=True))
    return ModeParts(derivation, system, of, surfaces, lambda numbers: eqx.combine(numbers, others), is_rounded)


def _guard_surfaces(derivation: Derivation, system: System, leaving: tuple, code: tuple, structure) -> Surfaces | None:
    """The guards of the transitions that leave a mode, lowered once; None if there is no such transition."""
    # `code` and `structure` are what params hold that is not a number. Raises `Unlowerable`.
    if not leaving:
        return None
    layout, multipliers = derivation.layout, derivation.accelerations.multipliers

    guards = [transition.guard for transition in leaving]
    if multipliers is None and any("multipliers" in guard.extras for guard in guards):
        raise ValueError("A guard asks for `multipliers`, but its mode has no constraints.")

    def values_at(y, params, *found):
        extras = {"t": y[-1], "params": params}
        for forces in found:
            extras["multipliers"] = system._split_by_constraint(forces, layout, params)
        state = [*map(layout.restore, halves(y[:-1]))]
        return jnp.stack([require_one_number(guard(*state, **extras), "A guard") for guard in guards])

    directions = tuple(transition.direction for transition in leaving)
    return Surfaces.from_function(derivation, values_at, directions, code, structure, given=multipliers)


def state_after(transition: Transition, layout: Layout, t, y, params) -> jax.Array:
    """The state (2n,) after the reset of a transition. Raises `TypeError` if it does not have this layout."""
    assert transition.reset is not None
    result = transition.reset(*map(layout.restore, halves(y)), t=t, params=params)
    where = f"The reset from {transition.source!r} to {transition.target!r}"
    if not isinstance(result, tuple) or len(result) != 2:
        raise TypeError(f"{where} must return the pair (q, qdot); got {type(result).__name__}.")
    try:
        same = Layout.from_state(*result) == layout
    except (TypeError, ValueError) as why:
        raise TypeError(f"{where} must return (q, qdot) like the initial state: {why}") from None
    if not same:
        raise TypeError(f"{where} must return q and qdot in the structure and the shapes of the initial state.")
    return jnp.concatenate([layout.flatten(part) for part in result])
