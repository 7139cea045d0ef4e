"""Forces that depend on the multipliers of the constraints, such as dry friction on a wire: Q(q, q̇, t, λ).

M q̈ = F + Q + Gᵀλ and G q̈ = γ make the multipliers linear in the force, and with that Q is a function of the state:

    λ = λ₀ + R Q(λ),    R = −S⁻¹ G K⁻¹,    S = G K⁻¹ Gᵀ,    K = M + Gᵀ W G        (see `_linear` for W)

A force linear in λ needs one linear solve. So does one that is piecewise linear in a single multiplier with a kink at
zero, as μ|λ|: as long as R Q grows more slowly than λ, the piece is that of λ₀, and none depends on the direction in
which friction acts. Otherwise, as for the length √(λ₁² + λ₂²) of a bearing's force, and for min(μ|λ|, Q₁), a bounded
number of Newton steps is taken, and the last is tested. If no solution is found, or a single multiplier has two
(Painlevé's paradox), Q is NaN.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import PyTree

from lagjax._program import Unlowerable
from lagjax._tracing import lower

# Steps of Newton's method. Each squares what is missing, times the part of λ that the force makes: from a tenth the
# fourth is exact, from nine tenths the seventh; series of the motion converge alike. Pieces are known after one or two.
STEPS, STEPS_OF_PIECES = 7, 3
_NONE = 1e-30  # of a multiplier's square: nothing pushes


class CoupledForces(eqx.Module):
    """The force Q(q, qdot, t, params) (n,) with the multipliers that it causes in the motion `free` of it.

    `law(q, qdot, t, params, multipliers)` takes these as an array (m,).
    """

    law: Callable
    free: Any  # a `Motion`

    def __call__(self, q, qdot, t, params: PyTree):
        state, of = (q, qdot, t, params), self.free
        matrix, force = of.mass_matrix_and_force(*state)
        return self.solve(matrix, force, of.constraints.jacobian(*state), of.constraints.gamma(*state), *state)

    def solve(self, matrix, force, jacobian, gamma, *state):
        """The force Q, from M, F, G and γ of the free motion."""
        squares, held = jnp.sum(jacobian**2, axis=1), self.free.constraints.held
        released = None if held is None else 1.0 - held(state[-1])  # rows of G that are zero, with no multiplier
        weights = jnp.trace(matrix) / (squares if released is None else squares + released)
        weighted = weights[:, None] * jacobian
        moved = eliminate(matrix + jacobian.T @ weighted, jacobian.T).T  # G K⁻¹
        right = jnp.concatenate([(gamma - moved @ (force + weighted.T @ gamma))[:, None], -moved], axis=1)
        schur = moved @ jacobian.T
        solved = eliminate(schur if released is None else schur + jnp.diag(released), right)
        zero = jnp.zeros_like(solved[:, 0])
        places, at_zero = _find_multipliers_read(self.law, *state, zero)
        read = np.array(places, int)
        law = lambda some: self.law(*state, zero.at[read].set(some))  # noqa: E731
        return _solve_law(law, solved[read, 0], solved[read, 1:], at_zero) if read.size else self.law(*state, zero)


def couple_forces(motion, law: Callable, layout, params: PyTree):
    """The motion with forces by a `law` as in `CoupledForces`, of all multipliers.

    If rows may be released, as those of contacts, and the law is linear in the multipliers, the force of each is a
    column of `drag`: one linear system, which leaves out rows that depend on others.
    """
    constraints = motion.constraints
    rest, numbers = jnp.zeros(layout.size, layout.dtype), eqx.filter(params, eqx.is_array_like)
    state = rest, rest, jnp.zeros((), layout.dtype), numbers
    # A number of no trace: the laws below outlive the one, as of `jit`, in which they are made.
    zero = np.zeros(jax.eval_shape(constraints.residual, *state).size, layout.dtype)

    def force_alone(*state):
        return law(*state, jnp.asarray(zero))

    if not zero.size:
        return dataclasses.replace(motion, forces=force_alone)
    if constraints.held is None:
        return dataclasses.replace(motion, forces=CoupledForces(law, motion))
    own = constraints.drag
    if any(_slopes_depend_on_multipliers(lambda some: law(*state, some), jnp.asarray(zero))):
        free = dataclasses.replace(motion, constraints=dataclasses.replace(constraints, drag=None))
        rubbing = law if own is None else (lambda *given: law(*given) + own(*given[:-1]) @ given[-1])
        return dataclasses.replace(free, forces=CoupledForces(rubbing, free))

    def drag(*state):
        brought = jax.jacfwd(law, argnums=4)(*state, jnp.asarray(zero))
        return brought if own is None else brought + own(*state)

    both = dataclasses.replace(constraints, drag=drag)
    return dataclasses.replace(motion, forces=force_alone, constraints=both)


def _solve_law(of_read: Callable, alone, responses, at_zero: bool):
    """The force Q(λ) with λ = λ₀ + R Q(λ), for λ₀ (m,) and R (m, n) of the multipliers that the law reads.

    `at_zero`: all kinks of the law are at zero.
    """
    decisive, curved = _slopes_depend_on_multipliers(of_read, alone)
    zero, unit, count = jnp.zeros_like(alone), jnp.eye(len(alone), dtype=alone.dtype), len(alone)
    some = alone + responses @ of_read(zero) if decisive else zero
    before, single = some, count == 1 and at_zero and not curved
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


def _find_multipliers_read(law: Callable, *arguments) -> tuple[list[int], bool]:
    """The indices of the multipliers that a law reads (all if it has no program), and a flag: its kinks are at zero."""
    m, inputs = arguments[-1].size, sum(jnp.size(x) for x in jax.tree.leaves(arguments))
    try:
        program = lower(law, *arguments)
    except Unlowerable:
        return list(range(m)), False
    read = program.find_inputs(range(len(program.line.outputs)))
    places = [i for i in range(m) if inputs - m + i in read]
    if len(places) != 1:
        return places, False
    # Of pieces a few sizes tell, at a state that nothing speaks for.
    sizes, columns = 2.0 ** np.arange(-20, 21), list(np.random.default_rng(0).uniform(0.3, 1.2, (inputs, 1)))
    columns[inputs - m + places[0]] = sizes = np.concatenate([[0.0], sizes, -sizes])
    values = program.evaluate_many(columns)
    slopes = np.stack(np.split((values[:, 1:] - values[:, :1]) / sizes[1:], 2, axis=1))
    return places, bool((np.ptp(slopes, axis=2) <= 1e-6 * np.abs(slopes).max()).all())


def _slopes_depend_on_multipliers(law: Callable, multipliers) -> tuple[bool, bool]:
    """Two flags: the slopes of a law by its multipliers depend on these; they do so within a piece."""

    def slopes(some):
        return jax.jacfwd(law)(some)

    curved = _find_inputs_read(lambda some, along: jax.jvp(slopes, (some,), (along,))[1], multipliers, multipliers)[1]
    return any(_find_inputs_read(slopes, multipliers)), curved


def _find_inputs_read(function: Callable, *arguments) -> list[bool]:
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1]


def eliminate(matrix, right):
    """X (n, k) with A X = B, by elimination without pivoting, since a choice of pivots would be a border."""
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
