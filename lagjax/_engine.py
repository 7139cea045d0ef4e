"""Where a run needs nothing but numbers, on the CPU, in float64: machine code made for the scene.

`kernel_for` says whether that is so; `run` turns the user's pytrees into rows of numbers, one for each member, and the
outcome back. All else (tracing by `jit`, `vmap` or `grad`, another solver, fixed steps, an event, float32, a GPU, a
scene without a scalar program) is diffrax's, in `_integrate`. Both follow the same motion within the tolerance.
"""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _native
from lagjax._equations import scalar_program
from lagjax._layout import Layout
from lagjax._program import Unlowerable
from lagjax._results import RESULTS
from lagjax._settings import Settings, is_concrete
from lagjax._system import System
from lagjax._trajectory import State

PyTree = Any

LARGEST_SCENE = 6_000  # operations of an acceleration, beyond which LLVM takes too long


class _Scene(NamedTuple):
    """All that decides what a kernel looks like; hashable. The scene and its layout hold no arrays, only structure."""

    system: Any
    layout: Any
    code: Any
    shapes: tuple

    @classmethod
    def of(cls, system: System, layout: Layout, params: PyTree) -> "_Scene":
        numbers, code = eqx.partition(params, eqx.is_array_like)
        leaves, structure = jax.tree.flatten(numbers)
        shapes = tuple((np.shape(leaf), np.dtype(jnp.result_type(leaf))) for leaf in leaves)
        others, tree = jax.tree.flatten(code)
        scene = cls(jax.tree.structure(system), jax.tree.structure(layout), (tuple(others), tree, structure), shapes)
        hash(scene)
        return scene

    def rebuilt(self) -> tuple[System, Layout, PyTree]:
        """The scene, its layout, and parameters of the right shapes, whatever their values."""
        others, tree, structure = self.code
        numbers = jax.tree.unflatten(structure, [np.zeros(*shape) for shape in self.shapes])
        params = eqx.combine(numbers, jax.tree.unflatten(tree, others))
        return jax.tree.unflatten(self.system, []), jax.tree.unflatten(self.layout, []), params


def kernel_for(system: System, settings: Settings, layout: Layout, params: PyTree, *states) -> "_native.Kernel | str":
    """The machine code for a run, or a sentence that says why it is not for it."""
    if not settings.by_default:
        return "the solver, the adjoint, fixed steps or an event were asked for"
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves((settings, states, params, system))):
        return "the run is being traced by a transformation of JAX"
    return scene_kernel(system, layout, params)


def scene_kernel(system: System, layout: Layout, params: PyTree) -> "_native.Kernel | str":
    """The machine code for a scene, or a sentence that says why there is none. Made once."""
    if jax.default_backend() != "cpu":
        return f"the default device is a {jax.default_backend()}"
    if layout.dtype != np.float64:
        return f"the coordinates are {layout.dtype.name}, not float64"
    if system.path == "array":
        return "the array path was asked for"
    if jax.tree.leaves(system):
        return "the functions of the scene hold arrays of their own"
    try:
        return _made(_Scene.of(system, layout, params))
    except TypeError as reason:
        if "unhashable" in str(reason):
            return f"the scene cannot be remembered: {reason}"
        raise


@functools.lru_cache(maxsize=64)
def _made(scene: _Scene) -> "_native.Kernel | str":
    system, layout, params = scene.rebuilt()
    try:
        program = scalar_program(system.motion(layout, params), layout, eqx.filter(params, eqx.is_array_like))
        if program.operations > LARGEST_SCENE:
            return f"its acceleration takes {program.operations} operations, more than {LARGEST_SCENE}"
        return _native.Kernel(program, layout.size)
    except Unlowerable as reason:
        return str(reason)


def run(kernel, settings: Settings, layout: Layout, q0, qdot0, params, axes=None, size: int | None = None) -> tuple:
    """The first six fields of `Trajectory`; `axes` are those of the batch for each leaf of (q0, qdot0, params)."""
    numbers = eqx.filter(params, eqx.is_array_like)
    axes_of = (None, None, None) if axes is None else axes
    y0 = np.concatenate([_rows(q0, axes_of[0], size), _rows(qdot0, axes_of[1], size)], axis=1)
    shared = axes is None or all(axis is None for axis in jax.tree.leaves(axes[2], is_leaf=lambda x: x is None))
    given = _rows(numbers, None if shared else axes_of[2], None if shared else size)
    ts, controller = np.asarray(settings.ts), settings.controller
    rtol, atol, smallest = (float(x) for x in (controller.rtol, controller.atol, controller.dtmin))
    outcome = kernel(ts, y0, given, rtol, atol, settings.max_steps, smallest)

    single, n = axes is None, layout.size

    def back(rows):
        return jax.tree.map(jnp.asarray, layout.restore(rows[0] if single else rows))

    def counts(x):
        return jnp.asarray(x[0] if single else x)

    stats = {
        "num_steps": counts(outcome.steps + outcome.rejected),
        "num_accepted_steps": counts(outcome.steps),
        "num_rejected_steps": counts(outcome.rejected),
    }
    end = State(counts(outcome.t_end), back(outcome.y_end[:, :n]), back(outcome.y_end[:, n:]))
    q, qdot = back(outcome.path[..., :n]), back(outcome.path[..., n:])
    return settings.ts, q, qdot, _results(counts(_told(outcome))), end, stats


def _rows(tree: PyTree, axes: PyTree, size: int | None) -> np.ndarray:
    """The numbers of every member end to end, shape (members, numbers); one row where `size` is None."""
    leaves, structure = jax.tree.flatten(tree)
    flat_axes = [None] * len(leaves) if axes is None else structure.flatten_up_to(axes)
    columns = [np.zeros((size or 1, 0))]
    for leaf, axis in zip(leaves, flat_axes, strict=True):
        leaf = np.asarray(leaf, np.float64)
        if axis is None:
            columns.append(np.broadcast_to(leaf.reshape(1, -1), (size or 1, leaf.size)))
        else:
            columns.append(np.moveaxis(leaf, axis, 0).reshape(size, math.prod(leaf.shape) // size))
    return np.concatenate(columns, axis=1)


def _told(outcome) -> np.ndarray:
    """The kernel's codes; a last state that overflowed is not a success."""
    return np.where(np.isfinite(outcome.y_end).all(axis=1), outcome.code, _native.NOT_FINITE)


def _results(codes) -> RESULTS:
    meaning = {
        _native.DONE: RESULTS.successful,
        _native.OUT_OF_STEPS: RESULTS.max_steps_reached,
        _native.STEP_TOO_SMALL: RESULTS.dt_min_reached,
        _native.NOT_FINITE: RESULTS.nonfinite_state,
        _native.SINGULAR: RESULTS.mass_matrix_singular,
    }
    table = np.array([int(meaning[code]._value) for code in range(len(meaning))], np.int32)
    return eqx.tree_at(lambda result: result._value, RESULTS.successful, jnp.asarray(table[np.asarray(codes)]))
