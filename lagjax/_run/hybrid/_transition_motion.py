"""The motion of a hybrid scene: a search for events, without derivatives, and a replay with derivatives.

HybridPlan, start ─► SceneCode.search ─► Found ─► attach_derivative(HybridReplay) ─► Ending
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import Problem
from lagjax._engine.taylor import Tolerances, vector_of
from lagjax._interface import Layout, compile_for_one_call, halves
from lagjax._run._trajectory import State, Transitions
from lagjax._run.hybrid._mode import FIRES, ModeParts, Transition, make_mode
from lagjax._run.hybrid._transition_places import PLACES
from lagjax._run.hybrid._transition_replay import HybridReplay, PlayedModes
from lagjax._run.hybrid._transition_search import LOOPS
from lagjax._run.jumps import Found, JumpLaw, Mode, SceneCode, mask_rows
from lagjax._scene import System

LAW = JumpLaw(PLACES, LOOPS, ("MODE",), ("LET_OUT", "MODE"))


class HybridPlan(eqx.Module):
    """The constants of a run: the modes by name, their transitions, tolerances and budgets."""

    names: tuple[str, ...] = eqx.field(static=True)
    systems: tuple[System, ...]
    transitions: tuple[Transition, ...]
    max_transitions: int = eqx.field(static=True)
    tolerances: Tolerances = eqx.field(static=True)
    is_single: bool = eqx.field(static=True)  # whether the start came in float32


class Ending(NamedTuple):
    """A whole motion: its outputs, its end, its result, and its transitions."""

    end: State
    mode: Any  # its place in `HybridPlan.names`
    result: Any  # the integer of a `lagjax.RESULTS`
    path: tuple[PyTree, PyTree]  # q and q̇, (T, …), NaN where not reached
    modes: Any  # (T,), −1 where not reached
    steps: tuple[Any, Any]  # accepted, rejected
    transitions: Transitions


@compile_for_one_call
def hybrid_motion(plan: HybridPlan, layout: Layout, ts, y0, params: PyTree, start) -> Ending:
    """The motion from y0 (2n,) at ts[0] in mode number `start`, with at most `max_transitions` transitions."""
    ts, y0 = jnp.asarray(ts), jnp.asarray(y0)
    replay = replay_of(plan, layout, params, len(ts))
    vector = vector_of(eqx.filter(params, eqx.is_array_like)).astype(float)
    given = ts, y0, vector, jax.lax.stop_gradient(jnp.asarray(start, float))[None]
    return _arrange_outcome(plan, layout, replay, *replay.search_and_replay(*given), given[:3])


def integrate_concrete(plan: HybridPlan, layout: Layout, params: PyTree, ts, y0, vectors, start) -> Ending:
    """The motions of N members with concrete numbers: `y0` (N, 2n), `ts` (N or 1, T), `vectors` (N, P).

    `params` are those of one member; all begin in mode number `start`.
    """
    replay, starts = replay_of(plan, layout, params, ts.shape[1]), np.full((len(y0), 1), float(start))
    given = (np.asarray(x, float) for x in (ts, y0, vectors))
    found = replay.code.search_batch(*given, starts, room=plan.max_transitions + 1)
    return _arrange_outcome(plan, layout, replay, found, *replay.read(found), ())


def _arrange_outcome(
    plan: HybridPlan, layout: Layout, replay: HybridReplay, found: Found, row, played: PlayedModes, inputs: tuple
) -> Ending:
    """The outputs, transitions and result of a motion, from the replayed parts; in JAX if `inputs` are given."""
    library: Any = jnp if inputs else np

    def cut(x):
        return x[(*[slice(None)] * (row.happens.ndim - 1), slice(plan.max_transitions))]

    def restore(y):
        return tuple(map(layout.restore, halves(y)))

    modes, of, happened = found.did[..., 0].astype(int), replay.code.read_ending(found.ending), cut(row.happens > 0)
    result, _, accepted, rejected = (x.astype(int) for x in of[:4])
    in_list = np.argsort(np.concatenate([mode.numbers for mode in replay.parts]))
    t, before, behind = (mask_rows(happened, cut(x), inputs) for x in (played.at, played.before, played.behind))
    kinds = [library.where(happened, cut(x), -1).astype(int) for x in (row.mode[..., 0], row.target, row.number)]
    known = happened.sum(axis=-1), cut(row.order_matters > 0), of.let_out[..., in_list]
    transitions = Transitions._make((t, *restore(before), *kinds, *known, *restore(behind)))
    end, path = State(played.t, *restore(played.y)), restore(mask_rows(modes >= 0, played.path, inputs))
    return Ending(end, of.mode[..., 0].astype(int), result, path, modes, (accepted, rejected), transitions)


# ---- what is made once -----------------------------------------------------------------------------------------------


def replay_of(plan: HybridPlan, layout: Layout, params: PyTree, times: int) -> HybridReplay:
    """The replay of the scene, for parameters of this structure and a number of outputs.

    Raises `ValueError` without machine code.
    """
    rtol, atol, max_steps, *_ = plan.tolerances
    limits = {"rtol": rtol, "atol": atol or None, "max_steps": max_steps}
    made = (Problem.from_system(system, layout, params, **limits) for system in plan.systems)
    problems = [dataclasses.replace(problem, is_rounded=plan.is_single) for problem in made]
    modes = (make_mode(name, plan.transitions, of) for name, of in zip(plan.names, problems, strict=True))
    return _make_scene(plan, tuple(modes), times)


@functools.lru_cache(maxsize=64)
def _make_scene(plan: HybridPlan, parts: tuple[ModeParts, ...], times: int) -> HybridReplay:
    numbers = [k for mode in parts for k in mode.numbers]
    leaving = [plan.transitions[k] for k in numbers]
    lines = {("RESETS", j): of for j, of in enumerate(of for mode in parts for of in mode.reset_lines) if of}
    lines |= {("CHECKS", place): mode.check for place, mode in enumerate(parts) if mode.check}
    still = [no_rate for mode in parts for no_rate in (mode.surfaces.have_no_rate if mode.surfaces else ())]
    arrays = {
        "FIRST_OF": np.cumsum([0, *(len(mode.numbers) for mode in parts)])[:-1], "NUMBER": numbers,
        "TARGET": [plan.names.index(of.target) for of in leaving], "WAY": [of.direction for of in leaving],
        "FIRES": [FIRES.index(of.fires) for of in leaving],
        "PASSES": [int(of.reset is None or no_rate) for of, no_rate in zip(leaving, still, strict=True)],
        "ALIKE": [int("multipliers" not in of.guard.extras) for of in leaving],
        "RESETS": np.zeros(len(leaving)), "CHECKS": np.zeros(len(parts)),
    }  # fmt: skip
    sizes = parts[0].sizes | {
        "K": len(leaving), "TIMES": times, "DOING": 1, "MOST": plan.max_transitions + 1, "SINGLE": int(plan.is_single),
    }  # fmt: skip
    modes = [Mode(mode.make_guarded, len(mode.numbers), lambda mode=mode: mode.surfaces) for mode in parts]
    return HybridReplay(SceneCode(LAW, sizes, arrays, modes, lines, plan.tolerances, first=len(modes)), parts)
