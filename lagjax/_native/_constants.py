"""Every numerical choice of the kernels: what it bounds, where it comes from, and what happens if it is doubled.

"Measured" means: varied by factors of two on free motions (double pendulum, Kepler at e = 0.9), borders (a wedge, a
bump and a pulse of the force), constrained ones (a double pendulum in Cartesian coordinates, a slider-crank through its
dead centres) and events (waves, grazing, two crossings 2e-5 apart). Else neither factor changed a step.
"""

from typing import NamedTuple

EPS = 2.0**-52  # from 1 to the next double


class Digits(NamedTuple):
    """The rounding of the numbers of a state, and of what is computed from them.

    - `round_off`: the rounding of an acceleration, and of a projected state, in parts of its size: some hundred
      operations, each half a unit in the last place. A scaled defect may contain it. It is for terms that cancel: in
      the motions above neither factor changed a step.
    - `unit`: an error of a few units in the last place of q, in parts of q, moves an acceleration in proportion to what
      it varies along the step.
    - `largest_unit`: beyond this `unit`, in parts of what q moves along the step, variations are not due to its moving.
      Measured on a pendulum after half a million turns at rtol = 1e-12, below what its angle resolves: without, 274
      steps and 328 rejected; with it 180 and 193; `unit` doubled the same, `largest_unit` doubled 105 and 89.
    - `small`: the square of what is less may be zero, and that of more than 1/`small` infinite.
    - `tiny`: what is less has terms that are zero, or have lost their digits, and counts as zero.
    """

    round_off: float
    unit: float
    largest_unit: float
    small: float
    tiny: float


DIGITS = Digits(256 * EPS, 16 * EPS, 1e-6, 2.0**-400, 2.0**-960)

# ---- how a member ended ----------------------------------------------------------------------------------------------

DONE, OUT_OF_STEPS, STEP_TOO_SMALL, NOT_FINITE, SINGULAR, PROJECTION_FAILED, DISCONTINUOUS, EVENT = range(8)
# The kernel itself does not give `DISCONTINUOUS`: `_stop_reason` finds it about the state where it stopped.
RUNNING = -1

# ---- series ----------------------------------------------------------------------------------------------------------

# Orders p = ⌈2 − ln(rtol)/2⌉ that a tolerance may ask for (Jorba & Zou, §3.2). 20 is that of the digits of a double:
# doubled, it would double the unrolled sums and be reached by no tolerance. 7 is that of 5e-5, for looser ones too; 14
# is that of 4e-11, and would be paid by tolerances that did not ask for it.
LEAST_ORDER, MAX_ORDER = 7, 20
# Beyond this angle sine and cosine are left to the C library, which knows enough digits of π. Cody and Waite's
# reduction with parts of 32 bits is exact for quotients of 21 bits, angles up to 2²⁰ π: doubled it still would be.
LARGEST_ANGLE = 2.0**20

# ---- the form of a kernel --------------------------------------------------------------------------------------------

# Operations of the programs of a kernel beyond which they stand in tables; a transpose has twice as many of its own.
# Measured on chains of 4 to 24 pendulums and 4 to 20 bodies in space. There LLVM takes 1 to 2 s for a straight line and
# 0.3 s for the walk along tables, which runs 1.2 times as long on chains and as long on bodies; with half of the border
# 1.4 times and as long. With twice as many operations LLVM takes 3 to 4 s. From 8000 on tables run faster, but for
# dense mechanisms, whose numbers fit into registers: an arm of six joints, 5200 operations, takes 1.6 times as long.
LARGEST_LINE = 1500
# A coordinate counts as this many operations there: what control, output and sums do with it is written out too.
# Measured on rows of masses with springs: LLVM takes 0.8 s for a straight line with 32 of them, 1.8 s with 60 and 8 s
# with 200, and 0.3 s for tables, which run 1.1 times as long with 16, 1.0 to 1.2 with 32, 0.8 to 1.0 with 60. Doubled,
# it would put 26 masses into tables in place of 44. A transpose has no more of it than a motion: for a chain of 8 and
# 32 masses LLVM takes 0.3 s longer for straight lines, and tables run 1.8 and 1.3 times as long.
OPERATIONS_PER_COORDINATE = 30
# How many alike operations are written out for one step along a table. Measured: eight as well run as long, two at most
# 7 % longer.
TIMES = 4, 2, 1
# Operations are joined to one that reads at most `LARGEST_TREE` numbers, where the same two come together `OFTEN`; in
# at most `ROUNDS` rounds of pairs of pairs. Measured: without, chains of 32 and 64 run 1.4 to 1.6 times as long;
# with 5 numbers a fifth longer, with 20 as long; with half of `OFTEN` the code is twice as long and runs no faster.
LARGEST_TREE, OFTEN, ROUNDS = 10, 24, 12

