"""`Batches`: from the points of a batch of members to what is kept of each.

    points ──start──► (q0, qdot0, params) ──run_batch──► Trajectory, Crossings ──keep──► values, change of energy

The user's functions are for one member. Where they are written in jax.numpy they are compiled for all members of a
batch at once; else they are called member by member, and `slow` says why.
"""

import contextlib
import dataclasses
import functools
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import Batch, Solution, axes_per_leaf
from lagjax._engine.taylor import FoundCrossings, MachineCode, flow_of, tolerances_of
from lagjax._equations import has_constraints
from lagjax._interface import RESULTS, SUCCESSFUL, as_arrays, code_of, name_of, result_from
from lagjax._run import Trajectory, restore_crossings, sections_of, simulate, simulate_batch, surfaces_in, trajectory_of
from lagjax._run.hybrid import Hybrid, may_jump
from lagjax._sweep._description import NOT_TRACEABLE, Description, Sections
from lagjax._sweep._files import RESULT, Quantity

_Kept = tuple[dict[str, np.ndarray], np.ndarray | None, dict[int, str]]  # values, |h − h₀| and complaints
KEEP_FAILED = 1001  # a result code of the sweep's own, far from those of `lagjax.RESULTS`
NAMES = {KEEP_FAILED: "keep_failed"}
MOST_CONTACT_CHANGES = 256  # of the contacts of a member: the default of `simulate_batch`
MOST_MEMBERS = 16_384  # members of a batch: more are no faster in machine code, and take more memory
MOST_ON_DEVICES = 131_072
PATH_BYTES = 64 * 2**20  # of the path of a batch
_RAISED = re.compile(r"[\w.]+(Error|Exception|Warning|Interrupt): ")


def result_name(code: int) -> str:
    return NAMES.get(code) or name_of(code)


class KeptResults(NamedTuple):
    """The results of the members of a batch: values (B, …) by name, results (B,), |h − h₀| (B,), and complaints."""

    values: dict[str, np.ndarray]
    result: np.ndarray
    drift: np.ndarray | None
    complaints: dict[int, str]
    engine: str


