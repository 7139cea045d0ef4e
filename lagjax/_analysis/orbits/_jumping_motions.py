"""Integrates many motions with contacts or modes, for `Arcs`.

They are simulated under `jax.vmap`, with derivatives by forward mode: in one call for all rows.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._interface import Function, Layout, halves
from lagjax._run import simulate
from lagjax._run.hybrid import Hybrid, Scene, list_laws
from lagjax._scene import ROLES

# The budgets of changes of one motion, and of one arc whose derivatives are taken: what they record takes memory.
_CHANGES, _CHANGES_OF_ARC = 4096, 256


class JumpRun(NamedTuple):
    """R motions: `path` (R, T, 2n), `y_end`, `t_end`, `result`, `accepted` as in a `Solution`; and `modes` (R, T).

    `by_start` (R, 2n, 2n) and `rate` (R, 2n) are the derivatives of `y_end` by the start and by the last time.
    """

    path: Any
    y_end: Any
    t_end: Any
    result: Any
    accepted: Any
    modes: Any
    by_start: Any = None
    rate: Any = None


class JumpingMotions(NamedTuple):
    """Integrates motions of one scene that jumps."""

    scene: Scene
    layout: Layout
    params: PyTree
    rtol: float

    @property
    def driven(self) -> bool:
        functions = [getattr(system, role) for system in list_laws(self.scene) for role in ROLES]
        if isinstance(self.scene, Hybrid):
            functions += [f for transition in self.scene.transitions for f in (transition.guard, transition.reset)]
        return any("t" in function.extras for function in functions if isinstance(function, Function))

    def run(self, times: np.ndarray, y0: np.ndarray, modes=None, varies: bool = False) -> JumpRun:
        """Integrate from y0 (R, 2n) in `modes` (R,), by default the first one, at `times` (R, T) or (1, T)."""
        rows, scene = len(y0), self.scene
        if modes is None:
            modes = np.full(rows, scene.first if isinstance(scene, Hybrid) else 0)
        given = np.broadcast_to(times, (rows, times.shape[-1])), y0, modes
        more = 2 ** int(np.ceil(np.log2(rows))) - rows  # another number of rows compiles anew
        times, y0, modes = (np.concatenate([x, np.repeat(x[-1:], more, axis=0)]) for x in given)
        return jax.tree.map(lambda x: np.array(x)[:rows], _simulate_arcs(self, times, y0, modes, varies))


@eqx.filter_jit
def _simulate_arcs(motions: JumpingMotions, times, y0, modes, varies: bool) -> JumpRun:
    scene, layout, params, rtol = motions
    options = {"rtol": rtol, "throw": False, "max_transitions": _CHANGES_OF_ARC if varies else _CHANGES}

    def end(y, last, ts, mode):
        ts, state = jnp.append(ts[:-1], last), map(layout.restore, halves(y))
        begun = dataclasses.replace(scene, start=mode) if isinstance(scene, Hybrid) else scene
        run = simulate(begun, *state, ts, params, **options)
        path = jnp.concatenate([jax.vmap(layout.flatten)(part) for part in (run.q, run.qdot)], axis=1)
        y_end = jnp.concatenate([layout.flatten(part) for part in run.end[1:]])
        at = jnp.zeros(ts.shape, int) if run.mode is None else run.mode
        return y_end, JumpRun(path, y_end, run.end.t, run.result._value, run.stats["num_accepted_steps"], at)

    def vary(ts, y, mode):
        given = y, ts[-1], ts, mode
        if not varies:
            return end(*given)[1]
        (by_start, rate), run = jax.jacfwd(end, (0, 1), has_aux=True)(*given)
        return run._replace(by_start=by_start, rate=rate)

    return jax.vmap(vary)(times, y0, modes)
