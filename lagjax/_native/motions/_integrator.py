"""The integration of a batch by Taylor series, as two LLVM functions: `begin`, and `run` for a number of rounds.

Every lane of a vector has one member. A round takes one step in each lane:

    coefficients   q and q̇ as power series about the current time (`_taylor`)
    choose         the step that the last two coefficients allow, per lane (`_step`); it ends at the first border of a
                   piecewise program (`_border_control`)
    check          the series must satisfy the equations of motion along the step, and end near its constraints
                   (`_projection`), or the step is halved
    stop           where a guard changes sign the step ends (`_events`)
    advance        outputs inside the step (`_run_records`), then the state at its end, summed with its rounding errors
                   carried along
    finish         a lane whose member has ended takes the next one of the batch

so that no lane waits for another. Several threads may run at once: they share the counter of members.
"""

from lagjax._native.code._constants import (
    DONE,
    EVENT,
    FIRST_STEP,
    LEAST_STEP,
    MAX_ORDER,
    OUT_OF_STEPS,
    RUNNING,
    SMALLEST_STEP,
)
from lagjax._native.code._frame import Frame, Lane, job_structure
from lagjax._native.code._ir import INTEGER, POINTER, Code, Value
from lagjax._native.series._guards import Guards
from lagjax._native.series._motion_parts import MotionParts
from lagjax._native.series._taylor import TaylorSeries, double, integer, is_large
from lagjax._native.steps import _rank_drops
from lagjax._native.steps._border_control import BorderControl
from lagjax._native.steps._events import Events
from lagjax._native.steps._projection import Projector
from lagjax._native.steps._roots import Roots
from lagjax._native.steps._run_records import OutputWriter
from lagjax._native.steps._step import PARTS, StepControl

JOB = job_structure(
    "Job",
    ("next_member", "ts", "y0", "params", "path", "y_end", "t_end", "code", "steps", "rejected", "record", "next_row"),
    # Strides from one member to the next: 0 where all share the output times, or the parameters.
    ("ts_stride", "params_stride", "members", "times", "order", "max_steps", "room", "room_of_notes"),
    ("rtol", "atol"),
    "changes",
)


