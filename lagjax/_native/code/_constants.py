"""Every numerical constant of the kernels: what it bounds, where it comes from, and what happens if it is doubled.

"Measured" means: varied by factors of two on free motions (double pendulum, Kepler at e = 0.9), borders (a wedge, a
bump and a pulse of the force), constrained ones (a double pendulum in Cartesian coordinates, a slider-crank through its
dead centres) and events (waves, grazing, two crossings 2e-5 apart). Where nothing is said, neither factor changed a
step.
"""

EPS = 2.0**-52  # from 1 to the next double
# The relative rounding error of an acceleration, and of a projected state: some hundred operations, each half a unit in
# the last place. A scaled defect may contain it. It allows for cancellation: in the motions above neither factor
# changed a step.
ROUND_OFF = 256 * EPS
# The relative rounding error of q, a few units in the last place. It changes an acceleration in proportion to the
# variation of the acceleration along the step. If it exceeds the fraction `LARGEST_UNIT` of the change of q along the
# step, the variation of the acceleration is rounding, and is not counted. Measured on a pendulum after half a million
# turns at rtol = 1e-12, below the resolution of its angle: without, 274 steps and 328 rejected; with it 180 and 193;
# `UNIT` doubled the same, `LARGEST_UNIT` doubled 105 and 89.
UNIT, LARGEST_UNIT = 16 * EPS, 1e-6
SMALL = 2.0**-400  # squares of smaller numbers may underflow to zero, squares of numbers above 1/`SMALL` may overflow
TINY = 2.0**-960  # terms of smaller numbers are zero or have lost their digits; such a number counts as zero

# ---- how a member ended ----------------------------------------------------------------------------------------------

DONE, OUT_OF_STEPS, STEP_TOO_SMALL, NOT_FINITE, SINGULAR, PROJECTION_FAILED, DISCONTINUOUS, EVENT = range(8)
# The kernel itself does not give `DISCONTINUOUS`: `_stop_reason` finds it about the state where it stopped.
RUNNING = -1

# ---- series ----------------------------------------------------------------------------------------------------------

# Orders p = ⌈2 − ln(rtol)/2⌉ that a tolerance may ask for (Jorba & Zou, §3.2). 20 is that of the digits of a double:
# doubled, it would double the unrolled sums and be reached by no tolerance. 7 is that of 5e-5, for looser ones too; 14
# is that of 4e-11, and would be paid by tolerances that did not ask for it.
LEAST_ORDER, MAX_ORDER = 7, 20
# Sine and cosine of larger angles are evaluated by the C library, whose reduction has enough digits of π. Cody and
# Waite's reduction with parts of 32 bits is exact for quotients of 21 bits, angles up to 2²⁰ π; so it is if doubled.
LARGEST_ANGLE = 2.0**20

# ---- the form of a kernel --------------------------------------------------------------------------------------------

# Operations of the programs of a kernel beyond which they stand in tables; a transpose has twice as many of its own.
# Measured on chains of 4 to 24 pendulums and 4 to 20 bodies in space. There LLVM takes 1 to 2 s for a straight line and
# 0.3 s for the walk along tables, which runs 1.2 times as long on chains and as long on bodies; with half of the border
# 1.4 times and as long. With twice as many operations LLVM takes 3 to 4 s. From 8000 on tables run faster, but for
# dense mechanisms, whose numbers fit into registers: an arm of six joints, 5200 operations, takes 1.6 times as long.
LARGEST_LINE = 1500
# A coordinate counts as this many operations there: step control, outputs and sums are unrolled over coordinates too.
# Measured on rows of masses with springs: LLVM takes 0.8 s for a straight line with 32 of them, 1.8 s with 60 and 8 s
# with 200, and 0.3 s for tables, which run 1.1 times as long with 16, 1.0 to 1.2 with 32, 0.8 to 1.0 with 60. Doubled,
# it would put 26 masses into tables in place of 44. A transpose has no more of it than a motion: for a chain of 8 and
# 32 masses LLVM takes 0.3 s longer for straight lines, and tables run 1.8 and 1.3 times as long.
OPERATIONS_PER_COORDINATE = 30
# Operations of one kind that are unrolled in one step along a table. Measured: eight take as long, two 7 % longer.
TIMES = 4, 2, 1
# Two operations that occur together at least `OFTEN` times are fused into one, which reads at most `LARGEST_TREE`
# numbers; in at most `ROUNDS` rounds, each of which fuses pairs. Measured: without, chains of 32 and 64 take 1.4 to 1.6
# times as long; with 5 numbers a fifth longer, with 20 as long; `OFTEN` halved doubles the code, which is no faster.
LARGEST_TREE, OFTEN, ROUNDS = 10, 24, 12

