"""How many effective draws of a posterior a CPU second: blackjax's No-U-Turn sampler along `Fit.log_density`.

Five fits: a damped pendulum, a driven one, dry friction near zero, the double pendulum of `benchmarks.fit` from four
starts, and a record of nine samples. The recipe is that of `docs/guide/recordings.md`: chains begin at draws of the
normal density of least squares, whose covariance is the metric; the step is fixed. The least effective number
of all unknowns counts, against the time of all processors for the draws, with compilation and without.

    python -m benchmarks.posterior

The record goes to `benchmarks/results/posterior.json`, with commit, versions and machine.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report, fit

STEP, SETTLING = 0.5, 50


def swing(q, qdot, params):
    """A pendulum of unit length."""
    return 0.5 * qdot**2 + params["w2"] * jnp.cos(q)


def drag(q, v, params):
    """Viscous friction."""
    return -params["c"] * v


def recorded(scene: lagjax.System, truth: dict, ts, sigma: float, start=(1.2, 0.0), inputs=None) -> lagjax.Record:
    """A record of q with white noise, from a start that is not known."""
    q = np.asarray(lagjax.simulate(scene, *start, ts, truth).q)
    return lagjax.Record(ts, q + sigma * np.random.default_rng(1).normal(size=q.shape), inputs)


def pendulum() -> Any:
    """Ten swings of a damped pendulum."""
    scene, ts = lagjax.System(swing, forces=drag), np.linspace(0.0, 10.0, 201)
    record = recorded(scene, {"w2": 9.0, "c": 0.2}, ts, 0.05)
    return lagjax.fit(scene, record, {"w2": 8.0, "c": 0.3}, transforms=lagjax.positive).log_density()


def driven() -> Any:
    """A pendulum whose drive was recorded."""
    ts = np.linspace(0.0, 10.0, 201)
    push = np.sin(2.3 * ts)
    scene = lagjax.System(swing, forces=lambda q, v, params, inputs: params["b"] * inputs - params["c"] * v)
    law = lagjax.System(
        swing, forces=lambda q, v, t, params: params["b"] * lagjax.samples(ts, push)(t) - params["c"] * v
    )
    record = recorded(law, {"w2": 9.0, "c": 0.2, "b": 1.0}, ts, 0.05, inputs=push)
    return lagjax.fit(scene, record, {"w2": 8.5, "c": 0.3, "b": 0.8}, transforms=lagjax.positive).log_density()


def dry_friction() -> Any:
    """A block on a spring, whose dry friction is smaller than what is known of it."""

    def forces(q, v, params):
        return -params["c"] * v - params["f"] * jnp.sign(v)

    scene = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params["w2"] * q**2, forces=forces)
    ts = np.linspace(0.0, 8.0, 161)
    record = recorded(scene, {"w2": 9.0, "c": 0.1, "f": 0.05}, ts, 0.03)
    free = lagjax.fit(scene, record, {"w2": 8.5, "c": 0.2, "f": 0.05})
    return free.log_density(lambda params: jnp.where((params["f"] > 0) & (params["c"] > 0), 0.0, -jnp.inf))


def double_pendulum() -> Any:
    """Five parameters, sixteen numbers of four starts, and two of noise."""
    records = fit.swings(4, np.linspace(0.0, 1.0, 201), np.random.default_rng(3), "white")
    first = {name: x * (1.1 if fit.KNOWN[name] else 1.0) for name, x in fit.TRUTH.items()}
    return lagjax.fit(fit.SCENE, records, first, free=fit.KNOWN, transforms=lagjax.positive).log_density()


def short() -> Any:
    """Half a swing in noise of a third of its amplitude, at nine instants."""
    ts = np.linspace(0.0, 2.0, 9)
    values = np.cos(2.0 * ts) + 0.3 * np.random.default_rng(4).normal(size=len(ts))
    scene = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
    return lagjax.fit(
        scene, lagjax.Record(ts, values, start=(1.0, 0.0)), {"k": 3.0}, transforms=lagjax.positive
    ).log_density()


FITS = (pendulum, driven, dry_friction, double_pendulum, short)


def chains_of(density, chains: int) -> tuple[Callable, np.ndarray]:
    """A function (keys (K,), starts (C, D)) → draws (K, C, D), compiled at its first call; and starts."""
    covariance = density.covariance()
    sampler = blackjax.nuts(density, STEP, covariance)

    @jax.jit
    def draw(keys, starts):
        def move(state, key):
            state, _ = jax.vmap(sampler.step)(jax.random.split(key, chains), state)
            return state, state.position

        return jax.lax.scan(move, jax.vmap(sampler.init)(starts), keys)[1]

    starts = np.random.default_rng(0).multivariate_normal(density.first, covariance, 20 * chains)
    return draw, starts[np.isfinite(jax.jit(jax.vmap(density))(starts))][:chains]  # a chain does not move elsewhere


def measure(make: Callable, draws: int, chains: int) -> dict:
    """One fit: what its draws are worth and cost."""
    density = make()
    began = time.process_time()
    draw, starts = chains_of(density, chains)
    np.asarray(draw(jax.random.split(jax.random.key(0), SETTLING + draws), starts))
    compiled = time.process_time()
    x = np.asarray(draw(jax.random.split(jax.random.key(1), SETTLING + draws), starts))
    spent, first = time.process_time() - compiled, compiled - began
    x = x[SETTLING:].swapaxes(0, 1)
    least, spread = float(blackjax.ess(x).min()), float(blackjax.rhat(x).max())
    return {
        "fit": make.__name__, "unknowns": len(density), "effective": least, "largest r-hat": spread,
        "CPU s first": first, "CPU s again": spent, "a CPU s": least / spent, "a CPU s first": least / first,
    }  # fmt: skip


def main():
    """All fits, and the record."""
    parser = argparse.ArgumentParser(description="Effective draws a CPU second.")
    parser.add_argument("--draws", type=int, default=250)
    parser.add_argument("--chains", type=int, default=8)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results", help="folder for the record")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = [measure(make, options.draws, options.chains) for make in FITS]
    for row in rows:
        print({name: x if isinstance(x, str) else round(x, 2) for name, x in row.items()})
    _report.write_json(options.output / "posterior.json", {"circumstances": _report.circumstances(), "fits": rows})


if __name__ == "__main__":
    main()
