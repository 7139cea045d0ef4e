"""Forces that read the multipliers of the constraints, as dry friction on a wire or in a bearing does: Q(q, q̇, t, λ).

M q̈ = F + Q + Gᵀλ and G q̈ = γ make the multipliers linear in the force, and with that Q is a function of the state:

    λ = λ₀ + R Q(λ),    R = −S⁻¹ G K⁻¹,    S = G K⁻¹ Gᵀ,    K = M + Gᵀ W G        (see `_linear` for W)

What is linear in λ is solved at once. So is what is linear in pieces of a single multiplier, as μ|λ|: as long as R Q
grows more slowly than λ, the piece is that of λ₀, and none depends on the direction in which friction acts. Else, as
for the length √(λ₁² + λ₂²) of a bearing's force, that is a few steps of Newton's method, the number of which is bounded
and the last of which is tested. Where none is found, or a single multiplier has two (Painlevé's paradox), Q is NaN.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

from lagjax._program import Unlowerable
from lagjax._tracing import lower

PyTree = Any

# Steps of Newton's method. Each squares what is missing, times the part of λ that the force makes: from a tenth the
# fourth is exact, from nine tenths the seventh; series of the motion converge alike. Pieces are known after one or two.
STEPS, STEPS_OF_PIECES = 7, 3
_NONE = 1e-30  # of a multiplier's square: nothing pushes


class CoupledForces(eqx.Module):
    """Q(q, qdot, t, params) (n,) for the multipliers that it brings about with the `free` motion, without it.

    `law(q, qdot, t, params, multipliers)` takes these as an array (m,).
    """

    law: Callable
    free: Any  # a `Motion`

    def __call__(self, q, qdot, t, params: PyTree):
        state, of = (q, qdot, t, params), self.free
        matrix, force = of.mass_matrix_and_force(*state)
        return self.solve(matrix, force, of.constraints.jacobian(*state), of.constraints.gamma(*state), *state)

    def solve(self, matrix, force, jacobian, gamma, *state):
        """Q from M, F, G and γ of the free motion."""
        weights = jnp.trace(matrix) / jnp.sum(jacobian**2, axis=1)
        weighted = weights[:, None] * jacobian
        moved = eliminate(matrix + jacobian.T @ weighted, jacobian.T).T  # G K⁻¹
        right = jnp.concatenate([(gamma - moved @ (force + weighted.T @ gamma))[:, None], -moved], axis=1)
        solved = eliminate(moved @ jacobian.T, right)
        read, zero = np.array(_multipliers_read(self.law, *state, solved[:, 0]), int), jnp.zeros_like(solved[:, 0])
        law = lambda some: self.law(*state, zero.at[read].set(some))  # noqa: E731
        return _solve_law(law, solved[read, 0], solved[read, 1:]) if read.size else self.law(*state, zero)


def _solve_law(of_read: Callable, alone, responses):
    """Q(λ) with λ = λ₀ + R Q(λ), for λ₀ (m,) and R (m, n) of multipliers that are read."""
    decisive, curved = _dependence(of_read, alone)
    zero, unit, count = jnp.zeros_like(alone), jnp.eye(len(alone), dtype=alone.dtype), len(alone)
    some = alone + responses @ of_read(zero) if decisive else zero
    before, single = some, count == 1 and not curved
    for _ in range(1 if single or not decisive else STEPS if curved else STEPS_OF_PIECES):
        value, slopes = of_read(some), jax.jacfwd(of_read)(some)
        coupling = unit - responses @ slopes
        change = eliminate(coupling, (alone + responses @ value - some)[:, None])[:, 0]
        force, some, before = value + slopes @ change, some + change, some
    if not decisive:
        return force
    if single:
        beyond = unit - responses @ jax.jacfwd(of_read)(-before)
        return jnp.where((coupling * beyond)[0, 0] > 0, force, jnp.nan)
    size = some**2 + jnp.sum((responses * force) ** 2, axis=1) + _NONE
    # The last step leaves the square of its change: rounding. As a border of the motion this number is to be the same
    # on both sides of all others, so that 1 is added.
    off = jnp.sum(change**2 / size) / jnp.finfo(size.dtype).eps
    return jnp.where(1.0 + off < 2.0, force, jnp.nan)


def _multipliers_read(law: Callable, *arguments) -> list[int]:
    """The places of the multipliers, the last argument of a law, that it reads; all where it has no program."""
    m, inputs = arguments[-1].size, sum(jnp.size(x) for x in jax.tree.leaves(arguments))
    try:
        program = lower(law, *arguments)
    except Unlowerable:
        return list(range(m))
    read = program.find_inputs(range(len(program.line.outputs)))
    return [i for i in range(m) if inputs - m + i in read]


def _dependence(law: Callable, multipliers) -> tuple[bool, bool]:
    """True if the slopes of a law by its multipliers depend on these; and if they do so but for their pieces."""

    def slopes(some):
        return jax.jacfwd(law)(some)

    curved = _inputs_read(lambda some, along: jax.jvp(slopes, (some,), (along,))[1], multipliers, multipliers)[1]
    return any(_inputs_read(slopes, multipliers)), curved


def _inputs_read(function: Callable, *arguments) -> list[bool]:
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1]


def eliminate(matrix, right):
    """X (n, k) of A X = B by elimination without a choice of pivots, which would be a border of the motion."""
    rows = []
    while len(matrix):
        factors = matrix[1:, 0] / matrix[0, 0]
        rows.append((matrix[0], right[0]))
        matrix, right = (x[1:] - factors[:, None] * x[0] for x in (matrix, right))
        matrix = matrix[:, 1:]
    solution = right  # no row is left
    for row, b in reversed(rows):
        solution = jnp.concatenate([((b - row[1:] @ solution) / row[0])[None], solution])
    return solution
