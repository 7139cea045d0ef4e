"""`Accelerations`: the linear systems of a scene on scalars, and the programs of their solutions.

    M x − Gᵀλ = b,    G x = c

where b and c belong to the accelerations, or to the steps back to the constraints. M is regular (`program`) or not
necessarily (`general`), built by recursion, or possibly indefinite. Each system is written as formulas on scalars that
call the programs of a `Derivation`, and then lowered: an elimination written in `jnp` is easy to test, and its
derivatives are JAX's.
"""

import functools
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lagjax._equations import _form as forms
from lagjax._equations import _saddle
from lagjax._equations._constraints import velocity_scales
from lagjax._equations._linear import eigen, solve_many
from lagjax._equations._recursion import RecursiveElimination
from lagjax._native import Projection
from lagjax._program import StraightLine, Unlowerable, is_smooth
from lagjax._tracing import (
    Program,
    apply_function,
    concatenate,
    lower_formula,
    lower_solution,
    multiply,
    scatter,
    stack,
)

if TYPE_CHECKING:
    from lagjax._equations._derivation import Derivation

# The order of coordinates of states far away, where a force between bodies is weak: its square is then a millionth.
_FAR = 1e3

# Steps of 0.3, of numbers of order one, to parameters that make M positive definite: eight coordinates take some ten.
_MOST_CLIMBED = 60
_INDEFINITE = "its mass matrix is not positive definite and needs pivoting"


class _SaddleSystem(NamedTuple):
    """A saddle-point system M x − Gᵀλ = b, G x = `sign` c, with the names of the quantities b (None: zero) and c.

    With `velocities` G has the constraints on velocities too.
    """

    b: str | None
    c: str
    sign: int
    velocities: bool = True


_MATRICES = "mass_matrix", "jacobian"
_ACCELERATION = _SaddleSystem("force", "gamma", 1)
_VELOCITY_STEP = _SaddleSystem(None, "rates", -1)
_POSITION_STEP = _SaddleSystem(None, "residual", -1, velocities=False)


def lowered_once(make: Callable) -> property:
    """A property that is computed once; an `Unlowerable` that it raised is raised again without repeating the work."""
    name = make.__name__

    @functools.wraps(make)
    def get(self):
        if name not in self._made:
            with self._lock:
                if name not in self._made:
                    try:
                        self._made[name] = make(self)
                    except Unlowerable as reason:
                        self._made[name] = reason
        made = self._made[name]
        if isinstance(made, Unlowerable):
            raise Unlowerable(str(made)) from None
        return made

    return property(get)


class _MatrixEntries(NamedTuple):
    """The entries of a matrix that are not structurally zero, with their rows and columns, and its shape."""

    # An array of scipy.sparse, whose import takes a tenth of the first motion of a small scene, would be no shorter.
    values: np.ndarray
    places: tuple[np.ndarray, np.ndarray]
    shape: tuple[int, int]

    def toarray(self) -> np.ndarray:
        matrix = np.zeros(self.shape)
        matrix[self.places] = self.values
        return matrix

    def is_definite(self, least: float) -> bool:
        """True if all eigenvalues of this symmetric matrix are larger than `least`."""
        n = len(self.places[0]) if np.array_equal(*self.places) else -1
        if n == self.shape[0]:
            return bool(self.values.min(initial=np.inf) > least)
        try:
            np.linalg.cholesky(self.toarray() - least * np.eye(self.shape[0]))
        except np.linalg.LinAlgError:
            return False
        return True