class Batches:
    """Simulates batches of a sweep's members, and keeps the compiled programs."""

    def __init__(self, description: Description, conserves: bool):
        self.description, self.conserves = description, conserves
        self.quantities: list[Quantity] = []  # what is kept of each member, once that is known
        self.slow: dict[str, str] = {}  # which functions are called member by member, and why
        roles = {role: getattr(description, role) for role in ("q0", "qdot0", "params", "ts")}
        if names := description.starts:
            roles["q0"] = lambda point: jax.tree.map(point.__getitem__, names.q)
            roles["qdot0"] = lambda point: jax.tree.map(point.__getitem__, names.qdot)
        if not any(map(callable, roles.values())):
            raise ValueError(
                "None of q0, qdot0, params and ts is a function: all members would be the same. Write q0=lambda point: "
                "point['theta'], with the names of `over`."
            )
        if callable(roles["ts"]) and not callable(roles["q0"]):
            roles["q0"] = lambda _: description.q0  # each member has a start, as it has times
        self._starts = {role: self._vectorize_start(role, f) if callable(f) else None for role, f in roles.items()}
        self._axes = tuple(0 if self._starts[role] else None for role in ("q0", "qdot0", "params"))
        self._keep_all, self._keep_one = jax.jit(self._keep_members), jax.jit(self._keep_member)
        self._drift_all, self._tolerances = jax.jit(jax.vmap(self._energy_drift, in_axes=(0, self._axes[2]))), None
        self._settings = None

    def __call__(self, points: dict[str, np.ndarray]) -> KeptResults:
        """The kept values of the members at these points (B,)."""
        motions, no_start, wrong = self._compute_motions(points)
        kept, drift, complaints = self._keep_results(motions)
        complaints |= wrong
        result = np.asarray(motions.run.result._value).astype(RESULT.dtype)
        if complaints:
            result = result.copy()
            result[list(complaints)] = KEEP_FAILED
        if wrong:
            expected = self.quantities or [Quantity(name, x.shape[1:], x.dtype) for name, x in kept.items()]
            kept = {name: np.array(x) for name, x in kept.items()}
            for q in expected:
                kept[q.name][list(wrong)] = q.filling
        return KeptResults(kept, result, drift, no_start | complaints, motions.run.engine)

    def count_member_bytes(self, points: dict[str, np.ndarray]) -> int:
        """The bytes that are kept of a member, of the first of these; 0 where `keep` fails for that one."""
        motions, *_ = self._compute_motions({name: x[:1] for name, x in points.items()})
        try:
            kept, _ = jax.eval_shape(self._keep_members, motions.arrays, motions.params)
            return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(kept))
        except NOT_TRACEABLE:
            (row,), _ = self._call_keep(motions)
            return sum(x.nbytes for x in (row or {}).values())

    def _compute_motions(self, points: dict[str, np.ndarray]) -> tuple["_BatchMotions", dict[int, str], dict[int, str]]:
        """The motions at points (B,), and {member: sentence} on failed starts, then on wrong output times."""
        description, complaints, wrong = self.description, {}, {}
        starts = self._starts.items()
        values = {role: f(points, complaints) if f else getattr(description, role) for role, f in starts}
        ts = values.pop("ts")
        if self._starts["ts"]:
            ts, wrong = _replace_bad_times(ts, complaints)
        run, crossings = run_batch(description, values, jnp.asarray(ts), self._axes)
        self._tolerances, self._settings = None if may_jump(description.system) else run.tolerances, run.settings
        for_members = values["params"] if self._axes[2] == 0 else None
        of_run = _result_arrays(run) | ({"ts": ts} if self._starts["ts"] else {})
        return _BatchMotions(run, (of_run, crossings), for_members), complaints, wrong

    def _keep_results(self, motions: "_BatchMotions") -> _Kept:
        """The results of `keep` for every member, |h − h₀| (B,), and {member: sentence} for those where it raised."""
        if "keep" not in self.slow:
            try:
                kept, drift = self._keep_all(motions.arrays, motions.params)
                return _arrays_by_name(kept), None if drift is None else np.asarray(drift), {}
            except NOT_TRACEABLE as why:
                self.slow["keep"] = _first_line(why)
            except jax.errors.JaxRuntimeError:  # of a callback, for some of them
                pass
        drift = self._drift_all(motions.arrays, motions.params)
        kept, complaints = self._keep_one_by_one(motions)
        if drift is not None:
            drift = np.asarray(drift).copy()
            drift[list(complaints)] = np.nan
        return kept, drift, complaints

    # ---- compiled for all members ----

    def _vectorize_start(self, role: str, function: Callable) -> Callable:
        """`start(points, complaints)`: `function` at points (B,); members that raise get a complaint."""
        compiled = jax.jit(jax.vmap(function))

        def start(points, complaints):
            if role not in self.slow:
                try:
                    return jax.tree.map(np.asarray, compiled(points))
                except NOT_TRACEABLE as why:
                    self.slow[role] = _first_line(why)
            return _start_one_by_one(role, function, points, complaints)

        return start

    def _keep_members(self, arrays: tuple, params: PyTree) -> tuple:
        keep_member = lambda *of: (self._keep_member(*of), self._energy_drift(*of))  # noqa: E731
        return jax.vmap(keep_member, in_axes=(0, self._axes[2]))(arrays, params)

    def _keep_member(self, arrays: tuple, params: PyTree) -> dict:
        run, crossings = arrays
        extras = {} if self.description.sections is None else {"crossings": crossings}
        kept = self.description.keep(self._member_trajectory(run, params), **extras)
        _require_dict(kept)
        return kept

    def _member_trajectory(self, arrays: dict, params: PyTree) -> Trajectory:
        """The `Trajectory` of one member, as `keep` takes it, from its arrays."""
        scene, code, ts = self.description.system, arrays["code"], arrays.get("ts", self.description.ts)
        modes = dict(scene.modes) if isinstance(scene, Hybrid) else None
        return Trajectory.from_fields(
            **{name: x for name, x in arrays.items() if name not in ("code", "ts")}, result=result_from(code),
            settings=self._settings, tolerances=self._tolerances, ts=jnp.asarray(ts),
            system=modes or scene,
            params=self.description.params if self._axes[2] is None else params, mode_names=tuple(modes or ()),
            contact_names=(),
        )  # fmt: skip

    def _energy_drift(self, arrays: tuple, params: PyTree):
        """|h − h₀| of a member from the first output to the end."""
        scene, run = self.description.system, self._member_trajectory(arrays[0], params)
        if not self.conserves or isinstance(scene, Hybrid) or may_jump(scene):
            return None
        q, qdot = jax.tree.map(lambda x: x[0], (run.q, run.qdot))
        energy, end = scene.energy, run.end
        return jnp.abs(energy(end.q, end.qdot, end.t, run.params) - energy(q, qdot, run.ts[0], run.params))

    # ---- member by member ----

    def _keep_one_by_one(self, motions: "_BatchMotions") -> tuple[dict[str, np.ndarray], dict[int, str]]:
        """The results of `keep`, called member by member, (B, …) by name; and {member: sentence} where it failed."""
        rows, errors = self._call_keep(motions)
        if not self.quantities and not any(rows):
            raise errors[0]  # at the first look, of all members
        complaints = {k: f"keep raised {_describe_error(error)}" for k, error in errors.items()}
        expected = self.quantities or _common_quantities([row for row in rows if row])
        for k, row in enumerate(rows):
            if row is not None and (wrong := _explain_mismatch(expected, row)):
                rows[k], complaints[k] = None, wrong
        kept = {q.name: np.full((len(rows), *q.shape), q.filling, q.dtype) for q in expected}
        for k, row in enumerate(rows):
            for name, x in (row or {}).items():
                kept[name][k] = x
        return kept, complaints

    def _call_keep(self, motions: "_BatchMotions") -> tuple[list[dict[str, np.ndarray] | None], dict[int, Exception]]:
        """The dict that `keep` returns for each member, None where it raised; and {member: exception}."""
        of_all = jax.tree.map(np.asarray, (*motions.arrays, motions.params))
        keep_member = self._keep_member if "keep" in self.slow else self._keep_one

        def keep(k: int) -> dict[str, np.ndarray]:
            *arrays, params = jax.tree.map(lambda x: x[k], of_all)
            return _arrays_by_name(keep_member(tuple(arrays), params))

        return _call_each(keep, len(motions.run.result._value))


