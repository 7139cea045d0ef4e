"""`Derivation`: everything that is derived from a scene, lowered to scalar programs on first use and kept.

    (system, layout, structure of params) ─► derivation_of ─► Derivation ─► programs and facts

One lowering gives all quantities of a state together: L, p, M, the forces, G, γ, … (`Motion.quantities`); a program for
some of them is cut out of that one. Solutions of linear systems (accelerations, multipliers, the steps back to the
constraints) are lowered separately, from formulas that call these programs (`Accelerations`).

All programs take the same inputs: q, q̇, t and then every number of params, one scalar each.
"""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._equations import _form as forms
from lagjax._equations._accelerations import Accelerations, lowered_once
from lagjax._equations._blame import list_decisions
from lagjax._equations._coupled_forces import CoupledForces
from lagjax._equations._form import SCALAR, Form, derived_form, form_in_xla
from lagjax._equations._motion import Motion
from lagjax._equations._patterns import count_equations, gradient_memory, jacobian_pattern
from lagjax._equations._quantities import OwnRules, quantities, unbalanced_force
from lagjax._equations._recursion import Recursion
from lagjax._equations._sparse import MOST_COLORS
from lagjax._equations._structure import SparseMotion
from lagjax._interface import Layout, dtype_of, is_concrete
from lagjax._primitives import DOUBLE
from lagjax._program import Borders, Unlowerable, borders, lack_of_memory
from lagjax._tracing import Program, lower, lower_scalars


