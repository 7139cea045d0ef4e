"""`fit` with sampled inputs: an oscillator that is driven, whose motion has a closed form for both holds."""

from pathlib import Path

import diffrax
import numpy as np
import pytest
from lagrangians import spring
from scipy.linalg import expm
from scipy.signal import lfilter, lsim

import lagjax
from lagjax._fit import Parameters, Point
from lagjax._fit.model import _inputs, _motions
from lagjax._interface import Layout

TRUTH = {"k": 4.0, "c": 0.3, "gain": 1.5}
TS = 0.02 * np.arange(200)


def driven(q, qdot, params, inputs):
    return params["gain"] * inputs["u"] - params["c"] * qdot


SCENE, UNDRIVEN = lagjax.System(spring, forces=driven), lagjax.System(spring)


def inputs_of(ts, seed=0):
    return np.random.default_rng(seed).normal(size=len(ts))


def exact(ts, u, hold, start=(0.3, -0.2), truth=TRUTH):
    a = np.array([[0.0, 1.0], [-truth["k"], -truth["c"]]])
    system = a, np.array([[0.0], [truth["gain"]]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))
    return lsim(system, u, ts - ts[0], np.array(start), interp=hold == "linear")[1]


def record_of(ts, hold, seed=0, **more):
    u = inputs_of(ts, seed)
    return lagjax.Record(ts, exact(ts, u, hold), {"u": u}, **more)


@pytest.mark.parametrize("hold", ["zero", pytest.param("linear", marks=pytest.mark.slow)])
def test_a_driven_oscillator_is_followed_and_recovered_from_records_of_any_length(hold):
    ends = [200, 90]
    records = [record_of(1.0 + TS[:end], hold, end) for end in ends]
    fit = lagjax.fit(SCENE, records, {"k": 3.0, "c": 0.1, "gain": 1.0}, transforms=lagjax.positive, hold=hold,
                     method="whole")  # fmt: skip
    # Motions are exact to rtol 1e-9, of size one.
    for name, value in TRUTH.items():
        assert fit.params[name] == pytest.approx(value, rel=1e-6)
    assert np.allclose([start[0] for start in fit.starts], 0.3, atol=1e-7)
    new = record_of(2.0 + TS[:150], hold, 7, start=(0.3, -0.2))
    shown = fit.predict(new)
    assert np.abs(shown.residuals).max() < 1e-6
    np.testing.assert_allclose(shown.trajectory.q, shown.values, atol=1e-8)


def test_pieces_of_a_record_have_tables_of_their_own_and_programs_are_made_for_few_lengths():
    u = np.arange(30.0)[:, None]
    table = _inputs.build_table([(TS[:30], u), (TS[10:14], u[10:14])], "zero")
    assert table.knots.shape == (2, 64) and table.values.shape == (2, 64, 1)
    assert (np.diff(table.knots) > 0).all() and (table.values[1, 4:] == 13.0).all()
    assert {_inputs.table_length(count) for count in range(1, 25_000)} == {16, 64, 256, 1024, 4096, 16384, 65536}


@pytest.mark.slow
def test_segments_begin_where_whole_records_are_out_of_phase():
    records = [record_of(0.02 * np.arange(end), "zero", end) for end in (1500, 900)]
    fit = lagjax.fit(SCENE, records, {"k": 15.0, "c": 1.0, "gain": 1.0}, transforms=lagjax.positive)
    assert all(fit.params[name] == pytest.approx(value, rel=1e-5) for name, value in TRUTH.items())


@pytest.mark.slow
def test_sensors_see_inputs_and_gain_and_bias_are_parameters():
    u = inputs_of(TS)
    values = {"a": 2.0 * exact(TS, u, "zero") + 0.1, "b": u + exact(TS, u, "zero")}

    def observe(q, qdot, params, inputs):
        return {"a": params["sensor"] * q + params["bias"], "b": inputs["u"] + q}

    record = lagjax.Record(TS, values, {"u": u}, start=lagjax.Guess(0.0, 0.0))
    first = {"k": 3.0, "c": 0.1, "gain": 1.0, "sensor": 1.0, "bias": 0.0}
    fit = lagjax.fit(SCENE, record, first, observe=observe)
    assert all(fit.params[name] == pytest.approx(value, rel=1e-5) for name, value in TRUTH.items())
    assert fit.params["sensor"] == pytest.approx(2.0, rel=1e-6) and fit.params["bias"] == pytest.approx(0.1, rel=1e-6)


