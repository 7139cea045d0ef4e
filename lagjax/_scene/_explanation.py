"""The contents of a scene, and what was left out of its equations: facts read off the scalar programs.

Nothing here looks at numbers: a coordinate is cyclic when no operation of the reduced Lagrangian reads it, the energy
is conserved when none reads the time, no force is given, and the constraints do no work: f does not read the time, and
a(q, q̇) is zero at rest. Only the dependence of constraints on each other is decided at one state.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

from lagjax._engine import Problem, choose
from lagjax._engine.taylor import MachineCode
from lagjax._equations import Derivation, border_places, dependent_rows
from lagjax._interface import join_names, show_str
from lagjax._native import Nesting, is_large, pieces_of
from lagjax._program import CLOCK, FLOOR, SIGN, TABLE, TRUNC, Unlowerable
from lagjax._tracing import Program

_PIECES = {
    SIGN: "the sign of", FLOOR: "the whole part of", TRUNC: "the whole part of", CLOCK: "samples by",
    TABLE: "a table by",
}  # fmt: skip
_LISTED = 12  # names that a row of an explanation lists
_GROUPED = 100  # names of which the first and the last are shown alone


@dataclass(frozen=True)
class Explanation:
    """The facts about a scene; `print` shows them as a table. A fact that could not be determined is None.

    Of a large scene that runs on arrays (`path`, `reason`) facts are read off operations, also where terms cancel, and
    none is about the state.

    - `coordinates`: the name of every scalar coordinate; `cyclic`: those that L does not depend on, whose momenta are
      conserved where no force and no constraint force acts.
    - `mass_matrix`: "constant" or "varying", then "diagonal", "block-diagonal" or "dense", or the form of a large
      one; `mass_matrix_depends_on`: the coordinates, velocities (`d` before the name) and `t` that it reads, of a large
      scene "q" and "dq" for any of them.
    - `velocity_terms`: whether forces depend on the velocities; `explicit_time`: whether anything depends on `t`.
    - `energy_conserved`: whether h = p·q̇ − L is constant along every motion.
    - `borders`: where the accelerations are piecewise: the operation (a sign, a whole part) and what it reads; on the
      array path the operation and its line. `borders_located`: whether steps end exactly there; otherwise they go
      across, and there are no derivatives of a motion that crosses a jump. `narrow`: functions that are flat until
      their argument comes near (exp, tanh, …), and powers that rise from nothing as their base falls or grows, whose
      arguments and bases machine code watches along every step.
    - `operations`: scalar operations of one acceleration (with constraints in machine code, where M is regular);
      `traced_operations`: of its derivatives before reduction.
    - `constraints`: the name of every number that is to be zero; `dependent_constraints`: those that, at the state in
      question, are combinations of earlier ones, and of which (to eps^(2/3) of the squared gradient). They change
      nothing but the multipliers.
    - `contacts`: the names of gaps and one-way velocities that stay positive; all other facts are those of the motion
      while none is closed.
    - `projection_operations`: scalar operations of one projection onto the constraints, which follows every step.
    - `path`: "scalar" or "array"; `reason`: why not "scalar".
    - `solver`: the default engine, and why not machine code where it is not; for machine code also whether operations
      are written one by one or stand in tables.
    """

    coordinates: tuple[str, ...]
    path: str
    reason: str
    solver: str
    cyclic: tuple[str, ...] | None = None
    mass_matrix: str | None = None
    mass_matrix_depends_on: tuple[str, ...] | None = None
    velocity_terms: bool | None = None
    explicit_time: bool | None = None
    energy_conserved: bool | None = None
    borders: tuple[str, ...] | None = None
    borders_located: bool | None = None
    narrow: tuple[str, ...] | None = None
    operations: int | None = None
    traced_operations: int | None = None
    constraints: tuple[str, ...] = ()
    dependent_constraints: dict[str, tuple[str, ...]] | None = field(default_factory=dict)
    projection_operations: int | None = None
    contacts: tuple[str, ...] = ()

    def with_constraints(self, names: list[str], schur_complement: np.ndarray | None) -> "Explanation":
        """Return this with the constraints' names and, given G M⁻¹ Gᵀ (m, m), the linearly dependent ones."""
        dependent = None
        if schur_complement is not None:
            dependent = {
                names[row]: tuple(name for name, factor in zip(names, factors, strict=True) if factor)
                for row, factors in dependent_rows(schur_complement).items()
            }
        return replace(self, constraints=tuple(names), dependent_constraints=dependent)

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        rows = [("coordinates", f"{len(self.coordinates)}: {_list_names(self.coordinates, counts=False)}")]
        if self.mass_matrix is not None:
            answers = {True: "yes", False: "no", None: "not known"}
            read = _list_names(self.mass_matrix_depends_on or ()) or "none"
            rows += [
                ("cyclic", "not known" if self.cyclic is None else _list_names(self.cyclic) or "none"),
                ("mass matrix", f"{self.mass_matrix}; depends on {read}"),
                ("velocity terms", answers[self.velocity_terms]),
                ("explicit time", answers[self.explicit_time]),
                ("energy conserved", answers[self.energy_conserved]),
            ]
        if self.borders:
            how = "steps end there" if self.borders_located else "not located: steps of diffrax go across"
            rows.append(("borders", f"{_count_names(self.borders)}; {how}"))
        if self.narrow:
            rows.append(("narrow features", _count_names(self.narrow)))
        for what, names in (("constraints", self.constraints), ("contacts", self.contacts)):
            rows += [(what, f"{len(names)}: {_list_names(names, counts=False)}")] if names else []
        for name, others in (self.dependent_constraints or {}).items():
            rows.append(("dependent", f"{name} on {join_names(others, _LISTED)}"))
        if self.operations is not None:
            traced = "" if self.traced_operations is None else f", {self.traced_operations} as derived"
            rows.append(("operations", f"{self.operations} per acceleration{traced}"))
        if self.projection_operations is not None:
            rows.append(("", f"{self.projection_operations} per projection to the constraints"))
        rows.append(("path", self.path + (f", because {self.reason}" if self.reason else "")))
        rows.append(("solver", self.solver))
        return "\n".join(f"{name:17s} {value}" for name, value in rows)


