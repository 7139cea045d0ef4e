"""A real pendulum of n arms: its parameters from recordings, the law of its friction by evidence, and what comes next.

The file holds `Y_id` (segments, 2n, samples), of which the first n signals are the angles from the upright, and their
spacing `dt` in seconds: free swings of a physical double pendulum, which Kaheman, Fasel, Bramburger, Strom, Kutz and
Brunton published with "The Experimental Multi-Arm Pendulum on a Cart" (HardwareX 2023, arXiv:2205.06231, MIT licence).
Recordings of a single or a triple pendulum in such a file need no other program: the number of arms is that of the
signals. Samples that are missing are NaN, as behind the end of a segment that is shorter than others; angles may be
wound, or taken modulo 2π.

The law of friction is chosen by leaving segments out of those that are fitted; the last ones are only predicted.

python examples/double_pendulum_fit.py kaheman2022_double_pendulum_identification.npz
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

HELD_OUT = 6  # segments at the end, which no fit sees, or a quarter of few
SPACING = 0.016  # s between samples of arms that swing at 3 Hz: at 1 kHz residuals are correlated over a hundred
FIRST, FEWEST = 0.1, 8  # seconds from which the start of a held-out segment is found, and samples at least
SMOOTH = 0.1  # rad/s over which dry friction changes its sign
SLOW = 1e-3  # m/s below which drag is linear
FOLDS = 4
G = 9.81

LAWS = {
    "viscous": ("viscous",),
    "dry": ("dry",),
    "viscous and dry": ("viscous", "dry"),
    "dry and air": ("dry", "air"),
    "viscous, dry and air": ("viscous", "dry", "air"),
}


def first_guess(arms, law):
    """Parameters to begin with, for arms of 20 cm. A free motion sees ratios of energies only.

    In units of the weight times lever of the last arm: `weight` of the others (n − 1,), `inertia` about their bearings
    over G (n,) with the arms beyond as points at the end, `length` (n − 1,) in metres; `viscous`, `dry` (n,), of the
    bearings, and `air`, of the last arm's middle against its speed squared.
    """
    many = np.ones(arms)
    guess = {"weight": np.arange(arms, 1.0, -1.0), "inertia": 0.2 * np.arange(arms, 0.0, -1.0) / G}
    guess["length"] = 0.2 * many[1:]
    strength = {"viscous": 5e-4 * many, "dry": 2e-3 * many, "air": 1e-2}
    return guess | {name: value * (name in law) for name, value in strength.items()}


def lagrangian(q, qdot, params):
    """A chain of rigid bodies: the arms beyond arm i hang at its end, a length away from its bearing."""
    n = q.shape[0]
    weight = jnp.append(params["weight"], 1.0)
    kinetic = 0.5 * jnp.sum(params["inertia"] * qdot**2)
    for j in range(1, n):
        for i in range(j):
            kinetic += params["length"][i] * weight[j] / G * jnp.cos(q[i] - q[j]) * qdot[i] * qdot[j]
    return kinetic - jnp.sum(weight * jnp.cos(q))


def friction(q, qdot, params):
    """Torques on the arms: of bearings, each between an arm and the one before it, and of air on the last arm.

    Air pulls against the velocity of a point of the last arm as far out as the arm before is long.
    """
    rates = qdot - jnp.concatenate([jnp.zeros(1), qdot[:-1]])
    bearing = -params["viscous"] * rates - params["dry"] * jnp.tanh(rates / SMOOTH)
    levers = jnp.append(params["length"], params["length"][-1] if q.shape[0] > 1 else 0.2)
    along = jnp.stack([levers * jnp.cos(q), -levers * jnp.sin(q)])  # (2, n): how the point moves with each angle
    velocity = along @ qdot
    drag = -params["air"] * velocity * jnp.sqrt(jnp.sum(velocity**2) + SLOW**2)
    return bearing - jnp.append(bearing[1:], 0.0) + drag @ along


SCENE = lagjax.System(lagrangian, forces=friction)


def recordings(file):
    """The angles of every segment, from its first to its last sample."""
    with np.load(file) as data:
        signals, dt = np.asarray(data["Y_id"], float), float(data["dt"])
    if signals.ndim != 3 or signals.shape[1] % 2 or not dt > 0:
        raise SystemExit(f"Y_id must be (segments, 2n, samples), angles before rates, and dt positive: {signals.shape}")
    angles = np.moveaxis(signals[:, : signals.shape[1] // 2], 1, 2)
    records = []
    for values in angles:
        measured = np.flatnonzero(np.isfinite(values).any(axis=1))
        if len(measured) > 1:
            values = values[measured[0] : measured[-1] + 1]
            records.append(lagjax.Record(dt * np.arange(len(values)), np.stack([unwound(x) for x in values.T], axis=1)))
    if not records:
        raise SystemExit("Y_id holds no angle that was measured.")
    return records


def unwound(angle):
    """An angle (T,) without jumps of 2π, where all of it is within one turn; a gap may hide more than half a turn."""
    measured = np.isfinite(angle)
    if measured.any() and np.ptp(angle[measured]) <= 2 * np.pi:
        angle = angle.copy()
        angle[measured] = np.unwrap(angle[measured])
    return angle


def thinned(record):
    """A record with the samples that a fit needs."""
    step = max(1, round(SPACING / record.ts[1])) if len(record) > 1 else 1
    return lagjax.Record(record.ts[::step], record.values[::step])


def fit_law(records, law, near=None):
    """The fit of one law of friction; what it does not name stays at zero. The arms begin as in the fit `near`."""
    params, method = first_guess(records[0].values.shape[1], law), "auto"
    if near is not None:
        params |= {name: near.params[name] for name in ("weight", "inertia", "length")}
        begun = [
            lagjax.Record(r.ts, r.values, start=lagjax.Guess(*y)) for r, y in zip(records, near.starts, strict=True)
        ]
        records, method = begun, "whole"
    free = {name: name in ("weight", "inertia", "length", *law) for name in params}
    return lagjax.fit(SCENE, records, params, free=free, transforms=lagjax.positive, method=method)


def prediction_errors(fit, records):
    """Root mean square errors of all angles over half a second and over all, (2, n), in mrad."""
    early, late = [], []
    for record in records:
        complete = np.flatnonzero(np.isfinite(record.values).all(axis=1))
        count = max(FEWEST, int(np.searchsorted(record.ts, FIRST)))
        begin = complete[min(count, len(complete)) - 1] + 1
        start = fit.predict(lagjax.Record(record.ts[:begin], record.values[:begin])).start
        error = 1e3 * fit.predict(lagjax.Record(record.ts, record.values, start=start)).residuals
        early.append(error[: int(np.searchsorted(record.ts, 0.5)) + 1])
        late.append(error)
    return np.sqrt([np.nanmean(np.concatenate(some) ** 2, axis=0) for some in (early, late)])


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="the recordings, an .npz file")
    parser.add_argument("--law", choices=LAWS, help="fit this law of friction alone")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    records = recordings(options.file)
    count = len(records) - min(HELD_OUT, max(len(records) // 4, int(len(records) > 1)))
    seen, held = [thinned(record) for record in records[:count]], records[count:]
    fits = {}
    for name, law in LAWS.items():
        if options.law in (None, name):
            fits[name] = fit_law(seen, law, next(iter(fits.values()), None))
    name, fit = next(iter(fits.items()))
    if len(fits) > 1:
        folds = min(FOLDS, len(seen)) if len(seen) > 1 else 0
        comparison = fit.compare({other: fits[other] for other in fits if other != name}, folds=folds)
        print(f'{len(seen)} segments; "this" is {name}\n{comparison}\n')
        name = name if comparison.best == "this" else comparison.best
    print(f"{name}\n{fits[name]}")
    if not held:
        return fits, None
    errors = prediction_errors(fits[name], held)
    print(f"\n{len(held)} segment{'s' * (len(held) > 1)} that no fit saw, from their first {FIRST:g} s:")
    for span, each in zip(("over 0.5 s", "over all"), errors, strict=True):
        print(f"{span:<12}{' / '.join(f'{error:.2f}' for error in each)} mrad")
    return fits, errors


if __name__ == "__main__":
    main()