class _BatchMotions(NamedTuple):
    """The motions of a batch; the arrays of B members (trajectories, crossings); params that differ by member."""

    run: Trajectory
    arrays: tuple
    params: PyTree


def _replace_bad_times(ts: np.ndarray, complaints: dict[int, str]) -> tuple[np.ndarray, dict[int, str]]:
    """Times (B, T) with invalid rows replaced by a valid one; and {member: sentence} for those."""
    steps = np.diff(ts, axis=1)
    is_sound: Any = np.isfinite(ts).all(axis=1) & ((steps > 0).all(axis=1) | (steps < 0).all(axis=1))
    reason = "ts returned times that are not finite, or neither increase nor decrease"
    wrong = {k: complaints.pop(k, reason) for k in np.flatnonzero(~is_sound).tolist()}
    any_times = ts[np.argmax(is_sound)] if is_sound.any() else np.arange(float(ts.shape[1]))
    return np.where(is_sound[:, None], ts, any_times), wrong


def _start_one_by_one(role: str, function: Callable, points: dict[str, np.ndarray], complaints: dict[int, str]):
    """`function(point)` member by member; NaN where it raises, with a sentence in `complaints`."""

    def start(k: int) -> PyTree:
        return jax.tree.map(lambda x: np.asarray(x, float), function({name: float(x[k]) for name, x in points.items()}))

    rows, errors = _call_each(start, len(next(iter(points.values()))))
    if len(errors) == len(rows):
        raise errors[0]
    complaints |= {k: f"{role} raised {_describe_error(error)}" for k, error in errors.items()}
    well = next(row for k, row in enumerate(rows) if k not in errors)
    rows = [jax.tree.map(lambda x: np.full_like(x, np.nan), well) if k in errors else row for k, row in enumerate(rows)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _call_each(function: Callable[[int], Any], count: int) -> tuple[list[Any], dict[int, Exception]]:
    """The results of `function(k)` for k < count, None where it raised; and {k: exception}."""
    rows, errors = [None] * count, {}
    for k in range(count):
        try:
            rows[k] = function(k)
        except Exception as error:
            errors[k] = error
    return rows, errors


def _common_quantities(rows: list[dict[str, np.ndarray]]) -> list[Quantity]:
    """The kept quantities, named as by the first member, each with the dtype that holds the values of all."""
    common = []
    for name, first in rows[0].items():
        dtype = first.dtype
        with contextlib.suppress(TypeError):
            dtype = np.result_type(*(row[name].dtype for row in rows if name in row))
        common.append(Quantity(name, first.shape, dtype))
    return common


_KEPT = ("q", "qdot", "end", "mode", "transitions", "impacts", "contacts", "contact_changes")


def _result_arrays(run: Trajectory) -> dict[str, Any]:
    """The fields of a batch's trajectory that `keep` may read, by name, as arrays with the members first."""
    fields = {name: getattr(run, name) for name in _KEPT}
    fields |= {name: _fill_record(fields[name]) for name in ("impacts", "contact_changes") if fields[name] is not None}
    return fields | {"code": run.result._value, "stats": {k: x for k, x in run.stats.items() if jnp.ndim(x)}}


def _fill_record(record: Any) -> Any:
    """`Impacts` or `ContactChanges` (B, N, …) padded to N = `MOST_CONTACT_CHANGES`, so that batches agree."""

    def fill(x):
        widths = [(0, 0), (0, MOST_CONTACT_CHANGES - x.shape[1]), *[(0, 0)] * (jnp.ndim(x) - 2)]
        return jnp.pad(x, widths, constant_values=jnp.nan if x.dtype.kind == "f" else -1)

    parts = {name: x for name, x in record._asdict().items() if name not in ("count", "doubts", "doubted")}
    return record._replace(**jax.tree.map(fill, parts))


def _explain_mismatch(expected: list[Quantity], row: dict[str, np.ndarray]) -> str | None:
    """A sentence if a member's kept values differ in name, shape or type from the expected ones; else None."""
    names = [q.name for q in expected]
    if names != list(row):
        return f"keep returned {list(row)}, of other members {names}"
    for q in expected:
        if row[q.name].shape != q.shape:
            return f"keep returned {q.name!r} of shape {row[q.name].shape}, of other members {q.shape}"
        if not np.can_cast(row[q.name].dtype, q.dtype, "same_kind"):
            return f"keep returned {q.name!r} of type {row[q.name].dtype}, of other members {q.dtype}"
    return None


def _require_dict(kept: Any) -> None:
    if not isinstance(kept, dict) or not jax.tree.leaves(kept):
        raise TypeError(
            "keep must return a dict that is not empty: names with numbers or arrays, such as {'angle': "
            f"trajectory.q[-1]}}; it returned {type(kept).__name__ if not isinstance(kept, dict) else kept}."
        )
    names = jax.tree.leaves(leaf_names(kept))
    for name, leaf in zip(names, jax.tree.leaves(kept), strict=True):
        if names.count(name) > 1:
            raise ValueError(f"keep returns two quantities with the name {name!r} in the store: rename one of them.")
        dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
        if dtype.kind not in "fciub":
            what = f"an array of type {dtype}" if hasattr(leaf, "dtype") else type(leaf).__name__
            raise TypeError(f"keep returns {name!r}, which is of type {what}: numbers can be kept.")


def _arrays_by_name(kept: dict) -> dict[str, np.ndarray]:
    return dict(zip(jax.tree.leaves(leaf_names(kept)), map(np.asarray, jax.tree.leaves(kept)), strict=True))


def leaf_names(kept: dict) -> dict:
    key = lambda path, _: jax.tree_util.keystr(path, simple=True, separator=".")  # noqa: E731
    return jax.tree_util.tree_map_with_path(key, kept)


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0][:200]


