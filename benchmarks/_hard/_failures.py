"""Where there is no motion to follow: a number or a sentence, never a wrong number."""

import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._hard._case import Experiment, Found, timed
from lagjax import RESULTS

# ---- broken members of a batch ---------------------------------------------------------------------------------------


def _attracted_lagrangian(q, qdot, params):
    return 0.5 * params["m"] * qdot @ qdot + params["k"] / jnp.sqrt(q @ q)


_ATTRACTED = lagjax.System(_attracted_lagrangian)
STEP_BUDGET = 2000

# What is wrong with a broken member, and what it must be called.
FAULTS = {
    "a parameter is NaN": ({"k": np.nan}, {}, RESULTS.nonfinite_state),
    "it falls into the centre": ({}, {"qdot0": [0.0, 0.0]}, RESULTS.dt_min_reached),
    "it has no mass": ({"m": 0.0}, {}, RESULTS.mass_matrix_singular),
    "it circles too fast for the budget": ({"k": 1e9}, {"qdot0": [0.0, 3e4]}, RESULTS.max_steps_reached),
}


def broken_members(short: bool) -> Found:
    """Ellipses in one batch, one in a hundred broken: the others must not notice, and the broken ones must be named.

    The error counts healthy members that differ in any bit from the batch without the faults, or are not ok, and broken
    ones that are called anything but what is wrong with them.
    """
    members, rng = (1000 if short else 10_000), np.random.default_rng(3)
    healthy = {
        "q0": np.stack([rng.uniform(0.8, 1.2, members), np.zeros(members)], axis=1),
        "qdot0": np.stack([np.zeros(members), rng.uniform(0.8, 1.1, members)], axis=1),
        "m": rng.uniform(0.9, 1.1, members),
        "k": rng.uniform(0.9, 1.1, members),
    }
    broken = rng.choice(members, members // 100, replace=False)
    values, expected = {name: x.copy() for name, x in healthy.items()}, {}
    for i, member in enumerate(broken):
        params, state, result = list(FAULTS.values())[i % len(FAULTS)]
        for name, x in (params | state).items():
            values[name][member] = x
        expected[int(member)] = result
    ts = np.linspace(0.0, 20.0, 3)

    def run(x):
        params = {"m": x["m"], "k": x["k"]}
        return lagjax.simulate_batch(
            _ATTRACTED, x["q0"], x["qdot0"], ts, params, batch_axes=(0, 0, 0), rtol=1e-12, max_steps=STEP_BUDGET
        )

    clean = run(healthy)
    seconds, mixed = timed(lambda: run(values))
    others = np.setdiff1d(np.arange(members), broken)
    same = [
        np.all(np.asarray(a)[others] == np.asarray(b)[others], axis=(1, 2))
        for a, b in ((clean.q, mixed.q), (clean.qdot, mixed.qdot))
    ]
    unlike = int(np.sum(~(same[0] & same[1] & np.asarray(mixed.ok)[others])))
    codes = np.asarray(mixed.result._value)
    misnamed = sum(int(codes[member]) != int(result._value) for member, result in expected.items())
    remark = f"{len(broken)} broken: {misnamed} misnamed; {unlike} of {len(others)} others unlike"
    return Found(float(unlike + misnamed), None, int(mixed.stats["num_steps"].sum()), seconds, remark)


# ---- fragments that automatic differentiation breaks -----------------------------------------------------------------


def _norm(x):
    return jnp.linalg.norm(x)


# L, (q, q̇), and the acceleration that is true there; None where the chart or L itself is at fault and nothing is.
FRAGMENTS = {
    "½|v|² by a norm, at rest": (lambda q, v: 0.5 * _norm(v) ** 2 - q[1], ([0, 0], [0, 0]), [0, -1]),
    "½k|q|² by a norm, at 0": (lambda q, v: 0.5 * v @ v - 0.5 * _norm(q) ** 2, ([0, 0], [1, 0]), [0, 0]),
    "−√(1 − |v|²) by a norm, at rest": (
        lambda q, v: -jnp.sqrt(1 - _norm(v) ** 2) - q[1], ([0, 0], [0, 0]), [0, -1],
    ),
    "V = |q|, at 0": (lambda q, v: 0.5 * v @ v - jnp.abs(q[0]), ([0, 0], [0, 0]), [0, 0]),
    "polar coordinates at r = 0": (lambda q, v: 0.5 * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2), ([0, 0], [1, 0]), None),
    "spherical ones at the pole": (
        lambda q, v: 0.5 * (v[0] ** 2 + jnp.sin(q[0]) ** 2 * v[1] ** 2) + jnp.cos(q[0]), ([0, 0], [1, 0]), None,
    ),
    "where(q > 0, √q³, 0), at −1": (
        lambda q, v: 0.5 * v @ v - jnp.where(q[0] > 0, jnp.sqrt(q[0] ** 3), 0.0), ([-1, 0], [0, 0]), [0, 0],
    ),
    "a velocity left out": (lambda q, v: 0.5 * v[0] ** 2 - q @ q, ([1, 1], [0, 0]), None),
    "a velocity linear": (lambda q, v: 0.5 * v[0] ** 2 + v[1] * q[0] - q @ q, ([1, 1], [0, 0]), None),
}  # fmt: skip


def fragments(short: bool) -> Found:
    """Counts fragments whose motion is wrong and that nobody complains of.

    Right is a finite, true acceleration. Anything else must be refused by `simulate` or, where JAX computes a slope
    that does not exist (as of |q| at 0), be an error in `lagjax.check`.
    """
    right, refused, named, wrong = [], [], [], []
    for name, (lagrangian, state, truth) in FRAGMENTS.items():
        q, v = (np.array(part, float) for part in state)
        system, h = lagjax.System(lagrangian), 1e-3
        try:
            run = lagjax.simulate(system, q, v, np.array([0.0, h]))
        except (lagjax.SimulationError, ValueError, TypeError):
            refused.append(name)
            continue
        mean = (np.asarray(run.qdot[-1]) - v) / h
        if truth is not None and np.abs(mean - truth).max() < 1e-2:
            right.append(name)
        else:
            (wrong if lagjax.check(system, q, v).ok else named).append(name)
    remark = f"{len(right)} right, {len(refused)} refused, {len(named)} named by check"
    return Found(float(len(wrong)), None, None, None, remark + (f"; WRONG: {', '.join(wrong)}" if wrong else ""))


CASES = (
    Experiment(
        name="10⁴ members, 1 % broken (wrong or unlike)",
        reference="the batch without them, bit by bit",
        accuracy=0.0,
        bound=0.0,
        because="lanes share nothing, whoever is in them",
        run=broken_members,
    ),
    Experiment(
        name="Where autodiff breaks (wrong)",
        reference="the acceleration by hand",
        accuracy=0.0,
        bound=0.0,
        because="where there is no derivative, there is an error to raise",
        run=fragments,
    ),
)