@pytest.mark.slow
def test_machine_code_and_diffrax_agree_and_derivatives_are_those_of_differences():
    hold = "zero"
    layout, parameters = Layout.from_state(0.0, 0.0), Parameters.from_pytree(TRUTH)
    form = _inputs.InputForm(*record_of(TS[:9], hold).input_structure, hold)
    pieces = [(TS[:9], inputs_of(TS[:9])[:, None]), (TS[3:8], inputs_of(TS[:5], 1)[:, None])]
    table, ts = _inputs.build_table(pieces, hold), np.stack([TS[0:7:3], TS[3:8:2]])
    y0, numbers = np.array([[1.0, 0.0], [0.3, -1.0]]), np.tile(parameters.first, (2, 1))
    y0_dot = np.concatenate([np.broadcast_to(np.eye(2), (2, 2, 2)), np.zeros((2, 3, 2))], axis=1)
    along = y0_dot, np.tile(np.concatenate([np.zeros((2, 3)), np.eye(3)]), (2, 1, 1))
    fast = _motions.choose_motions(SCENE, layout, parameters, 1e-12, form)
    options = {"rtol": 1e-12, "atol": None, "adjoint": diffrax.ForwardMode()}
    plain = _motions._JaxMotions(form.drive_scene(SCENE), layout, parameters, options, True)
    one, other = (motions.follow(ts, y0, numbers, *along, table) for motions in (fast, plain))
    np.testing.assert_allclose(one.path, other.path, atol=1e-8)
    np.testing.assert_allclose(one.tangents, other.tangents, atol=1e-7)
    at = (
        pieces[0][0],
        np.repeat(y0[:1], 9, axis=0),
        np.repeat(numbers[:1], 9, axis=0),
        _inputs.constant_tables(*pieces[0]),
    )
    np.testing.assert_allclose(fast.rate(*at), plain.rate(*at), rtol=1e-12)
    for k, step in enumerate(1e-5 * np.eye(3)):
        after, before = (fast.follow(ts, y0, numbers + way * step, *along, table).path for way in (1, -1))
        np.testing.assert_allclose(one.tangents[:, 2 + k], (after - before) / 2e-5, rtol=1e-6, atol=1e-8)


def test_a_start_may_follow_from_the_parameters():
    u = inputs_of(TS)
    record = lagjax.Record(TS, exact(TS, u, "zero"), {"u": u}, start=lambda params: (params["at"], -0.2))
    fit = lagjax.fit(SCENE, record, {**TRUTH, "at": 0.1}, method="whole")
    assert fit.params["at"] == pytest.approx(0.3, abs=1e-7) and fit.starts[0][0] == fit.params["at"]
    h = 1e-5
    ends = [
        fit.residual_function.evaluate(Point(fit.u + way * h * np.eye(4)[0], np.zeros((1, 2)))).residuals[0]
        for way in (1, -1)
    ]
    slopes = fit.residual_function.evaluate(Point(fit.u, np.zeros((1, 2)))).slopes[0]
    np.testing.assert_allclose(slopes[..., 2], (ends[0] - ends[1]) / (2 * h), atol=1e-7)


def delayed_record(tau, end=200, hold="linear"):
    """Samples at 50 Hz, of which the sensor of `a` is late by tau, and that of `b` is not; the input is a line."""
    ts, fine = TS[:end], np.arange(20 * end) * 1e-3
    u = inputs_of(ts)
    q = exact(fine, np.interp(fine, ts, u), hold)  # at every millisecond
    late = q[np.maximum(np.arange(end) * 20 - round(tau * 1e3), 0)]
    return lagjax.Record(ts, {"a": late, "b": q[::20]}, {"u": u}, start=lagjax.Guess(0.2, 0.0))


def both(q, qdot):
    return {"a": q, "b": q}


def only_first(params):
    return {"a": params["tau"], "b": 0.0}


