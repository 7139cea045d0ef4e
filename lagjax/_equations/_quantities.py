"""`Motion.quantities` on scalars: every function of a scene is traced as it is, and differentiated scalar by scalar.

JAX differentiates whole arrays: ∂²L/∂q̇² takes as many passes over L as there are coordinates, each full of zeros that
are folded away afterwards, and JAX takes long to trace them. On scalars only nonzero derivatives are computed. The
results are the same; `tests/equations/test_derivation.py` compares them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from lagjax._equations._constraints import Constraints
from lagjax._equations._coupled_forces import CoupledForces
from lagjax._equations._motion import Motion
from lagjax._equations._recursion import Recursion, RecursiveElimination, recursion_of
from lagjax._equations._saddle import SaddleElimination
from lagjax._program import Derivatives, Tape, copy_nodes
from lagjax._tracing import Expansion, has_own_rules, inputs_of

Ids = np.ndarray  # scalars of a graph, in the shape of the array that they stand for


class OwnRules(Exception):
    """Error: a function of a scene has custom derivative rules, which only JAX can apply."""


class _TapedValue(NamedTuple):
    """A value recorded on a tape: the nodes of the tape's scalars in the graph, its output, and positions of inputs."""

    tape: Tape
    nodes: list[int]
    output: int
    positions: dict[int, int]

    @property
    def value(self) -> Ids:
        return np.array(self.nodes[self.output], dtype=np.int64)


