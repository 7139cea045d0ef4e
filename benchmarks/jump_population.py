"""Random scenes with jumps in every spelling, as forces, events and sections: is any value or gradient wrong?

    python -m benchmarks.jump_population --scenes 200
    python -m benchmarks.jump_population --scenes 200 --float32

A *spelling* is a function of one number u that jumps where u passes levels that are known, with a smooth form between
them: angles by `arctan2`, powers and logarithms of complex numbers, wholes, comparisons, tables. A *kind* says what
jumps with it: a force by the place, by the time or by the angle of an orbit; an event; a section. The reference goes
from level to level with DOP853 (SciPy) on the smooth forms, angles as a further coordinate, and its derivatives are
differences. `--float32` is JAX's default, float32.
"""

import argparse
import collections
import functools
import itertools
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import lagjax
from benchmarks import _singles

PI = np.pi
# Runs of rtol 1e-9 for ten units of time, whose errors grow tenfold at a border; differences of a reference of 1e-12
# over 1e-5 are exact to 1e-6. In float32 the start and the parameters are known to 6e-8.
TOLERANCES = {False: (1e-6, 2e-5), True: (3e-5, 1e-3)}
SHIFT = 1e-5
SLOWEST, NEAREST = 0.15, 1e-3  # rate of u at a level; how near the end, or another crossing, a level may be
WHOLES = np.arange(-60, 61)


@dataclass(frozen=True, eq=False)
class Spelling:
    """A function of u in JAX, the levels where it jumps, and its smooth form beyond level number k − 1: `form(u, k)`.

    Between `levels[k - 1]` and `levels[k]` is piece k.
    """

    function: Callable
    levels: np.ndarray
    form: Callable


def _steps(function: Callable, levels=(0.0,), values=(-1.0, 1.0)) -> Spelling:
    """What is constant between its levels."""
    return Spelling(function, np.array(levels), lambda u, k: values[k] + 0.0 * u)


def _periodic(function: Callable, period: float, form: Callable, middle: float = 0.0) -> Spelling:
    """`form(rest, n)` of u = n periods + rest, with the jumps half a period from the `middle`."""
    levels = (WHOLES - 0.5) * period + middle
    return Spelling(function, levels, lambda u, k: form(u - (WHOLES[0] + k - 1) * period, WHOLES[0] + k - 1))


def _wrap(function: Callable, form: Callable = lambda rest, n: rest, period: float = 2 * PI) -> Spelling:
    return _periodic(function, period, form)


def _on_circle(u):
    return jnp.exp(1j * u)


