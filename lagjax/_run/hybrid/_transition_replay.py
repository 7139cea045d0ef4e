"""The replay of a hybrid motion: its stretches, crossings and resets, with derivatives (see `jumps._round_replay`).

The reset is differentiated like any function. Together with the crossing of the guard (`taylor._surfaces`) this is the
jump of a sensitivity at an event ("saltation matrix").
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lagjax._engine.taylor import Line, move_to_zero, run_stretch
from lagjax._primitives import differentiable_where
from lagjax._run._trajectory import constant_unless
from lagjax._run.hybrid._mode import ModeParts
from lagjax._run.jumps import Replay, SceneCode, concatenate


class PlayedModes(NamedTuple):
    """The differentiable results of a replay: outputs (T, 2n); per row its time, states around it; and the end."""

    path: Any
    at: Any
    before: Any
    behind: Any
    t: Any
    y: Any


class HybridReplay(Replay):
    """The replay of a hybrid scene; `parts` are its modes."""

    played = PlayedModes

    def __init__(self, code: SceneCode, parts: tuple[ModeParts, ...]):
        self.parts, self.said = parts, 1 + 2 * code.sizes["N"]
        self._resets = [mode.resets() for mode in parts]
        self._line_of = functools.cache(self._make_line)
        super().__init__(code, 3)

    def __call__(self, *given) -> tuple:
        """The fields of `PlayedModes`, from the output times, the start, the numbers, and the mode at the start."""
        path, said, behind, t, y = self.play(*given)
        return path, said[:, 0], said[:, 1:], behind, t, y

    def pass_stretch(self, given: tuple, start: tuple, row, record, ahead, times, event) -> tuple:
        ts, _, vector = given
        end, stop, k, crosses = event
        path, ended = jnp.zeros((ts.size, stop.size)), None
        for place, parts in enumerate(self.parts):  # members that are in another mode are given no time
            here = row.mode[0] == place if len(self.parts) > 1 else jnp.array(True)
            (t, y), numbers = start, vector
            if len(self.parts) > 1:
                t, y, numbers = constant_unless(here, (t, y, vector))
            of_mode = jnp.where(here, times, t), y, numbers, jnp.where(here, end, t), stop, k, crosses & here
            outputs, *at = run_stretch(parts.make_flow(), parts.surfaces, self.code.tolerances, *of_mode)
            parts_of_end = (*at, numbers, t, y)
            found = self._concatenate_effects(place, (record, *jax.lax.stop_gradient(parts_of_end[:3]), *parts_of_end))
            found = differentiable_where(jax.lax.stop_gradient(found[0]) > 0, found[1:], *at, numbers)
            ended = found if ended is None else jnp.where(here, found, ended)
            path = jnp.where(here & (ahead & (ts <= row.end))[:, None], outputs[1:-1], path)
        assert ended is not None
        said, behind = jnp.split(ended, [self.said])
        return path, said, behind, ended[0]

    def _concatenate_effects(self, place: int, given: tuple):
        """The vector of `_evaluate_effects`, by a straight line if that is short."""
        line = self._line_of(place)
        return self._evaluate_effects(place, *given) if line is None else line(concatenate(*given))

    def _make_line(self, place: int) -> Line | None:
        states, numbers = 2 * self.sizes["N"], self.sizes["NUMBERS"]
        function = functools.partial(self._evaluate_effects, place)
        return self.line_of_end(function, (), (states,), (numbers,), (), (states,))

    def _evaluate_effects(self, place: int, record, *given):
        """The effects of the end of a stretch: a flag that it is smooth, time and state there, the state after it."""
        parts, row, still, moving, start = self.parts[place], self._read(record), given[:3], given[3:6], given[6:]
        k, crosses, smooth, (t, y, numbers) = row.watch.astype(int), row.crosses > 0, jnp.array(True), moving
        if parts.surfaces is not None:  # one that is not crossed may have no derivative here
            at = tuple(jnp.where(crosses, *both) for both in zip(moving, still, strict=True))
            smooth, *moved = move_to_zero(parts.surfaces, k, crosses, at, still)
            t, y = (jnp.where(crosses, *both) for both in zip(moved, moving[:2], strict=True))
            stays = (row.happens > 0) & ~crosses
            t, y = (jnp.where(stays, *both) for both in zip(start, (t, y), strict=True))
        behind = y
        for g, reset in enumerate(self._resets[place]):
            if reset is not None:
                taken = (row.decides > 0) & (k == g)
                at = (jnp.where(taken, *both) for both in zip((t, y, numbers), still, strict=True))
                behind = jnp.where(taken, reset(*at), behind)
        return concatenate(jnp.where(smooth, 1.0, 0.0), t, y, behind)
