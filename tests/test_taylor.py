"""The Taylor series method: closed forms, its order, its output between steps, and every transformation of JAX."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax.scenes
from lagjax._equations import equations
from lagjax._layout import Layout
from lagjax._program import lower, series
from lagjax._taylor import Taylor


def solve(field, y0, args=None, t0=0.0, t1=5.0, order=13, tolerance=1e-10, **options):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), options.pop("solver", Taylor(order)), t0, t1, None, y0, args,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), **options,
    )  # fmt: skip


def oscillator(t, y, k):
    return y[1], -k * y[0]


def pendulum(t, y, args):
    return {"q": y["v"], "v": -args["g"] / args["l"] * jnp.sin(y["q"])}


PENDULUM = {"q": jnp.array(1.0), "v": jnp.array(0.3)}


def kepler(t, y, mu):
    return {"r": y["v"], "v": -mu * y["r"] / jnp.sum(y["r"] ** 2) ** 1.5}


# ---- against closed forms --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order, tolerance", [(7, 1e-5), (13, 1e-10), (20, 1e-13)])
def test_exponential(order, tolerance):
    # The estimate is the last term kept, the error the first one left out, e² smaller or more; 5 units of time at most
    # 20 steps.
    end = solve(lambda t, y, args: -y, jnp.array([1.0, 2.0]), order=order, tolerance=tolerance).ys[0]
    np.testing.assert_allclose(end, np.exp(-5.0) * np.array([1.0, 2.0]), atol=3 * tolerance)


def test_a_field_that_depends_on_time():
    # ẏ = 2 t y cos t²: y = exp sin t².
    solution = solve(lambda t, y, args: 2 * t * y * jnp.cos(t**2), jnp.array(1.0), t1=2.0, tolerance=1e-11)
    np.testing.assert_allclose(solution.ys[0], np.exp(np.sin(4.0)), rtol=1e-9)


def test_kepler_comes_back_after_a_period():
    # From the pericentre of e = ½, a = 1; mu = 1: period 2π. Errors along the orbit grow with its time.
    e = 0.5
    start = {"r": jnp.array([1 - e, 0.0]), "v": jnp.array([0.0, np.sqrt((1 + e) / (1 - e))])}
    solution = solve(kepler, start, jnp.array(1.0), t1=4 * np.pi, order=16, tolerance=1e-12)
    for name in start:
        np.testing.assert_allclose(solution.ys[name][0], start[name], atol=1e-9)
    others = solve(kepler, start, jnp.array(1.0), t1=4 * np.pi, solver=diffrax.Dopri8(), tolerance=1e-12)
    assert 3 * solution.stats["num_steps"] < 2 * others.stats["num_steps"]


@pytest.mark.parametrize("order", [4, 7, 10])
def test_order_of_convergence(order):
    # Fixed steps, so long that the error stays above rounding: halving them divides it by 2ᵖ.
    def error(steps):
        term, start = diffrax.ODETerm(oscillator), (jnp.array(1.0), jnp.array(0.5))
        end = diffrax.diffeqsolve(term, Taylor(order), 0.0, 6.0, 6.0 / steps, start, jnp.array(1.0)).ys
        return np.hypot(end[0][0] - np.cos(6) - 0.5 * np.sin(6), end[1][0] + np.sin(6) - 0.5 * np.cos(6))

    coarse = 8 if order < 10 else 4
    assert np.log2(error(2 * coarse) / error(4 * coarse)) == pytest.approx(order, abs=0.4)


def test_the_error_estimate_is_the_last_term():
    h, k, p = 0.5, 1.0, 8
    term, start = diffrax.ODETerm(oscillator), (jnp.array(1.0), jnp.array(0.0))
    _, error, dense, *_ = Taylor(p).step(term, jnp.array(0.0), jnp.array(h), start, jnp.array(k), None, False)
    factorial = float(np.prod(np.arange(1.0, p + 1)))
    np.testing.assert_allclose(error[0], h**p / factorial, rtol=1e-12)  # cos: even powers
    np.testing.assert_allclose(error[1], h ** (p - 1) / (factorial / p) / np.e**2, rtol=1e-12)
    polynomial = Taylor.interpolation_cls(t0=0.0, t1=jnp.array(h), **dense)
    rise = polynomial.evaluate(0.1, 0.3)[0]
    np.testing.assert_allclose(rise, np.cos(0.3) - np.cos(0.1), atol=1e-8)
    assert Taylor(p).order(term) == Taylor(p).error_order(term) == p


# ---- states between steps --------------------------------------------------------------------------------------------


def test_output_between_steps_is_as_good_as_the_ends():
    ts = jnp.linspace(0.0, 6.0, 200)
    start = (jnp.array(1.0), jnp.array(0.5))
    solution = solve(oscillator, start, jnp.array(1.0), t1=6.0, tolerance=1e-12, saveat=diffrax.SaveAt(ts=ts))
    np.testing.assert_allclose(solution.ys[0], np.cos(ts) + 0.5 * np.sin(ts), atol=2e-11)


def test_the_polynomial_meets_both_ends_exactly():
    saveat = diffrax.SaveAt(dense=True, t0=True, t1=True)
    solution = solve(pendulum, PENDULUM, {"g": 9.81, "l": jnp.array(2.0)}, saveat=saveat, max_steps=64)
    for name in PENDULUM:
        np.testing.assert_array_equal(solution.evaluate(0.0)[name], solution.ys[name][0])
        np.testing.assert_array_equal(solution.evaluate(5.0)[name], solution.ys[name][-1])
    slope = solution.derivative(1.5)  # of the polynomial; the field may differ by a tolerance for each step length
    np.testing.assert_allclose(slope["q"], solution.evaluate(1.5)["v"], atol=1e-8)


# ---- transformations -------------------------------------------------------------------------------------------------

TRUE = {"g": 9.81, "l": 2.0}


def final_angle(args, solver=None, tolerance=1e-9, **options):
    options = {"solver": solver or Taylor(7), "tolerance": tolerance, "t1": 2.0, **options}
    return solve(pendulum, PENDULUM, args, **options).ys["q"][0]


def test_gradients_agree_with_a_runge_kutta_method():
    args = {name: jnp.array(value) for name, value in TRUE.items()}
    reverse = jax.jit(jax.grad(final_angle))(args)
    runge_kutta = lambda args: final_angle(args, diffrax.Dopri8(), 1e-12, adjoint=diffrax.ForwardMode())
    reference = jax.jit(jax.jacfwd(runge_kutta))(args)
    along = lambda args: final_angle(args, adjoint=diffrax.ForwardMode())
    forward = jax.jit(lambda args, moving: jax.jvp(along, (args,), (moving,))[1])(args, reference)
    for name in args:
        np.testing.assert_allclose(reverse[name], reference[name], rtol=1e-7)
    np.testing.assert_allclose(forward, sum(x**2 for x in reference.values()), rtol=1e-7)


def test_batches_and_gradients_of_batches():
    gs = jnp.array([9.81, 5.0, 1.62])
    run = jax.value_and_grad(lambda g: final_angle({"g": g, "l": 2.0}, Taylor(5), 1e-7))
    single = jax.jit(run)
    # The lanes compute sines by another routine: equal to rounding, which steps may amplify to a tolerance.
    batch = jax.jit(jax.vmap(run))(gs)
    np.testing.assert_allclose(np.array(batch), np.array([single(g) for g in gs]).T, rtol=1e-6)


def test_parameters_closed_over_or_in_the_term():
    class Decay(eqx.Module):
        rate: jax.Array

        def __call__(self, t, y, args):
            return -self.rate * y

    run = lambda rate: solve(Decay(rate), jnp.array(1.0), t1=1.0, order=6).ys[0]
    closed = lambda rate: solve(lambda t, y, args: -rate * y, jnp.array(1.0), t1=1.0, order=6).ys[0]
    rates = jnp.array([0.7, 1.0])
    np.testing.assert_allclose(jax.vmap(run)(rates), np.exp(-rates), rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(closed)))(rates), -np.exp(-rates), rtol=1e-8)


def test_backward_in_time():
    ts = jnp.linspace(3.0, 0.0, 7)
    start = (jnp.array(1.0), jnp.array(0.5))
    forced = lambda t, y, args: (y[1], -y[0] + jnp.cos(2 * t))  # of time too, which must run backward with the state
    back = solve(forced, start, t0=3.0, t1=0.0, tolerance=1e-11, saveat=diffrax.SaveAt(ts=ts)).ys
    again = solve(forced, jax.tree.map(lambda x: x[-1], back), t1=3.0, tolerance=1e-11).ys
    np.testing.assert_allclose([again[0][0], again[1][0]], start, atol=1e-9)
    # q = −cos(2t)/3 + A cos t + B sin t through (1, ½) at t = 3.
    a, b = np.linalg.solve(
        [[np.cos(3), np.sin(3)], [-np.sin(3), np.cos(3)]], [1 + np.cos(6) / 3, 0.5 - 2 * np.sin(6) / 3]
    )
    np.testing.assert_allclose(back[0], -np.cos(2 * ts) / 3 + a * np.cos(ts) + b * np.sin(ts), atol=1e-9)


def test_single_precision():
    single = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)
    t0, t1 = jnp.float32([0.0, 5.0])
    # A fast oscillator: its coefficients without the powers of h would overflow, k¹⁰ = 1e60.
    solution = solve(oscillator, single((1.0, 0.0)), jnp.float32(1e6), t0, t1 / 100, order=20, tolerance=1e-5)
    assert solution.ys[0].dtype == solution.ts.dtype == jnp.float32
    np.testing.assert_allclose(solution.ys[0][0], np.cos(50.0), atol=1e-3)
    angle = solve(pendulum, single(PENDULUM), single(TRUE), t0, t1 * 0.4, order=9, tolerance=1e-5).ys["q"][0]
    np.testing.assert_allclose(angle, final_angle(TRUE), atol=2e-4)


def test_integer_and_static_arguments():
    def field(t, y, args):
        return args["sign"] * y * (2 if args["name"] == "double" else 1) + 0 * args["table"][1]

    args = {"sign": jnp.array(-1), "name": "double", "table": np.array([1, 2])}
    np.testing.assert_allclose(solve(field, jnp.array(1.0), args, t1=1.0).ys[0], np.exp(-2.0), rtol=1e-9)


# ---- where a series ends ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
def test_a_border_is_seen_and_stepped_up_to(tolerance):
    # q̈ = −sign-dependent spring: stiffness 4 where q > 0, 1 where q < 0, written with abs. From q = 0, v = 1 it is
    # ½ sin 2t up to π/2, then −sin(t − π/2): period 3π/2. Without the defect steps would go on along the wrong piece.
    spring = lambda t, y, args: (y[1], -(2.5 * y[0] + 1.5 * jnp.abs(y[0])))
    solution = solve(spring, (jnp.array(0.5), jnp.array(0.0)), t1=3 * np.pi, tolerance=tolerance)
    # A crossing may err by a few tolerances (the estimate takes a defect for one that grows as hᵖ); there are four.
    np.testing.assert_allclose([solution.ys[0][0], solution.ys[1][0]], [0.5, 0.0], atol=100 * tolerance)
    assert solution.stats["num_rejected_steps"] > 0


def test_a_field_without_a_series():
    for field, name in ((lambda t, y, args: jnp.sort(y), "sort"), (lambda t, y, args: jax.lax.lgamma(y), "lgamma")):
        with pytest.raises(ValueError, match=rf"`{name}`.*diffrax.Dopri8"):
            solve(field, jnp.array([1.0, 2.0]))


@pytest.mark.parametrize("order", [3, 21, 12.0, True, "high"])
def test_orders_that_are_not(order):
    with pytest.raises(ValueError, match="from 4 to 20"):
        Taylor(order)


# ---- one series for both forms, and a scene --------------------------------------------------------------------------


def test_first_and_second_order_recurrences_agree():
    # The same motion as q̈(q, q̇, t) and as ẏ = f(y, t): the sweep of the second closes over that of the first.
    x = jnp.zeros(())
    second = series(lower(lambda q, v, t: -jnp.sin(q) * v + t, x, x, x), 1, moving=3)
    first = series(lower(lambda q, v, t: (v, -jnp.sin(q) * v + t), x, x, x), 2, moving=3)
    assert (first.size, second.size, first.moving, second.moving) == (2, 1, 3, 3)
    assert first.products == second.products and first.rows == second.rows
    assert len(first.sweep.nodes) == len(second.sweep.nodes)


def test_the_vector_field_of_a_scene_conserves_energy():
    scene = lagjax.scenes.double_pendulum()
    start, params = (jax.tree.map(jnp.asarray, x) for x in ((scene.q0, scene.qdot0), scene.params))
    layout = Layout.of(*start)
    field = equations(scene.system.motion(layout, params), layout, params).vector_field
    end = solve(field, start, params, t1=3.0, order=9, tolerance=1e-9, adjoint=diffrax.ForwardMode()).ys
    energy = lambda q, v: scene.system.energy(q, v, params=params)
    after = energy(*jax.tree.map(lambda x: x[0], end))
    np.testing.assert_allclose(after, energy(*start), rtol=1e-7)
