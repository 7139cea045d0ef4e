"""The projection of the state onto the constraints, at the end of every step and at every output.

A Taylor step leaves the constraints by its local error. The projection of the scene, here a straight line like any
other, moves (q, q̇) back onto them. If it moves the state much farther than the error tolerance, it has failed, and the
step is halved.
"""

from lagjax._native.code._constants import PROJECTION_TOLERANCES, ROUND_OFF, START
from lagjax._native.code._frame import Fields, Frame, Index, Numbers
from lagjax._native.code._ir import Code, Value
from lagjax._native.series._taylor import TaylorSeries
from lagjax._native.steps._watch import reaches_border
from lagjax._program import Recurrent


class Projector:
    """The kernel functions of the projection; the first `base_size` of n coordinates satisfy the constraints.

    The rest are derivatives of them: how far they move does not count.
    """

    def __init__(self, motion: TaylorSeries, state: Recurrent, velocity_scale: Recurrent, base_size: int):
        self.motion, self.base_size = motion, base_size
        self.state, self.velocity_scale = state.line, velocity_scale.line
        self.project = self._project_end()

    @staticmethod
    def fields(n: int) -> Fields:
        return {
            "projected": 2 * n,  # the state at the end of the step, on the constraints
            "velocity_scale": n,  # of each coordinate; of derivatives it stays zero
        }

    def scales(self, i: Index) -> bool:
        """True if coordinate i may have a velocity scale, also if i is known at run time only."""
        return not isinstance(i, int) or i < self.base_size

    def project_state(self, frame: Frame, values: Numbers, increments: Numbers, s: Value) -> tuple[Numbers, Value]:
        """The projection of a state `values` at t + s, and its distance in units of `PROJECTION_TOLERANCES`.

        The series ends within the tolerance of the constraints. If it is much farther to the state that the projection
        finds, that is not the state of this motion: near a configuration where constraints become dependent there are
        several branches close together, and rounding of q decides on q̇.
        """
        code, n = frame.code, self.motion.n
        projected, farthest = self.motion.evaluate(frame, self.state, values, s), code.variable(frame.constant(0.0))
        first = code.compare("==", frame["steps"], 0.0)
        for i in (i + half for half in (0, n) for i in self.motion.form.each(code, self.base_size)):
            far = abs(projected[i] - values[i])
            size = abs(projected[i]) + abs(increments[i])
            error = (far - ROUND_OFF * size) * frame["scale", i] * (1 / PROJECTION_TOLERANCES)
            # A start may be off by more, as much as is taken for consistent.
            error = code.select(first, far / (START * (1.0 + size)), error)
            farthest.value = code.largest_or_nan(farthest.value, error)
        return projected, farthest.value

    def _project_end(self) -> Code:
        """Emit `()`: store the projected end of the step in `projected`, and its distance in `defect`."""
        frame = self.motion.function("project")
        code, states, form, h = frame.code, self.motion.states, self.motion.form, frame["h"]
        sums = form.room(frame, states)
        for i in form.each(code, states):
            sums[i] = end_of_step(frame, i)[0]
        projected, off = self.project_state(frame, sums, frame.vectors("increment", states), h)
        for i in form.each(code, states):
            frame["projected", i] = projected[i]
        if self.motion.pieces and self.base_size < self.motion.n:  # as in `ProjectedEnd`
            at_border = (frame["crossed"] > 0.0) & reaches_border(frame)
            for i in (i + half for half in (0, self.motion.n) for i in range(self.base_size, self.motion.n)):
                frame.assign(at_border, i, projected=sums[i])
        scales = self.motion.evaluate(frame, self.velocity_scale, projected, h)
        for i in form.each(code, self.base_size):
            frame["velocity_scale", i] = scales[i]
        defect = frame["defect"]
        frame["defect"] = code.select(off <= defect, defect, off)
        return frame.finish()


def end_of_step(frame: Frame, i: Index) -> tuple[Value, Value]:
    """Component i of the state at the end of the step, by the series, and its rounding error."""
    y = frame["y", i]
    increment = frame["increment", i] + frame["low", i]
    total = y + increment
    part = total - y
    return total, (y - (total - part)) + (increment - part)
