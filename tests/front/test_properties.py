"""What must hold for any Lagrangian and for any argument: laws of motion on random scenes, and random abuse.

Hypothesis draws coefficients, states and wrong values; the scenes are fixed functions that take the coefficients as
`params`, so that all draws share a few compiled programs. Nothing here depends on chance: the draws are always the
same. Motions are short and their coefficients of order one: neighbouring ones part by a factor of less than GROWTH, and
one that is integrated in N steps of relative error RTOL is off by less than GROWTH · N · RTOL of its own size.
"""

import functools
import re
import traceback

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from sweeps import sweep

import lagjax

few = settings(derandomize=True, deadline=None, max_examples=12, database=None, phases=(Phase.generate, Phase.shrink))
RTOL, GROWTH = 1e-10, 2.0
TS = np.linspace(0.0, 2.0, 9)
NEXT = np.array([1, 2, 0])


# ---- random Lagrangians ----------------------------------------------------------------------------------------------


def natural(q, v, params):
    """T − U in three lengths: a mass matrix that depends on q and is positive definite, springs, and a wave of U."""
    p, angle = params, q / params["length"]
    kinetic = 0.5 * jnp.sum(p["mass"] * v**2) + 0.5 * jnp.sum(p["coupling"] * jnp.cos(angle) * v) ** 2
    return kinetic - 0.5 * jnp.sum(p["spring"] * q**2) - p["wave"] * jnp.cos(jnp.sum(angle))


def general(q, v, params):
    """The same with a vector potential, and with a kinetic energy of fourth order in the velocities."""
    bend = jnp.sin(q[NEXT] / params["length"])
    return natural(q, v, params) + jnp.sum(params["field"] * bend * v) + params["quartic"] * jnp.sum(v**2) ** 2


def permuted(q, v, params):
    """The same, its coordinates in other places and in a pytree."""
    in_line = lambda tree: jnp.stack([tree["c"], *tree["a"]])
    return general(in_line(q), in_line(v), params)


def straight(bent):
    """Lengths x of curvilinear coordinates: x₀ = s₀ + sin(s₁)/3, and on around."""
    return bent + jnp.array([jnp.sin(bent[1]), jnp.sin(bent[2]), 0.0]) / 3


def in_bent_coordinates(q, v, params):
    return general(*jax.jvp(straight, (q,), (v,)), params)


def gauged(q, v, t, params):
    """The same and dF/dt, with F = s q₀ q₁ sin(2t) + s t² cos(q₂): no other motion, although L depends on time."""

    def of(q, t):
        return params["gauge"] * (q[0] * q[1] * jnp.sin(2 * t) + t**2 * jnp.cos(q[2]))

    return general(q, v, params) + jax.jvp(of, (q, t), (v, jnp.ones_like(t)))[1]


SCENE, PERMUTED = lagjax.System(general), lagjax.System(permuted)
BENT, GAUGED = lagjax.System(in_bent_coordinates), lagjax.System(gauged)


def numbers(low, high):
    return st.floats(low, high).map(lambda x: float(np.round(x, 6)))  # short to read, and no subnormals


def triples(low, high):
    return st.lists(numbers(low, high), min_size=3, max_size=3).map(np.array)


COEFFICIENTS = {
    "mass": triples(0.5, 2.0), "coupling": triples(-0.7, 0.7), "spring": triples(0.0, 4.0), "wave": numbers(-1.0, 1.0),
    "length": numbers(1.0, 3.0),
}  # fmt: skip
naturals = st.fixed_dictionaries(COEFFICIENTS | {"field": st.just(np.zeros(3)), "quartic": st.just(0.0)})
generals = st.fixed_dictionaries(COEFFICIENTS | {"field": triples(-1.5, 1.5), "quartic": numbers(0.0, 0.2)})
positions = velocities = triples(-1.0, 1.0)


def run(params, q0, v0, ts=TS, scene=SCENE, **options):
    return lagjax.simulate(scene, q0, v0, ts, params, rtol=RTOL, **options)


def assert_close(motion, other):
    """Whether two pairs (q, q̇) at the same times agree, up to the errors of two integrations."""
    allowed = 2 * GROWTH * RTOL * (10 + int(motion.stats["num_steps"]))
    size = max(np.abs(x).max() for x in other) + 1e-3
    for got, wanted in zip((motion.q, motion.qdot), other, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=allowed * size)


