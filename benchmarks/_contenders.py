"""The programs that are compared.

Every contender has one verb, `prepare(case) -> solve`, and `solve(tol)` returns the final states (q, q̇) of shape
(members, 2n) as a NumPy array, so that a caller who has them has waited for them, and the steps of each member (or one
number for all). What depends on the case alone is done by `prepare`; what depends on the tolerance, by the first
`solve(tol)`: compile times are read off those two.

A tolerance means rtol = atol = tol, for lagjax too. That is not the same error from program to program (heyoka's is
far below tol), which is why times are compared at equal error.

Peers are set up the way that was fastest when tried, not the most convenient one: the state of plain diffrax is one
array (a tuple of scalars is slower in its stage loop), the velocity term of the autodiff equations is one `jvp`, heyoka
writes its loops out where that compiles. And masses, lengths and the like are constants for all peers, which may fold
them, while lagjax gets them as inputs, as in any call of `simulate`.
"""

import copy
import functools
import importlib.util
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _gradsolve, _mujoco, _numba, _rebound
from benchmarks._cases import Case
from lagjax._native import cores

MAX_STEPS = 100_000
Solve = Callable[[float], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Contender:
    """`members` bounds the batch of a program that runs one trajectory after the other: its cost is proportional."""

    name: str
    prepare: Callable[[Case], Solve]
    packages: tuple[str, ...] = ()
    suits: Callable[[Case], str | None] = lambda case: None
    members: int | None = None

    def available(self, case: Case) -> str | None:
        """None, or the reason why this contender cannot run this case."""
        for package in self.packages:
            if not installed(package):
                return f"{package} is not installed"
        return self.suits(case)


def installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


# ---- lagjax ----------------------------------------------------------------------------------------------------------


def lagjax_batch(**options) -> Callable[[Case], Solve]:
    """`lagjax.simulate_batch`, called as a user does."""

    def prepare(case):
        scene, ts = case.scene, np.array([0.0, case.duration])
        q0, qdot0 = case.tree(case.q0), case.tree(case.qdot0)

        def solve(tol):
            run = lagjax.simulate_batch(
                scene.system, q0, qdot0, ts, scene.params, rtol=tol, atol=tol, max_steps=MAX_STEPS, **options
            )
            return rows_of(run.end, case.batch), np.asarray(run.stats["num_steps"])

        return solve

    return prepare


def _lagjax_single(jit: bool = True, **options) -> Callable[[Case], Solve]:
    """`lagjax.simulate`, for one member after the other; with `jit` in a compiled function, as those of diffrax are."""

    def prepare(case):
        scene, ts = case.scene, np.array([0.0, case.duration])
        starts = [(case.tree(q), case.tree(v)) for q, v in zip(case.q0, case.qdot0, strict=True)]

        @functools.cache
        def simulation(tol):
            def run(q0, qdot0):
                trajectory = lagjax.simulate(
                    scene.system, q0, qdot0, ts, scene.params, rtol=tol, atol=tol, max_steps=MAX_STEPS, **options
                )
                return trajectory.end, trajectory.stats["num_steps"]

            return jax.jit(run) if jit else run

        def one(start, tol):
            end, steps = simulation(tol)(*start)
            return rows_of(end, 1)[0], steps

        return lambda tol: _one_by_one(one, starts, tol)

    return prepare


def rows_of(end, batch: int) -> np.ndarray:
    """(q, q̇) of every member, shape (batch, 2n)."""
    leaves = jax.tree.leaves((end.q, end.qdot))
    return np.concatenate([np.asarray(leaf).reshape(batch, -1) for leaf in leaves], axis=1)


def _one_by_one(solve: Callable, starts, tol: float) -> tuple[np.ndarray, np.ndarray]:
    final, steps = zip(*(solve(start, tol) for start in starts), strict=True)
    return np.stack(final), np.array(steps)


# ---- plain diffrax ---------------------------------------------------------------------------------------------------


def autodiff_acceleration(case: Case) -> Callable:
    """q̈ = M⁻¹(∂L/∂q − (∂p/∂q)q̇) of one state, by `jax.grad`, `jax.hessian` and LAPACK, as most people write it."""
    L = case.lagrangian

    def acceleration(q, v):
        momentum_rate = jax.jvp(lambda q: jax.grad(L, 1)(q, v), (q,), (v,))[1]
        return jnp.linalg.solve(jax.hessian(L, 1)(q, v), jax.grad(L, 0)(q, v) - momentum_rate)

    return acceleration


def by_hand(case: Case) -> Callable:
    """The same, in the formulas of `case.acceleration`."""
    return lambda q, v: jnp.asarray(case.acceleration(q, v))


def diffeqsolve(case: Case, acceleration: Callable, max_steps: int = MAX_STEPS, adjoint=None) -> Callable:
    """`(y0, tol) -> y` at the end and the number of steps, one member, in plain diffrax."""
    n = case.coordinates

    def field(t, y, args):
        return jnp.concatenate([y[n:], acceleration(y[:n], y[n:])])

    def solve(y0, tol):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            t0=0.0,
            t1=case.duration,
            dt0=None,
            y0=y0,
            stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
            adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
            max_steps=max_steps,
            throw=False,
        )
        return solution.ys[-1], solution.stats["num_steps"]

    return solve