class Derivation:
    """The derivation of a scene: its scalar programs, and properties of the scene that they determine.

    Every program is lowered on first use. Each raises `Unlowerable`, with the end of a sentence, if the scene has none:
    it is too large, or uses operations without a scalar form.
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
        """`params` has numbers or shapes of numbers; `refusal` is a reason not to lower the scene at all.

        `unhashable` is the reason why this derivation cannot be cached. On the `path` "auto" a large scene with sparse
        matrices, whose functions are smooth, is not lowered: its motion is a `SparseMotion`. With `counts_on_params` M
        is taken to be positive definite if it is so for some parameters (`with_numbers`).
        """
        self.motion, self.layout, self.unhashable = motion, layout, unhashable
        self.numbers = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), params)
        is_large = layout.size >= forms.LEAST_COORDINATES and path != "scalar"
        self.memory = gradient_memory(motion.lagrangian, self.state_shapes) if is_large else 0
        if lack := lack_of_memory(self.memory):
            raise ValueError(
                f"The gradient of this L, of {layout.size} coordinates, {lack}: sum over fewer terms (neighbours, a "
                "cut-off), or over parts of them by jax.lax.map with jax.checkpoint."
            )
        self.path, self.counts_on_params = path, counts_on_params
        self._made: dict[str, Any] = {}
        self._lock = threading.RLock()
        self._programs: dict[tuple[str, ...], Program] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self.filled: dict[str, np.ndarray] = {}  # where a quantity, flat, is not zero as it is derived
        self._recursion: Recursion | None = None  # known once the quantities are
        self.has_rules = False  # of its own for derivatives, in a function; known once the quantities are
        # Compiled functions are traced once for each of their derivatives, and all quantities share these.
        self._traced_once: Motion = jax.tree.map(jax.jit, motion)
        self.form = SCALAR if refusal is None else Form("arrays", refusal)
        form = derived_form(motion, self.state_shapes, path, self._is_sparse_in_scalars)
        if form.structure is not None:
            self._made.clear()
            self.form, self.motion = form, SparseMotion(*vars(motion).values(), structure=form.structure)

    def _is_sparse_in_scalars(self) -> bool:
        """True if the scene has scalar programs in which the rows of the mass matrix have few entries."""
        try:
            return bool((~self.absent("mass_matrix")).sum(axis=1).max() <= MOST_COLORS)
        except Unlowerable:
            return False

    @functools.cached_property
    def lowered(self) -> "Derivation":
        """This derivation on scalars: itself, or for a large sparse scene a new one, up to `LARGEST_LOWERED`."""
        if not self.form.is_sparse:
            return self
        motion = Motion(*list(vars(self.motion).values())[:4])
        refusal = None
        if self.form.operations > forms.LARGEST_LOWERED:
            refusal = f"{self.form.operations} operations of L would take minutes to compile"
        return Derivation(motion, self.layout, self.numbers, refusal, self.unhashable, "scalar", self.counts_on_params)

    def with_numbers(self, numbers=None) -> "Derivation":
        """The derivation to use with these parameters; None and traced numbers are unknown.

        If elimination does not pivot and parameters decide whether M is positive definite, it is one that assumes so,
        unless known numbers contradict it.
        """
        doubted = self._assuming_definite_mass
        known = doubted is not None and numbers is not None and is_concrete(numbers)
        return self if doubted is None or (known and not self.accelerations.suit(np.asarray(numbers))) else doubted

    @functools.cached_property
    def _assuming_definite_mass(self) -> "Derivation | None":
        """The derivation that assumes a positive definite M, if this one does not and needs to; else None."""
        if self.path == "array" or not self.accelerations.depend_on_params:
            return None
        return Derivation(self.motion, self.layout, self.numbers, self.form.reason, self.unhashable, self.path, True)

    @functools.cached_property
    def accelerations(self) -> Accelerations:
        """The programs that solve linear systems."""
        return Accelerations(self)

    @functools.cached_property
    def form_in_xla(self) -> Form:
        """The form that XLA compiles; `ValueError` if the path "scalar" is impossible."""
        return form_in_xla(self)

    @property
    def is_lowered(self) -> bool:
        """True if the quantities of a state have scalar programs."""
        try:
            return bool(self.whole.shapes)
        except Unlowerable:
            return False

    # ---- quantities of a state ----

    @lowered_once
    def whole(self) -> Program:
        """The program of a zero, then all of `Motion.quantities` in the order of their names, without structural zeros.

        The matrices of large scenes have few entries.
        """
        if self.form.reason is not None:
            raise Unlowerable(self.form.reason)
        if lack := lack_of_memory(forms.BYTES_OF_ENTRY * self.layout.size**2):
            raise Unlowerable(f"its mass matrix {lack}")

        def order_values(values, zero):
            self._shapes = {name: values[name].shape for name in sorted(values)}
            flat = [values[name].ravel() for name in self._shapes]
            filled = [np.arange(x.size) if zero is None else np.flatnonzero(x != zero) for x in flat]
            self.filled = dict(zip(self._shapes, filled, strict=True))
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
            return lower_scalars(trace_scalars, tuple(leaves), forms.OPERATION_BUDGET, 2 * self.layout.size + 1)
        except OwnRules:
            self.has_rules = True
            return lower(trace_arrays, *leaves, budget=forms.OPERATION_BUDGET, moving=2 * self.layout.size + 1)

    @functools.cached_property
    def terms(self) -> Program | None:
        """The program of L (), Q (n,) and the constraints (m,), without the n² entries of M; None on arrays."""
        f, g, h = self.motion.lagrangian, self.motion.nonconservative_force, self.motion.constraints.residual
        moving, budget = 2 * self.layout.size + 1, forms.OPERATION_BUDGET if self.form.reason is None else 0
        try:
            return lower(lambda *x: (f(*x), g(*x), h(*x)), *self.state_shapes, budget=budget, moving=moving)
        except Unlowerable:
            return None

    @lowered_once
    def unbalanced_force(self) -> Program:
        """The program of `Motion.unbalanced_force`; its last inputs are q̈ (n,)."""
        if self.form.reason is not None or isinstance(self.motion.forces, CoupledForces):
            raise Unlowerable(self.form.reason or "forces read multipliers")
        shapes, moving = (*self.state_shapes, self.state_shapes[0]), 2 * self.layout.size + 1
        leaves, _ = jax.tree.flatten(shapes)

        def trace_scalars(expansion, leaves):
            return [unbalanced_force(self.motion, expansion, shapes[:-1], leaves[:-1], expansion.real(leaves[-1]))]

        try:
            return lower_scalars(trace_scalars, tuple(leaves), forms.OPERATION_BUDGET, moving)
        except OwnRules:
            raise Unlowerable("a function has rules of its own for its derivatives") from None

    @property
    def recursion(self) -> Recursion | None:
        """The recursion by which L builds velocities, if that takes fewer operations; else None."""
        self.whole  # noqa: B018  (its trace finds it)
        return self._recursion

    def program(self, *names: str) -> Program:
        """The program of the named ones of `Motion.quantities`, concatenated, each in C order."""
        if names not in self._programs:
            positions = [k for name in names for k in self.positions(name)]
            self._programs[names] = self.whole.select_outputs(positions)
        return self._programs[names]

    @functools.cached_property
    def _output_starts(self) -> dict[str, int]:
        ends = np.cumsum([1, *map(len, self.filled.values())]).tolist()
        return dict(zip(self._shapes, ends, strict=False))

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of the named one of `Motion.quantities`."""
        self.whole  # noqa: B018  (its trace says what the shapes are)
        return self._shapes[name]

    def count(self, name: str) -> int:
        return int(np.prod(self.shape(name), dtype=int))

    def evaluate(self, names: Sequence[str], columns: Sequence) -> dict[str, np.ndarray]:
        """Named quantities at S states, each (S, …), in NumPy; `columns` as in `Program.evaluate_many`."""
        return self.split_outputs(names, self.program(*names).evaluate_many(columns).T)

    def term_sizes(self, q, qdot, t, numbers: PyTree, names: tuple[str, ...] = ("residual", "rates")):
        """The sizes of the terms of quantities at a state of numbers or tracers, (outputs,); 0 without programs."""
        # The rounding of a quantity, in units of `eps`: its running error, with that of rounded inputs included. It is
        # 0.6 for 0.1 + q0 + 0.2 - q1 - 0.3 at q = 0, where the value, 0 or 6e-17, says nothing.
        state = [q, qdot, t, *jax.tree.leaves(numbers)]
        try:
            program = self.term_program(names)
        except Unlowerable:
            return 0.0
        if all(map(is_concrete, state)):
            return program.evaluate_many(np.concatenate([np.ravel(x) for x in state]))[:, 0]
        first, *others = map(jnp.ravel, jax.lax.stop_gradient([jnp.concatenate([q, qdot, t[None]]), *state[3:]]))
        return jnp.stack(program.compute_outputs(first, jnp.concatenate(others) if others else ()))

    def term_program(self, names: tuple[str, ...]) -> Program:
        """The program of the sizes of the terms of these quantities. Raises `Unlowerable`."""
        return self._rounding_of(names, self.program(*names).size)

    def round_off(self, names: Sequence[str], columns: Sequence) -> dict[str, np.ndarray]:
        """The rounding errors of these quantities at S exact states, each of shape (S, …)."""
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
        """The program of ∂pᵢ/∂q for the coordinates i in `momenta`, shape (len(momenta), n)."""
        key = "momenta_by_q", *map(str, momenta)
        if key not in self._programs:
            chosen = jax.jacrev(lambda *state: self._traced_once.momentum(*state)[jnp.asarray(momenta, int)])
            moving = 2 * self.layout.size + 1
            self._programs[key] = lower(chosen, *self.state_shapes, budget=forms.OPERATION_BUDGET, moving=moving)
        return self._programs[key]

    # ---- facts ----

    def reads(self, name: str) -> frozenset[int]:
        """The positions of the inputs on which any entry of this quantity depends."""
        return self.whole.find_inputs(self.filled_positions(name))

    def absent(self, name: str) -> np.ndarray:
        """A mask, in the shape of this quantity, of the entries that are structurally zero."""
        absent, line = np.ones(self.count(name), bool), self.whole.line
        of = (line.nodes[line.outputs[k]] for k in self.filled_positions(name))
        absent[self.filled[name]] = [op == "constant" and number == 0 for op, _, number in of]
        return absent.reshape(self.shape(name))

    def positions(self, name: str) -> np.ndarray:
        """The output positions, in `whole`, of the entries of this quantity in C order."""
        positions = np.zeros(self.count(name), int)
        positions[self.filled[name]] = self.filled_positions(name)
        return positions

    def filled_positions(self, name: str) -> range:
        """The output positions, in `whole`, of the entries of this quantity that are not structurally zero."""
        self.whole  # noqa: B018  (its trace says where quantities start)
        return range(self._output_starts[name], self._output_starts[name] + len(self.filled[name]))

    @lowered_once
    def works(self) -> bool:
        """True if energy is exchanged: L depends on time, or there is a force or a driving constraint."""
        return not all(self.absent(name).all() for name in ("lagrangian_by_t", "nonconservative_force", "driving"))

    @lowered_once
    def conserved(self) -> tuple[int, ...]:
        """The coordinates whose momenta are constant: no term of L, no force and no constraint acts on them."""
        untouched = self.absent("generalized_force") & self.absent("jacobian").all(axis=0)
        return tuple(np.flatnonzero(untouched).tolist())

    @functools.cached_property
    def unread(self) -> tuple[int, ...] | None:
        """The coordinates that no operation of L reads, for a scene on arrays; None if the pattern is unknown."""
        pattern = jacobian_pattern(lambda *state: jnp.ravel(self.motion.lagrangian(*state)), self.state_shapes, by=0)
        return None if pattern is None else tuple(np.flatnonzero(pattern.sum(axis=0) == 0).tolist())

    @property
    def cyclic(self) -> tuple[int, ...] | None:
        """The `unread` coordinates; None also if finding them takes long."""
        return None if self.form.operations > forms.LARGEST_FOLLOWED else self.unread

    @lowered_once
    def borders(self) -> Borders | None:
        """The borders and narrow features of the accelerations; None if they are smooth."""
        return borders(self.accelerations.program, self.layout.size)

    @functools.cached_property
    def kicks(self) -> bool:
        """True if velocities jump at borders, because L, or a speed prescribed by a constraint, jumps."""
        if not self.motion.constrained and not list_decisions([self.motion.lagrangian], *self.state_shapes):
            return False  # most scenes, and the largest ones, at no cost
        try:
            return self.borders is not None and bool(self.borders.kicking)
        except Unlowerable:
            return False

    @property
    def kick_refusal(self) -> str | None:
        """The reason why velocities behind a border are unknown, as the end of a sentence; None if they are known."""
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
        """True if JAX differentiates the programs: small ones, without custom rules or table look-ups."""
        return self._may_be_differentiated("whole")

    @property
    def differentiates_force(self) -> bool:
        """True if JAX differentiates the program of `unbalanced_force`."""
        return self._may_be_differentiated("unbalanced_force")

    def _may_be_differentiated(self, name: str) -> bool:
        try:
            program = getattr(self, name)
        except Unlowerable:
            return False
        usual = not (program.looks_up or self.has_rules)
        return usual and self.layout.dtype == DOUBLE and forms.suits_programs(self, program.operations)

    @functools.cached_property
    def equations(self) -> int:
        """The equations of JAX that L, forces, dissipation and constraints are written in."""
        functions = [jax.make_jaxpr(f)(*self.state_shapes) for f in self._traced_once.functions]
        q, _, t, numbers = self.state_shapes
        if self.motion.constrained:
            functions.append(jax.make_jaxpr(self._traced_once.constraints.f)(q, t, numbers))
        return sum(count_equations(of.jaxpr) for of in functions)

    @property
    def traced_operations(self) -> int:
        """The number of scalar operations of all quantities before simplification."""
        return self.whole.traced_operations

    # ---- inputs ----

    @property
    def state_shapes(self) -> tuple:
        """The shapes of (q, q̇, t, params), as the functions of the motion take them."""
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

    @functools.cached_property
    def position_count(self) -> int:
        q, _, t, numbers = self.state_shapes
        return jax.eval_shape(self._traced_once.constraints.f, q, t, numbers).size