# ---- tolerances ------------------------------------------------------------------------------------------------------

# The default absolute tolerance as a fraction of rtol, for components that pass through zero. It is at most
# `ATOL_OVER_MOTION` of the largest coordinate, or velocity, so far (`_step`), so that a small motion keeps its digits
# in any units. Measured on a Morse oscillator of size 1e-12: 1 costs a digit, 1/16 a third of one, 1/256 none and two
# steps in eighty more. It changes motions smaller than 1/60; the larger the fraction, the fewer these are.
ATOL_OVER_RTOL, ATOL_OVER_MOTION = 1e-3, 1 / 16
# After `MOST_REFUSED` rejected steps, if they are a third of all, what was at rest at zero moves by rounding (`_step`);
# steps for any reason of the motion hold after a halving or two. A start below `NOTHING` counts as zero then, in any
# units: impulses at rest leave velocities of 1e-50. Measured on borders, belts and stacks: 64 changes no result.
MOST_REFUSED, NOTHING = 6, 1e-30

# ---- step control ----------------------------------------------------------------------------------------------------

# The step as a fraction of that at which the last terms of the series equal the tolerance (Jorba & Zou use
# e^(−0.7/(p−1)), about the same).
# Measured: doubled, as many steps are rejected as accepted, and errors grow 20 to 100 times; halved, twice the steps.
SAFETY = 0.9
# Points of the step, as fractions of it, at which its series must satisfy the equations. The check at the end detects
# what lies ahead, that in the middle a narrow feature within the step. Each costs one acceleration.
CHECKS = (0.5, 1.0)
# A series that ends (free flight) allows any step, and a step that is too long misses features that lie inside it. The
# first step is at most `FIRST_STEP` of the whole time, each later one `GROWTH` times the one before. Measured: with a
# growth of 10 a particle flies past a bump of the force in a tenth fewer steps with the same error, with 2.5 in a
# quarter more. A doubled first step changes the steps about the first border by a tenth.
FIRST_STEP, GROWTH = 1 / 16, 5.0
# The same after a rejected step, whose cause is near. Measured on a wedge: doubled, a third more steps are rejected.
GROWTH_AFTER_REJECTION = 2.0
# The smallest step, as a fraction of the largest time: a shorter one no longer advances the time reliably. Doubled, a
# motion that falls into a singularity stops four steps earlier. It is at least `LEAST_STEP`, the smallest normal
# number; a motion that is shorter than that takes one step.
SMALLEST_STEP, LEAST_STEP = 4 * EPS, 2.0**-1022

# ---- derivatives -----------------------------------------------------------------------------------------------------

# The first coefficients of a series may be small by chance, as those of 1/r at the pericentre, down to this fraction of
# its largest term. A step is checked for derivatives if its last term exceeds their limit times this. Doubled or
# halved, a fifteenth more or fewer steps are checked. Measured: with 0.3 those of the planets are.
NEAR_ZERO = 0.01

# ---- borders ---------------------------------------------------------------------------------------------------------

