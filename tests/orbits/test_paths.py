"""Paths between two configurations: a simulated arc comes out again, actions in closed form, conjugate times."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OSCILLATOR, OSCILLATORS

import lagjax
from lagjax import scenes


def test_the_oscillator_and_its_conjugate_point():
    t = 5.0  # the period is 2π: one conjugate point at π, half of it
    path = lagjax.find_path(OSCILLATOR, 1.0, 0.5, 0.0, t)
    s, c = np.sin(t), np.cos(t)
    np.testing.assert_allclose(path.qdot_start, (0.5 - c) / s, rtol=1e-12)
    np.testing.assert_allclose(path.action, ((1 + 0.25) * c - 2 * 0.5) / (2 * s), rtol=1e-12)
    np.testing.assert_allclose(path.conjugate_times, [np.pi], rtol=1e-10)
    assert path.ok and path.index == 1 and not path.minimum
    early = lagjax.find_path(OSCILLATOR, 1.0, 0.5, 0.0, 3.0)
    assert early.minimum and early.index == 0


@pytest.mark.slow
def test_conjugate_points_count_as_often_as_they_are():
    path = lagjax.find_path(OSCILLATORS, np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.0, 8.0)
    np.testing.assert_allclose(path.conjugate_times, 1.0 + np.pi * np.array([1, 1, 2, 2]), rtol=1e-7)
    assert path.index == 4


@pytest.mark.slow
def test_a_simulated_arc_comes_out_again():
    scene = scenes.double_pendulum()
    ts = np.linspace(0.0, 0.7, 8)
    run = lagjax.simulate(scene.system, np.array([1.0, 1.5]), np.array([0.5, -0.3]), ts, scene.params, rtol=1e-14)
    path = lagjax.find_path(scene.system, run.q[0], run.q[-1], 0.0, 0.7, scene.params)
    np.testing.assert_allclose(path.qdot_start, run.qdot[0], atol=1e-9)
    np.testing.assert_allclose(path.qdot_end, run.qdot[-1], atol=1e-9)
    np.testing.assert_allclose(path.action, lagjax.action(scene.system, run), rtol=1e-11)


def test_action_of_any_path():
    np.testing.assert_allclose(lagjax.action(OSCILLATOR, jnp.cos, 0.0, 1.0), -np.sin(2.0) / 4, rtol=1e-13)
    with pytest.raises(ValueError, match="not resolved"):
        lagjax.action(OSCILLATOR, lambda t: jnp.maximum(t - 0.3141, 0.0), 0.0, 1.0)


def test_no_path_between_the_ends():
    # After half a period every motion of the oscillator is at minus its start.
    with pytest.raises(lagjax.SimulationError, match="No path was found"):
        lagjax.find_path(OSCILLATOR, 1.0, 1.0, 0.0, np.pi)
    with pytest.raises(ValueError, match="t_end must be later"):
        lagjax.find_path(OSCILLATOR, 1.0, 1.0, 1.0, 0.0)