class Integrator:
    """The module of an integrator, with public functions `begin` and `run`; `error_groups` as in `StepControl`."""

    job = JOB

    def __init__(self, parts: MotionParts, guards: Guards | None = None, error_groups=None, *, width: int):
        program, series, nesting, projection, borders, _ = parts
        n = series.size
        self.base_size = nesting.base
        self.guards = 0 if guards is None else len(guards.directions)
        self.notes = guards is not None and guards.notes  # in the place of states at output times
        fields = StepControl.fields(n) | OutputWriter.fields(n) | Events.fields(self.guards)
        fields["active"] = 1  # 1 in a lane that has a member
        if projection is not None:
            self.begins = _rank_drops.start_fields(2 * n, self.guards, 0 if borders is None else len(borders.guards))
            fields |= Projector.fields(n) | _rank_drops.fields(self.begins)
        if guards is not None:
            fields |= Roots.fields(MAX_ORDER + 2)
        if borders is not None:
            fields |= BorderControl.fields(borders)
        jump = parts.jump(over_steps=False)
        more = [line for line in (jump and jump.line, borders and borders.holding.retraction) if line]
        large = is_large(program, projection, guards, more=more)
        self.motion = motion = TaylorSeries("motion", parts, JOB, fields, large, width, kept=self.guards)
        self.projector = projection and Projector(motion, projection.state, projection.velocity_scale, self.base_size)
        groups = tuple(range(n)) if error_groups is None else error_groups
        self.step = StepControl(motion, groups, self.projector, self.base_size)
        self.borders = borders and BorderControl(motion, borders, nesting, projection is not None, jump)
        self.output = OutputWriter(motion, self.projector)
        roots = Roots(motion) if guards and self.borders is None else self.borders and self.borders.roots
        self.events = guards and roots and Events(motion, self.step, self.output, roots, guards)
        self.start_next = self._start_next()
        self._run_function()
        motion.write_begin(self.start_next)
        motion.finish()

    # ---- members ----

    def _start_next(self) -> Code:
        """Emit `(lane)`: load the next member into a lane, which becomes idle if none is left."""
        frame = self.motion.function("start_next", INTEGER)
        code, lane = frame.code, frame.lane(frame.arguments[0])
        member = frame.next("next_member")
        there = member < frame.job("members")
        lane["member"] = code.select(there, member, -1)
        for name in ("h", "t_low", "steps", "rejected", "pace", *(_rank_drops.AT_FIRST_ZERO if self.projector else ())):
            lane[name] = 0.0
        for k in range(2 * PARTS):
            lane["reach", k] = 0.0
        lane["active"] = code.flag(there)
        lane["code"], lane["due"], lane["event"] = float(RUNNING), float("inf"), -1.0
        with code.only_if(there):
            self._load_member(frame, lane, member)
        return frame.finish()

    def _load_member(self, frame: Frame, lane: Lane, member: Value) -> None:
        """Set the times, initial state and parameters of the member in a lane."""
        code, motion = frame.code, self.motion
        begin, end = (frame.time(member, i) for i in (0, frame.job("times") - 1))
        lane["t"], lane["t_end"] = begin, end
        lane["forward"] = code.select(end < begin, double(code, -1.0), 1.0)
        largest = code.maximum(abs(begin), abs(end))
        lane["smallest"] = code.maximum(SMALLEST_STEP * largest, double(code, LEAST_STEP))
        lane["longest"] = code.maximum(abs(end - begin) * FIRST_STEP, lane["smallest"])
        self.output.set_due_time(frame, lane, integer(code, 1))
        for i in motion.form.each(code, self.base_size if self.projector else 0):
            lane["velocity_scale", i] = 0.0
        for i in motion.form.each(code, motion.states):
            x = frame.read("y0", member * motion.states + i)
            lane["y", i] = x
            if not self.notes:
                frame.write("path", self.output.place(frame, member, 0, i), x)
            lane["low", i] = 0.0
        motion.take_numbers(frame, lane, member)
        if self.borders is not None:
            self.borders.begin(frame, lane)
        if self.events is not None:
            self.events.begin(frame, lane)

    # ---- rounds ----

    def _run_function(self) -> None:
        """Emit `run(job, memory, lanes, idle, rounds)`: 1 if more is to do after these; `idle` counts idle steps."""
        frame = self.motion.function("run", POINTER, INTEGER, result=INTEGER, public=True)
        code, (idle, rounds) = frame.code, frame.arguments
        order, borders = frame.job("order"), self.borders
        crossings = borders if self.motion.pieces else None  # features alone have no pieces
        kicks = crossings is not None and bool(crossings.borders.kicking)
        with self.motion.rounds(frame, rounds):
            if crossings is not None:
                frame.call(crossings.crossing.decide)
                if crossings.crossing.retract is not None:
                    frame.call(crossings.crossing.retract)
            frame.call(self.motion.coefficients, order)
            self.step.choose(frame, order)
            if borders is not None:
                frame.call(borders.stop, order)
            self.step.halve_until_sound(frame, order)
            if self.projector is not None:
                _rank_drops.retry_last_long_step(frame, self.motion.form, self.begins)
            if self.events is not None:
                self.events.end_step_at_event(frame, order)
            if crossings is not None:
                crossings.drop_missed_border(frame)
            with code.only_if(frame.job("room") > 0), code.loop(self.motion.width) as lane:
                retracts = crossings is not None and crossings.crossing.retraction is not None
                self.output.record(frame, frame.lane(lane), kicks, "unretracted" if retracts else "y")
            after, rest = self.step.end_time(frame)
            if not self.notes:
                self.output.write_due(
                    frame, order, after, crossings.table.kicks(frame) if crossings and kicks else None
                )
            self.step.advance(frame, after, rest, kicks)
            if crossings is not None:
                frame.call(crossings.crossing.cross)
            if self.projector is not None:
                _rank_drops.shorten_returned(frame)
            self._finish_members(frame, idle)
        frame.finish(self.motion.is_unfinished(frame))

    def _finish_members(self, frame: Frame, idle) -> None:
        """Write the results of members that have ended, and load the next ones."""
        code = frame.code
        ending, steps, rejected = (frame[name] for name in ("code", "steps", "rejected"))
        limit = code.as_double(frame.job("max_steps"))
        running = ending < 0.0
        counted = steps + rejected
        if self.motion.pieces:  # there are no more of those that end at entries of tables than there are entries
            counted = counted - frame["at_knots"]
        ending = code.select(running & (counted >= limit), OUT_OF_STEPS, ending)
        ending = code.select(frame["last"] > 0.0, DONE, ending)
        event = frame["event"]
        ending = code.select(event >= 0.0, event + float(EVENT), ending)
        frame["code"] = ending
        active = frame["active"] > 0.0
        with code.only_if(code.any_lane(~(active & (ending < 0.0)))), code.loop(self.motion.width) as j:
            lane = frame.lane(j)
            member = lane["member"]
            with code.only_if(member < 0):
                code.store(code.load(idle, INTEGER) + 1, idle)
            with code.only_if((member >= 0) & (lane["code"] >= 0.0)):
                self.output.write_end(frame, lane, states=not self.notes)
                if self.events is not None:
                    self.events.write_end(frame, lane)
                frame.call(self.start_next, j)
