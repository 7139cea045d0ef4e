"""What JAX's runtime for CPUs costs a loop of small kernels: one double pendulum, in whatever JAX this interpreter has.

Since jaxlib 0.4.32 XLA runs a compiled loop on CPUs as a sequence of small calls ("thunks"; issues 26145 and 40150 of
jax, 615 of diffrax). This file needs nothing but jax, and measures diffrax and lagjax where they are installed:

    python benchmarks/small_kernels.py                                   # this environment
    python benchmarks/small_kernels.py --beside OLD/bin/python           # and another one, in turns: ratios
    XLA_FLAGS=--xla_cpu_use_thunk_runtime=false python benchmarks/small_kernels.py     # old runtime, jax 0.4.32 to 0.6

It prints CPU seconds of this process per motion, the least of several: of `lax.scan` over classical Runge–Kutta steps,
of its gradient by the masses, of `diffrax.diffeqsolve` with Dopri8 and of its gradient, and of `lagjax.simulate`.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp

STEPS, DURATION, ROUNDS = 2000, 10.0, 5
START = jnp.array([1.0, 1.5, 0.0, 0.0], dtype=jnp.float32)  # made float64 below
PARAMS = (1.0, 0.8)


def rates(t, y, masses):
    """The double pendulum with rods of length one, by hand: 2 × 2 solved by Cramer's rule."""
    a, b, da, db = y
    m1, m2 = masses
    m, c, s, g = m1 + m2, m2 * jnp.cos(a - b), m2 * jnp.sin(a - b), 9.81
    f1, f2 = -s * db**2 - m * g * jnp.sin(a), s * da**2 - m2 * g * jnp.sin(b)
    det = m * m2 - c**2
    return jnp.stack([da, db, (m2 * f1 - c * f2) / det, (m * f2 - c * f1) / det])


def lagrangian(q, v, params):
    (a, b), (da, db), (m1, m2) = q, v, params
    kinetic = 0.5 * (m1 + m2) * da**2 + 0.5 * m2 * db**2 + m2 * da * db * jnp.cos(a - b)
    return kinetic + 9.81 * ((m1 + m2) * jnp.cos(a) + m2 * jnp.cos(b))


def by_scan(y, masses):
    """The end by STEPS classical Runge–Kutta steps in `lax.scan`."""
    h = DURATION / STEPS

    def step(y, _):
        k1 = rates(0.0, y, masses)
        k2 = rates(0.0, y + 0.5 * h * k1, masses)
        k3 = rates(0.0, y + 0.5 * h * k2, masses)
        k4 = rates(0.0, y + h * k3, masses)
        return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

    return jax.lax.scan(step, y, None, length=STEPS)[0]


def by_diffrax(y, masses):
    """The end by Dopri8 at 1e-9."""
    import diffrax

    controller = diffrax.PIDController(rtol=1e-9, atol=1e-12)
    term, solver, save = diffrax.ODETerm(rates), diffrax.Dopri8(), diffrax.SaveAt(t1=True)
    return diffrax.diffeqsolve(
        term, solver, 0.0, DURATION, None, y, masses, saveat=save, stepsize_controller=controller, max_steps=1024
    ).ys[0]


def by_lagjax(y, masses):
    """The end by `lagjax.simulate`, Taylor series at 1e-9."""
    import lagjax

    end = lagjax.simulate(by_lagjax.system, y[:2], y[2:], jnp.array([0.0, DURATION]), masses).end
    return jnp.concatenate([end.q, end.qdot])


def measured() -> dict[str, float]:
    """CPU milliseconds of each way in this process, and where the first one ends."""
    ways = {"scan": by_scan}
    if importlib.util.find_spec("diffrax"):
        ways["diffrax"] = by_diffrax
    if importlib.util.find_spec("lagjax"):
        import lagjax

        by_lagjax.system = lagjax.System(lagrangian)
        ways["lagjax"] = by_lagjax
    y, masses = START.astype(float), tuple(map(jnp.asarray, PARAMS))
    runs = {name: jax.jit(way) for name, way in ways.items()}
    for name, way in ways.items():
        runs[f"{name}, gradient"] = jax.jit(jax.grad(lambda masses, y, way=way: way(y, masses)[0]))
    result = {}
    for name, run in runs.items():
        arguments = (masses, y) if "gradient" in name else (y, masses)
        jax.block_until_ready(run(*arguments))
        least = min(_cpu_time(run, arguments) for _ in range(ROUNDS))
        result[name] = 1e3 * least
    ends = {name: run(y, masses) for name, run in runs.items() if "gradient" not in name}
    result["ends apart"] = max(float(abs(end - ends["scan"]).max()) for end in ends.values())
    return result


def _cpu_time(run, arguments) -> float:
    began, count = time.process_time(), 0
    while time.process_time() - began < 0.2:
        jax.block_until_ready(run(*arguments))
        count += 1
    return (time.process_time() - began) / count


def elsewhere(interpreter: str) -> dict[str, float]:
    """The same by another interpreter, without what this one has in front of its path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [interpreter, __file__, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beside", help="another interpreter, whose JAX is measured in turns with this one")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="one line for the caller")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    if options.json:
        print(json.dumps({"jax": jax.__version__, **measured()}))
        return
    if options.beside is None:
        for name, value in measured().items():
            print(f"{name:<20}{value:>10.3g}" + ("" if name == "ends apart" else " ms"))
        return
    pairs = [(elsewhere(sys.executable), elsewhere(options.beside)) for _ in range(options.turns)]
    table(pairs)


def table(pairs: list[tuple[dict, dict]]):
    """Prints the least of all turns, and the ratios of these."""
    here, there = pairs[0]
    print(f"{'CPU ms a motion':<20}{'jax ' + here['jax']:>12}{'jax ' + there['jax']:>12}{'ratio':>8}")
    for name in here:
        if name in ("jax", "ends apart"):
            continue
        mine = min(pair[0][name] for pair in pairs)
        row = f"{name:<20}{mine:>12.3f}"
        if name in there:
            theirs = min(pair[1][name] for pair in pairs)
            row += f"{theirs:>12.3f}{mine / theirs:>8.2f}"
        print(row)


if __name__ == "__main__":
    main()
