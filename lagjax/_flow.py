"""The motion of a scalar program as a function that JAX can transform, computed by machine code on the CPU.

A `Flow` is the map from (output times, initial state, parameters) to the states at those times. While JAX traces it, it
is one callback, and under `vmap` one callback for the whole batch. It has derivatives of every order, in two ways.

Forward mode is the flow of a larger system: to q belong the sensitivities ∂q/∂x by every number x that is being varied,
and they move by

    d²/dt² ∂q/∂x = ∂q̈/∂q ∂q/∂x + ∂q̈/∂q̇ ∂q̇/∂x + ∂q̈/∂x

which is a program like any other: a sensitivity is as accurate as the motion. Source: Hairer, Nørsett & Wanner,
*Solving Ordinary Differential Equations I*, §I.14.

Reverse mode goes back over the steps of the motion itself, each transposed (`_native._adjoint`): its cost does not grow
with the number of parameters. The two agree within the tolerance.
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
# Entries of ∂q̈/∂(q, q̇, parameters) up to which all sensitivities are followed at once.
LARGEST_JACOBIAN = 150
# How a motion ends that its program cannot follow.
GIVEN_UP = (_native.SINGULAR, _native.NOT_FINITE, _native.STEP_TOO_SMALL, _native.NOT_LANDED)


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
    tries: int = 4

    @property
    def elsewhere(self) -> "Tolerances":
        """For another try, whose steps end at other places."""
        return self._replace(rtol=0.7 * self.rtol, atol=0.7 * self.atol, tries=self.tries - 1)

    @property
    def patient(self) -> "Tolerances":
        """For a motion with its sensitivities, which takes more steps."""
        return self._replace(max_steps=4 * self.max_steps)


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
    singular. `projection` keeps the motion on its constraints. `guards` end the motion early: then the outcome is a
    plain number, without derivatives. `careful()` is the flow for members that a program which does not hold everywhere
    cannot follow: they start again, from the beginning.
    """

    def __init__(
        self,
        program: Program,
        size: int,
        projection: _native.Projection | None = None,
        guards: _native.Guards | None = None,
        groups: tuple[int, ...] | None = None,
        careful: Callable[[], "Flow | None"] | None = None,
    ):
        self.size, self.guards = size, guards
        self.groups = tuple(range(size)) if groups is None else groups
        self._given = program, projection
        self.careful = functools.cache(self._careful if careful is None else careful)
        self.traceable = functools.lru_cache(maxsize=16)(self._traceable)
        self.varied = functools.lru_cache(maxsize=16)(self._varied)

    @functools.cached_property
    def _programs(self):
        return self._given

    @property
    def program(self) -> Program:
        """q̈ and whether the mass matrix is singular."""
        return self._programs[0]

    @property
    def projection(self) -> _native.Projection | None:
        """The way back to the constraints, where there are some."""
        return self._programs[1]

    @functools.cached_property
    def kernel(self) -> _native.Kernel:
        """The machine code."""
        return _native.Kernel(self.program, self.size, self.projection, self.guards, self.groups, self.own)

    @property
    def own(self) -> int:
        """Coordinates that are the motion itself, not derivatives of it."""
        return self.size

    @property
    def states(self) -> int:
        """Numbers in a state: q, then q̇."""
        return 2 * self.size

    def run(self, ts, y0, params, tolerances: Tolerances, keep: bool = False) -> tuple[Outcome, int]:
        """For arrays of numbers: `ts` (N, T) or (1, T), `y0` (N, 2n), `params` (N, P) or (1, P).

        The second result counts the steps for which lanes stood empty. With `keep`, `pull` may come next.
        """
        *outcome, idle = self.kernel(ts, y0, params, *tolerances[:3], keep)
        outcome = Outcome(*outcome)
        again, flow, tolerances = self._second_chance(outcome.code, tolerances)
        if not again.any():
            return outcome, idle
        better, more = flow.run(*(x[again] if len(x) > 1 else x for x in (ts, y0, params)), tolerances)
        for values, new in zip(outcome, better, strict=True):
            values[again] = new
        return outcome, idle + more

    def pull(self, ts, y0, params, steps, path_bar, y_bar, tolerances: Tolerances) -> _native.Cotangents:
        """The transpose of the derivative of `run`, which took so many `steps`; see `Kernel.pull`."""
        cotangents = self.kernel.pull(ts, y0, params, steps, path_bar, y_bar, *tolerances[:3])
        again, flow, tolerances = self._second_chance(cotangents.code, tolerances)
        if again.any():
            shared = (x[again] if len(x) > 1 else x for x in (ts, y0, params))
            better = flow.pull(*shared, steps[again], path_bar[again], y_bar[again], tolerances)
            for values, new in zip(cotangents, better, strict=True):
                values[again] = new
        return cotangents

    def _second_chance(self, code, tolerances: Tolerances) -> tuple[np.ndarray, "Flow", Tolerances]:
        """The members to run once more, and how.

        A program that does not hold everywhere gives way to one that does. And where constraints become dependent, as
        at a dead centre, a step must not end: rounding of q would decide on q̇. It is by accident that one does.
        """
        if (code == _native.DONE).all():
            return np.zeros(len(code), bool), self, tolerances
        given_up = np.isin(code, GIVEN_UP)
        if given_up.any() and (careful := self.careful()) is not None:
            return given_up, careful, tolerances
        return (code == _native.NOT_LANDED) & (tolerances.tries > 1), self, tolerances.elsewhere

    def _careful(self) -> "Flow | None":
        """With the program that holds everywhere; None where this is it, or where that is too large."""
        program = self.everywhere
        if program is self.program or program.operations > LARGEST_PROGRAM:
            return None
        return Flow(program, self.size, self.projection, self.guards, self.groups)

    @property
    def everywhere(self) -> Program:
        """The program that holds everywhere, if there is one."""
        try:
            return self.program.complete
        except Unlowerable:
            return self.program

    def _traceable(self, tolerances: Tolerances, keep: bool = False) -> Callable:
        """`(ts, y0, *params)` → `Outcome` of one member, under every transformation of JAX."""

        if self.guards is not None:
            run = self.undifferentiated(tolerances)
            return lambda *arrays: run(*map(jax.lax.stop_gradient, arrays))
        run = jax.custom_jvp(self.undifferentiated(tolerances, keep))

        @functools.partial(run.defjvp, symbolic_zeros=True)
        def rule(primals, tangents):
            return _push(self, tolerances, primals, tangents)

        return jax.jit(run)  # a derivative outside of `jit` compiles as one, not operation by operation

    def undifferentiated(self, tolerances: Tolerances, keep: bool = False) -> Callable:
        """The same without derivatives."""

        # Not `jax.pure_callback`: it puts its arguments on the device once more and waits for that, on the threads that
        # the callbacks themselves may occupy.
        def on_host(_, places, *arrays):
            outcome = _over_batch(lambda *rows: self.run(*rows, tolerances, keep)[0], *map(np.asarray, arrays))
            for place, values in zip(places, outcome, strict=True):
                np.asarray(place)[...] = values

        def run(ts, y0, *params):
            shapes = [(*ts.shape, self.states), (self.states,), (), (), (), ()]
            dtypes = [np.float64] * 3 + [np.int64] * 3
            places = tuple(jax.ShapeDtypeStruct(*of) for of in zip(shapes, dtypes, strict=True))
            return Outcome(*buffer_callback(on_host, places, vmap_method="expand_dims")(ts, y0, *params))

        return run

    @functools.cached_property
    def directed(self) -> "Flow":
        """The flow of this one's derivative along a direction that is among its numbers."""
        return _Directed(self)

    def _varied(self, by_state: bool, params: tuple[int, ...]) -> "Flow":
        return _Varied(self, by_state, params)


