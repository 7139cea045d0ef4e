"""The way back to the constraints, from the end of every step and from every output.

A step by Taylor series leaves the constraints by its local error. The scene's own projection moves (q, q̇) back onto
them; here it is a straight line like any other. It must not move the state much farther than the step may be wrong:
then the projection has failed, and the step is halved.
"""

from lagjax._native._constants import PROJECTION_TOLERANCES, ROUND_OFF, START
from lagjax._native._frame import Frame
from lagjax._native._ir import Code, Value
from lagjax._native._series import Motion
from lagjax._program._series import Recurrent


class Projector:
    """The projection of a motion, of whose n coordinates the first `base_size` are bound by constraints.

    The others are derivatives of them, which follow: how far they move says nothing about the step.
    """

    def __init__(self, motion: Motion, state: Recurrent, velocity_scale: Recurrent, base_size: int):
        self.motion, self.base_size = motion, base_size
        self.state, self.velocity_scale = state.line, velocity_scale.line
        self.project = self._project()

    @staticmethod
    def fields(n: int, base_size: int) -> dict:
        """What a thread remembers for it: the projected state at the end of the step, and velocity scales."""
        return {"projected": 2 * n, "velocity_scale": base_size}

    def projected(
        self, frame: Frame, values: list[Value], increments: list[Value], s: Value
    ) -> tuple[list[Value], Value]:
        """The projection of a state of the series at t + s, and its distance in `PROJECTION_TOLERANCES`.

        The series ends within the tolerance of the constraints. If it is much farther to the state that the projection
        finds, that is not the state of this motion: near a configuration where constraints become dependent there are
        several branches close together, and rounding of q decides on q̇.
        """
        code, n = frame.code, self.motion.n
        projected, off = self.motion.evaluate(frame, self.state, values, s), frame.constant(0.0)
        first = code.compare("==", frame["steps"], 0.0)
        for i in (*range(self.base_size), *range(n, n + self.base_size)):
            far = code.intrinsic("fabs", projected[i] - values[i])
            size = code.intrinsic("fabs", projected[i]) + code.intrinsic("fabs", increments[i])
            error = (far - ROUND_OFF * size) * frame["scale", i] * (1 / PROJECTION_TOLERANCES)
            # A start may be off by more, as much as is taken for consistent.
            error = code.select(first, far / (START * (1.0 + size)), error)
            off = code.select(error <= off, off, error)  # NaN goes through
        return projected, off

    def _project(self) -> Code:
        """`()`: the end of the step back on the constraints, into `projected`; how far it was, into `defect`."""
        frame = self.motion.function("project")
        code, states, h = frame.code, self.motion.states, frame["h"]
        sums = [end_of_step(frame, i)[0] for i in range(states)]
        projected, off = self.projected(frame, sums, [frame["increment", i] for i in range(states)], h)
        for i, value in enumerate(projected):
            frame["projected", i] = value
        for i, value in enumerate(self.motion.evaluate(frame, self.velocity_scale, projected, h)):
            frame["velocity_scale", i] = value
        defect = frame["defect"]
        frame["defect"] = code.select(off <= defect, defect, off)
        return frame.finish()


def end_of_step(frame: Frame, i: int) -> tuple[Value, Value]:
    """Component i of the state at the end of the step, by the series, and what rounding takes from it."""
    y = frame["y", i]
    increment = frame["increment", i] + frame["low", i]
    total = y + increment
    part = total - y
    return total, (y - (total - part)) + (increment - part)
