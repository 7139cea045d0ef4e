"""The motion of a scalar program as a function that JAX can transform, computed by machine code on the CPU.

A `Flow` is the map from (output times, initial state, parameters) to the states at those times. While JAX traces it, it
is one callback, and under `vmap` one callback for the whole batch. Its derivative is the flow of a larger system: to q
belong the sensitivities ∂q/∂x by every number x that is being varied, and they move by

    d²/dt² ∂q/∂x = ∂q̈/∂q ∂q/∂x + ∂q̈/∂q̇ ∂q̇/∂x + ∂q̈/∂x

which is a program like any other. So forward and reverse mode have the same cost and the same digits, a sensitivity is
as accurate as the motion, and derivatives of every order exist. Source: Hairer, Nørsett & Wanner, *Solving Ordinary
Differential Equations I*, §I.14.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.experimental.buffer_callback import buffer_callback

from lagjax import _native
from lagjax._program import Program, Unlowerable, lower

LARGEST_PROGRAM = 6_000  # operations of an acceleration, beyond which LLVM takes too long
_BUDGET = 100_000  # operations of a program with sensitivities


class Outcome(NamedTuple):
    """The states (q, q̇) at the output times and at the end, how it ended, and counts."""

    path: jax.Array
    y_end: jax.Array
    t_end: jax.Array
    code: jax.Array
    accepted: jax.Array
    rejected: jax.Array


class Tolerances(NamedTuple):
    """How far a run may be off, and what it may cost."""

    rtol: float
    atol: float
    max_steps: int


def unfit(program: Program, size: int, dtype) -> str | None:
    """Why there is no machine code for a scene, as the end of a sentence; None where there is."""
    if jax.default_backend() != "cpu":
        return f"the default device is a {jax.default_backend()}"
    if dtype != np.float64:
        return f"the coordinates are {np.dtype(dtype).name}, not float64"
    if program.operations > LARGEST_PROGRAM:
        return f"its acceleration takes {program.operations} operations, more than {LARGEST_PROGRAM}"
    try:
        _native.recurrences(program, size)
    except Unlowerable as reason:
        return str(reason)
    return None


class Flow:
    """The map of one program for q̈ with n coordinates.

    `program` takes q, q̇, t and then the parameters, number by number; it gives q̈ and whether the mass matrix is
    singular. `projection`, from the same to (q, q̇), keeps the motion on its constraints. `guards` end the motion early:
    then the outcome is a plain number, without derivatives.
    """

    def __init__(
        self,
        program: Program,
        size: int,
        projection: Program | None = None,
        guards: _native.Guards | None = None,
        groups: tuple[int, ...] | None = None,
    ):
        self.program, self.size, self.projection, self.guards = program, size, projection, guards
        self.groups = tuple(range(size)) if groups is None else groups
        self.kernel = _native.Kernel(program, size, projection, guards, self.groups)
        self.traceable = functools.lru_cache(maxsize=16)(self._traceable)
        self.varied = functools.lru_cache(maxsize=16)(self._varied)

    @property
    def states(self) -> int:
        """Numbers in a state: q, then q̇."""
        return 2 * self.size

    def run(self, ts, y0, params, tolerances: Tolerances) -> tuple[Outcome, int]:
        """For arrays of numbers: `ts` (N, T) or (1, T), `y0` (N, 2n), `params` (N, P) or (1, P).

        The second result counts the steps for which lanes stood empty.
        """
        *outcome, idle = self.kernel(ts, y0, params, *tolerances)
        return Outcome(*outcome), idle

    def _traceable(self, tolerances: Tolerances) -> Callable:
        """`(ts, y0, *params)` → `Outcome` of one member, under every transformation of JAX."""

        if self.guards is not None:
            run = self.undifferentiated(tolerances)
            return lambda *arrays: run(*map(jax.lax.stop_gradient, arrays))
        run = jax.custom_jvp(self.undifferentiated(tolerances))

        @functools.partial(run.defjvp, symbolic_zeros=True)
        def rule(primals, tangents):
            return _push(self, tolerances, primals, tangents)

        return run

    def undifferentiated(self, tolerances: Tolerances) -> Callable:
        """The same without derivatives."""

        # Not `jax.pure_callback`: it puts its arguments on the device once more and waits for that, on the threads that
        # the callbacks themselves may occupy.
        def on_host(_, places, *arrays):
            outcome = _over_batch(lambda *rows: self.run(*rows, tolerances)[0], *map(np.asarray, arrays))
            for place, values in zip(places, outcome, strict=True):
                np.asarray(place)[...] = values

        def run(ts, y0, *params):
            shapes = [(*ts.shape, self.states), (self.states,), (), (), (), ()]
            dtypes = [np.float64] * 3 + [np.int64] * 3
            places = tuple(jax.ShapeDtypeStruct(*of) for of in zip(shapes, dtypes, strict=True))
            return Outcome(*buffer_callback(on_host, places, vmap_method="expand_dims")(ts, y0, *params))

        return run

    # ---- sensitivities ----

    def _varied(self, by_state: bool, params: tuple[int, ...]) -> "Flow":
        """The flow of q and of ∂q/∂x, for x in y0 (if asked for) and in these parameters; (1 + x's, n) coordinates."""
        n, free = self.size, self.states * by_state  # an initial state has no ∂q̈/∂x
        rows, numbers, chosen = 1 + free + len(params), self.program.size - self.states - 1, np.array(params, int)

        def derivative(function, q, v, t, p):
            """`function(q, v, t, p)` at the first rows, and for the others how it varies with them."""
            def of_varied(q, v, x):
                return function(q, v, t, p.at[chosen].set(x))

            by_q, by_v, by_x = jax.jacfwd(of_varied, argnums=(0, 1, 2))(q[0], v[0], p[chosen])
            varied = (q[1:] @ by_q.T + v[1:] @ by_v.T).at[free:].add(by_x.T)
            return jnp.concatenate([function(q[0], v[0], t, p)[None], varied])

        def accelerations(q, v, t, p):
            return jnp.stack(self.program(*q, *v, t, *p)[:n])

        def moving(q, v, t, p):
            return derivative(accelerations, q, v, t, p), self.program(*q[0], *v[0], t, *p)[n]

        def projected(q, v, t, p):
            both = derivative(lambda *state: jnp.stack(self.projection(*state[0], *state[1], t, *state[3])), q, v, t, p)
            return both[:, :n], both[:, n:]

        shapes = [jax.ShapeDtypeStruct(shape, np.float64) for shape in ((rows, n), (rows, n), (), (numbers,))]
        projection = None if self.projection is None else lower(projected, *shapes, budget=_BUDGET)
        # A sensitivity that is zero by symmetry is as exact as the others in its row, not exact relative to itself.
        groups = self.groups + tuple(n + row for row in range(rows - 1) for _ in range(n))
        return Flow(lower(moving, *shapes, budget=_BUDGET), rows * n, projection, None, groups)


def _push(flow: Flow, tolerances: Tolerances, primals, tangents) -> tuple[Outcome, Outcome]:
    """The outcome, and its tangent: sensitivities times what varies, and slopes times the output times."""
    (ts, y0, *params), (dts, dy0, *dparams) = primals, tangents
    by_time, moved = not isinstance(dts, SymbolicZero), not isinstance(dy0, SymbolicZero)
    by_state = moved or by_time  # to start later from the same state is to start from another state
    active = tuple(i for i, dx in enumerate(dparams) if not isinstance(dx, SymbolicZero))
    n, free = flow.size, flow.states * by_state
    rows = 1 + free + len(active)

    # (rows, states) to the coordinates of the larger system, (2, rows, n) end to end, and back.
    start = jnp.asarray(np.eye(rows, flow.states, -1) * by_state).at[0].set(y0)
    larger = flow.varied(by_state, active).traceable(tolerances)
    outcome = larger(ts, start.reshape(rows, 2, n).swapaxes(0, 1).ravel(), *params)

    def by_rows(y):
        y = y.reshape(*y.shape[:-1], 2, rows, n)
        return jnp.moveaxis(y, -2, 0).reshape(rows, *y.shape[:-3], flow.states)

    (path, *path_by), (y_end, *end_by) = by_rows(outcome.path), by_rows(outcome.y_end)

    def slope(t, y):
        rate = jnp.concatenate([y[n:], jnp.stack(flow.program(*y, t, *params)[:-1])])
        return jnp.where(jnp.isfinite(rate), rate, 0.0)  # where it is not, the motion has ended

    varied = (dy0 if moved else jnp.zeros_like(y0)) - (slope(ts[0], y0) * dts[0] if by_time else 0.0)
    weights = [*(varied if by_state else ()), *(dparams[i] for i in active)]
    # What was not reached is NaN, which must not meet the zero cotangent of an output that nobody uses.
    reached, done = jnp.isfinite(path), outcome.code == _native.DONE
    d_path = sum(w * jnp.where(reached, dy, 0.0) for w, dy in zip(weights, path_by, strict=True))
    d_end = sum(w * dy for w, dy in zip(weights, end_by, strict=True))
    d_t_end = jnp.zeros_like(outcome.t_end)
    if by_time:
        moving = jax.vmap(slope)(ts, jnp.where(reached, path, y0)) * dts[:, None]
        d_path = d_path + jnp.where(reached, moving, 0.0)
        d_end = d_end + jnp.where(done, moving[-1], 0.0)
        d_t_end = jnp.where(done, dts[-1], 0.0)
    counts = [np.zeros((), jax.dtypes.float0)] * 3
    return outcome._replace(path=path, y_end=y_end), Outcome(d_path, d_end, d_t_end, *counts)


def _over_batch(run: Callable, ts, y0, *params) -> tuple[np.ndarray, ...]:
    """Call `run` with rows of members for arrays with any batch axes in front, of length one where they share."""
    ts, y0, *params = (np.asarray(x, np.float64) for x in (ts, y0, *params))
    batch = np.broadcast_shapes(ts.shape[:-1], y0.shape[:-1], *(p.shape for p in params))
    members = math.prod(batch)

    def rows(x, inner: tuple[int, ...]):
        if x.size == math.prod(inner):
            return x.reshape(1, *inner)
        return np.broadcast_to(x, batch + inner).reshape(members, *inner)

    columns = [rows(p, ()) for p in params]
    count = max((len(column) for column in columns), default=1)
    numbers = np.stack([np.broadcast_to(column, count) for column in columns] or [np.zeros(count)], axis=1)
    states = np.broadcast_to(rows(y0, y0.shape[-1:]), (members, y0.shape[-1]))
    outcome = run(rows(ts, ts.shape[-1:]), states, numbers)
    return tuple(np.asarray(x).reshape(batch + np.shape(x)[1:]) for x in outcome)