# ---- derivatives -----------------------------------------------------------------------------------------------------


class _Varied(Flow):
    """The flow of q and of ∂q/∂x, for x in y0 (if asked for) and in these parameters; (1 + x's, n) coordinates.

    Its program is made when it is first needed: whoever only asks for reverse mode does not wait for it.
    """

    def __init__(self, base: Flow, by_state: bool, params: tuple[int, ...]):
        self.base, self.free, self.chosen = base, base.states * by_state, params  # an initial state has no ∂q̈/∂x
        self.rows = 1 + self.free + len(params)
        n = base.size
        # A sensitivity that is zero by symmetry is as exact as the others in its row, not exact relative to itself.
        groups = base.groups + tuple(n + row for row in range(self.rows - 1) for _ in range(n))

        def careful():
            return flow.varied(by_state, params) if (flow := base.careful()) else None

        super().__init__(None, self.rows * n, None, None, groups, careful)

    @property
    def own(self) -> int:
        return self.base.size

    # A state is (2, rows, n), end to end; the first row is the motion, and row by row states are (rows, 2, n).

    def start(self, y0):
        """The state at the beginning, from that of the motion, shape (..., 2n)."""
        n, states = self.base.size, self.base.states
        unit = np.eye(self.rows, states, -1)[1:] * (self.free > 0)
        library = np if isinstance(y0, np.ndarray) else jnp
        y = library.concatenate([y0[..., None, :], library.broadcast_to(unit, (*y0.shape[:-1], *unit.shape))], axis=-2)
        return y.reshape(*y0.shape[:-1], self.rows, 2, n).swapaxes(-3, -2).reshape(*y0.shape[:-1], self.states)

    def sensitivities(self, y):
        """∂y/∂x for every x, in front of all other axes, from states of shape (..., 2 · rows · n)."""
        n, library = self.base.size, np if isinstance(y, np.ndarray) else jnp
        by_rows = library.moveaxis(y.reshape(*y.shape[:-1], 2, self.rows, n), -2, 0)
        return by_rows.reshape(self.rows, *y.shape[:-1], 2 * n)[1:]

    @functools.cached_property
    def _programs(self):
        base, n, rows = self.base, self.base.size, self.rows
        numbers, chosen = base.program.size - base.states - 1, np.array(self.chosen, int)

        def derivative(function, q, v, t, p):
            """`function(q, v, t, p)` at the first rows, and for the others how it varies with them."""

            def of_varied(q, v, x):
                return function(q, v, t, p.at[chosen].set(x))

            by_q, by_v, by_x = jax.jacfwd(of_varied, argnums=(0, 1, 2))(q[0], v[0], p[chosen])
            varied = (q[1:] @ by_q.T + v[1:] @ by_v.T).at[self.free :].add(by_x.T)
            return jnp.concatenate([function(q[0], v[0], t, p)[None], varied])

        def accelerations(q, v, t, p):
            return jnp.stack(base.program(*q, *v, t, *p)[:n])

        def moving(q, v, t, p):
            return derivative(accelerations, q, v, t, p), base.program(*q[0], *v[0], t, *p)[n]

        def projected(q, v, t, p):
            state = base.projection.state
            both = derivative(lambda q, v, t, p: jnp.stack(state(*q, *v, t, *p)), q, v, t, p)
            return both[:, :n], both[:, n:]

        def speeds(q, v, t, p):
            return base.projection.speeds(*q[0], *v[0], t, *p)

        back = None if base.projection is None else (projected, speeds)
        return _lowered(moving, back, (rows, n), (rows, n), (), (numbers,))