SPELLINGS: dict[str, Spelling] = {
    # angles
    "arctan2": _wrap(lambda u: jnp.arctan2(jnp.sin(u), jnp.cos(u))),
    "arctan2 of a radius": _wrap(lambda u: jnp.arctan2((2 + jnp.sin(u)) * jnp.sin(u), (2 + jnp.sin(u)) * jnp.cos(u))),
    "arctan2, turned": _periodic(
        lambda u: jnp.arctan2(jnp.cos(u), jnp.sin(u)), 2 * PI, lambda rest, n: PI / 2 - rest, PI / 2),
    "angle": _wrap(lambda u: jnp.angle(_on_circle(u))),
    "angle of a sum": _wrap(lambda u: jnp.angle(jnp.exp((0.3 + 1j) * u))),
    "log": _wrap(lambda u: jnp.log(_on_circle(u)).imag),
    "complex root": _wrap(lambda u: jnp.sqrt(_on_circle(u)).imag, lambda rest, n: np.sin(rest / 2)),
    "complex power": _wrap(lambda u: (_on_circle(u) ** 0.3).real + (_on_circle(u) ** 0.3).imag,
                           lambda rest, n: np.cos(0.3 * rest) + np.sin(0.3 * rest)),
    "half angle": _wrap(lambda u: 2 * jnp.arctan(jnp.tan(u / 2))),
    "arctan of a quotient": _wrap(lambda u: jnp.arctan(jnp.sin(u) / jnp.cos(u)), period=PI),
    "arctan of 1/u": Spelling(
        lambda u: jnp.arctan(1 / u), np.zeros(1), lambda u, k: (2 * k - 1) * PI / 2 - np.arctan(u)),
    "arctan of u**-1": Spelling(
        lambda u: jnp.arctan(u**-1.0), np.zeros(1), lambda u, k: (2 * k - 1) * PI / 2 - np.arctan(u)),
    "arctan of a sum": Spelling(
        lambda u: jnp.arctan(1 + 2 / u), np.zeros(1),
        lambda u, k: np.arctan2((2 * k - 1) * (u + 2), (2 * k - 1) * u)),
    "mod of an angle": _wrap(lambda u: jnp.mod(jnp.arctan2(jnp.sin(u), jnp.cos(u)) + PI, 2 * PI) - PI),
    # wholes
    "mod": _wrap(lambda u: jnp.mod(u + PI, 2 * PI) - PI),
    "remainder": _wrap(lambda u: jnp.remainder(u + PI, 2 * PI) - PI),
    "round": _wrap(lambda u: u - 2 * PI * jnp.round(u / (2 * PI))),
    "floor": _periodic(jnp.floor, 1.0, lambda rest, n: n + 0 * rest, 0.5),
    "ceil": _periodic(jnp.ceil, 1.0, lambda rest, n: n + 1.0 + 0 * rest, 0.5),
    "trunc": Spelling(jnp.trunc, WHOLES[WHOLES != 0].astype(float), lambda u, k: k - 60.0 + 0 * u),
    "fmod": Spelling(
        lambda u: jnp.fmod(u, 1.0), WHOLES[WHOLES != 0].astype(float), lambda u, k: u - (k - 60.0)),
    "floor division": _periodic(lambda u: u // 1.0, 1.0, lambda rest, n: n + 0 * rest, 0.5),
    "whole numbers": Spelling(
        lambda u: u.astype(int) * 0.5, WHOLES[WHOLES != 0].astype(float), lambda u, k: 0.5 * (k - 60.0) + 0 * u),
    # comparisons
    "sign": _steps(jnp.sign),
    "where": _steps(lambda u: jnp.where(u > 0, 1.0, -1.0)),
    "heaviside": _steps(lambda u: jnp.heaviside(u, 0.5), values=(0.0, 1.0)),
    "greater": _steps(lambda u: 1.0 * (u > 0), values=(0.0, 1.0)),
    "copysign": _steps(lambda u: jnp.copysign(1.0, u)),
    "signbit": _steps(lambda u: jnp.where(jnp.signbit(u), -1.0, 1.0)),
    "u/|u|": _steps(lambda u: u / jnp.abs(u)),
    "u/sqrt(u²)": _steps(lambda u: u / jnp.sqrt(u**2)),
    "argmax": _steps(lambda u: 1.0 * jnp.argmax(jnp.stack([0.0 * u, u])), values=(0.0, 1.0)),
    "cond": _steps(lambda u: jax.lax.cond(u > 0, lambda u: 1.0 + 0 * u, lambda u: -1.0 + 0 * u, u)),
    "select": _steps(lambda u: jnp.select([u < -0.5, u < 0.7], [-1.0, 0.2], 1.0), (-0.5, 0.7), (-1.0, 0.2, 1.0)),
    "piecewise": _steps(lambda u: jnp.piecewise(u, [u < 0], [-1.0, 1.0])),
    "clip and sign": Spelling(
        lambda u: jnp.sign(u) * jnp.clip(u**2, 0.0, 1.0), np.array([-1.0, 0.0, 1.0]),
        lambda u, k: (-1.0 + 0 * u, -(u**2), u**2, 1.0 + 0 * u)[k]),
    # tables
    "digitize": _steps(
        lambda u: 1.0 * jnp.digitize(u, jnp.array([-0.6, 0.1, 0.8])), (-0.6, 0.1, 0.8), (0.0, 1.0, 2.0, 3.0)),
    "searchsorted": _steps(
        lambda u: jnp.array([-1.0, 0.5, 1.0])[jnp.searchsorted(jnp.array([-0.4, 0.5]), u)],
        (-0.4, 0.5), (-1.0, 0.5, 1.0)),
    "samples": _steps(
        lambda u: lagjax.samples(jnp.array([-99.0, -0.5, 0.6, 99.0]), jnp.array([-1.0, 1.0, 0.3, 0.0]), hold="zero")(u),
        (-0.5, 0.6), (-1.0, 1.0, 0.3)),
}  # fmt: skip


class Scene(NamedTuple):
    """One motion: a function of its numbers p in lagjax that gives what is compared, and the reference for that.

    `reference` gives None for a draw that is not compared: where a level is grazed, or too near the end.
    """

    name: str
    run: Callable
    reference: Callable
    p: np.ndarray


# ---- the reference ---------------------------------------------------------------------------------------------------


def integrate(spelling: Spelling, rates: Callable, number: Callable, y0, duration: float) -> np.ndarray | None:
    """The end of ẏ = `rates(t, y, J)`, where J is the value of the spelling at u = `number(t, y)`."""
    t, y, levels = 0.0, np.array(y0, float), np.r_[-np.inf, spelling.levels, np.inf]
    k = int(np.searchsorted(spelling.levels, number(t, y)))
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    for _ in range(200):

        def field(t, y, k=k):
            return rates(t, y, spelling.form(number(t, y), k))

        ends = []
        for level, direction in ((levels[k], -1), (levels[k + 1], 1)):
            if np.isfinite(level):
                ends.append(lambda t, y, level=level: number(t, y) - level)
                ends[-1].terminal, ends[-1].direction = True, direction
        done = solve_ivp(field, (t, duration), y, events=ends or None, **options)
        t, y = float(done.t[-1]), done.y[:, -1]
        if done.status == 0:
            return y
        after = number(t + 1e-6, y + 1e-6 * np.array(field(t, y))) - number(t, y)
        if abs(after) < SLOWEST * 1e-6 or duration - t < NEAREST:
            return None
        k += int(np.sign(after))
        beyond = number(t + 1e-6, y + 1e-6 * np.array(field(t, y, k))) - number(t, y)
        if abs(beyond) < SLOWEST * 1e-6 or beyond * after < 0:  # the motion would slide, or be thrown back
            return None
    return None


def sign_changes(spelling: Spelling, number: Callable, offset: float, duration: float, count: int):
    """The first times at which the value of the spelling at u(t), less the offset, changes its sign."""
    ts, found = np.linspace(0.0, duration, 4001), []
    us, levels = np.array([number(t) for t in ts]), spelling.levels
    edges = [ts[0]]
    for i in range(len(ts) - 1):
        low, high = sorted((us[i], us[i + 1]))
        for level in levels[(levels > low) & (levels <= high)]:
            at = brentq(lambda t, level=level: number(t) - level, ts[i], ts[i + 1], xtol=1e-15)
            if abs(number(at + 1e-6) - number(at - 1e-6)) < 2e-6 * SLOWEST:
                return None
            edges.append(at)
    edges = [*edges, ts[-1]]

    def value(t, k):
        return float(spelling.form(number(t), k)) - offset

    before = None
    for start, end in itertools.pairwise(edges):
        if end - start < NEAREST:
            return None
        k = int(np.searchsorted(levels, number(0.5 * (start + end))))
        first = value(start, k)
        if before is not None and abs(before) > 1e-9 and abs(first) > 1e-9 and before * first < 0:
            found.append(start)
        if min(abs(first), abs(value(end, k))) < 0.02:
            return None
        inside = np.linspace(start, end, 400)
        values = np.array([value(t, k) for t in inside])
        for i in np.flatnonzero(values[:-1] * values[1:] < 0):
            found.append(brentq(lambda t, k=k: value(t, k), inside[i], inside[i + 1], xtol=1e-15))
        if np.abs(np.diff(np.sign(values))).sum() == 0 and np.abs(values).min() < 0.01 and np.ptp(values) > 0:
            return None
        before = value(end, k)
    found = np.array(found)
    if len(found) < count or np.diff(np.r_[0.0, found, duration]).min() < NEAREST:
        return None
    return found[:count]


# ---- kinds: what jumps -----------------------------------------------------------------------------------------------

DURATION = 6.0


def _simulated(scene: lagjax.System, q, v, p, **options):
    return lagjax.simulate(scene, q, v, jnp.array([0.0, DURATION], q.dtype), p, **options)


@functools.cache
def by_place(spelling: Spelling) -> tuple[Callable, Callable]:
    """q̈ = −q + a J(b q + c) from (q, v): the end."""
    scene = lagjax.System(
        lambda q, v: 0.5 * v**2 - 0.5 * q**2,
        forces=lambda q, v, params: params[0] * spelling.function(params[1] * q + params[2]),
    )

    def reference(p):
        end = integrate(
            spelling, lambda t, y, J: [y[1], -y[0] + p[0] * J], lambda t, y: p[1] * y[0] + p[2], p[3:], DURATION
        )
        return None if end is None else end[:1]

    return lambda p: _simulated(scene, p[3], p[4], p[:3]).q[-1:], reference


@functools.cache
def by_time(spelling: Spelling) -> tuple[Callable, Callable]:
    """q̈ = −q + a J(b t + c): the end."""
    scene = lagjax.System(
        lambda q, v: 0.5 * v**2 - 0.5 * q**2,
        forces=lambda q, v, t, params: (
            params[0] * spelling.function(params[1] * t + params[2] - 3 * params[1]) + 0.0 * q
        ),
    )

    def reference(p):
        end = integrate(
            spelling, lambda t, y, J: [y[1], -y[0] + p[0] * J], lambda t, y: p[1] * (t - 3) + p[2], p[3:], DURATION
        )
        return None if end is None else end[:1]

    return lambda p: _simulated(scene, p[3], p[4], p[:3]).q[-1:], reference


ANGLES = (lambda q: jnp.arctan2(q[1], q[0]), lambda q: jnp.angle(q[0] + 1j * q[1]))


@functools.cache
def by_angle(spelling: Spelling) -> tuple[Callable, Callable]:
    """A particle on a spring, driven round by a J(b θ + c) of its angle θ, and braked: the end."""
    angle = ANGLES[list(SPELLINGS.values()).index(spelling) % len(ANGLES)]

    def force(q, v, params):
        J = spelling.function(params[1] * angle(q) + params[2])
        return params[0] * J * jnp.array([-q[1], q[0]]) - 0.1 * v

    scene = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q @ q, forces=force)

    def reference(p):
        def rates(t, y, J):
            x, z, vx, vz = y[:4]
            along = p[0] * J
            return [vx, vz, -x - along * z - 0.1 * vx, -z + along * x - 0.1 * vz, (x * vz - z * vx) / (x * x + z * z)]

        y0 = [1.0, 0.3, p[3], 1.0 + p[4], np.arctan2(0.3, 1.0)]
        end = integrate(_Wrapped(spelling, p[1], p[2]), rates, lambda t, y: y[4], y0, DURATION)
        return None if end is None else end[:1]

    def run(p):
        q, v = jnp.array([1.0, 0.3], p.dtype), jnp.stack([p[3], 1 + p[4]])
        return _simulated(scene, q, v, p[:3]).q[-1, :1]

    return run, reference


