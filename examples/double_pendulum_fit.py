"""A real double pendulum: its parameters from recordings, the law of its friction by evidence, and what comes next.

The file holds `Y_id` (segments, 4, samples), of which the first two signals are the angles from the upright, and their
spacing `dt` in seconds: free swings of a physical double pendulum, which Kaheman, Fasel, Bramburger, Strom, Kutz and
Brunton published with "The Experimental Multi-Arm Pendulum on a Cart" (HardwareX 2023, arXiv:2205.06231, MIT licence).

python examples/double_pendulum_fit.py kaheman2022_double_pendulum_identification.npz
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

HELD_OUT = 6  # segments at the end, which no fit sees
EVERY = 4  # of the samples at 1 kHz of arms that swing at 3 Hz: their residuals are correlated over a hundred
FIRST = 0.1  # seconds from which the start of a held-out segment is found
SMOOTH = 0.1  # rad/s over which dry friction changes its sign

# Only ratios of energies are seen: all are in units of the coupling m2 L1 a2, as `explain`s of the two arms would be.
START = {"arm 1": 2.0, "arm 2": 1.1, "gravity 1": 120.0, "gravity 2": 57.0}
LAWS = {
    "viscous": {"viscous": [0.08, 0.01], "dry": [0.0, 0.0], "air": 0.0},
    "dry": {"viscous": [0.0, 0.0], "dry": [0.2, 0.05], "air": 0.0},
    "viscous and dry": {"viscous": [0.05, 0.0], "dry": [0.1, 0.05], "air": 0.0},
    "dry, and air on the second arm": {"viscous": [0.0, 0.0], "dry": [0.2, 0.05], "air": 0.005},
}


def lagrangian(q, qdot, params):
    """Both arms as rigid bodies, in units of their coupling."""
    (th1, th2), (w1, w2) = q, qdot
    kinetic = 0.5 * params["arm 1"] * w1**2 + 0.5 * params["arm 2"] * w2**2 + jnp.cos(th1 - th2) * w1 * w2
    return kinetic - params["gravity 1"] * jnp.cos(th1) - params["gravity 2"] * jnp.cos(th2)


def friction(q, qdot, params):
    """Torques of the two bearings, of which the second is between the arms, and of the air on the second arm."""
    rates = jnp.array([qdot[0], qdot[1] - qdot[0]])
    first, second = -jnp.array(params["viscous"]) * rates - jnp.array(params["dry"]) * jnp.tanh(rates / SMOOTH)
    return jnp.array([first - second, second - params["air"] * qdot[1] * jnp.abs(qdot[1])])


SCENE = lagjax.System(lagrangian, forces=friction)


def recordings(file):
    """The angles of every segment."""
    with np.load(file) as data:
        angles, dt = np.moveaxis(data["Y_id"][:, :2], 1, 2), float(data["dt"])
    ts = dt * np.arange(angles.shape[1])
    return [lagjax.Record(ts, values) for values in angles]


def fit_law(records, law):
    """The fit of one law of friction; a coefficient that begins at zero stays there."""
    params = START | law
    free = jax.tree.map(lambda value: value != 0.0, params)
    return lagjax.fit(SCENE, records, params, free=free, transforms=lagjax.positive)


def prediction_errors(fit, records):
    """Root mean square errors of both angles over half a second and over all, (2, 2), in mrad."""
    errors = []
    for record in records:
        begin = int(np.searchsorted(record.ts, FIRST))
        start = fit.predict(lagjax.Record(record.ts[:begin], record.values[:begin])).start
        errors.append(fit.predict(lagjax.Record(record.ts, record.values, start=start)).residuals)
    errors, half = 1e3 * np.array(errors), int(np.searchsorted(records[0].ts, 0.5)) + 1
    return np.sqrt([np.mean(errors[:, :half] ** 2, axis=(0, 1)), np.mean(errors**2, axis=(0, 1))])


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="the recordings, an .npz file")
    parser.add_argument("--law", choices=LAWS, help="fit this law of friction alone")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    records = recordings(options.file)
    seen = [lagjax.Record(r.ts[::EVERY], r.values[::EVERY]) for r in records[:-HELD_OUT]]
    held = records[-HELD_OUT:]
    fits = {name: fit_law(seen, law) for name, law in LAWS.items() if options.law in (None, name)}
    print(f"{'law of friction':<32}{'RMS of the fit [mrad]':>24}{'log likelihood':>16}")
    for name, fit in fits.items():
        rms = " / ".join(f"{1e3 * x:.2f}" for x in fit.rms.values())
        print(f"{name:<32}{rms:>24}{fit.log_likelihood:>16.0f}")
    name = max(fits, key=lambda law: fits[law].log_likelihood)
    print(f"\n{name}\n{fits[name]}")
    errors = prediction_errors(fits[name], held)
    print(f"\n{len(held)} segments that no fit saw, from their first {FIRST:g} s:")
    for span, (first, second) in zip(("over 0.5 s", "over all"), errors, strict=True):
        print(f"{span:<12}{first:.2f} / {second:.2f} mrad")
    return fits, errors


if __name__ == "__main__":
    main()
