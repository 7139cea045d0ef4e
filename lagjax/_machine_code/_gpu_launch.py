"""A run of machine code on an NVIDIA GPU: XLA launches it itself, by the custom call that takes PTX.

There is no handler, no callback and no address in the program, so that it may be exported and kept. What Python does
after a run on a CPU - a second try of members that failed, a look at what stopped them - is not done here: a member
that another variant of the program could follow ends with the code of the first.
"""

import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _native
from lagjax._machine_code._flow import NOT_FINITE_RESULT, RESULT_OF_CODE, Flow, Tolerances
from lagjax._native import gpu
from lagjax._program import Unlowerable

_TARGET = "__gpu$xla.gpu.ptx"


def run_on_gpu(flow: Flow, tolerances: Tolerances, ts, y0, params) -> tuple:
    """The motions of N members, `ts` (1 or N, T), `y0` (N, 2n), `params` (1 or N, P): a `Solution` without `idle`.

    Raises `ValueError` where the scene cannot go to a GPU, saying why.
    """
    rtol, atol, max_steps, _, notes = tolerances
    try:
        program = flow.kernel.program_for_gpus(rtol)
    except Unlowerable as reason:
        raise ValueError(f"solver=lagjax.MachineCode() cannot integrate this scene on a GPU: {reason}.") from None
    members, times = len(y0), ts.shape[1]
    numbers = gpu.words(
        members=members, times=times, ts_stride=times if len(ts) > 1 else 0,
        params_stride=flow.numbers if len(params) > 1 else 0, max_steps=max_steps,
        room_of_notes=notes, rtol=rtol, atol=atol,
    )  # fmt: skip
    path = jnp.full((members, *flow.path_shape(times, notes)), jnp.nan)
    if not flow.numbers:
        params = jnp.zeros((1, 1))  # an array that has an address
    operands = ts, y0, params, jnp.asarray(np.array(numbers, np.int64)), jnp.zeros(1, np.int64), path
    shapes = [(1,), path.shape, y0.shape, *[(members,)] * 4]
    kinds = [np.int64, *[np.float64] * 6]
    results = [jax.ShapeDtypeStruct(shape, kind) for shape, kind in zip(shapes, kinds, strict=True)]
    return _solution(*launch(program, operands, results)[1:], states=not notes)


def launch(program: str, operands, results) -> list:
    """Launch a program on its operands: `_native._gpu.RESULTS`, of these shapes."""
    blocks, threads = gpu.grid(results[2].shape[0])
    sizes = dict(grid_x=blocks, grid_y=1, grid_z=1, block_x=threads, block_y=1, block_z=1, shared_mem_bytes=0)
    attributes = {name: np.int32(size) for name, size in sizes.items()}
    # Nothing clears what a kernel writes to: the counter and the path are given, and written to where they are.
    aliased = {gpu.ARGUMENTS.index(name): gpu.RESULTS.index(name) for name in ("next_member", "path")}
    call = jax.ffi.ffi_call(_TARGET, results, input_output_aliases=aliased)
    return list(call(*operands, name="integrate", kernel_type="ptx", kernel_data=program, **attributes))


def _solution(path, y_end, t_end, code, steps, rejected, states: bool) -> tuple:
    """The results of the kernel as the fields of a `Solution`; NaN in the path where a member did not come."""
    code, steps, rejected = (x.astype(int) for x in (code, steps, rejected))
    result = jnp.asarray(RESULT_OF_CODE)[jnp.minimum(code, _native.EVENT)]
    result = jnp.where(jnp.isfinite(y_end).all(axis=1), result, NOT_FINITE_RESULT)
    if states:
        reached = (code == _native.DONE)[:, None, None] | jnp.isfinite(path).all(axis=2, keepdims=True)
        path = jnp.where(reached, path, jnp.nan)
    event = jnp.maximum(code - _native.EVENT, 0)
    return path, y_end, t_end, result, steps, rejected, event, jnp.full(code.shape, -1)
