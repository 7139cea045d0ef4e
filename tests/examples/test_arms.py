"""The example of a pendulum of n arms on files of other machines of the laboratory, made here."""

import importlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    return importlib.import_module("double_pendulum_fit")


@pytest.mark.slow
def test_a_single_pendulum_with_gaps_windings_and_few_segments(example, tmp_path):
    rng, ts, segments = np.random.default_rng(0), 0.01 * np.arange(300), 4
    truth = example.first_guess(1, ("viscous",)) | {"inertia": np.array([0.0119])}
    q0 = np.pi + np.linspace(-1.2, 1.2, segments)[:, None]
    motion = lagjax.simulate_batch(example.SCENE, q0, np.zeros((segments, 1)), jnp.asarray(ts), truth)
    angles = np.asarray(motion.q) + 2e-3 * rng.normal(size=(segments, len(ts), 1))
    angles += 2 * np.pi * np.array([0, -1, 2, 0])[:, None, None]
    angles[2] = np.mod(angles[2], 2 * np.pi)
    signals = np.concatenate([angles, np.asarray(motion.qdot)], axis=2).swapaxes(1, 2)
    signals[0, :, 40:90] = signals[1, :, 250:] = signals[3, :, :5] = np.nan  # a gap, a shorter one, a later one
    np.savez(tmp_path / "one.npz", Y_id=np.append(signals, np.full((1, 2, len(ts)), np.nan), axis=0), dt=0.01)
    fits, errors = example.main([str(tmp_path / "one.npz"), "--law", "viscous"])
    low, high = fits["viscous"].intervals(0.999)
    for name in ("inertia", "viscous"):
        assert low[name] <= truth[name] <= high[name]
    # Noise of 2 mrad; a start read off the first 0.1 s is off by a few of these.
    assert errors.shape == (2, 1) and (errors < 15).all(), errors


def test_angles_lose_the_jumps_of_a_circle_and_keep_their_gaps(example):
    steady = np.linspace(0.0, 20.0, 101)
    wrapped = np.mod(steady, 2 * np.pi)
    wrapped[30] = np.nan
    after = example.unwound(wrapped)
    assert np.isnan(after[30]) and np.nanmax(np.abs(after - steady)) < 1e-12
    turned = np.where(np.arange(101) < 50, 0.0, 10.0)  # wound already: what a gap hides is not undone
    assert (example.unwound(turned) == turned).all()