class _Directed(Flow):
    """The flow of q and of its derivative δq along one direction (δy0, δparams): 2n coordinates, twice the numbers."""

    def __init__(self, base: Flow):
        self.base = base

        def careful():
            return flow.directed if (flow := base.careful()) else None

        super().__init__(None, 2 * base.size, None, None, base.groups + (base.size,) * base.size, careful)

    @property
    def own(self) -> int:
        return self.base.size

    @functools.cached_property
    def _programs(self):
        base, n = self.base, self.base.size
        numbers = base.program.size - base.states - 1

        def derivative(function, q, v, t, p):
            values, moving = jax.jvp(lambda q, v, p: function(q, v, t, p), (q[0], v[0], p[0]), (q[1], v[1], p[1]))
            return jnp.stack([values, moving])

        def moving(q, v, t, p):
            accelerations = derivative(lambda q, v, t, p: jnp.stack(base.program(*q, *v, t, *p)[:n]), q, v, t, p)
            return accelerations, base.program(*q[0], *v[0], t, *p[0])[n]

        def projected(q, v, t, p):
            state = base.projection.state
            both = derivative(lambda q, v, t, p: jnp.stack(state(*q, *v, t, *p)), q, v, t, p)
            return both[:, :n], both[:, n:]

        def speeds(q, v, t, p):
            return base.projection.speeds(*q[0], *v[0], t, *p[0])

        back = None if base.projection is None else (projected, speeds)
        return _lowered(moving, back, (2, n), (2, n), (), (2, numbers))


