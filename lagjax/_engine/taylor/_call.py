"""A run of machine code as XLA calls it: by a handler in machine code, and by a Python callback in all rare cases.

    members that one thread works on ─► handler ─► all ended well? ─► yes: results, without Python
                                                        └─ no: `Flow.run` continues in a callback
    more members                     ─► `Flow.run` in a callback
    derivatives of a short run       ─► handlers, which run it once more; of others ─► `_derivatives` in a callback

Long runs, retries, failures and their reasons are handled in Python, as are threads and Ctrl-C. The handler requires a
known version of XLA's interface; if `NO_HANDLER` has a reason against it, every run is a callback.
"""

import ctypes
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _native
from lagjax._engine.taylor._flow import Flow, Tolerances
from lagjax._interface import EVENT_OCCURRED, SUCCESSFUL
from lagjax._primitives import call_host, cond_alike, vary_alike

NO_HANDLER = _native.unavailable(jax.ffi.include_dir())
_TARGET = "lagjax_integrate"


def begins_in_handler(flow: Flow, members: int) -> bool:
    notes = flow.guards is not None and flow.guards.notes
    return NO_HANDLER is None and not notes and flow.kernel.select_width(members).threads(members) == 1


def derivatives_begin_in_handler(flow: Flow, members: int) -> bool:
    """True if derivatives of this many members start in a handler, which recomputes their motion."""
    return begins_in_handler(flow, members) and flow.projection is None and flow.kernel.rounds_of_rerun > 0


def run_by_handler(flow: Flow, tolerances: Tolerances, host: Callable, shapes, ts, y0, params) -> tuple:
    """Run N members, `ts` (1 or N, T), `y0` (N, 2n), `params` (1 or N, P), N few enough for one thread.

    `host(ts, y0, params, *begun)` completes a run that the handler leaves unfinished (`_native.RunResults`) and returns
    the results of the whole run, of these `shapes`.
    """
    _register_target()
    members, states = y0.shape
    kernel = flow.kernel.select_width(members)
    plan = kernel.plan(tolerances.rtol, tolerances.atol, tolerances.max_steps)
    rows, size = (members,), (kernel.rest_size,)
    of_handler = [(members, ts.shape[1], states), (members, states), *[rows] * 4, (members, kernel.ending_guards), size]
    call = jax.ffi.ffi_call(_TARGET, [jax.ShapeDtypeStruct(shape, np.float64) for shape in of_handler])
    begun = call(ts, y0, params, plan=np.int64(ctypes.addressof(plan)))
    begun = _native.RunResults(*vary_alike(begun, like=(ts, y0, params)))

    def convert_results(ts, y0, params, path, y_end, t_end, code, steps, rejected, changes, rest):
        result = jnp.where(code == _native.EVENT, EVENT_OCCURRED, SUCCESSFUL)
        return path, y_end, t_end, *(x.astype(int) for x in (result, steps, rejected, changes))

    def continue_on_host(*arrays):
        # The callback lives as long as the compiled program, and with it what the handler needs.
        return call_host(lambda *arrays, _needed=(plan, kernel): host(*arrays), shapes, *arrays)

    more = jax.lax.bitcast_convert_type(begun.rest[-1], np.int64)
    ended = (begun.code == _native.DONE) | (begun.code == _native.EVENT)
    well = (more == 0) & jnp.all(ended) & jnp.all(jnp.isfinite(begun.y_end))
    return tuple(cond_alike(well, convert_results, continue_on_host, ts, y0, params, *begun))


def derivative_by_handler(kind: str, flow: Flow, tolerances: Tolerances, rows: tuple) -> tuple:
    """The derivative "jvp" or "vjp" of the motions of N members, few enough for one thread.

    `rows` are the arguments of its handler (`_native.derivative_handler`). The results are followed by `excess` (N,), a
    flag () that it is done, and objects that must live as long as the compiled program.
    """
    _register_target()
    ts, y0, *_, start = rows
    (members, states), times = y0.shape, ts.shape[1]
    directions = start.shape[1] if kind == "jvp" else 1
    plan = flow.kernel.derivative_plan(kind, members, times, directions, *tolerances[:3])
    second = (members, directions, times, states) if kind == "jvp" else (members, flow.numbers)
    shapes = start.shape, second, (members,), (1,), (plan.scratch(members, times),)
    call = jax.ffi.ffi_call(f"lagjax_{kind}", [jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes])
    *results, done, _ = vary_alike(call(*rows, plan=np.int64(ctypes.addressof(plan))), like=rows)
    return *results, done[0] > 0, (plan, flow.kernel)


@_native.make_once
def _register_target() -> None:
    addresses = {_TARGET: _native.handler().address}
    addresses |= {f"lagjax_{kind}": _native.derivative_handler(kind) for kind in ("jvp", "vjp")}
    for target, address in addresses.items():
        jax.ffi.register_ffi_target(target, capsule(address), platform="cpu", api_version=1)


def capsule(address: int):
    new = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
    return new(("PyCapsule_New", ctypes.pythonapi))(address, None, None)
