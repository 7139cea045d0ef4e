"""`Trajectory`: what comes out, in the user's own pytree.

Time is the first axis of `q` and `qdot`; the members of a batch are an axis before it. Quantities derived from the
states are methods: they cost nothing until they are asked for, and they are differentiable.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._results import RESULTS
from lagjax._system import System

PyTree = Any


class State(NamedTuple):
    """A time and the state at it."""

    t: jax.Array
    q: PyTree
    qdot: PyTree


class Transitions(NamedTuple):
    """The changes of mode of a hybrid motion, in order: NaN or −1 beyond the last of `count`.

    `t`, `q`, `qdot` are those just before the reset; `source` and `target` are places in the dict of modes.
    """

    t: jax.Array
    q: PyTree
    qdot: PyTree
    source: jax.Array
    target: jax.Array
    count: jax.Array


class Trajectory(eqx.Module):
    """The motion of a system at the times `ts`, one trajectory or a batch of them.

    - `ts`: the output times, shape (T,).
    - `q`, `qdot`: the structure of the initial state, with the time axis in front of every leaf, and the batch axis,
      if there is one, in front of that. NaN at times that were not reached.
    - `result`: how each member ended, one of `lagjax.RESULTS`; `ok`: whether it ended well, at the last time or at an
      event.
    - `end`: where each member ended, a `State` of `t`, `q`, `qdot`: at `ts[-1]`, at the event, or at the last accepted
      step before it failed.
    - `stats`: counts of steps, per member: `num_steps`, `num_accepted_steps`, `num_rejected_steps`.
    - `mode`, `transitions`: of a hybrid motion (`simulate_hybrid`), else None. `system` is then the dict of its modes.
    """

    ts: jax.Array
    q: PyTree
    qdot: PyTree
    result: RESULTS
    end: State
    stats: dict[str, jax.Array]
    system: System
    params: PyTree
    params_axes: PyTree = eqx.field(static=True, default=None)  # how `simulate_batch` mapped over params
    mode: jax.Array | None = None
    transitions: "Transitions | None" = None

    @property
    def ok(self) -> jax.Array:
        """True where a member reached the last time or its event."""
        code = self.result._value
        return (code == RESULTS.successful._value) | (code == RESULTS.event_occurred._value)

    def energy(self) -> jax.Array:
        """h = p·q̇ − L at every output time, shape (T,) or (batch, T)."""
        return self._at_every_time(self.system.energy)

    def momentum(self) -> PyTree:
        """p = ∂L/∂q̇ at every output time, in the structure of `q`."""
        return self._at_every_time(self.system.momentum)

    @property
    def multipliers(self) -> PyTree:
        """λ at every output time, in the structure that the constraint functions return."""
        return self._at_every_time(self.system.multipliers)

    def constraint_force(self) -> PyTree:
        """(∂f/∂q)ᵀλ + (∂a/∂q̇)ᵀμ at every output time, in the structure of `q`."""
        return self._at_every_time(self.system.constraint_force)

    def constraint_residual(self) -> PyTree:
        """f and a at every output time, in the structure of `multipliers`: how far the motion has drifted."""
        return self._at_every_time(self.system.constraint_residual)

    def to_xarray(self):
        """An `xarray.Dataset` with a variable per leaf of `q` and `qdot` and the dimensions (member,) time, ...

        Raises `ImportError` when xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise ImportError("to_xarray() needs the package xarray: pip install xarray.") from None
        members = ("member",) * jnp.ndim(self.result._value)
        variables = {"ok": (members, np.asarray(self.ok))}
        for name, tree in (("q", self.q), ("qdot", self.qdot)):
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
                label = ".".join([name, *(_key_text(key) for key in path)])
                inner = tuple(f"{label}_{axis}" for axis in range(leaf.ndim - len(members) - 1))
                variables[label] = ((*members, "time", *inner), np.asarray(leaf))
        time = self.ts if self.ts.ndim == 1 else self.ts[(0,) * (self.ts.ndim - 1)]
        return xarray.Dataset(variables, coords={"time": np.asarray(time)})

    def _at_every_time(self, quantity: Callable) -> PyTree:
        """Map `quantity(q, qdot, t, params)` over the time axis, and over the batch axes before it."""
        mapped = jax.vmap(quantity, in_axes=(0, 0, 0, None))
        for outer in range(jnp.ndim(self.result._value)):
            # The innermost batch axis of `simulate_batch` shares its times and some parameters; axes that the user's
            # own `jax.vmap(simulate)` added are on everything.
            shared = outer == 0 and self.ts.ndim < 1 + jnp.ndim(self.result._value)
            mapped = jax.vmap(mapped, in_axes=(0, 0, None, self.params_axes) if shared else (0, 0, 0, 0))
        return mapped(self.q, self.qdot, self.ts, self.params)


def _key_text(key: Any) -> str:
    """A key of a pytree path as plain text: 'theta' for a dict's or a NamedTuple's, '0' for a list's."""
    return str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key))))
