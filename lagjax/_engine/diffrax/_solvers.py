"""Two wrappers around the solvers of diffrax: a better dense output, and steps that end on the constraints.

`FineOutput` makes the states *between* steps better and leaves the steps as they are. The interpolant that comes with
`diffrax.Dopri8` is of order five or six, the method of order eight: at tight tolerances it loses a factor of 30 to 1000
against the ends of the steps.

`Projected` projects the state onto its constraints after each step.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


class _SolverWrapper(diffrax.AbstractAdaptiveSolver):
    """The parts that a wrapper leaves to the `solver` inside it: all but the step, its terms and its dense output."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    def order(self, terms) -> int | None:
        return self.solver.order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


# The points inside a step, in equal parts. At Lobatto's nodes the slopes alone would fix yₙ₊₁, and a polynomial through
# them could not take the solver's yₙ₊₁ as well.
_INSIDE = (0.2, 0.4, 0.6, 0.8)


def _correction_weights() -> np.ndarray:
    """The (4, 4) weights that turn residual slopes at `_INSIDE` into the coefficients of C, of degree three.

    θ²(1−θ)² C(θ) has these slopes there, and neither value nor slope at the ends.
    """
    places = np.array(_INSIDE)[:, None]
    powers = np.arange(4)
    bump, bump_slope = (places * (1 - places)) ** 2, 2 * places * (1 - places) * (1 - 2 * places)
    return np.linalg.inv(bump_slope * places**powers + bump * powers * places ** np.maximum(powers - 1, 0))


_CORRECTION = _correction_weights()


class _CorrectedHermite(diffrax.AbstractLocalInterpolation):
    """Hermite's cubic through both ends of a step plus θ²(1−θ)² C(θ), which does not change the ends.

    It is not written as a sum of powers of θ, which would lose three digits to cancellation.
    """

    t0: jax.Array
    t1: jax.Array
    y0: PyTree
    y1: PyTree
    first: PyTree
    last: PyTree
    correction: PyTree

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        span = self.t1 - self.t0
        x = jnp.where(span == 0, 0, (t0 - self.t0) / jnp.where(span == 0, 1, span))

        def value(y0, y1, first, last, c):
            z = x.astype(y0.dtype)
            cubic = z * z * (3 - 2 * z) * (y1 - y0) + z * (1 - z) * ((1 - z) * first - z * last)
            bump = (z * (1 - z)) ** 2 * (((c[3] * z + c[2]) * z + c[1]) * z + c[0])
            return jnp.where(z == 1, y1, y0 + (cubic + bump))

        return jax.tree.map(value, self.y0, self.y1, self.first, self.last, self.correction)