# ---- tolerances ------------------------------------------------------------------------------------------------------

# The absolute tolerance where none is given, in parts of rtol: for components that pass through zero. It is at most
# this part of the largest coordinate, or velocity, so far (`_step`), so that a small motion has its digits in any
# units. Measured on a Morse oscillator of size 1e-12: 1 costs a digit, 1/16 a third of one, 1/256 none and two steps in
# eighty more; the larger it is, the fewer motions of ordinary size are touched by it: here those below 1/60.
ATOL_OVER_RTOL, ATOL_OVER_MOTION = 1e-3, 1 / 16
# What was at rest at zero, and has had so many steps refused, half as many as it took, moves by rounding (`_step`):
# other steps hold at once, or after a halving or two. Meant, and measured, was 6; a limit of the same name made it 64.
# A start below `NOTHING` counts as zero then, in any units: impulses at rest leave velocities of 1e-50.
MOST_REFUSED, NOTHING = 64, 1e-30

# ---- step control ----------------------------------------------------------------------------------------------------

# Of the step at which the last terms of the series equal the tolerance (Jorba & Zou: e^(−0.7/(p−1)), about the same).
# Measured: doubled, as many steps are rejected as accepted, and errors grow 20 to 100 times; halved, twice the steps.
SAFETY = 0.9
# Where in the step its series must satisfy the equations, as parts of it. The end sees what lies ahead, the middle a
# narrow feature on the way. Each costs one acceleration.
CHECKS = (0.5, 1.0)
# A series that ends (free flight) allows any step, and a step that is too long sees nothing of what lies inside it. The
# first step is at most this part of the whole time, every other one `GROWTH` times the one before. Measured: with a
# growth of 10 a particle flies past a bump of the force in a tenth fewer steps with the same error, with 2.5 in a
# quarter more. A doubled first step changes the steps about the first border by a tenth.
FIRST_STEP, GROWTH = 1 / 16, 5.0
# After a rejected step, for what made it fail is near. Measured on a wedge: doubled, a third more steps are rejected.
GROWTH_AFTER_REJECTION = 2.0
# The smallest step, in parts of the largest time: a shorter one no longer moves the time reliably. Doubled, a motion
# that falls into a singularity stops four steps earlier. It is never zero, nor less than what a processor may take for
# zero: where `LEAST_STEP` is more than all the time there is, one step goes to its end.
SMALLEST_STEP, LEAST_STEP = 4 * EPS, 2.0**-1022

# ---- derivatives -----------------------------------------------------------------------------------------------------

# How small the first coefficients of a series may be against its largest term by chance, as those of 1/r at the
# pericentre: steps may be too long for derivatives where its last term is larger than their limit, times this. Doubled,
# or halved, steps of a fifteenth more or less are looked at once more. Measured: 0.3 looks at those of the planets.
NEAR_ZERO = 0.01

# ---- borders ---------------------------------------------------------------------------------------------------------

