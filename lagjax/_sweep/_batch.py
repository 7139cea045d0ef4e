"""`Batches`: from the points of a batch of members to what is kept of each.

    points ──start──► (q0, qdot0, params) ──simulate_batch──► Trajectory ──keep──► values, and the change of energy

The user's functions are for one member. Where they are written in jax.numpy they are compiled for all members of a
batch at once; else they are called member by member, which `slow` tells.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._results import name_of, result_from
from lagjax._sweep._scene import NOT_TRACEABLE, Motions
from lagjax._sweep._sections import run_batch
from lagjax._sweep._store import RESULT, Quantity
from lagjax._trajectory import State, Trajectory

PyTree = Any
CRASHED, KEEP_FAILED = 1000, 1001  # result codes of the sweep's own, far from those of `lagjax.RESULTS`
NAMES = {CRASHED: "crashed", KEEP_FAILED: "keep_failed"}
MOST = 16_384  # members of a batch: more are no faster in machine code, and take more memory
MOST_ON_DEVICES = 131_072
PATH_BYTES = 64 * 2**20  # of the path of a batch


def label(code: int) -> str:
    """The name of a result code in a store."""
    return NAMES.get(code) or name_of(code)


class Kept(NamedTuple):
    """What remains of the members of a batch: values (B, …) by name, results (B,), |h − h₀| (B,), and complaints."""

    values: dict[str, np.ndarray]
    result: np.ndarray
    drift: np.ndarray | None
    complaints: dict[int, str]
    engine: str


def batches_of(motions: Motions, conserves: bool) -> "Batches":
    """What computes batches of these motions; the last ones are remembered, with what was compiled for them."""
    fixed = (motions.system, motions.q0, motions.qdot0, motions.params, motions.keep, *motions.settings.values())
    sections = motions.sections and motions.sections._replace(functions=tuple(map(id, motions.sections.functions)))
    key = (
        *map(id, fixed),
        sections,
        motions.left and motions.left.path,
        motions.ts.tobytes(),
        bool(conserves),
        jax.dtypes.canonicalize_dtype(float),
    )
    if key not in _remembered:
        while len(_remembered) >= _REMEMBERED:
            _remembered.pop(next(iter(_remembered)))
        _remembered[key] = Batches(motions, conserves)  # holds what the key names, so that no number is used twice
    return _remembered[key]


_REMEMBERED = 8
_remembered: "dict[tuple, Batches]" = {}


class Batches:
    """Computes batches of one sweep; what it compiles it keeps."""

    def __init__(self, motions: Motions, conserves: bool):
        self.motions, self.conserves = motions, conserves
        self.quantities: list[Quantity] = []  # what is kept of each member, once that is known
        self.slow: dict[str, str] = {}  # which functions are called member by member, and why
        begin = motions.left or motions
        roles = {"q0": begin.q0, "qdot0": begin.qdot0, "params": motions.params}
        if not any(map(callable, roles.values())):
            raise ValueError(
                "None of q0, qdot0 and params is a function: all members would be the same. Write q0=lambda point: "
                "point['theta'], with the names of `over`."
            )
        self._starts = {role: self._mapped(role, f) if callable(f) else None for role, f in roles.items()}
        of_q0, of_qdot0, of_params = (0 if start else None for start in self._starts.values())
        self._axes = (of_q0, of_qdot0, of_params)
        self._keep_all, self._tolerances = jax.jit(self._keep_of_all), None

    def __call__(self, points: dict[str, np.ndarray]) -> Kept:
        """What is kept of the members at these points (B,)."""
        motions, ts = self.motions, jnp.asarray(self.motions.ts)
        values = {role: start(points) if start else getattr(motions, role) for role, start in self._starts.items()}
        run, crossings = run_batch(motions.system, values, ts, self._axes, motions.settings, motions.sections)
        arrays = (_arrays(run), crossings), values["params"] if self._axes[2] == 0 else None
        self._tolerances = run.tolerances
        try:
            if "keep" in self.slow:
                raise _Slow
            kept, drift = self._keep_all(*arrays)
            kept, complaints = {name: np.asarray(x) for name, x in _by_name(kept).items()}, {}
        except (*NOT_TRACEABLE, _Slow) as why:
            if "keep" not in self.slow:
                self.slow["keep"] = _first_line(why)
            drift = self._drift_alone(*arrays) if self.conserves else None
            kept, complaints = self._one_by_one(run, crossings)
        result = np.asarray(run.result._value).astype(RESULT.dtype)
        if complaints:
            result = result.copy()
            result[list(complaints)] = KEEP_FAILED
        return Kept(kept, result, None if drift is None else np.asarray(drift), complaints, run.engine)

    # ---- compiled for all members ----

    def _mapped(self, role: str, function: Callable) -> Callable:
        """`function(point)` for points (B,) of all members."""
        compiled = jax.jit(jax.vmap(function))

        def start(points):
            if role not in self.slow:
                try:
                    return jax.tree.map(np.asarray, compiled(points))
                except NOT_TRACEABLE as why:
                    self.slow[role] = _first_line(why)
            count = len(next(iter(points.values())))
            rows = [function({name: float(x[k]) for name, x in points.items()}) for k in range(count)]
            return jax.tree.map(lambda *leaves: np.stack([np.asarray(x, float) for x in leaves]), *rows)

        return start

    def _keep_of_all(self, arrays: tuple, params: PyTree) -> tuple:
        """What `keep` returns of every member, and the change of the energy."""

        def of_member(arrays, params):
            run, crossings = arrays
            trajectory = self._trajectory(run, params)
            return self._kept(trajectory, crossings), self._drift(trajectory)

        return jax.vmap(of_member, in_axes=(0, self._axes[2]))(arrays, params)

    def _drift_alone(self, arrays: tuple, params: PyTree):
        def of_member(arrays, params):
            return self._drift(self._trajectory(arrays[0], params))

        return jax.jit(jax.vmap(of_member, in_axes=(0, self._axes[2])))(arrays, params)

    def _kept(self, trajectory: Trajectory, crossings: Any) -> dict:
        """What `keep` returns of one member."""
        keep, asked = self.motions.keep, {} if self.motions.sections is None else {"crossings": crossings}
        kept = keep(trajectory, **asked)
        _require_dict(kept)
        return kept

    def _trajectory(self, arrays: tuple, params: PyTree) -> Trajectory:
        """The trajectory of one member."""
        q, qdot, code, end, stats = arrays
        return Trajectory.of(
            ts=jnp.asarray(self.motions.ts), q=q, qdot=qdot, result=result_from(code), end=State(*end), stats=stats,
            system=self.motions.system, params=self.motions.params if self._axes[2] is None else params,
            params_axes=None, mode=None, transitions=None, mode_names=(), tolerances=self._tolerances, engine="",
        )  # fmt: skip

    def _drift(self, run: Trajectory):
        """|h − h₀| from the first output to the end."""
        if not self.conserves:
            return None
        q, qdot = jax.tree.map(lambda x: x[0], (run.q, run.qdot))
        energy, end = self.motions.system.energy, run.end
        return jnp.abs(energy(end.q, end.qdot, end.t, run.params) - energy(q, qdot, run.ts[0], run.params))

    # ---- member by member ----

    def _one_by_one(self, run: Trajectory, crossings: Any) -> tuple[dict[str, np.ndarray], dict[int, str]]:
        """What `keep` returns of each member, called with numbers; and what is wrong with what it returned."""
        arrays = jax.tree.map(np.asarray, (_arrays(run), crossings))
        params, rows, complaints = jax.tree.map(np.asarray, eqx.filter(run.params, eqx.is_array_like)), [], {}
        for k in range(len(run.result._value)):
            of_member = jax.tree.map(lambda x, k=k: x[k], params) if self._axes[2] == 0 else None
            try:
                one, crossed = jax.tree.map(lambda x, k=k: x[k], arrays)
                kept = self._kept(self._trajectory(one, of_member), crossed)
                rows.append({name: np.asarray(x) for name, x in _by_name(kept).items()})
            except _NotADict:
                raise
            except Exception as error:  # of the user's function: it costs this member, and nobody else
                rows.append(None)
                complaints[k] = f"keep raised {type(error).__name__}: {_first_line(error)}"
        expected = self.quantities or _quantities(next((row for row in rows if row), {}))
        for k, row in enumerate(rows):
            if row is not None and (wrong := _misfit(expected, row)):
                rows[k], complaints[k] = None, wrong
        return {q.name: _stacked(q, rows) for q in expected}, complaints


class _Slow(Exception):
    """That `keep` is known to be called member by member."""


class _NotADict(TypeError):
    """That `keep` does not return a dict, which is no matter of one member."""


def quantities_of(kept: Kept) -> list[Quantity]:
    """The quantities that are kept, from those of a batch."""
    return [Quantity(name, x.shape[1:], x.dtype) for name, x in kept.values.items()]


def _quantities(row: dict[str, np.ndarray]) -> list[Quantity]:
    return [Quantity(name, x.shape, x.dtype) for name, x in row.items()]


def _arrays(run: Trajectory) -> tuple:
    stats = {name: count for name, count in run.stats.items() if jnp.ndim(count)}  # what is of each member
    return run.q, run.qdot, run.result._value, tuple(run.end), stats


def _misfit(expected: list[Quantity], row: dict[str, np.ndarray]) -> str | None:
    """How what `keep` returned differs from what it returned of others."""
    names = [q.name for q in expected]
    if names != list(row):
        return f"keep returned {list(row)}, of other members {names}"
    for q in expected:
        if row[q.name].shape != q.shape:
            return f"keep returned {q.name!r} of shape {row[q.name].shape}, of other members {q.shape}"
        if not np.can_cast(row[q.name].dtype, q.dtype, "same_kind"):
            return f"keep returned {q.name!r} of type {row[q.name].dtype}, of other members {q.dtype}"
    return None


def _stacked(q: Quantity, rows: list) -> np.ndarray:
    nothing = np.full(q.shape, q.nothing, q.dtype)
    return np.stack([nothing if row is None else row[q.name].astype(q.dtype) for row in rows])


def _require_dict(kept: Any) -> None:
    if not isinstance(kept, dict) or not kept:
        raise _NotADict(
            "keep must return a dict that is not empty: names with numbers or arrays, such as {'angle': "
            f"trajectory.q[-1]}}; it returned {type(kept).__name__}."
        )


def _by_name(kept: dict) -> dict[str, Any]:
    """The leaves of what `keep` returns by names, those of inner trees with points: 'end.theta'."""
    return dict(zip(jax.tree.leaves(names_of(kept)), jax.tree.leaves(kept), strict=True))


def names_of(kept: dict) -> dict:
    """What `keep` returns with the name of every leaf in its place."""
    return jax.tree_util.tree_map_with_path(
        lambda path, _: ".".join(str(getattr(k, "key", getattr(k, "name", getattr(k, "idx", k)))) for k in path), kept
    )


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0][:200]
