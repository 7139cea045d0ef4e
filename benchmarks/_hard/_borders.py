"""Forces with corners and jumps: walls, dry friction, play, relays and pulses, over long times.

Every case is solved in closed form between its borders; where a border is met is a root of that, to the last digits of
doubles. The remark has the error at four tolerances, with the steps that it took.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import lagjax
from benchmarks._hard._case import MAX_STEPS, Experiment, Found, timed
from lagjax import scenes

TOLERANCES = (1e-4, 1e-7, 1e-10, 1e-13)


def mass(force) -> lagjax.System:
    """A unit mass on a line."""
    return lagjax.System(lambda q, v: 0.5 * v * v, forces=force)


def followed(scene: lagjax.System, q0: float, v0: float, ts: np.ndarray, exact: np.ndarray) -> Found:
    """The error at the tightest tolerance; `exact` (T, 2) are the states at ts[1:]."""
    ts, lines, found = np.concatenate([[0.0], ts]), [], None
    for rtol in TOLERANCES:

        def run(ts, rtol=rtol):
            return lagjax.simulate(scene, q0, v0, ts, rtol=rtol, max_steps=MAX_STEPS, throw=False)

        run(1e-3 * ts)  # compiles
        seconds, motion = timed(lambda run=run: run(ts))
        states = np.stack([motion.q[1:], motion.qdot[1:]], axis=1)
        error, steps = float(np.abs(states - exact).max()), int(motion.stats["num_steps"])
        lines.append(f"{rtol:.0e}: {error:.1e} in {steps} steps")
        found = Found(error if np.isfinite(error) else np.inf, None, steps, seconds)
    assert found is not None
    return found._replace(remark="; ".join(lines))


def first_root(f: Callable, begin: float, step: float, longest: float) -> float | None:
    """The first zero of f beyond `begin`, where it has the sign that it has a little later; `step` passes over none."""
    a = begin + 0.1 * step
    before, b = f(a), a
    while b < begin + longest:
        b = a + step
        if f(b) * before <= 0:
            return brentq(f, a, b, xtol=1e-300, rtol=1e-15)
        a = b
    return None


# ---- walls -----------------------------------------------------------------------------------------------------------

STIFF = 1e8


def stiff_walls(short: bool) -> Found:
    """Flights of the length 2 with v = 1 between springs of 1e8: half sines of 1e-4 depth."""
    half, w = 2.0 + np.pi / np.sqrt(STIFF), np.sqrt(STIFF)

    def state(t):
        n, s = divmod(t + 1.0, half)
        side = (-1) ** int(n)
        if s < 2.0:
            return side * (s - 1.0), side
        return side * (1.0 + np.sin(w * (s - 2.0)) / w), side * np.cos(w * (s - 2.0))

    ts = np.linspace(0.0, 20.0 if short else 2000.0, 8)[1:]
    # The state is as exact as the time of the last contact: velocities there change by their size in 1e-4.
    scene = mass(lambda q, v: -STIFF * jnp.sign(q) * jnp.maximum(jnp.abs(q) - 1.0, 0.0))
    return followed(scene, 0.0, 1.0, ts, np.array([state(t) for t in ts]))


def hard_walls(short: bool) -> Found:
    """The same between walls: transitions that turn the velocity."""
    T = 20.3 if short else 500.3
    flight = mass(lambda q, v: 0.0 * q)
    walls = [
        lagjax.Transition("flight", "flight", guard=lambda q, v: 1.0 - q, direction=-1, reset=lambda q, v: (q, -v)),
        lagjax.Transition("flight", "flight", guard=lambda q, v: 1.0 + q, direction=-1, reset=lambda q, v: (q, -v)),
    ]
    ts = np.array([0.0, T])
    seconds, run = timed(
        lambda: lagjax.simulate(lagjax.Hybrid({"flight": flight}, walls, "flight"), 0.0, 1.0, ts, max_transitions=1000)
    )
    n, s = divmod(T + 1.0, 2.0)
    side = (-1) ** int(n)
    error = max(abs(float(run.q[-1]) - side * (s - 1.0)), abs(float(run.qdot[-1]) - side))
    return Found(error, None, None, seconds, f"{int(run.transitions.count)} bounces")


# ---- dry friction ----------------------------------------------------------------------------------------------------

BELT, STATIC, WEAKENING = 0.5, 1.0, 0.3


def _friction_of_belt(q, v):
    slip = v - BELT
    return -q - STATIC * jnp.sign(slip) + WEAKENING * slip


def belt(short: bool) -> Found:
    """A block on a moving belt, whose friction falls with the speed: it sticks, and slips, for ever."""

    # From where it begins to slip, (1, 0.5): q" − c q' + q = 1 − c 0.5, a growing spiral.
    rate, w = WEAKENING / 2, np.sqrt(1 - WEAKENING**2 / 4)
    centre = STATIC - WEAKENING * BELT
    a = STATIC - centre
    b = (BELT - rate * a) / w

    def slipping(s):
        c, d, grown = np.cos(w * s), np.sin(w * s), np.exp(rate * s)
        q = a * c + b * d
        return centre + grown * q, grown * (rate * q + w * (b * c - a * d))

    slip = first_root(lambda s: slipping(s)[1] - BELT, 0.0, 0.01, 20.0)
    assert slip is not None
    lands = slipping(slip)[0]
    period = slip + (STATIC - lands) / BELT

    def state(t):
        s = t % period
        return slipping(s) if s < slip else (lands + BELT * (s - slip), BELT)

    periods = 3 if short else 300
    ts = period * np.array([0.3, 0.97, 1.5, periods - 0.7, periods - 0.02])
    return followed(mass(_friction_of_belt), STATIC, BELT, ts, np.array([state(t) for t in ts]))


SHAKEN, GRIP = 2.0, 1.2


def _friction_of_table(q, v, t):
    return -GRIP * jnp.sign(v + SHAKEN * jnp.cos(t))


def table(short: bool) -> Found:
    """A block on a table that is shaken with the acceleration 2 sin t, with friction of 1.2: it sticks and slips."""

    def under(t):  # the velocity of the table
        return -SHAKEN * np.cos(t)

    T, t, q, v, pieces = (10.0 if short else 1000.0), 0.0, 0.0, -SHAKEN, []
    while t < T + 10:
        # It sticks from t on, or goes on to slip at once.
        hold = abs(SHAKEN * np.sin(t)) <= GRIP
        if hold:
            leaves = first_root(lambda s: abs(SHAKEN * np.sin(s)) - GRIP, t, 0.01, 10.0)
            assert leaves is not None
            pieces.append((t, leaves, "sticks", q, v))
            q, t = q - SHAKEN * (np.sin(leaves) - np.sin(t)), leaves
            v = under(t)
        a = GRIP * np.sign(SHAKEN * np.sin(t))
        catches = first_root(lambda s, t=t, v=v, a=a: v + a * (s - t) - under(s), t, 0.001, 20.0)
        assert catches is not None
        pieces.append((t, catches, a, q, v))
        s = catches - t
        q, v, t = q + v * s + a * s * s / 2, v + a * s, catches

    def state(t):
        begin, _, a, q, v = next(piece for piece in pieces if piece[1] >= t)
        if a == "sticks":
            return q - SHAKEN * (np.sin(t) - np.sin(begin)), under(t)
        return q + v * (t - begin) + a * (t - begin) ** 2 / 2, v + a * (t - begin)

    ts = np.linspace(0.0, T, 8)[1:]
    return followed(mass(_friction_of_table), 0.0, -SHAKEN, ts, np.array([state(t) for t in ts]))


# ---- play, relays, pulses --------------------------------------------------------------------------------------------

PLAY, GEAR, DRIVE = 0.2, 50.0, 1.3


def _force_of_shaft(q, v, t):
    apart = q - jnp.sin(DRIVE * t)
    return -GEAR * (apart - jnp.clip(apart, -PLAY, PLAY)) - 0.4 * v


def backlash(short: bool) -> Found:
    """A load that a shaft drives by a spring with play: it is free in between, and hit from both sides."""

    w, damped = np.sqrt(GEAR - 0.04), 0.2

    def contact(side):
        # q" + 0.4 q' + k q = k (sin Ωt + side · play): the steady part is Im(X exp(iΩt)).
        steady = GEAR / (GEAR - DRIVE**2 + 0.4j * DRIVE)

        def at(begin, q, v, t):
            def part(t):
                x = steady * np.exp(1j * DRIVE * t)
                return x.imag + side * PLAY, (1j * DRIVE * x).imag

            (p, r), s = part(begin), t - begin
            a = q - p
            b = (v - r + damped * a) / w
            c, d, grown = np.cos(w * s), np.sin(w * s), np.exp(-damped * s)
            own = a * c + b * d
            p, r = part(t)
            return p + grown * own, r + grown * (-damped * own + w * (b * c - a * d))

        return at

    def free(begin, q, v, t):
        s = t - begin
        return q - v * np.expm1(-0.4 * s) / 0.4, v * np.exp(-0.4 * s)

    T, t, q, v, side, pieces = (10.0 if short else 40.0), 0.0, 0.0, 0.5, 0, []
    laws = {0: free, 1: contact(1), -1: contact(-1)}
    while t < T:
        law = laws[side]

        def apart(s, law=law, t=t, q=q, v=v):
            return law(t, q, v, s)[0] - np.sin(DRIVE * s)

        if side:
            end = first_root(lambda s, apart=apart, side=side: apart(s) - side * PLAY, t, 0.002, 100.0)
        else:
            ends = [first_root(lambda s, apart=apart, k=k: apart(s) - k * PLAY, t, 0.002, 100.0) for k in (1, -1)]
            end = min(x for x in ends if x is not None)
        assert end is not None
        pieces.append((t, end, law, q, v))
        (q, v), t = law(t, q, v, end), end
        side = 0 if side else int(np.sign(q - np.sin(DRIVE * t)))

    def state(t):
        begin, _, law, q, v = next(piece for piece in pieces if piece[1] >= t)
        return law(begin, q, v, t)

    ts = np.linspace(0.0, T, 8)[1:]
    return followed(mass(_force_of_shaft), 0.0, 0.5, ts, np.array([state(t) for t in ts]))


def relay(short: bool) -> Found:
    """A mass that a relay with hysteresis drives to and fro: force −1 from q = 1 on, +1 from q = −1 on; two modes."""
    modes = {"up": mass(lambda q, v: 1.0 - v), "down": mass(lambda q, v: -1.0 - v)}
    switches = [
        lagjax.Transition("up", "down", guard=lambda q, v: q - 1.0, direction=1),
        lagjax.Transition("down", "up", guard=lambda q, v: q + 1.0, direction=-1),
    ]

    def along(q, v, s):  # of q" = 1 − q'
        return q + s + (v - 1.0) * -np.expm1(-s), 1.0 + (v - 1.0) * np.exp(-s)

    # By symmetry half a period takes (−1, −v) to (1, v).
    def other_end(v):
        s = brentq(lambda s: along(-1.0, -v, s)[0] - 1.0, 1.0, 20.0, xtol=1e-300, rtol=1e-15)
        return s, along(-1.0, -v, s)[1]

    v = brentq(lambda v: other_end(v)[1] - v, 0.1, 1.0, xtol=1e-300, rtol=1e-15)
    half = other_end(v)[0]
    cycles = 3 if short else 100
    ts = np.array([0.0, (2 * cycles + 0.4) * half])
    seconds, run = timed(
        lambda: lagjax.simulate(
            lagjax.Hybrid(modes, switches, "up"), -1.0 + 1e-300, -v, ts, rtol=1e-13, max_transitions=300
        )
    )
    exact = along(-1.0, -v, 0.4 * half)
    error = max(abs(float(run.q[-1]) - exact[0]), abs(float(run.qdot[-1]) - exact[1]))
    return Found(error, None, None, seconds, f"{int(run.transitions.count)} switches")


def motor(short: bool) -> Found:
    """A motor on pulses of duty 0.2 and period 0.01 comes to its steady speed, over 10⁵ periods."""
    scene = mass(lambda q, v, t: jnp.where(jnp.mod(t, 0.01) < 0.002, 1.0, 0.0) - v)
    per = (1 - np.exp(-0.002)) * np.exp(-0.008)

    def state(t):
        n = round(t / 0.01)
        v = per * -np.expm1(-0.01 * n) / -np.expm1(-0.01)
        return 0.002 * n - v, v  # q + v gains the impulse

    ts = np.array([0.01, 1.0, 5.0, 10.0 if short else 1000.0])
    return followed(scene, 0.0, 0.0, ts, np.array([state(t) for t in ts]))


def portrait(force: Callable, q0: float, v0: float) -> Callable:
    """What a figure draws: the scene of a force, from its start."""
    return lambda: scenes.Scene(mass(force), None, q0, v0, 1.0, {})


def valley(q, v):
    """V = |q| with dry friction: swings become shorter and shorter, until the motion rests in the corner."""
    return -jnp.sign(q) - 0.1 * jnp.sign(v)


PORTRAITS = {
    "Stick–slip": (portrait(_friction_of_belt, 0.2, 0.0), 40.0),
    "Block": (portrait(_friction_of_table, 0.0, -SHAKEN), 20.0),
    "Play": (portrait(_force_of_shaft, 0.0, 0.5), 40.0),
    "Walls": (
        portrait(lambda q, v: -400.0 * jnp.sign(q) * jnp.maximum(jnp.abs(q) - 1.0, 0.0) - 0.02 * v, 0.0, 9.0),
        40.0,
    ),
    "Corner": (portrait(valley, 1.0, 0.0), 30.0),
}


def rest(short: bool) -> Found:
    """A mass in V = |q| with dry friction comes to rest in the corner after bounces without end, and is pulled off."""
    ratio = 0.9 / 1.1
    whole = np.sqrt(2 / 0.9) * (1 + ratio) / (1 - np.sqrt(ratio))
    ts = whole * np.array([1.001, 1.1, 2.0])
    return followed(mass(valley), 1.0, 0.0, ts, np.zeros((3, 2)))


def _case(name: str, bound: float, because: str, run: Callable) -> Experiment:
    return Experiment(name, "closed forms between borders", 1e-15, bound, because, run)


CASES = (
    _case(
        "Walls of stiffness 10⁸ (1000 bounces)", 1e-5,
        "velocities change within 1e-4, and 2000 contacts each add the rounding of a time", stiff_walls,
    ),
    _case("Hard walls (250 bounces)", 1e-11, "flights are straight", hard_walls),
    _case("Stick–slip on a belt (300 cycles)", 1e-9, "each time it sticks all that was before is forgotten", belt),
    _case("Block on a shaken table", 1e-9, "each time it sticks its velocity is forgotten", table),
    _case("Corner at rest", 1e-12, "its swings become shorter than any number", rest),
    _case("Play, driven from both sides", 1e-6, "small errors grow from hit to hit", backlash),
    _case("Relay with hysteresis (100 cycles)", 1e-10, "the cycle is attractive, but for its phase", relay),
    _case("Motor on 10⁵ pulses", 1e-8, "every pulse begins and ends at a time that is known to its rounding", motor),
)  # fmt: skip