def _lowered(moving: Callable, back: tuple[Callable, Callable] | None, *shapes):
    """The two programs of a flow, from functions of arrays of these shapes."""
    arrays = [jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes]
    program, *parts = (lower(function, *arrays, budget=_BUDGET) for function in (moving, *(back or ())))
    return program, _native.Projection(*parts) if parts else None


def _push(flow: Flow, tolerances: Tolerances, primals, tangents) -> tuple[Outcome, Outcome]:
    """The outcome, and its tangent: that of the motion between fixed times, and slopes times the output times."""
    (ts, y0, *params), (dts, dy0, *dparams) = primals, tangents
    by_time, moved = not isinstance(dts, SymbolicZero), not isinstance(dy0, SymbolicZero)
    by_state = moved or by_time  # to start later from the same state is to start from another state
    active = tuple(i for i, dx in enumerate(dparams) if not isinstance(dx, SymbolicZero))
    outcome, n = flow.traceable(tolerances, keep=True)(*primals), flow.size

    def slope(t, y):
        rate = jnp.concatenate([y[n:], jnp.stack(flow.everywhere(*y, t, *params)[:-1])])
        return jnp.where(jnp.isfinite(rate), rate, 0.0)  # where it is not, the motion has ended

    varied = (dy0 if moved else jnp.zeros_like(y0)) - (slope(ts[0], y0) * dts[0] if by_time else 0.0)
    moving = jnp.concatenate([*([varied] if by_state else []), *(dparams[i][None] for i in active)])
    d_path, d_end = _Response(flow, tolerances, primals, outcome, by_state, active)(moving)
    d_t_end = jnp.zeros_like(outcome.t_end)
    if by_time:
        reached, done = jnp.isfinite(outcome.path), outcome.code == _native.DONE
        rates = jax.vmap(slope)(ts, jnp.where(reached, outcome.path, y0)) * dts[:, None]
        d_path = d_path + jnp.where(reached, rates, 0.0)
        d_end = d_end + jnp.where(done, rates[-1], 0.0)
        d_t_end = jnp.where(done, dts[-1], 0.0)
    counts = [np.zeros((), jax.dtypes.float0)] * 3
    return outcome, Outcome(d_path, d_end, d_t_end, *counts)


