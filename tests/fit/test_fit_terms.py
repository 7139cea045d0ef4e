"""`lagjax.terms`: laws of candidate terms, from noisy motions whose terms are known, alike terms, and mistakes."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

TS = np.linspace(0.0, 20.0, 401)
POWERS = {
    "q2": lambda q: q**2 / 2,
    "q3": lambda q: q**3 / 3,
    "q4": lambda q: q**4 / 4,
    "q6": lambda q: q**6 / 6,
    "cos": lambda q: 1 - jnp.cos(q),
}
DRAG = {
    "coulomb": lambda v: -jnp.tanh(v / 1e-2),
    "viscous": lambda v: -v,
    "quadratic": lambda v: -v * jnp.abs(v),
    "stribeck": lambda v: -jnp.tanh(v / 1e-2) * jnp.exp(-((v / 0.3) ** 2)),
}


def potential(candidates):
    law = lagjax.terms(candidates)
    return law, lagjax.System(lambda q, v, params: 0.5 * v**2 - law(q, params=params))


FRICTION = lagjax.terms(DRAG)
SPRING = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2,
    forces=lambda q, v, params: FRICTION(v, params=params["friction"]),
)
DUFFING = lagjax.System(lambda q, v, params: 0.5 * v**2 - params[0] * q**2 / 2 - params[1] * q**4 / 4)
BINOMIAL = lagjax.terms({"a": POWERS["q2"], "b": POWERS["q4"]})
TIMED = lagjax.terms({"a": lambda v, t: -v, "c": lambda v, t: -v * jnp.abs(v)})
PAIR = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - BINOMIAL(q, params=params["laws"][0]),
    forces=lambda q, v, t, params: TIMED(v, t=t, params=params["laws"][1]),
)
TWENTY = lagjax.terms(
    {f"q{k}": lambda q, k=k: q**k / k for k in range(1, 11)}
    | {f"cos{k}": lambda q, k=k: jnp.cos(k * q) / k for k in range(1, 11)}
)
DRIVEN = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - TWENTY(q, params=params), forces=lambda q, v, t: 0.5 * jnp.cos(1.3 * t)
)


def record(scene, q0, params, seed=0, ts=TS, scatter=1e-3):
    motion = np.asarray(lagjax.simulate(scene, q0, 0.0, ts, params).q)
    return lagjax.Record(ts, motion + scatter * np.random.default_rng(seed).normal(size=motion.shape))


def assert_truth(fit, true):
    """The terms of the truth are kept, the others are exactly zero, and four standard deviations hold each number."""
    assert fit.ok, fit.message
    low, high = fit.intervals(0.9999)
    for name, number in true.items():
        assert low[name] <= number <= high[name], (name, fit)
        assert (fit.params[name] != 0.0) == (number != 0.0)
        assert (name in fit.selection.kept) == (number != 0.0)


@pytest.mark.parametrize("numbers", [{"q2": 1.0, "q4": 0.5}, {"cos": 2.0}, {"q3": 0.4, "q2": 2.0}])
def test_a_potential_is_found_among_powers_and_cosine(numbers):
    law, scene = potential(POWERS)
    true = law.params0 | numbers
    assert {type(number) for number in (true | {"q6": 0}).values()} == {float}
    fit = lagjax.fit(scene, record(scene, 2.0, true), law.params0)
    assert_truth(fit, true)
    assert type(fit.params) is type(law.params0) and str(fit.selection) in str(fit)


@pytest.mark.parametrize("units", [(1.0, 1.0), (1.7e-27, 1e-10), (6e24, 1e11)])
def test_the_choice_is_the_same_in_atoms_and_planets(units):
    """Masses and lengths in SI units; numbers of terms differ by 10⁴⁰. A law of q², q³ is found from all starts."""
    mass, length = units
    law = lagjax.terms({"q2": lambda q: q**2 / 2, "q3": lambda q: q**3, "q4": lambda q: q**4})
    scene = lagjax.System(lambda q, v, params: 0.5 * mass * v**2 - law(q, params=params))
    true = law.params0 | {"q2": 10.0, "q3": -10.0 / 6 / length}
    ts = np.linspace(0.0, 10 * np.pi * np.sqrt(mass / 10.0), 201)
    measured = record(scene, 0.3 * length, true, seed=2, ts=ts, scatter=1e-3 * length)
    for start in (0.0, 5.0):
        assert_truth(lagjax.fit(scene, measured, law.params0 | {"q2": start}), true)


def test_friction_is_found():
    law, scene = FRICTION, SPRING
    true = {"k": 4.0, "friction": law.params0 | {"coulomb": 0.05, "viscous": 0.1}}
    records = [record(scene, q0, true, seed) for seed, q0 in enumerate((1.0, 2.0, 1.5))]
    begun = {"k": 3.0, "friction": law.params0 | dict.fromkeys(DRAG, 0.02)}
    for transforms in (None, {"k": lagjax.positive, "friction": dict.fromkeys(DRAG, lagjax.positive)}):
        fit = lagjax.fit(scene, records, begun, transforms=transforms)
        assert fit.ok and set(fit.selection.kept) == {"coulomb", "viscous"}, fit
        np.testing.assert_allclose([fit.params["friction"][name] for name in DRAG], [0.05, 0.1, 0, 0], atol=2e-3)


READING = lagjax.terms({"viscous": lambda v, slow: -v, "fast": lambda v, slow: -v * jnp.exp(-((v / slow[0]) ** 2))})
SLOWED = lagjax.System(
    lambda q, v: 0.5 * v**2 - 0.5 * q**2,
    forces=lambda q, v, params: READING(v, params["slow"], params=params["f"]),
)


def test_a_number_that_only_a_dropped_term_reads_stays_at_its_guess():
    law, scene = READING, SLOWED
    guess = {"f": law.params0, "slow": np.array([0.2])}
    exact = lagjax.simulate(scene, 1.0, 0.0, TS, guess | {"f": law.params0 | {"viscous": 0.1}}).q
    record = lagjax.Record(TS, exact + 1e-3 * np.random.default_rng(0).normal(size=TS.size))
    fit = lagjax.fit(scene, record, guess)
    assert fit.ok and fit.unseen == () and fit.selection.kept == ("viscous",)
    assert fit.selection.idle == ("params['slow']",) and fit.params["slow"] == guess["slow"]
    assert "params['slow'], which stays at its guess" in str(fit.selection)
    alone = lagjax.fit(
        scene,
        record,
        guess | {"f": {"viscous": 0.05, "fast": 0.0}},
        free={"f": {"viscous": True, "fast": False}, "slow": True},
    )
    assert not alone.ok and "params['slow']" in alone.unseen[0]  # which no selection is to blame for


def test_no_term_is_kept_where_none_is_needed():
    law, scene = FRICTION, SPRING
    true = {"k": 4.0, "friction": law.params0}
    fit = lagjax.fit(scene, record(scene, 1.0, true), {"k": 3.0, "friction": law.params0})
    assert fit.ok and fit.selection.kept == () and not any(fit.params["friction"].values())
    assert abs(fit.params["k"] - 4.0) < 1e-2 and "none" in fit.message


def test_a_term_that_is_there_twice_is_named():
    law, scene = potential({"a": POWERS["q2"], "b": lambda q: 3 * q**2, "q4": POWERS["q4"], "one": lambda q: 1 + 0 * q})
    true = law.params0 | {"a": 1.0, "q4": 0.5}
    fit = lagjax.fit(scene, record(scene, 1.5, true), law.params0)
    assert not fit.ok and len(fit.selection.kept) == 2 and "q4" in fit.selection.kept
    assert fit.params["a"] + 6 * fit.params["b"] == pytest.approx(1.0, abs=5e-3)
    assert "The data cannot tell 'b' from 'a'" in fit.message or "The data cannot tell 'a' from 'b'" in fit.message
    assert "depends on 'one'" in str(fit.selection)


def test_terms_that_a_small_swing_cannot_tell_apart_are_named():
    law, scene = potential(POWERS)
    true = law.params0 | {"cos": 1.0}
    fit = lagjax.fit(scene, record(scene, 0.2, true, ts=TS[:100]), law.params0)
    assert not fit.ok and fit.selection.alike and "either fits" in fit.message
    assert {"q2", "cos"} & set(fit.selection.kept)


def test_two_laws_and_terms_of_the_same_name():
    law, drag, scene = BINOMIAL, TIMED, PAIR
    true = {"laws": (law.params0 | {"a": 1.0, "b": 0.5}, drag.params0 | {"a": 0.1})}
    fit = lagjax.fit(scene, record(scene, 1.2, true), {"laws": (law.params0, drag.params0)})
    assert fit.ok and set(fit.selection.kept) == {"params['laws'][0]['a']", "b", "params['laws'][1]['a']"}, fit
    np.testing.assert_allclose(jax.tree.leaves(fit.params), [1.0, 0.5, 0.1, 0.0], atol=1e-2)


def test_numbers_that_stay_and_other_branches():
    law, scene = potential({name: POWERS[name] for name in ("q2", "q3", "q4")})
    true = law.params0 | {"q2": 1.0, "q4": 0.5}
    measured = record(scene, 1.2, true)
    fit = lagjax.fit(scene, measured, law.params0 | {"q2": 1.0}, free={"q2": False, "q3": True, "q4": True})
    assert fit.selection.kept == ("q4",) and fit.params["q2"] == 1.0 and fit.params["q3"] == 0.0
    plain = lagjax.fit(scene, measured, dict(law.params0))
    assert plain.selection is None and plain.params["q3"] != 0.0


def test_twenty_terms_of_a_driven_motion():
    true = TWENTY.params0 | {"q2": 1.0, "q4": 0.5}
    assert_truth(lagjax.fit(DRIVEN, record(DRIVEN, 1.2, true, ts=np.linspace(0.0, 30.0, 1001)), TWENTY.params0), true)


def test_a_law_of_a_dict_and_of_arrays():
    """Terms may return pytrees; the law is the sum of each leaf, written out here by hand."""
    law = lagjax.terms({"a": lambda q: {"x": q["x"] ** 2}, "b": lambda q, scale: {"x": scale * q["x"]}})
    q, numbers = {"x": jnp.array([1.0, 2.0])}, law.params0 | {"a": 3.0, "b": -1.0}
    out = jax.jit(lambda q, params: law(q, scale=2.0, params=params))
    with pytest.raises(TypeError, match="scale"):
        lagjax.terms({"a": lambda q: q})(1.0, scale=2.0, params={"a": 1.0})
    with pytest.raises(TypeError):  # a term that is called without what it needs
        law(q, params=numbers)
    np.testing.assert_allclose(out(q, numbers)["x"], 3.0 * np.array([1.0, 4.0]) - 2.0 * np.array([1.0, 2.0]), rtol=1e-6)


def test_a_scene_with_a_law_goes_through_transformations():
    law, scene = potential(POWERS)
    params = law.params0 | {"q2": 1.0, "q4": 0.5}
    end = lambda params: lagjax.simulate(scene, 1.0, 0.0, np.array([0.0, 1.0]), params).q[-1]
    by_hand = lambda k, l: lagjax.simulate(
        DUFFING,
        1.0,
        0.0,
        [0.0, 1.0],
        (k, l),
    ).q[-1]
    slopes = jax.jit(jax.grad(end))(params)
    expected = jax.grad(by_hand, (0, 1))(1.0, 0.5)
    np.testing.assert_allclose([slopes["q2"], slopes["q4"]], expected, rtol=1e-6)
    assert type(slopes) is type(params) and slopes.law is law
    many = jax.tree.map(lambda x: jnp.array([x, 2 * x]), params)
    assert jax.vmap(end)(many).shape == (2,)


@pytest.mark.parametrize(
    ("given", "said"),
    [({}, "at least one"), ({"a": 1.0}, "must be a function"), ({"a": lambda q, params: q}, "asks for `params`")],
)
def test_what_is_no_law_is_a_sentence(given, said):
    with pytest.raises(TypeError, match=said):
        lagjax.terms(given)


def test_a_name_that_is_no_term_is_a_sentence():
    law, scene = potential(POWERS)
    with pytest.raises(TypeError, match="a number for each term, and no other"):
        lagjax.simulate(scene, 1.0, 0.0, TS, law.params0 | {"Q2": 1.0})
    with pytest.raises(ValueError, match="gradient"):
        lagjax.fit(scene, lagjax.Record(TS, np.cos(TS)), law.params0, method="gradient")


@pytest.mark.slow
def test_the_silverbox_by_its_own_choice(monkeypatch):
    """Forty seconds: three multisines are fitted anew for every term that is dropped, or taken again."""
    root = Path(__file__).parents[2]
    file = root.parent / "shared" / "data" / "silverbox_multisines.npz"
    if not file.exists():
        pytest.skip("the recording is not there")
    monkeypatch.syspath_prepend(str(root / "examples"))
    fit, errors = importlib.import_module("silverbox").main([str(file)])
    assert len(fit.u) <= 9 and errors["left out"] < 0.30  # mV; a block model: 0.96
