"""Forty scenes in eight systems of units, through the public functions: does any verdict, or any digit, change?

    python -m benchmarks.units
    python -m benchmarks.units --scenes kepler pendulum --functions simulate equilibrium --verbose

The law: with q = λ q′, t = τ t′ and L = ε L′ all motions are the same but for their units. Every scene is written once,
with λ, τ and ε among its parameters, so that one program serves all systems. What a function returns is divided by its
units and compared with what it returns for λ = τ = ε = 1: words, names, flags and counts must be equal, numbers equal
to the tolerance of the method. All coordinates are measured in λ, angles too: what a number is called does not matter.
"""

import argparse
import collections
import re
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

PyTree = Any

# λ, τ, ε: one at a time by powers of two, which round nothing; then atoms and planets in metres, seconds, kilograms.
# A unit of time of 1e-14 would be too short for series of order twenty, whose last terms are no doubles any more.
FAR = 2.0**40
SYSTEMS = {
    "1": (1.0, 1.0, 1.0),
    "short": (1 / FAR, 1.0, 1.0),
    "long": (FAR, 1.0, 1.0),
    "fast": (1.0, 1 / FAR, 1.0),
    "slow": (1.0, FAR, 1.0),
    "light": (1.0, 1.0, 1 / FAR),
    "heavy": (1.0, 1.0, FAR),
    "atoms": (1e-10, 1e-12, 1e-22),
    "planets": (1.5e11, 5e6, 1e39),
}


class Units(NamedTuple):
    """A system of units, and what numbers of a scene are in it."""

    length: float
    time: float
    energy: float

    def state(self, q: PyTree, qdot: PyTree) -> tuple[PyTree, PyTree]:
        """A state of the scene as written, in these units."""
        speed = self.length / self.time
        return jax.tree.map(lambda x: self.length * jnp.asarray(x, float), q), jax.tree.map(
            lambda x: speed * jnp.asarray(x, float), qdot
        )


class Case(NamedTuple):
    """A scene that takes its units as parameters, a start and a duration in units of one."""

    name: str
    system: lagjax.System
    params: PyTree
    q: PyTree
    qdot: PyTree
    duration: float

    def in_units(self, units: Units) -> tuple[PyTree, PyTree, PyTree]:
        """(q, qdot, params) in a system of units."""
        return *units.state(self.q, self.qdot), {"of": self.params, "unit": units._asdict()}


def with_units(scene: lagjax.scenes.Scene, name: str) -> Case:
    """A scene with λ, τ and ε among its parameters."""

    def old(q, qdot, t, params):
        u = params["unit"]
        place, rate = 1 / u["length"], u["time"] / u["length"]
        there = jax.tree.map(lambda x: place * x, q), jax.tree.map(lambda x: rate * x, qdot)
        return there, {"t": t / u["time"], "params": params["of"]}, u

    def of_role(function, factor: Callable, roles: int = 2):
        if function is None:
            return None

        def changed(q, qdot, t, params):
            (place, rate), more, u = old(q, qdot, t, params)
            value = function(place, rate, **more) if roles == 2 else function(place, **more)
            return jax.tree.map(lambda x: factor(u) * x, value)

        timed = "t" in function.extras
        if roles == 1:
            return (
                (lambda q, t, params: changed(q, q, t, params))
                if timed
                else lambda q, params: changed(q, q, 0.0, params)
            )
        if timed:
            return changed
        return lambda q, qdot, params: changed(q, qdot, 0.0, params)

    system = scene.system
    units = lagjax.System(
        of_role(system.lagrangian, lambda u: u["energy"]),
        forces=of_role(system.forces, lambda u: u["energy"] / u["length"]),
        dissipation=of_role(system.dissipation, lambda u: u["energy"] / u["time"]),
        constraints=of_role(system.constraints, lambda u: 1.0, roles=1),
        velocity_constraints=of_role(system.velocity_constraints, lambda u: 1.0),
    )
    return Case(name, units, scene.params, scene.q0, scene.qdot0, float(scene.duration))


# ---- what is asked ---------------------------------------------------------------------------------------------------
#
# Each function returns words, which must be equal, and numbers in units of one, which must be equal to a tolerance.


def flat(tree: PyTree) -> np.ndarray:
    """All numbers of a pytree, end to end."""
    leaves = [np.ravel(np.asarray(x)) for x in jax.tree.leaves(tree)]
    return np.concatenate([np.zeros(0), *leaves])


