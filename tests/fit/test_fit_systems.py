"""`fit` of records of several systems that share parameters: a single and a double pendulum on one earth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import pendulum_in_gravity, weight_in_gravity
from scenes import PENDULUM_IN_GRAVITY
from scipy.integrate import solve_ivp

import lagjax

TRUTH = {"g": 9.81, "bearing": 0.05, "motor": 2.0}
FIRST = {"g": 9.6, "bearing": 0.04, "motor": 1.9, "mass": 1.0}
FREE = {"g": True, "bearing": True, "motor": True, "mass": False}
TS = np.linspace(0.0, 3.0, 91)
SIGMA = 1e-3

SINGLE = lagjax.System(
    pendulum_in_gravity,
    dissipation=lambda q, qdot, params: 0.5 * params["bearing"] * qdot**2,
    forces=lambda q, qdot, inputs, params: params["motor"] * inputs,
)


def energy(q, qdot, params):
    kinetic = qdot[0] ** 2 + 0.5 * qdot[1] ** 2 + qdot[0] * qdot[1] * jnp.cos(q[0] - q[1])
    return kinetic + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


DOUBLE = lagjax.System(
    energy, dissipation=lambda q, qdot, params: 0.5 * params["bearing"] * (qdot[0] ** 2 + (qdot[1] - qdot[0]) ** 2)
)
ROD = lagjax.System(weight_in_gravity, constraints=lambda q: q @ q - 0.64)
SYSTEMS = {"single": SINGLE, "double": DOUBLE}


def tip(q, qdot):
    """What the camera sees of the double pendulum."""
    return {"x": jnp.sin(q[0]) + jnp.sin(q[1]), "elbow": q[0]}


OBSERVE = {"single": None, "double": tip}


RATES = {
    "single": lambda t, y, g, c, k: [y[1], k * t / 3 - c * y[1] - g * np.sin(y[0])],
    "double": lambda t, y, g, c, _: [*y[2:], *_double(y[:2], y[2:], g, c)],
}


def _double(q, qdot, g, c):
    """The accelerations by hand: masses and lengths are one."""
    across, turning = np.cos(q[0] - q[1]), np.sin(q[0] - q[1])
    matrix = np.array([[2.0, across], [across, 1.0]])
    torque = c * np.array([2 * qdot[0] - qdot[1], qdot[1] - qdot[0]])
    forces = turning * np.array([-(qdot[1] ** 2), qdot[0] ** 2]) - g * np.array([2 * np.sin(q[0]), np.sin(q[1])])
    return np.linalg.solve(matrix, forces - torque)


def followed(name, start):
    """Positions (T, n) to 1e-10, by another integrator and other equations."""
    run = solve_ivp(RATES[name], TS[[0, -1]], start, "DOP853", TS, args=tuple(TRUTH.values()), rtol=1e-10, atol=1e-11)
    return run.y[: len(start) // 2].T


def measured(seed=0):
    """A driven record of the single pendulum, without a start, and two free ones of the double one, with guesses."""
    rng, double = np.random.default_rng(seed), []
    values = followed("single", [-0.5, 0.2])[:, 0]
    single = lagjax.Record(TS, values + SIGMA * rng.normal(size=len(TS)), TS / 3)
    for angle in (0.3, -0.5):
        start = np.array([angle, -0.2, 0.3, 0.1])
        seen = jax.tree.map(np.asarray, jax.vmap(tip)(jnp.asarray(followed("double", start)), np.zeros((len(TS), 2))))
        seen = {name: values + 2 * SIGMA * rng.normal(size=len(TS)) for name, values in seen.items()}
        double.append(lagjax.Record(TS, seen, start=lagjax.Guess(start[:2], start[2:])))
    return {"single": single, "double": double}


OPTIONS = {"hold": "linear", "method": "whole"}


@pytest.fixture(scope="module")
def records():
    return measured()


@pytest.fixture(scope="module")
def joint(records):
    return lagjax.fit(SYSTEMS, records, FIRST, observe=OBSERVE, free=FREE, **OPTIONS)


def test_the_joint_estimate_weighs_those_of_each_system_by_their_information(records, joint):
    # With the starts eliminated, the sum of squares of each system is a parabola of the parameters, and parabolas add.
    alone = lagjax.fit(SINGLE, records["single"], FIRST, free=FREE, **OPTIONS)
    other = lagjax.fit(DOUBLE, records["double"], FIRST, observe=tip, free={**FREE, "motor": False}, **OPTIONS)
    assert joint.covariance.names == ("params['bearing']", "params['g']", "params['motor']")
    precision, pull = np.zeros((3, 3)), np.zeros(3)
    for fit, own in ((alone, slice(0, 3)), (other, slice(0, 2))):
        precision[own, own] += np.linalg.inv(fit.information.white)
        pull[own] += np.linalg.inv(fit.information.white) @ fit.u
    deviation = np.sqrt(np.diag(np.linalg.inv(precision)))
    # A search ends within 0.05 standard deviations; they bend over one by a thousandth of their slopes.
    np.testing.assert_allclose(joint.u / deviation, np.linalg.solve(precision, pull) / deviation, rtol=0, atol=0.1)
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(joint.information.white / scale, np.linalg.inv(precision) / scale, rtol=0, atol=0.02)
    assert joint.ok and (np.abs(joint.u - [0.05, 9.81, 2.0]) < 4 * np.sqrt(np.diag(joint.covariance.matrix))).all()
    assert (deviation[:2] < 0.95 * np.sqrt(np.diag(other.information.white))).all()


def test_what_comes_out_has_the_names_of_the_systems(records, joint):
    assert list(joint.noise) == ["single: q", "double: values['elbow']", "double: values['x']"]
    sigma = [noise.sigma / SIGMA for noise in joint.noise.values()]
    np.testing.assert_allclose(sigma, [1.0, 2.0, 2.0], rtol=0.25)  # of 91 and of 182 samples: 5 to 7 %
    assert joint.starts["single"][0][0] == pytest.approx(-0.5, abs=5 * SIGMA)
    assert np.shape(joint.starts["double"][0][0]) == (2,) and set(joint.residuals["double"][1]) == {"x", "elbow"}
    np.testing.assert_allclose(joint.starts["double"][0][0], [0.3, -0.2], atol=5 * SIGMA)
    text = str(joint)
    assert "single: q" in text and "3 records" in text


def test_a_record_of_one_system_is_predicted(records, joint):
    shown = joint.predict(records["double"][1], system="double")
    assert all(np.sqrt(np.mean(left**2)) < 3 * SIGMA for left in shown.residuals.values())
    low, high = shown.bands(0.9999)
    for name, values in records["double"][1].values.items():
        assert ((low[name] < values) & (values < high[name])).mean() > 0.98
    with pytest.raises(ValueError, match="give system=, one of 'single', 'double'"):
        joint.predict(records["single"])


def test_segments_of_one_system_bring_all_from_far_off(records, joint):
    # The tip's signals are no positions: only records of the single pendulum can be cut into segments.
    far = {"g": 3.0, "bearing": 0.4, "motor": 0.5, "mass": 1.0}
    fit = lagjax.fit(SYSTEMS, records, far, observe=OBSERVE, free=FREE, hold="linear")
    np.testing.assert_allclose((fit.u - joint.u) / np.sqrt(np.diag(joint.covariance.matrix)), 0.0, atol=0.1)


def test_many_starts_of_several_systems_are_one_batch(records, joint):
    far = {"g": 3.0, "bearing": 0.4, "motor": 0.5, "mass": 1.0}
    positive = {**dict.fromkeys(far, lagjax.positive), "motor": None}
    fit = lagjax.fit(
        SYSTEMS, records, far, observe=OBSERVE, free=FREE, transforms=positive, starts=6, **OPTIONS
    )  # fmt: skip
    values = np.array([fit.params[name] for name in ("bearing", "g", "motor")])
    np.testing.assert_allclose((values - joint.u) / np.sqrt(np.diag(joint.covariance.matrix)), 0.0, atol=0.1)
    assert len(fit.waterfall.misfits) == 6 and fit.waterfall.misfits[0] < 0.01


def test_a_system_whose_only_record_is_left_out_is_judged_by_the_noise_of_the_whole_fit(joint):
    left = joint.compare(joint, folds=3).left_out[0]
    assert list(left) == list(joint.noise) and np.isfinite(list(left.values())).all()
    assert left["double: values['x']"] == pytest.approx(2 * SIGMA, rel=0.25)


def test_what_no_system_sees_is_named(records, joint):
    fit = lagjax.fit(SYSTEMS, records, FIRST, observe=OBSERVE, **OPTIONS)
    assert fit.unseen == ("Nothing that was measured depends on params['mass'].",)
    np.testing.assert_allclose(fit.params["g"], joint.params["g"], rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "error", "sentence"),
    [
        ({"records": []}, TypeError, "records must be a dict by the same names, 'single', 'double'; got list"),
        ({"records": {"single": []}}, ValueError, "records has nothing for the system 'double'"),
        ({"observe": {**OBSERVE, "triple": None}}, ValueError, "observe has 'triple', which is the name of no system"),
        ({"system": SINGLE, "observe": None}, TypeError, "records is a dict, so system must be"),
        ({"system": SINGLE, "records": [], "observe": {}}, TypeError, "observe is a dict, so system must be"),
        ({"system": {}}, ValueError, "system is an empty dict"),
        ({"system": {1: SINGLE}}, TypeError, "have names; 1 is no str"),
        ({"observe": None}, ValueError, "Of the system 'double': values must have the structure of q"),
        ({"method": "gradient", "starts": 2}, ValueError, "goes down from one start"),
    ],
)
def test_what_cannot_be_is_a_sentence(records, change, error, sentence):
    given = {"system": SYSTEMS, "records": records, "params0": FIRST, "observe": OBSERVE, **OPTIONS, **change}
    with pytest.raises(error, match=sentence):
        lagjax.fit(**given)


def test_the_next_experiment_is_one_of_a_system(joint):
    planned = {
        name: lagjax.Record(TS, 0 * TS, push * TS, start=(0.1, 0.0)) for name, push in (("none", 0), ("strong", 3))
    }
    table = joint.next_experiment(planned, system="single")
    assert table.names == ("strong", "none") and table.parameters[np.argmin(table.deviations[0])] == "params['motor']"


@pytest.mark.slow
def test_profiles_reports_and_plots_know_of_several_systems(joint, tmp_path):
    pytest.importorskip("matplotlib").use("Agg")
    low, high = joint.intervals()
    # Three thousandths of g are far within where the sum of squares is a parabola.
    np.testing.assert_allclose(joint.profile("params['g']").interval, (low["g"], high["g"]), rtol=1e-5)
    joint.report(tmp_path / "fit.html")
    text = (tmp_path / "fit.html").read_text(encoding="utf-8")
    assert "<h2>single: Data over fit" in text and "<h2>double: Data over fit" in text
    assert lagjax.plot.fit(joint, record=0).shape == (2, 1) and lagjax.plot.fit(joint, record=2).shape == (2, 2)


@pytest.mark.slow
def test_crossing_times_of_one_system_and_constraints_of_another():
    gates = PENDULUM_IN_GRAVITY
    sections, span = {"bottom": lambda q, qdot: q}, np.array([0.0, 6.0])
    times = lagjax.crossings(gates, sections, 1.0, 0.0, span, {"g": 9.81})["bottom"]
    passed = np.asarray(times.t)[: int(times.count)]
    q0 = 0.8 * np.array([np.sin(0.9), -np.cos(0.9)])
    values = np.asarray(lagjax.simulate(ROD, q0, 0 * q0, TS, {"g": 9.81}).q)
    timings = lagjax.Timings(
        sections, {"bottom": passed}, t0=0.0, start=lagjax.Guess(0.9, 0.1), direction={"bottom": 0}
    )
    fit = lagjax.fit({"gates": gates, "rod": ROD}, {"gates": timings, "rod": lagjax.Record(TS, values)}, {"g": 9.0})
    # Both are exact to rtol 1e-9 of their motions.
    assert fit.params["g"] == pytest.approx(9.81, rel=1e-6)
    assert list(fit.noise) == ["gates: times", "rod: q[0]", "rod: q[1]"]
    np.testing.assert_allclose(np.concatenate(fit.starts["rod"][0]), [*q0, 0.0, 0.0], atol=1e-6)