# ---- laws of motion --------------------------------------------------------------------------------------------------


@functools.cache
def energy_sizes():
    """Σ |∂h/∂y y| over the state at every time: how much energy a relative error of one in every component is."""

    def size(q, v, params):
        slopes = jax.grad(lambda q, v: SCENE.energy(q, v, 0.0, params), argnums=(0, 1))(q, v)
        return sum(jnp.sum(jnp.abs(slope * x)) for slope, x in zip(slopes, (q, v), strict=True))

    return jax.jit(jax.vmap(size, (0, 0, None)))


@few
@given(generals, positions, velocities)
def test_energy_is_conserved(params, q0, v0):
    motion = run(params, q0, v0)
    per_step = RTOL * (float(energy_sizes()(motion.q, motion.qdot, params).max()) + 1e-3)
    drift = np.abs(motion.energy() - motion.energy()[0]).max()
    assert drift <= per_step * (10 + int(motion.stats["num_steps"]))  # h is conserved: its errors do not grow


@few
@given(naturals, positions, velocities)
def test_a_natural_motion_comes_back_with_its_velocities_reversed(params, q0, v0):
    there = run(params, q0, v0)
    back = run(params, there.q[-1], -there.qdot[-1])
    assert_close(back, (there.q[::-1], -there.qdot[::-1]))


@few
@given(generals, positions, velocities)
def test_any_motion_comes_back_backward_in_time(params, q0, v0):
    there = run(params, q0, v0)
    back = run(params, there.q[-1], there.qdot[-1], TS[::-1])
    assert_close(back, (there.q[::-1], there.qdot[::-1]))


@few
@given(generals, positions, velocities)
def test_the_motion_does_not_depend_on_the_coordinates(params, s0, u0):
    straight_of = lambda s, u: jax.jvp(straight, (jnp.asarray(s),), (jnp.asarray(u),))
    bent = run(params, s0, u0, scene=BENT)
    assert_close(run(params, *straight_of(s0, u0)), jax.vmap(straight_of)(bent.q, bent.qdot))


@few
@given(generals, positions, velocities, numbers(-2.0, 2.0))
def test_a_total_derivative_changes_nothing(params, q0, v0, gauge):
    other = run(params | {"gauge": gauge}, q0, v0, scene=GAUGED)
    assert_close(run(params, q0, v0), (other.q, other.qdot))


@few
@given(generals, positions, velocities)
def test_the_order_of_coordinates_changes_nothing(params, q0, v0):
    motion = run(params, q0, v0)
    as_tree = lambda x: {"a": (x[1], x[2]), "c": x[0]}
    in_line = lambda tree: np.stack([tree["c"], *tree["a"]], axis=-1)
    elsewhere = run(params, as_tree(q0), as_tree(v0), scene=PERMUTED)
    assert_close(motion, (in_line(elsewhere.q), in_line(elsewhere.qdot)))
    # L is made so that turning its coefficients around is turning its coordinates around.
    around = {name: x[NEXT] if np.ndim(x) else x for name, x in params.items()}
    assert_close(run(around, q0[NEXT], v0[NEXT]), (motion.q[:, NEXT], motion.qdot[:, NEXT]))


@few
@given(generals, positions, velocities, *[st.floats(-3.0, 3.0).map(lambda x: 10.0**x)] * 3)
def test_units_of_mass_length_and_time_change_nothing(params, q0, v0, mass, length, time):
    units = {
        "mass": mass, "coupling": mass**0.5, "spring": mass / time**2, "wave": mass * length**2 / time**2,
        "length": length, "field": mass * length / time, "quartic": mass * (time / length) ** 2,
    }  # fmt: skip
    # The absolute tolerance is in units of the state, and q and q̇ have two: let it not matter.
    other = run({name: params[name] * unit for name, unit in units.items()}, q0 * length, v0 * length / time, TS * time,
                atol=1e-30)  # fmt: skip
    assert_close(run(params, q0, v0), (other.q / length, other.qdot * time / length))


