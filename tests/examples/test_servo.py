"""The example of the servo: on recordings made here by small steps, and on the real ones where they are."""

import importlib
from pathlib import Path

import numpy as np
import pytest

TRUTH = {"pull": 0.9, "brake": 0.05, "armature": 2e-3, "offset": 0.02, "dry": 0.02}
MORE = {"motor": 0.2, "weight": 0.1, "sag": 0.3}
REAL = Path(__file__).parents[3] / "shared" / "data" / "servo_identification.npz"


@pytest.fixture(autouse=True)
def examples_on_path(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    monkeypatch.chdir(tmp_path)


def swing(goal, gain, mass, length, spacing=5e-3, parts=100):
    """Positions of a servo that follows held goals: steps of 50 µs, in each of which friction at most stops it."""
    duty_of, law, weight = importlib.import_module("servo").DUTY * gain, TRUTH | MORE, mass * 9.80665 * length
    inertia, h, q, v, positions = mass * length**2 + TRUTH["armature"], spacing / parts, 0.0, 0.0, []
    for aim in goal:
        positions.append(q)
        for _ in range(parts):
            duty, pull = np.clip(duty_of * (aim - q), -1, 1), -weight * np.sin(q + law["offset"])
            torque = law["pull"] * duty * (1 - law["sag"] * abs(duty)) - law["brake"] * v
            friction = law["dry"] + law["motor"] * abs(torque) + law["weight"] * abs(pull)
            free = v + h * (torque + pull) / inertia
            v = np.sign(free) * max(0.0, abs(free) - h * friction / inertia)
            q += h * v
    return np.array(positions)


def save(file, arms):
    """Recordings of arms (gain, kg, m), all with the same goals."""
    t, found = 5e-3 * np.arange(600), {}
    goal = 1.2 * np.sin(2.0 * t) + 0.5 * np.sin(5.0 * t)
    for k, (gain, mass, length) in enumerate(arms):
        names = "timestamp", "position", "goal_position", "torque_enable", "kp", "mass", "length"
        values = t + 3.0, swing(goal, gain, mass, length), goal, np.ones(len(t)), gain, mass, length
        found |= {f"{k}_{name}": np.asarray(value) for name, value in zip(names, values, strict=True)}
    np.savez(file, **found)


@pytest.mark.slow
def test_a_servo_is_fitted_and_followed_with_another_mass(capsys):
    save("one.npz", [(100.0, 0.5, 0.1), (400.0, 0.5, 0.1), (200.0, 0.3, 0.15)])
    save("other.npz", [(300.0, 0.4, 0.12)])
    fit, errors = importlib.import_module("servo").main(["one.npz", "--follow", "other.npz"])
    assert capsys.readouterr().out.splitlines()[-1].startswith("followed: 1 recordings, mean absolute error ")
    assert set(fit.selection.kept) == {"motor", "weight", "sag"}
    found = fit.params | fit.params["friction"] | fit.params["supply"]
    for key, value in (TRUTH | MORE).items():
        assert abs(found[key] - value) < 0.02 * abs(value) + 2e-4, (key, found[key])
    assert errors["followed"][0] < 0.5  # mrad: steps of 50 µs are as far from the exact motion
    assert {path.name for path in Path("out").iterdir()} == {"servo_fitted.png", "servo_followed.png"}


@pytest.mark.slow
@pytest.mark.skipif(not REAL.exists(), reason="the recordings of the servo are not here")
def test_the_real_servo_is_followed_by_its_goals(capsys):
    """A minute: friction is chosen among ten laws, each fitted to every half of the ten recordings."""
    _, errors = importlib.import_module("servo").main([str(REAL)])
    assert np.mean(errors["fitted"]) < 45  # the published laws: 74 to 86