@pytest.mark.slow
def test_the_delay_of_a_sensor_is_found_with_exact_derivatives():
    record = delayed_record(0.037)
    observe = lagjax.Delayed(only_first, longest=0.1, observe=both)
    transforms = {**dict.fromkeys(TRUTH), "tau": lagjax.between(0.0, 0.1)}
    fit = lagjax.fit(SCENE, record, {**TRUTH, "tau": 0.01, "k": 3.5}, observe=observe, transforms=transforms,
                     hold="linear", method="whole")  # fmt: skip
    # `lsim` between the samples is exact for a line, and the fit to rtol 1e-9.
    assert fit.params["tau"] == pytest.approx(0.037, abs=1e-6) and fit.params["k"] == pytest.approx(4.0, rel=1e-6)
    assert np.abs(fit.starts[0][0] - 0.3) < 1e-6
    u, states = fit.u - 1e-2, fit.states
    slopes = fit.residual_function.evaluate(Point(u, states)).slopes[0]
    for k, step in enumerate(1e-5 * np.eye(len(u))):
        ends = [fit.residual_function.evaluate(Point(u + way * step, states)).residuals[0] for way in (1, -1)]
        np.testing.assert_allclose(slopes[..., 2 + k], (ends[0] - ends[1]) / 2e-5, rtol=1e-5, atol=1e-7)
    shown = fit.predict(record)
    assert np.isnan(shown.values["a"][:5]).all() and np.abs(shown.residuals["a"][6:]).max() < 1e-6