class _Wrapped:
    """The spelling at b θ + c, with θ wrapped into half a turn to both sides, as a spelling of the lifted angle."""

    def __init__(self, spelling: Spelling, b: float, c: float):
        inner = [
            turn * 2 * PI + (level - c) / b
            for turn in range(-6, 7)
            for level in spelling.levels
            if abs((level - c) / b) < PI
        ]
        self.levels = np.sort([*((turn - 0.5) * 2 * PI for turn in range(-6, 8)), *inner])
        self.spelling, self.b, self.c = spelling, b, c
        self.middles = 0.5 * (np.r_[self.levels[0] - 1, self.levels] + np.r_[self.levels, self.levels[-1] + 1])

    def form(self, u, k):
        """The value on piece k."""
        turn = np.round(self.middles[k] / (2 * PI))
        inner = np.searchsorted(self.spelling.levels, self.b * (self.middles[k] - 2 * PI * turn) + self.c)
        return self.spelling.form(self.b * (u - 2 * PI * turn) + self.c, int(inner))


@functools.cache
def as_section(spelling: Spelling) -> tuple[Callable, Callable]:
    """The first two crossings of J(b q + c) − a along q̈ = −q."""
    scene = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2)

    def section(q, v, params):
        return spelling.function(params[1] * q + params[2]) - params[0]

    def run(p):
        found = lagjax.crossings(scene, section, p[3], p[4], (0.0, DURATION), p[:3])
        return jnp.concatenate([found.t[:2], found.q[1:2]])

    def reference(p):
        def place(t):
            return p[3] * np.cos(t) + p[4] * np.sin(t)

        found = sign_changes(spelling, lambda t: p[1] * place(t) + p[2], p[0], DURATION, 2)
        return None if found is None else np.r_[found, place(found[1])]

    return run, reference