class _ScalarState:
    """A state on scalars: q (n,), q̇ (n,), t () and params as ids, by name, with the shapes that functions expect."""

    def __init__(self, expansion: Expansion, shapes: tuple, leaves: list[Ids]):
        names = ("q", "qdot", "t", "params")
        state = jax.tree.unflatten(jax.tree.structure(shapes), leaves)
        self.expansion, self.derivatives = expansion, Derivatives(expansion.graph)
        self.shapes: dict[str, Any] = dict(zip(names, shapes, strict=True))
        self.ids: dict[str, Any] = dict(zip(names, state, strict=True))
        # Coordinates are differentiated by, one by one: those of a long array are nodes as well.
        self.ids |= {name: expansion.real(self.ids[name]) for name in ("q", "qdot", "t")}

    def evaluate(self, function: Callable, *arguments: str, at_rest: bool = False) -> Ids:
        """The value of a function of the named ones of q, qdot, t, params; `at_rest` with qdot = 0."""
        values = self.ids | ({"qdot": self.zeros(self.ids["qdot"].shape)} if at_rest else {})
        leaves = jax.tree.leaves([values[name] for name in arguments])
        (value,) = self.expansion.run_closed(self._traced(function, *arguments), leaves)
        return value

    def evaluate_with(self, function: Callable, *values: Ids) -> Ids:
        """The value of a function of these numbers, and then of q, q̇, t and params."""
        shapes = [jax.ShapeDtypeStruct(ids.shape, self.shapes["q"].dtype) for ids in values]
        jaxpr = jax.make_jaxpr(function)(*shapes, *self.shapes.values())
        (value,) = self.expansion.run_closed(jaxpr, [*values, *jax.tree.leaves(list(self.ids.values()))])
        return value

    def taped(self, function: Callable) -> "_TapedValue":
        """A scalar function of (q, q̇, t, params) recorded on a tape, as written, for `gradient`."""
        tape = Tape(self.expansion.graph.budget, self.expansion.graph.moving)
        written = Expansion(tape)
        inputs = [i for leaf in jax.tree.leaves(list(self.ids.values())) for i in leaf.ravel().tolist()]
        arguments = inputs_of(tape, jax.tree.leaves(list(self.shapes.values())))
        (output,) = written.run_closed(self._traced(function, *self.ids), arguments)
        self.expansion.traced_operations += written.traced_operations
        nodes = copy_nodes(self.expansion.graph, tape, inputs)
        return _TapedValue(tape, nodes, int(output), {i: k for k, i in enumerate(inputs)})

    def gradient(self, of: "_TapedValue", *by: str, together: bool = True) -> list[Ids]:
        """The derivatives of a taped value by each of the named ones of q, qdot and t."""
        inputs = [self.ids[name] for name in by]
        positions = [of.positions[i] for ids in inputs for i in ids.ravel().tolist()]
        again = [of.positions[i] for i in self.ids["qdot"].ravel().tolist()]
        gradient = self.derivatives.gradient(of.tape, of.nodes, of.output, positions, together, again)
        flat = np.array(gradient, dtype=np.int64)
        ends = np.cumsum([ids.size for ids in inputs])[:-1]
        return [part.reshape(ids.shape) for part, ids in zip(np.split(flat, ends), inputs, strict=True)]

    def _traced(self, function: Callable, *arguments: str):
        jaxpr = jax.make_jaxpr(function)(*(self.shapes[name] for name in arguments))
        if has_own_rules(jaxpr.jaxpr):
            raise OwnRules
        return jaxpr

    def zeros(self, shape) -> Ids:
        return np.full(shape, self.expansion.graph.constant(0.0, "float"))

    def jacobian(self, values: Ids, by: str) -> Ids:
        """The derivatives ∂valueᵢ/∂xⱼ for x = q or qdot, shape (values, n)."""
        one = self.expansion.graph.constant(1.0, "float")
        directions = [{i: one} for i in self.ids[by].tolist()]
        result = self.zeros((values.size, len(directions)))
        for i, row in enumerate(self.derivatives.directional_derivatives(values.tolist(), directions)):
            for j, derivative in row.items():
                result[i, j] = derivative
        return result

    def rate(self, values: Ids, q: Ids | None = None, qdot: Ids | None = None, t: bool = False) -> Ids:
        """The rates of change of `values` while q, q̇ and t change at the rates `q`, `qdot` and 1, where given."""
        rates: dict[int, int] = {}
        for name, rate in (("q", q), ("qdot", qdot)):
            if rate is not None:
                rates |= zip(self.ids[name].tolist(), rate.tolist(), strict=True)
        if t:
            rates[int(self.ids["t"])] = self.expansion.graph.constant(1.0, "float")
        found = self.derivatives.directional_derivatives(values.tolist(), [rates])
        return np.array([of.get(0, self.expansion.graph.number(0.0)) for of in found], dtype=np.int64)

    def varying(self, values: Ids) -> np.ndarray:
        """For each value: True if it depends on q, q̇ or t."""
        graph = self.expansion.graph
        moving = {i for name in ("q", "qdot", "t") for i in self.ids[name].ravel().tolist()}
        for i in self.derivatives.find_ancestors(values.ravel().tolist()):
            if not moving.isdisjoint(graph.nodes[i][1]):
                moving.add(i)
        return np.array([i in moving for i in values.ravel().tolist()], bool).reshape(values.shape)


def quantities(motion: Motion, expansion: Expansion, shapes: tuple, leaves: list) -> tuple[dict, Recursion | None]:
    """`Motion.quantities` as ids; `shapes` are those of (q, q̇, t, params) and `leaves` the ids of all their leaves.

    If the recursion in L needs fewer operations for accelerations, it is returned too, and its `entries` are one
    further quantity: `recursion` (k,). Raises `OwnRules`.
    """
    state, everything = _ScalarState(expansion, shapes, leaves), ("q", "qdot", "t", "params")
    rates = {"q": state.ids["qdot"], "t": True}
    lagrangian = state.taped(motion.lagrangian)
    by_q, momentum, by_t, matrix, inertial = _lagrangian_derivatives(state, lagrangian, rates)
    of_constraints = _constraint_quantities(motion.constraints, state, rates)
    zero, dissipation, damping = _dissipation_and_slopes(motion, state)
    if isinstance(motion.forces, CoupledForces):
        free = state.expansion.map("sub", inertial, damping)
        rows = of_constraints["jacobian"], of_constraints["gamma"]
        forces = state.evaluate_with(motion.forces.solve, matrix, free, *rows)
    else:
        forces = zero if motion.forces is None else state.evaluate(motion.forces, *everything)
    nonconservative = state.expansion.map("sub", forces, damping)
    generalized = state.expansion.map("add", by_q, nonconservative)
    result = {
        "lagrangian": lagrangian.value,
        "momentum": momentum,
        "mass_matrix": matrix,
        "lagrangian_by_q": by_q,
        "lagrangian_by_t": by_t,
        "energy_by_q": state.expansion.map("sub", state.rate(by_q, qdot=state.ids["qdot"]), by_q),
        "force": state.expansion.map("add", inertial, nonconservative),
        "given_force": forces,
        "dissipation": dissipation,
        "dissipation_by_qdot": damping,
        "nonconservative_force": nonconservative,
        "generalized_force": generalized,
        **of_constraints,
    }
    # Last of all, so that programs of scenes without one are not touched by the search.
    recursion = _shorter_recursion(motion, state, lagrangian, matrix)
    if recursion is not None:
        result["recursion"] = _entries_of(state, recursion)
    expansion.traced_operations += state.derivatives.operations
    return result, recursion