# A polynomial is zero where it is less than `ROOT_NOISE` EPS Σ |cₖ|: some twenty products and sums, each half a unit.
ROOT_NOISE = 16
# Moves towards a first root. Five to ten are usual; a double root to rounding takes some fifty. What is not found then
# ends the step where it has been looked, which costs one step.
MOST_MOVES = 128
# Before this part of the step a root is looked for once more, so often at most: its rounding is that of the whole step,
# which may be long. Each time takes seven digits.
EARLY, MOST_LOOKS = 0.25, 8
# Borders of several guards lie at one instant where their roots differ by so little: rounding of both, with room.
AT_ONCE = 2.0**-36
# Borders of one guard that are crossed at one instant, before the motion is said not to get on.
MOST_CROSSINGS = 4
# Of atol: by what a motion along a border may leave it in a step, which rounding of what holds it there does.
NEGLIGIBLE = 1e-3
# Once every border was met at one instant, and some are met again, it is more with each turn, by the fifth power of
# their number: rounding grows with the forces, whose size is not known here. A million times as much is 1e-9 by the
# default tolerances; blocks held by forces of 1000 need some ten turns.
MOST_TURNS = 16.0
# Of atol: the length of a vector of velocities at which dry friction has stopped it, and half of that with which it
# sets out again. What is left of the way is the square of the first, 1e-9 at the default tolerances: doubled, first
# derivatives are off by so much more; with a hundredth of it the coefficients of their series overflow. The second one
# is an error of velocities.
AT_REST, SETS_OUT = 1e3, 16.0
# Smallest steps before its end in which a length is not followed: it counts as none. Doubled, it ends so much earlier.
LAST_STEPS = 16.0
# By which part of itself that length may grow in a step: tangents across it have a series of this ratio. Doubled, steps
# from rest are half as many, some 50, and what is left out of a series of order 20 is 1e-6 of a tangent.
GROWTH_OF_LENGTH = 0.25
# A border that is reached within this part of the smallest step from another one is bounced off without end: the
# motion rests on it. What is left of its velocity is as small as that.
NO_TIME = 0.25
# A switching number is known along a step where its last terms are at most `SWITCH_TOLERANCES` tolerances of its size.
# They are less than one in a step that suits the state, unless the number is another one than that: then it is halved.
SWITCH_TOLERANCES, MOST_HALVINGS = 16.0, 64
# Below atol they are at most this part of its size, so that what approaches zero for ever, as exp(−s), keeps its sign:
# its series has it up to s = 3 at the order of the default tolerance. Doubled, that of order 20 loses it.
RESOLVED = 2.0**-17
# exp(u) below u = −`FAINT` is 2e-35: nothing, whatever it is multiplied with. Above it, u may rise in one step by
# `RISE` parts of the order p: then exp(u) is the sum of terms Rᵏ/k! that fall from the last one on, as steps expect.
FAINT, RISE = 80.0, 0.5
# exp(u) is infinite above u = 709.8: steps from above end below that, and fall by no more than they may rise as long as
# its coefficients may be infinite, e²⁰⁰ times the twentieth power of a rate. Doubled, only rates up to 1e6 are told.
BEYOND, STEEP = 700.0, 200.0
# From an argument as large as this on it is not known to a tenth: then the way to the feature is gone in parts.
FAR = 2.0**40
# The last terms of the argument of a feature, at most; of a base, in parts of what it falls or rises to.
ARGUMENT = 0.1
# A power of u may rise by as much as exp(u) with u; but its base falls to this part of itself at most, to which its
# series has to tell it. Doubled, a feature a millionth of the way wide takes one step more, of seven.
LARGEST_FALL = 1 / 64
# Where a base comes to zero, steps end ever nearer to that; and no more where this part of the first one is left. What
# is narrower is missed.
NARROWEST = 2.0**-30
# Where no series begins beyond a border a step goes `SHORT_OF` the way to it, and when that is less than `NEARBY` of
# the step, `PAST` times that: if what is beyond matters it fails its check, and half of it does not end at the border.
# What is narrower is missed. The last terms of the switching number are to be `ABRUPT` of it, at most.
SHORT_OF, NEARBY, PAST, ABRUPT = 0.9, 1e-4, 1.7, 1e-3
# Of an acceleration: a smaller difference between both sides of a border is no jump. It stands far above rounding.
JUMP_NOISE = 2.0**-34

