"""The programs that a kernel is made from: those of a motion, its Taylor series, and the borders between its pieces."""

import functools
from dataclasses import replace
from typing import NamedTuple

from lagjax._native.series._guards import Guards, append_guards, require_vectorizable
from lagjax._program import (
    BESIDE,
    LOOK_UPS,
    Borders,
    Jump,
    Nesting,
    PiecedProgram,
    Recurrent,
    Series,
    Unlowerable,
    borders,
    jump_at_border,
    series,
    shift_look_up,
    with_borders_of_tangents,
)


class Projection(NamedTuple):
    """Two programs of (q, q̇, t, parameters) that keep a motion on its constraints.

    `state` gives the projected state (q, q̇), 2n numbers. `velocity_scale` gives n numbers: the error of a velocity is
    measured relative to its scale if that is larger than the velocity.
    """

    state: Recurrent
    velocity_scale: Recurrent


class ChosenParameters(NamedTuple):
    """The parameters of a member that a motion computes with: those at `positions` among `of`; tables read the rest."""

    positions: tuple[int, ...]
    of: int


class MotionParts(NamedTuple):
    """The parts of a motion from which its integrator, its tangents and its adjoint are built.

    - `program`: q̈ and whether the mass matrix is singular, then numbers that are followed along a step. Its last inputs
      are the pieces, where there are `borders` between some.
    - `series`: the Taylor series of the motion along a piece.
    - `nesting`: which of the coordinates are tangents of others.
    - `projection`: that onto the constraints; None without constraints. `chosen`: the parameters of a member that the
      programs compute with; None for all.
    """

    program: Recurrent
    series: Series
    nesting: Nesting
    projection: Projection | None = None
    borders: Borders | None = None
    chosen: ChosenParameters | None = None

    @property
    def pieces(self) -> int:
        """The number of pieces among the inputs of the program."""
        return 0 if self.borders is None else len(self.borders.switches)

    @property
    def kicks(self) -> bool:
        """True if L jumps at a border, so that velocities do."""
        return self.borders is not None and bool(self.borders.kicking)

    @property
    def varied(self) -> list[int]:
        """The positions of the inputs with derivatives: all floats except the time and the pieces."""
        dtypes, time = self.program.dtypes, 2 * self.series.size
        moving = dtypes[: len(dtypes) - self.pieces]
        return [i for i, dtype in enumerate(moving) if dtype.kind == "f" and i != time]

    @property
    def numbers_of_motion(self) -> int:
        """The number of parameters of a member of the motion without tangents, if tables read some of them; else 0."""
        return 0 if self.chosen is None else self.chosen.of * self.nesting.base // self.nesting.size

    def jump(self, over_steps: bool) -> Jump | None:
        """The jump of tangents at borders; None without tangents. `over_steps` adds a derivative of taken steps."""
        nesting = self.nesting.with_tangents(1) if over_steps else self.nesting
        if not self.pieces or self.borders is None or not nesting.directions:
            return None
        return jump_at_border(self.borders.motion or self.borders, *nesting, self.numbers_of_motion, over_steps)

    @classmethod
    def from_program(
        cls, program: Recurrent, size: int, projection: Projection | None = None, chosen: ChosenParameters | None = None
    ) -> "MotionParts":
        """The parts of a motion with `size` coordinates whose borders, if any, are ignored."""
        return cls(program, recurrences(program, size), Nesting(size), projection, chosen=chosen)

    def append_guards(self, nesting: Nesting, guards: Guards | None, motion: Recurrent | None) -> "MotionParts":
        """The parts of a run, from those of the smooth motion: with pieces, and with guards as outputs after q̈."""
        size, whole = nesting.size, self._replace(nesting=nesting)
        if guards is not None:
            program, series, found = append_guards(self.program, size, guards.values, not nesting.directions)
            return whole._replace(program=program, series=series, borders=found)
        if (pieces := pieces_of(self.program, nesting, motion, whole.numbers_of_motion)) is None:
            return whole
        found, series = pieces
        return whole._replace(program=found.program, series=series, borders=found)

    @property
    def drop_guards(self) -> "MotionParts":
        """The parts of a piecewise motion without its guards."""
        assert self.borders is not None
        of, size = self.borders.program, self.nesting.size
        program = replace(of, line=of.line.replace(outputs=of.line.outputs[: size + 1]))
        return self._replace(program=program, series=series_of_pieces(program, size, self.borders))