class _Response(NamedTuple):
    """The linear map from what varies, (δy0, δparams), to (δpath, δy_end): the derivative between fixed times.

    There are two programs for it: sensitivities, which give the map, and the transpose of the steps, which gives the
    transposed map at once. JAX learns of both as the solution x of A x = b with A (u, w) = (u, w − R u): x is
    (u, w + R u), and the transposed equation has (u + Rᵀw, w).
    """

    flow: Flow
    tolerances: Tolerances
    primals: tuple
    outcome: Outcome
    by_state: bool
    active: tuple[int, ...]

    def __call__(self, moving):
        """(δpath, δy_end) from the numbers that vary, end to end."""
        count = len(moving)

        # Only derivatives of A are ever computed. JAX transposes it at once, though, and computes there and then what
        # does not depend on x, every sensitivity: `checkpoint` puts that off until somebody asks for it.
        by_sensitivities = jax.checkpoint(self._by_sensitivities)

        def without_response(x):
            return jnp.concatenate([x[:count], x[count:] - by_sensitivities(x[:count])])

        def solved(_, b):
            return jnp.concatenate([b[:count], b[count:] + self.push(b[:count])])

        def transposed(_, b):
            return jnp.concatenate([b[:count] + self.pull(b[count:]), b[count:]])

        shape = self.outcome.path.shape
        b = jnp.pad(moving, (0, shape[0] * shape[1] + shape[1]))
        x = jax.lax.custom_linear_solve(without_response, b, solved, transposed)
        return self._apart(x[count:])

    def _apart(self, flat):
        """What belongs to the path and to the end."""
        shape = self.outcome.path.shape
        return flat[: -shape[1]].reshape(shape), flat[-shape[1] :]

    @property
    def reached(self):
        """What was not reached is NaN, which must not meet the zero cotangent of an output that nobody uses."""
        return jnp.isfinite(self.outcome.path)

    def push(self, moving):
        """Along one direction, or by all sensitivities where those are few; only the latter can be transposed."""
        return self._by_sensitivities(moving) if self._few else self._along(moving)

    @property
    def _few(self) -> bool:
        return self.flow.size * (self.flow.program.size - 1) <= LARGEST_JACOBIAN

    def _along(self, moving):
        """(δpath, δy_end) of a direction of length one, times its length."""
        ts, y0, *params = self.primals
        n, states = self.flow.size, self.flow.states
        length = jnp.max(jnp.abs(moving))
        direction = moving / jnp.where(length > 0, length, 1.0)
        dy0 = direction[:states] if self.by_state else jnp.zeros(states)
        dparams = jnp.zeros(len(params)).at[np.array(self.active, int)].set(direction[states * self.by_state :])
        start = jnp.stack([y0.reshape(2, n), dy0.reshape(2, n)], axis=1).ravel()
        found = self.flow.directed.traceable(self.tolerances.patient)(ts, start, *params, *dparams)

        def moved(y):
            return y.reshape(*y.shape[:-1], 2, 2, n)[..., 1, :].reshape(*y.shape[:-1], states)

        d_path = jnp.where(self.reached, moved(found.path), 0.0)
        return length * jnp.concatenate([d_path.ravel(), moved(found.y_end)])

    def _by_sensitivities(self, moving):
        ts, y0, *params = self.primals
        larger = self.flow.varied(self.by_state, self.active)
        found = larger.traceable(self.tolerances.patient)(ts, larger.start(y0), *params)

        d_path = jnp.tensordot(moving, jnp.where(self.reached, larger.sensitivities(found.path), 0.0), 1)
        return jnp.concatenate([d_path.ravel(), moving @ larger.sensitivities(found.y_end)])

    def pull(self, bars):
        """By the transpose of the steps."""
        ts, _, *params = self.primals
        path_bar, end_bar = self._apart(bars)
        path_bar = jnp.where(self.reached, path_bar, 0.0)
        params_bar = jnp.zeros(len(params))
        if self.flow.projection is not None and len(ts) > 2:  # outputs were put on the constraints
            inner, more = jax.vmap(self._back_on_constraints)(ts[1:-1], self.outcome.path[1:-1], path_bar[1:-1])
            path_bar, params_bar = path_bar.at[1:-1].set(inner), params_bar + more.sum(axis=0)
        done = self.outcome.code == _native.DONE
        end_bar = end_bar + jnp.where(done, path_bar[-1], 0.0)
        y0_bar, more = self._on_host(path_bar.at[-1].set(0.0), end_bar)
        params_bar = params_bar + more
        chosen = params_bar[np.array(self.active, int)]
        return jnp.concatenate([y0_bar, chosen]) if self.by_state else chosen

    def _back_on_constraints(self, t, y, bar):
        y = jnp.where(jnp.isfinite(y), y, self.primals[1])
        projection = self.flow.projection.state
        y_bar, *params_bar = jax.vjp(lambda y, *p: jnp.stack(projection(*y, t, *p)), y, *self.primals[2:])[1](bar)
        return y_bar, jnp.stack(params_bar) if params_bar else jnp.zeros(0)

    def _on_host(self, path_bar, end_bar):
        ts, y0, *params = self.primals
        shapes = [jax.ShapeDtypeStruct(shape, np.float64) for shape in (y0.shape, (len(params),))]

        def on_host(_, places, *arrays):
            with jax.enable_x64(True):  # another thread; the program may be made here
                found = _pull_batch(self.flow, self.tolerances, *map(np.asarray, arrays))
            for place, values in zip(places, found, strict=True):
                np.asarray(place)[...] = values

        numbers = jnp.stack(params) if params else jnp.zeros(0)
        callback = buffer_callback(on_host, tuple(shapes), vmap_method="expand_dims")
        return callback(ts, y0, numbers, self.outcome.accepted, path_bar, end_bar)