# What a Taylor series costs: a step takes about this many orders, and a sum over all lower orders half as many
# products.
_ORDERS = 20


def _shorter_recursion(motion: Motion, state: _ScalarState, lagrangian: _TapedValue, matrix: Ids) -> Recursion | None:
    """The recursion in L if it takes fewer operations than eliminating M; two coordinates use Cramer's rule."""
    if motion.constraints.exist or len(matrix) < 3 or not state.varying(_nonzero_scalars(state, matrix)).any():
        return None
    recursion = recursion_of(state.derivatives, int(lagrangian.value), state.ids["qdot"].tolist())
    if recursion is None:
        return None
    sparse, graph = RecursiveElimination(recursion, float), state.expansion.graph
    if not sparse.complete:
        return None
    zeros = np.array([graph.value(i) == 0 for i in matrix.ravel().tolist()], bool).reshape(matrix.shape)
    dense = SaddleElimination((zeros, np.zeros((0, len(matrix)), bool)), float, False, False)
    nodes, entries = matrix[tuple(dense.entries.T)].tolist(), _entries_of(state, recursion).tolist()
    costs = (
        _cost(state, entries, sparse.entries, *sparse.operations([graph.value(i) for i in entries])),
        _cost(state, nodes, dense.entries, dense.operations, dense.solution_operations),
    )
    return recursion if all(a < b for a, b in zip(*costs, strict=True)) else None


def _cost(state: _ScalarState, nodes: list[int], places, operations: int, solution: int) -> tuple[int, float]:
    """The operations of an elimination, given the nodes of its matrix and their places, and those of a Taylor step."""
    operations += state.derivatives.size(nodes)
    sums = np.where(places[:, 0] == places[:, 1], 1, 2)[state.varying(np.array(nodes))].sum()
    return operations, operations + _ORDERS * (solution + (2 + _ORDERS / 2) * float(sums))


def _entries_of(state: _ScalarState, recursion: Recursion) -> Ids:
    minus = state.expansion.graph.constant(-1.0, "float")
    return np.array([minus if i is None else i for i in recursion.entries.values()])


def unbalanced_force(motion: Motion, expansion: Expansion, shapes: tuple, leaves: list, qddot: Ids) -> Ids:
    """`Motion.unbalanced_force` as ids, at an acceleration of ids (n,). Raises `OwnRules`."""
    state = _ScalarState(expansion, shapes, leaves)
    lagrangian = state.taped(motion.lagrangian)

    def derive(together: bool) -> tuple[Ids, Ids]:
        by_q, momentum = state.gradient(lagrangian, "q", "qdot", together=together)
        rate = state.rate(momentum, q=state.ids["qdot"], qdot=qddot, t=True)
        return (force := expansion.map("sub", rate, by_q)), force

    inertial, _ = _derive_shorter(state, lagrangian, derive)
    _, _, damping = _dissipation_and_slopes(motion, state)
    given = None if motion.forces is None else state.evaluate(motion.forces, *state.ids)
    return expansion.map("add", inertial if given is None else expansion.map("sub", inertial, given), damping)


