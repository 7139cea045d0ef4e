"""Sampled inputs, and look-ups in tables: exact between knots, with derivatives by everything."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import oscillator, weight
from scenes import particle
from scipy.interpolate import CubicHermiteSpline

import lagjax
from lagjax._program import LOOK_UPS
from lagjax._tracing import lower

RNG = np.random.default_rng(0)
KNOTS = np.cumsum(RNG.uniform(0.05, 0.3, 12))
KNOTS -= KNOTS[0]
VALUES = RNG.normal(size=12)
END = np.array([0.0, KNOTS[-1]])
MACHINE = lagjax.MachineCode()
INTERPOLATED = lagjax.System(oscillator, forces=lambda q, qdot, t, params: jnp.interp(t, KNOTS, params))


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


@functools.cache
def driven(hold):
    """An oscillator that an input drives: one system for each hold, which is compiled once."""
    force = lambda q, qdot, t, params: lagjax.samples(params["t"], params["u"], hold)(t)
    return lagjax.System(oscillator, forces=force)


def end_of(hold, knots, values, start=0.3, **options):
    """q and q̇ at the last knot."""
    params = {"t": jnp.asarray(knots), "u": jnp.asarray(values)}
    ts = jnp.stack([jnp.asarray(knots)[0], jnp.asarray(knots)[-1]])
    run = lagjax.simulate(driven(hold), start, 0.1, jax.lax.stop_gradient(ts), params, **options)
    return jnp.stack([run.q[-1], run.qdot[-1]])


def exact(hold, knots, values, start=0.3):
    """The same in closed form: about the input, which is linear between knots, the motion is a rotation."""

    def over(state, piece):
        x0, x1, v0, v1 = piece
        h, (q, v) = x1 - x0, state
        slope = 0.0 if hold == "zero" else (v1 - v0) / h
        c, s = jnp.cos(h), jnp.sin(h)
        q, v = q - v0, v - slope
        return (q * c + v * s + v0 + slope * h, v * c - q * s + slope), None

    x, u = jnp.asarray(knots), jnp.asarray(values)
    start = jnp.asarray(start), jnp.asarray(0.1)
    return jnp.stack(jax.lax.scan(over, start, (x[:-1], x[1:], u[:-1], u[1:]))[0])


# ---- the function of time --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 9])
def test_between_knots_it_is_what_scipy_says(count):
    x = np.cumsum(RNG.uniform(0.1, 1.0, count))
    v, t = RNG.normal(size=(count, 2)), np.linspace(x[0], x[-1], 41)
    slopes = np.gradient(v, x, axis=0, edge_order=min(2, count - 1))
    expected = {
        "zero": v[np.searchsorted(x, t, side="right") - 1],
        "linear": np.stack([np.interp(t, x, column) for column in v.T], axis=1),
        "cubic": CubicHermiteSpline(x, v, slopes)(t),
    }
    for hold, values in expected.items():
        np.testing.assert_allclose(lagjax.samples(x, v, hold)(t), values, atol=1e-13)


def sinusoids(t, share, step):
    """Three sinusoids up to a share of the Nyquist frequency of samples with this step."""
    return sum(np.sin(part * share * np.pi / step * t + phase) for part, phase in ((1.0, 0.3), (0.7, 1.0), (0.2, 2.0)))


@pytest.mark.parametrize("share", [0.05, 0.4, 0.8])
def test_a_band_limited_input_comes_back_from_its_samples(share):
    step, count = 0.1, 200
    x = 3.0 + step * np.arange(count)
    t = np.linspace(x[20], x[-21], 1001)
    u = lagjax.samples(x, sinusoids(x, share, step), "band")
    np.testing.assert_allclose(u(t), sinusoids(t, share, step), atol=3e-5)
    rates = jax.jit(jax.vmap(jax.grad(u)))(t)
    closed = (sinusoids(t + 1e-6, share, step) - sinusoids(t - 1e-6, share, step)) / 2e-6
    np.testing.assert_allclose(rates, closed, atol=1e-4 * np.pi / step)
    np.testing.assert_allclose(u(x), sinusoids(x, share, step), atol=1e-13)


@pytest.mark.parametrize("count", [2, 3, 10, 40])
def test_at_its_ends_a_band_limited_input_is_reflected(count):
    x, v = np.arange(float(count)), RNG.normal(size=(count, 2))
    j = np.arange(-40, count + 40)
    nearest = lambda j: v[np.clip(j, 0, count - 1)]  # what is farther away than the record is long stays
    beyond = nearest(j) + (v[0] - nearest(-j)) + (v[-1] - nearest(2 * (count - 1) - j))
    t = np.linspace(0.0, count - 1.0, 37)
    inner = lagjax.samples(j.astype(float), beyond, "band")
    np.testing.assert_allclose(lagjax.samples(x, v, "band")(t), inner(t), atol=1e-12)
    np.testing.assert_allclose(lagjax.samples(x, np.full(count, 2.5), "band")(t), 2.5, rtol=1e-14)
    assert np.isnan(lagjax.samples(x, v, "band")(np.array([-0.1, count - 0.9]))).all()


def test_knots_of_a_band_are_even():
    with pytest.raises(ValueError, match=r"knots\[3\] - knots\[2\] = 1.1 where the mean is 1.0.* Use hold='cubic'"):
        lagjax.samples(np.array([0.0, 1.0, 2.0, 3.1, 4.1]), np.ones(5), "band")
    u = jax.jit(lambda x, t: lagjax.samples(x, jnp.ones(5), "band")(t))
    assert np.isnan(u(np.array([0.0, 1.0, 2.0, 3.1, 4.1]), 2.5)) and abs(u(np.arange(5.0), 2.5) - 1.0) < 1e-14
    rounded = np.round(np.arange(50) / 610.3515625, 6)
    assert np.isfinite(lagjax.samples(rounded, np.ones(50), "band")(0.01))


@pytest.mark.slow
def test_a_motion_under_a_band_limited_input_is_exact_with_derivatives():
    step, count = 0.2, 80
    x = step * np.arange(count)
    v = sinusoids(x, 0.5, step)
    fine = x[0] + (x[-1] - x[0]) * np.arange(400 * (count - 1) + 1) / (400 * (count - 1))
    dense = np.asarray(lagjax.samples(x, v, "band")(fine))
    closed = lambda v: exact("linear", fine, v)  # of 400 pieces in each of its own: (h / 400)² u″ / 12
    np.testing.assert_allclose(end_of("band", x, v), closed(dense), atol=1e-5)
    run = lagjax.simulate(driven("band"), 0.3, 0.1, np.array([0.0, x[-1]]), {"t": x, "u": v}, solver=MACHINE)
    other = lagjax.simulate(driven("band"), 0.3, 0.1, np.array([0.0, x[-1]]), {"t": x, "u": v}, solver=diffrax.Dopri8())
    np.testing.assert_allclose(run.q, other.q, atol=1e-7)
    slopes = jax.grad(lambda v: end_of("band", x, v)[0])(np.asarray(v))
    direction = RNG.normal(size=count)
    ahead = np.asarray(lagjax.samples(x, direction, "band")(fine))
    np.testing.assert_allclose(slopes @ direction, (closed(dense + ahead) - closed(dense))[0], atol=1e-4)


def test_outside_nothing_is_made_up():
    for hold, beyond in (("zero", VALUES[-1]), ("linear", np.nan), ("cubic", np.nan)):
        u = lagjax.samples(KNOTS, VALUES, hold)
        at = np.array([KNOTS[-1], KNOTS[-1] + 1.0, KNOTS[0] - 1e-9, np.nan])
        np.testing.assert_allclose(u(at), [VALUES[-1], beyond, np.nan, np.nan], rtol=1e-14)


def test_it_is_a_function_of_jax():
    at = jnp.array([0.2, 1.1])
    of = lambda t, u, x: lagjax.samples(x, u, "cubic")(t)
    by_t = jax.jit(jax.vmap(jax.grad(of), in_axes=(0, None, None)))(at, VALUES, KNOTS)
    slopes = np.gradient(VALUES, KNOTS, edge_order=2)
    np.testing.assert_allclose(by_t, CubicHermiteSpline(KNOTS, VALUES, slopes)(at, 1), rtol=1e-10)
    by_values = jax.jit(jax.jacrev(of, argnums=1))(at, VALUES, KNOTS)
    np.testing.assert_allclose(by_values @ VALUES, of(at, VALUES, KNOTS), rtol=1e-13)  # it is linear in them
    several = jax.jit(jax.vmap(of, in_axes=(None, 0, 0)))(at, np.stack([VALUES, 2 * VALUES]), np.stack([KNOTS, KNOTS]))
    np.testing.assert_allclose(several[1], 2 * several[0], rtol=1e-14)
    assert lagjax.samples(KNOTS.astype(np.float32), VALUES.astype(np.float32))(np.float32(0.2)).dtype == np.float32


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([0.0, 2.0, 1.0], [1.0, 2.0, 3.0]), r"knots\[2\] = 1 comes after knots\[1\] = 2"),
        (([0.0, 1.0, 1.0], [1.0, 2.0, 3.0]), "knots must increase"),
        (([0.0, 1.0], [1.0, 2.0, 3.0]), r"one row for each of 2 knots, not \(3,\)"),
        (([0.0, 1.0], [1.0, np.nan]), r"values\[1\] is nan"),
        (([0.0, np.inf], [1.0, 2.0]), r"knots\[1\] is inf"),
        (([0.0, 1.0], [1.0, 2.0], "spline"), "hold='spline' is not known"),
        (([[0.0, 1.0]], [1.0, 2.0]), r"shape \(K,\)"),
        (([0.0], [1.0], "linear"), "K ≥ 2"),
    ],
)
def test_what_cannot_be_right_is_said(arguments, words):
    with pytest.raises(ValueError, match=words):
        lagjax.samples(*map(np.asarray, arguments[:2]), *arguments[2:])


# ---- motions ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_motions_are_exact_at_every_tolerance(hold):
    closed = exact(hold, KNOTS, VALUES)
    for rtol in (1e-6, 1e-9, 1e-13):
        np.testing.assert_allclose(end_of(hold, KNOTS, VALUES, rtol=rtol), closed, atol=max(rtol, 1e-15) * 10)
    run = lagjax.simulate(driven(hold), 0.3, 0.1, END, {"t": KNOTS, "u": VALUES}, solver=MACHINE)
    assert run.stats["num_accepted_steps"] == len(KNOTS) - 1 and run.stats["num_rejected_steps"] == 0


def test_derivatives_by_samples_and_by_their_instants():
    by = lambda f: jax.jit(jax.grad(lambda u, x, q: f("zero", x, u, q)[0], argnums=(0, 1, 2)))
    found, closed = (by(f)(np.asarray(VALUES), np.asarray(KNOTS), 0.3) for f in (end_of, exact))
    np.testing.assert_allclose(found[0], closed[0], atol=1e-12)
    np.testing.assert_allclose(found[1][1:-1], closed[1][1:-1], atol=1e-12)  # the first and the last are times of it
    np.testing.assert_allclose(found[2], closed[2], rtol=1e-12)


def test_members_with_samples_and_knots_of_their_own():
    values, knots = RNG.normal(size=(9, 12)), np.sort(RNG.uniform(0.01, KNOTS[-1] - 0.01, (9, 12)))
    knots[:, 0], knots[:, -1] = 0.0, KNOTS[-1]
    run = lagjax.simulate_batch(
        driven("zero"), np.full(9, 0.3), np.full(9, 0.1), END, {"t": knots, "u": values}, batch_axes=(0, 0, 0)
    )
    closed = jax.vmap(functools.partial(exact, "zero"))(knots, values)
    np.testing.assert_allclose(run.q[:, -1], closed[:, 0], atol=1e-9)


def test_beyond_the_last_sample_a_motion_fails_there():
    with pytest.raises(lagjax.SimulationError, match=r"beyond t = 1\.97168387 of 2\.97"):
        lagjax.simulate(driven("linear"), 0.3, 0.1, END + np.array([0.0, 1.0]), {"t": KNOTS, "u": VALUES})


def test_knots_among_params_that_do_not_increase():
    knots = np.delete(np.insert(KNOTS, 3, KNOTS[5]), 6)

    def run(t, values=VALUES):
        return lagjax.simulate(driven("zero"), 0.3, 0.1, END, {"t": t, "u": values}, throw=False).q[-1]

    with pytest.raises(ValueError, match=r"knots of a look-up .* must increase"):
        run(knots)
    assert np.isnan(jax.jit(run)(knots)) and np.isfinite(jax.jit(run)(KNOTS))


def test_samples_are_no_inputs_of_a_program():
    count = 25_000
    knots = np.arange(count) * 1e-3

    def force(t, params):
        return lagjax.samples(knots, params["u"], "cubic")(t) * params["gain"]

    program = lower(force, 0.0, {"u": jax.ShapeDtypeStruct((count,), float), "gain": 1.0})
    assert program.operations < 100 and sum(op in LOOK_UPS for op, *_ in program.line.nodes) < 16
    assert program.find_inputs([0]) == frozenset(range(count + 2))
    values, t = np.sin(knots), np.array([0.5, 20.1234])
    found = program.evaluate_many([t, 2.0, *values])[0]
    np.testing.assert_allclose(found, 2 * np.sin(t), atol=1e-9)


def test_a_long_record():
    knots = np.arange(25_000) * 1e-3
    values = np.where(knots % 2 < 1, 1.0, -1.0)
    run = lagjax.simulate(driven("zero"), 0.3, 0.1, np.array([0.0, 24.999]), {"t": knots, "u": values})
    np.testing.assert_allclose(run.q[-1], exact("zero", knots, values)[0], atol=1e-9)
    assert run.stats["num_accepted_steps"] == 24_999


# ---- slower ones -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_derivatives_of_every_mode(hold):
    def both(f):
        return lambda z: jnp.sum(f(hold, KNOTS, z[:-1], z[-1]) ** 2)

    z, d = np.append(np.asarray(VALUES), 0.3), np.asarray(RNG.normal(size=13))
    for transform in (
        jax.grad, jax.jacfwd, jax.hessian, lambda f: jax.jit(jax.hessian(f)),
        lambda f: lambda z: jax.jvp(jax.grad(f), (z,), (d,))[1],
        lambda f: lambda z: jax.vmap(jax.grad(f))(jnp.stack([z, 2 * z, z + d])),
    ):  # fmt: skip
        np.testing.assert_allclose(transform(both(end_of))(z), jax.jit(transform(both(exact)))(z), atol=2e-11)


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_second_derivatives_by_instants(hold):
    """Of an input that jumps, and of one that bends: by knots, by values and by both, in every mode.

    Compiles the tangent flows along 11 and 11 and along 11 and 1 directions, and the transposes of the first.
    """

    def in_motion(f):
        # The ends are no knots that the motion passes.
        return lambda x, u: f(hold, jnp.concatenate([KNOTS[:1], x, KNOTS[-1:]]), u)[0]

    inner, values = np.asarray(KNOTS[1:-1]), np.asarray(VALUES)
    closed = jax.jit(jax.hessian(in_motion(exact), argnums=(0, 1)))(inner, values)
    for outer, by in ((jax.jacfwd, jax.grad), (jax.jacfwd, jax.jacfwd), (jax.jacrev, jax.jacfwd)):
        found = outer(by(in_motion(end_of), argnums=(0, 1)), argnums=(0, 1))(inner, values)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found, closed)


@pytest.mark.slow
def test_instants_of_two_inputs_that_coincide_have_no_derivatives():
    force = lambda q, qdot, t, params: sum(lagjax.samples(params["t"][k], params["u"][k])(t) for k in range(2))
    scene, other = lagjax.System(oscillator, forces=force), np.linspace(0.0, KNOTS[-1], 12)
    other[5] = KNOTS[5]

    def end(knots, values):
        return lagjax.simulate(scene, 0.3, 0.1, END, {"t": knots, "u": values}).q[-1]

    knots, values = np.stack([KNOTS, other]), np.asarray(RNG.normal(size=(2, 12)))
    together = (
        exact("zero", KNOTS, values[0])[0] + exact("zero", other, values[1])[0] - exact("zero", KNOTS, 0 * VALUES)[0]
    )
    np.testing.assert_allclose(end(knots, values), together, atol=1e-9)  # it is linear
    by_knots, by_values = jax.grad(end, argnums=(0, 1))(knots, values)
    one = jax.grad(lambda x: exact("zero", x, values[0])[0])(np.asarray(KNOTS))
    assert np.isnan(by_knots[:, 5]).all() and np.isfinite(by_values).all()
    forward = jax.jvp(lambda u: end(knots, u), (values,), (np.cos(values),))[1]
    np.testing.assert_allclose(forward, np.vdot(by_values, np.cos(values)), atol=1e-10)
    for along in np.eye(24).reshape(24, 2, 12)[[5, 17]]:
        assert np.isnan(jax.jvp(lambda x: end(x, values), (knots,), (np.asarray(along),))[1])
    np.testing.assert_allclose(np.delete(by_knots[0], 5)[1:-1], np.delete(one, 5)[1:-1], atol=1e-11)


@pytest.mark.slow
def test_time_runs_backwards():
    params = {"t": KNOTS, "u": VALUES}
    back = lagjax.simulate(driven("linear"), 0.3, 0.1, END[::-1], params)
    again = lagjax.simulate(driven("linear"), back.q[-1], back.qdot[-1], END, params)
    np.testing.assert_allclose([again.q[-1], again.qdot[-1]], [0.3, 0.1], atol=1e-12)


@pytest.mark.slow
def test_engines_agree():
    closed = end_of("cubic", KNOTS, VALUES)
    np.testing.assert_allclose(end_of("cubic", KNOTS, VALUES, solver=diffrax.Dopri8()), closed, atol=1e-7)
    single = [x.astype(np.float32) for x in (KNOTS, VALUES)]
    run = lagjax.simulate(
        driven("linear"),
        np.float32(0.3),
        np.float32(0.1),
        np.asarray(END, np.float32),
        dict(zip("tu", single, strict=True)),
    )
    assert run.q.dtype == np.float32
    np.testing.assert_allclose(run.q[-1], exact("linear", KNOTS, VALUES)[0], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("backward", [False, True])
def test_steps_of_diffrax_end_at_knots(backward):
    """The held input jumps at twelve instants, both ends included. Compiles two runs of diffrax and a gradient."""
    ts, params = END[::-1] if backward else END, {"t": jnp.asarray(KNOTS), "u": jnp.asarray(VALUES)}

    def end(u, solver):
        return lagjax.simulate(driven("zero"), 0.3, 0.1, ts, params | {"u": u}, solver=solver)

    run, closed = end(params["u"], diffrax.Dopri8()), end(params["u"], MACHINE)
    np.testing.assert_allclose(run.q[-1], closed.q[-1], atol=1e-9)
    assert run.stats["num_rejected_steps"] == 0 and run.stats["num_accepted_steps"] < 30
    slopes = [jax.grad(lambda u, s=s: end(u, s).q[-1])(params["u"]) for s in (diffrax.Dopri8(), MACHINE)]
    np.testing.assert_allclose(*slopes, atol=1e-9)


@pytest.mark.slow
def test_interpolation_of_jax_is_known():
    def end(values):
        return lagjax.simulate(INTERPOLATED, 0.3, 0.1, END, values, solver=MACHINE).q[-1]

    closed = lambda values: exact("linear", KNOTS, values)[0]
    np.testing.assert_allclose(end(VALUES), closed(VALUES), atol=1e-10)
    np.testing.assert_allclose(jax.grad(end)(VALUES), jax.jit(jax.grad(closed))(np.asarray(VALUES)), atol=1e-10)


@pytest.mark.slow
def test_terrain_by_the_floor_of_a_place():
    heights, width = 0.2 * RNG.normal(size=40), 0.1
    force = lambda q, qdot, t, params: params[jnp.floor(q / width).astype(int)]
    scene = particle(force)

    def exact_end(heights):
        q, v, t = 0.05, 1.0, 0.0
        for k in range(40):
            a, way = heights[k], (k + 1) * width - q
            left = (-v + np.sqrt(v * v + 2 * a * way)) / a
            if t + left > 1.5:
                return q + v * (1.5 - t) + a * (1.5 - t) ** 2 / 2
            q, v, t = (k + 1) * width, v + a * left, t + left

    def end(heights):
        return lagjax.simulate(scene, 0.05, 1.0, jnp.array([0.0, 1.5]), heights, solver=MACHINE).q[-1]

    np.testing.assert_allclose(end(heights), exact_end(heights), atol=1e-11)
    differences = [(exact_end(heights + d) - exact_end(heights - d)) / 2e-5 for d in 1e-5 * np.eye(40)]
    np.testing.assert_allclose(jax.grad(end)(np.asarray(heights)), differences, atol=1e-8)


def force_beyond_samples(q, qdot, t, params):
    side = jnp.where(q > lagjax.samples(params["t"], params["u"], "linear")(t), 1.0, -1.0)
    return 0.3 * side - 0.05 * qdot


FOLLOWED_BORDER = lagjax.System(oscillator, forces=force_beyond_samples)


@pytest.mark.slow
def test_a_border_that_follows_samples():
    def end(knots, values):
        return lagjax.simulate(FOLLOWED_BORDER, 1.0, 0.0, END, {"t": knots, "u": values}, solver=MACHINE).q[-1]

    x, u = np.asarray(KNOTS), np.asarray(0.5 * VALUES)
    for k, f in enumerate((lambda x: end(x, u), lambda u: end(x, u))):
        at, step = (x, u)[k], 1e-6
        differences = np.stack([(f(at + d) - f(at - d)) / (2 * step) for d in step * np.eye(12)[1:-1]])
        for derivative in (jax.grad, jax.jacfwd):
            np.testing.assert_allclose(derivative(f)(at)[1:-1], differences, atol=1e-8)


@pytest.mark.slow
def test_a_block_on_a_belt_whose_speed_is_sampled():
    # It sticks from the first knot on at which the belt is slow enough to be followed, and slips where the speed jumps.
    knots, speeds = np.array([0.0, 1.0, 2.0]), np.array([0.5, -0.5, 0.25])
    force = lambda q, qdot, t, params: -2.0 * jnp.sign(qdot - lagjax.samples(knots, params)(t))
    block = particle(force)
    ts = np.array([0.0, 0.25, 0.75, 1.5, 1.75, 3.0])
    run = lagjax.simulate(block, 0.0, 0.0, ts, speeds, solver=MACHINE)
    np.testing.assert_allclose(run.qdot, [0.0, 0.5, 0.5, -0.5, -0.5, 0.25], atol=1e-9)
    # From rest to a speed v: after v/2 at ±2 it sticks.
    way = 0.0625 + 0.5 * 0.75 + 0.0 - 0.5 * 0.5 + (0.25**2 - 0.5**2) / 4 + 0.25 * (1 - 0.375)
    np.testing.assert_allclose(run.q[-1], way, atol=1e-9)
    slopes = jax.grad(lambda u: lagjax.simulate(block, 0.0, 0.0, ts, u, solver=MACHINE).q[-1])(np.asarray(speeds))
    ends = [lagjax.simulate(block, 0.0, 0.0, ts, speeds + d, solver=MACHINE).q[-1] for d in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(slopes, (np.array(ends) - run.q[-1]) / 1e-5, atol=1e-4)


def driven_pivot(q, t, params):
    return jnp.sum((q - jnp.stack([lagjax.samples(KNOTS, params, "cubic")(t), 0.0])) ** 2) - 1.0


DRIVEN_PIVOT = lagjax.System(weight, constraints=driven_pivot)


@pytest.mark.slow
def test_a_constraint_that_samples_drive():
    values = np.concatenate([np.zeros(3), 0.1 * RNG.normal(size=9)])

    def middle(values):
        ts = jnp.linspace(0.0, KNOTS[-1], 4)
        return lagjax.simulate(DRIVEN_PIVOT, jnp.array([0.0, -1.0]), jnp.zeros(2), ts, values, solver=MACHINE).q[2, 0]

    u, d = np.asarray(values), np.eye(12)[4]
    difference = (middle(u + 1e-6 * d) - middle(u - 1e-6 * d)) / 2e-6
    np.testing.assert_allclose(jax.grad(middle)(u)[4], difference, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(middle, (u,), (d,))[1], difference, rtol=1e-7)


@pytest.mark.slow
def test_what_machine_code_does_not_look_up_is_said():
    def refusal(force, params):
        scene = lagjax.System(oscillator, forces=force)
        with pytest.raises(ValueError) as error:
            lagjax.simulate(scene, 0.3, 0.1, END, params, solver=MACHINE)
        return str(error.value)

    computed = lambda q, qdot, t, params: jnp.interp(q, jnp.linspace(-2, 2, 1000), jnp.cumsum(params))
    assert "pass the array in params" in refusal(computed, np.full(1000, 1e-3))


@pytest.mark.slow
def test_health_does_not_blame_what_lies_between_outputs():
    for hold, count in (("zero", 50), ("linear", 50), ("zero", 12)):
        ts = np.asarray(KNOTS) if count == 12 else np.linspace(0.0, KNOTS[-1], count)
        report = lagjax.simulate(driven(hold), 0.3, 0.1, ts, {"t": KNOTS, "u": VALUES}).health()
        assert not report.suspicious
        if count == 12:  # outputs at the knots: between them nothing jumps
            assert report.energy.value < 1e-12 and report.work_error < 1e-9


@pytest.mark.slow
def test_explain_and_check_know_samples():
    params = {"t": KNOTS, "u": VALUES}
    text = str(driven("zero").explain(0.3, 0.1, params=params))
    assert "1: samples by t; steps end there" in text and "machine code" in text
    assert not [f for f in lagjax.check(driven("zero"), 0.3, 0.1, params=params) if f.level == "error"]


@pytest.mark.slow
def test_times_of_outputs_and_rates():
    def end(t):
        params = {"t": KNOTS, "u": VALUES}
        return lagjax.simulate(driven("zero"), 0.3, 0.1, jnp.stack([jnp.zeros(()), t]), params)

    np.testing.assert_allclose(jax.grad(lambda t: end(t).q[-1])(1.03), end(np.asarray(1.03)).qdot[-1], rtol=1e-13)
