"""Lyapunov exponents: pairs, sums, closed forms, batches, and what cannot be followed."""

import numpy as np
import pytest
from scenes import DAMPED_OSCILLATOR, KEPLER

import lagjax
from lagjax import scenes

SADDLE = lagjax.System(lambda q, v: 0.5 * v @ v + 0.5 * (4.0 * q[0] ** 2 - q[1] ** 2))


def test_a_saddle_has_its_rates():
    # ẍ = 4x grows as e^(2t); the other coordinate oscillates.
    exponents = lagjax.lyapunov_spectrum(SADDLE, np.array([1e-3, 1.0]), np.zeros(2), 5.0)
    np.testing.assert_allclose(exponents, [2.0, 0.0, 0.0, -2.0], atol=0.3)  # log(norms)/5
    np.testing.assert_allclose(exponents + exponents[::-1], 0.0, atol=1e-11)


def test_friction_shrinks_all():
    exponents = lagjax.lyapunov_spectrum(DAMPED_OSCILLATOR, 1.0, 0.0, 20.0)
    np.testing.assert_allclose(exponents.sum(), -0.2, rtol=1e-10)  # −∂²D/∂q̇²


@pytest.mark.slow
def test_pairs_of_a_chaotic_double_pendulum():
    scene = scenes.double_pendulum()
    starts = np.array([[2.0, 2.5], [0.2, 0.3], [3.0, 1.0]])
    exponents = np.asarray(lagjax.lyapunov_spectrum(
        scene.system, starts, np.zeros((3, 2)), np.full(3, 100.0), scene.params
    ))  # fmt: skip
    # Round-off of arcs along which errors grow tenfold, added up over the arcs of a unit of time.
    assert np.abs(exponents + exponents[:, ::-1]).max() < 1e-10 and np.abs(exponents.sum(axis=1)).max() < 1e-10
    assert exponents[0, 0] > 1.0 and exponents[1, 0] < 0.1
    alone = lagjax.lyapunov_spectrum(scene.system, starts[1], np.zeros(2), 100.0, scene.params)
    np.testing.assert_allclose(alone, exponents[1], atol=1e-6)
    largest = lagjax.lyapunov_exponent(scene.system, starts, np.zeros((3, 2)), np.full(3, 100.0), scene.params)
    assert largest.ok.all() and np.all(np.abs(largest.value - exponents[:, 0]) < 4 * largest.error + 0.05)


@pytest.mark.slow
def test_what_cannot_be_followed():
    fall = KEPLER
    with pytest.raises(lagjax.SimulationError, match="could not be followed"):
        lagjax.lyapunov_spectrum(fall, np.array([1.0, 0.0]), np.zeros(2), 3.0)
    starts, pushes = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 1.0]])
    largest = lagjax.lyapunov_exponent(fall, starts, pushes, np.full(2, 3.0))
    assert largest.ok.tolist() == [False, True] and np.isnan(largest.value[0])
    spectra = lagjax.lyapunov_spectrum(fall, starts, pushes, np.full(2, 3.0))
    assert np.isnan(spectra[0]).all() and np.isfinite(spectra[1]).all()
