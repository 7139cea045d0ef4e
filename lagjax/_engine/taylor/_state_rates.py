"""The rate of a state, which moves an output when its time varies; also for a motion that slides along a border.

Pieces decided from the state alone do not show that the motion slides along a border (`_program._borders`): there
rounding decides on which side a state lies. The motion slides if both sides push onto the border, and the state reaches
it at once.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from lagjax._engine.taylor._flow import Flow
from lagjax._engine.taylor._line_functions import join_columns, program_outputs
from lagjax._tracing import Rows, emit_look_up, emit_rows

INSTANT = 1e-9  # of the time; what a border is off by while a motion slides along it is rounding


def rate(flow: Flow, t, y, params):
    """The rates (q̇, q̈) at states y (…, 2n), t (…), params (…, P); zero where not finite: the motion has ended."""
    n, borders, program = flow.size, flow.kernel.borders, flow.general_program
    rows = Rows(join_columns(y, t[..., None]), params)
    if borders is not None and any(guard.slide >= 0 for guard in borders.guards):
        chosen = params if flow.kernel.chosen is None else params[..., jnp.array(flow.kernel.chosen.positions, int)]
        rows = rows._replace(first=join_columns(rows.first, chosen))
        found = _evaluate_pieces(borders, rows, _pieces_at_state(borders, rows, n))[0][:n]
        acceleration = jnp.stack(jnp.broadcast_arrays(*found), axis=-1)
    else:
        acceleration = program_outputs(program, n, rows.first, params)
    slope = join_columns(y[..., n:], acceleration)
    return jnp.where(jnp.isfinite(slope), slope, 0.0)


def _evaluate_pieces(borders, rows: Rows, pieces) -> tuple[tuple, tuple]:
    """The outputs of the program on these pieces, and its switching numbers."""
    line = borders.program.line
    count = len(line.outputs)
    values = emit_rows(line.replace(outputs=(*line.outputs, *borders.switches)), rows._replace(pieces=pieces))
    return values[:count], values[count:]


def _pieces_at_state(borders, rows: Rows, n: int) -> list[Any]:
    """The pieces at a state; 1 for a flag that the motion slides."""
    count, zero = len(borders.switches), jnp.zeros_like(rows.first[..., 0])
    pieces = list(emit_rows(borders.decide, rows._replace(pieces=[zero] * (2 * count))))
    # Along a border in position a motion slides at rest, which `decide` knows, and so it rests on a cone.
    guards = [guard for guard in borders.guards if guard.slide >= 0 and guard.beyond.slope != 0.0 and guard.order < 2]
    switches = _evaluate_pieces(borders, rows, pieces)[1]
    sides: dict[int, tuple] = {}
    for guard in guards:  # of the borders of a piece the nearest one counts
        j, piece = guard.piece, pieces[guard.piece]
        beyond, ends = guard.beyond(piece), (zero - 1, zero + 1)
        below, above = ends if guard.beyond.slope < 0 else (jnp.minimum(piece, beyond), jnp.maximum(piece, beyond))
        found = jnp.abs(switches[j] - _border_level(borders, guard, rows, piece)), below, above
        known = sides.get(guard.slide, (j, *found))[1:]
        sides[guard.slide] = (j, *(jnp.where(found[0] < known[0], x, y) for x, y in zip(found, known, strict=True)))

    def rates(side: int):
        """The rates of the switching numbers with all pieces that may slide on one side of their border."""
        there = list(pieces)
        for slide, (j, _, *of_sides) in sides.items():
            there[slide], there[j] = zero, lax.stop_gradient(of_sides[side])
        out = _evaluate_pieces(borders, rows, there)[0]
        still = [zero] * (rows.first.shape[-1] - 2 * n - 1)
        moving = jnp.stack([*(rows[n + i] for i in range(n)), *out[:n], jnp.ones_like(zero), *still], axis=-1)
        pieced = lambda first: _evaluate_pieces(borders, rows._replace(first=first), there)[1]  # noqa: E731
        return jax.jvp(pieced, (rows.first,), (moving.astype(rows.first.dtype),))[1]

    below, above = rates(0), rates(1)
    for slide, (j, offset, lower, _) in sides.items():
        fast = jnp.maximum(jnp.abs(below[j]), jnp.abs(above[j]))
        slides = (offset <= INSTANT * jnp.abs(rows[2 * n]) * fast) & (below[j] > 0.0) & (above[j] < 0.0)
        pieces[slide] = jnp.where(slides, 1.0, zero)
        pieces[j] = jnp.where(slides, lower, pieces[j])
    return [lax.stop_gradient(piece) for piece in pieces]


def _border_level(borders, guard, rows: Rows, piece):
    if guard.of_table:
        index = guard.level.slope * piece + guard.level.offset
        table = borders.decisions[guard.piece].table.table
        entry = emit_look_up("take", table, rows.entries, piece.dtype, index)
        return jnp.where((index >= 0) & (index < table.count), entry, jnp.inf)
    return guard.level(piece, lambda where, x: jnp.where(where, x, 0.0))
