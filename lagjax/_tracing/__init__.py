"""From JAX to scalar programs and back: a function of a few numbers, reduced to the arithmetic it really needs.

Derivatives of a Lagrangian, as JAX traces them, are mostly padding: products with the zeros and ones of unit vectors,
arrays built to be taken apart again, the same product in three places. For a small scene all of it can be seen through.
`lower` traces a function, follows every single number through every array operation, and keeps each operation once:

    jaxpr  ──_rules──►  graph of scalars  ──_graph──►  folded, shared  ──_passes──►  Program  ──_emit──►  JAX again

    >>> program = lower(lambda q, v: 0.5 * jnp.sum(v * v) - jnp.cos(q[0]) + 0.0 * q[1], jnp.zeros(2), jnp.zeros(2))
    >>> program.operations              # v0*v0 + v1*v1, a half of it, cos(q0), the difference
    6
    >>> program.depends(0)              # inputs 0, 2 and 3: q[1] is cyclic
    frozenset({0, 2, 3})
    >>> program(q0, q1, v0, v1)         # JAX again: under jit, vmap, grad

Structure needs no special cases then. A constant mass matrix is inverted here, a diagonal one becomes divisions, an
absent term is absent.

The inputs are the elements of the example arrays, leaf by leaf, each in C order; the outputs likewise.
A `Program` is called with one JAX scalar per input. Each may be an array of lanes instead, all lanes in one call: the
inputs broadcast, and every output, constants too, has the shape they broadcast to. The precision is that of the inputs.

Derivatives of a program are those of its operations, programs again that are made on first use; `has_own_rules` finds
functions that have other ones.

`lowering/` turns JAX's operations into scalars of a graph (`_program`), `_scalars` writes formulas on it, `_emit` is
for JAX again.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from lagjax._program import (
    INPUTS,
    LOOK_UPS,
    Graph,
    LinearSystem,
    StraightLine,
    copy_nodes,
    eliminate_dead_code,
    factor,
    find_ancestors,
    pushforward,
    rounding,
    sink_negations,
    table_of,
)
from lagjax._tracing import _scalars as scalar_algebra
from lagjax._tracing._emit import WRITTEN, Rows, apply_in_jax, emit, emit_look_up, emit_rows
from lagjax._tracing._scalars import Scalars, absolute, apply_function, concatenate, fold, multiply, scatter, stack
from lagjax._tracing.lowering import _complex
from lagjax._tracing.lowering._matrices import orthogonalize, row_weights, solve_orthogonalized
from lagjax._tracing.lowering._rules import (
    LARGEST_UNFOLDED,
    Expansion,
    expand_primitive,
    has_own_rules,
    inputs_of,
    lowers,
)


def lower(function: Callable, *examples, budget: int = 20_000, moving: int = 0) -> "Program":
    """The scalar program of `function` at arguments like `examples` (arrays, `ShapeDtypeStruct`s, or pytrees of them).

    The first `moving` scalars among the inputs vary along a motion (`Graph`). Raises `Unlowerable`, with a sentence,
    for a primitive without a scalar form, for indices and loops that depend on the values of the inputs, and for more
    than `budget` scalar operations; the last without doing the work first.
    """
    leaves, structure = jax.tree.flatten(examples)
    shapes = tuple(jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
    jaxpr = jax.make_jaxpr(lambda *xs: jax.tree.leaves(function(*jax.tree.unflatten(structure, xs))))(*shapes)

    def scalars(expansion, arguments):
        return expansion.run_closed(jaxpr, arguments)

    return lower_scalars(scalars, shapes, budget, moving)


def lower_scalars(
    scalars: Callable, shapes: tuple[jax.ShapeDtypeStruct, ...], budget: int, moving: int = 0
) -> "Program":
    """The program of a function `scalars(expansion, arguments)` from id arrays of inputs to those of outputs."""
    expansion = Expansion(Graph(budget, moving))
    expansion.work(sum(math.prod(shape.shape) for shape in shapes))
    arguments = inputs_of(expansion.graph, shapes)
    with np.errstate(all="ignore"):
        results = scalars(expansion, arguments)
    real = expansion.graph.real
    outputs = [i if i < INPUTS else real(i) for result in results for i in result.ravel().tolist()]
    line = eliminate_dead_code(*sink_negations(*factor(expansion.graph, outputs)))
    return Program(line, expansion.traced_operations, shapes)


def lower_formula(formula: Callable, *shapes, budget: int) -> "Program":
    """The program of a formula: a function of `Scalars`, one per input, that returns a vector."""

    def scalars(expansion, arguments):
        return [formula(*(Scalars(expansion, x) for x in arguments)).ids]

    return lower_scalars(scalars, tuple(shapes), budget)


def lower_solution(system: Callable, solve: Callable, size: int, *shapes, budget: int) -> "Program":
    """The program of the first `size` components of z with A z = r, and of one further number.

    A is symmetric up to entries added above its diagonal. Both functions are formulas (see `lower_formula`) on numbers
    of these `shapes`. `system(*numbers)` gives the rows and columns (k, 2) of entries of A on and below its diagonal,
    and of those added, these entries (k,), r, what `solve` needs of A, a tree of vectors, and the further number;
    `solve(factors, r)` gives z, and is linear in r.
    """
    counts: list = []

    def expand_system(expansion, arguments):
        places, entries, right, factors, number = system(*(Scalars(expansion, x) for x in arguments))
        leaves = jax.tree.leaves(factors)
        z = solve(factors, right)
        counts.append((places, [x.ids.size for x in (z, entries, right)], [x.shape for x in leaves], factors))
        number = number.ids if isinstance(number, Scalars) else expansion.constants(number)
        return [z.ids[:size], number, z.ids[size:], *(x.ids for x in (entries, right, *leaves))]

    program = lower_scalars(expand_system, tuple(shapes), budget)
    places, (of_z, of_entries, of_right), of_factors, factors = counts[0]
    ends = np.cumsum([size, 1, of_z - size, of_entries, of_right])
    z, _, others, entries, right, leaves = np.split(np.array(program.line.outputs), ends)
    scalar = jnp.result_type(float)
    tree, nodes = jax.tree.structure(factors), dict(zip(map(tuple, places.tolist()), entries.tolist(), strict=True))
    vectors = [jax.ShapeDtypeStruct(shape, scalar) for shape in (*of_factors, (of_right,))]

    def solution(expansion, arguments):
        *parts, b = (Scalars(expansion, x) for x in arguments)
        return [solve(jax.tree.unflatten(tree, parts), b).ids]

    return replace(
        program,
        line=program.line.replace(outputs=program.line.outputs[: size + 1]),
        linear=LinearSystem(
            z=(*z.tolist(), *others.tolist()),
            entries={(i, j): node for (i, j), node in nodes.items() if i >= j},
            others={(i, j): node for (i, j), node in nodes.items() if i < j},
            right=tuple(right.tolist()),
            factors=tuple(leaves.tolist()),
            solve=functools.cache(lambda: lower_scalars(solution, tuple(vectors), budget).line),
        ),
    )


def compose(outer: "Program", inner: "Program", budget: int, moving: int) -> "Program":
    """The composition of two programs: `inner` computes the last array of `outer` from the inputs before it."""

    def scalars(expansion, arguments):
        ids = np.concatenate([x.ravel() for x in arguments])
        found = inner.place(expansion, ids)[list(inner.line.outputs)]
        return [outer.place(expansion, np.concatenate([ids, found]))[list(outer.line.outputs)]]

    return lower_scalars(scalars, outer.shapes[:-1], budget, moving)


@dataclass(frozen=True, eq=False)
class Program:
    """A straight line of scalar operations as a function in JAX; made by `lower`, compared and hashed by identity.

    `line` has the operations and outputs; `traced_operations` counts the scalar operations of the function as written.
    A program that is not valid for all inputs says so in its last output, and `otherwise()` is one that is. If the
    outputs solve a linear system, `linear` is that. `mechanics` gives L and the constraints (`_kick.Mechanics`) from
    the same inputs, if L or a constraint is piecewise. `residual()` is a program that is zero at the solution, its last
    inputs, by which its derivatives are A.
    """

    line: StraightLine
    traced_operations: int
    shapes: tuple[jax.ShapeDtypeStruct, ...]
    otherwise: "Callable[[], Program] | None" = None
    linear: LinearSystem | None = None
    mechanics: StraightLine | None = None
    residual: "Callable[[], Program] | None" = None

    @property
    def complete(self) -> "Program":
        """The program that is valid for all inputs."""
        return self if self.otherwise is None else self.otherwise()

    def __call__(self, *scalars) -> tuple:
        """The outputs, one per scalar input; see the module's text for lanes and precision."""
        if len(scalars) != self.size:
            raise TypeError(f"this program takes {self.size} scalars, not {len(scalars)}")
        return self._differentiable_call(*scalars)

    def vector(self, *scalars) -> Scalars:
        """The outputs as one vector of `Scalars`: the program is copied into their graph."""
        inputs = stack(scalars)
        return Scalars(inputs.expansion, self.place(inputs.expansion, inputs.ids)[list(self.line.outputs)])

    def place(self, expansion: Expansion, ids: np.ndarray) -> np.ndarray:
        """The nodes of the program, copied into a graph where its inputs are the nodes `ids` (inputs,)."""
        graph, inputs = expansion.graph, ids.tolist()
        expansion.traced_operations += self.operations
        places = [graph.position(i) for i in inputs] if self.looks_up else None
        return np.array(copy_nodes(graph, self.line, inputs, places), dtype=np.int64)

    @property
    def looks_up(self) -> bool:
        """True if the program reads tables (see `_look_ups`)."""
        return self.line.looks_up

    def compute_outputs(self, first, numbers) -> tuple:
        """The outputs at inputs `first` (m,), then `numbers` (P,), which stay one array if there are many.

        In that case derivatives are those of the operations as written.
        """
        if self.looks_up or self.size > LARGEST_UNFOLDED:
            return emit_rows(self.line, Rows(first, numbers))
        return self(*first, *numbers)

    @property
    def size(self) -> int:
        return len(self.dtypes)

    @property
    def dtypes(self) -> tuple[np.dtype, ...]:
        return self._dtypes  # a property, as the protocol of what has recurrences has it

    @functools.cached_property
    def _dtypes(self) -> tuple[np.dtype, ...]:
        return tuple(dtype for shape in self.shapes for dtype in [shape.dtype] * math.prod(shape.shape))

    def evaluate(self, *numbers) -> np.ndarray:
        """The outputs (outputs,) at these numbers, in NumPy without compilation."""
        return self.evaluate_many(numbers)[:, 0]

    def evaluate_many(self, columns) -> np.ndarray:
        """The outputs at S states, shape (outputs, S), in NumPy without compilation.

        `columns` has one entry for each input: a number, or S of them, (S,), whose precision is that of floats.
        """
        return self.line.evaluate(columns)

    def append_inputs(self, count: int) -> "Program":
        """The program with `count` further float inputs, which it does not read."""
        more, other = jax.ShapeDtypeStruct((count,), jnp.result_type(float)), self.otherwise
        otherwise = other and functools.cache(lambda: other().append_inputs(count))
        return replace(self, shapes=(*self.shapes, more), otherwise=otherwise)

    def select_outputs(self, positions: Sequence[int]) -> "Program":
        line = eliminate_dead_code(self.line, [self.line.outputs[i] for i in positions])
        return replace(self, line=line, otherwise=None, linear=None)

    def rounding_of(self, positions: Sequence[int], moving: int) -> "Program":
        """The program of the running errors of the outputs at `positions` (see `_rounding`); it has no derivatives."""
        line = eliminate_dead_code(self.line, [self.line.outputs[i] for i in positions])
        graph = Graph.from_line(line, 20 * len(line.nodes) + 1000)
        with np.errstate(all="ignore"):
            errors = rounding(graph, line, range(len(line.nodes)), moving, to_zero=True)
        return replace(self, line=eliminate_dead_code(graph, errors), otherwise=None, linear=None)

    @property
    def operations(self) -> int:
        return self.line.operations

    def constant(self, output: int) -> float | None:
        """The value of an output that does not depend on the inputs, else None."""
        return self.line.constant(output)

    def find_inputs(self, outputs: Sequence[int]) -> frozenset[int]:
        nodes = self.line.nodes
        seen = [nodes[i] for i in find_ancestors(nodes, [self.line.outputs[k] for k in outputs])]
        tables = (table_of(attribute).positions for op, _, attribute in seen if op in LOOK_UPS)
        return frozenset({attribute for op, _, attribute in seen if op == "input"}.union(*tables))

    def depends(self, output: int) -> frozenset[int]:
        return self.find_inputs([output])

    # ---- derivatives ----

    @functools.cached_property
    def _differentiable_call(self) -> Callable:
        def run(*scalars):
            return emit(self.line, scalars)

        if self.looks_up:  # the tangents of a table's entries are a table themselves
            return run
        run = jax.custom_jvp(run)

        @functools.partial(run.defjvp, symbolic_zeros=True)
        def rule(primals, tangents):
            values = run(*primals)
            active = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
            dots = list(self._tangent_programs(active)(*primals, *(tangents[i] for i in active)))
            return values, tuple(
                dots.pop(0).astype(value.dtype) if kind == "float" else np.zeros(value.shape, jax.dtypes.float0)
                for value, kind in zip(values, self._output_kinds, strict=True)
            )

        return run

    @property
    def _output_kinds(self) -> list[str]:
        return [self.line.kinds[i] for i in self.line.outputs]

    @functools.cached_property
    def _tangent_programs(self) -> Callable:
        """A cached function `(active)`: the program of the tangents of float outputs for these active inputs."""

        @functools.cache
        def tangent_program(active: tuple[int, ...]) -> Program:
            floats = [k for k, kind in enumerate(self._output_kinds) if kind == "float"]
            line = pushforward(self.line, self.dtypes, active, floats, in_jax=True)
            scalar = jax.ShapeDtypeStruct((), jnp.result_type(float))
            return Program(line, len(line.nodes), (*self.shapes, *[scalar] * len(active)))

        return tangent_program
