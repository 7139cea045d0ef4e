"""An electronic oscillator with a hardening spring: its law by evidence, then a record that it was not fitted to.

The file holds the input `u` [V], the output `y` [V] and the rate `fs` [Hz] of Silverbox (Wigren and Schoukens, "Three
free data sets for development and benchmarking in nonlinear system identification", ECC 2013): ten random-phase odd
multisines, one after another, with zero stretches between them. The circuit is to be

    q̈ = gain u + bias − V′(q) − friction(q, q̇)

V and friction are sums of candidate terms (`lagjax.terms`), of which a fit keeps those that the motion asks for. Three
multisines are fitted from rest; the others are then simulated from rest by their input alone. Its input is
band-limited between samples. Times are in milliseconds.

    python examples/silverbox.py silverbox_multisines.npz [--follow OTHER.npz]
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import lagjax

FITTED = 3  # multisines
REST = 20  # samples over which the input stands still between multisines
QUIET = 10  # samples of rest with which a record begins

POTENTIAL = lagjax.terms({f"q^{k}": lambda q, k=k: q**k / k for k in range(2, 8)})
FRICTION = lagjax.terms({
    "viscous": lambda q, v: -v,
    "viscous by deflection": lambda q, v: -v * q,
    "viscous by its square": lambda q, v: -v * q**2,
    "cubic": lambda q, v: -(v**3),
})  # fmt: skip
SCENE = lagjax.System(
    lambda q, qdot, params: 0.5 * qdot**2 - POTENTIAL(q, params=params["V"]),
    forces=lambda q, qdot, params, inputs: (
        params["gain"] * inputs + params["bias"] + FRICTION(q, qdot, params=params["friction"])
    ),
)
START = {"gain": 0.1, "bias": 0.0, "V": POTENTIAL.params0 | {"q^2": 0.19}, "friction": FRICTION.params0}
START["friction"] |= {"viscous": 0.02}


def records(file) -> list[lagjax.Record]:
    """The stretches of a file between rests, from rest."""
    with np.load(file) as data:
        u, y, ts = data["u"].ravel(), data["y"].ravel(), 1e3 / float(data["fs"]) * np.arange(data["u"].size)
    still = np.lib.stride_tricks.sliding_window_view(u, REST).std(axis=1) < 1e-3
    moves = np.flatnonzero(still[:-1] & ~still[1:])
    begins = [k + QUIET for k in moves if not still[k + 1 : k + 1 + 10 * REST].any()]
    ends = [*(np.array(begins[1:], int) - 80), len(u)]
    return [lagjax.Record(ts[: b - a], y[a:b], u[a:b], (0.0, 0.0)) for a, b in zip(begins, ends, strict=True)]


def followed(fit, others) -> float:
    """The root mean square error [mV] of simulations from rest, by the input alone."""
    return 1e3 * float(np.sqrt(np.mean(np.concatenate([fit.predict(one).residuals for one in others]) ** 2)))


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="the multisines, an .npz file")
    parser.add_argument("--follow", type=Path, help="another record, simulated from rest with what was fitted")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    known = records(options.file)
    fit = lagjax.fit(SCENE, known[:FITTED], START, hold="band", method="whole")
    print(fit)
    errors = {"left out": followed(fit, known[FITTED:])} if len(known) > FITTED else {}
    if options.follow:
        with np.load(options.follow) as data:
            u, y, ts = data["u"].ravel(), data["y"].ravel(), 1e3 / float(data["fs"]) * np.arange(data["u"].size)
        errors["followed"] = followed(fit, [lagjax.Record(ts, y, u, (0.0, 0.0))])
    for name, error in errors.items():
        print(f"{name}: {error:.3f} mV RMS, by {len(fit.u)} numbers")
    return fit, errors


if __name__ == "__main__":
    main()