def _diffrax(derive: Callable, batched: bool = True) -> Callable[[Case], Solve]:
    def prepare(case):
        one = diffeqsolve(case, derive(case))
        run, y0 = jax.jit(jax.vmap(one, in_axes=(0, None)) if batched else one), jnp.asarray(case.states)
        if batched:
            return lambda tol: tuple(map(np.asarray, run(y0, tol)))
        return lambda tol: _one_by_one(lambda y, tol: tuple(map(np.asarray, run(y, tol))), y0, tol)

    return prepare


def _has_formulas(case: Case) -> str | None:
    return None if case.acceleration else "nobody writes these equations by hand"


# ---- heyoka ----------------------------------------------------------------------------------------------------------


def heyoka_system(case: Case) -> list:
    """The equations of motion, derived by heyoka from the symbolic Lagrangian; what it has compiled is forgotten."""
    import heyoka as hy

    hy.llvm_state.clear_memcache()
    if hasattr(hy.llvm_state, "set_diskcache_enabled"):  # or compile times would be those of reading a file
        hy.llvm_state.set_diskcache_enabled(False)
    q, v = ([hy.expression(f"{letter}{i}") for i in range(case.coordinates)] for letter in "qv")
    if case.equations is not None:
        rates = [*v, *case.equations(hy, q, v)]
        return list(zip([*q, *v], rates, strict=True))
    return hy.lagrangian(case.symbolic(hy, q, v), q, v)


def heyoka_width(case: Case) -> int:
    """How many trajectories share a SIMD lane: what heyoka recommends, or twice that in compact mode (faster there)."""
    import heyoka as hy

    return hy.recommended_simd_size() * (2 if case.long_formulas else 1)


def _heyoka_single(case: Case) -> Solve:
    import heyoka as hy

    equations, integrators = heyoka_system(case), {}

    def one(state, tol):
        ta = integrators[tol]
        ta.time = 0.0
        ta.state[:] = state
        steps = ta.propagate_until(case.duration)[3]
        return ta.state.copy(), steps

    def solve(tol):
        if tol not in integrators:
            integrators[tol] = hy.taylor_adaptive(
                equations, case.states[0].copy(), tol=tol, compact_mode=case.long_formulas
            )
        return _one_by_one(one, case.states, tol)

    return solve


