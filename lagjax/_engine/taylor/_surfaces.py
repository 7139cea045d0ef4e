"""Surfaces as guards of machine code, and derivatives of the time and state of a crossing.

Machine code finds the zeros of guards without derivatives (`_native.steps._events`). Those of the crossing follow from
the implicit function theorem: with g the guard and ġ its rate along the motion,

    dt* = −dg / ġ        dy* = dy + ẏ dt*

and likewise to second order (`crossing_variation`).
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine.taylor._line_functions import program_outputs
from lagjax._equations import Derivation, forms
from lagjax._native import SINGLE_NOISE, Guards
from lagjax._primitives import differentiable_where
from lagjax._program import StraightLine, Unlowerable, borders, copy_nodes, distances, tangents_in
from lagjax._tracing import Program, Scalars, absolute, compose, fold, lower, lower_scalars, stack


class Surfaces(NamedTuple):
    """Guards as programs of (q, q̇, t, params), and the direction of a sign change that counts: −1, 0, +1.

    `values` gives all g. `complete` gives the outputs that `_native.Guards` needs: g, then ġ, then the sizes of both,
    which bound their round-off; and for a start that `is_rounded` to float32, unless the motion remembers it, its
    rounding error. `borders` gives the distance of every switching number of a guard from its border, and `followed()`
    all g and these distances, the rates of both along the motion, and (q̇, q̈). A guard that `holds` ends at once a
    motion that starts beyond it, in its direction.
    """

    values: Program
    complete: Program
    followed: Callable[[], Program]
    directions: tuple[int, ...]
    is_rounded: bool = False
    borders: StraightLine | None = None
    holds: tuple[bool, ...] = ()

    def guards(self, notes: bool = False, remembers: bool = False) -> Guards:
        """The surfaces as guards of machine code: a change ends the motion or, with `notes`, is recorded.

        A motion that `remembers` is given the side of each surface from which it comes (see `Guards`).
        """
        given = notes, remembers, self.is_rounded, self.holds
        return Guards(self.values, self.complete, self.directions, *given)

    @property
    def have_no_rate(self) -> np.ndarray:
        """For every guard, (G,): True if its rate is zero everywhere, so that it changes its sign by jumps."""
        count = len(self.directions)
        return np.array([self.complete.constant(count + k) == 0.0 for k in range(count)])

    @classmethod
    def from_function(
        cls, derivation: Derivation, function: Callable, directions, code, structure, is_rounded=False, given=None
    ) -> "Surfaces":
        """The surfaces of a function of y = (q, q̇, t), (2n + 1,), and params, which gives all g (G,).

        It also takes the outputs of the program `given`, if there is one. `code` and `structure` are the parts of
        params that are not numbers. Raises `Unlowerable`.
        """
        moving, motion = 2 * derivation.layout.size + 1, derivation.accelerations.program.complete
        y, numbers = jax.ShapeDtypeStruct((moving,), derivation.layout.dtype), derivation.numbers

        def values_at(y, numbers, *more):
            return function(y, eqx.combine(numbers, structure.unflatten(code)), *more)

        more = () if given is None else (jax.ShapeDtypeStruct((len(given.line.outputs),), jnp.result_type(float)),)
        values = lower(values_at, y, numbers, *more, moving=moving)
        if given is not None:
            values = compose(values, given, forms.OPERATION_BUDGET, moving)

        def sizes_by_rounding(y, numbers):
            floats, others = eqx.partition(numbers, eqx.is_inexact_array)
            slopes = jax.jacrev(lambda y, floats: values_at(y, eqx.combine(floats, others)), (0, 1))(y, floats)
            moved = jax.tree.map(lambda by, x: jnp.abs(by * x).reshape(len(by), -1).sum(1), slopes, (y, floats))
            return SINGLE_NOISE * sum(jax.tree.leaves(moved))

        rounding = lower(sizes_by_rounding, y, numbers, moving=moving) if is_rounded else None
        complete = _guard_rates_and_noise(values, motion, moving, rounding)
        pieces = _borders_of(values, derivation.layout.size)
        follow = functools.cache(lambda: _guards_and_rates(values, motion, moving, pieces))
        return cls(values, complete, follow, directions, is_rounded, pieces)


def _guard_rates_and_noise(values: Program, motion: Program, moving: int, rounding: Program | None) -> Program:
    """The program of g, ġ, the sizes of both, and the error of g by a rounded start, see `Surfaces`."""

    def scalars(expansion, arguments):
        graph, ids = expansion.graph, np.concatenate([x.ravel() for x in arguments])
        nodes, y = values.place(expansion, ids).tolist(), Scalars(expansion, ids[:moving])
        outputs = values.line.outputs
        one, zero = graph.number(1.0), graph.number(0.0)
        read = sorted(i for i in values.find_inputs(range(len(outputs))) if i < moving) or [0]
        by_y = {j: tangents_in(graph, values.line, nodes, {j: one}, {}) for j in read}
        rate, found = _rate_of_change(motion, expansion, ids, moving), []
        for i in outputs:
            at = [j for j, by in by_y.items() if by.get(i, zero) != zero] or read[:1]  # most are zero, of many watches
            slopes = Scalars(expansion, np.array([by_y[j].get(i, zero) for j in at]))
            terms, moves = slopes * y[at], slopes * rate[at]
            found.append([fold("add", x) for x in (moves, absolute(terms), absolute(moves))])
        more = [] if rounding is None else [rounding.place(expansion, ids)[list(rounding.line.outputs)]]
        return [np.array([nodes[i] for i in outputs]), *(stack(x).ids for x in zip(*found, strict=True)), *more]

    return lower_scalars(scalars, values.shapes, forms.OPERATION_BUDGET, moving)


def _guards_and_rates(values: Program, motion: Program, moving: int, pieces: StraightLine | None) -> Program:
    """The program of all g and border distances, their rates along the motion, and (q̇, q̈)."""

    def scalars(expansion, arguments):
        graph, ids = expansion.graph, np.concatenate([x.ravel() for x in arguments])
        rate, found = _rate_of_change(motion, expansion, ids, moving).ids.tolist(), []
        lines = [values.line] if pieces is None else [values.line, pieces]
        for line in lines:
            nodes = copy_nodes(graph, line, ids.tolist(), [graph.position(i) for i in ids.tolist()])
            tangents = tangents_in(graph, line, nodes, dict(enumerate(rate)), {})
            zero = graph.number(0.0)
            found.append(([nodes[i] for i in line.outputs], [tangents.get(i, zero) for i in line.outputs]))
        at, moves = (np.array([x for part in parts for x in part]) for parts in zip(*found, strict=True))
        return [at, moves, np.array(rate[:-1])]

    return lower_scalars(scalars, values.shapes, forms.OPERATION_BUDGET, moving)


def _rate_of_change(motion: Program, expansion, ids: np.ndarray, moving: int) -> Scalars:
    """The rate of (q, q̇, t), in a graph whose inputs are `ids`."""
    outputs = motion.place(expansion, ids)[list(motion.line.outputs[: moving // 2])]
    one = expansion.constants(np.ones(1))
    return Scalars(expansion, np.concatenate([ids[moving // 2 : moving - 1], outputs, one]))


@functools.lru_cache(maxsize=64)
def rate_errors(complete: Program, count: int) -> Program:
    """The program of the running errors of all ġ in units of round-off, which include those of cancelled terms."""
    return complete.rounding_of(range(count, 2 * count), complete.shapes[0].size)


def _borders_of(values: Program, n: int) -> StraightLine | None:
    """The distances of guards from the borders at which they may jump; None if smooth, or without a program."""
    try:
        found = borders(values, n, slides=False, watched=len(values.line.outputs))
    except Unlowerable:
        return None
    return None if found is None or not found.switches else distances(found)


def vector_of(numbers: PyTree) -> jax.Array:
    leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(numbers)]
    return jnp.concatenate(leaves) if leaves else jnp.zeros(0)


def require_one_number(value, what: str) -> jax.Array:
    """The value of a guard as an array. Raises `TypeError` if it is not one real number."""
    if len(jax.tree.leaves(value)) != 1 or value is not jax.tree.leaves(value)[0]:
        raise TypeError(f"{what} must return one real number; got {type(value).__name__}.")
    value = jnp.asarray(value)
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"{what} must return one real number; got shape {value.shape} of {value.dtype}.")
    return value


def crossing_variation(surfaces: Surfaces) -> Callable:
    """A function `(k, taken, t, y, numbers)` → (t, y), as `move_to_zero`; derivatives are NaN where g′ is zero."""

    def move(k, taken, *at):
        crosses, *there = move_to_zero(surfaces, k, taken, at, jax.lax.stop_gradient(at))
        return tuple(differentiable_where(crosses, x, *at) for x in there)

    return move


def move_to_zero(surfaces: Surfaces, k, taken, at: tuple, still: tuple) -> tuple:
    """A flag that guard k crosses, and (t, y): the state `at` (t, y, numbers), moved to the zero of the guard.

    `still` are the same numbers without derivatives. With δg the variation of the guard, f the rate of the state, and ′
    the derivative along the motion, time moves by

        s = −ε − ½ (g″/g′) ε²,  ε = δg/g′        and the state by   f s + ½ f′ s²,

    up to third order in δg, which is zero itself: first and second derivatives are right. Where it is not `taken`
    nothing moves. Where the guard jumps through zero, δg is that of the switching number at its border, the nearest in
    time.
    """
    follow = functools.partial(_follow_guards, surfaces)
    (t, y, _), (values, rates, slope) = at, follow(*at)
    zeros, still_rates, still_slope = follow(*still)
    along = jnp.ones_like(t), still_slope
    _, (_, bends, turn) = jax.jvp(lambda t, y: follow(t, y, still[2]), still[:2], along)
    here = np.arange(len(values)) == (k if surfaces.borders is None else _find_zero(surfaces, k, zeros, still_rates))
    varied, rate, still_rate, bend = (
        jnp.where(here, x, 0.0).sum() for x in (values - zeros, rates, still_rates, bends)
    )
    crosses = ~taken | (still_rate != 0)
    moves = taken & crosses
    part = jnp.where(taken, varied, 0.0) / jnp.where(moves, rate, 1.0)
    later = -part - 0.5 * bend / jnp.where(moves, still_rate, 1.0) * part**2
    return crosses, t + later, y + slope * later + 0.5 * turn * later**2


def jumps_through_zero(surfaces: Surfaces, k, t, y, numbers):
    """True if guard k changes its sign at (t, y) by a jump, at a border of its own."""
    if surfaces.borders is None:
        return np.array(False)
    values, rates, _ = _follow_guards(surfaces, *jax.lax.stop_gradient((t, y, numbers)))
    return _find_zero(surfaces, k, values, rates) >= len(surfaces.directions)


def _follow_guards(surfaces: Surfaces, t, y, numbers) -> list:
    """The guards and border distances, their rates along the motion, and the rate of the state."""
    program, n = surfaces.followed(), y.shape[0] // 2
    found = program_outputs(program, len(program.line.outputs), jnp.append(y, t), numbers)
    return jnp.split(found, [len(found) // 2 - n, len(found) - 2 * n])


def _find_zero(surfaces: Surfaces, k, values, rates):
    """The index of the number that is zero where guard k changes: the guard, or the border nearest in time."""
    number, count = np.arange(values.size), len(surfaces.directions)
    times = jnp.abs(values / rates) * np.where(number >= count, _LATER, 1.0)
    times = jnp.where(jnp.isnan(times), jnp.inf, times)
    return jnp.argmin(jnp.where((number >= count) | (number == k), times, jnp.inf))


# A guard that jumps at a border is not zero there: of the times to both that to the guard's own zero is by many orders
# longer, where that to the border is some roundings. With twice as much nothing changes.
_LATER = 1e4
