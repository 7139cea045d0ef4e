"""Rounds of a motion: each follows one stretch, to the next guard that changes, and decides what comes behind it.

    run_rounds ─► a round, while any motion goes on ─► Stretch.locate ─► which guard ends it ─► Stretch.vary

Contacts and hybrid motion differ in their guards, and in what they decide.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lagjax._engine import Problem, Solution
from lagjax._engine.taylor import MachineCode, Surfaces
from lagjax._interface import SUCCESSFUL
from lagjax._primitives import cond_alike

PyTree = Any

BLOCK = 32  # rounds that are left out together where no motion goes on: what goes on is copied for each


def run_rounds(run_round: Callable, first, absent: PyTree, rows: PyTree, goes_on: Callable) -> tuple[Any, PyTree]:
    """The last carry, and the records (N, …), of `run_round(carry, row)` for `rows` (N, …) while `goes_on(carry, row)`.

    In a batch it runs while any member goes on. The records of rounds that are left out are `absent`.
    """
    count = len(jax.tree.leaves(rows)[0])

    def while_going(run, idle, first_of):
        def keep(carry, _):
            return carry, idle

        return lambda carry, rows: cond_alike(any_member(goes_on(carry, first_of(rows))), run, keep, carry, rows)

    run_one = while_going(run_round, absent, lambda row: row)

    def run_block(carry, rows):
        return jax.lax.scan(run_one, carry, rows)

    if count <= 2 * BLOCK:
        return run_block(first, rows)
    blocks = -(-count // BLOCK)
    idle = jax.tree.map(lambda x: jnp.broadcast_to(x, (BLOCK, *jnp.shape(x))), absent)

    def split(x):
        return jnp.pad(x, [(0, blocks * BLOCK - count)] + [(0, 0)] * (x.ndim - 1)).reshape(blocks, BLOCK, *x.shape[1:])

    of_block = while_going(run_block, idle, lambda rows: jax.tree.map(lambda x: x[0], rows))
    ending, record = jax.lax.scan(of_block, first, jax.tree.map(split, rows))
    return ending, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], record)


@jax.custom_batching.custom_vmap
def any_member(going):
    """True if a motion, or any of those that `jax.vmap` runs beside it, goes on."""
    return going


@any_member.def_vmap
def _(size, batched, going):
    return any_member(going.any(0) if batched[0] else going), False


class Stretch(NamedTuple):
    """A motion to the first change of its guards, or to the last of the output times; of no length if it is not `here`.

    It is `located` without derivatives. It starts at the first time and the state of `problem`, of which the others are
    those outputs (T,) that lie ahead, and covers some of them; it may end `at_once`. `kinds` (G,) are 1 for guards that
    fell where it ends, 2 for those that rose, and 0.
    """

    problem: Problem
    surfaces: Surfaces | None
    located: Solution
    kinds: jax.Array
    covers: jax.Array
    at_once: jax.Array

    @classmethod
    def locate(cls, problem: Problem, surfaces: Surfaces | None, start: tuple, ts, here, noted) -> "Stretch":
        """The stretch from `start`, (t, y), of whose guards the motion has `noted` (see `Guards`)."""
        t, y = start
        t_start = jax.lax.stop_gradient(t)
        ahead = here & ((ts > t_start) | (ts == jnp.where(t_start == ts[0], t_start, jnp.nan)))
        last = jnp.where(here, ts[-1], t_start)
        times = jnp.concatenate([t[None], jnp.where(ahead, ts, t_start), last[None]])
        guards = surfaces and surfaces.guards(remembers=True)
        problem = dataclasses.replace(problem, ts=times, y0=y, guards=guards)
        located = MachineCode().solve_to_event(problem, noted)
        t_end = jnp.where(here & (located.result == SUCCESSFUL), ts[-1], located.t_end)
        kinds = jnp.where(here, located.event, 0)
        return cls(problem, surfaces, located._replace(t_end=t_end), kinds, ahead & (ts <= t_end), t_end == t_start)

    def vary(self, k, crosses) -> tuple:
        """(path, t, y): the outputs (T, 2n), and the end, where guard k is zero and stays so if it `crosses`.

        What changes and is no crossing does so at once, and moves nothing: it varies as the start does.
        """
        path, t, y = MachineCode().vary_to_event(self.problem, self.surfaces, self.located, k, crosses)
        stays = (self.kinds > 0).any() & ~crosses
        return path[1:-1], jnp.where(stays, self.problem.ts[0], t), jnp.where(stays, self.problem.y0, y)