@pytest.mark.slow
def test_sensors_with_a_delay_may_see_time_and_inputs():
    observe = lagjax.Delayed(lambda p: p["tau"], 0.1, lambda q, qdot, t, inputs: q * t + inputs["u"] + qdot)
    u = inputs_of(TS)
    record = lagjax.Record(TS, u, {"u": u}, start=(0.3, -0.2))
    fit = lagjax.fit(SCENE, record, {**TRUTH, "tau": 0.033}, observe=observe, hold="linear", method="whole")
    at, h = fit.parameters.inverse(fit.parameters.first), 1e-6
    slopes = fit.residual_function.evaluate(Point(at, fit.states)).slopes[0]
    for k, step in enumerate(h * np.eye(len(at))):
        ends = [fit.residual_function.evaluate(Point(at + way * step, fit.states)).residuals[0] for way in (1, -1)]
        np.testing.assert_allclose(slopes[..., 2 + k], (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=1e-6)


# ---- what can be wrong -----------------------------------------------------------------------------------------------


def test_what_is_wrong_with_delays_is_a_sentence():
    u = inputs_of(TS)
    record = lagjax.Record(TS[:10], u[:10], start=(0.0, 0.0))
    first = {"k": 1.0, "tau": 0.05}
    with pytest.raises(ValueError, match=r"Record 0 is 0\.18 long, shorter than the longest delay"):
        lagjax.fit(UNDRIVEN, record, first, observe=lagjax.Delayed(lambda params: params["tau"], 0.2))
    with pytest.raises(ValueError, match=r"A delay is 0.05, but must lie between 0 and the longest one, 0.04"):
        lagjax.fit(UNDRIVEN, record, first, observe=lagjax.Delayed(lambda params: params["tau"], 0.04), method="whole")
    with pytest.raises(ValueError, match="delay must return one number, or a prefix"):
        lagjax.fit(UNDRIVEN, record, first, observe=lagjax.Delayed(lambda params: {"x": 0.0}, 0.04))
    with pytest.raises(ValueError, match="longest must be a positive number"):
        lagjax.Delayed(lambda params: 0.0, 0.0)


def smooth(ts):
    return np.sin(1.3 * ts) + 0.5 * np.cos(7.0 * ts + 0.4)


def smooth_record(count, ts, **more):
    """A record under a smooth input that was sampled `count` times, from a motion under it sampled a hundred times as
    densely, in the closed form of `lsim`."""
    fine = np.linspace(0.0, 4.0, 40_001)
    values = np.interp(ts, fine, exact(fine, smooth(fine), "linear"))
    at = np.linspace(-2.0, 6.0, count)
    return lagjax.Record(ts, values, {"u": smooth(at)}, input_ts=at, **more)


@pytest.mark.slow
@pytest.mark.parametrize(("hold", "count", "error"), [("cubic", 321, 2e-4), ("band", 81, 2e-4)])
def test_smooth_inputs_on_times_of_their_own(hold, count, error):
    ts = np.sort(np.random.default_rng(0).uniform(0.0, 4.0, 120))
    record = smooth_record(count, ts, start=None)
    fit = lagjax.fit(SCENE, record, {"k": 3.0, "c": 0.1, "gain": 1.0}, hold=hold)
    for name, value in TRUTH.items():
        assert fit.params[name] == pytest.approx(value, rel=error)
    again = fit.predict(smooth_record(count, ts, start=fit.starts[0]))
    assert np.abs(again.residuals).max() < 1e-4
    np.testing.assert_allclose(again.trajectory.q, again.values, atol=1e-8)
    if hold == "cubic":  # on lines that is far worse
        on_lines = lagjax.fit(SCENE, record, TRUTH, hold="linear")
        assert abs(on_lines.params["gain"] - 1.5) > 10 * abs(fit.params["gain"] - 1.5)


@pytest.mark.parametrize("hold", ["zero", "linear", "cubic", "band"])
@pytest.mark.parametrize("count", [17, 64])
def test_tables_are_the_inputs_of_records_with_the_ends_they_have(hold, count):
    ts, u = 1.0 + 0.1 * np.arange(count), np.random.default_rng(count).normal(size=(count, 1))
    table = _inputs.build_table([(ts, u)], hold)
    at = np.linspace(ts[0], ts[-1], 97)
    expected = lagjax.samples(ts, u, hold)(at)
    np.testing.assert_allclose(lagjax.samples(table.knots[0], table.values[0], hold)(at), expected, atol=1e-10)
    part = _inputs.samples_between(ts, 1.31, 1.55, hold)
    table, at = _inputs.build_table([(ts[part], u[part])], hold), np.linspace(1.31, min(1.55, ts[-1]), 5)[None]
    expected = lagjax.samples(ts, u, hold)(at[0])
    np.testing.assert_allclose(_inputs.inputs_at(table, at, hold)[0][0], expected, atol=1e-10)


@pytest.mark.slow
def test_sensors_see_inputs_between_their_samples():
    ts = np.linspace(0.0, 4.0, 57)
    record = smooth_record(81, ts, start=(0.3, -0.2))
    at = np.asarray(lagjax.samples(record.input_ts, record.inputs["u"], "band")(ts))
    record = lagjax.Record(ts, at, record.inputs, record.start, input_ts=record.input_ts)
    shown = lambda q, qdot, params, inputs: params["scale"] * inputs["u"]
    fit = lagjax.fit(SCENE, record, {**TRUTH, "scale": 0.5}, observe=shown,
                     free={**dict.fromkeys(TRUTH, False), "scale": True}, hold="band")  # fmt: skip
    assert fit.params["scale"] == pytest.approx(1.0, rel=1e-9)


def test_what_is_wrong_with_times_of_inputs_is_a_sentence():
    u, late = np.ones(50), 0.01 + TS[:50]
    with pytest.raises(ValueError, match=r"input_ts begin at 0.01, after the record, which begins at t = 0"):
        lagjax.Record(TS[:40], u[:40], u, input_ts=late)
    with pytest.raises(ValueError, match=r"input_ts are the times of `inputs`, and there are none"):
        lagjax.Record(TS, np.ones(200), input_ts=TS)
    with pytest.raises(ValueError, match=r"input_ts must increase strictly; input_ts\[0\] = 0.98"):
        lagjax.Record(TS, np.ones(200), u, input_ts=TS[:50][::-1])
    with pytest.raises(ValueError, match=r"inputs must have the 49 times as its first axis"):
        lagjax.Record(TS[:40], u[:40], u, input_ts=TS[:49])
    short = lagjax.Record(TS, inputs_of(TS), {"u": u}, input_ts=TS[:50])
    with pytest.raises(
        ValueError, match=r"input_ts of records\[0\] end at 0.98, before the record, which ends at t = 3.98"
    ):
        lagjax.fit(SCENE, short, TRUTH, hold="linear")
    uneven = np.sort(np.random.default_rng(0).uniform(0.0, 1.0, 50))
    with pytest.raises(ValueError, match=r"The inputs of records\[0\]: hold='band' takes evenly spaced ts, but ts"):
        lagjax.fit(SCENE, lagjax.Record(uneven, inputs_of(uneven), {"u": u}), TRUTH, hold="band")


def silverbox(q, qdot, params):
    return 0.5 * qdot**2 - params["k"] * q**2 / 2 - params["k2"] * q**3 / 3 - params["k3"] * q**4 / 4


def drive_silverbox(q, qdot, params, inputs):
    return params["gain"] * inputs - params["c"] * qdot + params["bias"]


SILVERBOX = lagjax.System(silverbox, forces=drive_silverbox)


@pytest.mark.slow
def test_a_silverbox_is_known_to_its_noise():
    file = Path(__file__).parents[3] / "shared" / "data" / "silverbox_multisines.npz"
    if not file.exists():
        pytest.skip("the recording is not there")
    data = np.load(file)
    u, y, each = data["u"].ravel(), data["y"].ravel(), 8675
    still = np.lib.stride_tricks.sliding_window_view(u, 20).std(axis=1) < 1e-3
    begins = [each * k - 150 + np.flatnonzero(still[each * k - 150 : each * k + 150])[-1] + 10 for k in range(1, 10)]
    ends, ts = np.array([*begins[1:], len(u)]) - 80, 1e3 / float(data["fs"]) * np.arange(each)  # milliseconds
    records = [lagjax.Record(ts[: b - a], y[a:b], u[a:b], (0.0, 0.0)) for a, b in zip(begins, ends, strict=True)]

    first = {"k": 0.19, "c": 0.02, "k2": 0.0, "k3": 0.5, "gain": 0.1, "bias": 0.0}
    fit = lagjax.fit(SILVERBOX, records[:2], first, hold="band", method="whole")
    left = np.concatenate([fit.predict(record).residuals for record in records[2:]])
    assert fit.ok and np.sqrt(np.mean(left**2)) < 0.33e-3  # on lines 0.90 mV


def test_what_is_wrong_with_inputs_is_a_sentence():
    u = inputs_of(TS)
    record, bare = lagjax.Record(TS, u, {"u": u}), lagjax.Record(TS, u)
    with pytest.raises(ValueError, match=r"forces asks for `inputs`, which records.0. has none of"):
        lagjax.fit(SCENE, bare, TRUTH)
    with pytest.raises(ValueError, match=r"observe asks for `inputs`, which records.0. has none of"):
        lagjax.fit(UNDRIVEN, bare, TRUTH, observe=lambda q, qdot, inputs: q)
    with pytest.raises(ValueError, match=r"records\[1\] has different inputs from records\[0\]"):
        lagjax.fit(SCENE, [record, bare], TRUTH)
    with pytest.raises(ValueError, match="hold must be one of 'zero', 'linear', 'cubic', 'band'; got 'spline'"):
        lagjax.fit(SCENE, record, TRUTH, hold="spline")
    with pytest.raises(ValueError, match=r"inputs\['u'\]\[3\] is NaN, but what drives a scene must be known"):
        lagjax.Record(TS, u, {"u": np.where(np.arange(len(u)) == 3, np.nan, u)})
    with pytest.raises(TypeError, match=r"start must be .*a function of the parameters"):
        lagjax.Record(TS, u, start=3.0)
    with pytest.raises(
        TypeError, match=r"driven asks for `inputs`, and there are none: the records of lagjax.fit have"
    ):
        lagjax.simulate(SCENE, 0.0, 0.0, np.array([0.0, 1.0]), TRUTH)


@pytest.mark.slow
def test_a_record_of_more_samples_than_a_budget_of_steps_is_followed():
    """A step ends at every sample of held inputs. By the exact map of an oscillator from one sample to the next."""
    count, dt = 70_000, 0.5
    driven = lagjax.System(
        lambda q, v: 0.5 * v**2 - 0.5 * q**2, forces=lambda q, v, params, inputs: inputs - params["c"] * v
    )
    inputs = np.random.default_rng(0).normal(size=count)
    step = expm(dt * np.array([[0.0, 1.0, 0.0], [-1.0, -0.1, 1.0], [0.0, 0.0, 0.0]]))
    # q of x ← A x + b u by its characteristic polynomial, from rest.
    a, b = step[:2, :2], step[:2, 2]
    below = [1.0, -np.trace(a), np.linalg.det(a)]
    exact = lfilter([0.0, b[0], a[0, 1] * b[1] - a[1, 1] * b[0]], below, inputs)
    record = lagjax.Record(dt * np.arange(count), exact, inputs=inputs, start=(0.0, 0.0))
    fit = lagjax.fit(driven, record, {"c": 0.1}, free=False)
    assert np.abs(fit.residuals[0]).max() < 1e-6 * np.abs(exact).max()
    assert np.abs(fit.predict(record).residuals).max() < 1e-6 * np.abs(exact).max()
