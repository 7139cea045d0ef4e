"""Guards: functions of the state that are watched along a motion, as part of the program of its acceleration."""

import functools
from typing import NamedTuple

from lagjax._native.series._lanes import INTEGERS
from lagjax._program import Borders, Recurrent, Series, StraightLine, Unlowerable, borders, series, with_outputs


class Guards(NamedTuple):
    """Functions of the state that are watched, and for each −1, 0 or +1: when a change of its sign counts.

    That ends the motion or, with `notes`, is written down. `values` gives all g. With y the state and the time, the
    outputs of `program` are all g; their rates ġ = Σ ∂g/∂yᵢ ẏᵢ; then Σ |∂g/∂yᵢ yᵢ| and Σ |∂g/∂yᵢ ẏᵢ|, of which
    round-off is a part; and, if there are five of each guard, how far the rounding of a start in float32 moves it. A
    motion that `remembers` has two numbers more for each guard, behind its parameters: how far rounding may have moved
    them, with the sign of the side from which the motion comes, 0 where that is unknown, and infinite where a motion
    that is beyond the surface has changed its side wherever it goes; then how far rounding may have moved their rates.
    Of a start that `is_rounded`, more coarsely than the motion, a guard that is zero to rounding is zero: its surface
    passes through the start. A guard that `holds` ends a motion at once that begins beyond it, in its direction.
    """

    values: Recurrent
    program: Recurrent
    directions: tuple[int, ...]
    notes: bool = False
    remembers: bool = False
    is_rounded: bool = False
    holds: tuple[bool, ...] = ()

    @property
    def inputs(self) -> int:
        """The count of numbers of a member that are remembered."""
        return 2 * len(self.directions) if self.remembers else 0


class Watched(NamedTuple):
    """A program with guards, and how rounding moves them, as its last outputs; the series of both, and its borders."""

    program: Recurrent
    series: Series
    borders: Borders | None


@functools.lru_cache(maxsize=32)
def append_guards(program: Recurrent, size: int, values: Recurrent, slides: bool) -> Watched:
    """A program of q̈ with guards behind it. Raises `Unlowerable` where one of them has no series."""
    count = len(values.line.outputs)
    whole = with_outputs(program, values.line, 2 * size + 1)
    require_lanes(whole.line)
    try:
        if (found := borders(whole, size, slides, count)) is not None:
            return Watched(found.program, _series_of_guards(found.program, size, found.followed, count), found)
    except Unlowerable:  # a switching number without a series, or more operations than that takes
        pass
    return Watched(whole, _series_of_guards(whole, size, (), count), None)


def require_lanes(line: StraightLine) -> None:
    """Raise `Unlowerable` where the lanes of a kernel cannot run a program."""
    for (op, _, _), kind in zip(line.nodes, line.kinds, strict=True):
        if kind not in ("float", "bool") and op not in ("input", "constant", "convert", *INTEGERS):
            raise Unlowerable(f"`{op}` of integers is not for vectors of doubles")


def _series_of_guards(program: Recurrent, size: int, nodes: tuple[int, ...], count: int) -> Series:
    guards = program.line.outputs[len(program.line.outputs) - count :]
    return series(program, size, moving=2 * size + 1, followed=(*nodes, *guards))
