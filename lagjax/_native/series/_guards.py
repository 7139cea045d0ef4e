"""Guards: functions of the state whose sign is watched along a motion; they are part of its program."""

import functools
from typing import NamedTuple

from lagjax._native.series._lanes import INTEGERS
from lagjax._program import Borders, Recurrent, Series, StraightLine, Unlowerable, borders, series, with_outputs


class Guards(NamedTuple):
    """Functions gᵢ of the state that are watched; `directions` (−1, 0 or +1) says which sign changes count.

    A change that counts ends the motion or, with `notes`, is recorded. `values` computes all g. The outputs of
    `program` are, with y the state and the time: all g; their rates ġ = Σ ∂g/∂yᵢ ẏᵢ; then Σ |∂g/∂yᵢ yᵢ| and Σ |∂g/∂yᵢ
    ẏᵢ|, the scales of their rounding errors; and, if there are five per guard, the error due to a start rounded to
    float32.

    With `remembers` a member has two further parameters per guard: the rounding error of g, with the sign of the side
    from which the motion comes (0: unknown; infinite: a motion beyond the surface has changed its side in any case),
    and the rounding error of ġ. With `is_rounded` the start is rounded more coarsely than the motion: a guard that is
    zero to that rounding is zero. A guard that `holds` ends at once a motion that starts beyond it, in its direction.
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
        """The number of parameters of a member that guards remember."""
        return 2 * len(self.directions) if self.remembers else 0


class WatchedProgram(NamedTuple):
    """A program whose last outputs are guards and their rounding errors, its series, and its borders."""

    program: Recurrent
    series: Series
    borders: Borders | None


@functools.lru_cache(maxsize=32)
def append_guards(program: Recurrent, size: int, values: Recurrent, slides: bool) -> WatchedProgram:
    """A program of q̈ with guards as further outputs. Raises `Unlowerable` if a guard has no series."""
    count = len(values.line.outputs)
    whole = with_outputs(program, values.line, 2 * size + 1)
    require_vectorizable(whole.line)
    try:
        if (found := borders(whole, size, slides, count)) is not None:
            return WatchedProgram(found.program, _series_of_guards(found.program, size, found.followed, count), found)
    except Unlowerable:  # a switching number without a series, or more operations than that takes
        pass
    return WatchedProgram(whole, _series_of_guards(whole, size, (), count), None)


def require_vectorizable(line: StraightLine) -> None:
    """Raise `Unlowerable` if a program has integer operations that vectors of doubles cannot compute."""
    for (op, _, _), kind in zip(line.nodes, line.kinds, strict=True):
        if kind not in ("float", "bool") and op not in ("input", "constant", "convert", *INTEGERS):
            raise Unlowerable(f"`{op}` of integers is not for vectors of doubles")


def _series_of_guards(program: Recurrent, size: int, nodes: tuple[int, ...], count: int) -> Series:
    guards = program.line.outputs[len(program.line.outputs) - count :]
    return series(program, size, moving=2 * size + 1, followed=(*nodes, *guards))