# A polynomial is zero if it is less than `ROOT_NOISE` EPS Σ |cₖ|: some twenty products and sums, each half a unit.
ROOT_NOISE = 16
# Iterations towards a first root. Five to ten are usual; a double root to rounding takes some fifty. If they do not
# suffice, the step ends where the search ended, which costs one step.
MOST_MOVES = 128
# A root in the first `EARLY` part of the step is located again on a shorter step, at most `MOST_LOOKS` times: its
# rounding is that of the whole step, which may be long. Each repetition gains seven digits.
EARLY, MOST_LOOKS = 0.25, 8
# Several guards change at one instant if their roots differ by less than this fraction of the step: rounding of both.
AT_ONCE = 2.0**-36
# Borders of one guard that may be crossed at one instant; beyond, the motion stops with a result that says so.
MOST_CROSSINGS = 4
# A motion along a border may leave it by this fraction of atol in a step, by rounding of the force that holds it.
NEGLIGIBLE = 1e-3
# Several active borders can be left and reached alternately because of rounding. Therefore the threshold grows as the
# fifth power of the number of repetitions at one instant, up to `MOST_TURNS`: rounding grows with the forces, which are
# unknown here. A million times it is 1e-9 at the default tolerances; blocks held by forces of 1000 need ten.
MOST_TURNS = 16.0
# In units of atol: the length of a vector of velocities below which dry friction has stopped it, and half the length
# with which it starts to move again. The distance left is the square of the first, 1e-9 at the default tolerances:
# doubled, the error of first derivatives doubles; with a hundredth of it the coefficients of their series overflow. The
# second is an error of velocities.
AT_REST, SETS_OUT = 1e3, 16.0
# A length that vanishes within this many smallest steps counts as zero. Doubled, a slip ends that much earlier.
LAST_STEPS = 16.0
# The relative growth of that length in a step: series of tangents across it have this ratio. Doubled, starts from rest
# take half the steps, some 50, and the truncation error of a series of order 20 is 1e-6 of a tangent.
GROWTH_OF_LENGTH = 0.25
# If a border is reached within this fraction of the smallest step after another one, bounces accumulate and the motion
# rests on it; the velocity that is dropped is as small.
NO_TIME = 0.25
# A switching number is resolved along a step if its last terms are at most `SWITCH_TOLERANCES` tolerances of its size.
# A step that resolves the state gives less than one tolerance for numbers that vary as the state; else it is halved.
SWITCH_TOLERANCES, MOST_HALVINGS = 16.0, 64
# Below atol they are at most this fraction of its size, so that a number that decays for ever, as exp(−s), keeps its
# sign: its series does up to s = 3 at the order of the default tolerance. Doubled, that of order 20 does not.
RESOLVED = 2.0**-17
# exp(u) below u = −`FAINT` is 2e-35, negligible whatever its factor. Above that, u may rise in one step by `RISE` times
# the order p: then the terms Rᵏ/k! of exp(u) decrease beyond the last one, as the step control assumes.
FAINT, RISE = 80.0, 0.5
# exp(u) overflows above u = 709.8: steps from above end below `BEYOND`. As long as the coefficients may overflow, e²⁰⁰
# times the twentieth power of a rate, u may fall by no more than it may rise. Doubled, rates up to 1e6 are resolved.
BEYOND, STEEP = 700.0, 200.0
# Larger arguments are not known to a tenth: then the distance to the feature is covered in several steps.
FAR = 2.0**40
# A bound for the last terms of the argument of a feature; for a base, as a fraction of the value it falls or rises to.
ARGUMENT = 0.1
# A power may rise by as much as exp(u) does; but its base falls at most to this fraction of itself in a step, which its
# series must resolve. Doubled, a feature a millionth of the distance wide takes one step more, of seven.
LARGEST_FALL = 1 / 64
# If a base reaches zero, steps end ever nearer to the zero, until this fraction of the first distance is left.
# Narrower features are missed.
NARROWEST = 2.0**-30
# If no series exists beyond a border, a step covers `SHORT_OF` of the distance to it, and once that is less than
# `NEARBY` of the step, `PAST` times the distance: if the far side matters, this step fails its check, and its half does
# not end at the border. Narrower features are missed. `ABRUPT` bounds the last terms of the switching number, relative
# to it.
SHORT_OF, NEARBY, PAST, ABRUPT = 0.9, 1e-4, 1.7, 1e-3
# A relative difference of the accelerations on both sides of a border below this is no jump. It is far above rounding.
JUMP_NOISE = 2.0**-34

