"""Seeded faults: what people get wrong, one after the other, and what lagjax says to each. None may be silent.

Three tables: what is refused before any work, what `lagjax.check` finds at a state, and motions that cannot be followed
to their end. Every row names the words, the kind of finding or the result code that must come.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import VALLEY
from sweeps import sweep

import lagjax

TS = np.linspace(0.0, 1.0, 5)


def free(q, v):
    return 0.5 * jnp.sum(v**2)


def spring(q, v, params):
    return 0.5 * params["m"] * v**2 - 0.5 * params["k"] * q**2


def weight(q, v):
    return 0.5 * jnp.sum(v**2) - 9.81 * q[1]


def rod(q):
    return {"rod": jnp.sum(q**2) - 1.0}


def length(q, v):
    return jnp.sqrt(jnp.sum(v**2))


def top(q, v):  # Euler angles θ, φ, ψ
    return 0.5 * (v[0] ** 2 + jnp.sin(q[0]) ** 2 * v[1] ** 2) + 0.1 * (v[2] + v[1] * jnp.cos(q[0])) ** 2


FREE, SPRING = lagjax.System(free), lagjax.System(spring)
PARAMS = {"m": 1.0, "k": 4.0}
ONES, ZEROS = np.ones(2), np.zeros(2)


# ---- refused ---------------------------------------------------------------------------------------------------------


def ask(lagrangian=free, q=ONES, qdot=ONES, params=None, t=0.0, **roles):
    return lambda: lagjax.System(lagrangian, **roles).acceleration(q, qdot, t, params)


def run(system=SPRING, q0=1.0, qdot0=0.0, ts=TS, params=PARAMS, **options):
    return lambda: lagjax.simulate(system, q0, qdot0, ts, params, **options)


def batch(q0=ONES, qdot0=ZEROS, ts=TS, params=PARAMS, **options):
    return lambda: lagjax.simulate_batch(SPRING, q0, qdot0, ts, params, **options)


def stay(**changes):
    return lagjax.Transition(**({"source": "a", "target": "a", "guard": lambda q, v: q - 0.5} | changes))


def hybrid(transition=None, **changes):
    def call():
        made = [stay() if transition is None else transition()]
        given = {"modes": {"a": FREE}, "start": "a", "q0": 0.0, "qdot0": 1.0, "ts": TS} | changes
        scene = lagjax.Hybrid(given.pop("modes"), made, given.pop("start"))
        return lagjax.simulate(scene, **given)

    return call


REFUSED = {
    # System: the functions
    "L is a number": (ask(3.0), TypeError, "lagrangian must be a function"),
    "L without velocities": (ask(lambda q: 0.0), TypeError, r"must have the form lagrangian\(q, qdot\)"),
    "params that are not given": (
        run(lagjax.System(lambda q, v, params: 0.5 * v**2 - params["k"] * q), 1.0, 0.0, TS, None), TypeError,
        "none were given",
    ),
    "L has a default that looks like the time": (ask(lambda q, v, T=0.0: 0.0), TypeError, "asks for `T=0.0`"),
    "L has a default that looks like params": (ask(lambda q, v, param=None: 0.0), TypeError, "asks for `param=None`"),
    "L asks for an unknown name": (ask(lambda q, v, mass: 0.0), TypeError, "asks for `mass`"),
    "L without its sum": (ask(lambda q, v: v**2), TypeError, "a missing sum"),
    "L returns nothing": (ask(lambda q, v: None), TypeError, "must return one scalar"),
    "L is complex": (ask(lambda q, v: jnp.sum(v) * 1j), TypeError, "real floating-point number; got complex"),
    "a misspelt parameter": (run(params={"m": 1.0, "K": 4.0}), KeyError, "k"),
    "forces of the wrong shape": (ask(forces=lambda q, v: v[0]), TypeError, "structure of q, one force per coord"),
    "forces that are complex": (ask(forces=lambda q, v: 1j * v), TypeError, "forces must return real numbers: take"),
    "dissipation without its sum": (ask(dissipation=lambda q, v: v**2), TypeError, "dissipation must return one sca"),
    "constraints of the velocity": (ask(constraints=lambda q, v: v), TypeError, "asks for `v`"),
    "constraints that hold nothing": (ask(constraints=lambda q: {}), TypeError, "at least one number"),
    "a constraint that is a condition": (ask(constraints=lambda q: q[0] > 0), TypeError, "real floating-point"),
    "one name for two constraints": (
        ask(constraints=rod, velocity_constraints=lambda q, v: {"rod": v[0]}), ValueError, "have the same name: rod",
    ),
    "an unknown path": (lambda: lagjax.System(free, path="fast"), ValueError, "path must be"),
    "multipliers without constraints": (lambda: FREE.multipliers(ONES, ONES), ValueError, "has no constraints"),
    # the state
    "integers as coordinates": (ask(q=1, qdot=0), TypeError, "write 1.0 instead of 1"),
    "text as a velocity": (ask(q=1.0, qdot="fast"), TypeError, "must be a real number or array; got 'fast'"),
    "no coordinates": (ask(q={}, qdot={}), ValueError, "at least one number"),
    "another structure of velocities": (ask(q={"x": 1.0}, qdot={"y": 1.0}), ValueError, "same structure"),
    "another shape of velocities": (ask(qdot=jnp.ones(3)), ValueError, "they must agree"),
    "a time for every coordinate": (ask(t=ONES), ValueError, "t must be one number"),
    # simulate
    "a function in the place of a system": (run(system=spring), TypeError, "system must be a lagjax.System"),
    "NaN in the state": (run(q0=np.nan), ValueError, "q0 is nan"),
    "NaN in a parameter": (run(params={"m": 1.0, "k": np.nan}), ValueError, r"params\['k'\] is nan"),
    "one output time": (run(ts=[0.0]), ValueError, "at least two output times"),
    "times out of order": (run(ts=[0.0, 2.0, 1.0]), ValueError, "strictly increasing"),
    "times that single precision cannot tell apart": (
        run(q0=np.float32(1), qdot0=np.float32(0), ts=np.array([1e6, 1e6 + 1e-3])), ValueError, "in float32",
    ),
    "float32 in diffrax with rtol 1e-12": (
        run(q0=np.float32(1), qdot0=np.float32(0), rtol=1e-12, solver=diffrax.Tsit5()), ValueError,
        "float32 cannot meet rtol",
    ),
    "rtol beyond float64": (run(rtol=1e-18), ValueError, "float64 cannot meet rtol"),
    "rtol that leaves no digit": (run(rtol=2.0), ValueError, "less than 1"),
    "rtol as a text": (run(rtol="1e-9"), TypeError, "rtol must be a real number"),
    "rtol that is True": (run(rtol=True), TypeError, "rtol must be a real number"),
    "atol of zero": (run(atol=0.0), ValueError, "atol must be positive"),
    "a fixed step and a tolerance": (run(dt=0.1, rtol=1e-6), ValueError, "one or the other"),
    "a step backwards": (run(dt=-0.1), ValueError, "dt must be a positive step"),
    "steps that the budget does not cover": (run(dt=1e-9), ValueError, "more than max_steps"),
    "no budget of steps": (run(max_steps=None), ValueError, "max_steps must be a positive integer"),
    "a solver's class": (run(solver=diffrax.Tsit5), TypeError, "instance of a diffrax solver"),
    "a symplectic solver for a split system": (
        run(solver=diffrax.SemiImplicitEuler(), dt=0.1), ValueError, "several terms",
    ),
    "adaptive steps without an error": (run(solver=diffrax.Euler()), ValueError, "give a fixed step with dt"),
    "an event of one argument": (run(event=lambda q: q), TypeError, "event must have the form"),
    "an adjoint by name": (run(adjoint="forward"), TypeError, "adjoint must be an instance"),
    "a progress meter by name": (run(progress="yes"), TypeError, "progress must be an instance"),
    "a start off its constraints": (
        run(lagjax.System(weight, constraints=rod), ONES, ZEROS), ValueError, "q0 does not satisfy constraints",
    ),
    "a velocity across its constraints": (
        run(lagjax.System(weight, constraints=rod), jnp.array([0.0, -1.0]), ONES), ValueError, "qdot0 does not satisfy",
    ),
    "constraints that contradict each other": (
        run(lagjax.System(weight, constraints=lambda q: {"a": q[0], "b": q[0] - 1.0}), ZEROS, ZEROS), ValueError,
        "b'. contradicts",
    ),
    "a constraint that is a square": (
        run(lagjax.System(weight, constraints=lambda q: q[0] ** 2), ZEROS, ZEROS), ValueError, "zero gradient",
    ),
    # simulate_batch
    "batch axes for two": (batch(batch_axes=(0, 0)), ValueError, "tuple of three"),
    "an axis that is not there": (batch(batch_axes=(1, 0, None)), ValueError, "it has no axis 1"),
    "batches of two sizes": (batch(qdot0=jnp.zeros(3)), ValueError, "same number of members"),
    "a batch of nothing": (batch(batch_axes=(None, None, None)), ValueError, "maps over nothing"),
    "an empty batch": (batch(jnp.zeros(0), jnp.zeros(0)), ValueError, "batch is empty"),
    "NaN that all members share": (batch(params={"m": np.inf, "k": 1.0}), ValueError, r"params\['m'\] is inf"),
    # Hybrid and Transition
    "a transition without a guard": (hybrid(lambda: stay(guard=None)), TypeError, "has no guard"),
    "a guard of one argument": (hybrid(lambda: stay(guard=lambda q: q)), TypeError, "guard must have the form"),
    "a direction of two": (hybrid(lambda: stay(direction=2)), ValueError, "direction must be"),
    "a guard that is a condition": (hybrid(lambda: stay(guard=lambda q, v: q > 0)), TypeError, "one real number"),
    "a reset that forgets the velocity": (hybrid(lambda: stay(reset=lambda q, v: q)), TypeError, "return the pair"),
    "a guard on multipliers without constraints": (
        hybrid(lambda: stay(guard=lambda q, v, multipliers: q)), ValueError, "no constraints",
    ),
    "modes in a list": (hybrid(modes=[FREE]), TypeError, "modes must be a dict"),
    "a start in no mode": (hybrid(start="b"), ValueError, "start is 'b', which is no mode"),
    "a transition to nowhere": (hybrid(lambda: stay(target="b")), ValueError, "target 'b', which is no mode"),
    "a mode that is never reached": (hybrid(modes={"a": FREE, "b": FREE}), ValueError, "unreachable"),
    "hybrid motion back in time": (hybrid(ts=TS[::-1]), ValueError, "ts must increase"),
    "no budget of transitions": (hybrid(max_transitions=0), ValueError, "max_transitions must be a positive integer"),
    # solvers, tables
    "fine output of an implicit solver": (lambda: lagjax.FineOutput(diffrax.Kvaerno5()), TypeError, "explicit FSAL"),
    "a function without a series": (
        run(lagjax.System(lambda q, v: 0.5 * v**2 - jax.scipy.special.betainc(2.0, 3.0, q)), 1.0, 0.0, TS, None,
            solver=lagjax.MachineCode()), ValueError, "regularized_incomplete_beta",
    ),
    "tolerances that are one": (
        lambda: lagjax.work_precision(SPRING, 1.0, 0.0, TS, PARAMS, tolerances=1e-6), ValueError, "at least one value",
    ),
    "check inside jit": (lambda: jax.jit(lambda q: lagjax.check(FREE, q, 0.0).ok)(1.0), ValueError, "outside of jit"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    call, error, words = REFUSED[name]
    with pytest.raises(error, match=words):
        call()


# ---- found by check --------------------------------------------------------------------------------------------------


def slider(q):  # a slack variable s with x = s²
    return {"slack": q[0] - q[1] ** 2}


FOUND = {
    "friction that drives": (
        lagjax.System(free, dissipation=lambda q, v: -0.1 * jnp.sum(v**2)), ONES, ZEROS, "creates_energy", (),
    ),
    "U - T": (lagjax.System(lambda q, v: 0.5 * q**2 - 0.5 * v**2), 1.0, 0.0, "indefinite_mass_matrix", ("q",)),
    "a missing velocity": (
        lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - q[1] ** 2), ONES, ZEROS, "velocity_unused", ("q[1]",),
    ),
    "a velocity without its square": (
        lagjax.System(lambda q, v: 0.5 * v[0] ** 2 + q[0] * v[1]), ONES, ZEROS, "linear_in_velocity", ("q[1]",),
    ),
    "gimbal lock": (lagjax.System(top), jnp.zeros(3), jnp.ones(3), "coordinate_singularity", ("q[1]", "q[2]")),
    "nearly gimbal lock": (
        lagjax.System(top), jnp.array([1e-6, 1.0, 1.0]), jnp.ones(3), "near_coordinate_singularity", ("q[1]", "q[2]"),
    ),
    "the length of a path": (lagjax.System(length), ONES, ONES, "gauge", ("q[0]", "q[1]")),
    "a norm at rest": (
        lagjax.System(lambda q, v: v @ v + jnp.linalg.norm(v)), ONES, ZEROS, "derivative_not_finite",
        ("dq[0]", "dq[1]"),
    ),
    "abs at its kink": (VALLEY, 0.0, 1.0, "kink", ("q",)),
    "a stopped gradient": (
        lagjax.System(lambda q, v: 0.5 * v**2 - jax.lax.stop_gradient(q) ** 2), 1.0, 0.0, "wrong_derivative", ("q",),
    ),
    "a pole of the potential": (lagjax.System(lambda q, v: 0.5 * v**2 + 1 / q), 0.0, 1.0, "value_not_finite", ()),
    "a discontinuous force": (
        lagjax.System(free, forces=lambda q, v: -0.3 * jnp.sign(v)), 1.0, 0.0, "discontinuity", ("dq",),
    ),
    "a stiff spring": (
        lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) - 0.5 * q[0] ** 2 - 0.5e10 * (q[1] - q[0]) ** 2), ONES, ZEROS,
        "stiff", (),
    ),
    "a slack rope": (
        lagjax.System(weight, constraints=lambda q: {"rope": jnp.maximum(0.0, q @ q - 4.0)}), ONES, ZEROS,
        "constraint_zero_gradient", ("constraints['rope']",),
    ),
    "a slack variable": (
        lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - q[0], constraints=slider), ZEROS, ZEROS, "coordinate_singularity",
        ("q[1]",),
    ),
    "a singular saddle point": (
        lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - q[1], constraints=lambda q: {"wall": q[0] - 1.0}), ONES, ZEROS,
        "velocity_unused", ("q[1]",),
    ),
    "a speed that is prescribed": (
        lagjax.System(free, velocity_constraints=lambda q, v: {"speed": v @ v - 2.0}), ONES, ONES,
        "velocity_constraint_not_affine", ("velocity_constraints['speed']",),
    ),
    "one rod twice": (
        lagjax.System(weight, constraints=lambda q: {"a": q @ q - 2.0, "b": 3 * (q @ q) - 6.0}), ONES, ZEROS,
        "dependent_constraints", ("constraints['b']", "constraints['a']"),
    ),
    "metres where there are nanometres": (
        lagjax.System(lambda q, v: 0.5 * (v["x"] ** 2 + v["angle"] ** 2)), {"x": 1e-12, "angle": 1.0},
        {"x": 0.0, "angle": 0.0}, "small_state", ("q['x']",),
    ),
    "NaN in the velocity": (FREE, ONES, jnp.array([0.0, jnp.nan]), "not_finite", ("qdot[1]",)),
}  # fmt: skip
WARNINGS = {"creates_energy", "indefinite_mass_matrix", "near_coordinate_singularity", "discontinuity", "kink",
            "velocity_constraint_not_affine", "stiff", "dependent_constraints", "small_state"}  # fmt: skip


@pytest.mark.parametrize("name", FOUND)
def test_found(name):
    system, q, qdot, kind, where = FOUND[name]
    findings = lagjax.check(system, q, qdot)
    chosen = [finding for finding in findings if finding.kind == kind]
    assert chosen, str(findings)
    assert {label for finding in chosen for label in finding.where} == set(where)
    assert findings.ok == (kind in WARNINGS)


# ---- motions that cannot be followed ---------------------------------------------------------------------------------


def bounces():
    floor = lagjax.Transition("a", "a", lambda q, v: q, -1, lambda q, v: (q, -0.5 * v))
    ball = lagjax.System(lambda q, v: 0.5 * v**2 - 9.81 * q)
    return lagjax.simulate(
        lagjax.Hybrid({"a": ball}, [floor], "a"), 1.0, 0.0, [0.0, 5.0], max_transitions=8, throw=False
    )


STOPPED = {
    # name: the run, and the results that name what happened
    "a collision": (
        run(lagjax.System(lambda q, v: 0.5 * v**2 + 1 / q), 1.0, 0.0, [0.0, 3.0], None, throw=False),
        {"dt_min_reached", "nonfinite_state"},
    ),
    "out of the domain of a root": (
        run(lagjax.System(lambda q, v: 0.5 * v**2 - jnp.sqrt(1 - q)), 0.0, 1.0, [0.0, 3.0], None, throw=False),
        {"dt_min_reached", "nonfinite_state"},
    ),
    "switched too fast": (
        run(lagjax.System(free, forces=lambda q, v, t: jnp.sign(jnp.sin(1e9 * t))), 0.0, 0.0, [0.0, 3.0],
            None, max_steps=1000, throw=False),
        {"acceleration_discontinuous", "max_steps_reached"},
    ),
    "a stiff spring and an explicit solver": (
        run(params={"m": 1e-12, "k": 1.0}, solver=diffrax.Tsit5(), max_steps=1000, throw=False),
        {"max_steps_reached"},
    ),
    "a stiff spring and long fixed steps": (
        run(params={"m": 1e-12, "k": 1.0}, solver=diffrax.Euler(), dt=0.01, ts=[0.0, 1.0], throw=False),
        {"nonfinite_state"},
    ),
    "a missing velocity": (
        run(lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - q[1] ** 2), ONES, ONES, TS, None, throw=False),
        {"mass_matrix_singular"},
    ),
    "a mass that vanishes": (
        run(lagjax.System(lambda q, v: 0.5 * q * v**2), 1.0, -1.0, [0.0, 3.0], None, throw=False),
        {"mass_matrix_singular", "dt_min_reached", "nonfinite_state"},
    ),
    "bounces that pile up": (bounces, {"zeno"}),
    "a budget of steps that is spent": (run(ts=[0.0, 1e4], max_steps=20, throw=False), {"max_steps_reached"}),
    "too tight beside a jump": (
        run(lagjax.System(free, forces=lambda q, v: jnp.where(q > 0, -1e3, 1e3)), 0.1, 0.0, [0.0, 100.0], None,
            max_steps=200, throw=False),
        {"acceleration_discontinuous", "max_steps_reached"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", sweep(STOPPED, kept=lambda name: "stiff" not in name))
def test_stopped(name):
    call, results = STOPPED[name]
    trajectory = call()
    assert not trajectory.ok
    assert any(bool(trajectory.result == getattr(lagjax.RESULTS, name)) for name in results), trajectory.result
    last = jax.tree.leaves(trajectory.q)[0][-1]
    assert np.isnan(last).all(), "what was not reached is NaN"


def test_members_of_a_batch_are_named():
    q0 = np.array([1.0, np.nan, 1.0, 1.0])
    params = {"m": np.array([1.0, 1.0, 0.0, 1.0]), "k": np.array([4.0, 4.0, 4.0, np.inf])}
    mixed = lagjax.simulate_batch(SPRING, q0, np.zeros(4), TS, params, batch_axes=(0, 0, 0))
    assert mixed.ok.tolist() == [True, False, False, False]
    clean = lagjax.simulate(SPRING, 1.0, 0.0, TS, PARAMS)
    np.testing.assert_array_equal(mixed.q[0], clean.q)
    assert np.isnan(mixed.q[1:, 1:]).all()
