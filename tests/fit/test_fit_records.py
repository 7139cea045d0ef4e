"""`lagjax.per_record`: numbers that every record has of its own, against truth and against the same fit by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import f

import lagjax
from lagjax import per_record
from lagjax._fit.model._parameters import Unknowns
from lagjax._fit.model._pieces import Piece
from lagjax._fit.model._residuals import Point, compress_rows
from lagjax._fit.result._information import eliminate_starts, parameter_rows
from lagjax._fit.search import _descent
from lagjax._fit.search._multistart import run_multistart
from lagjax._fit.search._search import _leaves_more

TS = np.linspace(0.0, 6.0, 151)
STIFFNESS, FRICTION = 4.0, 0.2
SPRING = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
PAIR = lagjax.System(
    lambda q, qdot, params: 0.5 * jnp.sum(qdot**2) - 0.5 * params["k"] * jnp.sum(q**2) - 0.5 * (q[0] - q[1]) ** 2
)
MIXED = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * jnp.dot(params["w"], jnp.array([2.0, 6.0])) * q**2)
BALL = lagjax.System(
    lambda q, qdot: 0.5 * qdot**2 - 9.81 * q,
    contacts=lambda q, params: {"board": q - params["h"]},
    restitution=lambda params: params["e"],
)
ROD = lagjax.System(
    lambda q, qdot, params: 0.5 * jnp.sum(qdot**2) - params["g"] * q[1],
    constraints=lambda q, params: jnp.sum(q**2) - params["l"] ** 2,
)
ANGLE = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 + 9.81 / params * jnp.cos(q))


def double_pendulum(q, qdot, params):
    kinetic = qdot[0] ** 2 + 0.5 * params["l"] ** 2 * qdot[1] ** 2
    kinetic += params["l"] * qdot[0] * qdot[1] * jnp.cos(q[0] - q[1])
    return kinetic + 9.81 * (2 * jnp.cos(q[0]) + params["l"] * jnp.cos(q[1]))


DOUBLE = lagjax.System(double_pendulum)
OFFSETS = np.array([0.1, -0.2, 0.05, 0.3])
AMPLITUDES = np.array([1.0, 0.7, 1.3, 0.9])
SCENE = lagjax.System(
    lambda q, qdot, params: 0.5 * qdot**2 - 0.5 * params["k"] * q**2,
    forces=lambda q, qdot, params: -params["c"] * qdot,
)


def swing(ts, amplitude=1.0):
    """The motion from rest at an amplitude, in closed form."""
    w = np.sqrt(STIFFNESS - 0.25 * FRICTION**2)
    return amplitude * np.exp(-0.5 * FRICTION * ts) * (np.cos(w * ts) + 0.5 * FRICTION / w * np.sin(w * ts))


def noisy(values, seed, sigma=2e-3):
    return values + sigma * np.random.default_rng(seed).normal(size=values.shape)


def shifted(q, qdot, params):
    return q + params["offset"]


# Of different lengths, the starts fitted.
RECORDS = [
    lagjax.Record(TS[: 100 + 10 * k], noisy(swing(TS[: 100 + 10 * k], a) + o, k))
    for k, (a, o) in enumerate(zip(AMPLITUDES, OFFSETS, strict=True))
]
PARAMS0 = {"k": 2.5, "c": 0.5, "offset": 0.0}
FREE = {"k": True, "c": True, "offset": per_record}


@pytest.fixture(scope="module")
def offsets():
    return lagjax.fit(SCENE, RECORDS, PARAMS0, observe=shifted, free=FREE)


def contains(fit, **truth):
    low, high = fit.intervals(0.999)
    return all(((low[key] <= value) & (value <= high[key])).all() for key, value in truth.items())


def test_offsets_of_records_are_found_from_where_segments_begin(offsets):
    assert offsets.ok and offsets.params["offset"].shape == (4,)
    assert contains(offsets, offset=OFFSETS, k=STIFFNESS, c=FRICTION)
    assert offsets.covariance.names[:3] == ("params['c']", "params['k']", "params['offset'][0]")
    line = next(line for line in str(offsets).splitlines() if "offset" in line)
    scatter = np.std(offsets.params["offset"], ddof=1)
    assert line.startswith("params['offset']") and f"scatter {scatter:.3g} over 4 records  each ± " in line


def test_it_is_the_fit_of_an_array_that_is_indexed_by_record(offsets):
    rows = [lagjax.Record(r.ts, r.values, inputs=np.full(len(r), float(k))) for k, r in enumerate(RECORDS)]
    shown = lambda q, qdot, params, inputs: q + params["offset"][jnp.round(inputs).astype(int)]
    by_hand = lagjax.fit(SCENE, rows, PARAMS0 | {"offset": np.zeros(4)}, observe=shown)
    np.testing.assert_allclose(offsets.params["offset"], by_hand.params["offset"], atol=1e-8)
    assert offsets.params["k"] == pytest.approx(float(by_hand.params["k"]), rel=1e-8)
    np.testing.assert_allclose(offsets.covariance.matrix, by_hand.covariance.matrix, rtol=1e-6)
    assert offsets.log_likelihood == pytest.approx(by_hand.log_likelihood, abs=1e-8)
    assert offsets.noise["shifted"].effective == by_hand.noise["values"].effective


def test_the_step_is_the_solution_of_the_whole_problem():
    # Three records, the first in three pieces and the others in one, with numbers of their own.
    rng, damping = np.random.default_rng(0), 0.3
    states, own, shared, owners = 2, 2, 3, np.array([0, 0, 1, 2, 0])
    count = 3 * own + shared
    columns = np.array([[*range(own * o, own * o + own), *range(3 * own, count)] for o in owners])
    unknowns = Unknowns(columns, owners, own, count)
    rows = rng.normal(size=(5, 30, states + own + shared + 1))
    triangles, pull = compress_rows(rows), (rng.normal(size=count), rng.normal(size=count))
    scale = _descent.column_norms(triangles, states, unknowns)
    step = _descent.eliminate(triangles, states, scale, damping, pull, unknowns)
    whole, right = np.zeros((150, 5 * states + count)), -rows[..., -1].ravel()
    for k, own_columns in enumerate(columns):
        here = slice(30 * k, 30 * k + 30)
        whole[here, states * k : states * (k + 1)] = rows[k, :, :states]
        whole[here, 5 * states + own_columns] = rows[k, :, states:-1]
    np.testing.assert_allclose(scale[1], np.linalg.norm(whole[:, 5 * states :], axis=0), rtol=1e-12)
    norms = np.sqrt(damping) * np.concatenate([scale[0].ravel(), scale[1]])
    beside = np.concatenate([np.zeros((count, 5 * states)), np.diag(pull[0])], axis=1)
    full, zeros = np.concatenate([whole, np.diag(norms), beside]), np.zeros(len(norms))
    expected, *_ = np.linalg.lstsq(full, np.concatenate([right, zeros, -pull[1]]), rcond=None)
    np.testing.assert_allclose(np.concatenate([step.starts.ravel(), step.u]), expected, atol=1e-12)
    limits = np.full(count, -1e-3), np.full(count, 1e-3)
    assert (np.abs(_descent.eliminate(triangles, states, scale, damping, pull, unknowns, limits).u) <= 1e-3).all()


@pytest.mark.parametrize("own", [0, 2])
def test_sums_over_records_are_those_of_whole_rows(own):
    rng, records, shared = np.random.default_rng(0), 6, 3
    owners = np.array([0, 0, 1, 2, 2, 2])
    count = own * 3 + shared
    places = [[*(own * owner + np.arange(own)), *range(own * 3, count)] for owner in owners]
    unknowns = Unknowns(np.array(places), owners, own, count)
    local = rng.normal(size=(records, 4, own + shared))
    whole = np.zeros((records, 4, count))
    for row, columns in enumerate(places):
        whole[row][:, columns] = local[row]
    np.testing.assert_array_equal(unknowns.spread(local), whole)
    flat = whole.reshape(-1, count)
    np.testing.assert_allclose(unknowns.add(local.swapaxes(1, 2) @ local), flat.T @ flat, atol=1e-14)


def test_records_of_the_fit_and_others_are_predicted(offsets):
    own = offsets.predict(RECORDS[3])
    np.testing.assert_allclose(own.residuals, offsets.residuals[3], atol=1e-4)
    # Another record has an offset of its own, which is found with its start, and makes its values less certain.
    other = lagjax.Record(TS, noisy(swing(TS, 0.8) + 0.5, 9), start=lagjax.Guess(0.5, 0.0))
    new = offsets.predict(other)
    assert new.start[0] == pytest.approx(0.8, abs=2e-3) and np.std(new.residuals) == pytest.approx(2e-3, rel=0.2)
    known = offsets.predict(lagjax.Record(TS, other.values, start=(0.8, 0.0)))
    assert 0.0 < np.median(known.deviation) < np.median(new.deviation) < 2e-3
    np.testing.assert_allclose(known.values, swing(TS, 0.8) + 0.5, atol=2e-3)
    planned = {
        "long": lagjax.Record(TS, 0 * TS, start=(0.8, 0.0)),
        "short": lagjax.Record(TS[:9], TS[:9], start=(0.8, 0.0)),
    }
    assert offsets.next_experiment(planned).names == ("long", "short")


@pytest.mark.slow
def test_methods_of_the_result_know_the_numbers_of_records(offsets, tmp_path):
    profile, low_and_high = offsets.profile("offset[2]"), [end["offset"][2] for end in offsets.intervals()]
    np.testing.assert_allclose(profile.interval, low_and_high, rtol=0.02)
    assert offsets.to_pandas().loc["params['offset'][1]", "value"] == offsets.params["offset"][1]
    density = offsets.log_density()
    assert density.params(density.first)["offset"].shape == (4,)
    slope = np.asarray(jax.grad(density)(density.first))
    assert np.abs(slope * np.sqrt(np.diag(density.covariance()))).max() < 0.05  # of a standard deviation from its top
    offsets.report(tmp_path / "fit.html")


@pytest.mark.slow
def test_left_out_records_are_fitted_with_numbers_of_their_own(offsets):
    shared = lagjax.fit(SCENE, RECORDS, PARAMS0, observe=shifted, free={**FREE, "offset": True})
    compared = shared.compare({"of each": offsets}, folds=2)
    assert compared.best == "of each" and compared.left_out[1]["shifted"] == pytest.approx(2e-3, rel=0.1)
    assert not shared.ok and shared.rms["shifted"] > 0.1


@pytest.mark.parametrize("transform", [lagjax.positive, lagjax.between(0.1, 5.0)])
def test_amplitudes_that_starts_are_computed_from(transform):
    start = lambda params: (params["a"], 0.0)
    rows = [lagjax.Record(TS, noisy(swing(TS, a), k), start=start) for k, a in enumerate(AMPLITUDES)]
    fit = lagjax.fit(
        SCENE, rows, {"k": 3.5, "c": 0.3, "a": 1.0}, free={"k": True, "c": True, "a": per_record}, transforms=transform
    )
    assert fit.ok and contains(fit, a=AMPLITUDES, k=STIFFNESS, c=FRICTION)


def test_an_array_of_every_record_and_a_transform_of_the_whole():
    squares = np.array([3.0, 4.0, 5.0])
    rows = [lagjax.Record(TS, noisy(np.cos(np.sqrt(k) * TS), int(k)), start=(1.0, 0.0)) for k in squares]
    half = {"w": np.array([0.5, 0.5])}
    fit = lagjax.fit(MIXED, rows, half, free=per_record, transforms=lagjax.simplex)
    assert fit.ok and fit.params["w"].shape == (3, 2)
    np.testing.assert_allclose(fit.params["w"].sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(fit.params["w"] @ [2.0, 6.0], squares, rtol=2e-3)
    assert "params['w'][:, 1]" in str(fit)
    each = np.array([lagjax.positive, None])
    apart = lagjax.fit(MIXED, rows, half, free={"w": per_record}, transforms={"w": each}, method="whole")
    assert not apart.ok and len(apart.unseen) == 3
    assert (
        "Of params['w'][2, 0] and params['w'][2, 1] only params['w'][2, 0] + 3 params['w'][2, 1] is" in apart.unseen[2]
    )


@pytest.mark.slow
def test_delays_of_records():
    delays = np.array([0.02, 0.05, 0.08])
    late = [swing(np.maximum(TS - delay, 0.0)) for delay in delays]
    rows = [lagjax.Record(TS, noisy(q, k, 1e-3), start=(1.0, 0.0)) for k, q in enumerate(late)]
    sensors = lagjax.Delayed(lambda params: params["tau"], longest=0.15)
    fit = lagjax.fit(
        SCENE, rows, {"k": 3.5, "c": 0.3, "tau": 0.07}, observe=sensors, free={"k": True, "c": True, "tau": per_record},
        transforms={"k": None, "c": None, "tau": lagjax.between(0.0, 0.15)},
    )  # fmt: skip
    assert fit.ok and contains(fit, tau=delays, k=STIFFNESS)


@pytest.mark.slow
def test_clocks_of_timings():
    # Each clock began at another time before the pendulum was let go.
    late = np.array([0.3, 0.5, 0.1])

    def start(params):
        angle = jnp.sqrt(params["k"]) * params["late"]
        return jnp.cos(angle), jnp.sqrt(params["k"]) * jnp.sin(angle)

    times = [noisy(0.5 * (np.pi / 2 + np.pi * np.arange(6)) + delay, k, 1e-4) for k, delay in enumerate(late)]
    rows = [lagjax.Timings(lambda q, qdot: q, own, t0=0.0, start=start) for own in times]
    fit = lagjax.fit(SPRING, rows, {"k": 3.8, "late": 0.3}, free={"k": True, "late": per_record})
    assert fit.ok and contains(fit, late=late, k=4.0)


@pytest.mark.slow
def test_heights_of_a_board_that_a_ball_meets():
    heights, ts = np.array([0.02, -0.03, 0.05]), np.linspace(0.0, 1.2, 121)

    def bounce(h):
        """The fall to the board at h, and the arcs after two impacts."""
        first = np.sqrt(2 * (1.0 - h) / 9.81)
        second = first + 2 * 0.7 * first
        rise = lambda t, speed: h + speed * t - 0.5 * 9.81 * t**2
        arcs = 1.0 - 0.5 * 9.81 * ts**2, rise(ts - first, 0.7 * 9.81 * first), rise(ts - second, 0.49 * 9.81 * first)
        return np.select([ts < first, ts < second], arcs[:2], arcs[2])

    rows = [lagjax.Record(ts, noisy(bounce(h), k, 1e-3), start=(1.0, 0.0)) for k, h in enumerate(heights)]
    fit = lagjax.fit(BALL, rows, {"h": 0.0, "e": 0.6}, free={"h": per_record, "e": True})
    assert fit.ok and contains(fit, h=heights, e=0.7)


@pytest.mark.slow
def test_lengths_of_rods_whose_starts_lie_on_constraints():
    lengths, ts, rows = np.array([0.9, 1.0, 1.1]), np.linspace(0.0, 3.0, 101), []
    for k, length in enumerate(lengths):
        theta = np.asarray(lagjax.simulate(ANGLE, 1.0, 0.0, ts, length).q)
        rows.append(lagjax.Record(ts, noisy(length * np.stack([np.sin(theta), -np.cos(theta)], axis=1), k, 1e-3)))
    fit = lagjax.fit(ROD, rows, {"g": 9.0, "l": 1.0}, free={"g": True, "l": per_record}, transforms=lagjax.positive)
    assert fit.ok and contains(fit, l=lengths, g=9.81)


@pytest.mark.slow
def test_of_several_systems_those_that_do_not_see_a_number_keep_it():
    slow, fast = np.cos(2.0 * TS), np.cos(np.sqrt(6.0) * TS)
    both = [lagjax.Record(TS, noisy(0.5 * np.stack([slow + fast, slow - fast], axis=1), k, 1e-3)) for k in range(2)]
    own = [lagjax.Record(TS, noisy(a * slow + o, k, 1e-3)) for k, (a, o) in enumerate(((1.0, 0.1), (0.5, -0.2)))]
    fit = lagjax.fit(
        {"single": SPRING, "pair": PAIR}, {"single": own, "pair": both}, {"k": 3.0, "offset": 0.0},
        observe={"single": shifted, "pair": None}, free={"k": True, "offset": per_record},
    )  # fmt: skip
    assert fit.ok and fit.covariance.names == ("params['k']", "params['offset'][0]", "params['offset'][1]")
    assert contains(fit, k=4.0, offset=np.array([0.1, -0.2, 0.0, 0.0])) and (fit.params["offset"][2:] == 0.0).all()
    new = fit.predict(lagjax.Record(TS, 0.4 * slow + 0.7), system="single")
    assert np.abs(new.residuals).max() < 1e-3
    assert np.std(fit.predict(lagjax.Record(TS, both[0].values), system="pair").residuals) < 1.2e-3


@pytest.mark.slow
def test_chaotic_records_in_pieces_have_one_offset_each():
    ts, truth = np.linspace(0.0, 15.0, 1501), np.array([[0.05, -0.02], [-0.04, 0.03]])
    rows = []
    for k, offset in enumerate(truth):
        q = np.asarray(lagjax.simulate(DOUBLE, np.array([2.0, 2.3 + 0.2 * k]), np.zeros(2), ts, {"l": 1.0}).q)
        rows.append(lagjax.Record(ts, noisy(q + offset, k)))
    free = {"l": True, "offset": per_record}
    fit = lagjax.fit(DOUBLE, rows, {"l": 0.9, "offset": np.zeros(2)}, observe=shifted, free=free)
    assert fit.ok and "pieces" in fit.message and contains(fit, l=1.0, offset=truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [{"noise": lagjax.StudentT()}, {"starts": 6}, {"noise": lagjax.Quantised(0.02)}, {"method": "gradient"}]
)
def test_other_searches_find_the_same_offsets(settings, offsets):
    rows = RECORDS
    if isinstance(settings.get("noise"), lagjax.Quantised):
        rows = [lagjax.Record(r.ts, 0.02 * np.round(r.values / 0.02)) for r in RECORDS]
    fit = lagjax.fit(SCENE, rows, PARAMS0, observe=shifted, free=FREE, **settings)
    assert contains(fit, offset=OFFSETS)
    np.testing.assert_allclose(fit.params["offset"], offsets.params["offset"], atol=2e-3)


def test_what_nothing_depends_on_is_said_once():
    fit = lagjax.fit(SCENE, RECORDS[:2], PARAMS0 | {"z": 0.0}, observe=shifted, free={**FREE, "z": per_record})
    assert fit.unseen == ("Nothing that was measured in any record depends on params['z'].",) and not fit.ok
    assert "not seen in every record" in str(fit)


def test_mistakes_are_sentences():
    with pytest.raises(
        ValueError, match=r"params\['offset'\] is lagjax\.per_record, and there is one record: say True"
    ):
        lagjax.fit(SCENE, RECORDS[0], PARAMS0, observe=shifted, free=FREE)
    with pytest.raises(TypeError, match=r"params\['offset'\] is free but not a float"):
        lagjax.fit(SCENE, RECORDS, PARAMS0 | {"offset": 0}, observe=shifted, free=FREE)
    with pytest.raises(TypeError, match=r"free must hold True or False, or lagjax\.per_record; got 3"):
        lagjax.fit(SCENE, RECORDS, PARAMS0, observe=shifted, free={**FREE, "offset": 3})
    with pytest.raises(ValueError, match=r"params\['offset'\] must start above zero"):
        lagjax.fit(SCENE, RECORDS, PARAMS0, observe=shifted, free=FREE, transforms=lagjax.positive)


def test_numbers_of_records_are_eliminated_one_record_after_the_other():
    """The square of the rows is that of the whole matrix, where records share owners and have more or fewer numbers."""
    rng, columns = np.random.default_rng(0), np.array([[0, 1, 5, 6], [0, 1, 5, 6], [2, 7, 5, 6], [3, 4, 5, 6]])
    unknowns = Unknowns(columns, np.array([0, 0, 1, 2]), 2, 7)
    triangles = np.triu(rng.normal(size=(4, 7, 7)))
    triangles[2, :, 3] = 0.0  # of a number that it does not have
    whole = unknowns.spread(eliminate_starts(triangles, triangles[..., :-1], 2)).reshape(-1, 7)
    rows = parameter_rows(triangles, 2, unknowns)
    assert len(rows) == 3 * 2 + 2
    np.testing.assert_allclose(rows.T @ rows, whole.T @ whole, atol=1e-12)


def test_a_trial_in_two_parts_is_that_at_once_and_one_of_some_records_is_a_part_of_it():
    """Motions first, derivatives then; records of several lengths, whose batches differ where one is left out."""
    records = []
    for k, end in enumerate((9.0, 5.0, 3.0)):
        ts = np.arange(0.0, end, 0.05)
        records.append(lagjax.Record(ts, np.cos(1.2 * ts + k)))
    fit = lagjax.fit(SPRING, records, {"k": 1.4})
    residuals, whole = fit.residual_function, fit.residual_function.evaluate(Point(fit.u, fit.states))
    bare = residuals.evaluate(whole.point, slopes=False)
    for begun in (bare, residuals.evaluate(whole.point, begun=bare)):
        for name in ("residuals", "slopes")[: 1 + bool(begun.slopes)]:
            for found, right in zip(getattr(begun, name), getattr(whole, name), strict=True):
                np.testing.assert_array_equal(found, right)
    assert not bare.slopes
    for keep in (np.array([False, True, True]), np.array([True, False, True])):
        part, some = residuals.select(keep, whole)
        for name in ("residuals", "slopes"):
            for found, right in zip(getattr(some, name), getattr(part.evaluate(some.point), name), strict=True):
                np.testing.assert_allclose(found, right, atol=1e-9)


def test_long_pieces_that_leave_more_than_chance_are_another_minimum():
    """The F test of two fits of a linear model, one within the other."""
    count, few, many = 1800, 9, 63
    edge = 1.0 + f.isf(1e-4, many - few, count - many) * (many - few) / (count - many)

    def ended(numbers: int, squares: float) -> SimpleNamespace:
        likelihood = lambda trial, noise: -0.5 * count * np.log(squares)
        residuals = SimpleNamespace(log_likelihood=likelihood, measured=count, free_states=numbers - 3)
        return SimpleNamespace(residuals=residuals, trial=SimpleNamespace(u=np.zeros(3)), noise=None)

    for squares, more in ((0.9, False), (0.999 * edge, False), (1.001 * edge, True), (100.0, True)):
        assert _leaves_more(ended(few, squares), ended(many, 1.0)) == more


def test_pieces_that_follow_the_motion_are_better_than_a_whole_record_that_does_not():
    """The best of several searches, of which the first ends in two pieces."""
    states = np.stack([np.cos(2 * TS), -2 * np.sin(2 * TS)], axis=1)
    record = lagjax.Record(TS, noisy(states[:, 0], 0), start=(1.0, 0.0))
    whole = (fit := lagjax.fit(SPRING, record, {"k": 4.1})).residual_function
    cut = whole.with_pieces([Piece(0, np.arange(80)), Piece(0, np.arange(80, 151))], np.ones(2, bool))
    ends = [(whole, Point(0.5 * fit.u, states[:1])), (cut, Point(fit.u, states[[0, 80]]))]

    def search(point):
        of, end = ends.pop() if len(ends) > 1 else ends[0]
        trial = of.evaluate(end)
        return _descent.Descent(of, trial, of.noise_scale(trial, lagjax.Gaussian()), True, 1, "")

    assert run_multistart(whole, search, Point(fit.u, states[:1]), 2, 0)[0].residuals is cut
