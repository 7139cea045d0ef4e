"""Derivatives of the scalars of a graph, as more scalars of the same graph.

What a derivative costs is then what it consists of: only operations that carry a derivative are looked at, where an
array derivative goes through every zero of its unit vectors. The rules are those of `_operations`: a scalar operation
is its own transpose, so that one formula, linear in g, takes a cotangent from the result to an operand and a tangent
from an operand to the result.

These are derivatives of the operations as they stand. A function with a rule of its own for its derivative is not
differentiated here: `has_own_rules` finds it.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
from jax.extend import core

from lagjax._program._graph import Graph, Node, Tape
from lagjax._program._operations import OPERATIONS
from lagjax._program._rules import is_formula, live_equations

_Rule = Callable[[int], int]
Tangents = dict[int, int]  # by the number of the direction; a direction that is not there has none

_OWN_RULES = frozenset(("stop_gradient", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"))


def has_own_rules(jaxpr) -> bool:
    """True if a jaxpr, or one that it calls, asks for other derivatives than those of its operations."""
    return any(
        not is_formula(equation)
        and (equation.primitive.name in _OWN_RULES or any(has_own_rules(inner) for inner in _inner(equation)))
        for equation in live_equations(jaxpr)
    )


def _inner(equation) -> list:
    params = equation.params
    if equation.primitive.name == "custom_linear_solve":  # how JAX solves it is not what is lowered
        params = {"matvec": params["jaxprs"].matvec}
    leaves = jax.tree.leaves(list(params.values()), is_leaf=lambda x: isinstance(x, core.Jaxpr | core.ClosedJaxpr))
    closed = (x.jaxpr if isinstance(x, core.ClosedJaxpr) else x for x in leaves)
    return [x for x in closed if isinstance(x, core.Jaxpr)]


class Derivatives:
    """Derivatives of nodes of a graph; `operations` counts what they consist of before anything is simplified."""

    def __init__(self, graph: Graph):
        self.graph, self.operations = graph, 0

    def copied(self, tape: Graph, inputs: Sequence[int]) -> list[int]:
        """The scalars of a tape, or of another graph, in this graph; `inputs` are its inputs here."""
        nodes: list[int] = []
        for (op, operands, attribute), kind in zip(tape.nodes, tape.kinds, strict=True):
            nodes.append(self._copied(op, [nodes[x] for x in operands], attribute, kind, inputs))
        return nodes

    def gradient(
        self, tape: Tape, nodes: list[int], output: int, by: Sequence[int], together: bool, again: Sequence[int] = ()
    ) -> list[int]:
        """The derivatives of one scalar of a tape by the inputs at the positions `by`: reverse mode.

        What depends on the inputs `again` will be differentiated once more by these.

        `nodes` holds what the tape is in the graph. The cotangents of scalars that are equal are added up at once where
        they are to be taken `together`, else each is followed on its own as far as it is written apart.
        """
        first: dict[int, int] = {}
        same = [first.setdefault(i, k) if together else k for k, i in enumerate(nodes)]
        varied, once_more = (self._varied(tape, nodes, frozenset(inputs)) for inputs in (by, again))
        cotangents, results = {same[output]: self._number(1.0)}, {}
        for k in range(output, -1, -1):
            if not varied[k] or (g := cotangents.pop(k, None)) is None:
                continue
            op, operands, attribute = tape.nodes[k]
            if op == "input":
                results[attribute] = g
            rules_of = self._rules if once_more[k] else self._rules_once
            rules = rules_of(nodes[k], op, [nodes[x] for x in operands], attribute)
            for x, rule in zip(operands, rules, strict=False):
                if rule is not None and varied[x]:
                    part, x = rule(g), same[x]
                    cotangents[x] = self._apply("add", cotangents[x], part) if x in cotangents else part
        return [results.get(i, self._number(0.0)) for i in by]

    def slopes(self, output: int, through: Iterable[int], by: Sequence[int]) -> list[int]:
        """The derivatives of a node by others, as if these were independent: reverse mode on the graph itself.

        `through` holds the nodes that depend on the others, in order, `output` the last of them.
        """
        cotangents, ends = {output: self._number(1.0)}, set(by)
        for i in reversed(list(through)):
            if i in ends or (g := cotangents.pop(i, None)) is None:
                continue
            op, operands, attribute = self.as_derived(i)
            for x, rule in zip(operands, self._rules(i, op, operands, attribute), strict=False):
                if rule is not None and self.graph.value(x) is None:
                    part = rule(g)
                    cotangents[x] = self._apply("add", cotangents[x], part) if x in cotangents else part
        return [cotangents.get(i, self._number(0.0)) for i in by]

    def size(self, outputs: Sequence[int]) -> int:
        """The number of operations of some nodes together."""
        return sum(bool(self.graph.nodes[i][1]) for i in self.graph.below(outputs))

    def _copied(self, op: str, operands: list[int], attribute, kind: str, inputs: Sequence[int]) -> int:
        """A node of a tape in the graph."""
        if op == "input":
            return self.graph.real(inputs[attribute])
        if op == "constant":
            return self.graph.constant(attribute, kind)
        if op == "integer_pow":
            (base,) = operands
            return self.graph.power(base, attribute)
        return self.graph.apply(op, *operands, attribute=attribute)

    def _varied(self, tape: Tape, nodes: list[int], by: frozenset[int]) -> list[bool]:
        """Which scalars of a tape depend on the inputs `by`, and have a derivative."""
        varied: list[bool] = []
        for k, (op, operands, attribute) in enumerate(tape.nodes):
            depends = attribute in by if op == "input" else any(varied[x] for x in operands)
            varied.append(depends and tape.kinds[k] == "float" and self.graph.value(nodes[k]) is None)
        return varied

    def along(self, outputs: Sequence[int], directions: Sequence[Tangents]) -> list[Tangents]:
        """The derivatives of some nodes along directions, each the tangents of some inputs: forward mode."""
        tangents: dict[int, Tangents] = {}
        for k, direction in enumerate(directions):
            for i, tangent in direction.items():
                if self.graph.value(tangent) != 0:
                    tangents.setdefault(i, {})[k] = tangent
        for i in self.below(outputs) if tangents else ():
            if self.graph.kinds[i] == "float" and i not in tangents:
                moved = not tangents.keys().isdisjoint(self.as_derived(i)[1])
                if moved and (of_node := self._tangents(i, tangents)):
                    tangents[i] = of_node
        return [tangents.get(i, {}) for i in outputs]

    def along_one(self, outputs: Sequence[int], direction: Tangents) -> list[int]:
        """The derivatives of some nodes along one direction, the tangents of some inputs."""
        return [t.get(0, self._number(0.0)) for t in self.along(outputs, [direction])]

    def _tangents(self, i: int, tangents: dict[int, Tangents]) -> Tangents:
        """The tangents of a node, from those of its operands."""
        (op, operands, attribute), result = self.as_derived(i), {}
        if op == "div" and all(x in tangents for x in operands):
            return self._of_quotient(i, tangents)
        for operand, rule in zip(operands, self._rules(i, op, operands, attribute), strict=False):
            if rule is None:
                continue
            for k, tangent in tangents.get(operand, {}).items():
                part = rule(tangent)
                result[k] = self._apply("add", result[k], part) if k in result else part
        return {k: tangent for k, tangent in result.items() if self.graph.value(tangent) != 0}

    def _of_quotient(self, i: int, tangents: dict[int, Tangents]) -> Tangents:
        """(u′ − w v′)/v: one division, where the two rules have two."""
        (u, v), apply = self.graph.nodes[i][1], self._apply
        of_u, of_v = tangents[u], tangents[v]
        result = {k: apply("neg", apply("mul", i, tangent)) for k, tangent in of_v.items()}
        for k, tangent in of_u.items():
            result[k] = apply("sub", tangent, apply("mul", i, of_v[k])) if k in of_v else tangent
        return {k: apply("div", tangent, v) for k, tangent in result.items()}

    def _rules_once(self, w: int, op: str, operands: Sequence[int], attribute: Any) -> Sequence[_Rule | None]:
        """`_rules` for the only cotangent of w: factors 2 and ½ are next to others, with which they cancel."""
        if op == "sqrt":
            return [lambda g: self._apply("mul", self._number(0.5), self._apply("div", g, w))]
        if op == "mul" and operands[0] == operands[1]:
            return [lambda g: self._of_power(operands[0], 2, g)]
        return self._rules(w, op, operands, attribute)

    def as_derived(self, i: int) -> Node:
        """A node as it is differentiated: a power is one operation, not the products that it consists of."""
        if i in self.graph.powers:
            base, exponent = self.graph.powers[i]
            return "integer_pow", (base,), exponent
        return self.graph.nodes[i]

    def _rules(self, w: int, op: str, operands: Sequence[int], attribute: Any = None) -> Sequence[_Rule | None]:
        """For every operand what takes a cotangent, or a tangent, past w = op(operands); None: there is none."""
        if op == "integer_pow":
            return [lambda g: self._of_power(operands[0], attribute, g)]

        def passed(rule):
            return None if rule is None else lambda g: rule(self._apply, self._number, g, w, *operands)

        return [passed(rule) for rule in OPERATIONS[op].transpose()] if operands else []

    def _of_power(self, base: int, exponent: float, g: int) -> int:
        """p uᵖ⁻¹ g, which is finite at u = 0 where the products and roots that make up uᵖ have no derivative."""
        lower = base if exponent == 2 else self._apply("pow", base, self._number(exponent - 1))
        return self._apply("mul", g, self._apply("mul", self._number(exponent), lower))

    def below(self, outputs: Sequence[int]) -> list[int]:
        """The nodes that some nodes are derived from, and these, in order."""
        return self.graph.below(outputs, as_derived=True)

    def _apply(self, op: str, *operands: int, attribute=None) -> int:
        self.operations += 1
        return self.graph.apply(op, *operands, attribute=attribute)

    def _number(self, x: float) -> int:
        return self.graph.constant(x, "float")
