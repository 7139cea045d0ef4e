"""A small servo that swings a mass: the law of its gear box by records that were left out, from its goals alone.

The file holds recordings of a position-controlled servo with a mass on an arm, each with its goal, mass, length and
gain (Rhoban/bam; the keys are `K_timestamp`, `K_position`, `K_goal_position`, `K_torque_enable`, `K_mass`, `K_length`,
`K_kp` for K = 0, 1, …). The firmware makes a duty cycle u of the error, and the motor a torque of it:

    (m l² + J) q̈ = τ − m g l sin(q + offset) − friction · sign(q̇)
    u = clip(e kp (goal − q), −1, 1)        τ = pull u (1 − sag |u|) − brake q̇    while the motor is on

`sag` is what the supply loses under load. The teeth of a gear box press on each other with the motor's torque on one
side, and the weight on the other, and friction grows with both:

    friction = dry + viscous |q̇| + (a |τ| + b |m g l sin(q + offset)| + c) (1, or exp(−(q̇/slow)²))

Which of these terms the servo has, and whether its supply sags, is chosen by `lagjax.terms`: a fit has all of them,
others have fewer and fewer, recordings are left out and simulated with what the others gave, and of the laws that
follow as well as the best, within one standard error of the difference over all recordings, the smallest is taken.

    python examples/servo.py servo_identification.npz [--follow OTHER.npz]
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import lagjax

G = 9.80665  # m/s²
DUTY = 4096 / (2 * np.pi) / (256 * 885)  # duty cycle over gain and error [1/rad]: the firmware's encoder and scale
SLOW = 0.5  # rad/s within which dry friction falls
SPACING = 0.02  # seconds between positions that are fitted


def against(size):
    """A term of friction: against the velocity, as large as `size` of the motor's torque, the weight and the rise."""
    return lambda v, torque, weight: -jnp.sign(v) * size(jnp.abs(torque), jnp.abs(weight), jnp.exp(-((v / SLOW) ** 2)))


FRICTION = lagjax.terms({
    "viscous": lambda v, torque, weight: -v,
    "motor": against(lambda motor, weight, rise: motor),
    "weight": against(lambda motor, weight, rise: weight),
    "rise": against(lambda motor, weight, rise: rise),
    "rise by motor": against(lambda motor, weight, rise: motor * rise),
    "rise by weight": against(lambda motor, weight, rise: weight * rise),
})  # fmt: skip
SUPPLY = lagjax.terms({"sag": lambda duty: -duty * jnp.abs(duty)})
START = {"pull": 1.0, "brake": 0.04, "armature": 1.5e-3, "offset": 0.0, "dry": 0.02}
START |= {"friction": FRICTION.params0 | {"motor": 0.25, "weight": 0.15}, "supply": SUPPLY.params0}
SETS = dict.fromkeys(("pull", "brake", "armature", "dry"), lagjax.positive)
SETS |= dict.fromkeys(("offset", "friction", "supply"), None)


def push(q, qdot, params, inputs, weight):
    """The motor's torque less friction [N m]."""
    duty = jnp.clip(inputs["gain"] * (inputs["goal"] - q), -1.0, 1.0)
    torque = params["pull"] * (duty + SUPPLY(duty, params=params["supply"])) - params["brake"] * qdot
    torque, weight = inputs["on"] * torque, weight * jnp.sin(q + params["offset"])
    return torque - params["dry"] * jnp.sign(qdot) + FRICTION(qdot, torque, weight, params=params["friction"])