def _describe_error(error: Exception) -> str:
    """The type and first line of an error; for one raised in a callback, its line within XLA's message."""
    lines = (line.strip() for line in reversed(str(error).split("\n")))
    said = next((line for line in lines if _RAISED.match(line)), None)
    return f"{type(error).__name__}: {_first_line(error)}" if said is None else said[:200]


# ---- motions of all members, with their crossings of sections on the way ---------------------------------------------

_INCONSISTENT = code_of(RESULTS.inconsistent_start)


@functools.lru_cache(maxsize=8)
def _hybrid_batch(scene: Hybrid, axes: tuple, **tolerances) -> Callable:
    follow_member = functools.partial(simulate, scene, throw=False, **tolerances)
    return jax.jit(jax.vmap(follow_member, in_axes=axes))


def run_batch(description: Description, values: dict[str, PyTree], ts, axes: tuple) -> tuple[Trajectory, Any]:
    """The motions of B members and their `Crossings` (a dict by name, None without sections), members first; `values`
    are q0, qdot0 and params by name, `axes` their `batch_axes`."""
    system, settings, sections = description.system, description.settings, description.sections
    q0, qdot0, params = values.values()
    if may_jump(system):
        tolerances = {name: settings[name] for name in ("rtol", "atol", "max_steps")}
        of_times = None if ts.ndim == 1 else 0
        return _hybrid_batch(system, (*axes[:2], of_times, axes[2]), **tolerances)(q0, qdot0, ts, params), None
    if sections is None:
        return simulate_batch(system, q0, qdot0, ts, params, batch_axes=axes, **settings), None
    of_leaves, size = axes_per_leaf(values, axes)
    tolerances = (settings[name] for name in ("rtol", "atol", "max_steps"))
    batch = Batch.from_values(system, values, of_leaves, size, ts, *tolerances)
    solution, noted = _find_crossings(batch, sections)
    if len(ts) == 2 and not has_constraints(system):
        params, reached = as_arrays(params, batch.member.layout.dtype), (solution.result == SUCCESSFUL)[:, None]
        ends = np.stack([np.asarray(batch.y0), np.where(reached, solution.y_end, np.nan)], axis=1)  # at both times
        run = trajectory_of(batch.member, MachineCode(), solution._replace(path=ends), batch.y0, params, axes[2])
    else:
        run = simulate_batch(system, q0, qdot0, ts, params, batch_axes=axes, **settings)
        starts = np.asarray(run.result._value) != _INCONSISTENT  # others are not followed, and cross nothing
        t, y = np.where(starts[:, None], noted.t, np.nan), np.where(starts[:, None, None], noted.y, np.nan)
        noted = FoundCrossings(t, y, np.where(starts, noted.count, 0))
    ok = (solution.result == SUCCESSFUL) & (noted.count <= sections.count)
    return run, restore_crossings(batch.member.layout, sections.names, noted, ok)


def _find_crossings(batch: Batch, sections: Sections) -> tuple[Solution, FoundCrossings]:
    """The motions of a batch, and the crossings of G sections, (G, B, …)."""
    section = sections.named_functions() if sections.names else sections.functions[0]
    surfaces = surfaces_in(batch.member, sections_of(section)[1], sections.directions, sections.names)
    problem = dataclasses.replace(batch.member, guards=surfaces.guards(notes=True))
    tolerances = tolerances_of(problem)._replace(notes=sections.count)
    ts, y0, params = (np.asarray(x) for x in (batch.ts, batch.y0, batch.vectors))
    solution = flow_of(problem).run(ts, y0, params, tolerances)
    path = solution.path.reshape(len(y0), len(sections.functions), sections.count + 1, -1)
    rows = np.moveaxis(path, 1, 0)
    return solution, FoundCrossings(rows[:, :, :-1, 0], rows[:, :, :-1, 1:], rows[:, :, -1, 0])