def without_numbers(text: str) -> str:
    """A sentence whose numbers are left out."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text.split("\n")[0])


def simulate(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    ts = u.time * jnp.linspace(0.0, case.duration, 11)
    run = lagjax.simulate(case.system, q, qdot, ts, params, throw=False)
    health = run.health()
    words = str(run.result), *(without_numbers(x) for x in health.findings())
    return words, [flat(run.q) / u.length, flat(run.qdot) * u.time / u.length]


def batch(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    some = jnp.array([1.0, 1.0, 1.0])
    stacked = jax.tree.map(lambda x: some.reshape(-1, *[1] * jnp.ndim(x)) * x, (q, qdot))
    ts = u.time * jnp.linspace(0.0, 0.3 * case.duration, 4)
    run = lagjax.simulate_batch(case.system, *stacked, ts, params)
    return (str(run.ok.tolist()),), [flat(run.q) / u.length]


def kept(make: Callable) -> Callable:
    """`make(case)` once for each scene: what is made of other functions is compiled anew."""
    made = {}

    def of_case(case: Case):
        if case.name not in made:
            made[case.name] = make(case)
        return made[case.name]

    return of_case


@kept
def level(case: Case) -> Callable:
    """A number that is zero where the first coordinate passes some 0.6 of its first value."""
    first = jax.tree.leaves(case.q)[0]
    place = 0.6 * float(np.ravel(np.asarray(first))[0]) + 0.05

    def of_state(q, qdot, params):
        return jax.tree.leaves(q)[0].ravel()[0] / params["unit"]["length"] - place

    return of_state


@kept
def slowed(case: Case):
    """A transition that takes a tenth of the velocity at that place."""
    reset = lambda q, v: (q, jax.tree.map(lambda x: 0.9 * x, v))  # noqa: E731
    return lagjax.Transition("one", "one", level(case), reset=reset)


def crossings(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    span = 0.0, 0.97 * u.time * case.duration
    found = lagjax.crossings(case.system, level(case), q, qdot, span, params, count=64)
    count = int(found.count)
    return (str(count), str(bool(found.ok))), [flat(found.t)[:count] / u.time]


def hybrid(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    ts = u.time * jnp.linspace(0.0, 0.6 * case.duration, 4)
    run = lagjax.simulate(lagjax.Hybrid({"one": case.system}, [slowed(case)], "one"), q, qdot, ts, params, throw=False)
    count = int(run.transitions.count)
    return (str(run.result), str(count)), [flat(run.q) / u.length, flat(run.transitions.t)[:count] / u.time]


def equilibrium(case: Case, u: Units):
    q, _, params = case.in_units(u)
    found = lagjax.equilibrium(case.system, q, params)
    modes = lagjax.normal_modes(case.system, found.q, params)
    words = tuple(without_numbers(" ".join(row.split()[3:])) for row in str(modes).split("\n")[1:-1])
    return (*words, str(bool(modes.stable))), [flat(found.q) / u.length, flat(modes.exponents) * u.time]


def linearize(case: Case, u: Units):
    found = lagjax.linearize(case.system, *(case.in_units(u)[k] for k in (0, 1, 2)))
    n = len(found.A) // 2
    a = np.array(found.A)
    return (), [a[n:, :n] * u.time**2, a[n:, n:] * u.time]


def conserved_quantities(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    found = lagjax.conserved_quantities(case.system, q, qdot, params)
    return tuple(without_numbers(x) for x in str(found).split("\n")), []


@kept
def multiples(case: Case) -> tuple[lagjax.System, lagjax.System]:
    """Two scenes, of L and of 2 L."""

    def multiple(factor):
        if "t" in case.system.lagrangian.extras:
            return lambda q, qdot, t, params: factor * case.system.lagrangian(q, qdot, t=t, params=params)
        return lambda q, qdot, params: factor * case.system.lagrangian(q, qdot, params=params)

    return lagjax.System(multiple(1.0)), lagjax.System(multiple(2.0))


def same_motion(case: Case, u: Units):
    same = lagjax.same_motion(*multiples(case), *case.in_units(u))
    return (str(same.same), str(same.residual < 1e-12)), [np.array([same.factor])]


@kept
def written_otherwise(case: Case) -> tuple:
    """The scene in stretched coordinates, and its canonical form."""

    def stretched(Q, params):
        unit = params["unit"]["length"]
        return jax.tree.map(lambda x: x + 0.1 * unit * jnp.tanh(x / unit), Q)

    return lagjax.change_coordinates(case.system, stretched), lagjax.hamiltonian(case.system)


def coordinates(case: Case, u: Units):
    """Other coordinates, and momenta, each there and back."""
    q, qdot, params = case.in_units(u)
    changed, canonical = written_otherwise(case)
    new = changed.new_from_old(q, qdot, q, params=params)
    p = canonical.momentum(q, qdot, params=params)
    v = canonical.velocity(q, p, params=params)
    return (), [flat(new[0]) / u.length, flat(new[1]) * u.time / u.length, flat(v) * u.time / u.length]


def routhian(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    reduced = lagjax.routhian(case.system, q, qdot, params)
    run = reduced.simulate(q, qdot, u.time * jnp.linspace(0.0, 0.3 * case.duration, 4), params)
    return tuple(reduced.names), [flat(run.q) / u.length]


def periodic_orbit(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    energy = float(case.system.energy(q, qdot, 0.0, params))
    found = [
        lagjax.periodic_orbit(case.system, q, qdot, 1.01 * u.time * case.duration, params, energy=e, throw=False)
        for e in (None, energy)
    ]
    words = tuple(f"{bool(x.ok)} {bool(x.stable)} {without_numbers(str(x.message))}" for x in found)
    return words, [np.append(flat(x.q0) / u.length, x.period / u.time) for x in found if x.ok]


def family(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    orbit = lagjax.periodic_orbit(case.system, q, qdot, 1.01 * u.time * case.duration, params)
    along = lagjax.family(case.system, orbit, params, count=5)
    return (without_numbers(along.message), str(along.stable.tolist())), [flat(along.period) / u.time]


def lyapunov(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    duration = u.time * case.duration
    spectrum = lagjax.lyapunov_spectrum(case.system, q, qdot, duration, params)
    largest = lagjax.lyapunov_exponent(case.system, q, qdot, duration, params, rtol=1e-9)
    return (str(bool(largest.ok)),), [flat(spectrum) * u.time, flat(largest.value) * u.time]


def find_path(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    until = 0.2 * u.time * case.duration
    end = lagjax.simulate(case.system, q, qdot, jnp.array([0.0, until]), params, rtol=1e-12).end.q
    path = lagjax.find_path(case.system, q, end, 0.0, until, params)
    scale = u.energy * u.time
    words = str(path.index), str(path.minimum)
    return words, [flat(path.qdot_start) * u.time / u.length, flat(path.action) / scale, path.conjugate_times / u.time]


def check(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    found = lagjax.check(case.system, q, qdot, params=params)
    return tuple(sorted(f"{x.kind} {x.level} {x.where}" for x in found)), []


def explain(case: Case, u: Units):
    q, qdot, params = case.in_units(u)
    return tuple(str(case.system.explain(q, qdot, params=params)).split("\n")), []


def project(case: Case, u: Units):
    """A state beside the constraints put back on them; one off them refused."""
    q, qdot, params = case.in_units(u)
    off = jax.tree.map(lambda x: 1.01 * x, q)
    back = case.system.project(off, qdot, 0.0, params)
    try:
        lagjax.simulate(case.system, off, qdot, jnp.array([0.0, u.time]), params)
        words = ("accepted",)
    except ValueError as error:
        words = (without_numbers(str(error)),)
    return words, [flat(back[0]) / u.length]


def fit(case: Case, u: Units):
    """One parameter, a factor of the potential energy and of all else that is not kinetic, from a motion of its own."""
    q, qdot, params = case.in_units(u)
    ts = u.time * jnp.linspace(0.0, case.duration, 101)
    run = lagjax.simulate(case.system, q, qdot, ts, params, rtol=1e-12)
    noise = 1e-3 * jax.random.normal(jax.random.key(0), ts.shape)
    record = lagjax.Record(ts, jax.tree.map(lambda x: x + noise * u.length, run.q), start=(q, qdot))
    free = jax.tree.map(lambda _: False, params)
    name = min(params["of"])
    free["of"][name] = True
    found = lagjax.fit(case.system, record, params, free=free, transforms=lagjax.positive)
    words = str(bool(found.ok)), without_numbers(str(found.message))
    return words, [flat(found.params["of"][name])]


# The function, and up to how much its numbers may differ beside their largest. Of an orbit that is one of many the
# nearest is found; which one that is of a plane full of them, as Kepler's, is decided by singular values that are as
# small as what a trial misses by.
FUNCTIONS: dict[Callable, float] = {
    simulate: 1e-6, batch: 1e-6, crossings: 1e-7, hybrid: 1e-6, equilibrium: 1e-9, linearize: 1e-12,
    conserved_quantities: 0.0, same_motion: 1e-12, coordinates: 1e-12, routhian: 1e-6, periodic_orbit: 1e-3,
    family: 1e-6, lyapunov: 1e-5, find_path: 1e-9, check: 0.0, explain: 0.0, project: 1e-10, fit: 1e-6,
}  # fmt: skip
UNCONSTRAINED = {coordinates, routhian, periodic_orbit, family, lyapunov, find_path, same_motion}
PERIODIC = {
    "pendulum", "harmonic_oscillator", "morse_oscillator", "one_dimension", "kepler", "central_force", "figure_eight",
    "restricted_three_body", "driven_oscillator",
}  # fmt: skip
FAMILIES = {"pendulum", "morse_oscillator", "kepler", "figure_eight"}
FITTED = {"pendulum", "harmonic_oscillator", "morse_oscillator"}
# The ones with no room for eight more runs: nineteen coordinates and more, or as many rotations.
LARGE = {"solar_system", "newtonian_solar_system"}


def applies(function: Callable, case: Case) -> bool:
    """Whether the function is for this scene."""
    constrained = case.system.constraints is not None or case.system.velocity_constraints is not None
    only = {periodic_orbit: PERIODIC, family: FAMILIES, fit: FITTED}.get(function)
    if only is not None and case.name not in only:
        return False
    if function is project:
        return case.system.constraints is not None
    return not (constrained and function in UNCONSTRAINED)


def asked(function: Callable, case: Case, units: Units) -> tuple[tuple, list]:
    """What the function returns; the kind and the words of an error that it raises."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return function(case, units)
    except (ValueError, TypeError, lagjax.SimulationError) as error:
        return (type(error).__name__, without_numbers(str(error))), []


