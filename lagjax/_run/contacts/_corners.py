"""The corners of contacts: borders at which a gap, its rate or a slip jumps (`abs`, `maximum`, `where`, tables).

While a contact is open, its corners are borders like those of L, and nothing happens there. A closed contact that
reaches a corner opens, and the motion continues a few roundings beyond; the watches of that side then tell whether it
strikes, stays or separates. On the corner itself a contact has no unique normal: a motion that is struck there, or
rests there, ends.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

from lagjax._program import Unlowerable, find_corners, is_smooth, with_outputs
from lagjax._scene import ContactShapes
from lagjax._tracing import Program


class Corners(NamedTuple):
    """The P corners of k contacts: a matrix `touch` (P, k) of which belongs to which, and a program of sides (P,)."""

    touch: np.ndarray
    sides: Program


def corners_of(derivation, rows: tuple[int, ...], shapes: ContactShapes) -> Corners | None:
    """The corners of contacts, which have these `rows` of all constraints, slips last; None without any.

    Raises `ValueError` for a gap that is zero where it has its corner.
    """
    return _corners_of(derivation, rows, tuple(shapes.rough.tolist()), shapes.of_gaps, shapes.names)


@functools.lru_cache(maxsize=64)
def _corners_of(derivation, places: tuple[int, ...], rough: tuple[int, ...], gaps: int, names: tuple) -> Corners | None:
    rows, count = np.array(places, int), len(names)
    program, m = derivation.program("residual", "rates"), derivation.shape("residual")[0]
    program = program.select_outputs([*rows, *(m + rows)])
    try:
        found = None if is_smooth(program.line) else find_corners(program, derivation.layout.size)
    except Unlowerable:
        return None
    if found is None:
        return None
    jumps = found.jumps[:, : len(rows)] | found.jumps[:, len(rows) :]
    for name, vanishes in zip(names[:gaps], (found.vanish[:, : len(rows)] & jumps).T, strict=False):
        if vanishes.any():
            raise ValueError(
                f"The gap {name} is zero where two of its pieces meet, as abs(x) is at x = 0, and x % 1 at x = 1: it "
                "does not tell from which side it is to be kept, nor in which direction it pushes. Give each side a "
                "gap of its own, as x for x >= 0 and 1 - x for x <= 1."
            )
    touch = jumps[:, :count].copy()
    for k, of_slip in zip(rough, np.split(jumps[:, count:], max(len(rough), 1), axis=1), strict=False):
        touch[:, k] |= of_slip.any(axis=1)
    return Corners(touch, dataclasses.replace(program.select_outputs([]), line=found.sides))


def append_sides(program: Program, corners: Corners) -> Program:
    """The program with the sides of corners as further outputs."""
    return dataclasses.replace(program, line=with_outputs(program, corners.sides.line).line)  # type: ignore
