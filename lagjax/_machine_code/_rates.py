"""The rate of a state, with which an output moves when its time does: of a motion that slides, too.

A program that decides anew at the state does not see that the motion slides along a border (`_program._borders`): on
which side of it a state lies there is rounding. The motion slides where both sides push onto the border, and the state
comes to it within an instant.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from lagjax._machine_code._flow import Flow
from lagjax._machine_code._lines import outputs
from lagjax._program import emit

INSTANT = 1e-9  # of the time; what a border is off by while a motion slides along it is rounding


def rate(flow: Flow, t, y, params):
    """(q̇, q̈) at states y (…, 2n), t (…), params (…, P); zero where it is not finite: there the motion has ended."""
    n = flow.size
    borders = flow.borders
    slides = borders is not None and any(guard.slide >= 0 for guard in borders.guards)
    if flow.general_program.looks_up or not slides:
        return _rate_from_rows(flow, t, y, params)
    scalars = (*(y[..., i] for i in range(2 * n)), t, *(params[..., i] for i in range(flow.numbers)))
    scalars = jnp.broadcast_arrays(*scalars)
    if slides:
        acceleration = _evaluate_pieces(borders, scalars, _pieces(borders, scalars, n))[0][:n]
    else:
        acceleration = flow.general_program(*scalars)[:n]
    return _stack_rate(flow, y, acceleration)


def _stack_rate(flow: Flow, y, acceleration):
    velocity = (y[..., flow.size + i] for i in range(flow.size))
    slope = jnp.stack(jnp.broadcast_arrays(*velocity, *acceleration), axis=-1)
    return jnp.where(jnp.isfinite(slope), slope, 0.0)


def _rate_from_rows(flow: Flow, t, y, params):
    """`rate` of a program that looks up tables, whose parameters are too many to be taken apart, or of a large one."""
    shape = jnp.broadcast_shapes(y.shape[:-1], t.shape)
    y, time = jnp.broadcast_to(y, (*shape, 2 * flow.size)), jnp.broadcast_to(t, shape)[..., None]
    rows = jnp.concatenate([y, time], axis=-1)
    if flow.general_program.looks_up:
        return _stack_rate(flow, y, flow.general_program.compute_rows(rows, params)[: flow.size])
    return _stack_rate(flow, y, jnp.moveaxis(outputs(flow.general_program, flow.size, rows, params), -1, 0))


def _evaluate_pieces(borders, scalars, pieces) -> tuple[tuple, tuple]:
    """The outputs of the program on these pieces, and the switching numbers."""
    line = borders.program.line
    outputs = (*line.outputs, *borders.switches)
    values = emit(line.nodes, line.kinds, outputs, (*scalars, *pieces))
    return values[: len(line.outputs)], values[len(line.outputs) :]


def _pieces(borders, scalars, n: int) -> list[Any]:
    """The pieces at a state; 1 for those that say that the motion slides."""
    count, zero, decide = len(borders.switches), jnp.zeros_like(scalars[0]), borders.decide
    pieces = list(emit(decide.nodes, decide.kinds, decide.outputs, (*scalars, *[zero] * (2 * count))))
    # Along a border in position a motion slides at rest, which `decide` knows.
    sliding = {guard.piece: guard.slide for guard in borders.guards if guard.slide >= 0 and guard.order < 2}

    def rates(side: float):
        """The rates of the switching numbers, where all pieces that may slide are on one side of their border."""
        there = [jnp.full_like(zero, side) if j in sliding else piece for j, piece in enumerate(pieces)]
        there = [zero if j in sliding.values() else piece for j, piece in enumerate(there)]
        out, _ = _evaluate_pieces(borders, scalars, there)
        moving = [*scalars[n : 2 * n], *out[:n], jnp.ones_like(zero)]
        moving += [jnp.zeros_like(zero)] * (len(scalars) - 2 * n - 1)
        return jax.jvp(lambda *at: _evaluate_pieces(borders, at, there)[1], tuple(scalars), tuple(moving))

    (switches, below), (_, above) = rates(-1.0), rates(1.0)
    for j, slide in sliding.items():
        fast = jnp.maximum(jnp.abs(below[j]), jnp.abs(above[j]))
        near = jnp.abs(switches[j]) <= INSTANT * jnp.abs(scalars[2 * n]) * fast
        pieces[slide] = jnp.where(near & (below[j] > 0.0) & (above[j] < 0.0), 1.0, zero)
    return [lax.stop_gradient(piece) for piece in pieces]
