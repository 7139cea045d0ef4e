"""Derivatives of motions in machine code: of every order, in every order of modes, against closed forms."""

import itertools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import weight, weight_g
from scenes import BALL_IN_GRAVITY, PENDULUM_G
from sweeps import sweep

import lagjax
from lagjax import scenes

SPRING = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2 - 0.1 * params["c"] * q)
PENDULUM = lagjax.System(lambda q, v: 0.5 * v**2 + 9.81 * jnp.cos(q))
HUNDRED_STIFFNESSES = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * jnp.mean(params) * q**2)
CIRCLE_G = lagjax.System(weight_g, constraints=lambda q: jnp.sum(q**2) - 1.0)
CIRCLE = lagjax.System(weight, constraints=lambda q: q @ q - 1.0)
X = np.array([1.0, 0.3, 2.3, 0.7, 0.1])  # q, q̇, k, c and the time of the start
TIMES = np.array([0.4, 1.0, 2.1])
MODES = {"forward": jax.jacfwd, "reverse": jax.jacrev}


def followed(x, times=TIMES):
    ts = jnp.concatenate([x[4:], times])
    trajectory = lagjax.simulate(SPRING, x[0], x[1], ts, {"k": x[2], "c": x[3]}, rtol=1e-12)
    return jnp.concatenate([trajectory.q[1:], trajectory.end.qdot[None]])


def exact(x, times=TIMES):
    """q and the last q̇ of an oscillator about −c/10k."""
    w, rest = jnp.sqrt(x[2]), -0.1 * x[3] / x[2]

    def at(s):
        return rest + (x[0] - rest) * jnp.cos(w * s) + x[1] * jnp.sin(w * s) / w

    s = times - x[4]
    return jnp.concatenate([at(s), jax.grad(at)(s[-1])[None]])


def loss(function):
    return lambda x: jnp.sum(function(x) ** 3)


@pytest.mark.parametrize("mode", sweep(MODES, kept=["reverse"]))
def test_first_derivatives_by_the_state_parameters_and_times(mode):
    right = jax.jit(jax.jacfwd(exact, argnums=(0, 1)))(X, TIMES)
    np.testing.assert_allclose(jax.jit(MODES[mode](followed))(X), right[0], atol=1e-11)
    np.testing.assert_allclose(jax.jit(MODES[mode](followed, argnums=1))(X, TIMES), right[1], atol=1e-11)


@pytest.mark.slow  # by default, a hessian on a constraint, and `test_simulate` of a free motion
@pytest.mark.parametrize("outer, inner", list(itertools.product(MODES, MODES)))
def test_second_derivatives_in_every_order_of_modes(outer, inner):
    found = jax.jit(MODES[outer](MODES[inner](loss(followed))))(X)
    np.testing.assert_allclose(found, jax.jit(jax.hessian(loss(exact)))(X), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_of_all_outputs_and_of_output_times():
    for outer, inner in itertools.product(MODES.values(), MODES.values()):
        found = jax.jit(outer(inner(followed, argnums=(0, 1)), argnums=(0, 1)))(X, TIMES)
        expected = jax.jit(jax.jacfwd(jax.jacfwd(exact, argnums=(0, 1)), argnums=(0, 1)))(X, TIMES)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-10)


@pytest.mark.slow  # every mode follows every other one, and itself
@pytest.mark.parametrize("modes", [(a, b, a) for a, b in itertools.product(MODES, MODES)])
def test_third_derivatives(modes):
    found, expected = loss(followed), loss(exact)
    for mode in modes:
        found, expected = MODES[mode](found), jax.jacfwd(expected)
    np.testing.assert_allclose(jax.jit(found)(X), expected(X), rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_batches_of_second_derivatives_are_those_of_their_members():
    batch = X + 0.1 * np.arange(3)[:, None]
    found = jax.jit(jax.vmap(jax.hessian(loss(followed))))(batch)
    np.testing.assert_allclose(found, jax.vmap(jax.hessian(loss(exact)))(batch), rtol=1e-9, atol=1e-9)


def test_a_hundred_parameters():
    # A row of springs side by side: only their sum is felt, so that every derivative is the same for each.
    value = lambda p: lagjax.simulate(HUNDRED_STIFFNESSES, 1.0, 0.0, jnp.array([0.0, 2.0]), p, rtol=1e-11).q[-1]
    of_mean = lambda k: jnp.cos(2.0 * jnp.sqrt(k))
    p, direction = np.full(100, 1.7), np.sin(np.arange(100.0))
    np.testing.assert_allclose(jax.jit(jax.grad(value))(p), jax.grad(of_mean)(1.7) / 100, rtol=1e-9)
    along = jax.jit(lambda p, d: jax.jvp(jax.grad(value), (p,), (d,))[1])(p, direction)
    np.testing.assert_allclose(along, jax.grad(jax.grad(of_mean))(1.7) * np.mean(direction) / 100, rtol=1e-8)


@pytest.mark.slow
def test_second_derivatives_on_a_constraint_are_those_of_the_angle():
    # By gravity and speed: a family of starts that stay on the circle.
    pendulum = PENDULUM_G
    ts = np.linspace(0, 1.5, 4)

    def on_circle(x):
        start = jnp.array([0.0, -1.0]), x[1] * jnp.array([1.0, 0.0])
        return jnp.sum(lagjax.simulate(CIRCLE_G, *start, ts, x[0], rtol=1e-11).q ** 3)

    def by_angle(x):
        angle = lagjax.simulate(pendulum, 0.0, x[1], ts, x[0], rtol=1e-11).q
        return jnp.sum(jnp.stack([jnp.sin(angle), -jnp.cos(angle)]) ** 3)

    x = np.array([9.81, 1.3])
    np.testing.assert_allclose(jax.jit(jax.hessian(on_circle))(x), jax.hessian(by_angle)(x), atol=1e-9)


@pytest.mark.slow
def test_second_and_third_derivatives_by_a_start_that_moves_along_a_curved_constraint():
    ts = np.array([0.0, 1.3, 2.0])

    def on_circle(angle):
        start = jnp.array([jnp.sin(angle), -jnp.cos(angle)])
        return jnp.sum(lagjax.simulate(CIRCLE, start, jnp.zeros(2), ts, rtol=1e-11).q ** 3)

    def by_angle(angle):
        angles = lagjax.simulate(PENDULUM, angle, 0.0, ts, rtol=1e-11).q
        return jnp.sum(jnp.stack([jnp.sin(angles), -jnp.cos(angles)]) ** 3)

    exact = jax.grad(jax.grad(by_angle))(0.65)
    for inner in (jax.grad, jax.jacfwd):
        for outer in (jax.grad, jax.jacfwd):
            np.testing.assert_allclose(jax.jit(outer(inner(on_circle)))(0.65), exact, rtol=1e-8)
    third = jax.jacfwd(jax.grad(jax.grad(by_angle)))(0.65)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.jacfwd(jax.grad(on_circle))))(0.65), third, rtol=1e-7)