@functools.cache
def as_event(spelling: Spelling) -> tuple[Callable, Callable]:
    """Where a motion along q̈ = −q ends by the event J(b q + c) − a."""
    scene = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2)

    def event(q, v, params):
        return spelling.function(params[1] * q + params[2]) - params[0]

    def run(p):
        end = _simulated(scene, p[3], p[4], p[:3], event=event).end
        return jnp.stack([end.t, end.qdot])

    def reference(p):
        def number(t):
            return p[1] * (p[3] * np.cos(t) + p[4] * np.sin(t)) + p[2]

        found = sign_changes(spelling, number, p[0], DURATION, 1)
        return None if found is None else np.r_[found, p[4] * np.cos(found[0]) - p[3] * np.sin(found[0])]

    return run, reference


KINDS: dict[str, Callable] = {
    "force by place": by_place, "force by time": by_time, "force by angle": by_angle, "section": as_section,
    "event": as_event,
}  # fmt: skip


# ---- both ------------------------------------------------------------------------------------------------------------


def draw(seed: int, spellings: list[str], kinds: list[str]) -> tuple[Scene, np.ndarray] | None:
    """A scene, and what is right; None where no draw of the spelling and the kind is compared."""
    kind = kinds[seed % len(kinds)]
    name = spellings[(seed // len(kinds)) % len(spellings)]
    run, reference = KINDS[kind](SPELLINGS[name])
    rng = np.random.default_rng(seed)
    for _ in range(60):
        p = np.array(
            [rng.uniform(-0.8, 0.8), rng.uniform(0.7, 3.0), rng.uniform(-0.6, 0.6), *rng.uniform(-2.0, 2.0, 2)]
        )
        p = np.float32(p).astype(float)
        right = reference(p)
        if right is not None:
            return Scene(f"{kind}: {name}", run, reference, p), right
    return None


def differences(scene: Scene) -> np.ndarray | None:
    """The derivatives of what is right by p, as differences."""
    columns = []
    for i in range(len(scene.p)):
        moved = [scene.reference(scene.p + sign * SHIFT * np.eye(len(scene.p))[i]) for sign in (1, -1)]
        if any(x is None for x in moved):
            return None
        columns.append((moved[0] - moved[1]) / (2 * SHIFT))
    return np.stack(columns, -1)


def compare(scene: Scene, right: np.ndarray, slopes: np.ndarray, single: bool) -> tuple[str, Any]:
    """ "right", "wrong value", "wrong gradient", or how lagjax names it; and the errors, or the sentence."""
    p, done = jnp.asarray(scene.p, jnp.float32 if single else jnp.float64), []
    for what, function in (("", scene.run), ("gradient ", jax.jacrev(scene.run))):
        try:
            done.append(np.asarray(function(p), float))
        except lagjax.SimulationError as reason:
            return f"{what}named", str(reason)[:160]
        except Exception as reason:
            return f"{what}broken", repr(reason)[:300]
    value, gradient = done
    of_value, of_gradient = TOLERANCES[single]
    error = np.abs(value - right).max() / (1 + np.abs(right).max())
    if not error <= of_value:
        return "wrong value", (value, right)
    error = np.abs(gradient - slopes).max() / (1 + np.abs(slopes).max())
    if np.isnan(error):
        return "gradient nan", (gradient, slopes)
    return ("right", error) if error <= of_gradient else ("wrong gradient", (gradient, slopes))


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare so many scenes, print those that are not right, and count them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.jump_population", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first one")
    parser.add_argument("--spellings", nargs="*", default=list(SPELLINGS))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    _singles.add_option(parser)
    options = parser.parse_args(arguments)
    _singles.precision_of(options)
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    counts: collections.Counter = collections.Counter()
    for seed in range(options.first, options.first + options.scenes):
        drawn = draw(seed, options.spellings, options.kinds)
        slopes = None if drawn is None else differences(drawn[0])
        if drawn is None or slopes is None:
            counts["not compared"] += 1
            continue
        scene, right = drawn
        name, what = compare(scene, right, slopes, options.float32)
        counts[name] += 1
        if name != "right":
            print(f"{seed} {name}: {scene.name}, p = {scene.p.tolist()}: {what}", flush=True)
    print(f"{dict(counts)}", file=sys.stderr)
    return counts


if __name__ == "__main__":
    main()
