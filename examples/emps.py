"""A driven axis that sticks: its mass and the law of its friction by evidence, from one record of a positioning system.

The file holds the times `t`, the measured position `qm` [m], the motor's voltage `vir` [V], which is held between
samples, and `gtau`, newtons per volt: the electro-mechanical positioning system of Janot, Gautier and Brunot, "Data set
and reference models of EMPS" (2019, nonlinearbenchmark.org).

    m q̈ = gtau · vir − friction(q̇) − offset

The law of friction is chosen before anything is simulated from end to end: the record is cut into stretches, each law
is fitted to some of them and follows the others. What is chosen is then fitted to the whole record, which is simulated
from q(0) at rest with the voltage alone. With friction that jumps at q̇ = 0 the sum of squares has a kink at every
reversal, where searches creep; here the jump is spread over 2 mm/s.

python examples/emps.py emps_identification.npz
"""

import argparse
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

STRETCHES, FOLDS = 8, 4
EVERY = 10  # of the samples at 1 kHz: the voltage is used as it is, the positions of 10 ms say the same
SMOOTH = 2e-3  # m/s over which dry friction changes its sign
SLOW = 2e-2  # m/s below which Stribeck's rise is seen
REST = 1.0  # N: the least load, so that the root below has a slope

START = {"mass": 95.0, "dry": 20.0, "viscous": 200.0, "offset": 0.0}
MORE = {"viscous skew": 0.0, "square": 0.0, "stribeck": 0.0, "load": 0.0, "spring": 0.0}
LAWS = {
    "dry and viscous": (),
    "Stribeck": ("stribeck",),
    "square of the velocity": ("square",),
    "grows with the load": ("load",),
    "spring": ("spring",),
    "viscous, each way its own": ("viscous skew",),
    "each way its own, Stribeck": ("viscous skew", "stribeck"),
    "each way its own, load": ("viscous skew", "load"),
    "each way its own, square": ("viscous skew", "square"),
}


def forces(q, qdot, params, inputs):
    """The motor's force less that of friction and offset; the offset is also what dry friction differs by, each way."""
    sign, drive = jnp.tanh(qdot / SMOOTH), inputs
    dry = params["dry"] + params["stribeck"] * jnp.exp(-((qdot / SLOW) ** 2)) + params["load"] * load(drive)
    viscous = params["viscous"] + params["viscous skew"] * sign + params["square"] * qdot * sign
    return drive - dry * sign - viscous * qdot - params["offset"] - params["spring"] * q


def load(drive):
    """What presses on nut and bearings: the size of the motor's force."""
    return jnp.sqrt(drive**2 + REST**2)


SCENE = lagjax.System(lambda q, qdot, params: 0.5 * params["mass"] * qdot**2, forces=forces)


def recording(file):
    """Times, positions and the motor's force."""
    with np.load(file) as data:
        return data["t"], data["qm"], float(data["gtau"]) * data["vir"]


def records(t, q, drive, count):
    """The record in stretches whose starts are fitted; in one, it starts at rest."""
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], count + 1))
    edges[-1] = len(t)
    found = []
    for a, b in itertools.pairwise(edges):
        values = np.full(b - a, np.nan)
        values[::EVERY] = q[a:b:EVERY]
        start = (q[0], 0.0) if count == 1 else None  # of a stretch it is read off the data, and fitted
        found.append(lagjax.Record(t[a:b], values, inputs=drive[a:b], start=start))
    return found


def fit_law(rows, more, start=None):
    """The fit of one law; what it does not name stays at zero."""
    params = START | MORE if start is None else start
    free = {name: name in START or name in more for name in params}
    transforms = {name: lagjax.positive if name in ("mass", "dry", "viscous") else None for name in params}
    return lagjax.fit(SCENE, rows, params, free=free, transforms=transforms, method="whole")


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="the record, an .npz file")
    parser.add_argument("--law", choices=LAWS, help="take this law of friction without looking at the others")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    measured = recording(options.file)
    stretches = records(*measured, STRETCHES)
    fits = {name: fit_law(stretches, more) for name, more in LAWS.items() if options.law in (None, name)}
    name, fit = next(iter(fits.items()))
    if len(fits) > 1:
        comparison = fit.compare({other: fits[other] for other in fits if other != name}, folds=FOLDS)
        print(f'{STRETCHES} stretches; "this" is {name}\n{comparison}\n')
        name = name if comparison.best == "this" else comparison.best
    print(f"{name}, from the stretches\n{fits[name]}\n")
    whole = fit_law(records(*measured, 1), LAWS[name], fits[name].params)
    print(f"{name}, simulated from q(0): {1e3 * whole.rms['q']:.2f} mm RMS over {measured[0][-1]:.1f} s\n{whole}")
    return fits, whole


if __name__ == "__main__":
    main()