def columns_of(q, qdot, t, numbers: Sequence) -> list:
    """The inputs of a program at S states: `q`, `qdot` (S, n), `t` () or (S,), and `numbers` each () or (S,)."""
    return [*np.asarray(q).T, *np.asarray(qdot).T, np.asarray(t), *numbers]


def numbers_of(params: PyTree) -> list:
    return [x for leaf in jax.tree.leaves(params) for x in np.ravel(np.asarray(leaf))]


# ---- made once ---------------------------------------------------------------------------------------------------


class _NumberKey(NamedTuple):
    """The cache key of a number or array among the parameters: its shape and dtype, not its values."""

    shape: tuple[int, ...]
    dtype: np.dtype


class _SceneStructure(NamedTuple):
    """The cache key of a scene: all of its structure, without values; a leaf of params is a `_NumberKey` or code."""

    system: Any
    layout: Layout
    params: Any
    leaves: tuple

    @property
    def restored(self) -> tuple[Any, Layout, PyTree]:
        """The scene, the layout, and the parameters with zeros for numbers."""
        leaves = [np.zeros(*leaf) if isinstance(leaf, _NumberKey) else leaf for leaf in self.leaves]
        return jax.tree.unflatten(self.system, []), self.layout, jax.tree.unflatten(self.params, leaves)


