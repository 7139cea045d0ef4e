"""A run of machine code on an NVIDIA GPU: XLA launches it itself, by the custom call that takes PTX.

There is no handler, no callback and no address in the program, so that it can be exported and saved. What Python does
after a run on a CPU - a retry of members that failed, an analysis of what stopped them - is not done here: a member
that another variant of the program could integrate ends with the code of the first.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _native
from lagjax._engine.taylor._flow import NOT_FINITE_RESULT, RESULT_OF_CODE, Flow, Tolerances
from lagjax._native import gpu
from lagjax._program import Unlowerable

_TARGET = "__gpu$xla.gpu.ptx"


def run_on_gpu(flow: Flow, tolerances: Tolerances, ts, y0, params) -> tuple:
    """The motions of N members, `ts` (1 or N, T), `y0` (N, 2n), `params` (1 or N, P): a `Solution` without `idle`.

    Raises `ValueError`, with the reason, if the scene cannot run on a GPU.
    """
    notes = tolerances.notes
    try:
        program = flow.kernel.gpu_programs.motion(tolerances.rtol)
    except Unlowerable as reason:
        raise ValueError(f"solver=lagjax.MachineCode() cannot integrate this scene on a GPU: {reason}.") from None
    members, path = len(y0), jnp.full((len(y0), *flow.path_shape(ts.shape[1], notes)), jnp.nan)
    arrays = _launch_inputs(gpu.MOTION, ts, y0, params, flow, tolerances, room_of_notes=notes) | {"path": path}
    guards = flow.kernel.ending_guards
    shapes = [path.shape, y0.shape, *[(members,)] * 4, (members, max(1, guards))]  # an array that has an address
    *results, changes = launch(gpu.MOTION, program, members, arrays, shapes)
    results.append(changes[:, :guards])
    return _launch_solution(*results, states=not notes)


def transpose_on_gpu(flow: Flow, tolerances: Tolerances, ts, y0, params, path_ct, end_ct) -> tuple:
    """The cotangents of `y0` (N, 2n) and of the parameters (N, P), from those of outputs and ends.

    `path_ct` is (N, T, 2n), whose first and last output are not read, `end_ct` (N, 2n). Then `excess` (N,), as in
    `Kernel.vjp`, and flags (N,) of those that are done: all except those with more steps than a thread can record.

    Raises `Unlowerable` if a GPU cannot transpose the steps of this scene.
    """
    program, row = flow.kernel.gpu_programs.transpose(tolerances.rtol)
    members, threads = len(y0), math.prod(gpu.grid_size(gpu.TRANSPOSE, len(y0)))
    room = min(tolerances.max_steps, gpu.LARGEST_RECORD // (threads * row))
    arrays = _launch_inputs(gpu.TRANSPOSE, ts, y0, params, flow, tolerances, room=room)
    arrays |= {"path_ct": path_ct, "end_ct": end_ct}
    shapes = [y0.shape, (members, max(1, flow.numbers)), (members,), (members,), (threads * room * row,)]
    y_ct, params_ct, excess, done, _ = launch(gpu.TRANSPOSE, program, members, arrays, shapes)
    return y_ct, params_ct[:, : flow.numbers], excess, done > 0


def _launch_inputs(entry: gpu.Entry, ts, y0, params, flow: Flow, tolerances: Tolerances, **more: int) -> dict[str, Any]:
    rtol, atol, max_steps, *_ = tolerances
    numbers = entry.words(
        members=len(y0), times=ts.shape[1], ts_stride=ts.shape[1] if len(ts) > 1 else 0,
        params_stride=flow.numbers if len(params) > 1 else 0, max_steps=max_steps, rtol=rtol, atol=atol, **more,
    )  # fmt: skip
    if not flow.numbers:
        params = jnp.zeros((1, 1))  # an array that has an address
    words, counter = jnp.asarray(np.array(numbers, np.int64)), jnp.zeros(1, np.int64)
    return dict(ts=ts, y0=y0, params=params, numbers=words, next_member=counter)


def launch(entry: gpu.Entry, program: str, members: int, arrays: dict[str, Any], shapes: list[tuple]) -> list:
    """Launch a GPU program for this many members on the `arrays` of its entry; its results have these shapes."""
    blocks, threads = gpu.grid_size(entry, members)
    sizes = dict(grid_x=blocks, grid_y=1, grid_z=1, block_x=threads, block_y=1, block_z=1, shared_mem_bytes=0)
    attributes = {name: np.int32(size) for name, size in sizes.items()}
    results = [jax.ShapeDtypeStruct((1,), np.int64), *(jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes)]
    # Nothing clears what a kernel writes to: what must be clear is given, and written to where it is.
    call = jax.ffi.ffi_call(_TARGET, results, input_output_aliases=entry.aliases)
    given = (arrays[name] for name in entry.arguments)
    return list(call(*given, name="integrate", kernel_type="ptx", kernel_data=program, **attributes))[1:]


def _launch_solution(path, y_end, t_end, code, steps, rejected, changes, states: bool) -> tuple:
    """The results of the GPU program as the fields of a `Solution`; NaN in the path at times not reached."""
    code, steps, rejected, changes = (x.astype(int) for x in (code, steps, rejected, changes))
    result = jnp.asarray(RESULT_OF_CODE)[code]
    result = jnp.where(jnp.isfinite(y_end).all(axis=1), result, NOT_FINITE_RESULT)
    if states:
        reached = (code == _native.DONE)[:, None, None] | jnp.isfinite(path).all(axis=2, keepdims=True)
        path = jnp.where(reached, path, jnp.nan)
    return path, y_end, t_end, result, steps, rejected, changes