@pytest.mark.slow
def test_second_derivatives_of_the_cartesian_double_pendulum_are_those_of_its_angles():
    cartesian, angles = scenes.cartesian_double_pendulum(), scenes.double_pendulum()
    ts, start = np.linspace(0, 0.7, 4), np.array([1.0, 1.2])

    def places(angle, l):
        return jnp.cumsum(l[:, None] * jnp.stack([jnp.sin(angle), -jnp.cos(angle)], axis=1), axis=0)

    def by_places(x):
        params = {"m": x[3:], "l": x[:2], "g": x[2]}
        q0 = places(start, x[:2])
        return jnp.sum(lagjax.simulate(cartesian.system, q0, 0 * q0, ts, params, rtol=1e-11).q ** 3)

    def by_angles(x):
        params = dict(zip(("l1", "l2", "g", "m1", "m2"), x, strict=True))
        q0 = (
            jax.tree.unflatten(jax.tree.structure(angles.q0), list(start)) if not hasattr(angles.q0, "shape") else start
        )
        q = lagjax.simulate(angles.system, q0, jax.tree.map(jnp.zeros_like, q0), ts, params, rtol=1e-11).q
        flat = jnp.stack(jax.tree.leaves(q), axis=1) if not hasattr(q, "shape") else q
        return jnp.sum(jax.vmap(lambda angle: places(angle, x[:2]))(flat) ** 3)

    x = np.array([1.0, 0.9, 9.81, 1.2, 0.8])
    np.testing.assert_allclose(jax.jit(jax.hessian(by_places))(x), jax.jit(jax.hessian(by_angles))(x), atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_through_a_bounce():
    # By the height, g, the restitution and the speed, of what comes after the first bounce.
    ball = BALL_IN_GRAVITY
    bounce = lagjax.Transition(
        "flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v, params: (q, -params["e"] * v)
    )
    ts = np.array([0.0, 0.3, 0.8, 1.0])

    def run(x):
        params = {"g": x[1], "e": x[2]}
        found = lagjax.simulate(
            lagjax.Hybrid({"flight": ball}, [bounce], "flight"), x[0], x[3], ts, params, max_transitions=2
        )
        return jnp.sum(jnp.append(found.q, found.transitions.t[0]) ** 3)

    def closed(x):
        h, g, e, v = x
        touch = (v + jnp.sqrt(v * v + 2 * g * h)) / g
        s, up = ts - touch, e * (g * touch - v)
        q = jnp.where(s < 0, h + v * ts - 0.5 * g * ts**2, up * s - 0.5 * g * s**2)
        return jnp.sum(jnp.append(q, touch) ** 3)

    x = np.array([1.0, 9.81, 0.8, 0.1])
    np.testing.assert_allclose(jax.jit(jax.grad(run))(x), jax.jit(jax.grad(closed))(x), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.hessian(run))(x), jax.jit(jax.hessian(closed))(x), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("derivative", [lambda f: f, jax.jacfwd, jax.jacrev])
def test_machine_code_of_a_cpu_is_not_exported(derivative):  # lowers without compiling
    with pytest.raises(ValueError, match=r"jax\.export cannot take a motion in a CPU's .* solver of diffrax"):
        jax.export.export(jax.jit(derivative(followed)))(X)


@pytest.mark.slow
@pytest.mark.parametrize("on_error", ["raise", "nan"])
def test_the_recipe_for_exports_is_one_whole(on_error):
    """With two of its three parts it says again what they are, and with all of them a motion is exported."""
    code = """
import diffrax, jax, jax.numpy as jnp, lagjax
jax.config.update("jax_enable_x64", True)
spring, ts = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2), jnp.array([0.0, 1.0])
run = lambda q, throw: lagjax.simulate(spring, q, 0.0, ts, solver=diffrax.Dopri8(), throw=throw).q[-1]
for throw in (True, False):
    for function in (run, jax.grad(run)):
        try:
            exported = jax.export.export(jax.jit(lambda q: function(q, throw)))(1.0)
            print("right" if abs(exported.call(1.0) - jnp.cos(1.0)) < 1e-8 else "wrong")
        except ValueError as why:
            print("told" if "throw=False), and set EQX_ON_ERROR=nan" in str(why) else "raw")
"""
    environment = os.environ | {"EQX_ON_ERROR": on_error}
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["told", "told", *(["told"] * 2 if on_error == "raise" else ["right"] * 2)]
