"""What a motion that did not reach its end does to a program of JAX: it raises, or is NaN; never a silent number."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPRING_K

import lagjax

TS = np.linspace(0.0, 50.0, 6)  # for which 20 steps are too few: those of Taylor series reach t = 16, those of Tsit5 3
ENGINES = {"machine code": {}, "diffrax": {"solver": diffrax.Tsit5(), "rtol": 1e-6}}
SENTENCE = r"could not be followed beyond t = [0-9.]+ of 50\. The budget of steps was spent"


def last(x, throw, **options):
    return lagjax.simulate(SPRING_K, x, 0.0, TS, 1.0, max_steps=20, throw=throw, **options).q[-1]


@pytest.fixture(params=["machine code", pytest.param("diffrax", marks=pytest.mark.slow)])
def options(request):
    return ENGINES[request.param]


@pytest.mark.parametrize("transform", [jax.grad, lambda f: jax.vmap(f), lambda f: jax.vmap(jax.grad(f))])
def test_a_failure_is_one_sentence_outside_of_jit(options, transform):
    x = 1.0 if transform is jax.grad else np.array([1.0, 2.0])
    with pytest.raises(lagjax.SimulationError, match=SENTENCE):
        transform(lambda x: last(x, True, **options))(x)


@pytest.mark.parametrize("transform", [lambda f: f, jax.grad, lambda f: jax.vmap(jax.grad(f))])
def test_a_failure_is_the_same_sentence_at_run_time_inside_jit(options, transform):
    x = jnp.array([1.0, 2.0]) if "vmap" in transform.__code__.co_names else 1.0
    with pytest.raises(RuntimeError, match=SENTENCE):
        jax.block_until_ready(jax.jit(transform(lambda x: last(x, True, **options)))(x))


@pytest.mark.slow
def test_diffrax_does_not_lose_a_failure_where_only_the_derivative_is_used():
    with pytest.raises(RuntimeError, match=SENTENCE):
        jax.block_until_ready(jax.jit(jax.grad(lambda x: last(x, True, **ENGINES["diffrax"])))(1.0))


def test_forward_mode_says_it_as_well():
    with pytest.raises(lagjax.SimulationError, match=SENTENCE):
        jax.jacfwd(lambda x: last(x, True))(1.0)


def test_a_batch_names_the_member_and_the_time():
    ends = np.array([1.0, 50.0, 60.0])

    def motion(x, end):
        return lagjax.simulate(SPRING_K, x, 0.0, jnp.stack([0.0, end]), 1.0, max_steps=20).q[-1]

    with pytest.raises(lagjax.SimulationError, match=r"member 1, the first of 2 that failed among 3,.* of 50\."):
        jax.vmap(motion)(np.ones(3), ends)
    nested = jax.vmap(jax.vmap(motion, in_axes=(0, None)), in_axes=(None, 0))
    with pytest.raises(lagjax.SimulationError, match=r"member \(1, 0\), the first of 6 that failed among 9,"):
        nested(np.ones(3), ends)


def test_the_derivative_of_what_was_not_reached_is_nan_and_never_zero(options):
    for mode in (jax.grad, lambda f: jax.jit(jax.grad(f)), lambda f: jax.vmap(jax.grad(f))):
        x = np.array([1.0, 2.0]) if mode not in (jax.grad,) and "vmap" in mode.__code__.co_names else 1.0
        assert np.isnan(mode(lambda x: last(x, False, **options))(x)).all()


def test_the_derivative_of_what_was_reached_stays_right():
    # q = x cos t: outputs at 0 and 10 are reached in 20 steps of the series, those at 20 and later are not.
    def reached(x, k):
        trajectory = lagjax.simulate(SPRING_K, x, 0.0, TS, k, max_steps=20, throw=False)
        return trajectory.q[1], trajectory.ok

    for mode in (jax.grad, jax.jacfwd):
        (by_x, by_k), ok = jax.jit(mode(reached, argnums=(0, 1), has_aux=True))(1.3, 1.0)
        assert not ok
        np.testing.assert_allclose(by_x, np.cos(10.0), rtol=1e-8)
        np.testing.assert_allclose(by_k, -1.3 * 5.0 * np.sin(10.0), rtol=1e-8)


def test_the_end_of_a_failed_motion_is_given_and_has_no_derivative(options):
    def end(x):
        return lagjax.simulate(SPRING_K, x, 0.0, TS, 1.0, max_steps=20, throw=False, **options).end.q

    assert np.isfinite(end(1.0)) and np.isnan(jax.grad(end)(1.0))


def test_members_that_fail_leave_the_derivatives_of_others_alone():
    ends = np.array([1.0, 50.0])
    f = lambda x, end: lagjax.simulate(SPRING_K, x, 0.0, jnp.stack([0.0, end]), 1.0, max_steps=20, throw=False).q[-1]
    found = jax.jit(jax.vmap(jax.grad(f)))(np.ones(2), ends)
    np.testing.assert_allclose(found[0], np.cos(1.0), rtol=1e-9)
    assert np.isnan(found[1])


@pytest.mark.parametrize("derived", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_nan_for_what_is_not_there_is_no_mistake_to_jax_debug_nans(derived):
    """Rows beyond the last crossing or transition, outputs after an event."""
    ts, turn = np.linspace(0.0, 5.0, 6), lagjax.Transition("a", "a", lambda q, v: v, direction=1)

    def crossed(x):
        return lagjax.crossings(SPRING_K, lambda q, v: q, x, 0.0, ts, 1.0, count=4)

    def turned(x):
        return lagjax.simulate(lagjax.Hybrid({"a": SPRING_K}, [turn], "a"), x, 0.0, ts, 1.0, max_transitions=3)

    with jax.debug_nans(True):
        run = lagjax.simulate(SPRING_K, 1.0, 0.0, ts, 1.0, event=lambda q, v: q)
        assert np.isnan(np.asarray(run.energy())[-1]) and np.isfinite(turned(1.0).energy()).all()
        assert int(crossed(1.0).count) == 2 and int(turned(1.0).transitions.count) == 1
        for transform in (jax.grad, jax.jacfwd, lambda f: jax.vmap(jax.grad(f)), jax.jit) if derived else ():
            x = np.ones(2) if transform.__name__ == "<lambda>" else 1.0
            np.testing.assert_allclose(transform(lambda x: turned(x).q[1])(x), np.cos(1.0), rtol=1e-8)
            np.testing.assert_allclose(transform(lambda x: x * crossed(x).t[0])(x), np.pi / 2, rtol=1e-8)
        with pytest.raises(FloatingPointError):
            jnp.log(jnp.asarray(-1.0))