@few
@given(generals, positions, velocities, numbers(0.01, 100.0))
def test_a_multiple_of_the_lagrangian_has_the_same_motion(params, q0, v0, factor):
    powers = {"coupling": 0.5, "length": 0.0}  # the first enters as a square
    other = run({name: x * factor ** powers.get(name, 1.0) for name, x in params.items()}, q0, v0)
    assert_close(run(params, q0, v0), (other.q, other.qdot))


@few
@given(generals, positions, velocities)
def test_a_lagrangian_that_is_even_has_the_mirrored_motion(params, q0, v0):
    motion = run(params, q0, v0)
    assert_close(run(params, -q0, -v0), (-motion.q, -motion.qdot))


# ---- transformations -------------------------------------------------------------------------------------------------

MEMBERS = 5  # lanes are four or eight side by side: one group is full, or none is


@few
@given(st.lists(generals, min_size=MEMBERS, max_size=MEMBERS), st.lists(positions, min_size=MEMBERS, max_size=MEMBERS))
def test_batch_and_vmap_and_jit_are_the_loop(each, starts):
    # A member's arithmetic does not depend on its neighbours, nor on who asks for it: equal to the last bit.
    params, q0 = jax.tree.map(lambda *x: np.stack(x), *each), np.stack(starts)
    v0 = q0[:, NEXT] / 2
    loop = [run(*one) for one in zip(each, q0, v0, strict=True)]
    batch = lagjax.simulate_batch(SCENE, q0, v0, TS, params, batch_axes=(0, 0, 0), rtol=RTOL)
    mapped = transformed()[0](params, q0, v0)
    jitted = transformed()[1](each[0], q0[0], v0[0])
    for name in ("q", "qdot"):
        expected = np.stack([getattr(one, name) for one in loop])
        np.testing.assert_array_equal(getattr(batch, name), expected)
        np.testing.assert_array_equal(getattr(mapped, name), expected)
        np.testing.assert_array_equal(getattr(jitted, name), expected[0])
    for counted in loop[0].stats:
        np.testing.assert_array_equal(batch.stats[counted], [one.stats[counted] for one in loop])
    assert batch.ok.all() and mapped.ok.all()


@functools.cache
def transformed():
    """`run` under vmap, and under jit; compiled once."""
    return jax.jit(jax.vmap(lambda *one: run(*one))), jax.jit(lambda *one: run(*one))


def two(q, v, params):
    spring, mixed = params["spring"] * jnp.cos(q), params["mixed"] * jnp.cos(q[0] - q[1])
    return 0.5 * jnp.sum(params["mass"] * v**2) + mixed * v[0] * v[1] + jnp.sum(spring)


pairs = lambda low, high: st.lists(numbers(low, high), min_size=2, max_size=2).map(np.array)
twos = st.fixed_dictionaries({"mass": pairs(0.5, 2.0), "spring": pairs(0.0, 4.0), "mixed": numbers(-0.3, 0.3)})
TWO = lagjax.System(two)


@functools.cache
def derivatives():
    """A number that the motion ends in, its slopes in reverse mode, and its slope along a direction in forward mode."""

    def end(params, q0):
        motion = run(params, q0, 0 * q0, TS[[0, -1]], TWO)
        return jnp.sum(jnp.sin(motion.q[-1])) + jnp.sum(motion.qdot[-1] ** 2)

    def forward(params, q0, along):
        return jax.jvp(lambda p: end(p, q0), (params,), (along,))[1]

    return jax.jit(end), jax.jit(jax.grad(end)), jax.jit(forward)


@few
@given(twos, twos, pairs(-1.0, 1.0))
def test_reverse_mode_is_forward_mode_is_the_difference(params, along, q0):
    end, reverse, forward = derivatives()
    slopes = reverse(params, q0)
    ahead = float(forward(params, q0, along))
    terms = np.concatenate([np.ravel(slopes[name] * along[name]) for name in params])
    size = np.abs(terms).sum() + 1e-2
    assert abs(terms.sum() - ahead) <= 100 * GROWTH * RTOL * size  # some tens of steps, two integrations
    step = 1e-4  # h² of truncation, with third derivatives of up to a hundred or so, and the solver's error over h
    up, down = (end({name: x + sign * step * along[name] for name, x in params.items()}, q0) for sign in (1, -1))
    assert abs((up - down) / (2 * step) - ahead) <= 1e-5 * (1 + size)


# ---- abuse -----------------------------------------------------------------------------------------------------------