def _apart(one, two) -> float:
    """How far numbers in units of one are apart, beside the largest; what is below 1/100 there may be zero."""
    one, two = np.asarray(one), np.asarray(two)
    if one.shape != two.shape or (np.isnan(one) != np.isnan(two)).any():
        return np.inf
    off = np.where(np.isnan(one), 0.0, np.abs(one - two))
    return float(off.max(initial=0.0)) / float(np.nanmax(np.abs(one), initial=0.01))


def compare(function: Callable, case: Case, names) -> list[tuple[str, str]]:
    """For each system of units whose result differs from that in units of one, its name and how it differs."""
    words, numbers = asked(function, case, Units(*SYSTEMS["1"]))
    differences = []
    for name in names:
        other, values = asked(function, case, Units(*SYSTEMS[name]))
        if other != words:
            a, b = next(
                (x for x in zip(words + ("",) * 99, other + ("",) * 99, strict=False) if x[0] != x[1]), ("", "")
            )
            differences.append((name, f"verdict: {a[:110]!r} -> {b[:110]!r}"))
            continue
        worst = max((_apart(*pair) for pair in zip(numbers, values, strict=True)), default=0.0)
        if worst > FUNCTIONS[function]:
            differences.append((name, f"digits: {worst:.1e} (allowed {FUNCTIONS[function]:.0e})"))
    return differences


