"""A potential that nobody knows, learned as a network from trajectories: a bead on a wire with bumps.

L = ½ q̇² − V(q), where V is a small network among the parameters, and friction c that is fitted beside it. What is
learned is a potential and no table of forces: energy is conserved but for friction, and motions that were not seen
follow. A constant of V moves nothing, and the fit says so.

python examples/learned_potential.py out/
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lagjax

SIGMA, FRICTION = 0.01, 0.05
TS = np.linspace(0.0, 4.0, 81)
RECORDS, HELD_OUT = 12, 3
FIRST = 1.0  # from which the start of the motion in the picture is found


def bumps(q):
    """The potential that made the recordings."""
    return 0.25 * q**4 - q**2 + 0.3 * jnp.sin(3 * q)


TRUE = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - bumps(q), dissipation=lambda q, qdot: 0.5 * FRICTION * qdot**2)
LEARNED = lagjax.System(
    lambda q, qdot, params: 0.5 * qdot**2 - params["V"](q),
    dissipation=lambda q, qdot, params: 0.5 * params["c"] * qdot**2,
)


def recordings(seed=0):
    """Noisy positions from starts in both wells, and the starts."""
    rng = np.random.default_rng(seed)
    q0, qdot0 = rng.uniform(-2.2, 2.2, RECORDS), rng.normal(size=RECORDS)
    exact = np.asarray(lagjax.simulate_batch(TRUE, q0, qdot0, TS).q)
    return exact + SIGMA * rng.normal(size=exact.shape), exact, list(zip(q0, qdot0, strict=True))


def learned(values, width=12, **more):
    """The fit of a network to recordings without their starts."""
    network = eqx.nn.MLP("scalar", "scalar", width, 2, activation=jnp.tanh, key=jax.random.key(0))
    records = [lagjax.Record(TS, y) for y in values]
    transforms = {"V": None, "c": lagjax.positive}
    return lagjax.fit(LEARNED, records, {"V": network, "c": 0.02}, transforms=transforms, method="gradient", **more)


def held_out_errors(fit, exact, starts):
    """Root mean square errors of motions that no fit saw, from their true starts."""
    pairs = zip(exact, starts, strict=True)
    predicted = [(fit.predict(lagjax.Record(TS, y, start=start)).values, y) for y, start in pairs]
    return [float(np.sqrt(np.mean((prediction - y) ** 2))) for prediction, y in predicted]


def picture(fit, values, held, file):
    """The learned potential over the true one, where the recordings were; and a motion that was held out."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    q = np.linspace(values.min(), values.max(), 201)
    true, network = np.asarray(bumps(q)), np.asarray(jax.vmap(fit.params["V"])(q))
    network = network - np.mean(network - true)
    left.plot(q, true, color="0.6", linewidth=4, label="true")
    left.plot(q, network, color="#0072B2", label="learned, less a constant")
    left.set(xlabel="q", ylabel="V")
    left.legend(frameon=False)
    prediction = fit.predict(lagjax.Record(TS, np.where(TS < FIRST, held, np.nan)))
    right.axvline(FIRST, color="0.7", linewidth=1)
    right.plot(TS, held, ".", color="0.4", label="held out; its start is from the left of the line")
    right.plot(TS, prediction.values, color="#0072B2", label="predicted")
    right.set(xlabel="t", ylabel="q")
    right.legend(frameon=False)
    figure.savefig(file, dpi=110)
    return float(np.std(network - true) / np.ptp(true))


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=Path("out"), help="folder for the picture")
    parser.add_argument("--progress", action="store_true", help="print how the search goes")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    values, exact, starts = recordings()
    seen = slice(0, RECORDS - HELD_OUT)
    fit = learned(values[seen], progress=options.progress)
    print(fit)
    errors = held_out_errors(fit, exact[-HELD_OUT:], starts[-HELD_OUT:])
    print(f"\nfriction {float(fit.params['c']):.4f} (true {FRICTION})")
    print(f"held-out motions: {', '.join(f'{1e3 * e:.1f}' for e in errors)} mm RMS; the noise was {1e3 * SIGMA:g}")
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "learned_potential.png"
    error = picture(fit, values[seen], values[-1], file)
    print(f"the potential is off by {100 * error:.2g} % of its range; {file}")
    return fit, errors, error


if __name__ == "__main__":
    main()