def _heyoka_blocks(case: Case) -> np.ndarray:
    """The states as (blocks, 2n, width), the last block filled up with copies of the last member."""
    width, states = heyoka_width(case), case.states
    filled = np.concatenate([states, np.repeat(states[-1:], -len(states) % width, axis=0)])
    return np.ascontiguousarray(filled.reshape(-1, width, states.shape[1]).transpose(0, 2, 1))


def _heyoka_integrator(case: Case, equations: list, blocks: np.ndarray) -> Callable:
    import heyoka as hy

    return lambda tol: hy.taylor_adaptive_batch(equations, blocks[0].copy(), tol=tol, compact_mode=case.long_formulas)


def _heyoka_batch(case: Case) -> Solve:
    blocks, integrators = _heyoka_blocks(case), {}
    build = _heyoka_integrator(case, heyoka_system(case), blocks)

    def solve(tol):
        ta = integrators[tol] if tol in integrators else integrators.setdefault(tol, build(tol))
        return _members(*_propagated(ta, blocks, case.duration), case.batch)

    return solve


def _heyoka_threads(case: Case) -> Solve:
    """The batch integrator on all cores that this process may use, a copy for each: heyoka lets go of Python's lock.

    (heyoka's own `ensemble_propagate_until_batch` copies the integrator for every block, which here costs more.)
    """
    workers = cores()
    shares, integrators = np.array_split(_heyoka_blocks(case), workers), {}
    shares = [share for share in shares if len(share)]
    build = _heyoka_integrator(case, heyoka_system(case), shares[0])
    pool = ThreadPoolExecutor(workers)

    def solve(tol):
        if tol not in integrators:
            first = build(tol)
            integrators[tol] = [first, *(copy.deepcopy(first) for _ in shares[1:])]
        runs = pool.map(lambda ta, share: _propagated(ta, share, case.duration), integrators[tol], shares)
        return _members(*map(np.concatenate, zip(*runs, strict=True)), case.batch)

    return solve