def spring(q, v, params):
    return 0.5 * params["m"] * v**2 - 0.5 * params["k"] * q**2


def far(q, v):
    return q - 1e3


SPRING, PARAMS, SHORT = lagjax.System(spring), {"m": 1.0, "k": 4.0}, np.linspace(0.0, 1.0, 5)
WRONG = {
    # not numbers
    "None": None, "a text": "text", "an empty text": "", "bytes": b"1", "an object": object(), "a class": int,
    "a system": SPRING, "a function of nothing": lambda: 0.0, "a generator": (x for x in "abc"), "a set": {1.0, 2.0},
    "texts": ["a", "b"], "a ragged list": [[1.0], [1.0, 2.0]], "a key": jax.random.key(0),
    "an array of texts": np.array(["a"]), "an array of objects": np.array([None, 1.0], object),
    "dates": np.array(["2020-01-01", "2020-01-02"], "datetime64[D]"), "a record": np.zeros(2, [("a", float)]),
    # numbers, but which
    "True": True, "NumPy's False": np.False_, "NaN": np.nan, "∞": np.inf, "−∞": -np.inf, "−1.0": -1.0, "0.0": 0.0,
    "0": 0, "1": 1, "2⁶³": 2**63, "10⁴⁰⁰": 10**400, "1e308": 1e308, "1e-320": 1e-320, "1j": 1j,
    "half precision": np.float16(1.0), "bfloat16": jnp.bfloat16(1.0), "single precision": np.float32(1.0),
    "quadruple precision": np.longdouble(1.0),
    # shapes and times
    "an empty list": [], "an empty tuple": (), "an empty array": np.zeros(0), "no rows": np.zeros((0, 3)),
    "two": np.ones(2), "a square": np.ones((2, 2)), "integers": np.array([0, 1, 2]),
    "conditions": np.array([True, False]), "complex numbers": np.array([1j, 2.0]),
    "one NaN": np.array([0.0, np.nan]), "up and down": np.array([0.0, 1.0, 0.5]),
    "a time that stands still": np.array([1.0, 1.0]), "masked": np.ma.array([0.0, 1.0], mask=[False, True]),
    # pytrees
    "an empty dict": {}, "a list of None": [None], "another dict": {"x": 1.0},
    "a dict with a text": PARAMS | {"m": "heavy"}, "a dict with NaN": PARAMS | {"m": np.nan},
    "a dict with None": PARAMS | {"m": None}, "no mass": PARAMS | {"m": 0.0},
    "integers by name": {"m": 1, "k": 4}, "keys without an order": {1: 1.0, "a": 1.0},
}  # fmt: skip


def a_system(**roles):
    return lagjax.System(**roles).acceleration(1.0, 0.5, params=PARAMS)


def a_transition(**fields):
    transitions = [lagjax.Transition(**fields)]
    return lagjax.simulate(lagjax.Hybrid({"a": SPRING}, transitions, "a"), 1.0, 0.5, SHORT, PARAMS, rtol=RTOL)


def a_hybrid(modes, transitions, start, **arguments):
    return lagjax.simulate(lagjax.Hybrid(modes, transitions, start), **arguments)


MOTION = {"q0": 1.0, "qdot0": 0.5, "ts": SHORT, "params": PARAMS, "rtol": RTOL}
MANY = MOTION | {"q0": np.ones(2), "qdot0": np.full(2, 0.5)}
OPTIONS = ("atol", "dt", "max_steps", "solver", "event", "adjoint", "progress")
CALLS = {  # what is called, with which arguments it is right, and which more it has
    "simulate": (lagjax.simulate, MOTION | {"system": SPRING}, (*OPTIONS, "throw")),
    "simulate_batch": (lagjax.simulate_batch, MANY | {"system": SPRING}, (*OPTIONS, "batch_axes")),
    "Hybrid": (
        a_hybrid, MOTION | {"modes": {"a": SPRING}, "transitions": [], "start": "a"},
        ("atol", "max_steps", "max_transitions", "throw"),
    ),
    "Transition": (a_transition, {"source": "a", "target": "a", "guard": far}, ("direction", "reset")),
    "System": (
        a_system, {"lagrangian": spring}, ("forces", "dissipation", "constraints", "velocity_constraints", "path"),
    ),
    "acceleration": (SPRING.acceleration, {"q": 1.0, "qdot": 0.5, "params": PARAMS}, ("t",)),
}  # fmt: skip
EVERY = [(name, argument) for name, (_, right, more) in CALLS.items() for argument in (*right, *more)]


