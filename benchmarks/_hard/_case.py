"""What a hard case is, and how lagjax and its peers are put to it.

A `Case` is a scene, the times to look at, and a reference that was not made here: a closed form, published digits, or a
quantity that the motion must keep. Its `error` reads a path, whoever computed it, so that lagjax and the peers are
judged by the same function. An `Experiment` is anything else that has a right answer: a count, a spectrum, a batch.

lagjax runs at the tightest tolerance that doubles allow, so that round-off alone is left. The peers do too:

- SciPy's DOP853 at rtol = 1e-13 on the accelerations that lagjax derived, so that the integrators alone differ;
- heyoka with compensated sums at its default tolerance, which is the machine epsilon, on equations that it derives
  itself, where the Lagrangian is written out in `symbolic`.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import lagjax
from benchmarks._contenders import installed
from lagjax import scenes

EPS = 2.0**-52
RTOL = 2.5e-15
MAX_STEPS = 1_000_000_000
BUDGET = 60.0  # seconds of a peer


class Path(NamedTuple):
    """States at `ts`, in the structure of the scene, the time axis in front."""

    ts: np.ndarray
    q: Any
    qdot: Any

    @property
    def end(self) -> tuple[Any, Any]:
        """The last state."""
        return jax.tree.map(lambda leaf: leaf[-1], (self.q, self.qdot))


class Found(NamedTuple):
    """What a run came to. `steps` are those of all members; `failures` says what went wrong, in words."""

    error: float
    drift: float | None = None
    steps: int | None = None
    seconds: float | None = None
    remark: str = ""


@dataclass(frozen=True)
class Case:
    """One motion.

    - `reference`, `accuracy`: where the truth comes from, and how good it is.
    - `bound`, `because`: what the error must stay below, and why it can.
    - `error(scene, path)`: how far the path is from the truth.
    - `drift_bound`: what the invariants of the scene must keep to, or the constraints where there are some.
    """

    name: str
    reference: str
    accuracy: float
    bound: float
    because: str
    scene: Callable[[], scenes.Scene]
    ts: np.ndarray
    error: Callable[[scenes.Scene, Path], float]
    drift_bound: float = 1e-12
    symbolic: Callable | None = None
    rtol: float = RTOL
    peers: bool = True

    def measure(self, short: bool = False) -> Found:
        """The run of lagjax; there is no short form."""
        scene = self.scene()
        follow(scene, self.ts[0] + 1e-3 * (self.ts - self.ts[0]), self.rtol)  # compiles
        seconds, run = timed(lambda: follow(scene, self.ts, self.rtol))
        path = Path(self.ts, *jax.tree.map(np.asarray, (run.q, run.qdot)))
        steps = int(run.stats["num_steps"])
        return Found(float(self.error(scene, path)), drift(scene, path), steps, seconds)

    def against(self) -> dict[str, Found | str]:
        """The runs of the peers, or why there is none."""
        found: dict[str, Found | str] = {}
        for name, package, solve in (("SciPy DOP853", "scipy", dop853), ("heyoka", "heyoka", heyoka)):
            if not self.peers or (name == "heyoka" and self.symbolic is None):
                continue
            found[name] = f"{package} is not installed" if not installed(package) else self._of(solve)
        return found

    def _of(self, solve: Callable) -> "Found | str":
        scene = self.scene()
        try:
            states, steps, seconds = solve(scene, self.ts, self.symbolic)
        except TookTooLong as reason:
            return str(reason)
        _, restore = ravel_pytree(start(scene))
        path = Path(self.ts, *jax.tree.map(np.asarray, jax.vmap(restore)(jnp.asarray(states))))
        return Found(float(self.error(scene, path)), drift(scene, path), steps, seconds)


@dataclass(frozen=True)
class Experiment:
    """One question with a right answer; `run(short)` asks it of lagjax. `missing()` is why it cannot be asked here."""

    name: str
    reference: str
    accuracy: float
    bound: float
    because: str
    run: Callable[[bool], Found]
    drift_bound: float = 1e-12
    missing: Callable[[], str | None] = lambda: None
    peer: dict[str, Callable[[], Found]] = field(default_factory=dict)

    def measure(self, short: bool = False) -> Found:
        """The run of lagjax."""
        return self.run(short)

    def against(self) -> dict[str, Found | str]:
        """The runs of the peers, or why there is none."""
        return {
            name: run() if installed(name.split()[0].lower()) else f"{name} is not installed"
            for name, run in self.peer.items()
        }


# ---- lagjax ----------------------------------------------------------------------------------------------------------


def start(scene: scenes.Scene) -> tuple[Any, Any]:
    """(q, q̇) of the scene, as arrays of doubles."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (scene.q0, scene.qdot0))