def _propagated(ta, blocks: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    final, steps = np.empty_like(blocks), np.empty((len(blocks), blocks.shape[2]), int)
    for block, out, count in zip(blocks, final, steps, strict=True):
        ta.set_time(0.0)
        ta.state[:] = block
        ta.propagate_until(duration)
        out[:], count[:] = ta.state, [result[3] for result in ta.propagate_res]
    return final, steps


def _members(blocks: np.ndarray, steps: np.ndarray, batch: int) -> tuple[np.ndarray, np.ndarray]:
    return blocks.transpose(0, 2, 1).reshape(-1, blocks.shape[1])[:batch], steps.ravel()[:batch]


def reference(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Final states from a program and a method other than those measured, and a second, looser one to judge them by.

    heyoka at tol = 1e-18 (its series is then long enough that round-off alone is left) and at 1e-16. Without heyoka,
    and where it compiles for minutes, DOP853 at 1e-13 and 1e-12 over all members at once, on the autodiff equations.
    """
    if installed("heyoka") and _heyoka_compiles(case) is None:
        solve = _heyoka_batch(case)
        return solve(1e-18)[0], solve(1e-16)[0]
    few = case.first(8)
    return tuple(dop853_of_all(few, autodiff_acceleration(few), tol) for tol in (1e-13, 1e-12))


def _heyoka_compiles(case: Case) -> str | None:
    long = case.equations is None and case.long_formulas and case.coordinates > 16
    return "heyoka takes minutes to compile formulas this long" if long else None


# ---- SciPy and SymPy -------------------------------------------------------------------------------------------------


def sympy_functions(case: Case) -> Callable:
    """`y -> (M, F)` by SymPy: `LagrangesMethod`, common subexpressions shared, lambdified."""
    import sympy
    from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

    n = case.coordinates
    q = dynamicsymbols(f"q:{n}")
    v = dynamicsymbols(f"q:{n}", 1)
    ops = SimpleNamespace(sin=sympy.sin, cos=sympy.cos, sqrt=sympy.sqrt)
    method = LagrangesMethod(case.symbolic(ops, q, v), q)
    method.form_lagranges_equations()
    plain = [sympy.Symbol(f"{letter}{i}") for letter in "qv" for i in range(n)]
    names = dict(zip([*v, *q], [*plain[n:], *plain[:n]], strict=True))  # velocities first: they contain the q
    mass, force = (part.xreplace(names) for part in (method.mass_matrix, method.forcing))
    return sympy.lambdify([plain], [mass, force], "numpy", cse=True)


def _scipy(case: Case) -> Solve:
    from scipy.integrate import solve_ivp

    parts, n = sympy_functions(case), case.coordinates

    def field(t, y):
        mass, force = parts(y)
        return np.concatenate([y[n:], np.linalg.solve(mass, force)[:, 0]])

    def solve(tol):
        runs = [solve_ivp(field, (0.0, case.duration), y, method="DOP853", rtol=tol, atol=tol) for y in case.states]
        return np.stack([run.y[:, -1] for run in runs]), np.array([len(run.t) - 1 for run in runs])

    return solve


def dop853_of_all(case: Case, acceleration: Callable, tol: float) -> np.ndarray:
    """Final states by SciPy's DOP853, all members as one system, from q̈ of one state."""
    from scipy.integrate import solve_ivp

    n, derived = case.coordinates, jax.jit(jax.vmap(acceleration))

    def field(t, y):
        y = y.reshape(-1, 2 * n)
        return np.concatenate([y[:, n:], derived(y[:, :n], y[:, n:])], axis=1).ravel()

    run = solve_ivp(field, (0.0, case.duration), case.states.ravel(), method="DOP853", rtol=tol, atol=tol)
    return run.y[:, -1].reshape(case.states.shape)


def _sympy_copes(case: Case) -> str | None:
    return "SymPy takes minutes for formulas this long" if case.long_formulas else None


# ---- who takes part --------------------------------------------------------------------------------------------------

HEYOKA = {"packages": ("heyoka",), "suits": _heyoka_compiles}

BATCHED = (
    Contender("lagjax", lagjax_batch()),
    Contender("lagjax, diffrax", lagjax_batch(solver=diffrax.Dopri8())),
    Contender("diffrax, by hand", _diffrax(by_hand), suits=_has_formulas),
    Contender("diffrax, autodiff", _diffrax(autodiff_acceleration)),
    Contender("heyoka, SIMD", _heyoka_batch, **HEYOKA),
    Contender("heyoka, threads", _heyoka_threads, **HEYOKA),
    Contender("heyoka, single", _heyoka_single, **HEYOKA, members=128),
    Contender("gradsolve", _gradsolve.prepare, ("gradsolve", "warp"), suits=_gradsolve.why_not),
    Contender("numba", _numba.prepare, ("numba", "scipy"), suits=_numba.why_not),
    Contender("REBOUND", _rebound.prepare, ("rebound",), suits=_rebound.why_not),
    Contender("MuJoCo", _mujoco.prepare, ("mujoco",), suits=_mujoco.why_not, members=32),
    Contender("SciPy + SymPy", _scipy, ("scipy", "sympy"), suits=_sympy_copes, members=4),
)

SINGLE = (  # one trajectory after the other
    Contender("lagjax", _lagjax_single()),
    Contender("lagjax, no jit", _lagjax_single(jit=False)),
    Contender("lagjax, diffrax", _lagjax_single(solver=diffrax.Dopri8())),
    Contender("diffrax, by hand", _diffrax(by_hand, batched=False), suits=_has_formulas),
    Contender("diffrax, autodiff", _diffrax(autodiff_acceleration, batched=False)),
    Contender("heyoka, single", _heyoka_single, **HEYOKA),
    Contender("SciPy + SymPy", _scipy, ("scipy", "sympy"), suits=_sympy_copes, members=4),
)


def named(*names: str) -> list[Contender]:
    return [contender for contender in BATCHED if contender.name in names]
