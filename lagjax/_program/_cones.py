"""Cones: divisions by the length |u| of a velocity vector u, singular at rest, as in dry friction in the plane."""

from typing import Any

from lagjax._program._operations import COMPARISONS
from lagjax._program._series import StraightLine

NO_LENGTH = 1e-12  # the longest one that a guard against zero may put in the place of a vector at rest


def list_squares(line: StraightLine, i: int) -> list[int] | None:
    """The nodes u₁, u₂, … if node i is a sum Σ cₖ uₖ² with positive constants cₖ; None if it is not."""
    op, operands, _ = line.nodes[i]
    if op == "add":
        some = [list_squares(line, x) for x in operands]
        return None if None in some else [u for of in some for u in of or ()]
    if op == "mul" and operands[0] == operands[1]:
        return [operands[0]]
    factors = [line.nodes[x][2] for x in operands if line.nodes[x][0] == "constant"] if op == "mul" else []
    others = [x for x in operands if line.nodes[x][0] != "constant"]
    return list_squares(line, others[0]) if len(others) == len(factors) == 1 and factors[0] > 0 else None


def velocity_degrees(line: StraightLine, size: int) -> list[int]:
    """For each node its degree as a polynomial in the velocities: 0, 1, or 2 for anything higher or not polynomial."""
    degrees: list[int] = []
    for op, operands, attribute in line.nodes:
        of = [degrees[x] for x in operands]
        if op == "input":
            degrees.append(int(size <= attribute < 2 * size))
        elif op in ("add", "sub", "neg", "select", "mul") or (op == "div" and not of[1]):
            degrees.append(min(2, sum(of) if op == "mul" else max(of)))
        else:
            degrees.append(2 * any(of))
    return degrees


def find_cones(line: StraightLine, size: int, linear: Any) -> dict[int, int]:
    """The nodes that compute, or compare, a length |u| of velocities used as a divisor, each with the node of |u|².

    They are square roots, also of `where` or `maximum` expressions that replace |u| = 0, and the comparisons in such
    guards. Each component of u must be linear in the velocities, and the program must solve a linear system.
    """
    nodes, cones = line.nodes, {}

    def guarded(i: int) -> list[int]:
        """Node i and, if it is a `select` or `max` that guards against zero, the nodes that it chooses from."""
        op, operands, _ = nodes[i]
        some = operands[1:] if op == "select" else operands if op == "max" else ()
        return [i, *(x for k in some for x in guarded(k))] if some else [i]

    roots = {x for op, of, _ in nodes if op == "div" for x in guarded(of[1]) if nodes[x][0] == "sqrt"}
    roots |= {i for i, (op, _, _) in enumerate(nodes) if op == "rsqrt"}
    squares, degrees = {}, velocity_degrees(line, size) if roots else []
    for root in roots if linear is not None else ():
        for x in guarded(nodes[root][1][0]):
            parts = list_squares(line, x)
            if parts and all(degrees[u] == 1 for u in parts):
                squares[x] = cones[root] = x
    squares |= {i: x for i, x in cones.items() if nodes[i][0] == "sqrt"}
    for i, (op, operands, _) in enumerate(nodes):
        if op in (*COMPARISONS, "eq", "ne", "max") and not squares.keys().isdisjoint(operands):
            others = [x for x in operands if x not in squares]
            if len(others) == 1 and nodes[others[0]][0] == "constant" and 0 <= nodes[others[0]][2] <= NO_LENGTH:
                cones[i] = next(squares[x] for x in operands if x in squares)
        elif op == "select" and operands[0] in cones and {nodes[x][2] for x in operands[1:] if x not in cones} == {0.0}:
            cones[i] = cones[operands[0]]  # a length, written so that it has a slope at zero
    return cones