class Recording(NamedTuple):
    """Times [s], positions [rad] and goals [rad], whether the motor is on, (T,) each; the gain, kg and m."""

    t: np.ndarray
    q: np.ndarray
    goal: np.ndarray
    on: np.ndarray
    gain: float
    mass: float
    length: float

    @property
    def arm(self) -> str:
        """The name of what is on the arm, which recordings share."""
        return f"{self.mass:g} kg at {self.length:g} m"

    @property
    def inputs(self) -> dict[str, np.ndarray]:
        """What the firmware is given, (T,) each."""
        return {"goal": self.goal, "on": self.on, "gain": np.full(len(self.t), self.gain)}

    def scene(self, given=None) -> lagjax.System:
        """The servo with this arm, whose inputs are those of a record, or the functions of time `given`."""
        mass, length, weight = self.mass, self.length, self.mass * G * self.length

        def lagrangian(q, qdot, params):
            inertia = mass * length**2 + params["armature"]
            return 0.5 * inertia * qdot**2 + weight * jnp.cos(q + params["offset"])

        def forces(q, qdot, params, inputs):
            return push(q, qdot, params, inputs, weight)

        def timed_forces(q, qdot, t, params):
            return push(q, qdot, params, {name: u(t) for name, u in given.items()}, weight)

        return lagjax.System(lagrangian, forces=timed_forces if given else forces)

    def record(self) -> lagjax.Record:
        """What is fitted, from the first position and its rate on."""
        step = max(1, round(SPACING / np.median(np.diff(self.t))))
        start = self.q[0], (self.q[step] - self.q[0]) / (self.t[step] - self.t[0])
        return lagjax.Record(self.t[::step], self.q[::step], inputs=self.inputs, input_ts=self.t, start=start)

    def errors(self, params) -> np.ndarray:
        """What a simulation from the first sample, with the goal alone, is off by [rad], (T,)."""
        given = {name: lagjax.samples(self.t, values) for name, values in self.inputs.items()}
        return np.asarray(lagjax.simulate(self.scene(given), *self.record().start, self.t, params).q) - self.q


def recordings(file) -> list[Recording]:
    """The recordings of a file."""
    with np.load(file) as data:

        def read(k, *names):
            return [np.asarray(data[f"{k}_{name}"], float) for name in names]

        found = []
        while f"{len(found)}_timestamp" in data:
            t, *signals = read(len(found), "timestamp", "position", "goal_position", "torque_enable")
            gain, mass, length = map(float, read(len(found), "kp", "mass", "length"))
            found.append(Recording(t - t[0], *signals, DUTY * gain, mass, length))
    return found


def fit_servo(known: list[Recording]) -> lagjax.results.Fit:
    """The fit of recordings, and its choice of terms."""
    arms = {one.arm: one.scene() for one in known}
    records = {arm: [one.record() for one in known if one.arm == arm] for arm in arms}
    return lagjax.fit(arms, records, START, transforms=SETS, method="whole")


def mean_error(errors: np.ndarray) -> float:
    """The mean absolute error [mrad] of a simulated recording."""
    return 1e3 * float(np.mean(np.abs(errors)))


def draw(known: list[Recording], errors: list[np.ndarray], file: Path):
    """Every recording and its simulation."""
    rows = -(-len(known) // 2)
    figure, axes = plt.subplots(rows, 2, figsize=(9.0, 1.6 * rows), sharex=True, squeeze=False)
    for axis in axes.flat[len(known) :]:
        axis.set_visible(False)
    for axis, one, of_one in zip(axes.flat, known, errors, strict=False):
        axis.plot(one.t, one.goal, color="0.8", linewidth=1, label="goal")
        axis.plot(one.t, one.q, color="0.2", linewidth=2.5, label="measured")
        axis.plot(one.t, one.q + of_one, color="C1", linewidth=1.2, label="from its goal alone")
        axis.set_ylabel("angle [rad]")
        axis.set_title(f"gain {one.gain / DUTY:g}: {mean_error(of_one):.0f} mrad", fontsize=9)
    axes[0, 0].legend(fontsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    file.parent.mkdir(exist_ok=True)
    figure.savefig(file)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="the recordings, an .npz file")
    parser.add_argument("--follow", type=Path, help="other recordings of the servo, simulated with what was fitted")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    plt.style.use("lagjax.figures")

    known = recordings(options.file)
    fit = fit_servo(known)
    print(f"{fit}\n")
    errors = {}
    for file, text in ((options.file, "fitted"), (options.follow, "followed")):
        if file is not None:
            other = recordings(file)
            found = [one.errors(fit.params) for one in other]
            draw(other, found, Path("out") / f"servo_{text}.png")
            errors[text] = [mean_error(of_one) for of_one in found]
            print(f"{text}: {len(other)} recordings, mean absolute error {np.mean(errors[text]):.1f} mrad")
    return fit, errors


if __name__ == "__main__":
    main()
