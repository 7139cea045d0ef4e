"""Every numerical choice of the kernels: what it bounds, where it comes from, and what happens if it is doubled."""

EPS = 2.0**-52

# ---- how a member ended ----------------------------------------------------------------------------------------------

DONE, OUT_OF_STEPS, STEP_TOO_SMALL, NOT_FINITE, SINGULAR, PROJECTION_FAILED, DISCONTINUOUS, EVENT = range(8)
# The kernel itself does not give `DISCONTINUOUS`: `_stopped` finds it about the state where it stopped.
# EVENT + Σ 4ᵏ (1 where guard k falls, 2 where it rises), over those that do so at that instant.
RUNNING = -1

# ---- series ----------------------------------------------------------------------------------------------------------

LEAST_ORDER, MAX_ORDER = 7, 20

# ---- step control ----------------------------------------------------------------------------------------------------

SAFETY = 0.9
ROUND_OFF = 256 * EPS  # of an acceleration
PLACES, LARGEST_UNIT = 16, 1e-6  # units in the last place of a coordinate; of what an acceleration varies
# A series that ends (free flight) allows any step, and a step that is too long sees nothing of what lies inside it.
FIRST_STEP, GROWTH, GROWTH_AFTER_REJECTION = 1 / 16, 5.0, 2.0  # of the whole time; of the step before
SMALLEST_STEP = 4 * EPS  # of the largest time: below this a step no longer moves the time reliably
CHECKS = (0.5, 1.0)  # where in the step its series is held against the equations

# ---- events ----------------------------------------------------------------------------------------------------------

INTERVALS = 8  # of a step, at whose ends they are looked at
BETWEEN = (1.382, 5.236)  # two places more, in intervals
SAMPLES = INTERVALS + 3 + len(BETWEEN)
JUMP = 2.0**20  # smallest steps: where a guard varies too fast for so short a step, it jumps
BISECTIONS = 60  # of an interval, to find the zero: beyond the digits of a double
SECTIONS, GOLDEN = 32, 0.6180339887498949  # to find where it is least: to half of the digits
TOUCHING = 1e-13  # of its size nearby: what goes no further through the surface has touched it
GUARD_NOISE, LITTLE = 64 * EPS, 1e-4  # rounding; of the step

# ---- constraints -----------------------------------------------------------------------------------------------------

PROJECTION_TOLERANCES = 16.0  # tolerances from the end of a series to the constraints, at most
START = 1e-5  # of the size of the state, the same for the first step
# Next to where constraints become dependent, rounding allows no step longer than the way there: steps become ever
# shorter, and none gets through. When they have become `SHORTER` by so much the last long one is taken once more, by a
# tenth shorter each time, so that it ends farther away and the next one gets through; so often at most.
SHORTER, RETAKEN, MOST_RETURNS = 1 / 64, 0.9, 16
