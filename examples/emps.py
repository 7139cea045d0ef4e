"""A driven axis that sticks: its mass and the law of its friction by evidence, from one record of a positioning system.

The file holds the times `t`, the measured position `qm` [m], the motor's voltage `vir` [V], which is held between
samples, and `gtau`, newtons per volt: the electro-mechanical positioning system of Janot, Gautier and Brunot, "Data set
and reference models of EMPS" (2019, nonlinearbenchmark.org).

    m q̈ = gtau · vir − friction(q̇) − offset

What is wanted is a law that follows another record of the axis by its voltage alone. So that is what laws are chosen
by. The record is cut at rests into halves, thirds and quarters; each of these is left out in turn, the law is fitted to
the others, and what was left out is simulated from its rest, with no start or offset fitted to it. Of the laws that
follow as well as the best, within one standard error of the difference over those nine, the simplest is taken.

An axis on rails remembers a force of 0.1 N as millimetres for ever after, and what the motor needs at one and the same
speed drifts by 0.4 N within this record. A fit of all of it at once bends friction after the drift. So a law is fitted
from rest to every third rest, about two seconds: the three thirds that were left out are then followed to 2.6 mm RMS
by the best law that is written down, where a fit of whole spans gives 4.4, and to 1.7 mm by a free function of the
speed (`lagjax.learned`). With friction that jumps at q̇ = 0 the sum of squares has a kink at every reversal,
where searches creep; here the jump is spread over 2 mm/s.

python examples/emps.py emps_identification.npz
python examples/emps.py emps_identification.npz --follow another_record.npz
"""

import argparse
import itertools
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

PARTS = 2, 3, 4  # how many long spans the record is cut into, one of which is left out
RESTS = 3  # a law is fitted from a rest to the third after it
FIRST = 0.03  # seconds of a recording off which its first velocity is read
TURN = 0.1  # seconds that two rests are apart, at least
SPACING = 0.005  # seconds between positions that are fitted, and over which the voltage is averaged: its impulse stays
SMOOTH = 2e-3  # m/s over which dry friction changes its sign
SLOW = 2e-2  # m/s below which Stribeck's rise is seen
LEAST = 1.0  # N: the least load, so that the root below has a slope

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
FREE = "a free function of the speed"
# Of friction, positive: knots up to the fastest stroke [m/s]. The record has three speeds. From seven knots on a spline
# wriggles between them, which follows strokes of these speeds to 0.3 mm, and others worse than any law.
SIZE = lagjax.learned.inertia((0.0, 0.14), count=5)


def forces(q, qdot, params, inputs):
    """The motor's force less that of friction and offset; the offset is also what dry friction differs by, each way."""
    sign, drive = jnp.tanh(qdot / SMOOTH), inputs
    dry = params["dry"] + params["stribeck"] * jnp.exp(-((qdot / SLOW) ** 2)) + params["load"] * load(drive)
    viscous = params["viscous"] + params["viscous skew"] * sign + params["square"] * qdot * sign
    return drive - dry * sign - viscous * qdot - params["offset"] - params["spring"] * q


def load(drive):
    """What presses on nut and bearings: the size of the motor's force."""
    return jnp.sqrt(drive**2 + LEAST**2)


def free_forces(q, qdot, params, inputs):
    """The same with friction by a spline, and what is viscous in one direction alone."""
    sign, speed = jnp.tanh(qdot / SMOOTH), jnp.sqrt(qdot**2 + SMOOTH**2)
    return inputs - sign * SIZE(speed, params=params["size"]) - params["viscous skew"] * speed - params["offset"]


def kinetic(q, qdot, params):
    return 0.5 * params["mass"] * qdot**2


SCENE, FREE_SCENE = (lagjax.System(kinetic, forces=of_law) for of_law in (forces, free_forces))


class Recording(NamedTuple):
    """Times [s], positions [m], and the motor's force [N], (T,) each."""

    t: np.ndarray
    q: np.ndarray
    drive: np.ndarray

    def part(self, span: tuple[int, int]) -> "Recording":
        """The samples of one span, its end included."""
        begin, end = span
        return Recording(*(signal[begin : end + 1] for signal in self))

    def first_velocity(self) -> float:
        """The velocity at the first sample, that of a parabola through the first 30 ms."""
        count = max(5, int(np.searchsorted(self.t, self.t[0] + FIRST)))
        return float(np.polyfit(self.t[:count] - self.t[0], self.q[:count], 2)[1])

    def record(self, velocity: float) -> lagjax.Record:
        """The recording as it is fitted and followed, with fewer samples, from its first position."""
        step = max(1, round(SPACING / np.median(np.diff(self.t))))
        places = np.arange(0, len(self.t), step)
        drive = np.add.reduceat(self.drive, places) / np.diff(places, append=len(self.t))
        return lagjax.Record(self.t[places], self.q[places], inputs=drive, start=(self.q[0], velocity))


def recording(file) -> Recording:
    """The recording of a file."""
    with np.load(file) as data:
        return Recording(data["t"], data["qm"], float(data["gtau"]) * data["vir"])


def rests(whole: Recording) -> np.ndarray:
    """The samples, between first and last, at which the axis stands or turns: the slowest of each time that it is slow.

    Velocities are differences over 10 ms, as long as the turn itself takes.
    """
    before, after = (np.interp(whole.t + way * SPACING, whole.t, whole.q) for way in (-1, 1))
    speed = np.abs(after - before) / (2 * SPACING)
    slow = np.flatnonzero((speed < 2 * SMOOTH) & (whole.t > whole.t[0] + TURN) & (whole.t < whole.t[-1] - TURN))
    groups = np.split(slow, np.flatnonzero(np.diff(whole.t[slow]) > TURN) + 1)
    return np.array([group[np.argmin(speed[group])] for group in groups if len(group)], int)