def explain(problem: Problem) -> Explanation:
    """Collect the facts about the scene of a problem, and choose its engine."""
    derivation = problem.derivation
    names, n, motion = derivation.layout.names, derivation.layout.size, derivation.motion
    known = {"coordinates": names, **_engine_facts(problem)}
    if derivation.form.is_sparse:
        return Explanation(**known, **_borders_in_lines(problem), **_facts_of_arrays(derivation))
    try:
        matrix, force = derivation.program("mass_matrix"), derivation.reads("force")
    except Unlowerable:
        return Explanation(**known, **_borders_in_lines(problem))

    inputs = (*names, *(f"d{name}" for name in names), "t")

    def named(*quantities: str) -> set[str]:
        return {inputs[i] for quantity in quantities for i in derivation.reads(quantity) if i < len(inputs)}

    mass, lagrangian = named("mass_matrix"), named("lagrangian")
    return Explanation(
        **known,
        **_border_facts(problem, inputs),
        cyclic=tuple(name for name in names if name not in lagrangian),
        mass_matrix=f"{'varying' if mass else 'constant'}, {_pattern_kind(matrix, n)}",
        mass_matrix_depends_on=tuple(name for name in inputs if name in mass),
        velocity_terms=any(i in force for i in range(n, 2 * n)),
        explicit_time="t" in named("lagrangian", "mass_matrix", "force", "residual"),
        energy_conserved=not derivation.works and motion.forces is None and motion.dissipation is None,
        traced_operations=derivation.traced_operations,
    )


def _facts_of_arrays(derivation: Derivation) -> dict[str, Any]:
    """Return the facts about a scene that runs on arrays, by what its operations read, even if that cancels."""
    motion, cyclic, form = derivation.motion, derivation.cyclic, derivation.form.mass
    names, inputs = derivation.layout.names, ("q", "dq", "t")

    def reads(function) -> set[str]:
        jaxpr = jax.make_jaxpr(function)(*derivation.state_shapes).jaxpr
        _, used = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
        return {name for name, is_used in zip(inputs, used, strict=False) if is_used}

    mass = reads(lambda *state: motion.mass_product(*state)(jnp.ones_like(state[0])))
    of_constraints = reads(motion.residual) if motion.constrained else set()
    timed = "t" in reads(motion.lagrangian) | of_constraints
    works = timed or motion.forces is not None or motion.dissipation is not None
    return {
        "cyclic": None if cyclic is None else tuple(names[i] for i in cyclic),
        "mass_matrix": f"{'varying' if mass else 'constant'}, {form and form.name}",
        "mass_matrix_depends_on": tuple(name for name in inputs if name in mass),
        "velocity_terms": "dq" in reads(motion.force),
        "explicit_time": timed or "t" in reads(motion.force),
        "energy_conserved": None if motion.constraints.on_velocities and not works else not works,
    }