class Accelerations:
    """The programs of a derivation that solve linear systems. Each is lowered on first use, or raises `Unlowerable`."""

    def __init__(self, derivation: "Derivation"):
        self.of, self.motion, self.layout = derivation, derivation.motion, derivation.layout
        self._made: dict[str, Any] = {}
        self._lock = threading.RLock()
        self._responses: dict[tuple[int, ...], Program] = {}
        self._sampled: dict[float, list[tuple[_MatrixEntries, _MatrixEntries]]] = {}

    @lowered_once
    def program(self) -> Program:
        """The program of q̈, then a flag: M, or its saddle point with the constraints, is singular.

        If L builds velocities by recursion, and that is shorter, they are eliminated instead of M (see `_recursion`):
        the flag is then set where that elimination fails.

        With constraints M may be singular (for some parameters) as long as the saddle point is not. To allow for that
        costs three times the arithmetic. If M is regular in general the program is therefore the regular-M variant, and
        its flag is set where that would lose digits; there `otherwise()` is the general variant. Machine code changes
        over when that happens, with the numbers of the run; XLA, which needs the program before the numbers, takes the
        one that is always valid (`Program.complete`).
        """
        mechanics = self._kick_mechanics
        if (variant := self._recursive_acceleration()) is not None:
            return replace(variant, otherwise=lambda: self.general, mechanics=mechanics)
        usual = self.motion.constrained and not self.motion.constraints.held
        if not usual or self._constant_mass or not self._is_mass_regular(_ACCELERATION):
            return self.general
        variant = self._saddle_solution(_ACCELERATION, regular_only=True)
        return replace(variant, otherwise=lambda: self.general, mechanics=mechanics)

    @lowered_once
    def general(self) -> Program:
        program, mechanics = self._saddle_solution(_ACCELERATION), self._kick_mechanics
        residual = None if self.motion.constrained or self.of.has_rules else lambda: self.of.unbalanced_force
        return replace(program, mechanics=mechanics, residual=residual)

    @lowered_once
    def _kick_mechanics(self) -> StraightLine | None:
        """The quantities that decide where L jumps (`_kick.Mechanics`), as one line; None if nothing is piecewise.

        Constraints that parameters can release, those of contacts, are left out: they push, and do not pull.
        """
        count, n = self.of.shape("rates")[0], self.layout.size
        holds = np.arange(count) if self.motion.constraints.held is None else np.flatnonzero(self.of.absent("release"))
        of = self.of.positions
        first, rates = [*of("lagrangian"), *of("momentum")], of("rates")[holds]
        if is_smooth(self.of.whole.select_outputs([*first, *rates]).line):
            return None
        rows = of("jacobian").reshape(-1, n)[holds].ravel()
        outputs = [*first, *of("mass_matrix"), *rows, *rates, *of("driving")[holds]]
        return self.of.whole.select_outputs(outputs).line

    @lowered_once
    def multipliers(self) -> Program | None:
        """The program of λ, those of `constraints` first; redundant ones are zero. None without constraints."""
        if not self.motion.constrained:
            return None
        system, solve = self._scalar_system(_ACCELERATION)

        def multipliers(*scalars):
            _, _, right, factors, _ = system(*scalars)
            return -solve(factors, right)[self.layout.size :]

        return lower_formula(multipliers, *self.of.scalar_shapes, budget=forms.OPERATION_BUDGET)

    def impact_response(self, rows: tuple[int, ...], states: int, free: "Derivation") -> Program:
        """The response to impulses at K `rows` of G: G, G M⁻¹ (K, n), G M⁻¹ Gᵀ (K, K), values, rates, G q̈ − γ (K,).

        The last `states` parameters tell which contacts are closed; G is evaluated with all of them closed. q̈ and M⁻¹
        are those of the motion with none closed, with its other constraints, which is `free`.
        """
        if rows in self._responses:
            return self._responses[rows]
        system, solve = free.accelerations._scalar_system(_VELOCITY_STEP)
        n, (m, _), (others, _) = self.layout.size, self.of.shape("jacobian"), free.shape("jacobian")
        parts, acceleration = self.of.program("jacobian", "residual", "rates", "gamma"), free.accelerations.program

        def response(*scalars):
            values = parts.vector(*scalars[: len(scalars) - states], *[0.0 * scalars[0] + 1.0] * states)
            factors, accelerations = system(*scalars)[3], acceleration.vector(*scalars)[:n]
            gradients = [values[n * i : n * (i + 1)] for i in rows]
            moved = [solve(factors, scatter(row, np.arange(n), n + others))[:n] for row in gradients]
            residuals, rates, gammas = (values[[(n + part) * m + i for i in rows]] for part in range(3))
            bends = multiply(gradients, [accelerations]) - gammas
            return concatenate([*gradients, *moved, multiply(gradients, moved), residuals, rates, bends])

        self._responses[rows] = lower_formula(response, *self.of.scalar_shapes, budget=forms.OPERATION_BUDGET)
        return self._responses[rows]

    @lowered_once
    def projected(self) -> Program | None:
        """The program of (q, q̇) after one Newton step each back to the constraints, as `Motion.projected`; or None."""
        if not self.motion.constrained:
            return None
        n = self.layout.size
        velocity = self._saddle_solution(_VELOCITY_STEP)
        position = None if self.motion.constraints.on_positions is None else self._saddle_solution(_POSITION_STEP)

        def projected(*scalars):
            q, v, rest = stack(scalars[:n]), stack(scalars[n : 2 * n]), scalars[n:]
            if position is not None:
                q = q + position.vector(*scalars)[:n]
            return concatenate([q, v + velocity.vector(*(q[i] for i in range(n)), *rest)[:n]])

        return lower_formula(projected, *self.of.scalar_shapes, budget=forms.OPERATION_BUDGET)

    @lowered_once
    def velocity_scales(self) -> Program | None:
        """The program of the `velocity_scales` of a state, (n,); None without constraints."""
        if not self.motion.constrained:
            return None
        n, (mass, rows) = self.layout.size, map(self.of.positions, _MATRICES)
        touched = np.flatnonzero(~self.of.absent("jacobian").all(axis=0))
        parts = self.of.whole.select_outputs([*mass[:: n + 1], *rows.reshape(-1, n)[:, touched].ravel()])

        def scale_arrays(values, qdot):
            return velocity_scales(values[:n], values[n:].reshape(-1, len(touched)), qdot, touched)

        def scales(*scalars):
            of_touched = apply_function(scale_arrays, parts.vector(*scalars), stack(scalars[n : 2 * n]))
            return scatter(of_touched, touched, n)

        return lower_formula(scales, *self.of.scalar_shapes, budget=forms.OPERATION_BUDGET)

    @lowered_once
    def projection(self) -> Projection | None:
        """The programs with which machine code keeps a motion on its constraints; None without any."""
        return None if self.projected is None else Projection(self.projected, self.velocity_scales)

    def _saddle_solution(self, saddle: _SaddleSystem, regular_only: bool = False) -> Program:
        """The program of x of a saddle-point system, and then a flag: it is singular."""
        system, solve = self._scalar_system(saddle, regular_only)
        return lower_solution(system, solve, self.layout.size, *self.of.scalar_shapes, budget=forms.OPERATION_BUDGET)

    @lowered_once
    def lacks(self) -> str | None:
        """The reason why accelerations have no scalar program, as the end of a sentence; None if they have one."""
        try:
            self._scalar_system(_ACCELERATION)
        except Unlowerable as why:
            return str(why)

    def _scalar_system(self, saddle: _SaddleSystem, regular_only: bool = False) -> tuple[Callable, Callable]:
        """A z = r with z = (x, −λ), as two functions of scalars: system and solution.

        The first gives the entries of A, r, the factors of A and a flag that it is singular; the second z from factors
        and r.
        """
        n, m, regular = self.layout.size, self._row_count(saddle), self._is_mass_regular(saddle)
        if regular is None and not self._mass_pivots:
            raise Unlowerable(_INDEFINITE)
        zeros = self.of.absent("mass_matrix"), self.of.absent("jacobian")[:m]
        released = self.motion.constraints.held is not None
        augmented = self.motion.constrained and not (regular_only or ((self._constant_mass or released) and regular))
        if n == 2 and not self.motion.constrained:
            elimination = _saddle.TwoCoordinates(zeros[0], self.layout.dtype)
        elif regular is None:
            elimination = _saddle.IndefiniteElimination(zeros[0], self.layout.dtype)
        else:
            elimination = _saddle.SaddleElimination(zeros, self.layout.dtype, augmented, regular_only, released)
            if released and saddle.b is not None:
                elimination = _saddle.DraggedElimination(elimination, self.of.absent("drag"))
        if elimination.operations > forms.OPERATION_BUDGET:
            raise Unlowerable(
                f"to solve for the accelerations takes some {elimination.operations} operations, more than the "
                f"{forms.OPERATION_BUDGET} that are expected to fit in memory"
            )
        parts = self._elimination_parts(saddle, elimination, m)
        count, places = len(elimination.entries), elimination.entries

        def system(*scalars):
            values = parts(*scalars)
            entries, c, b = values[:count], values[count : count + m], values[count + m :]
            factors, singular = elimination.factors(entries)
            c = c if saddle.sign > 0 else -c
            b = scatter(c[:0], np.zeros(0, int), n) if saddle.b is None else b
            return places, entries, concatenate([b, c]), factors, singular

        return system, elimination.solve

    def _recursive_acceleration(self) -> Program | None:
        """The program of q̈ by the recursion in L; None without one, or if it fails at a sampled state."""
        if self.of.recursion is None or self._is_mass_regular(_ACCELERATION) is None:
            return None
        elimination, n = RecursiveElimination(self.of.recursion, self.layout.dtype), self.layout.size
        places, count = elimination.entries, len(elimination.entries)
        positions = [*self.of.positions("recursion"), *self.of.positions("force")]
        cut = functools.cache(lambda: self.of.whole.select_outputs(positions))

        def system(*scalars):
            values = cut().vector(*scalars)
            right = scatter(values[count:], np.arange(n), n + 2 * elimination.velocities)
            return places, values[:count], right, *elimination.factors(values[:count])

        program = lower_solution(system, elimination.solve, n, *self.of.scalar_shapes, budget=forms.OPERATION_BUDGET)
        return program if self._solves_equations(program) else None

    def _solves_equations(self, program: Program) -> bool:
        """True if a program of q̈ gives the solution of M q̈ = F at the sampled states."""
        columns = self._input_columns()
        of = self.of.evaluate(["mass_matrix", "force"], columns)
        exact = solve_many(of["mass_matrix"], of["force"][:, :, None])[:, :, 0]
        *found, singular = program.evaluate_many(columns)
        usable = np.isfinite(exact).all(axis=1)
        error = np.abs(np.array(found).T - exact)[usable]
        return not singular[usable].any() and bool((error <= 1e-6 * np.abs(exact[usable]).max(initial=0)).all())

    def _elimination_parts(self, saddle: _SaddleSystem, elimination, constraints: int) -> Callable:
        """A formula of the entries of an elimination, `constraints` numbers of c, and b, concatenated."""
        n = self.layout.size
        row, column = elimination.entries.T
        names = "mass_matrix", "jacobian", "release", "drag"
        ends = np.cumsum([0, *map(self.of.count, names)])
        m = self.of.shape("jacobian")[0]
        place = np.select([column < n, row >= n], [n * row + column, ends[2] + row - n], ends[3] + m * row + column - n)
        filled = np.concatenate([end + self.of.filled[name] for end, name in zip(ends, names, strict=False)])
        outputs = np.concatenate([self.of.filled_positions(name) for name in names]).astype(int)
        at = np.searchsorted(filled, place)
        found = np.append(filled, -1)[at] == place
        given = np.where(found, np.append(outputs, 0)[at], 0), self.of.positions(saddle.c)[:constraints]
        positions = np.concatenate([*given, *([] if saddle.b is None else [self.of.positions(saddle.b)])])
        cut = functools.cache(lambda: self.of.whole.select_outputs(positions))
        return lambda *scalars: cut().vector(*scalars)

    def _row_count(self, saddle: _SaddleSystem) -> int:
        return self.of.shape("jacobian")[0] if saddle.velocities else self.of.position_count

    @lowered_once
    def _constant_mass(self) -> bool:
        return not self.of.reads("mass_matrix")

    def samples(self, reach: float = 1.0, numbers: Any = None) -> "list[tuple[_MatrixEntries, _MatrixEntries]]":
        """M and G at a few generic states where they are finite; `numbers` are parameters to use."""
        if numbers is not None:
            return self._evaluate_matrices([*self._input_columns(reach)[: 2 * self.layout.size + 1], *numbers])
        if reach not in self._sampled:
            self._sampled[reach] = self._evaluate_matrices(self._input_columns(reach))
        return self._sampled[reach]

    @functools.cached_property
    def _matrix_entries(self) -> Program:
        """The program of the entries of M and G that are not structurally zero."""
        return self.of.whole.select_outputs([k for name in _MATRICES for k in self.of.filled_positions(name)])

    def _evaluate_matrices(self, columns: list) -> "list[tuple[_MatrixEntries, _MatrixEntries]]":
        shapes, ends = [self.of.shape(name) for name in _MATRICES], [len(self.of.filled["mass_matrix"])]
        places = [np.divmod(self.of.filled[name], self.layout.size) for name in _MATRICES]
        samples = [np.split(x, ends) for x in self._matrix_entries.evaluate_many(columns).T if np.isfinite(x).all()]
        make: Any = _MatrixEntries
        return [tuple(map(make, of, places, shapes)) for of in samples]

    def _input_columns(self, reach: float = 1.0) -> list[np.ndarray]:
        """The inputs at the sampled states, one array (states,) each: of order one, q of order `reach`."""
        n, columns = self.layout.size, np.random.default_rng(0).uniform(0.3, 1.2, (3, len(self.of.scalar_shapes))).T
        return [reach * x for x in columns[:n]] + list(columns[n:])

    def _is_mass_regular(self, saddle: _SaddleSystem) -> bool | None:
        """True if M is regular at all sampled states, False if not; None if M may be indefinite.

        Elimination without pivoting requires a positive definite M. With constraints M may be singular, and is then
        augmented by GᵀG. Both choices give right answers: a wrong guess is detected by the test on the pivots. A mass
        matrix that is a series in something small, as 1/(c² r) in relativity, is positive definite where that is small:
        so a scene counts as positive definite if it is at all states near the origin, or at all far away.
        """
        for reach in (1.0, _FAR):
            if (regular := self._judge_regularity(self.samples(reach), self._row_count(saddle))) is not None:
                return regular
        samples = self.samples(1.0, self._favorable_params) if self.of.counts_on_params else None
        return None if samples is None else self._judge_regularity(samples, self._row_count(saddle))

    def _judge_regularity(self, samples: "list[tuple[_MatrixEntries, _MatrixEntries]]", m: int) -> bool | None:
        """True if M is regular at some states, else False; None if not positive definite where m rows of G vanish."""
        regular = True
        for matrix, jacobian in samples:
            size = np.abs(matrix.values).max(initial=0.0)
            if matrix.is_definite(1e-10 * size):
                continue
            regular, rows = False, jacobian.toarray()[:m]
            lowest = np.linalg.eigvalsh(matrix.toarray() + rows.T @ rows)[0]
            if (self.layout.size > 2 or m) and not lowest >= -1e-12 * size:
                return None
        return regular

    @functools.cached_property
    def depend_on_params(self) -> bool:
        """True if elimination does not pivot, and parameters decide whether M is positive definite."""
        try:
            settled = self._mass_pivots or self._is_mass_regular(_ACCELERATION) is not None
            return not settled and self._favorable_params is not None
        except Unlowerable:
            return False

    def suit(self, numbers: np.ndarray) -> bool:
        """True if M is positive definite for these parameters, at all sampled states near the origin or far away."""
        rows = self._row_count(_ACCELERATION)
        return any(self._judge_regularity(self.samples(reach, numbers), rows) is not None for reach in (1.0, _FAR))

    @property
    def _mass_pivots(self) -> bool:
        return not self.motion.constrained and self.layout.size <= _saddle.LARGEST_INDEFINITE

    @functools.cached_property
    def _favorable_params(self) -> np.ndarray | None:
        """Nonnegative parameters for which M, augmented by GᵀG, is positive definite; None if none are found.

        From sampled parameters the most negative eigenvalue of M is increased along its gradient: parameters that
        couple coordinates fall to zero.
        """
        first = 2 * self.layout.size + 1
        program, columns = self.of.program("mass_matrix", "jacobian"), [x[:1] for x in self._input_columns()]
        for _ in range(_MOST_CLIMBED):
            samples = self._evaluate_matrices(columns)
            if not samples:
                return None
            matrix, jacobian = (x.toarray() for x in samples[0])
            values, vectors = eigen(matrix + jacobian.T @ jacobian)
            if values[0] > 1e-3 * values[-1]:
                return np.concatenate(columns[first:])
            low = vectors[:, values <= 1e-3 * values[-1]]
            slopes = program.line.vjp(columns, [*(low @ low.T).ravel(), *[None] * jacobian.size])[first:]
            slopes = np.array([0.0 if x is None else x[0] for x in slopes])
            if not np.isfinite(slopes).all() or not slopes.any():
                return None
            climbed = np.concatenate(columns[first:]) + 0.3 * slopes / np.linalg.norm(slopes)
            columns[first:] = list(np.maximum(climbed, 0.0)[:, None])
        return None