def outcome(name, changes):
    """What the call returns, or None where it ended in a sentence."""
    call, right, more = CALLS[name]
    if "dt" in changes:  # fixed steps, by a solver that is compiled fast
        right = {argument: x for argument, x in right.items() if argument != "rtol"} | {"solver": diffrax.Euler()}
    try:
        return call(**(right | changes))
    except Exception as error:
        assert_sentence(error, [*right, *more])


def assert_sentence(error, arguments):
    """A refusal by lagjax that names the argument or begins like a sentence, and ends like one.

    Or an error in the user's own function, which is its own: with the wrong `params` that is the place to look.
    """
    frames = traceback.extract_tb(error.__traceback__)
    if any(frame.name == "spring" for frame in frames):
        return
    message = str(error)
    assert isinstance(error, TypeError | ValueError | lagjax.SimulationError), repr(error)
    assert "/lagjax/" in frames[-1].filename, f"{message!r} comes from {frames[-1].filename}"
    names = "|".join([*arguments, "q", "qdot"])  # a state is spoken of as q and qdot
    assert message[0].isupper() or re.search(rf"\b({names})\b", message), message
    assert message.endswith("."), message


def assert_right(motion, given):
    """q = q₀ cos ωt + q̇₀/ω sin ωt for the members that ended well; NaN, and not ok, for those that did not."""
    ok = np.atleast_1d(motion.ok)
    q, qdot = (np.reshape(x, (len(ok), -1)) for x in (motion.q, motion.qdot))
    np.testing.assert_array_equal(np.isfinite(q).all(1) & np.isfinite(qdot).all(1), ok)
    if given.get("dt") is None and given.get("atol") is None:  # else as coarse as was asked for
        q0, v0 = (np.reshape(np.asarray(given[name], float), (-1, 1)) for name in ("q0", "qdot0"))
        omega = np.sqrt(float(given["params"]["k"]) / max(float(given["params"]["m"]), 1e-300))
        phase = omega * (motion.ts - motion.ts[0])
        exact = np.broadcast_to(q0 * np.cos(phase) + v0 / omega * np.sin(phase), q.shape)
        np.testing.assert_allclose(q[ok], exact[ok], atol=1e-6)


def wrong_for(argument):
    # True asks for a progress meter, which is right, and prints.
    return sorted(set(WRONG) - {"True"} if argument == "progress" else set(WRONG))


def check(name, changes):
    result = outcome(name, {argument: WRONG[value] for argument, value in changes.items()})
    if isinstance(result, lagjax.Trajectory):
        given = CALLS[name][1] if name != "Transition" else MOTION
        assert_right(result, given | {argument: WRONG[value] for argument, value in changes.items()})
    elif result is not None:
        strange = {"NaN", "∞", "−∞", "1e308", "a dict with NaN", "no mass"} & set(changes.values())
        assert np.isfinite(result) or (name == "acceleration" and strange), f"{changes} gave {result}"


# By default not where a right motion compiles for long: `test_faults` shows what is refused of a fixed step.
@pytest.mark.parametrize(
    ("name", "argument"),
    sweep(EVERY, kept=lambda one: one[0] not in ("simulate_batch", "Hybrid") and one != ("simulate", "dt")),
)
def test_one_wrong_argument(name, argument):
    # Not many are drawn but all of them: a refusal takes a millisecond.
    @settings(few, max_examples=len(WRONG))
    @given(st.sampled_from(wrong_for(argument)))
    def holds(value):
        check(name, {argument: value})

    holds()


@pytest.mark.parametrize("name", CALLS)
def test_several_wrong_arguments(name):
    arguments = [argument for called, argument in EVERY if called == name]
    pairs = st.fixed_dictionaries({argument: st.sampled_from(wrong_for(argument)) for argument in arguments})
    chosen = st.sets(st.sampled_from(arguments), min_size=2, max_size=3)

    @settings(few, max_examples=25)
    @given(pairs, chosen)
    def holds(values, some):
        check(name, {argument: values[argument] for argument in sorted(some)})

    holds()
