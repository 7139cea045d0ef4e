"""`work_precision`: run time against error, measured on the user's own scene.

A tolerance bounds the error of one step; a user wants the error of the whole motion, and its cost. Both are measured:
for every solver at every tolerance, by comparison with one solution that is far more accurate.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import LEAST_RTOL
from lagjax._engine.diffrax import LEAST_RTOL_OF_DIFFRAX, FineOutput
from lagjax._engine.taylor import MachineCode
from lagjax._interface import as_arrays, show_str
from lagjax._run import Members, Trajectory, simulate, simulate_batch
from lagjax._scene import System, require_system

_TOLERANCES = {np.dtype("float64"): (1e-4, 1e-6, 1e-8, 1e-10, 1e-12), np.dtype("float32"): (1e-2, 1e-3, 1e-4, 1e-5)}
# Tolerances of the reference and of the solve that checks it, in units of the round-off. Any tighter, and round-off in
# the error estimate itself begins to reject steps.
_REFERENCE, _CHECK = 50, 500

# Measured beside the default engine. Where that is diffrax's it is the first of these, and not measured twice.
_SOLVERS = {"Dopri8": FineOutput(diffrax.Dopri8()), "Tsit5": diffrax.Tsit5()}
_FIRST = next(iter(_SOLVERS))


class WorkPrecisionRow(NamedTuple):
    """One solver at one tolerance; errors are in the units of q."""

    solver: str
    rtol: float
    seconds: float  # median over the repeats, without compilation
    seconds_per_trajectory: float
    error: float  # median over the members
    worst_error: float  # maximum over the members
    accepted_steps: float  # mean over the members
    rejected_steps: float
    ok: float  # the fraction of members that reached the end
    wasted: float  # steps spent waiting for the slowest member, over the steps that were needed


class WorkPrecision(eqx.Module):
    """The outcome of `work_precision`: iterate over it for its rows, print it for a table, or draw it with `plot`.

    - `rows`: a tuple of `WorkPrecisionRow`, solver after solver, each in the order of the tolerances given.
    - `reference_error`: the error of the reference, median over the members. Smaller errors are not resolved.
    - `worst_reference_error`: the same for the worst member, the resolution of `worst_error`.
    - `members`: how many trajectories each row has run.
    """

    rows: tuple[WorkPrecisionRow, ...]
    reference_error: float
    worst_reference_error: float
    members: int

    def __iter__(self) -> Iterator[WorkPrecisionRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        table = [_HEADER, *map(_table_cells, self.rows)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = []
        for name, *numbers in table:
            aligned = [cell.rjust(width) for cell, width in zip(numbers, widths[1:], strict=True)]
            lines.append("  ".join([name.ljust(widths[0]), *aligned]))
        members = "1 member" if self.members == 1 else f"{self.members} members"
        note = f"{members}; the reference is good to {self.reference_error:.1e}, smaller errors are not resolved."
        return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:], note])


_HEADER = ("solver", "rtol", "error", "worst", "time", "per member", "accepted", "rejected", "ok", "wasted")


def _table_cells(row: WorkPrecisionRow) -> tuple[str, ...]:
    """Return one row of the printed table, in the order of `_HEADER`."""
    return (
        row.solver, f"{row.rtol:.0e}", f"{row.error:.1e}", f"{row.worst_error:.1e}",
        _run_duration(row.seconds), _run_duration(row.seconds_per_trajectory),
        f"{row.accepted_steps:.0f}", f"{row.rejected_steps:.0f}", f"{row.ok:.0%}", f"{row.wasted:.0%}",
    )  # fmt: skip


def work_precision(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    ts: jax.Array,
    params: PyTree = None,
    solvers: Mapping[str, diffrax.AbstractSolver | MachineCode | None] | None = None,
    tolerances: Sequence[float] | None = None,
    *,
    batch_axes: tuple[PyTree, PyTree, PyTree] | None = None,
    repeats: int = 3,
    max_steps: int = 65_536,
) -> WorkPrecision:
    """Error and time of every solver at every tolerance, on this scene and from this state.

    The error of a trajectory is the largest |q_i(t) − reference| over all coordinates i and all output times t, in the
    units of q. The reference is the default solver of `simulate` at rtol = 50 round-offs, in float64 wherever that is
    enabled. Its own error is estimated by its distance to a second run at 500 round-offs, and returned as
    `reference_error`; that distance is mostly the error of the second run, so the estimate is on the safe side. Outputs
    between steps are interpolated: a solver whose interpolation is less accurate than its steps, such as plain
    `diffrax.Dopri8()`, shows that error here, as it does in use.

    - `system`, `q0`, `qdot0`, `ts`, `params`, `max_steps`: as for `simulate`.
    - `solvers`: names, and what `simulate` takes as its `solver`: an adaptive one of diffrax, `lagjax.MachineCode()`,
      or None for the engine that `simulate` chooses. By default that engine first, under its name, then Dopri8 with
      fine output and Tsit5.
    - `tolerances`: values of rtol, atol being rtol/1000 as in `simulate`; by default from 1e-4 to 1e-12 in float64,
      from 1e-2 to 1e-5 in float32.
    - `batch_axes`: time `simulate_batch` with these axes instead of `simulate`. Errors are then the median and the
      maximum over the members that reached their end.
    - `repeats`: how often each run is timed. The median counts, without the compilation.

    `wasted` is the number of steps that lanes spent idle, over the steps that the members needed. In diffrax a batch
    steps until its slowest member arrives; machine code gives the lane of a member that has ended to the next one.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, `SimulationError` when the reference of
    a single trajectory cannot be followed to its end.

    Source: Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I*, §II.10 (work-precision diagrams).

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
    print(lagjax.work_precision(scene, 1.0, 0.0, jnp.linspace(0, 10, 101), tolerances=[1e-6, 1e-9]))
    ```
    """
    system = require_system(system, contacts=True)
    dtype = np.dtype(jnp.result_type(jnp.float32, *(jnp.asarray(leaf).dtype for leaf in jax.tree.leaves((q0, qdot0)))))
    measured: Any = {"default": None, **_SOLVERS} if solvers is None else solvers
    _require_adaptive(measured)
    tolerances = _TOLERANCES[dtype] if tolerances is None else tolerances
    _require_tolerances(tolerances, dtype, measured)
    if isinstance(repeats, bool) or not isinstance(repeats, int) or repeats < 1:
        raise ValueError(f"repeats must be a positive integer; got {repeats!r}.")

    scene = as_arrays((q0, qdot0, jnp.asarray(ts), params), dtype, "state")
    precise = as_arrays(scene, jnp.result_type(float))

    def run(solver, rtol, reference=False) -> Trajectory:
        arguments, options = precise if reference else scene, {"solver": solver, "rtol": rtol, "max_steps": max_steps}
        if batch_axes is None:
            return simulate(system, *arguments, throw=reference, **options)
        return simulate_batch(system, *arguments, batch_axes=batch_axes, **options)

    if solvers is None:  # the first is named after the integrator that `simulate` chooses
        name = "Taylor (machine code)" if run(None, max(tolerances)).engine == "MachineCode" else _FIRST
        measured = {f"default: {name}": None} | {other: of for other, of in _SOLVERS.items() if other != name}
    truth, resolution = _reference_path(partial(run, None, reference=True), jnp.result_type(float))
    rows = []
    for name, solver in measured.items():
        run(solver, max(tolerances))  # compiles; tolerances are traced, so once per solver
        rows += [_row(name, rtol, partial(run, solver, rtol), truth, repeats) for rtol in tolerances]
    return WorkPrecision(tuple(rows), *_median_and_worst(resolution), members=len(truth))


def _reference_path(run: Callable[[float], Trajectory], dtype) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference coordinates (members, T, n), and the estimated error of each member's reference."""
    eps = float(jnp.finfo(dtype).eps)
    truth = _coordinate_path(run(_REFERENCE * eps))
    resolution = np.abs(_coordinate_path(run(_CHECK * eps)) - truth).max(axis=(1, 2))
    if np.isnan(resolution).all():
        raise ValueError(
            "The reference reached the end for none of the members: look at the result of simulate_batch with a tight "
            "rtol, shorten ts, or raise max_steps."
        )
    return truth, resolution


def _row(name: str, rtol: float, run: Callable[[], Trajectory], truth: np.ndarray, repeats: int) -> WorkPrecisionRow:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        trajectory = run()
        jax.block_until_ready((trajectory.q, trajectory.qdot))
        times.append(time.perf_counter() - start)

    seconds = statistics.median(times)
    counts = "num_accepted_steps", "num_rejected_steps", "num_steps"
    accepted, rejected, steps = (np.atleast_1d(trajectory.stats[key]) for key in counts)
    idle = trajectory.stats.get("num_wasted_lane_steps", 0)  # of a batch only
    errors = _median_and_worst(np.abs(_coordinate_path(trajectory) - truth).max(axis=(1, 2)))
    shares = map(float, (accepted.mean(), rejected.mean(), np.mean(trajectory.ok), idle / max(steps.sum(), 1)))
    return WorkPrecisionRow(name, float(rtol), seconds, seconds / len(truth), *errors, *shares)


def _coordinate_path(trajectory: Trajectory) -> np.ndarray:
    """Return all coordinates at all times, (members, T, n); NaN for a member that did not reach its end."""
    return np.where(np.atleast_1d(trajectory.ok)[:, None, None], Members(trajectory).flat(trajectory.q), np.nan)


def _median_and_worst(errors: np.ndarray) -> tuple[float, float]:
    known = errors[~np.isnan(errors)]
    return (float(np.median(known)), float(known.max())) if known.size else (np.nan, np.nan)


def _require_adaptive(solvers: Mapping[str, diffrax.AbstractSolver | MachineCode | None]) -> None:
    if not isinstance(solvers, Mapping):
        raise TypeError(f"solvers must be a dict from names to diffrax solvers; got {type(solvers).__name__}.")
    if not solvers:
        raise ValueError("solvers is empty: name at least one, such as {'default': None} or {'5': diffrax.Tsit5()}.")
    for name, solver in solvers.items():
        if not isinstance(solver, diffrax.AbstractSolver | MachineCode | None):
            raise TypeError(
                f"solvers[{name!r}] must be an instance of a diffrax solver, lagjax.MachineCode() or None; got "
                f"{solver!r}."
            )
        if isinstance(solver, diffrax.AbstractSolver) and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
            raise ValueError(
                f"solvers[{name!r}] is {type(solver).__name__}, which has no error estimate: a tolerance means nothing "
                "to it. Choose an adaptive one, such as diffrax.Tsit5()."
            )


def _require_tolerances(tolerances: Sequence[float], dtype: np.dtype, solvers: Mapping) -> None:
    if not np.ndim(tolerances) == 1 or not len(tolerances):
        raise ValueError(f"tolerances must be a sequence of at least one value of rtol; got {tolerances!r}.")
    # What `simulate` asks for, found before the reference is computed; of machine code alone it asks for less.
    by_diffrax = any(isinstance(solver, diffrax.AbstractSolver) for solver in solvers.values())
    least = LEAST_RTOL_OF_DIFFRAX * jnp.finfo(dtype).eps if by_diffrax else LEAST_RTOL * np.finfo(float).eps
    for rtol in tolerances:
        if not (np.isfinite(rtol) and rtol >= least):
            raise ValueError(f"Every tolerance must be a number of at least {least:.1e} in {dtype.name}; got {rtol}.")


def _run_duration(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"