def long_spans(whole: Recording, stops: np.ndarray, count: int) -> list[tuple[int, int]]:
    """The recording in so many spans, cut at the rests that are nearest to equal lengths."""
    wanted = np.linspace(whole.t[0], whole.t[-1], count + 1)[1:-1]
    inner = [int(stops[np.argmin(np.abs(whole.t[stops] - t))]) for t in wanted]
    if len(set(inner)) < count - 1:
        raise SystemExit(f"The record has {len(stops)} rests, too few to cut it into {count} spans at them.")
    return list(itertools.pairwise([0, *inner, len(whole.t) - 1]))


def fitted_spans(whole: Recording, stops: np.ndarray, spans: list[tuple[int, int]]) -> list[lagjax.Record]:
    """Spans cut at every third rest. They start at rest, but for that with which the recording starts."""
    pieces = []
    for begin, end in spans:
        inner = stops[(begin < stops) & (stops < end)][RESTS - 1 :: RESTS]
        pieces += itertools.pairwise([begin, *inner, end])
    return [whole.part(piece).record(0.0 if piece[0] else whole.first_velocity()) for piece in pieces]


def fit_law(records, law, near=None):
    """The fit of one law, begun at the parameters of the fit `near`; what it does not name stays at zero."""
    if law == FREE:
        size = SIZE.interpolate(lambda speed: START["dry"] + START["viscous"] * speed)
        params = {"mass": START["mass"], "offset": 0.0, "viscous skew": 0.0, "size": size}
        transforms = dict.fromkeys(params) | {"mass": lagjax.positive}
        return lagjax.fit(FREE_SCENE, records, params, transforms=transforms, method="whole")
    params, more = START | MORE if near is None else near.params, LAWS[law]
    free = {name: name in START or name in more for name in params}
    transforms = {name: lagjax.positive if name in ("mass", "dry", "viscous") else None for name in params}
    return lagjax.fit(SCENE, records, params, free=free, transforms=transforms, method="whole")


def simulated(fit, part: Recording, velocity: float) -> float:
    """The root mean square error [mm] of a simulation from the start, with the voltage alone."""
    return 1e3 * float(np.sqrt(np.mean(fit.predict(part.record(velocity)).residuals ** 2)))


def left_out(whole: Recording, stops: np.ndarray, law: str, near) -> list[float]:
    """How far off each half, third and quarter is simulated [mm] by the law fitted to the others."""
    errors = []
    for count in PARTS:
        spans = long_spans(whole, stops, count)
        for apart in spans:
            fit = fit_law(fitted_spans(whole, stops, [span for span in spans if span != apart]), law, near)
            errors.append(simulated(fit, whole.part(apart), 0.0 if apart[0] else whole.first_velocity()))
    return errors


def chosen(free: list[int], errors: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
    """Which law (of errors (laws, spans)), and how far each is behind the best in the mean logarithm, and to how much.

    The one-standard-error rule: Hastie, Tibshirani & Friedman, *The Elements of Statistical Learning* (2009), §7.10.
    """
    logs = np.log(errors)
    behind = logs - logs[np.argmin(logs.mean(axis=1))]
    mean, error = behind.mean(axis=1), behind.std(axis=1, ddof=1) / np.sqrt(errors.shape[1])
    return min(np.flatnonzero(mean <= error).tolist(), key=lambda k: (free[k], mean[k])), mean, error


def select(whole: Recording, stops: np.ndarray, fits: dict) -> str:
    """The name of the law that follows what was left out, and the table it was read off."""
    errors = np.array([left_out(whole, stops, name, fit) for name, fit in fits.items()])
    free = [len(fit.u) for fit in fits.values()]
    best, mean, error = chosen(free, errors)
    print(f"{'law':<28}free  RMS [mm] of each half, third, quarter left out, from rest{'behind the best':>22}")
    for k, name in enumerate(fits):
        row = "".join(f"{x:6.2f}" for x in errors[k])
        print(f"{name:<28}{free[k]:>4}  {row}{100 * mean[k]:>10.0f} ± {100 * error[k]:.0f} %")
    name = list(fits)[best]
    print(f"No simpler law follows as well as the best, within one standard error: {name}.\n")
    return name


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="the record, an .npz file")
    parser.add_argument("--law", choices=[*LAWS, FREE], help="take this law of friction without looking at the others")
    parser.add_argument("--follow", type=Path, help="another record of the axis, simulated with what was fitted")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    whole = recording(options.file)
    stops, fits = rests(whole), {}
    everything = fitted_spans(whole, stops, [(0, len(whole.t) - 1)])
    for name in (*LAWS, FREE):
        if options.law in (None, name):
            fits[name] = fit_law(everything, name, next(iter(fits.values()), None))
    name = options.law or select(whole, stops, fits)
    print(f"{name}, from rest to every third rest\n{fits[name]}\n")
    errors = {}
    for file in filter(None, (options.file, options.follow)):
        other = recording(file)
        velocities = 0.0, other.first_velocity()
        errors[file] = [simulated(fits[name], other, velocity) for velocity in velocities]
        print(f"{file.name}, {np.ptp(other.t):.1f} s, simulated from its first position:")
        for velocity, error in zip(velocities, errors[file], strict=True):
            print(f"{error:8.2f} mm RMS from {1e3 * velocity:.1f} mm/s")
    return fits, name, errors


if __name__ == "__main__":
    main()
