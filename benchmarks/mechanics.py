"""The equations of robots, one state at a time: what accelerations, their Jacobians and linearizations cost.

    python -m benchmarks.mechanics --write       # benchmarks/results/mechanics.json; LAGJAX_CACHE=off keeps nothing

An arm with eight joints (`examples/robot_arm.urdf`), and a floating base on six legs: 24 coordinates. Inertias are
parameters. CPU seconds; `first` with all compilation, `twenty` are the first twenty calls together. Where pinocchio and
casadi are installed (`pip install pin casadi`) they take the same states, called from Python; CasADi's functions are C
by `cc -O2`, for their own inertias. Errors are those from pinocchio or, without it, from L by JAX's own derivatives.
"""

import argparse
import contextlib
import importlib.util
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report
from examples import robot

STORE = Path(__file__).parent / "results" / "mechanics.json"
CALLS, STEPS, MEMBERS = 2000, 1000, 4096


def legs(count: int = 6) -> str:
    """A base with three slides and three turns, and legs of three joints at its rim, as URDF."""
    limit = '<limit lower="-9" upper="9" effort="9" velocity="9"/>'  # which pinocchio asks of slides
    inertia = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.015"/>'

    def link(name: str, mass: float) -> str:
        body = f'<inertial><origin xyz="0.02 0.01 -0.1"/><mass value="{mass}"/>{inertia}</inertial>' if mass else ""
        return f'<link name="{name}">{body}</link>'

    def joint(kind: str, parent: str, child: str, axis: str, place: str = "0 0 0") -> str:
        return (
            f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{place}"/><axis xyz="{axis}"/>{limit}</joint>'
        )

    parts, carrier = [link("ground", 0.0)], "ground"
    for i, (kind, axis) in enumerate((k, a) for k in ("prismatic", "continuous") for a in ("1 0 0", "0 1 0", "0 0 1")):
        parts += [link(f"base{i}", 8.0 if i == 5 else 0.0), joint(kind, carrier, f"base{i}", axis)]
        carrier = f"base{i}"
    for leg, angle in enumerate(2 * np.pi * np.arange(count) / count):
        upper, place = carrier, f"{0.3 * np.cos(angle)} {0.3 * np.sin(angle)} 0"
        for k, axis in enumerate(("0 0 1", "0 1 0", "0 1 0")):
            parts += [link(f"leg{leg}{k}", 0.7), joint("continuous", upper, f"leg{leg}{k}", axis, place)]
            upper, place = f"leg{leg}{k}", "0.05 0 -0.2"
    return f'<robot name="legs">{"".join(parts)}</robot>'


def spend(call: Callable, count: int = 1) -> float:
    """CPU seconds of a call."""
    begun = time.process_time()
    for _ in range(count):
        jax.block_until_ready(call())
    return (time.process_time() - begun) / count