def _pull_batch(flow: Flow, tolerances: Tolerances, ts, y0, params, steps, path_bar, y_bar) -> list[np.ndarray]:
    """`flow.pull` for arrays with any batch axes in front, of length one where they share."""
    arrays, inner = (ts, y0, params, steps, path_bar, y_bar), (1, 1, 1, 0, 2, 1)
    leading = [x.shape[: x.ndim - k] for x, k in zip(arrays, inner, strict=True)]
    batch, motions = np.broadcast_shapes(*leading), np.broadcast_shapes(*leading[:4])
    members = math.prod(batch)
    if members > math.prod(motions) * (flow.states + params.shape[-1]):  # a Jacobian, row by row
        found = _by_all_sensitivities(flow, tolerances, motions, ts, y0, params, path_bar, y_bar)
        if found is not None:
            return found

    def rows(x, k, shared):
        own = x.shape[x.ndim - k :]
        if shared and x.size == math.prod(own):
            return x.reshape(1, *own)
        return np.broadcast_to(x, batch + own).reshape(members, *own)

    given = [rows(x, k, i in (0, 2)) for i, (x, k) in enumerate(zip(arrays, inner, strict=True))]
    found = flow.pull(*given, tolerances)
    return [x.reshape(*batch, x.shape[-1]) for x in (found.y0, found.params)]


def _by_all_sensitivities(flow: Flow, tolerances, motions, ts, y0, params, path_bar, y_bar):
    """The same for many cotangents of few motions; None where sensitivities are too many, or not to be had."""
    states, numbers = flow.states, params.shape[-1]
    if flow.size * (flow.program.size - 1) > LARGEST_JACOBIAN:
        return None
    larger = flow.varied(True, tuple(range(numbers)))
    start = np.broadcast_to(larger.start(y0), (*motions, larger.states))
    columns = [params[..., i] for i in range(numbers)]
    found = _over_batch(lambda *rows: larger.run(*rows, tolerances.patient)[0], ts, start, *columns)
    path_by, end_by = larger.sensitivities(found[0]), larger.sensitivities(found[1])
    if not (np.isfinite(path_by).all() and np.isfinite(end_by).all()):
        return None
    bars = np.einsum("r...ts,...ts->...r", path_by, path_bar) + np.einsum("r...s,...s->...r", end_by, y_bar)
    return [bars[..., :states], bars[..., states:]]


# ---- arrays with any batch axes --------------------------------------------------------------------------------------


def _over_batch(run: Callable, ts, y0, *params) -> tuple[np.ndarray, ...]:
    """Call `run` with rows of members for arrays with any batch axes in front, of length one where they share."""
    ts, y0, *params = (np.asarray(x, np.float64) for x in (ts, y0, *params))
    batch = np.broadcast_shapes(ts.shape[:-1], y0.shape[:-1], *(p.shape for p in params))
    members = math.prod(batch)

    def rows(x, inner: tuple[int, ...], count: int):
        if x.size == math.prod(inner):
            x = x.reshape(1, *inner)
            return x if count == 1 else np.broadcast_to(x, (count, *inner))
        return np.broadcast_to(x, batch + inner).reshape(members, *inner)

    count = members if any(p.size != 1 for p in params) else 1
    numbers = np.stack([rows(p, (), count) for p in params] or [np.zeros(count)], axis=1)
    states = rows(y0, y0.shape[-1:], members)
    outcome = run(rows(ts, ts.shape[-1:], 1), states, numbers)
    return tuple(np.asarray(x).reshape(batch + np.shape(x)[1:]) for x in outcome)