def follow(scene: scenes.Scene, ts: np.ndarray, rtol: float = RTOL) -> lagjax.Trajectory:
    """`lagjax.simulate`, from the start of the scene."""
    return lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params, rtol=rtol, max_steps=MAX_STEPS)


def follow_batch(scene, q0, qdot0, ts, params, batch_axes, **options) -> tuple[float, lagjax.Trajectory]:
    """`lagjax.simulate_batch` at the tightest tolerance, and its seconds once it is compiled."""
    options = {"rtol": RTOL, "max_steps": MAX_STEPS, "batch_axes": batch_axes} | options

    def run(ts):
        return jax.block_until_ready(lagjax.simulate_batch(scene.system, q0, qdot0, ts, params, **options))

    run(ts[0] + 1e-4 * (ts - ts[0]))  # compiles
    return timed(lambda: run(ts))


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds, and what came out, which is waited for."""
    began = time.perf_counter()
    value = jax.block_until_ready(run())
    return time.perf_counter() - began, value


def drift(scene: scenes.Scene, path: Path) -> float | None:
    """The largest residual of a constraint; without constraints, how far an invariant leaves its first value.

    That is relative to Σ |∂I/∂y||y|, as large as it gets: what a relative error of one in the state would make of it.
    """
    system, params = scene.system, scene.params
    path = jax.tree.map(jnp.asarray, path)
    if system.constraints is not None or system.velocity_constraints is not None:
        residual = jax.jit(jax.vmap(lambda q, v, t: system.constraint_residual(q, v, t, params)))
        return max(float(jnp.abs(r).max()) for r in jax.tree.leaves(residual(path.q, path.qdot, path.ts)))
    worst = None
    for invariant in scene.invariants.values():

        def value_and_size(q, v, t, invariant=invariant):
            value, slopes = jax.value_and_grad(lambda state: invariant(*state, t, params))((q, v))
            parts = jax.tree.map(lambda slope, y: jnp.sum(jnp.abs(slope * y)), slopes, (q, v))
            return value, sum(jax.tree.leaves(parts))

        values, sizes = jax.jit(jax.vmap(value_and_size))(path.q, path.qdot, path.ts)
        worst = max(worst or 0.0, float(jnp.abs(values - values[0]).max() / jnp.maximum(sizes.max(), 1e-300)))
    return worst


def changes(scene: scenes.Scene, path: Path, name: str) -> np.ndarray:
    """How far an invariant of the scene is from its first value, at every time."""
    invariant = scene.invariants[name]
    path = jax.tree.map(jnp.asarray, path)
    values = jax.jit(jax.vmap(lambda q, v, t: invariant(q, v, t, scene.params)))(path.q, path.qdot, path.ts)
    return np.abs(np.asarray(values - values[0]))


# ---- the peers -------------------------------------------------------------------------------------------------------


class TookTooLong(Exception):
    """A peer has used its budget."""


def dop853(scene: scenes.Scene, ts: np.ndarray, symbolic=None) -> tuple[np.ndarray, int, float]:
    """States (T, 2n), steps and seconds of SciPy's DOP853."""
    from scipy.integrate import solve_ivp

    y0, restore = ravel_pytree(start(scene))

    @jax.jit
    def slope(t, y):
        q, v = restore(y)
        return ravel_pytree((v, scene.system.acceleration(q, v, t, scene.params)))[0]

    slope(ts[0], y0)
    began = time.perf_counter()

    def within_budget(t, y):
        if time.perf_counter() - began > BUDGET:
            raise TookTooLong(f"SciPy needs more than {BUDGET:.0f} s: stopped at t = {t:.4g}")
        return np.asarray(slope(t, y))

    run = solve_ivp(within_budget, ts[[0, -1]], y0, method="DOP853", t_eval=ts, rtol=1e-13, atol=1e-16)
    states = np.full((len(ts), len(y0)), np.nan)
    states[: len(run.t)] = run.y.T
    return states, run.nfev // 12, time.perf_counter() - began


def heyoka(scene: scenes.Scene, ts: np.ndarray, symbolic: Callable) -> tuple[np.ndarray, int, float]:
    """States (T, 2n), steps and seconds of heyoka's scalar integrator."""
    import heyoka as hy

    y0, _ = ravel_pytree(start(scene))
    q, v = ([hy.expression(f"{letter}{i}") for i in range(len(y0) // 2)] for letter in "qv")
    ta = hy.taylor_adaptive(hy.lagrangian(symbolic(hy, q, v), q, v), np.array(y0), time=ts[0], high_accuracy=True)
    began = time.perf_counter()
    *found, states = ta.propagate_grid(ts)
    return states, int(found[3]), time.perf_counter() - began