def main(arguments=None) -> int:
    """Print what differs, and a table of counts; 1 where anything does."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", nargs="*", help="names of lagjax.scenes; by default all but the solar system")
    parser.add_argument("--functions", nargs="*", help="names of functions of this file")
    parser.add_argument("--systems", nargs="*", default=[name for name in SYSTEMS if name != "1"])
    given = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    made = {f.__name__: f for f in lagjax.scenes.ALL}
    chosen = given.scenes or [name for name in made if name not in LARGE]
    functions = [f for f in FUNCTIONS if given.functions is None or f.__name__ in given.functions]
    counts, begun = collections.defaultdict(lambda: [0, 0, 0]), time.process_time()
    for name in chosen:
        case = with_units(made[name](), name)
        for function in functions:
            if not applies(function, case):
                continue
            found, of = compare(function, case, given.systems), counts[function.__name__]
            of[0] += len(given.systems)
            of[1] += sum(text.startswith("verdict") for _, text in found)
            of[2] += sum(text.startswith("digits") for _, text in found)
            for system, text in found:
                print(f"{name:38s} {function.__name__:20s} {system:8s} {text}", flush=True)
        jax.clear_caches()
    print(f"\n{'function':22s} {'asked':>6s} {'verdicts changed':>17s} {'digits lost':>12s}")
    for name, (asked_for, verdicts, digits) in counts.items():
        print(f"{name:22s} {asked_for:6d} {verdicts:17d} {digits:12d}")
    total = np.sum(list(counts.values()), axis=0)
    print(f"{'all':22s} {total[0]:6d} {total[1]:17d} {total[2]:12d}")
    print(
        f"{len(chosen)} scenes in {len(given.systems)} systems of units, {time.process_time() - begun:.0f} CPU seconds"
    )
    return int(total[1:].any())


if __name__ == "__main__":
    sys.exit(main())
