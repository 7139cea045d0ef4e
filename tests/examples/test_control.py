"""The examples for control engineers: each does what it says, against SciPy's integrator and equations by hand."""

import importlib
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


def assert_main_draws(module, folder, capsys):
    """`main` prints one line and writes the picture of its name; what it returns."""
    returned = module.main([str(folder)])
    assert len(capsys.readouterr().out.splitlines()) == 1
    assert (folder / f"{module.__name__}.png").read_bytes().startswith(b"\x89PNG")
    return returned


def cart_pole(z, u):
    """The rates of a cart of 1 kg with a pole of 0.3 kg, 0.5 m: Kelly's equations 6.1 and 6.2."""
    m1, m2, length, g = 1.0, 0.3, 0.5, 9.81
    _, angle, speed, rate = z
    s, c = np.sin(angle), np.cos(angle)
    whole = m1 + m2 * (1 - c**2)
    push = length * m2 * s * rate**2 + u
    return [speed, rate, (push + m2 * g * c * s) / whole, -(push * c + (m1 + m2) * g * s) / (length * whole)]


def test_a_pole_swings_up_with_the_least_effort(example):
    swing_up = example("swing_up")
    point, _ = swing_up.swing_up()
    # CasADi with Ipopt, four steps of Runge and Kutta an interval: 59.130, whose digits end there.
    assert abs(0.04 * point.u @ point.u - 59.130) < 5e-4
    z = np.zeros(4)
    for u in point.u:
        z = solve_ivp(lambda _, z, u=u: cart_pole(z, u), (0.0, 0.04), z, method="DOP853", rtol=1e-12, atol=1e-12).y[
            :, -1
        ]
    # Steps of the search are good to 1e-9 of a state of size 10, fifty of them.
    np.testing.assert_allclose(z, [1.0, np.pi, 0.0, 0.0], atol=1e-8)
    assert np.abs(swing_up.replay(point.u) - swing_up.GOAL).max() < 1e-9


@pytest.mark.slow
def test_bounds_hold_and_cost_effort(example, tmp_path, capsys):
    swing_up = example("swing_up")
    free, missed = assert_main_draws(swing_up, tmp_path, capsys)
    assert missed < 1e-9
    bound, _ = swing_up.swing_up(strongest=10.0)
    assert 9.99 < np.abs(bound.u).max() <= 10.0 and bound.u @ bound.u > free.u @ free.u
    np.testing.assert_allclose(swing_up.replay(bound.u), swing_up.GOAL, atol=1e-8)
    finer, _ = swing_up.swing_up(intervals=100)  # each of whose forces may be one of the fifty, twice
    assert 0.02 * finer.u @ finer.u < 0.04 * free.u @ free.u


@pytest.mark.slow
def test_three_links_balance_on_a_cart(example):
    regulator = example("regulator")
    above, m, length, g = np.array([2.0, 1.0, 0.0]), 0.2, 0.5, 9.81  # rods above each
    mass, stiffness = np.zeros((2, 4, 4))  # of the angles, then the place
    later = np.maximum.outer(np.arange(3), np.arange(3))
    mass[:3, :3] = m * length**2 * (0.5 + above[later]) - m * length**2 / 6 * np.eye(3)
    mass[3, :3] = mass[:3, 3] = m * length * (0.5 + above)
    mass[3, 3], stiffness[:3, :3] = 1.0 + 3 * m, -m * g * length * np.diag(0.5 + above)
    np.testing.assert_allclose(regulator.model.A[4:, :4], -np.linalg.solve(mass, stiffness), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(regulator.model.B[4:, 0], np.linalg.solve(mass, [0.0, 0.0, 0.0, 1.0]), rtol=1e-12)
    K, small = regulator.gain(), 1e-6 * regulator.START["angles"]
    (q, qdot), forces = regulator.balance({"angles": small, "place": 0.0}, K)
    x = np.append(small, np.zeros(5))
    for k in range(50):  # the closed loop is linear up to cubes of angles; a run is good to 1e-9 of its size a step
        now = np.concatenate([q["angles"][k], [q["place"][k]], qdot["angles"][k], [qdot["place"][k]]])
        np.testing.assert_allclose(now, x, atol=1e-11)
        x = np.asarray(regulator.model.Phi @ x + regulator.model.Gamma[:, 0] * forces[k])
    (q, _), _ = regulator.balance(regulator.START, K)
    assert np.abs(q["angles"][-1]).max() < 1e-3 and np.abs(q["angles"]).max() < 0.5


def test_innovations_of_the_filter_are_what_it_says(example, monkeypatch):
    kalman_filter = example("kalman_filter")
    monkeypatch.setattr(kalman_filter, "STEPS", 40)
    _, states, estimates, covariances, distances = map(np.asarray, kalman_filter.filtered(50))
    low, high = chi2.ppf([0.001, 0.999], 2 * distances.size)
    assert low < distances.sum() < high
    errors = estimates - states
    normed = np.einsum("bti,btij,btj->bt", errors, np.linalg.inv(covariances), errors)
    low, high = chi2.ppf([0.001, 0.999], 4 * 50) / 50  # of one instant, whose members are independent
    assert low < normed[:, -1].mean() < high


@pytest.mark.slow
def test_a_plan_holds_the_pole_where_a_clipped_regulator_drops_it(example, monkeypatch):
    control = example("predictive_control")
    small = np.array([2e-4, -1e-4, 3e-4, 1e-4])
    # Without active bounds the plan is that of the regulator, whose cost it has, up to terms of third order.
    first = control.plan(small, control.plan(small, np.zeros(control.HORIZON)))[0]
    np.testing.assert_allclose(first, -control.GAIN @ small, rtol=1e-5)
    monkeypatch.setattr(control, "DURATION", 4.0)
    tilted = np.array([0.0, np.radians(25.0), 0.0, 0.0])
    states, forces = control.controlled(tilted)
    assert np.abs(states[-1]).max() < 0.02 and np.abs(states[:, 1]).max() < 0.45 and np.abs(forces).max() == 8.0
    dropped, _ = control.controlled(tilted, predictive=False)
    assert np.abs(dropped[:, 1]).max() > np.pi


@pytest.mark.slow
@pytest.mark.parametrize("name", ["regulator", "kalman_filter", "predictive_control"])
def test_the_whole_example_runs(example, name, tmp_path, capsys):
    assert_main_draws(example(name), tmp_path, capsys)