def derivation_of(system: Any, layout: Layout, params: PyTree) -> Derivation:
    """The derivation of a scene for parameters of this structure, whatever their values.

    It is made once for equal scenes, layouts and structures. Scenes whose functions hold arrays of their own have no
    programs, as these arrays could change; those whose code cannot be hashed are derived anew each time.
    """
    key = _structure_key(system, layout, params)
    if key is None:
        numbers = eqx.filter(params, eqx.is_array_like)
        reason = "the functions of the scene hold arrays of their own"
        return Derivation(system._motion(layout, params), layout, numbers, reason, path=system.path)
    try:
        hash(key)
    except TypeError as reason:
        return _derive_structure(key, str(reason))
    return _derived_once(key)


def once_for_structure(make: Callable) -> Callable:
    """A decorator: `make(system, layout, params)`, independent of values, is cached as in `derivation_of`."""
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


def _structure_key(system: Any, layout: Layout, params: PyTree) -> _SceneStructure | None:
    """The cache key of a scene with its layout and parameters; None if its functions hold arrays."""
    arrays, scene = jax.tree.flatten(system)
    leaves, tree = jax.tree.flatten(params)
    kept = (
        _NumberKey(np.shape(x), np.dtype(dtype_of(x))) if type(x) is np.ndarray or eqx.is_array_like(x) else x
        for x in leaves
    )
    return None if arrays else _SceneStructure(scene, layout, tree, tuple(kept))


def _derive_structure(key: _SceneStructure, unhashable: str | None = None) -> Derivation:
    system, layout, params = key.restored
    numbers = eqx.filter(params, eqx.is_array_like)
    return Derivation(system._motion(layout, params), layout, numbers, unhashable=unhashable, path=system.path)


_derived_once = functools.lru_cache(maxsize=64)(_derive_structure)
