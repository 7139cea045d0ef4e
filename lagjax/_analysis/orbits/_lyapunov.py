"""Lyapunov exponents: the mean rates at which neighbouring motions diverge.

The whole spectrum follows from derivatives of short arcs, which are rows of one run, in canonical coordinates: there
they are symplectic, and in the order (q1 … qn, pn … p1) their QR decompositions are Iwasawa's, whose diagonals contain
numbers and their inverses. So exponents come in pairs ±λ at every time, and not in the limit alone. The largest by
itself follows from one tangent that is integrated with the motion, as additional coordinates.

Source: Benettin, Galgani, Giorgilli & Strelcyn, *Lyapunov characteristic exponents for smooth dynamical systems and for
Hamiltonian systems*, Meccanica 15 (1980) 9; Leimkuhler & Van Vleck, *Orthosymplectic integration of linear Hamiltonian
systems*, Numer. Math. 77 (1997) 269, for the pairs.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._analysis.orbits._arc_motions import Arcs, check_starts
from lagjax._interface import SUCCESSFUL, SimulationError, require_flag, show_str
from lagjax._primitives import accepts_singles, sentence
from lagjax._run.hybrid import Scene
from lagjax._scene import System

_STEPS_OF_ARC = 8  # along which errors grow tenfold or so: the rounding of its derivative then stays round-off
_PORTION = 2**15  # arcs that are followed together: some ten megabytes for each coordinate
_BLOCKS = 16  # of a motion, whose own exponents tell how much the mean may be off
_MEMBERS = 2**14  # that are followed together: what a map of any size takes of memory


class LyapunovExponent(NamedTuple):
    """The largest Lyapunov exponent of a motion, or of many with the members as first axis.

    - `value` (): the mean rate at which a tangent grows, per unit of time; `error` (): its standard error, from the
      scatter among sixteen equal parts of the motion. A regular motion has the exponent zero; over a finite duration
      its `value` is about log(duration)/duration.
    - `ok`: whether the motion could be followed; NaN where not.
    """

    value: jax.Array
    error: jax.Array
    ok: jax.Array

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        value, error, ok = map(np.asarray, self)
        if not value.ndim:
            return f"Lyapunov exponent {value:.6g} ± {error:.1g} per unit of time"
        span = f" from {np.nanmin(value):.6g} to {np.nanmax(value):.6g}" if ok.any() else ""
        return f"{ok.sum()} of {ok.size} Lyapunov exponents{span} per unit of time"


@accepts_singles(("q0", "qdot0"), ("duration", "params"))
def lyapunov_spectrum(
    system: Scene,
    q0: PyTree,
    qdot0: PyTree,
    duration: jax.Array | float,
    params: PyTree = None,
    *,
    rtol: float = 1e-13,
    throw: bool = True,
) -> jax.Array:
    """All 2n Lyapunov exponents of the motion from (q0, qdot0) over a `duration`, descending, per unit of time.

    Without friction the exponents come in pairs ±λ whose sums vanish to round-off, at every duration. The exponent
    along the motion, and those of conserved momenta, tend to zero as log(t)/t.

    - `duration`: a number; or an array (N,) for N motions at once, with the members as first axis of every leaf of
      `q0` and `qdot0`. The result is then (N, 2n), NaN for a motion that cannot be followed.
    - `rtol`: the local error of the motion, see `simulate`.

    The scene may have contacts, as billiards do, or be a `Hybrid`; 4096 of their changes are followed.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, for a scene with constraints or without
    machine code; `SimulationError` when a single motion cannot be followed to its end.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    scene = lagjax.scenes.double_pendulum()
    lagjax.lyapunov_spectrum(scene.system, jnp.array([2.0, 2.5]), jnp.zeros(2), 20.0, scene.params)
    ```
    """
    require_flag(throw, "throw")
    durations, layout, y0 = check_starts(q0, qdot0, duration, "duration")
    arcs = Arcs.from_system(system, layout, params, rtol, "Lyapunov exponents", jumps=True)
    spans = durations.ravel()
    run = arcs.integrate(np.stack([np.zeros_like(spans), spans], axis=1), y0)
    if throw and durations.ndim == 0 and run.result[0] != SUCCESSFUL:
        reason = sentence(run.result[0], run.t_end[0], spans[0], run.y_end[0], layout.names)
        raise SimulationError(reason or "", None)
    pieces = max(1, -(-int(run.accepted.max()) // _STEPS_OF_ARC))
    size = max(1, _PORTION // pieces)
    parts = [_lyapunov_spectra(arcs, y0[k : k + size], spans[k : k + size], pieces) for k in range(0, len(y0), size)]
    exponents = np.concatenate(parts)
    return jnp.asarray(exponents if durations.ndim else exponents[0])


def _lyapunov_spectra(arcs: Arcs, y0: np.ndarray, duration: np.ndarray, pieces: int) -> np.ndarray:
    """Return the exponents (N, 2n) of N motions from y0 (N, 2n), each divided into this many arcs."""
    members, states = y0.shape
    times = duration[:, None] * np.arange(pieces + 1) / pieces
    run: Any = arcs.integrate(times, y0)
    path, modes = run.path, run.modes[:, :-1].ravel() if arcs.jumping else None
    spans = np.stack([times[:, :-1], times[:, 1:]], axis=2).reshape(-1, 2)
    well = np.isfinite(path).all(axis=(1, 2))
    rows = np.repeat(well, pieces)
    moved = np.full((members * pieces, states, states), np.nan)
    if well.any():
        starts, modes = path[:, :-1].reshape(-1, states)[rows], modes if modes is None else modes[rows]
        moved[rows] = arcs.differentiate(spans[rows], starts, modes=modes).by_start
    units = arcs.units(y0)
    moved = units.repeat(pieces).scale_growth(moved)
    chart = arcs.canonical_charts(times.ravel(), path.reshape(-1, states), units.repeat(pieces + 1))
    chart = chart.reshape(members, pieces + 1, states, states)
    order = np.append(np.arange(states // 2), np.arange(states - 1, states // 2 - 1, -1))
    growth, frame = np.zeros((members, states)), np.tile(np.eye(states), (members, 1, 1))
    moved = moved.reshape(members, pieces, states, states)
    for k in range(pieces):
        canonical = chart[well, k + 1] @ moved[well, k] @ np.linalg.inv(chart[well, k])
        frame[well], upper = np.linalg.qr(canonical[:, order][:, :, order] @ frame[well])
        growth[well] += np.log(np.abs(np.diagonal(upper, axis1=1, axis2=2)))
    growth[~well] = np.nan
    return -np.sort(-growth / duration[:, None], axis=1)


@accepts_singles(("q0", "qdot0"), ("duration", "params"))
def lyapunov_exponent(
    system: System, q0: PyTree, qdot0: PyTree, duration: jax.Array | float, params: PyTree = None, *, rtol: float = 1e-6
) -> LyapunovExponent:
    """The largest Lyapunov exponent of the motion from (q0, qdot0) over a `duration`, with its standard error.

    One tangent vector, with the same initial direction for every motion, is integrated along with it in a single run,
    so that maps of many starts are affordable. `duration` is a number, or an array (N,) for N motions at once, with the
    members as first axis of every leaf of `q0` and `qdot0`; they are followed some thousands at a time, so that memory
    does not grow with N. A motion that cannot be followed is NaN and not `ok`.

    `rtol` is loose by default: no tolerance gives the final state of a chaotic motion, and its exponent is a mean that
    any typical motion has.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, for a scene with constraints or without
    machine code.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    scene = lagjax.scenes.double_pendulum()
    angles = jnp.stack([jnp.linspace(0.5, 2.5, 5), jnp.zeros(5)], axis=1)
    lagjax.lyapunov_exponent(scene.system, angles, jnp.zeros((5, 2)), jnp.full(5, 50.0), scene.params).value
    ```
    """
    durations, layout, y0 = check_starts(q0, qdot0, duration, "duration")
    arcs = Arcs.from_system(system, layout, params, rtol, "Lyapunov exponents")
    some = [slice(k, k + _MEMBERS) for k in range(0, len(y0), _MEMBERS)]
    value, error = np.concatenate([_largest_exponent(arcs, y0[x], durations.ravel()[x]) for x in some], axis=1)
    if not durations.ndim:
        value, error = value[0], error[0]
    return LyapunovExponent(*map(jnp.asarray, (value, error, np.isfinite(value))))


def _largest_exponent(arcs: Arcs, y0: np.ndarray, duration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    (members, states), n = y0.shape, arcs.size
    flow = arcs.flow.tangent(1)
    numbers = np.concatenate([arcs.numbers, np.zeros_like(arcs.numbers)])[None]
    unit = arcs.units(y0).state
    tangent = np.tile(np.cos(np.arange(1.0, states + 1.0)), (members, 1))
    rates, y = np.empty((_BLOCKS, members)), y0
    for block in range(_BLOCKS):
        tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
        along = tangent * unit
        start = np.concatenate([y[:, :n], along[:, :n], y[:, n:], along[:, n:]], axis=1)
        times = duration[:, None] * (np.array([block, block + 1]) / _BLOCKS)
        run = flow.run(times, start, numbers, arcs.tolerances.with_larger_budget)
        end = np.where((run.result == SUCCESSFUL)[:, None], run.y_end, np.nan)
        y = np.concatenate([end[:, :n], end[:, 2 * n : 3 * n]], axis=1)
        tangent = np.concatenate([end[:, n : 2 * n], end[:, 3 * n :]], axis=1) / unit
        rates[block] = np.log(np.linalg.norm(tangent, axis=1)) * _BLOCKS / duration
    return rates.mean(axis=0), rates.std(axis=0, ddof=1) / np.sqrt(_BLOCKS)