def _engine_facts(problem: Problem) -> dict[str, Any]:
    """Return the fields about the engine: default solver, path, reason, and operation counts."""
    derivation, refusal = problem.derivation, choose(problem).refusal
    if problem.system.touches and MachineCode().refuses(problem) is None:  # however large: arrays do not jump
        derivation, refusal = derivation.lowered, None
    if refusal is None:
        solver, program = "Taylor series in machine code", derivation.accelerations.program
        if is_large(program, derivation.accelerations.projection):
            solver += ", whose operations stand in tables: for code operation by operation they are too many"
    else:
        solver, form = f"diffrax.Dopri8, because {refusal}", derivation.form_in_xla
        if form.kind != "scalar":
            return {"solver": solver, "path": "array", "reason": form.reason}
        program = derivation.accelerations.program.complete
    projected = derivation.accelerations.projected
    of_projection = None if projected is None else projected.operations
    costs = {"operations": program.operations, "projection_operations": of_projection}
    return {"solver": solver, "path": "scalar", "reason": "", **costs}


def _border_facts(problem: Problem, inputs: tuple[str, ...]) -> dict[str, Any]:
    """Return the fields on borders and narrow functions of the accelerations: each operation and what it reads."""
    derivation, n = problem.derivation, problem.derivation.layout.size
    try:
        borders = derivation.borders
    except Unlowerable:
        return _borders_in_lines(problem)
    if borders is None:
        return {"borders": (), "narrow": (), "borders_located": True}

    def read_by(node: int) -> str:
        return join_names([inputs[i] for i in sorted(borders.read_by(node)) if i < len(inputs)], _LISTED) or "none"

    kinds = zip(borders.switches, borders.kinds, strict=True)
    located = choose(problem).refusal is None and pieces_of(derivation.accelerations.program, Nesting(n)) is not None
    return {
        "borders": tuple(f"{_PIECES[kind]} {read_by(node)}" for node, kind in kinds if kind in _PIECES),
        "narrow": tuple(f"a function of {read_by(node)}" for node in borders.arguments),
        "borders_located": located or set(borders.kinds) <= {CLOCK},  # known times are diffrax's as well
    }


def _borders_in_lines(problem: Problem) -> dict[str, Any]:
    # Functions of this very system: its derivation may be that of another one, whose text stands in another line.
    motion = problem.system._motion(problem.layout, problem.params)
    pieces = border_places(motion.functions, *problem.derivation.state_shapes)
    names = tuple(f"{name}{place}" for name, place, size in pieces for _ in range(size))
    return {"borders": names, "borders_located": not names}


def _list_names(names: tuple[str, ...], counts: bool = True) -> str:
    """Return names as text; of more than `_GROUPED` only the first and the last, with their number if `counts`."""
    if len(names) <= _GROUPED:
        return join_names(names, _LISTED)
    return f"{f'{len(names)}: ' if counts else ''}{names[0]} … {names[-1]}"


def _count_names(names: tuple[str, ...]) -> str:
    return f"{len(names)}: {join_names(list(dict.fromkeys(names)), _LISTED)}"


def _pattern_kind(parts: Program, n: int) -> str:
    """Return "diagonal", "block-diagonal" or "dense" for a program of (n, n) entries, by which entries are not zero."""
    filled = np.array([[parts.constant(n * i + j) != 0 for j in range(n)] for i in range(n)])
    if not (filled & ~np.eye(n, dtype=bool)).any():
        return "diagonal"
    connected = np.linalg.matrix_power((filled | np.eye(n, dtype=bool)).astype(float), n) > 0
    return "dense" if connected.all() else "block-diagonal"
