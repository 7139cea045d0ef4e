"""The price of constraints: one motion in more coordinates than it needs, held by constraints, and in minimal ones.

Both are lagjax, both start from the same states, and the end of the minimal form is carried over to the coordinates of
the other, so that errors are of the same thing. Masses and lengths are inputs of both. The truth comes from another
program, which integrates the minimal form; Andrews' squeezer has none that could be written down, stands alone, and is
held against SciPy's DOP853 on the equations with multipliers, as they are solved with dense matrices.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._cases import GRAVITY, Case, chain, double_pendulum, with_params
from benchmarks._contenders import Contender, dop853_of_all, lagjax_batch, reference
from benchmarks._measure import REFERENCE_MEMBERS, Comparison, compare
from benchmarks._report import EQUAL_ERRORS
from lagjax import scenes

HELD, MINIMAL = "lagjax", "minimal coordinates"


@dataclass(frozen=True)
class Pair:
    """`held` with constraints and `minimal` without; `carried` takes (q, q̇) of one member from this to that."""

    held: Case
    minimal: Case | None
    carried: Callable | None = None

    def of_duration(self, duration: float | None) -> "Pair":
        if duration is None:
            return self
        return replace(self, **{
            name: replace(case, duration=min(duration, case.duration))
            for name, case in (("held", self.held), ("minimal", self.minimal)) if case is not None
        })  # fmt: skip


def constraints(options) -> Iterator[Comparison]:
    """Every pair."""
    for pair in PAIRS.values():
        yield compared(pair(options.batch).of_duration(options.duration), options)


def compared(pair: Pair, options) -> Comparison:
    """Both forms at every tolerance."""
    contenders = [Contender(HELD, lagjax_batch())]
    if pair.minimal is not None:
        contenders.append(Contender(MINIMAL, lambda _: _carried_over(lagjax_batch()(pair.minimal), pair)))
    truth = _truth(pair)
    return compare(pair.held, contenders, options.tolerances, options.repeats, options.budget, truth=truth)


def price(comparison: dict) -> dict[float, float]:
    """How many times the minimal form the constraints cost, by error, from a stored comparison."""
    points = [p for p in comparison["equal_error"] if p["contender"] == MINIMAL and not p["upper_bound"]]
    return {p["error"]: 1 / p["times_lagjax"] for p in points if p["times_lagjax"]}


def price_line(comparison: dict) -> str:
    """The same for the eye."""
    known = price(comparison)
    times = ", ".join(f"{known[error]:.2g} at {error:.0e}" for error in EQUAL_ERRORS if error in known)
    return f"{comparison['case']}: constraints cost {times} times the minimal form" if times else ""


def _carried_over(solve: Callable, pair: Pair) -> Callable:
    def run(tol):
        final, steps = solve(tol)
        return _in_coordinates_of_held(final, pair), steps

    return run


def _in_coordinates_of_held(states: np.ndarray, pair: Pair) -> np.ndarray:
    """By NumPy, at once for all members: a small part of what a run takes."""
    n = pair.minimal.coordinates
    q, v = pair.carried(states[:, :n], states[:, n:])
    return np.concatenate([q, v], axis=1)


def _truth(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    if pair.minimal is not None:
        few = pair.minimal.first(REFERENCE_MEMBERS)
        return tuple(_in_coordinates_of_held(states, pair) for states in reference(few))
    few = pair.held.first(8)
    return tuple(dop853_of_all(few, _with_multipliers(few), tol) for tol in (1e-13, 1e-12))


def _with_multipliers(case: Case) -> Callable:
    """q̈ of one state from M q̈ − Jᵀλ = F, J q̈ = −(dJ/dt) q̇ for a scene at rest in time, with LAPACK."""
    L, system = case.lagrangian, case.scene.system

    def held(q):
        leaves = jax.tree.leaves(system.constraints(case.tree(q), t=0.0, params=case.scene.params))
        return jnp.stack(leaves)

    def acceleration(q, v):
        momentum_rate = jax.jvp(lambda q: jax.grad(L, 1)(q, v), (q,), (v,))[1]
        drift = jax.jvp(lambda q: jax.jvp(held, (q,), (v,))[1], (q,), (v,))[1]
        M, J = jax.hessian(L, 1)(q, v), jax.jacfwd(held)(q)
        whole = jnp.block([[M, J.T], [J, jnp.zeros((len(J), len(J)))]])
        right = jnp.concatenate([jax.grad(L, 0)(q, v) - momentum_rate, -drift])
        return jnp.linalg.solve(whole, right)[: len(q)]

    return acceleration


# ---- the scenes ------------------------------------------------------------------------------------------------------


def _of_rods(minimal: Case, scene: scenes.Scene) -> Pair:
    """Masses on rods of length 1, and the angles of the rods."""

    def carried(angles, rates):
        q, v = (np.zeros((*angles.shape, 2)) for _ in range(2))
        np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], -1), axis=1, out=q)
        np.cumsum(np.stack([np.cos(angles) * rates, np.sin(angles) * rates], -1), axis=1, out=v)
        return q.reshape(len(q), -1), v.reshape(len(v), -1)

    return _pair(minimal, scene, carried)


def _pair(minimal: Case, scene: scenes.Scene, carried: Callable) -> Pair:
    q0, qdot0 = carried(minimal.q0, minimal.qdot0)
    held = Case(minimal.name, scene, q0, qdot0, minimal.duration, symbolic=minimal.symbolic)
    return Pair(held, minimal, carried)


def _pendulum(batch: int) -> Pair:
    def symbolic(ops, q, v):
        return 0.5 * v[0] ** 2 + GRAVITY * ops.cos(q[0])

    q0 = np.random.default_rng(7).uniform(-2.5, 2.5, (batch, 1))
    scene = scenes.chain(1)  # like the others with an array of coordinates
    alone = with_params(scene, {"m": np.ones(1), "l": np.ones(1), "g": GRAVITY})
    return _of_rods(Case("pendulum", alone, q0, 0 * q0, 10.0, symbolic), scenes.cartesian_pendulum())


def _double_pendulum(batch: int) -> Pair:
    return _of_rods(double_pendulum(batch), scenes.cartesian_double_pendulum())


def _chain(links: int, batch: int) -> Pair:
    minimal = chain(links, batch)
    return _of_rods(minimal, with_params(scenes.cartesian_chain(links), minimal.scene.params))


def _rolling_cylinder(batch: int) -> Pair:
    scene = scenes.rolling_cylinder()
    M, R, a, alpha, g = (scene.params[name] for name in ("M", "R", "a", "alpha", "g"))
    inertia, turns = (1 + alpha) * M * (R + a) ** 2, (R + a) / a

    def lagrangian(q, v, params):
        M, far = params["M"], params["R"] + params["a"]
        return 0.5 * (1 + params["alpha"]) * M * far**2 * v[0] ** 2 - M * params["g"] * far * jnp.cos(q[0])

    def symbolic(ops, q, v):
        return 0.5 * inertia * v[0] ** 2 - M * g * (R + a) * ops.cos(q[0])

    def carried(angle, rate):
        return np.hstack([np.full_like(angle, R + a), angle, turns * angle]), np.hstack([0 * rate, rate, turns * rate])

    q0 = np.random.default_rng(8).uniform(0.1, 0.5, (batch, 1))
    alone = scenes.Scene(lagjax.System(lagrangian), scene.params, q0[0], 0 * q0[0], scene.duration, {})
    return _pair(Case("rolling_cylinder", alone, q0, 0 * q0, scene.duration, symbolic), scene, carried)


def _squeezer(batch: int) -> Pair:
    """From rest, the crank turned a little: the states on the constraints nearest to that."""
    scene = scenes.andrews_squeezer()
    turned = np.random.default_rng(9).uniform(-0.01, 0.01, batch)
    start = jnp.array(scene.q0) + np.eye(7)[0] * turned[:, None]

    def nearest(q):
        q, v = scene.system.project(scenes.Squeezer(*q), scene.qdot0, params=scene.params)
        return jnp.stack(q), jnp.stack(v)

    q0, qdot0 = map(np.asarray, jax.jit(jax.vmap(nearest))(start))
    return Pair(Case("andrews_squeezer", scene, q0, qdot0, scene.duration, symbolic=lambda *_: None), None)


PAIRS: dict[str, Callable[[int], Pair]] = {
    "pendulum": _pendulum,
    "double_pendulum": _double_pendulum,
    "chain_4": lambda batch: _chain(4, batch),
    "chain_8": lambda batch: _chain(8, max(1, batch // 4)),
    "rolling_cylinder": _rolling_cylinder,
    "andrews_squeezer": lambda batch: _squeezer(max(1, batch // 4)),
}