# ---- events ----------------------------------------------------------------------------------------------------------

# The last three terms of the series of a guard along a step are at most this fraction of Σ |cₖ|; else the step is
# shortened. Those of the state are, at the loosest tolerance; a guard that varies faster than the state shortens steps.
GUARD_TERMS = 1 / 128
# They are also at most `FALL` of the three before them (a half for each), or below `SEEN`: terms that do not decrease
# belong to a pole ahead, near which the guard can take any value.
FALL, SEEN = 1 / 8, 2.0**-48
# A guard that was zero at the end of a step at its own border is zero at the beginning of the next one, if it is below
# this fraction of Σ |cₖ|: it has not jumped.
CONTINUOUS = 2.0**-20
# Sign changes of one guard in one step, a bound: more than the roots of its polynomial.
MOST_CHANGES = 32
# Newton's steps from the root of the polynomial to that of the guard: two or three at the tolerances there are.
MOST_CORRECTIONS = 8
# A guard that approaches zero to rounding, from this multiple of its rounding, may cross it and return undetected: the
# step ends there, and the next one, which begins near, has less rounding. A guard that is rounding throughout ends no
# step.
MEETS = 16.0
# If a guard has no series, this fraction of the step is taken, and its sign is read at the end.
WITHOUT_SERIES = 1 / 8
# Bisections of such a step to find the zero: more than the digits of a double.
BISECTIONS = 60
# At the start of a run a guard below `GUARD_NOISE` Σ |∂g/∂yᵢ yᵢ|, or below its rate times `INSTANT` smallest steps, is
# on its surface: its side is the sign of its rate, or its sign after `LITTLE` of the step. A reset leaves a state on
# the surface to some ten roundings; doubled, a start next to a surface counts as one on it.
GUARD_NOISE, INSTANT, LITTLE = 64 * EPS, 16.0, 1e-4
# The same for float32 inputs, as a fraction of each: eight roundings. One is the input's own; the expression that
# computed it (a cosine times a radius, steps of a grid) makes some five. Doubled, a start at a relative distance of
# 1e-6 from a surface counts as one on it; halved, one that is a sum of three products may pass through.
SINGLE_NOISE = 4 * 2.0**-23

# ---- constraints -----------------------------------------------------------------------------------------------------

# The largest distance from the end of a series to its projection, in tolerances. The series satisfies the constraints
# to about one; how much more the projection moves it depends on the conditioning. Measured on a slider-crank 1e-9 from
# its dead centre: halved, a fifth more steps are rejected, doubled as many; far from a dead centre neither matters.
PROJECTION_TOLERANCES = 16.0
# The same for the first step, as a fraction of the size of the state: ten times the residual (1e-6) up to which a
# start is consistent. Doubled, it would hide no more than that check does.
START = 1e-5
# If steps shrink to `SHORTER` of the last long one, that one is repeated with `RETAKEN` of its length, at most
# `MOST_RETURNS` times, so that it ends farther away and the next one passes. Measured on the dead centre of a
# slider-crank: without, it does not pass. With `SHORTER` doubled or halved it takes as many steps, with a quarter fewer
# or an eighth more rejected; the number of returns, doubled or halved, is not reached.
SHORTER, RETAKEN, MOST_RETURNS = 1 / 64, 0.9, 16

# ---- threads ---------------------------------------------------------------------------------------------------------

# Members that make a thread worth its start, in vectors. Doubled, batches of up to that size run on half the cores.
VECTORS_PER_THREAD = 4
# The cost of an adjoint in units of that of its motion: 16 members use two threads. Halved, they use one.
MOTIONS_PER_ADJOINT = 4
