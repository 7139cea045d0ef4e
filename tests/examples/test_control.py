"""The examples for control engineers: each does what it says, against SciPy's integrator and equations by hand."""

import importlib
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import numpy as np
import pytest
from scipy.integrate import solve_ivp

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
