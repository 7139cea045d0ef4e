"""`Derivation`: everything that is derived from a scene, lowered to scalar programs on first use and kept.

    (system, layout, structure of params) ─► derivation_of ─► Derivation ─► programs and facts

One lowering gives all quantities of a state together: L, p, M, the forces, G, γ, … (`Motion.quantities`); a program for
some of them is cut out of that one. What is solved for (accelerations, multipliers, the steps back to the constraints)
is written down as formulas in JAX on scalars, which call these programs, and lowered once more: an elimination that is
written in `jnp` costs nothing to test, and its derivatives are JAX's.

All programs take the same inputs: q, q̇, t and then every number of params, one scalar each.
"""

import functools
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_array

from lagjax._equations import _saddle
from lagjax._equations._blame import pieces_of, pieces_of_motion
from lagjax._equations._constraints import velocity_scales
from lagjax._equations._coupled_forces import CoupledForces
from lagjax._equations._linear import eigen, is_definite, solve_many
from lagjax._equations._motion import Motion
from lagjax._equations._patterns import gradient_memory, jacobian_pattern
from lagjax._equations._quantities import OwnRules, quantities
from lagjax._equations._recursion import Recursion, RecursiveElimination
from lagjax._equations._sparse import MOST_COLORS, MatrixFree
from lagjax._equations._structure import LARGEST_LOWERED, LEAST_COORDINATES, SparseMotion, SparseStructure, structure_of
from lagjax._interface import Layout, dtype_of, is_concrete
from lagjax._native import Projection
from lagjax._primitives import DOUBLE
from lagjax._program import Borders, StraightLine, Unlowerable, borders, is_smooth, lack_of_memory, operations_that_fit
from lagjax._tracing import (
    Program,
    apply_function,
    concatenate,
    lower,
    lower_formula,
    lower_scalars,
    lower_solution,
    multiply,
    scatter,
    stack,
)

PyTree = Any

# While it is lowered, an operation takes about a kilobyte, and two where it is written anew.
OPERATION_BUDGET = operations_that_fit(2000)

# Bytes that an entry of M takes while it is derived on scalars, zero or not: 2 GB of 10 000 coordinates.
_ENTRY = 20

# Operations of all quantities beyond which JAX differentiates arrays. Derivatives of programs take 100 µs for each;
# those of arrays 2 s for what is vectorised, as 60 bodies are (39 000: 4 s), and 13 s for an arm that is written joint
# by joint (7600: 1 s). Doubled, the first kind loses 3 s more; halved, arms of 12 joints compile for half a minute.
LARGEST_DIFFERENTIATED = 30_000

# Operations of L up to which the coordinates that it reads are looked for, at 1 to 3 µs and up to 1 kB each.
_FOLLOWED = 1_500_000

# The order of coordinates of states far away, where a force between bodies is weak: its square is then a millionth.
_FAR = 1e3

# Steps of 0.3, of numbers of order one, to parameters that make M positive definite: eight coordinates take some ten.
_MOST_CLIMBED = 60
_INDEFINITE = "its mass matrix is not positive definite and needs pivoting"


class _Saddle(NamedTuple):
    """M x − Gᵀλ = b, G x = c by the names of b (None: zero) and c, the `sign` of c, whether `velocities` are in G."""

    b: str | None
    c: str
    sign: int
    velocities: bool = True


_MATRICES = "mass_matrix", "jacobian"
_ACCELERATION = _Saddle("force", "gamma", 1)
_VELOCITY_STEP = _Saddle(None, "rates", -1)
_POSITION_STEP = _Saddle(None, "residual", -1, velocities=False)


def _lowered_once(make: Callable) -> property:
    """A property that is made once; what could not be lowered raises the same `Unlowerable` again, without the work."""
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


