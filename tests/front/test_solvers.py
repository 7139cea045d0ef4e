"""The wrappers around diffrax's solvers: the same steps, and states between them as good as at their ends."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweeps import sweep

import lagjax

TERM = diffrax.ODETerm(lambda t, y, args: (y[1], -args * y[0]))  # an oscillator, as a tuple of scalars
START = (np.array(1.0), np.array(0.5))
KINDS = [diffrax.Dopri8(), diffrax.Dopri5(), diffrax.Tsit5()]


def solve(solver, saveat, tolerance=1e-9, t1=6.0, y0=START, stiffness=1.0):
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    return diffrax.diffeqsolve(
        TERM, solver, 0.0, t1, None, y0, jnp.asarray(stiffness), saveat=saveat, stepsize_controller=controller
    )


def exact(ts):
    return np.cos(ts) + 0.5 * np.sin(ts)


@pytest.mark.parametrize("kind", sweep(KINDS, kept=KINDS[2:]), ids=lambda kind: type(kind).__name__)
def test_the_steps_are_those_of_the_solver(kind):
    # Fixed steps: adaptive ones may differ where a decision hangs on the last digit.
    plain, wrapped = (
        diffrax.diffeqsolve(TERM, s, 0.0, 6.0, 0.1, START, np.array(1.0)) for s in (kind, lagjax.FineOutput(kind))
    )
    np.testing.assert_allclose(wrapped.ys, plain.ys, rtol=1e-14)
    errors = []
    for solver in (kind, lagjax.FineOutput(kind)):
        state = solver.init(TERM, 0.0, 0.5, START, np.array(1.0))
        errors.append(solver.step(TERM, 0.0, 0.5, START, np.array(1.0), state, False)[1])
    np.testing.assert_allclose(*errors, atol=1e-15)  # a difference of numbers of order one


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-7, 1e-10, 1e-12])
def test_fine_output_between_steps(tolerance):
    # Local errors of the interpolant are about ten times those of a step; the error at the end of a step is a sum of
    # local ones that partly cancel.
    ts = np.linspace(0.0, 6.0, 200)
    worst = lambda solver: np.abs(solve(solver, diffrax.SaveAt(ts=ts), tolerance).ys[0] - exact(ts)).max()
    fine, plain = worst(lagjax.FineOutput(diffrax.Dopri8())), worst(diffrax.Dopri8())
    assert fine < 30 * tolerance and fine < plain / 4


@pytest.mark.slow
def test_interpolation_meets_the_ends_and_has_the_right_order():
    step = lambda h: diffrax.diffeqsolve(
        TERM, lagjax.FineOutput(diffrax.Dopri8()), 0.0, h, h, START, jnp.array(1.0), saveat=diffrax.SaveAt(dense=True)
    )
    inside = np.linspace(0.05, 0.95, 19)
    error = lambda h: max(abs(float(step(h).evaluate(x * h)[0]) - exact(x * h)) for x in inside)
    assert error(0.8) / error(0.4) > 0.7 * 2**7
    assert step(0.5).evaluate(0.0)[0] == START[0]
    at_end = solve(lagjax.FineOutput(diffrax.Dopri8()), diffrax.SaveAt(ts=np.array([0.0, 6.0]), t1=True))
    np.testing.assert_array_equal(at_end.ys[0][-1], at_end.ys[0][-2])


@pytest.mark.slow
def test_transformations():
    solver = lagjax.FineOutput(diffrax.Dopri8())
    ts = jnp.linspace(0.0, 3.0, 7)
    run = lambda k: solve(solver, diffrax.SaveAt(ts=ts), t1=3.0, stiffness=k).ys[0]
    reverse = jax.vmap(jax.grad(lambda k: run(k)[3]))(jnp.array([1.0, 2.0]))
    # q(t) = cos ωt + ½/ω sin ωt at t = 1.5, ω² = k.
    closed = jax.grad(lambda k: jnp.cos(jnp.sqrt(k) * 1.5) + 0.5 / jnp.sqrt(k) * jnp.sin(jnp.sqrt(k) * 1.5))
    np.testing.assert_allclose(reverse, jax.jit(jax.vmap(closed))(jnp.array([1.0, 2.0])), rtol=1e-6)
    start = tuple(jnp.float32(x) for x in START)
    single = diffrax.diffeqsolve(TERM, solver, *jnp.float32([0.0, 1.0, 0.1]), start, jnp.float32(1.0))
    assert single.ys[0].dtype == jnp.float32
    saveat = diffrax.SaveAt(ts=ts[::-1])
    backward = diffrax.diffeqsolve(TERM, solver, 3.0, 0.0, -0.1, START, jnp.array(1.0), saveat=saveat)
    np.testing.assert_allclose(backward.ys[0], exact(ts[::-1] - 3.0), atol=1e-9)


def test_only_what_they_are_for():
    for wrong in (diffrax.Kvaerno5(), diffrax.Dopri8, lagjax.FineOutput(diffrax.Dopri8())):
        with pytest.raises(TypeError, match="explicit"):
            lagjax.FineOutput(wrong)
    with pytest.raises(TypeError, match="FSAL"):
        lagjax.FineOutput(diffrax.Heun())


def test_results_have_the_numbers_of_diffrax():
    # The codes of stores that were written before stay what they were, and those of other versions go by their names.
    names = list(diffrax.RESULTS._name_to_item)
    assert names == list(lagjax.RESULTS._name_to_item)[: len(names)]
    for name in names:
        assert getattr(lagjax.RESULTS, name)._value == getattr(diffrax.RESULTS, name)._value
    with pytest.raises(ValueError, match="same type"):
        lagjax.RESULTS.successful == diffrax.RESULTS.successful  # noqa: B015
