"""Poincaré sections and return maps as figures: every crossing is a point, and what has none says so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
import lagjax.plot

OSCILLATOR = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * (q[0] ** 2 + 2.0 * q[1] ** 2))


@pytest.mark.slow
def test_a_section_is_an_ellipse():
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    amplitudes = np.array([0.5, 1.0])

    def section(a):
        start = jnp.array([0.0, a]), jnp.array([1.0, 0.0])
        return lagjax.crossings(OSCILLATOR, lambda q, v: q[0], *start, jnp.array([0.0, 40.0]), direction=1, count=16)

    found = jax.vmap(section)(amplitudes)
    ax = lagjax.plot.poincare(found, lambda q, v: (q[1], v[1]))
    points = np.asarray(ax.collections[0].get_offsets())
    assert len(points) == int(found.count.sum()) == 12
    np.testing.assert_allclose(points[:, 0] ** 2 + points[:, 1] ** 2 / 2, np.repeat(amplitudes**2, 6), rtol=1e-7)
    pairs = np.asarray(lagjax.plot.return_map(found, lambda q, v: q[1]).collections[0].get_offsets())
    assert len(pairs) == 10  # of each member one less than its crossings
    np.testing.assert_allclose(pairs[0], [0.5 * np.cos(np.sqrt(2) * 2 * np.pi * k) for k in (1, 2)], atol=1e-8)
    never = lagjax.crossings(OSCILLATOR, lambda q, v: q[0] - 5.0, np.zeros(2), np.ones(2), np.array([0.0, 9.0]))
    with pytest.raises(ValueError, match="never crossed"):
        lagjax.plot.poincare(never, lambda q, v: (q[1], v[1]))