def _dissipation_and_slopes(motion: Motion, state: _ScalarState) -> tuple[Ids, Ids, Ids]:
    """Zeros (n,), the dissipation (1,), or (0,) without one, and its derivatives by q̇ (n,)."""
    zero = state.zeros(state.ids["q"].shape)
    if motion.dissipation is None:
        return zero, state.zeros(0), zero
    taped = state.taped(motion.dissipation)
    return zero, taped.value.reshape(-1), state.gradient(taped, "qdot")[0]


# Scalars of a tape beyond which cotangents of equal scalars are always taken together: what they would hide is that
# terms of sums cancel, and sums of many terms are not compared.
_APART = 5000
# The part of its operations that one form must save to be preferred: less is within what later passes may change.
_SHORTER = 0.97


def _lagrangian_derivatives(
    state: _ScalarState, lagrangian: _TapedValue, rates: dict
) -> tuple[Ids, Ids, Ids, Ids, Ids]:
    """∂L/∂q, p, ∂L/∂t, M, and ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t, in the form that takes fewer operations."""

    def derive(together: bool) -> tuple[tuple, Ids]:
        by_q, momentum, by_t = state.gradient(lagrangian, "q", "qdot", "t", together=together)
        matrix = state.jacobian(momentum, "qdot")
        i, j = np.nonzero(matrix != state.zeros(()))
        i, j = np.maximum(i, j), np.minimum(i, j)
        matrix[j, i] = matrix[i, j]
        inertial = state.expansion.map("sub", by_q, state.rate(momentum, **rates))
        return (by_q, momentum, by_t, matrix, inertial), np.append(_nonzero_scalars(state, matrix), inertial)

    return _derive_shorter(state, lagrangian, derive)[0]


def _derive_shorter(state: _ScalarState, lagrangian: _TapedValue, derive: Callable[[bool], tuple[Any, Ids]]) -> tuple:
    """The result and scalars of `derive(together)`, in the variant with fewer operations."""
    # In a kinetic energy of rotations the terms of ∂L/∂q cancel with those of (∂p/∂q) q̇. Where the cotangents of equal
    # scalars are added up at once, that is not seen: where cos q is in the kinetic and in the potential energy, one
    # term cancels and the other does not. For forces between many bodies to add them up at once is a quarter shorter.
    forms = [derive(together) for together in ((True, False) if len(lagrangian.tape.nodes) <= _APART else (True,))]
    if len(forms) == 1:
        return forms[0]
    sizes = [state.derivatives.size(ids.tolist()) for _, ids in forms]
    return forms[0] if sizes[0] < _SHORTER * sizes[-1] else forms[-1]


def _nonzero_scalars(state: _ScalarState, matrix: Ids) -> Ids:
    """The entries of a matrix that are not structurally zero."""
    return matrix[matrix != state.zeros(())]


def _constraint_quantities(constraints: Constraints, state: _ScalarState, rates: dict) -> dict[str, Ids]:
    f = a = at_rest = state.zeros(0)
    if constraints.on_positions is not None:
        f = state.evaluate(constraints.on_positions, "q", "t", "params")
    if constraints.on_velocities is not None:
        a = state.evaluate(constraints.on_velocities, "q", "qdot", "t", "params")
        at_rest = state.evaluate(constraints.on_velocities, "q", "qdot", "t", "params", at_rest=True)
    rate = state.rate(f, **rates)
    release, drag = state.zeros(0), state.zeros((0, 0))
    if constraints.held is not None:
        held = constraints.held
        release = state.evaluate(lambda params: held(params) - 1.0, "params")
    if constraints.drag is not None:
        drag = state.evaluate(constraints.drag, "q", "qdot", "t", "params")
    return {
        "jacobian": np.concatenate([state.jacobian(f, "q"), state.jacobian(a, "qdot")]),
        "gamma": state.expansion.map("neg", np.concatenate([state.rate(rate, **rates), state.rate(a, **rates)])),
        "residual": np.concatenate([f, a]),
        "rates": np.concatenate([rate, a]),
        "driving": np.concatenate([state.rate(f, t=True), at_rest]),
        "release": release,
        "drag": drag,
    }
