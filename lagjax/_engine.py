"""Which runs go to machine code, and the way there and back: pytrees of a scene to rows of numbers.

On the CPU, in float64, everything that was left to its default goes there, inside and outside the transformations of
JAX. All else (another solver or adjoint, fixed steps, an event, float32, a GPU, a scene that is too large or has no
scalar program) is diffrax's, in `_integrate`. Both follow the same motion within the tolerance.
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _native, _transforms
from lagjax._derivation import Derivation, derivation_of
from lagjax._explain import machine_code_refusal
from lagjax._flow import Flow, Outcome, Tolerances
from lagjax._integrate import Solved
from lagjax._layout import Layout, as_vector
from lagjax._results import RESULTS, result_from
from lagjax._settings import Settings, is_concrete
from lagjax._system import System
from lagjax._trajectory import State

PyTree = Any

# Operations of an acceleration beyond which LLVM takes too long over its transpose: derivatives are then diffrax's.
# Whether a run that is being traced will be differentiated cannot be known.
LARGEST_DIFFERENTIATED = 2000


def flow_for(system: System, settings: Settings, layout: Layout, *values: PyTree) -> "Flow | str":
    """The flow for a run from the values (q0, qdot0, params) of one member, or a sentence that says why it has none.

    Raises `ValueError` with that sentence where `solver=MachineCode()` insists.
    """
    flow = _flow_or_reason(system, settings, layout, values[-1])
    if isinstance(flow, str) and settings.insists:
        raise ValueError(
            f"solver=lagjax.MachineCode() cannot integrate this: {flow}. Leave solver at None, and diffrax integrates "
            "what machine code cannot."
        )
    return flow


def _flow_or_reason(system: System, settings: Settings, layout: Layout, params: PyTree) -> "Flow | str":
    if not settings.by_default:
        asked = "an adjoint, fixed steps, an event or a progress meter"
        return f"{asked} was asked for" if settings.insists else f"a solver, {asked} was asked for"
    if not all(is_concrete(x) for x in (settings.controller.rtol, settings.controller.atol)):
        return "the tolerances are being traced"
    return scene_flow(system, layout, params)


def has_derivatives(flow: Flow, *values: PyTree) -> bool:
    """Whether derivatives of this run, should they be asked for, come from machine code as well."""
    few = flow.program.operations <= LARGEST_DIFFERENTIATED
    return few or all(is_concrete(leaf) for leaf in jax.tree.leaves(values))


def primal(flow: Flow, settings: Settings) -> Callable:
    """`(ts, (q, qdot), params)` → `Solved`: a run for which only diffrax has derivatives, where none is taken."""
    return _primal(flow, _tolerances(settings))


@functools.lru_cache(maxsize=64)  # one function object for one program: it becomes part of what XLA compiles
def _primal(flow: Flow, tolerances: Tolerances) -> Callable:
    n = flow.size

    def solved(ts, y0, params):
        outcome = _transforms.run(flow, tolerances, ts, jnp.concatenate(y0), as_vector(params, y0[0].dtype))
        stats = {
            "num_steps": outcome.accepted + outcome.rejected,
            "num_accepted_steps": outcome.accepted,
            "num_rejected_steps": outcome.rejected,
        }
        code = jnp.asarray(_AS_DIFFRAX)[outcome.code]
        result = jax.tree.unflatten(jax.tree.structure(diffrax.RESULTS.successful), [code])
        halves = [(y[..., :n], y[..., n:]) for y in (outcome.path, outcome.y_end)]
        return Solved(*halves, outcome.t_end, result, stats)

    return solved


def scene_flow(system: System, layout: Layout, params: PyTree) -> "Flow | str":
    """The flow of a scene, or a sentence that says why it has none. Made once."""
    return _flow_of(derivation_of(system, layout, params), system.path)


@functools.lru_cache(maxsize=64)
def _flow_of(derivation: Derivation, path: str) -> "Flow | str":
    refusal = machine_code_refusal(derivation, path)
    return refusal or Flow.of(derivation.acceleration, derivation.layout.size, derivation.projection)


# ---- one trajectory --------------------------------------------------------------------------------------------------


def run(flow: Flow, settings: Settings, layout: Layout, q0: PyTree, qdot0: PyTree, params: PyTree) -> tuple:
    """The first six fields of `Trajectory`, for one member."""
    numbers = jax.tree.leaves(eqx.filter(params, eqx.is_array_like))
    if all(is_concrete(leaf) for leaf in jax.tree.leaves((settings.ts, q0, qdot0, numbers))):
        ts, state, given = np.asarray(settings.ts)[None], _rows((q0, qdot0)), _rows(numbers)
        outcome = Outcome(*(x[0] for x in flow.run(ts, state, given, _tolerances(settings))[0]))
    else:
        state = jnp.concatenate([layout.flatten(q0), layout.flatten(qdot0)])
        given = as_vector(numbers, state.dtype)
        outcome = _transforms.run(flow, _tolerances(settings), jnp.asarray(settings.ts), state, given)
    return _fields(settings, layout, outcome)


def run_batch(flow: Flow, settings: Settings, layout: Layout, values: dict, axes: dict, size: int) -> tuple:
    """The same for a batch of numbers; `axes` are those of the members, leaf by leaf."""
    numbers = eqx.filter(values["params"], eqx.is_array_like)
    spread = [axis for axis in jax.tree.leaves(axes["params"])]  # None is no leaf: those that all share
    y0 = _rows((values["q0"], values["qdot0"]), (axes["q0"], axes["qdot0"]), size)
    given = _rows(numbers, axes["params"], size) if spread else _rows(numbers)
    outcome, idle = flow.run(np.asarray(settings.ts)[None], y0, given, _tolerances(settings))
    return _fields(settings, layout, outcome, idle)


def _tolerances(settings: Settings) -> Tolerances:
    return Tolerances(float(settings.controller.rtol), float(settings.controller.atol), settings.max_steps)


def _rows(tree: PyTree, axes: PyTree = None, size: int = 1) -> np.ndarray:
    """The numbers of every member end to end, shape (members, numbers)."""
    leaves, structure = jax.tree.flatten(tree)
    each = [None] * len(leaves) if axes is None else structure.flatten_up_to(axes)
    columns = [np.zeros((size, 0))]
    for leaf, axis in zip(leaves, each, strict=True):
        array = np.asarray(leaf, np.float64)
        if axis is None:
            columns.append(np.broadcast_to(array.reshape(1, -1), (size, array.size)))
        else:
            columns.append(np.moveaxis(array, axis, 0).reshape(size, array.size // size))
    return np.concatenate(columns, axis=1)


def _fields(settings: Settings, layout: Layout, outcome: Outcome, idle: int | None = None) -> tuple:
    """Where nothing is traced, the few numbers stay in NumPy: each one sent to JAX costs as much as a hundred steps."""
    n, library = layout.size, np if isinstance(outcome.y_end, np.ndarray) else jnp
    finite = library.isfinite(outcome.y_end).all(axis=-1)  # a last state that overflowed is not a success
    result = library.asarray(RESULT_OF_CODE)[library.where(finite, outcome.code, _native.NOT_FINITE)]
    stats = {
        "num_steps": outcome.accepted + outcome.rejected,
        "num_accepted_steps": outcome.accepted,
        "num_rejected_steps": outcome.rejected,
    }
    if idle is not None:
        stats["num_wasted_lane_steps"] = idle

    def half(y, part):
        return layout.restore(y[..., part * n : (part + 1) * n])

    end = State(outcome.t_end, half(outcome.y_end, 0), half(outcome.y_end, 1))
    found = settings.ts, half(outcome.path, 0), half(outcome.path, 1), result
    # All in one call, which costs as much as for one of them.
    ts, q, qdot, result = jax.device_put(found) if library is np else jax.tree.map(jnp.asarray, found)
    return ts, q, qdot, result_from(result), end, stats


# What diffrax calls them; the state at the end tells the rest.
_AS_DIFFRAX = np.array([
    int(result._value)
    for result in (diffrax.RESULTS.successful, diffrax.RESULTS.max_steps_reached, *[diffrax.RESULTS.dt_min_reached] * 5)
], np.int32)  # fmt: skip
# The codes of the kernel, in their order, as those of `RESULTS`.
RESULT_OF_CODE = np.array([
    int(result._value)
    for result in (
        RESULTS.successful, RESULTS.max_steps_reached, RESULTS.dt_min_reached, RESULTS.nonfinite_state,
        RESULTS.mass_matrix_singular, RESULTS.projection_failed, RESULTS.acceleration_discontinuous,
    )
], np.int32)  # fmt: skip