def measure(source: str | Path) -> Iterator[dict[str, Any]]:
    """A row for each quantity."""
    of = robot.read(source)
    scene, params, n = robot.system(of), robot.parameters(of), len(of.moving)
    q, v, a = jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (3, n)))

    def acceleration(q, v):
        return scene.acceleration(q, v, params=params)

    def slopes(jacobian):
        return jax.jit(lambda q, v: jacobian(acceleration, (0, 1))(q, v))

    def walk(q, v):
        step = lambda state, _: ((state[0] + 1e-3 * state[1], state[1] + 1e-3 * acceleration(*state)), None)  # noqa: E731
        return jax.lax.scan(step, (q, v), None, length=STEPS)[0]

    right = reference(of, source, q, v, params)
    calls = {
        "acceleration": (jax.jit(acceleration), 1), "Jacobian, forward": (slopes(jax.jacfwd), 1),
        "Jacobian, reverse": (slopes(jax.jacrev), 1), "acceleration within scan": (jax.jit(walk), STEPS),
        f"acceleration of {MEMBERS}": (
            jax.jit(lambda q, v: jax.vmap(acceleration)(jnp.tile(q, (MEMBERS, 1)), jnp.tile(v, (MEMBERS, 1)))), MEMBERS
        ),
        "inverse dynamics": (jax.jit(lambda q, v: lagjax.inverse_dynamics(scene, q, v, a, params=params)), 1),
        "linearize": (lambda q, v: lagjax.linearize(scene, q, v, params), 1),
    }  # fmt: skip
    for name, (call, each) in calls.items():
        first = spend(lambda call=call: call(q, v))
        second = spend(lambda call=call: call(q, v))
        twenty = first + second + 18 * spend(lambda call=call: call(q, v), 18)
        again = min(spend(lambda call=call: call(q, v), max(1, CALLS // each // 10)) for _ in range(5)) / each
        error = float(jnp.abs(call(q, v) - right).max() / jnp.abs(right).max()) if name == "acceleration" else None
        yield {
            "robot": of.name, "n": n, "quantity": name, "first s": first, "second µs": 1e6 * second / each,
            "twenty s": twenty, "again µs": 1e6 * again, "error": error,
        }  # fmt: skip
    for name, call in peers(of, source, *map(np.asarray, (q, v, a))):
        again = min(spend(call, CALLS) for _ in range(5))
        yield {"robot": of.name, "n": n, "quantity": name, "again µs": 1e6 * again}


def peers(of, source, q, v, a) -> Iterator[tuple[str, Callable]]:
    """What others that are installed take for a state that is ready in their form; damping is left out."""
    if not importlib.util.find_spec("pinocchio"):
        return
    theirs = robot.Pinocchio(source, of)
    pin, given = theirs.pin, (theirs.model, theirs.data, *theirs._state(q, v, a))
    yield "acceleration by pinocchio", lambda: pin.aba(*given)
    yield "Jacobian by pinocchio", lambda: pin.computeABADerivatives(*given)
    yield "inverse dynamics by pinocchio", lambda: pin.rnea(*given)
    if importlib.util.find_spec("casadi") and shutil.which("cc"):
        yield from compile_casadi(of)


def compile_casadi(of: robot.Robot) -> Iterator[tuple[str, Callable]]:
    """CasADi's accelerations and inverse dynamics of the same L, as C that is called with buffers."""
    import casadi  # pyright: ignore[reportMissingImports]

    n = len(of.moving)
    q, v, a = (casadi.SX.sym(name, n) for name in ("q", "v", "a"))
    energy = lagrangian_in_casadi(of, q, v)
    momentum = casadi.gradient(energy, v)
    taken = casadi.jtimes(momentum, casadi.vertcat(q, v), casadi.vertcat(v, a)) - casadi.gradient(energy, q)
    free, mass = casadi.substitute(taken, a, casadi.SX.zeros(n)), casadi.jacobian(momentum, v)
    formulas = {
        "inverse dynamics": taken,
        "acceleration": casadi.ldl_solve(-free, *casadi.ldl(mass, False)[:2], range(n)),
    }
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, formula in formulas.items():
            function, given = casadi.Function("of", [q, v, a], [formula]), [np.full(n, 0.1) for _ in range(3)]
            function.generate("of.c")
            library = f"{folder}/{name[:3]}.so"
            subprocess.run(["cc", "-O2", "-fPIC", "-shared", "of.c", "-o", library], check=True)
            buffer, work = casadi.external("of", library).buffer()
            result = np.zeros(n)
            for i, array in enumerate(given):
                buffer.set_arg(i, array.data)
            buffer.set_res(0, result.data)
            yield f"{name} by CasADi", work


def lagrangian_in_casadi(of: robot.Robot, q, v):
    """`examples.robot._lagrangian` in CasADi."""
    import casadi  # pyright: ignore[reportMissingImports]

    still, total, k = casadi.SX.zeros(3), 0.0, 0
    state = {of.root: (still, still, casadi.SX([0.0, 0.0, 1.0]), 0.0)}
    for joint in of.joints:
        omega, speed, up, height = state[joint.parent]
        axis, turn, offset = casadi.SX(joint.axis), casadi.SX(joint.rotation), casadi.SX(joint.offset)
        moves = joint.kind in robot.MOVING
        if joint.kind == "prismatic":
            offset += turn @ axis * q[k]
        elif moves:
            along = axis @ axis.T
            turn = turn @ (along + casadi.cos(q[k]) * (casadi.SX.eye(3) - along) + casadi.sin(q[k]) * casadi.skew(axis))
        height, up = height + casadi.dot(up, offset), turn.T @ up
        speed, omega = turn.T @ (speed + casadi.cross(omega, offset)), turn.T @ omega
        if joint.kind == "prismatic":
            speed += axis * v[k]
        elif moves:
            omega += axis * v[k]
        k += moves
        state[joint.child] = omega, speed, up, height
        if body := of.bodies.get(joint.child):
            centre = casadi.SX(body.centre)
            w = speed + casadi.cross(omega, centre)
            turning = casadi.dot(omega, casadi.SX(body.inertia) @ omega)
            total += 0.5 * (body.mass * casadi.dot(w, w) + turning) - body.mass * robot.G * (
                height + casadi.dot(up, centre)
            )
    return total


def reference(of, source, q, v, params):
    if importlib.util.find_spec("pinocchio"):
        return robot.Pinocchio(source, of).acceleration(q, v)
    damping = np.array([joint.damping for joint in of.moving])
    mass = jax.hessian(lambda v: robot.system(of).lagrangian(q, v, params=params))(v)
    return jnp.linalg.solve(mass, -damping * v - robot.bias(of, q, v, params))


def cotangents() -> dict[str, Any]:
    """The Jacobian of a short run in reverse mode, beside two gradients of it."""
    scene = lagjax.System(lambda q, v: 0.5 * v**2 + 9.81 * jnp.cos(q), forces=lambda q, v, params: params)

    def end(u):
        state = lagjax.simulate(scene, 0.5, 0.0, jnp.array([0.0, 0.04]), u).end
        return jnp.stack([state.q, state.qdot])

    forms = {
        "value": end, "two gradients": lambda u: [jax.grad(lambda u, k=k: end(u)[k])(u) for k in (0, 1)],
        "jacrev": jax.jacrev(end), "jacfwd": jax.jacfwd(end),
    }  # fmt: skip
    found = {}
    for name, form in forms.items():
        call = jax.jit(form)
        spend(lambda call=call: call(0.3))
        found[f"{name} µs"] = 1e6 * min(spend(lambda call=call: call(0.3), 200) for _ in range(5))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--write", action="store_true", help="store the figures")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = [row for source in (robot.ARM, legs()) for row in measure(source)]
    print(_report.table(rows))
    short = cotangents()
    print(short)
    if options.write:
        _report.write_json(STORE, {"mechanics": _report.circumstances() | {"rows": rows, "a short run": short}})


if __name__ == "__main__":
    main()