# ---- events ----------------------------------------------------------------------------------------------------------

# The last three terms of the series of a guard along a step, in parts of Σ |cₖ|, at most: else the step ends where they
# are that small. Those of the state are, at the loosest tolerance; a guard that varies faster makes steps of its own.
GUARD_TERMS = 1 / 128
# And they are to be this part of the three before them, by a half each, or else less than what can be seen: terms that
# do not fall are those of a pole ahead, about which the guard may do anything.
FALL, SEEN = 1 / 8, 2.0**-48
# A guard that was zero where a step ended at a border of its own is so at the beginning of the next one, if it is not
# more than this part of Σ |cₖ|: it has not jumped.
CONTINUOUS = 2.0**-20
# Changes of one guard in one step: more than the roots of its polynomial.
MOST_CHANGES = 32
# Newton's steps from the root of the polynomial to that of the guard: two or three at the tolerances there are.
MOST_CORRECTIONS = 8
# A guard that comes to zero to rounding, from this many times as much, may go through it and back unseen: the step ends
# there, and the next one, which begins near, has less rounding. One that is rounding all along ends no steps.
MEETS = 16.0
# Where a guard has no series, this part of the step is taken, and its end looked at.
WITHOUT_SERIES = 1 / 8
# Halvings of such a step to find the zero: more than the digits of a double.
BISECTIONS = 60
# Where a run begins, a guard of less than `GUARD_NOISE` Σ |∂g/∂yᵢ yᵢ|, or that its rate makes up for within `INSTANT`
# smallest steps, is on the surface: it takes its side from its rate, or from where it is after `LITTLE` of the step.
# A reset leaves a state on the surface to some ten roundings; doubled, a start next to a surface counts as one on it.
GUARD_NOISE, INSTANT, LITTLE = 64 * EPS, 16.0, 1e-4
# The same for numbers that came in as float32, in parts of each: eight roundings. Its own is one, what computed it (a
# cosine and a radius, steps of a grid) makes some five. Doubled, a start 1e-6 of its size beside a surface counts as
# one on it; halved, one that is a sum of three products may pass through.
SINGLE_NOISE = 4 * 2.0**-23

# ---- constraints -----------------------------------------------------------------------------------------------------

# Tolerances from the end of a series to its projection, at most. The series is within about one of the constraints; by
# how much more the projection moves it is a matter of conditioning. Measured on a slider-crank 1e-9 beside its dead
# centre: halved, a fifth more steps are rejected, doubled as many; far from a dead centre neither matters.
PROJECTION_TOLERANCES = 16.0
# The same for the first step, in parts of the size of the state: ten times the residual (1e-6) with which a start is
# accepted as consistent. Doubled it would hide no more than that check does.
START = 1e-5
# When steps have become `SHORTER` than the last long one by so much, that one is taken once more, shorter by `RETAKEN`
# each time, so that it ends farther away and the next one gets through; so often at most. Measured on the dead centre
# of a slider-crank: without, it does not get through. With `SHORTER` doubled or halved it does in as many steps, with a
# quarter fewer or an eighth more rejected; the number of returns, doubled or halved, is not reached.
SHORTER, RETAKEN, MOST_RETURNS = 1 / 64, 0.9, 16

# ---- threads ---------------------------------------------------------------------------------------------------------

# Members that make a thread worth its start, in vectors. Doubled, batches of up to that size run on half the cores.
VECTORS_PER_THREAD = 4
# What an adjoint costs beside its motion: 16 members go back on two threads. Halved, they do on one.
MOTIONS_PER_ADJOINT = 4