class Derivation:
    """The derivation of a scene: its programs, and the facts that can be read off them.

    Every program is lowered on first use. Each raises `Unlowerable`, with the end of a sentence, where the scene has
    none: it is too large, or takes operations that have no scalar form.
    """

    def __init__(
        self,
        motion: Motion,
        layout: Layout,
        params: PyTree,
        refusal: str | None = None,
        unhashable: str | None = None,
        path: str = "auto",
        counts_on_params: bool = False,
    ):
        """`params` holds numbers or shapes of numbers; `refusal` says why a scene must not be lowered at all.

        `unhashable` says why this derivation cannot be kept for the next time. On the `path` "auto" a large scene with
        sparse matrices, whose functions are smooth, is not lowered: its motion is a `SparseMotion`. One that
        `counts_on_params` takes M for positive definite where some parameters make it so (`with_numbers`).
        """
        self.motion, self.layout, self.refusal, self.unhashable = motion, layout, refusal, unhashable
        self.numbers = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), params)
        is_large = layout.size >= LEAST_COORDINATES and path != "scalar"
        self.memory = gradient_memory(motion.lagrangian, self.state_shapes) if is_large else 0
        if lack := lack_of_memory(self.memory):
            raise ValueError(
                f"The gradient of this L, of {layout.size} coordinates, {lack}: sum over fewer terms (neighbours, a "
                "cut-off), or over parts of them by jax.lax.map with jax.checkpoint."
            )
        self.structure = None
        self._path, self.counts_on_params = path, counts_on_params
        self._made: dict[str, Any] = {}
        self._lock = threading.RLock()
        self._programs: dict[tuple[str, ...], Program] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._filled: dict[str, np.ndarray] = {}  # where a quantity, flat, is not zero as it is derived
        self._sampled: dict[float, list[tuple[csr_array, csr_array]]] = {}
        self._recursion: Recursion | None = None  # known once the quantities are
        self.has_rules = False  # of its own for derivatives, in a function; known once the quantities are
        # Compiled functions are traced once for each of their derivatives, and all quantities share these.
        self._traced_once: Motion = jax.tree.map(jax.jit, motion)
        self.structure = None if path == "scalar" else self._structure_of(motion, path == "array")
        if self.structure is not None:
            self._made.clear()
            self.motion = SparseMotion(*vars(motion).values(), structure=self.structure)
            self.refusal = f"it has {layout.size} coordinates, {self.structure}, and arrays suit that better"

    def _structure_of(self, motion: Motion, insists: bool) -> SparseStructure | None:
        structure = structure_of(motion, self.state_shapes, insists)
        if structure is None or insists or structure.operations > LARGEST_LOWERED:
            return structure
        if isinstance(structure.mass, MatrixFree):
            return structure if structure.mass.known or not self._is_sparse_in_scalars else None
        return None if pieces_of_motion(motion, *self.state_shapes) else structure  # steps end at borders there alone

    @property
    def _is_sparse_in_scalars(self) -> bool:
        """True if the scene has scalar programs, and a mass matrix of few entries there."""
        try:
            return bool((~self.absent("mass_matrix")).sum(axis=1).max() <= MOST_COLORS)
        except Unlowerable:
            return False

    @functools.cached_property
    def lowered(self) -> "Derivation":
        """The derivation as scalar programs of a large scene too, as far as machine code takes it."""
        if self.structure is None:
            return self
        motion = Motion(*list(vars(self.motion).values())[:4])
        refusal = None
        if self.structure.operations > LARGEST_LOWERED:
            refusal = f"{self.structure.operations} operations of L would take minutes to compile"
        return Derivation(motion, self.layout, self.numbers, refusal, self.unhashable, "scalar", self.counts_on_params)

    def with_numbers(self, numbers=None) -> "Derivation":
        """The derivation for these numbers of params; None, or traced ones, may be any.

        Where nothing pivots, and parameters decide whether M is positive definite, it counts on that, unless these are
        known and make another M.
        """
        doubted = self._counting_on_params
        if doubted is None or numbers is None or not is_concrete(numbers):
            return doubted or self
        samples, m = (self._samples(reach, np.asarray(numbers)) for reach in (1.0, _FAR)), self._rows(_ACCELERATION)
        return self if all(self._judge(of, m) is None for of in samples) else doubted

    @functools.cached_property
    def _counting_on_params(self) -> "Derivation | None":
        """The derivation that counts on a positive definite M, where this one does not and needs to."""
        try:
            settled = self._path == "array" or self._pivots or self._regular(_ACCELERATION) is not None
            if settled or self._favorable is None:
                return None
        except Unlowerable:
            return None
        return Derivation(self.motion, self.layout, self.numbers, self.refusal, self.unhashable, self._path, True)

    # ---- quantities of a state ----

    @_lowered_once
    def _whole(self) -> Program:
        """A zero, and all of `Motion.quantities` in the order of their names, without what is `zero` as it is derived.

        The matrices of large scenes are zeros but for a few numbers.
        """
        if self.refusal is not None:
            raise Unlowerable(self.refusal)
        if lack := lack_of_memory(_ENTRY * self.layout.size**2):
            raise Unlowerable(f"its mass matrix {lack}")

        def order_values(values, zero):
            self._shapes = {name: values[name].shape for name in sorted(values)}
            flat = [values[name].ravel() for name in self._shapes]
            filled = [np.arange(x.size) if zero is None else np.flatnonzero(x != zero) for x in flat]
            self._filled = dict(zip(self._shapes, filled, strict=True))
            return [x[at] for x, at in zip(flat, filled, strict=True)]

        def trace_arrays(*leaves):
            values = self._traced_once.quantities(*jax.tree.unflatten(structure, leaves))
            return [jnp.zeros(1), *order_values(values, None)]

        def trace_scalars(expansion, leaves):
            values, self._recursion = quantities(self.motion, expansion, self.state_shapes, leaves)
            zero = expansion.graph.number(0.0)
            return [np.full(1, zero), *order_values(values, zero)]

        leaves, structure = jax.tree.flatten(self.state_shapes)
        try:
            return lower_scalars(trace_scalars, tuple(leaves), OPERATION_BUDGET, 2 * self.layout.size + 1)
        except OwnRules:
            self.has_rules = True
            return lower(trace_arrays, *leaves, budget=OPERATION_BUDGET, moving=2 * self.layout.size + 1)

    def program(self, *names: str) -> Program:
        """The program for these of `Motion.quantities`, end to end, each in C order."""
        if names not in self._programs:
            positions = [k for name in names for k in self._positions(name)]
            self._programs[names] = self._whole.select_outputs(positions)
        return self._programs[names]

    @functools.cached_property
    def _starts(self) -> dict[str, int]:
        ends = np.cumsum([1, *map(len, self._filled.values())]).tolist()
        return dict(zip(self._shapes, ends, strict=False))

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of one of `Motion.quantities`."""
        self._whole  # noqa: B018  (its trace says what the shapes are)
        return self._shapes[name]

    def count(self, name: str) -> int:
        return int(np.prod(self.shape(name), dtype=int))

    def evaluate(self, names: Sequence[str], columns: Sequence) -> dict[str, np.ndarray]:
        """Named quantities at S states, each of shape (S, …), in NumPy; `columns` as `Program.evaluate_many` takes."""
        return self.split_outputs(names, self.program(*names).evaluate_many(columns).T)

    def term_sizes(self, q, qdot, t, numbers: PyTree, names: tuple[str, ...] = ("residual", "rates")):
        """The sizes of the terms of quantities at a state of numbers or tracers, (outputs,); 0 without programs."""
        # The rounding of a quantity is so many times `eps`: its running error, with inputs that are rounded, too. It is
        # 0.6 for 0.1 + q0 + 0.2 - q1 - 0.3 at q = 0, where the value, 0 or 6e-17, says nothing.
        state = [q, qdot, t, *jax.tree.leaves(numbers)]
        try:
            program = self._rounding_of(names, self.program(*names).size)
        except Unlowerable:
            return 0.0
        if all(map(is_concrete, state)):
            return program.evaluate_many(np.concatenate([np.ravel(x) for x in state]))[:, 0]
        first, *others = map(jnp.ravel, jax.lax.stop_gradient([jnp.concatenate([q, qdot, t[None]]), *state[3:]]))
        return jnp.stack(program.compute_outputs(first, jnp.concatenate(others) if others else ()))

    def round_off(self, names: Sequence[str], columns: Sequence) -> dict[str, np.ndarray]:
        """The rounding errors of these quantities at S states that are exact, each of shape (S, …)."""
        sizes = self._rounding_of(tuple(names), 0).evaluate_many(columns)
        return self.split_outputs(names, np.finfo(sizes.dtype).eps * sizes.T)

    def _rounding_of(self, names: tuple[str, ...], moving: int) -> Program:
        key = "rounding", str(moving), *names
        if key not in self._programs:
            program = self.program(*names)
            self._programs[key] = program.rounding_of(range(len(program.line.outputs)), moving)
        return self._programs[key]

    def split_outputs(self, names: Sequence[str], outputs) -> dict[str, Any]:
        """Named quantities (…, *shape) from the outputs (…, outputs) of their `program`, of NumPy or JAX."""
        ends = np.cumsum([0, *map(self.count, names)])
        parts = {name: outputs[..., ends[k] : ends[k + 1]] for k, name in enumerate(names)}
        return {name: x.reshape(*x.shape[:-1], *self.shape(name)) for name, x in parts.items()}

    def momenta_by_q(self, momenta: tuple[int, ...]) -> Program:
        """∂pᵢ/∂q for the coordinates i in `momenta`, shape (len(momenta), n)."""
        key = "momenta_by_q", *map(str, momenta)
        if key not in self._programs:
            chosen = jax.jacrev(lambda *state: self._traced_once.momentum(*state)[jnp.asarray(momenta, int)])
            moving = 2 * self.layout.size + 1
            self._programs[key] = lower(chosen, *self.state_shapes, budget=OPERATION_BUDGET, moving=moving)
        return self._programs[key]

    # ---- what is solved for ----

    @_lowered_once
    def acceleration(self) -> Program:
        """q̈, then whether M, or its saddle point with the constraints, is singular.

        Where L builds velocities by recursion, and that is shorter, they are eliminated, not M (see `_recursion`): the
        last output tells where that does not hold.

        With constraints M may be singular (a parameter may make it so) as long as the saddle point is not. To allow for
        that costs three times the arithmetic. Where M is regular in general the program is therefore the regular-M
        variant, and its last output tells where that would cost digits; there `otherwise()` is the general variant.
        Machine code changes over where that comes about, with the numbers of the run at hand; XLA, which has to write
        the program down before it knows them, takes the one that always holds (`Program.complete`).
        """
        mechanics = self._mechanics
        if (variant := self._recursive_acceleration()) is not None:
            return replace(variant, otherwise=lambda: self._general_acceleration, mechanics=mechanics)
        usual = self.motion.constrained and not self.motion.constraints.held
        if not usual or self._constant_mass or not self._regular(_ACCELERATION):
            return self._general_acceleration
        variant = self._solution(_ACCELERATION, regular_only=True)
        return replace(variant, otherwise=lambda: self._general_acceleration, mechanics=mechanics)

    @_lowered_once
    def _general_acceleration(self) -> Program:
        program, mechanics = self._solution(_ACCELERATION), self._mechanics
        return program if mechanics is None else replace(program, mechanics=mechanics)

    @_lowered_once
    def _mechanics(self) -> StraightLine | None:
        """The quantities that decide where L jumps (`_kick.Mechanics`), as one line; None if nothing is piecewise.

        Constraints that numbers release, those of contacts, are left out: they push, and do not pull.
        """
        count, n = self.shape("rates")[0], self.layout.size
        holds = np.arange(count) if self.motion.constraints.held is None else np.flatnonzero(self.absent("release"))
        of = self._positions
        first, rates = [*of("lagrangian"), *of("momentum")], of("rates")[holds]
        if is_smooth(self._whole.select_outputs([*first, *rates]).line):
            return None
        rows = of("jacobian").reshape(-1, n)[holds].ravel()
        outputs = [*first, *of("mass_matrix"), *rows, *rates, *of("driving")[holds]]
        return self._whole.select_outputs(outputs).line

    @_lowered_once
    def multipliers(self) -> Program | None:
        """λ, those of `constraints` first; redundant ones are zero. None without constraints."""
        if not self.motion.constrained:
            return None
        system, solve = self._system(_ACCELERATION)

        def multipliers(*scalars):
            _, _, right, factors, _ = system(*scalars)
            return -solve(factors, right)[self.layout.size :]

        return lower_formula(multipliers, *self.scalar_shapes, budget=OPERATION_BUDGET)

    def impact_response(self, rows: tuple[int, ...], states: int, free: "Derivation") -> Program:
        """The response to impulses at K `rows` of G: G, G M⁻¹ (K, n), G M⁻¹ Gᵀ (K, K), values, rates, G q̈ − γ (K,).

        The last `states` parameters say what is held, and G is that where everything is. The motion where nothing is,
        with q̈ and M⁻¹, which leaves the other constraints as they are, is that of `free`.
        """
        key = "impact_response", *map(str, rows)
        if key in self._programs:
            return self._programs[key]
        system, solve = free._system(_VELOCITY_STEP)
        n, (m, _), (others, _) = self.layout.size, self.shape("jacobian"), free.shape("jacobian")
        parts, acceleration = self.program("jacobian", "residual", "rates", "gamma"), free.acceleration

        def response(*scalars):
            values = parts.vector(*scalars[: len(scalars) - states], *[0.0 * scalars[0] + 1.0] * states)
            factors, accelerations = system(*scalars)[3], acceleration.vector(*scalars)[:n]
            gradients = [values[n * i : n * (i + 1)] for i in rows]
            moved = [solve(factors, scatter(row, np.arange(n), n + others))[:n] for row in gradients]
            residuals, rates, gammas = (values[[(n + part) * m + i for i in rows]] for part in range(3))
            bends = multiply(gradients, [accelerations]) - gammas
            return concatenate([*gradients, *moved, multiply(gradients, moved), residuals, rates, bends])

        self._programs[key] = lower_formula(response, *self.scalar_shapes, budget=OPERATION_BUDGET)
        return self._programs[key]

    @_lowered_once
    def projected(self) -> Program | None:
        """(q, q̇) after one Newton step of each kind back to the constraints, as `Motion.projected`; or None."""
        if not self.motion.constrained:
            return None
        n = self.layout.size
        velocity = self._solution(_VELOCITY_STEP)
        position = None if self.motion.constraints.on_positions is None else self._solution(_POSITION_STEP)

        def projected(*scalars):
            q, v, rest = stack(scalars[:n]), stack(scalars[n : 2 * n]), scalars[n:]
            if position is not None:
                q = q + position.vector(*scalars)[:n]
            return concatenate([q, v + velocity.vector(*(q[i] for i in range(n)), *rest)[:n]])

        return lower_formula(projected, *self.scalar_shapes, budget=OPERATION_BUDGET)

    @_lowered_once
    def velocity_scales(self) -> Program | None:
        """The `velocity_scales` of a state, (n,); None without constraints."""
        if not self.motion.constrained:
            return None
        n, (mass, rows) = self.layout.size, map(self._positions, _MATRICES)
        touched = np.flatnonzero(~self.absent("jacobian").all(axis=0))
        parts = self._whole.select_outputs([*mass[:: n + 1], *rows.reshape(-1, n)[:, touched].ravel()])

        def scale_arrays(values, qdot):
            return velocity_scales(values[:n], values[n:].reshape(-1, len(touched)), qdot, touched)

        def scales(*scalars):
            of_touched = apply_function(scale_arrays, parts.vector(*scalars), stack(scalars[n : 2 * n]))
            return scatter(of_touched, touched, n)

        return lower_formula(scales, *self.scalar_shapes, budget=OPERATION_BUDGET)

    @_lowered_once
    def projection(self) -> Projection | None:
        """The programs by which machine code keeps a motion on its constraints; None without any."""
        return None if self.projected is None else Projection(self.projected, self.velocity_scales)

    # ---- facts ----

    def reads(self, name: str) -> frozenset[int]:
        """The positions of the inputs that any number of this quantity depends on."""
        return self._whole.find_inputs(self._filled_positions(name))

    def absent(self, name: str) -> np.ndarray:
        """True for each number of this quantity that is zero whatever the state, in its shape."""
        absent, line = np.ones(self.count(name), bool), self._whole.line
        of = (line.nodes[line.outputs[k]] for k in self._filled_positions(name))
        absent[self._filled[name]] = [op == "constant" and number == 0 for op, _, number in of]
        return absent.reshape(self.shape(name))

    def _positions(self, name: str) -> np.ndarray:
        """The outputs of the program of all quantities that are this one, in C order."""
        positions = np.zeros(self.count(name), int)
        positions[self._filled[name]] = self._filled_positions(name)
        return positions

    def _filled_positions(self, name: str) -> range:
        """The outputs that are numbers of this quantity which are not zero as they are derived."""
        self._whole  # noqa: B018  (its trace says where quantities start)
        return range(self._starts[name], self._starts[name] + len(self._filled[name]))

    @_lowered_once
    def works(self) -> bool:
        """True if anything does work: an explicit time, a force, a constraint that drives the motion."""
        return not all(self.absent(name).all() for name in ("lagrangian_by_t", "nonconservative_force", "driving"))

    @_lowered_once
    def conserved(self) -> tuple[int, ...]:
        """The coordinates whose momenta are constant: neither L, nor a force, nor a constraint acts on them."""
        untouched = self.absent("generalized_force") & self.absent("jacobian").all(axis=0)
        return tuple(np.flatnonzero(untouched).tolist())

    @functools.cached_property
    def cyclic(self) -> tuple[int, ...] | None:
        """The coordinates that no operation of L reads, of a scene on arrays; None where a look takes long."""
        if self.structure is not None and self.structure.operations > _FOLLOWED:
            return None
        pattern = jacobian_pattern(lambda *state: jnp.ravel(self.motion.lagrangian(*state)), self.state_shapes, by=0)
        return None if pattern is None else tuple(np.flatnonzero(pattern.sum(axis=0) == 0).tolist())

    @_lowered_once
    def borders(self) -> Borders | None:
        """The decisions of the accelerations along a motion, and their narrow features; None where there are none."""
        return borders(self.acceleration, self.layout.size)

    @functools.cached_property
    def kicks(self) -> bool:
        """True if velocities jump at borders of the motion, as L or a speed that a constraint prescribes does."""
        if not self.motion.constrained and not pieces_of([self.motion.lagrangian], *self.state_shapes):
            return False  # most scenes, and the largest ones, at no cost
        try:
            return self.borders is not None and bool(self.borders.kicking)
        except Unlowerable:
            return False

    @property
    def kick_refusal(self) -> str | None:
        """Why velocities behind a border are not known, as the end of a sentence; None where they are."""
        if self.kicks and isinstance(self.motion.forces, CoupledForces):
            return "L jumps at a border, and no law gives the impulse of a force that reads multipliers"
        if not self.kicks or (borders := self.borders) is None or borders.kick is None or not borders.kick.refused:
            return None
        piece, reason = borders.kick.refused[0]
        n, read = self.layout.size, borders.read_by(borders.switches[piece])
        inputs = (*self.layout.names, *(f"d{name}/dt" for name in self.layout.names), "t")
        of = ", ".join(inputs[i] for i in sorted(read) if i < 2 * n + 1)
        return (
            f"{reason}, at a border of {of}: round it off over a width w that the motion resolves, "
            "0.5 * (1 + jnp.tanh(x / w)) for x > 0, or take samples(..., hold='cubic') where it is sampled"
        )

    @property
    def differentiates(self) -> bool:
        """True if derivatives are those of programs: no function has rules of its own or looks up a table, and the
        programs are not large."""
        try:
            usual = not (self._whole.looks_up or self.has_rules)
            return usual and self.layout.dtype == DOUBLE and self._whole.operations <= LARGEST_DIFFERENTIATED
        except Unlowerable:
            return False

    @property
    def traced_operations(self) -> int:
        """The scalar operations of all quantities as derived, before reduction."""
        return self._whole.traced_operations

    # ---- inputs ----

    @property
    def state_shapes(self) -> tuple:
        """Shapes of (q, q̇, t, params), as the functions of the motion take them."""
        q, t = jax.ShapeDtypeStruct((self.layout.size,), self.layout.dtype), jax.ShapeDtypeStruct((), self.layout.dtype)
        return q, q, t, self.numbers

    @functools.cached_property
    def scalar_shapes(self) -> list[jax.ShapeDtypeStruct]:
        """The shapes of the inputs of every program: q, q̇, t and every number in params, one by one."""
        leaves = jax.tree.leaves(self.numbers)
        numbers = [dtype for leaf in leaves for dtype in [leaf.dtype] * leaf.size]
        dtypes = [self.layout.dtype] * (2 * self.layout.size + 1) + numbers
        of = {dtype: jax.ShapeDtypeStruct((), dtype) for dtype in set(dtypes)}  # one for all: there may be many
        return [of[dtype] for dtype in dtypes]

    # ---- linear systems ----

    def _solution(self, saddle: _Saddle, regular_only: bool = False) -> Program:
        """x of a linear system, and then whether it is singular."""
        system, solve = self._system(saddle, regular_only)
        return lower_solution(system, solve, self.layout.size, *self.scalar_shapes, budget=OPERATION_BUDGET)

    @_lowered_once
    def lacks_elimination(self) -> str | None:
        """Why its accelerations are not solved for on scalars, as the end of a sentence; None where they are."""
        try:
            self._system(_ACCELERATION)
        except Unlowerable as why:
            return str(why)

    def _system(self, saddle: _Saddle, regular_only: bool = False) -> tuple[Callable, Callable]:
        """A z = r with z = (x, −λ), as two functions of scalars.

        The first gives the entries of A, r, factors of A and whether it is singular; the second z, of factors and r.
        """
        n, m, regular = self.layout.size, self._rows(saddle), self._regular(saddle)
        if regular is None and not self._pivots:
            raise Unlowerable(_INDEFINITE)
        zeros = self.absent("mass_matrix"), self.absent("jacobian")[:m]
        released = self.motion.constraints.held is not None
        augmented = self.motion.constrained and not (regular_only or ((self._constant_mass or released) and regular))
        if n == 2 and not self.motion.constrained:
            elimination = _saddle.TwoCoordinates(zeros[0], self.layout.dtype)
        elif regular is None:
            elimination = _saddle.IndefiniteElimination(zeros[0], self.layout.dtype)
        else:
            elimination = _saddle.SaddleElimination(zeros, self.layout.dtype, augmented, regular_only, released)
            if released and saddle.b is not None:
                elimination = _saddle.DraggedElimination(elimination, self.absent("drag"))
        if elimination.operations > OPERATION_BUDGET:
            raise Unlowerable(
                f"to solve for the accelerations takes some {elimination.operations} operations, more than the "
                f"{OPERATION_BUDGET} that are expected to fit in memory"
            )
        parts = self._parts(saddle, elimination, m)
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
        """q̈ by the recursion in L; None where there is none, or where it does not hold at a sampled state."""
        self._whole  # noqa: B018  (its trace finds the recursion)
        if self._recursion is None or self._regular(_ACCELERATION) is None:
            return None
        elimination, n = RecursiveElimination(self._recursion, self.layout.dtype), self.layout.size
        places, count = elimination.entries, len(elimination.entries)
        positions = [*self._positions("recursion"), *self._positions("force")]
        cut = functools.cache(lambda: self._whole.select_outputs(positions))

        def system(*scalars):
            values = cut().vector(*scalars)
            right = scatter(values[count:], np.arange(n), n + 2 * elimination.velocities)
            return places, values[:count], right, *elimination.factors(values[:count])

        program = lower_solution(system, elimination.solve, n, *self.scalar_shapes, budget=OPERATION_BUDGET)
        return program if self._agrees(program) else None

    def _agrees(self, program: Program) -> bool:
        """True if a program for q̈ gives that of M q̈ = F at the sampled states."""
        columns = self._columns()
        of = self.evaluate(["mass_matrix", "force"], columns)
        exact = solve_many(of["mass_matrix"], of["force"][:, :, None])[:, :, 0]
        *found, singular = program.evaluate_many(columns)
        usable = np.isfinite(exact).all(axis=1)
        error = np.abs(np.array(found).T - exact)[usable]
        return not singular[usable].any() and bool((error <= 1e-6 * np.abs(exact[usable]).max(initial=0)).all())

    def _parts(self, saddle: _Saddle, elimination, constraints: int) -> Callable:
        """A formula for the entries of an elimination, the `constraints` numbers of c, and b, end to end."""
        n = self.layout.size
        row, column = elimination.entries.T
        names = "mass_matrix", "jacobian", "release", "drag"
        ends = np.cumsum([0, *map(self.count, names)])
        m = self.shape("jacobian")[0]
        place = np.select([column < n, row >= n], [n * row + column, ends[2] + row - n], ends[3] + m * row + column - n)
        filled = np.concatenate([end + self._filled[name] for end, name in zip(ends, names, strict=False)])
        outputs = np.concatenate([self._filled_positions(name) for name in names]).astype(int)
        at = np.searchsorted(filled, place)
        found = np.append(filled, -1)[at] == place
        given = np.where(found, np.append(outputs, 0)[at], 0), self._positions(saddle.c)[:constraints]
        positions = np.concatenate([*given, *([] if saddle.b is None else [self._positions(saddle.b)])])
        cut = functools.cache(lambda: self._whole.select_outputs(positions))
        return lambda *scalars: cut().vector(*scalars)

    def _rows(self, saddle: _Saddle) -> int:
        return self.shape("jacobian")[0] if saddle.velocities else self.position_count

    @functools.cached_property
    def position_count(self) -> int:
        q, _, t, numbers = self.state_shapes
        return jax.eval_shape(self._traced_once.constraints.f, q, t, numbers).size

    @_lowered_once
    def _constant_mass(self) -> bool:
        return not self.reads("mass_matrix")

    @property
    def samples(self) -> list[tuple[csr_array, csr_array]]:
        """M and G at a few states that nothing speaks for, where they are finite."""
        return self._samples(1.0)

    def _samples(self, reach: float, numbers: Any = None) -> list[tuple[csr_array, csr_array]]:
        """M and G at a few states that nothing speaks for, where they are finite; `numbers` are those of params."""
        if numbers is not None:
            return self._evaluate_matrices([*self._columns(reach)[: 2 * self.layout.size + 1], *numbers])
        if reach not in self._sampled:
            self._sampled[reach] = self._evaluate_matrices(self._columns(reach))
        return self._sampled[reach]

    @functools.cached_property
    def _entries(self) -> Program:
        """The numbers of M and G that are not zero as they are derived."""
        return self._whole.select_outputs([k for name in _MATRICES for k in self._filled_positions(name)])

    def _evaluate_matrices(self, columns: list) -> list[tuple[csr_array, csr_array]]:
        shapes, ends = [self.shape(name) for name in _MATRICES], [len(self._filled["mass_matrix"])]
        places = [np.divmod(self._filled[name], self.layout.size) for name in _MATRICES]
        samples = [np.split(x, ends) for x in self._entries.evaluate_many(columns).T if np.isfinite(x).all()]
        make: Any = lambda *matrix: csr_array(matrix[:2], shape=matrix[2])  # noqa: E731
        return [tuple(map(make, of, places, shapes)) for of in samples]

    def _columns(self, reach: float = 1.0) -> list[np.ndarray]:
        """The inputs at these states, one array (states,) for each: of order one, but q of this order."""
        n, columns = self.layout.size, np.random.default_rng(0).uniform(0.3, 1.2, (3, len(self.scalar_shapes))).T
        return [reach * x for x in columns[:n]] + list(columns[n:])

    def _regular(self, saddle: _Saddle) -> bool | None:
        """True if M is regular in general: at all of the sampled states; None where it need not be positive definite.

        Elimination without pivoting is for positive definite M. With constraints M may be singular, and is then
        augmented by GᵀG. The choice is between right answers: a wrong guess is caught by the test on the pivots. A mass
        matrix that is a series in something small, as 1/(c² r) in relativity, is positive definite where that is small:
        a scene counts as positive definite that is so at all states near, or at all far away.
        """
        for reach in (1.0, _FAR):
            if (regular := self._judge(self._samples(reach), self._rows(saddle))) is not None:
                return regular
        return self._judge(self._samples(1.0, self._favorable), self._rows(saddle)) if self.counts_on_params else None

    def _judge(self, samples: list[tuple[csr_array, csr_array]], m: int) -> bool | None:
        """True if M is regular at some states; None where it is not positive definite, on m rows of G at rest."""
        regular = True
        for matrix, jacobian in samples:
            size = abs(matrix).max()
            if is_definite(matrix, 1e-10 * size):
                continue
            regular, rows = False, jacobian[:m]
            lowest = np.linalg.eigvalsh((matrix + rows.T @ rows).toarray())[0]
            if (self.layout.size > 2 or m) and not lowest >= -1e-12 * size:
                return None
        return regular

    @property
    def _pivots(self) -> bool:
        return not self.motion.constrained and self.layout.size <= _saddle.LARGEST_INDEFINITE

    @functools.cached_property
    def _favorable(self) -> np.ndarray | None:
        """Numbers of params, none negative, that make M, with GᵀG, positive definite; None where none are found.

        From those of the samples it is climbed along the slopes of what is negative in M: couplings, which are numbers
        of their own, fall to zero.
        """
        first = 2 * self.layout.size + 1
        program, columns = self.program("mass_matrix", "jacobian"), [x[:1] for x in self._columns()]
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


def columns_of(q, qdot, t, numbers: Sequence) -> list:
    """The inputs of a program at S states: `q`, `qdot` (S, n), `t` () or (S,), and `numbers` each () or (S,)."""
    return [*np.asarray(q).T, *np.asarray(qdot).T, np.asarray(t), *numbers]


def numbers_of(params: PyTree) -> list:
    return [x for leaf in jax.tree.leaves(params) for x in np.ravel(np.asarray(leaf))]


# ---- made once ---------------------------------------------------------------------------------------------------


class _Number(NamedTuple):
    """The key of a number, or of an array of them, among the parameters."""

    shape: tuple[int, ...]
    dtype: np.dtype


class _Structure(NamedTuple):
    """All that decides how a scene is derived, structure alone; a leaf of params is a `_Number`, or program."""

    system: Any
    layout: Layout
    params: Any
    leaves: tuple

    @property
    def restored(self) -> tuple[Any, Layout, PyTree]:
        """The scene, the layout, and the parameters with zeros for numbers."""
        leaves = [np.zeros(*leaf) if isinstance(leaf, _Number) else leaf for leaf in self.leaves]
        return jax.tree.unflatten(self.system, []), self.layout, jax.tree.unflatten(self.params, leaves)


def derivation_of(system: Any, layout: Layout, params: PyTree) -> Derivation:
    """The derivation of a scene with parameters of this structure, whatever their values.

    It is made once for scenes, layouts and structures that are equal. Scenes whose functions hold arrays of their own
    have no programs, as these arrays could change; those whose code cannot be hashed are derived anew each time.
    """
    key = _structure_key(system, layout, params)
    if key is None:
        numbers = eqx.filter(params, eqx.is_array_like)
        reason = "the functions of the scene hold arrays of their own"
        return Derivation(system._motion(layout, params), layout, numbers, reason, path=system.path)
    try:
        hash(key)
    except TypeError as reason:
        return _derived(key, str(reason))
    return _derived_once(key)


def once_for_structure(make: Callable) -> Callable:
    """`make(system, layout, params)`, which depends on no values, called once for all that `derivation_of` does so."""
    make_once = functools.lru_cache(maxsize=64)(lambda key: make(*key.restored))

    @functools.wraps(make)
    def find(system: Any, layout: Layout, params: PyTree):
        key = _structure_key(system, layout, params)
        try:
            hash(key)
        except TypeError:
            key = None
        return make(system, layout, params) if key is None else make_once(key)

    return find


def _structure_key(system: Any, layout: Layout, params: PyTree) -> _Structure | None:
    """All that decides how a scene is derived; None where its functions hold arrays."""
    arrays, scene = jax.tree.flatten(system)
    leaves, tree = jax.tree.flatten(params)
    kept = (
        _Number(np.shape(x), np.dtype(dtype_of(x))) if type(x) is np.ndarray or eqx.is_array_like(x) else x
        for x in leaves
    )
    return None if arrays else _Structure(scene, layout, tree, tuple(kept))


def _derived(key: _Structure, unhashable: str | None = None) -> Derivation:
    system, layout, params = key.restored
    numbers = eqx.filter(params, eqx.is_array_like)
    return Derivation(system._motion(layout, params), layout, numbers, unhashable=unhashable, path=system.path)


_derived_once = functools.lru_cache(maxsize=64)(_derived)
