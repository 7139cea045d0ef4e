"""Derivatives over the steps of diffrax: refused where a motion crosses a jump of the acceleration, right elsewhere."""

import diffrax
import jax
import jax.numpy as jnp
import lagrangians
import numpy as np
import pytest
from scenes import OSCILLATOR, particle

import lagjax

TS = np.array([0.0, 1.0, 3.0])
PARAMS = {"a": 0.7, "t": 1.3}
HEUN = {"solver": diffrax.Heun(), "dt": 0.01}


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


# Forces beside −q, and whether the acceleration jumps on the way, at a place that moves with the state.
FORCES = {
    "a step of the place": (lambda q, v, t, p: -p["a"] * jnp.where(q > 0.5, 1.0, 0.2), True),
    "dry friction": (lambda q, v, t, p: -0.2 * p["a"] * jnp.sign(v), True),
    "a table of steps": (
        lambda q, v, t, p: p["a"] * jnp.array([0.3, -0.5])[jnp.digitize(q, jnp.array([0.0, 0.5])) - 1], True,
    ),
    "a moving wall": (lambda q, v, t, p: -p["a"] * jnp.where(q > 0.4 + 0.3 * t, 1.0, 0.0), True),
    "a switch at a time that is differentiated": (lambda q, v, t, p: p["a"] * jnp.where(t > p["t"], 1.0, 0.0), True),
    "a switch at a known time": (lambda q, v, t, p: p["a"] * jnp.where(t > 1.3, 1.0, 0.0), False),
    "a corner": (lambda q, v, t, p: -p["a"] * jax.nn.relu(q - 0.5), False),
    "a saturation": (lambda q, v, t, p: -p["a"] * jnp.clip(q, -0.3, 0.3), False),
    "a border that is not met": (lambda q, v, t, p: -p["a"] * jnp.where(q > 5.0, 1.0, 0.2), False),
    "what is steep and smooth": (lambda q, v, t, p: -p["a"] * jnp.tanh(v / 0.01), False),
}  # fmt: skip


def scene(name):
    force = FORCES[name][0]
    return lagjax.System(lagrangians.free_particle, forces=lambda q, qdot, t, params: force(q, qdot, t, params) - q)


def end(system, params, **options):
    return lagjax.simulate(system, 0.3, 1.0, TS, params, **options).q[-1]


@pytest.mark.slow
@pytest.mark.parametrize("name", FORCES)
def test_derivatives_over_steps_are_right_or_refused(name):
    """Beside those of machine code, which ends a step at every border.

    A step of size h that goes across a corner leaves O(h²) in a derivative, as Heun's method does elsewhere; one across
    a switch at a known time leaves O(h).
    """
    system, lost = scene(name), FORCES[name][1]
    value, slopes = jax.value_and_grad(lambda p: end(system, p))(PARAMS)
    if lost:
        with pytest.raises(lagjax.SimulationError, match=r"has no derivatives here\. The acceleration jumps"):
            jax.grad(lambda p: end(system, p, **HEUN))(PARAMS)
        by_force = jax.value_and_grad(lambda a: end(system, PARAMS | {"a": a}, throw=False, **HEUN))
        followed, by_a = by_force(0.7)
        assert np.isnan(by_a) != ("differentiated" in name)  # by the force alone it is right
    else:
        followed, found = jax.value_and_grad(lambda p: end(system, p, **HEUN))(PARAMS)
        for of in PARAMS:
            np.testing.assert_allclose(found[of], slopes[of], atol=2e-3 if "corner" in name else 1e-2)
    np.testing.assert_allclose(followed, value, atol=0.02)  # the motion itself


@pytest.mark.slow
def test_the_default_solver_and_other_adjoints_lose_them_too():
    """In forward mode, with an event, and under vmap over members of which one does not come to the border."""
    system = scene("a step of the place")
    with pytest.raises(lagjax.SimulationError, match="has no derivatives here"):
        jax.grad(lambda p: end(system, p, solver=diffrax.Dopri8()))(PARAMS)
    forward = {**HEUN, "adjoint": diffrax.ForwardMode()}
    assert np.isnan(jax.jvp(lambda a: end(system, PARAMS | {"a": a}, **forward), (0.7,), (1.0,))[1])
    event = {**HEUN, "event": lambda q, qdot: q + 9.0}
    assert np.isnan(jax.grad(lambda a: end(system, PARAMS | {"a": a}, **event))(0.7))

    def last(v):
        return lagjax.simulate(system, 0.3, v, TS, PARAMS, throw=False, **HEUN).q[-1]

    slopes = jax.jit(jax.vmap(jax.grad(last)))(jnp.array([0.1, 1.0]))
    np.testing.assert_array_equal(np.isnan(slopes), [False, True])
    exact = jax.grad(lambda v: lagjax.simulate(system, 0.3, v, TS, PARAMS).q[-1])(0.1)
    np.testing.assert_allclose(slopes[0], exact, atol=1e-4)


def test_a_guard_that_only_jumps_varies_as_its_border_does():
    """In machine code: a guard that is flat on both sides says not how it moves, but what decides about it does."""
    oscillator = OSCILLATOR

    def time(p):
        flat = lambda q, v, params: jnp.where(q < params, 1.0, -1.0)
        return lagjax.crossings(oscillator, flat, 1.0, 0.0, (0.0, 3.0), p, count=1).t[0]

    np.testing.assert_allclose(time(0.5), np.arccos(0.5), rtol=1e-9)
    for slope in (jax.grad(time)(0.5), jax.jvp(time, (0.5,), (1.0,))[1]):
        np.testing.assert_allclose(slope, -1.0 / np.sqrt(0.75), rtol=1e-9)


def test_only_what_decides_is_searched_for_jumps():
    """A bracket about a jump is halved thirty times; an elimination, which compares pivots, does not jump."""

    def searches(force):
        system = particle(lambda q, qdot: force(q) - q, path="array")
        run = lambda v: lagjax.simulate(system, 0.3, v, TS, **HEUN).q[-1]
        return "length=30" in str(jax.make_jaxpr(lambda v: jax.vjp(run, v)[0])(1.0))

    assert searches(lambda q: jnp.where(q > 0.5, 1.0, 0.0)) and not searches(jnp.sin)
