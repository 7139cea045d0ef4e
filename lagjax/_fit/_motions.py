"""`Motions`: the motions of many starts together with their derivatives by start and by parameters.

What a fit asks of an engine: rows of starts (N, 2n), each with times of its own (N, T), and one vector of parameters
(P,). It gives the states (N, T, 2n) and how they move along D = 2n + F directions (N, D, T, 2n): the 2n components of
the row's start, and F directions of the parameters. Machine code follows all directions over the steps of the motion,
without a program of XLA, so that another number of rows or times compiles nothing; other engines go through
`jax.jacfwd` of `simulate`, the plain path that this one is tested against.
"""

import abc
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import choose
from lagjax._failures import sentence
from lagjax._fit._parameters import Parameters
from lagjax._layout import Layout, halves
from lagjax._machine_code import MachineCode, _derivatives, _tolerances, flow_of
from lagjax._machine_code._steps import KEPT
from lagjax._problem import Problem
from lagjax._results import ENDED_WELL
from lagjax._simulate import simulate
from lagjax._system import System

PyTree = Any


class Motion(NamedTuple):
    """N motions: `path` (N, T, 2n), `tangents` (N, D, T, 2n), and how each ended: `result`, `t_end` (N,), `y_end`."""

    path: np.ndarray
    tangents: np.ndarray
    result: np.ndarray
    t_end: np.ndarray
    y_end: np.ndarray

    @property
    def ok(self) -> bool:
        """Whether all reached their last time."""
        return bool(np.isin(self.result, ENDED_WELL).all() and np.isfinite(self.tangents).all())

    def why_not(self, ts: np.ndarray, layout: Layout) -> tuple[int, str]:
        """The first row that failed, and what became of it."""
        failed = ~np.isin(self.result, ENDED_WELL)
        if not failed.any():
            row = int(np.argmin(np.isfinite(self.tangents).all(axis=(1, 2, 3))))
            return row, "Its derivatives are not finite."
        row = int(np.argmax(failed))
        text = sentence(self.result[row], self.t_end[row], ts[row, -1], self.y_end[row], layout.names)
        return row, text or ""


class AbstractMotions(abc.ABC):
    """What follows motions and their tangents."""

    @abc.abstractmethod
    def follow(self, ts: np.ndarray, y0: np.ndarray, numbers: np.ndarray, directions: np.ndarray) -> Motion:
        """The motions from `y0` (N, 2n) at `ts` (N, T) for all parameters `numbers` (P,), along `directions` (F, P)."""

    @abc.abstractmethod
    def rate(self, t: np.ndarray, y: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """q̈ (M, n) at M states `y` (M, 2n) and times `t` (M,)."""


def motions_of(system: System, layout: Layout, parameters: Parameters, rtol, atol) -> AbstractMotions:
    """What follows the motions of this scene: machine code where it has that, else diffrax."""
    params = parameters.restore(parameters.first)
    problem = Problem.about(system, layout, params, rtol=rtol, atol=atol)
    if isinstance(choose(problem).engine, MachineCode):
        return _ByMachineCode(problem)
    return _ByDiffrax(system, layout, parameters, rtol, atol)


class _ByMachineCode(AbstractMotions):
    def __init__(self, problem: Problem):
        self.flow, self.tolerances = flow_of(problem), _tolerances(problem)

    def follow(self, ts, y0, numbers, directions):
        (rows, states), count = y0.shape, len(directions)
        params = numbers[None]
        run = self.flow.run(ts, y0, params, self.tolerances, KEPT)
        dy0 = np.zeros((rows, states + count, states))
        dy0[:, :states] = np.eye(states)
        dparams = np.zeros((rows, states + count, len(numbers)))
        dparams[:, states:] = directions
        steps = run.path, run.result, run.accepted, run.ticket
        tangents, _ = _derivatives.jvp(self.flow, ts, y0, params, steps, dy0, dparams, self.tolerances)
        return Motion(run.path, tangents, run.result, run.t_end, run.y_end)

    def rate(self, t, y, numbers):
        values = self.flow.anywhere.evaluate(*y.T, t, *numbers)[: self.flow.size]
        return np.stack([np.broadcast_to(value, t.shape) for value in values], axis=-1)


class _ByDiffrax(AbstractMotions):
    def __init__(self, system: System, layout: Layout, parameters: Parameters, rtol, atol):
        unfree = [leaf for leaf in parameters.leaves if not hasattr(leaf, "shape")]
        if unfree:
            raise TypeError(f"params0 may only hold numbers where the scene has no machine code; got {unfree[0]!r}.")

        def run(state, ts):
            y0, numbers = state
            q, qdot = map(layout.restore, halves(y0))
            params, begin = [], 0
            for leaf in parameters.leaves:
                params.append(numbers[begin : begin + leaf.size].reshape(leaf.shape).astype(leaf.dtype))
                begin += leaf.size
            trajectory = simulate(
                system, q, qdot, ts, jax.tree.unflatten(parameters.tree, params), rtol=rtol, atol=atol,
                adjoint=diffrax.ForwardMode(), throw=False,
            )  # fmt: skip
            rows = jax.vmap(lambda q, v: jnp.concatenate([layout.flatten(q), layout.flatten(v)]))
            end = jnp.concatenate([layout.flatten(trajectory.end.q), layout.flatten(trajectory.end.qdot)])
            path = rows(trajectory.q, trajectory.qdot)
            return path, (path, trajectory.result._value, trajectory.end.t, end)

        def with_tangents(ts, y0, numbers, directions):
            def along(dy0, dnumbers):
                return jax.jvp(lambda state: run(state, ts)[0], ((y0, numbers),), ((dy0, dnumbers),))[1]

            size = len(y0)
            dy0 = jnp.concatenate([jnp.eye(size, dtype=y0.dtype), jnp.zeros((len(directions), size), y0.dtype)])
            dnumbers = jnp.concatenate([jnp.zeros((size, directions.shape[1]), y0.dtype), directions])
            return run((y0, numbers), ts)[1], jax.vmap(along)(dy0, dnumbers)

        self._follow = jax.jit(jax.vmap(with_tangents, in_axes=(0, 0, None, None)))
        self._rate = jax.jit(jax.vmap(lambda t, y, p: _acceleration(system, layout, t, y, p), in_axes=(0, 0, None)))
        self.dtype, self.parameters = layout.dtype, parameters

    def follow(self, ts, y0, numbers, directions):
        arrays = [np.asarray(x, self.dtype) for x in (ts, y0, numbers, directions)]
        (path, result, t_end, y_end), tangents = jax.tree.map(np.asarray, self._follow(*arrays))
        return Motion(path.astype(float), tangents.astype(float), result, t_end, y_end)

    def rate(self, t, y, numbers):
        params = self.parameters.restore(numbers)
        return np.asarray(self._rate(np.asarray(t, self.dtype), np.asarray(y, self.dtype), params), float)


def _acceleration(system: System, layout: Layout, t, y, params):
    q, qdot = map(layout.restore, halves(y))
    return layout.flatten(system.acceleration(q, qdot, t, params))
