"""Twenty scenes whose freedoms are known: every one is named, none is invented, and fixing what is named ends it."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import damping

import lagjax

TS, SIGMA = np.linspace(0.0, 4.0, 101), 2e-3


def spring(stiffness, mass=lambda p: 1.0):
    return lambda q, v, p: 0.5 * mass(p) * v**2 - 0.5 * stiffness(p) * q**2


# name: (L, params, more of the scene, sensors, what must be said, what to fix)
SCENES = {
    "scale of mass": (
        spring(lambda p: p["k"], lambda p: p["m"]), {"k": 4.0, "m": 1.5}, {}, None,
        ["A common factor of params['k'] and params['m']"], ["m"],
    ),
    "scale of mass, friction and stiffness": (
        spring(lambda p: p["k"], lambda p: p["m"]), {"c": 0.3, "k": 4.0, "m": 1.5},
        {"dissipation": damping}, None,
        ["A common factor of params['c'], params['k'] and params['m']"], ["k"],
    ),
    "mass and length of a pendulum": (
        lambda q, v, p: p["m"] * (0.5 * p["l"] ** 2 * v**2 + p["g"] * p["l"] * jnp.cos(q)),
        {"g": 9.8, "l": 0.9, "m": 2.0}, {}, None,
        ["A common factor of params['g'] and params['l']", "depends on params['m']"], ["m", "g"],
    ),
    "charge in a gauge": (
        lambda q, v, p: spring(lambda p: p["k"])(q, v, p) + p["a"] * q**2 * v, {"a": 0.7, "k": 4.0}, {}, None,
        ["depends on params['a']"], ["a"],
    ),
    "two charges in a gauge": (
        lambda q, v, p: spring(lambda p: p["k"])(q, v, p) + p["a"] * p["b"] * jnp.cos(q) * v,
        {"a": 0.7, "b": 0.2, "k": 4.0}, {}, None, ["depends on params['a']", "depends on params['b']"], ["a", "b"],
    ),
    "level of a potential": (
        lambda q, v, p: spring(lambda p: p["k"])(q, v, p) - p["level"], {"k": 4.0, "level": 3.0}, {}, None,
        ["depends on params['level']"], ["level"],
    ),
    "product": (
        spring(lambda p: p["a"] * p["b"]), {"a": 2.0, "b": 3.0}, {}, None,
        ["only params['a']·params['b'] is seen"], ["a"],
    ),
    "product with a square": (
        spring(lambda p: p["a"] * p["b"] ** 2), {"a": 2.0, "b": 1.4}, {}, None,
        ["only params['a']·params['b']^2 is seen"], ["a"],
    ),
    "product and ratio of three": (
        spring(lambda p: p["a"] * p["b"] / p["c"]), {"a": 6.0, "b": 2.0, "c": 2.5}, {}, None,
        ["Of params['a'], params['b'] and params['c'] only"], ["a", "b"],
    ),
    "two products of one mass": (
        lambda q, v, p: 0.5 * v**2 - p["m"] * (p["a"] * q**2 / 2 + p["b"] * q**4 / 4), {"a": 2.0, "b": 3.0, "m": 1.3},
        {}, None, ["Of params['a'], params['b'] and params['m'] only"], ["m"],
    ),
    "springs side by side": (
        spring(lambda p: p["a"] + p["b"]), {"a": 2.0, "b": 2.5}, {}, None,
        ["only params['a'] + params['b'] is seen"], ["b"],
    ),
    "difference": (
        spring(lambda p: p["a"] - 2 * p["b"]), {"a": 9.0, "b": 1.5}, {}, None,
        ["only params['a'] − 2 params['b'] is seen"], ["a"],
    ),
    "springs one behind the other": (
        spring(lambda p: p["a"] * p["b"] / (p["a"] + p["b"])), {"a": 6.0, "b": 9.0}, {}, None,
        ["A combination of params['a'] and params['b'] is not seen"], ["a"],
    ),
    "inertia of what turns freely": (
        lambda q, v, p: 0.5 * p["I"] * v**2, {"I": 2.0, "bias": 0.0}, {}, lambda q, v, params: q + params["bias"],
        ["depends on params['I']", "depends on params['bias']"], None,
    ),
    "torque over inertia": (
        lambda q, v, p: 0.5 * p["I"] * v**2 + p["torque"] * q, {"I": 2.0, "torque": 1.0}, {}, None,
        ["A common factor of params['I'] and params['torque']"], ["I"],
    ),
    "gain of a sensor of a linear scene": (
        spring(lambda p: p["k"]), {"gain": 2.0, "k": 4.0}, {}, lambda q, v, params: params["gain"] * q,
        ["depends on params['gain']"], ["gain"],
    ),
    "place of a spring and of its ruler": (
        lambda q, v, p: 0.5 * v**2 - 0.5 * p["k"] * (q - p["place"]) ** 2, {"bias": 0.3, "k": 4.0, "place": 0.2}, {},
        lambda q, v, params: q + params["bias"], ["only params['bias'] + params['place'] is seen"], ["place"],
    ),
    "force over mass": (
        spring(lambda p: p["k"], lambda p: p["m"]), {"F": 1.0, "k": 4.0, "m": 1.5},
        {"forces": lambda q, v, t, params: params["F"] * jnp.cos(3 * t)}, None,
        ["A common factor of params['F'], params['k'] and params['m']"], ["F"],
    ),
    "friction of two bearings": (
        spring(lambda p: p["k"]), {"a": 0.2, "b": 0.1, "k": 4.0},
        {"dissipation": lambda q, v, params: 0.5 * (params["a"] + params["b"]) * v**2}, None,
        ["only params['a'] + params['b'] is seen"], ["b"],
    ),
    "a branch that is never taken": (
        lambda q, v, p: spring(lambda p: p["k"])(q, v, p) - jnp.where(q > 50.0, p["wall"] * q, 0.0),
        {"k": 4.0, "wall": 3.0}, {}, None, ["depends on params['wall']"], ["wall"],
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_freedoms_that_are_known_are_named_and_no_others(name):
    lagrangian, params, more, observe, sentences, fixed = SCENES[name]
    scene = lagjax.System(lambda q, v, params: lagrangian(q, v, params), **more)
    run = lagjax.simulate(scene, 1.0, 0.3, TS, params)
    shown = np.asarray(run.q) if observe is None else np.array([observe(q, 0.0, params) for q in run.q])
    record = lagjax.Record(TS, shown + SIGMA * np.random.default_rng(0).normal(size=shown.shape))
    fit = lagjax.fit(scene, record, params, observe=observe)
    assert len(fit.unseen) == len(sentences), fit.unseen
    for sentence in sentences:
        assert any(sentence in said for said in fit.unseen), fit.unseen
    if fixed is not None:
        free = {key: key not in fixed for key in params}
        fit = lagjax.fit(scene, record, params, observe=observe, free=free)
        assert fit.unseen == () and fit.ok, fit


def test_a_sentence_for_what_only_enters_as_a_product():
    name = "two products of one mass"
    lagrangian, params, *_ = SCENES[name]
    scene = lagjax.System(lambda q, v, params: lagrangian(q, v, params))
    q = np.asarray(lagjax.simulate(scene, 1.0, 0.3, TS, params).q)
    [said] = lagjax.fit(scene, lagjax.Record(TS, q), params).unseen
    assert said == (
        "Of params['a'], params['b'] and params['m'] only params['a']·params['m'] and params['b']·params['m'] are seen."
    )


# ---- scenes of which everything is seen ------------------------------------------------------------------------------


def turning(v, q):
    return q[0] * v[1] - q[1] * v[0]


FLAT, BOTH = (1.0, 0.3), ([1.0, 0.0], [0.1, 0.8])  # starts (q, q̇) of one and of two coordinates
# name: (L, params, more of the scene, sensors, start). What looks like a freedom of the list above, and is none.
SEEN = {
    "friction and stiffness": (
        spring(lambda p: p["k"]), {"c": 0.3, "k": 4.0},
        {"dissipation": damping}, None, FLAT,
    ),
    "length of a pendulum in known gravity": (
        lambda q, v, p: p["m"] * (0.5 * p["l"] ** 2 * v**2 + 9.8 * p["l"] * jnp.cos(q)) / p["m"], {"l": 0.9, "m": 2.0},
        {"forces": lambda q, v, t, params: (params["m"] - 1.0) * jnp.cos(3 * t)}, None, FLAT,
    ),
    "mass under a known force": (
        spring(lambda p: p["k"], lambda p: p["m"]), {"k": 4.0, "m": 1.5},
        {"forces": lambda q, v, t, params: 2.0 * jnp.cos(3 * t)}, None, FLAT,
    ),
    "a product, and one of its factors": (
        spring(lambda p: p["a"] * p["b"]), {"a": 0.5, "b": 8.0},
        {"dissipation": lambda q, v, params: 0.5 * params["a"] * v**2}, None, FLAT,
    ),
    "a ratio, and its denominator": (
        spring(lambda p: p["a"] / p["b"]), {"a": 2.0, "b": 0.5},
        {"dissipation": lambda q, v, params: 0.5 * params["b"] * v**2}, None, FLAT,
    ),
    "a sum and a difference": (
        spring(lambda p: p["a"] + p["b"]), {"a": 2.5, "b": 2.0},
        {"dissipation": lambda q, v, params: 0.5 * (params["a"] - params["b"]) * v**2}, None, FLAT,
    ),
    "two terms of a potential": (
        lambda q, v, p: 0.5 * v**2 - p["a"] * q**2 / 2 - p["b"] * q**4 / 4, {"a": 2.0, "b": 3.0}, {}, None, FLAT,
    ),
    "gain of a sensor of a pendulum that swings far": (
        lambda q, v, p: 0.5 * v**2 + p["k"] * jnp.cos(q), {"gain": 2.0, "k": 9.0}, {},
        lambda q, v, params: params["gain"] * q, (1.8, 0.0),
    ),
    "bias of a sensor": (
        spring(lambda p: p["k"]), {"bias": 0.3, "k": 4.0}, {}, lambda q, v, params: q + params["bias"], FLAT,
    ),
    "place of a spring": (
        lambda q, v, p: 0.5 * v**2 - 0.5 * p["k"] * (q - p["place"]) ** 2, {"k": 4.0, "place": 0.2}, {}, None, FLAT,
    ),
    "charge in a field that is no gauge": (
        lambda q, v, p: 0.5 * v @ v - 0.5 * p["k"] * q @ q + 0.5 * p["B"] * turning(v, q), {"B": 0.7, "k": 4.0}, {},
        None, BOTH,
    ),
    "masses about a centre that holds one of them": (
        lambda q, v, p: 0.5 * v @ v + p["GM"] / jnp.sqrt(q @ q), {"GM": 1.0}, {}, None, BOTH,
    ),
    "torque over a known inertia": (
        lambda q, v, p: 0.5 * 2.0 * v**2 + p["torque"] * q, {"torque": 1.0}, {}, None, FLAT,
    ),
    "force and period of a drive": (
        spring(lambda p: 4.0), {"F": 1.0, "w": 3.0},
        {"forces": lambda q, v, t, params: params["F"] * jnp.cos(params["w"] * t)}, None, FLAT,
    ),
    "force and phase of a drive": (
        spring(lambda p: 4.0), {"F": 1.0, "phase": 0.4},
        {"forces": lambda q, v, t, params: params["F"] * jnp.cos(3 * t + params["phase"])}, None, FLAT,
    ),
    "a chain of two, one mass known": (
        lambda q, v, p: 0.5 * (v[0] ** 2 + p["m"] * v[1] ** 2)
        - 0.5 * (p["a"] * q[0] ** 2 + p["b"] * (q[1] - q[0]) ** 2),
        {"a": 4.0, "b": 3.0, "m": 1.5}, {}, None, BOTH,
    ),
    "a power of a potential": (
        lambda q, v, p: 0.5 * v**2 - p["a"] * (q**2 + 0.1) ** p["power"], {"a": 2.0, "power": 1.5}, {}, None, FLAT,
    ),
    "gain of the second of two sensors": (
        spring(lambda p: p["k"]), {"gain": 2.0, "k": 4.0}, {},
        lambda q, v, params: jnp.stack([q, params["gain"] * v]), FLAT,
    ),
    "drag and friction": (
        spring(lambda p: 4.0), {"air": 0.2, "c": 0.2},
        {"forces": lambda q, v, params: -params["c"] * v - params["air"] * v * jnp.abs(v)}, None, FLAT,
    ),
    "a branch that is taken": (
        lambda q, v, p: spring(lambda p: p["k"])(q, v, p) - jnp.where(q > 0.5, p["wall"] * (q - 0.5) ** 2, 0.0),
        {"k": 4.0, "wall": 3.0}, {}, None, FLAT,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEN)
def test_of_scenes_that_show_everything_nothing_is_said_to_be_unseen(name):
    lagrangian, params, more, observe, start = SEEN[name]
    scene = lagjax.System(lambda q, v, params: lagrangian(q, v, params), **more)
    q0, qdot0 = (np.asarray(half) for half in start)
    run = lagjax.simulate(scene, q0, qdot0, TS, params)
    pairs = zip(run.q, run.qdot, strict=True)
    shown = np.asarray(run.q if observe is None else [observe(q, v, params) for q, v in pairs])
    record = lagjax.Record(
        TS, shown + SIGMA * np.random.default_rng(0).normal(size=shown.shape), start=lagjax.Guess(q0, qdot0)
    )
    fit = lagjax.fit(scene, record, params, observe=observe)
    assert fit.unseen == () and fit.ok, fit


# ---- records longer than rounding lets one follow --------------------------------------------------------------------


def two_pendulums(q, qdot, params):
    (a, b), (m, n) = params["l"], params["m"]
    swing = a * b * qdot[0] * qdot[1] * jnp.cos(q[0] - q[1])
    kinetic = 0.5 * (m + n) * (a * qdot[0]) ** 2 + n * (0.5 * (b * qdot[1]) ** 2 + swing)
    return kinetic + 9.81 * ((m + n) * a * jnp.cos(q[0]) + n * b * jnp.cos(q[1])) + params["more"] * jnp.cos(q[0])


CHAOTIC = lagjax.System(two_pendulums)
DAMPED_SWING = lagjax.System(
    lambda q, v, params: 0.5 * v**2 + params["w2"] * jnp.cos(q), forces=lambda q, v, params: -params["c"] * v
)
TRUTH = {"l": np.array([1.0, 0.8]), "m": np.array([1.0, 0.6]), "more": 0.0}
HIGH = np.array([2.0, 2.5]), np.zeros(2)


def chaotic_record(end, start):
    ts = np.linspace(0.0, end, int(20 * end) + 1)
    q = np.asarray(lagjax.simulate(CHAOTIC, *HIGH, ts, TRUTH).q)
    return lagjax.Record(ts, q + SIGMA * np.random.default_rng(0).normal(size=q.shape), start=start)


@pytest.mark.parametrize("end, power", [(40.0, 15), pytest.param(400.0, 150, marks=pytest.mark.slow)])
def test_of_a_chaotic_record_nothing_is_said_to_be_unseen_that_is_only_drowned(end, power):
    # Motions part by e^(2 t) or so: within 40 s by 10^20, within 400 s by more than the square of which is a number.
    free = {"l": True, "m": True, "more": False}
    fit = lagjax.fit(CHAOTIC, chaotic_record(end, lagjax.Guess(*HIGH)), TRUTH, free=free, method="whole")
    assert not fit.ok and not any("depends" in sentence for sentence in fit.unseen)
    drowned = fit.unseen[-1]
    assert drowned.startswith("records[0] is chaotic") and "params['l'][1]" in drowned and "shorter" in drowned
    assert int(re.search(r"e\+(\d+),", drowned)[1]) > power
    assert fit.unseen[:-1] == (
        "A common factor of params['m'][0] and params['m'][1] is not seen, only their ratios: keep one of them fixed.",
    )  # no row sees it, long or short
    assert np.isinf(fit.intervals()[1]["l"]).all()


def test_one_parameter_that_a_chaotic_record_cannot_tell_has_no_interval():
    # Its one column is not null, and was the whole of what least squares ask: an interval of 1e-18 of its value.
    free = {"l": False, "m": False, "more": True}
    fit = lagjax.fit(CHAOTIC, chaotic_record(40.0, HIGH), {**TRUTH, "more": 1e-3}, free=free, method="whole")
    assert not fit.ok and "is chaotic" in fit.unseen[0] and "about params['more']." in fit.unseen[0]
    assert fit.intervals()[1]["more"] == np.inf


def test_a_swing_that_noise_gives_says_nothing_of_its_frequency():
    # A pendulum that hangs still, one that swings by half of the noise, and one that rests beside one that moves.
    ts, rng = np.linspace(0.0, 10.0, 501), np.random.default_rng(1)
    exact = np.asarray(lagjax.simulate(DAMPED_SWING, 1.0, 0.0, ts, {"w2": 9.0, "c": 0.1}).q)

    def found(*sizes, law=None, start=None):
        records = [lagjax.Record(ts, x * exact + 0.005 * rng.normal(size=501), start=start) for x in sizes]
        return lagjax.fit(DAMPED_SWING, records, {"w2": 7.0, "c": 0.2}, transforms=lagjax.positive, noise=law)

    still = [found(0.0) for _ in range(6)] + [found(0.0, law=lagjax.StudentT()), found(0.0, 0.0)]
    assert sum(fit.ok for fit in still) <= 1
    assert all(fit.ok or "params['c'] and params['w2']" in fit.unseen[-1] for fit in still)
    moving = [found(0.0025) for _ in range(4)]
    assert all(not fit.unseen for fit in [*moving, found(0.0, 0.1), found(0.1, law=lagjax.StudentT())])
    assert not any("seen to move" in text for text in found(0.0, start=(0.0, 0.0)).unseen)