class FineOutput(_SolverWrapper):
    r"""The steps of an explicit Runge–Kutta solver of diffrax, with better states between them.

    The solver's own interpolant gives states at four points inside the step, the equations give the slopes there, and
    the polynomial of degree seven through yₙ, yₙ₊₁, the slopes at both ends and these four slopes is the new
    interpolant: one order higher than that of the states at which the slopes were taken. For `Dopri8` its error is 5 to
    70 times smaller than that of the solver's own interpolant, and a few times that of the steps. It costs four
    evaluations of the right-hand side per step: use it where states between steps are wanted.

    `solver` is any explicit solver whose last slope is taken at the end of the step (FSAL), such as `diffrax.Dopri8()`
    or `diffrax.Tsit5()`; it integrates a single `ODETerm`. Raises `TypeError` for any other.

    Source: Enright, Jackson, Nørsett & Thomsen, *Interpolants for Runge–Kutta formulas*, ACM TOMS 12 (1986) 193–218,
    §3 (boot-strapping).

    ```python
    import diffrax, jax.numpy as jnp, lagjax

    diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: -y),
        lagjax.FineOutput(diffrax.Dopri8()),
        0.0, 5.0, None, jnp.array(1.0),
        saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, 5.0, 50)),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
    )
    ```
    """

    solver: diffrax.AbstractERK

    interpolation_cls: ClassVar[Callable] = _CorrectedHermite

    def __check_init__(self):
        explicit = isinstance(self.solver, diffrax.AbstractERK)
        tableau = self.solver.tableau if explicit else None
        if not isinstance(tableau, diffrax.ButcherTableau) or not tableau.fsal:
            raise TypeError(f"FineOutput takes an explicit FSAL Runge-Kutta solver of diffrax; got {self.solver!r}.")

    @property
    def term_structure(self):
        return diffrax.ODETerm

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """The solver's step, and the polynomial through it and through the slopes at four points inside it."""
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        interpolant, span = self.solver.interpolation_cls(t0=t0, t1=t1, **dense), terms.contr(t0, t1)

        def increment(place):
            t = t0 + place * (t1 - t0)
            slope = terms.vf_prod(t, interpolant.evaluate(t), args, span)
            return jax.tree.map(lambda leaf, like: leaf.astype(like.dtype), slope, y0)

        def correction(y0, y1, k, inside):
            places = jnp.asarray(_INSIDE, y0.dtype).reshape(-1, *[1] * y0.ndim)
            other = 1 - places  # the slope of Hermite's cubic there: from y1 − y0, then from the slopes at both ends
            slopes = (
                6 * places * other * (y1 - y0) + other * (1 - 3 * places) * k[0] + places * (3 * places - 2) * k[-1]
            )
            residuals = inside - slopes
            return jnp.tensordot(jnp.asarray(_CORRECTION, y0.dtype), residuals, axes=1)

        # A loop, as XLA compiles each call of the equations anew.
        inside = jax.lax.map(increment, jnp.asarray(_INSIDE, jnp.result_type(t0)))
        first, last = (jax.tree.map(lambda k, i=i: k[i], dense["k"]) for i in (0, -1))
        polynomial = jax.tree.map(correction, y0, y1, dense["k"], inside)
        coefficients = {"y0": y0, "y1": y1, "first": first, "last": last, "correction": polynomial}
        return y1, error, coefficients, state, result


class Projected(_SolverWrapper):
    """The steps of a solver, each followed by a projection of the state (2n,): `project(t, y, args)`, a Newton step.

    Two Newton steps are taken, the second of which says whether the method converges. Where it does not, the state is
    NaN, so that the step is rejected; where no step can be rejected (fixed steps), the run ends with `breakdown`. The
    distance between the solver's state and the projected one is added to the error of the step:
    a constraint that jumps is then refused and not followed. The states inside a step are those of the solver.
    """

    solver: diffrax.AbstractSolver
    project: Callable

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Callable:
        return self.solver.interpolation_cls

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """The solver's step, then two Newton steps. No FSAL: the last slope is not that of the new state."""
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, True)

        def take_newton_step(y, _):
            y = self.project(t1, y, args)
            return y, y

        _, (near, nearer) = jax.lax.scan(take_newton_step, y1, length=2)
        failed = ~_newton_contracts(y1, near, nearer)
        if error is not None:
            error = jnp.abs(error) + jnp.abs(near - y1)
        arrays, others = eqx.partition((nearer, error, dense), eqx.is_inexact_array)
        lost = jax.tree.map(lambda leaf: jnp.where(failed, jnp.nan, leaf), arrays)
        y1, error, dense = eqx.combine(lost, others)
        # `breakdown` is the only code of diffrax that none of its own solvers returns.
        projection: Any = diffrax.RESULTS.where(failed, diffrax.RESULTS.breakdown, diffrax.RESULTS.successful)  # type: ignore
        return y1, error, dense, state, diffrax.RESULTS.where(result == diffrax.RESULTS.successful, projection, result)


def _newton_contracts(start: jax.Array, near: jax.Array, nearer: jax.Array) -> jax.Array:
    """True if Newton's method converges: its second step is a hundredth of its first, or rounding.

    Near a solution the method squares the distance; from too far away a step covers half of it at best, which a
    hundredth tells apart with room on both sides. A step of a thousand units of round-off counts as converged: so much
    the condition of the saddle point may leave.
    """
    first, second, *sizes = (jnp.max(jnp.abs(x)) for x in (near - start, nearer - near, nearer, start))
    return second <= jnp.maximum(0.01 * first, 1e3 * float(jnp.finfo(start.dtype).eps) * jnp.maximum(*sizes))
