"""Sampled inputs of a scene, as tables that its functions look into.

A scene whose functions ask for `inputs` becomes one whose functions ask for `t` and `params` alone (`drive_scene`): its
parameters are those of the user and, beside them, one table of samples, in which the input at the time t is looked up
(`lagjax.samples`). So a step of machine code ends at every sample, each member of a batch has a table of its own, and
derivatives go along the user's parameters only. Tables are filled up to a few lengths (`table_length`): a program is
made for a length, and serves all records.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._run.hybrid import Hybrid, Scene, Transition, list_laws
from lagjax._scene import (
    MARGINS,
    DrivenParams,
    System,
    append_samples,
    drive_function,
    drive_scene,
    roles_with_inputs,
    samples,
)

_LEAST_ROOM, _GROWTH = 16, 4  # of tables: at most four times what is needed, and six programs up to 16 000 samples


class SampleTable(NamedTuple):
    """The inputs of N pieces of records: I numbers at K instants, `knots` (N, K) and `values` (N, K, I)."""

    knots: np.ndarray
    values: np.ndarray

    @property
    def room(self) -> int:
        return self.knots.shape[1]

    def rows(self, numbers: np.ndarray) -> np.ndarray:
        """The parameters `numbers` (P,) or (N, P) of the user and then the table, (N, P + K + K I)."""
        count = len(self.knots)
        parts = np.broadcast_to(numbers, (count, numbers.shape[-1])), self.knots, self.values.reshape(count, -1)
        return np.concatenate(parts, axis=1)


class InputForm(NamedTuple):
    """The structure of an input at one time, and its interpolation between samples, one of `_samples.HOLDS`."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    hold: str

    @property
    def size(self) -> int:
        return sum(map(math.prod, self.shapes))

    def restore(self, flat) -> PyTree:
        return split_leaves(flat, self.tree, self.shapes)

    def __call__(self, table: "SampleTable", t) -> PyTree:
        """The inputs at the time t, by the table of one piece."""
        return self.restore(samples(table.knots, table.values, self.hold)(t))

    def drive_system(self, system: System) -> System:
        return drive_scene(system, self, ("t", "params"))

    def drive_scene(self, scene: Scene) -> Scene:
        return _drive_modes(scene, self) if isinstance(scene, Hybrid) else self.drive_system(scene)

    def bind_samples(self, system: Scene, params: PyTree, ts: np.ndarray, inputs: np.ndarray) -> tuple[Scene, PyTree]:
        """The scene with inputs (K, I) sampled at `ts` (K,), and its parameters, as `simulate` takes them."""
        if not input_functions(system):
            return system, params
        table = build_table([(ts, inputs)], self.hold)
        return self.drive_scene(system), DrivenParams(params, SampleTable(table.knots[0], table.values[0]))

    def params(self, params: PyTree, room: int) -> DrivenParams:
        """Parameters of the driven scene, with a table of zeros of this many instants: a structure."""
        return DrivenParams(params, SampleTable(np.arange(float(room)), np.zeros((room, self.size))))


@functools.lru_cache(maxsize=16)
def _drive_modes(scene: Hybrid, form: InputForm) -> Hybrid:
    drive = functools.partial(drive_function, find_inputs=form, extras=("t", "params"))
    modes = {name: form.drive_system(mode) for name, mode in scene.modes.items()}
    transitions = [
        Transition(one.source, one.target, drive(one.guard), one.direction, one.reset and drive(one.reset), one.fires)
        for one in scene.transitions
    ]
    return Hybrid(modes, transitions, scene.start, scene.max_transitions)


def split_leaves(flat, tree, shapes: tuple[tuple[int, ...], ...]) -> PyTree:
    """Rows of numbers (..., I), of NumPy or JAX, as a pytree of leaves (..., *shape)."""
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
    parts = [flat[..., end - math.prod(shape) : end] for end, shape in zip(ends, shapes, strict=True)]
    return tree.unflatten([part.reshape(part.shape[:-1] + shape) for part, shape in zip(parts, shapes, strict=True)])


def input_functions(scene: Scene) -> list[str]:
    return [role for law in list_laws(scene) for role in roles_with_inputs(law)]


def table_length(count: int) -> int:
    room = _LEAST_ROOM
    while room <= count:
        room *= _GROWTH
    return room


def build_table(pieces: list[tuple[np.ndarray, np.ndarray]], hold: str) -> SampleTable:
    """The tables of N pieces, each given by its times (k,) and inputs (k, I), and filled up behind its last sample."""
    room, size = table_length(max(len(ts) for ts, _ in pieces) + MARGINS[hold]), pieces[0][1].shape[1]
    knots, values = np.zeros((len(pieces), room)), np.zeros((len(pieces), room, size))
    for row, (ts, inputs) in enumerate(pieces):
        count = len(ts)
        spacing = (ts[-1] - ts[0]) / (count - 1) if count > 1 else max(1.0, abs(ts[0]))
        knots[row] = np.concatenate([ts, ts[-1] + spacing * np.arange(1, room - count + 1)])
        values[row, :count], values[row, count:] = inputs, append_samples(inputs, room - count, hold)
    return SampleTable(knots, values)


def constant_tables(ts: np.ndarray, inputs: np.ndarray) -> SampleTable:
    """Tables that hold one input each, `inputs` (M, I), at and after its time `ts` (M,)."""
    later = np.maximum(1.0, np.abs(ts))
    return SampleTable(np.stack([ts, ts + later], axis=1), np.stack([inputs, inputs], axis=1))


def samples_between(ts: np.ndarray, begin: float, end: float, hold: str) -> slice:
    """The samples at `ts` (K,) that determine the input from `begin` to `end`."""
    margin = MARGINS[hold]
    first = int(np.searchsorted(ts, begin, side="right")) - 1 - margin
    last = int(np.searchsorted(ts, end, side="left")) + 1 + margin
    return slice(max(first, 0), last)


@functools.partial(jax.jit, static_argnames="hold")
def inputs_at(table: SampleTable, ts, hold: str) -> tuple[Any, Any]:
    """The inputs (N, T, I) at the times `ts` (N, T) of the pieces of a table, and their rates there."""

    def evaluate(knots, values, ts):
        return jax.jvp(samples(knots, values, hold), (ts,), (jnp.ones_like(ts),))

    return jax.vmap(evaluate)(table.knots, table.values, ts)