@functools.lru_cache(maxsize=16)
def choose_parameters(
    program: Recurrent, projection: Projection | None, guards: Guards | None, motion: Recurrent | None, nesting: Nesting
) -> "tuple[Recurrent, Projection | None, Guards | None, Recurrent | None, ChosenParameters | None]":
    """The programs reduced to the parameters that they compute with, tables reading the rest; and which ones these are.

    The same parameters are chosen in every row of the `nesting`; `motion` is the program of the first row alone.
    """
    first, rows = 2 * nesting.size + 1, nesting.size // nesting.base
    programs: list = [program]
    programs += [] if projection is None else [projection.state, projection.velocity_scale]
    programs += [] if guards is None else [guards.values, guards.program]
    mechanics = [m for one in programs if (m := getattr(one, "mechanics", None)) is not None]
    lines = [*(one.line for one in programs), *mechanics]
    if not any(op in LOOK_UPS for line in lines for op, _, _ in line.nodes):
        return program, projection, guards, motion, None
    read = {node[2] - first for line in lines for node in line.nodes if node[0] == "input"}
    of, kinds = program.size - first, program.dtypes[first:]  # a guard's own program ends before the sides
    read |= set() if guards is None else set(range(of - guards.inputs, of))
    if motion is not None:
        of_motion = [line for line in (motion.line, getattr(motion, "mechanics", None)) if line is not None]
        read |= {node[2] - 2 * nesting.base - 1 for line in of_motion for node in line.nodes if node[0] == "input"}
    own = of // rows
    columns = sorted({i % own for i in read if i >= 0}) if own else []
    positions = tuple(row * own + i for row in range(rows) for i in columns)

    def reduce_program(one, first=first, positions=positions):
        place = {first + i: first + k for k, i in enumerate(positions)}

        def reduce_attribute(op, a):
            return place.get(a, a) if op == "input" else shift_look_up(a, BESIDE - first) if op in LOOK_UPS else a

        def reduce_line(line):
            return line and line.replace(nodes=tuple((op, of, reduce_attribute(op, a)) for op, of, a in line.nodes))

        dtypes = (*one.dtypes[:first], *(kinds[i] for i in positions))
        size, mechanics = first + len(positions), reduce_line(getattr(one, "mechanics", None))
        return PiecedProgram(reduce_line(one.line), size, dtypes, one.linear, mechanics)

    done = iter([reduce_program(one) for one in programs])
    return (
        next(done),
        projection and Projection(next(done), next(done)),
        guards and guards._replace(values=next(done), program=next(done)),
        None if motion is None else reduce_program(motion, 2 * nesting.base + 1, columns),
        ChosenParameters(positions, of),
    )


@functools.lru_cache(maxsize=16)  # used where the engine is chosen, and where it is compiled
def recurrences(program: Recurrent, size: int) -> Series:
    """The Taylor series of a smooth motion. Raises `Unlowerable` if vectors of doubles cannot compute the program."""
    require_vectorizable(program.line)
    return series(program, size, moving=2 * size + 1)


def series_of_pieces(program: Recurrent, size: int, found: Borders) -> Series:
    """The Taylor series of a motion along a piece, and of its switching numbers and feature arguments."""
    return series(program, size, moving=2 * size + 1, followed=found.followed)


@functools.lru_cache(maxsize=16)
def pieces_of(
    program: Recurrent, nesting: Nesting, motion: Recurrent | None = None, member: int = 0
) -> "tuple[Borders, Series] | None":
    """The borders of a piecewise program, and the series of its motion along a piece; None if it is smooth.

    With tangents the borders are those of the `motion` alone, which has `member` parameters, renumbered.
    """
    size = nesting.size
    if nesting.directions:
        assert motion is not None
        if (of_motion := pieces_of(motion, Nesting(nesting.base))) is None:
            return None
        found = of_motion[0]
        for inner, directions in nesting.levels:
            found = with_borders_of_tangents(found, inner, directions, member * (inner // nesting.base))
        return found, series_of_pieces(found.program, size, found)
    try:
        if (found := borders(program, size)) is not None:
            return found, series_of_pieces(found.program, size, found)
    except Unlowerable:  # a switching number without a series, or more operations than that takes
        pass
    return None
