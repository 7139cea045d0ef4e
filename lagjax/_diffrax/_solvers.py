"""Wrappers around the solvers of diffrax. Neither changes the size of the steps that are taken.

`FineOutput` makes the states *between* steps better. The interpolant that comes with `diffrax.Dopri8` is of order five
or six, the method of order eight: at tight tolerances it loses a factor of 30 to 1000 against the ends of the steps.

`Projected` puts the state back on its constraints after each step.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

PyTree = Any


class FineOutput(diffrax.AbstractAdaptiveSolver):
    r"""The steps of an explicit Runge–Kutta solver of diffrax, with better states between them.

    The solver's own interpolant gives states at four points inside the step, the equations give the slopes there, and
    the polynomial of degree seven through yₙ, yₙ₊₁, the slopes at both ends and these four slopes is the new
    interpolant: one order better than the states that the slopes were taken at, and closer than order tells. For
    `Dopri8` its error is 5 to 70 times smaller than that of the solver's own, and a few times that of the steps. The
    price is four evaluations of the right-hand side a step: use it where states between steps are wanted.

    `solver` is any explicit one whose last slope is taken at the end of the step (FSAL): `diffrax.Dopri8()`,
    `diffrax.Tsit5()`. For a single `ODETerm`. Raises `TypeError` for any other.

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

    interpolation_cls: ClassVar[Callable]

    def __check_init__(self):
        explicit = isinstance(self.solver, diffrax.AbstractERK)
        tableau = self.solver.tableau if explicit else None
        if not isinstance(tableau, diffrax.ButcherTableau) or not tableau.fsal:
            raise TypeError(f"FineOutput takes an explicit FSAL Runge-Kutta solver of diffrax; got {self.solver!r}.")

    @property
    def term_structure(self):
        """One term, of an ordinary differential equation."""
        return diffrax.ODETerm

    def order(self, terms) -> int | None:
        """The order of the solver."""
        return self.solver.order(terms)

    def init(self, terms, t0, t1, y0, args):
        """The state of the solver."""
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        """The slope."""
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """The solver's step, and the slopes inside it."""
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        rough, span = self.solver.interpolation_cls(t0=t0, t1=t1, **dense), terms.contr(t0, t1)

        def increment(place):
            t = t0 + place * (t1 - t0)
            return _in_dtype_of(y0, terms.vf_prod(t, rough.evaluate(t), args, span))

        def correction(y0, y1, k, *inside):
            cubic = (_hermite_slope(place, y1 - y0, k[0], k[-1]) for place in _INSIDE)
            missing = [slope - guess for slope, guess in zip(inside, cubic, strict=True)]
            return jnp.tensordot(jnp.asarray(_CORRECTION, y0.dtype), jnp.stack(missing), axes=1)

        increments = dense["k"]
        ends = {"first": _pick(increments, 0), "last": _pick(increments, -1)}
        polynomial = jax.tree.map(correction, y0, y1, increments, *map(increment, _INSIDE))
        return y1, error, {"y0": y0, "y1": y1, **ends, "correction": polynomial}, state, result


# Equal parts: with the nodes of Lobatto the slopes alone would fix yₙ₊₁, and no polynomial would meet it as well.
_INSIDE = (0.2, 0.4, 0.6, 0.8)


def _correction_weights() -> np.ndarray:
    """Weights that turn missing slopes at `_INSIDE` into the coefficients of C in θ²(1−θ)² C(θ), C of degree three."""
    places = np.array(_INSIDE)[:, None]
    powers = np.arange(4)
    bump, bump_slope = (places * (1 - places)) ** 2, 2 * places * (1 - places) * (1 - 2 * places)
    return np.linalg.inv(bump_slope * places**powers + bump * powers * places ** np.maximum(powers - 1, 0))


_CORRECTION = _correction_weights()


def _hermite_slope(place, rise, first, last):
    """The slope at `place` of the cubic that rises from 0 to `rise` with the slopes `first` and `last` at its ends."""
    return (
        6 * place * (1 - place) * rise
        + (1 - place) * (1 - 3 * place) * first
        + place * (3 * place - 2) * last
    )  # fmt: skip


class _Polynomial(diffrax.AbstractLocalInterpolation):
    """Hermite's cubic through both ends of a step, and θ²(1−θ)² C(θ), which leaves the ends alone.

    Written as a sum of single powers the polynomial would lose three digits to cancellation.
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


FineOutput.interpolation_cls = _Polynomial


def _pick(stacked: PyTree, index: int) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[index], stacked)


class Projected(diffrax.AbstractAdaptiveSolver):
    """The steps of a solver, each followed by a projection of the state: `project(t, y, args)` → y, one Newton step.

    It is taken twice: the second says whether Newton's method arrives. Where it does not the state is NaN, which makes
    the step one to reject; if that cannot be (fixed steps), the run ends with `Projected.FAILED`. How far the state was
    moved is a part of the error of the step, so that a constraint that jumps is not followed by a jump. The states
    inside a step are those of the solver.
    """

    solver: diffrax.AbstractSolver
    project: Callable

    # The one of diffrax's codes that none of its solvers gives.
    FAILED: ClassVar[Any] = diffrax.RESULTS.breakdown

    @property
    def term_structure(self):
        """That of the solver."""
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Callable:
        """That of the solver."""
        return self.solver.interpolation_cls

    def order(self, terms) -> int | None:
        """The order of the solver."""
        return self.solver.order(terms)

    def init(self, terms, t0, t1, y0, args):
        """The state of the solver."""
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        """The slope."""
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """The solver's step, then the projection. A slope kept from the step before belongs to another state."""
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, True)
        near = self.project(t1, y1, args)
        nearer = self.project(t1, near, args)
        failed = ~_contracts(y1, near, nearer)
        if error is not None:
            error = jax.tree.map(lambda e, a, b: jnp.abs(e) + jnp.abs(b - a), error, y1, near)
        y1, error, dense = _nan_where(failed, (nearer, error, dense))
        lost = diffrax.RESULTS.where(failed, self.FAILED, diffrax.RESULTS.successful)
        return y1, error, dense, state, diffrax.RESULTS.where(result == diffrax.RESULTS.successful, lost, result)


def _contracts(start: PyTree, near: PyTree, nearer: PyTree) -> jax.Array:
    """Whether the second of two steps is far shorter than the first, or round-off: a third would be nothing.

    Newton's method squares a distance that is small enough; from too far away it goes half the way at best.
    """
    first, second = (
        jnp.max(jnp.stack([jnp.max(jnp.abs(b - a)) for a, b in zip(*map(jax.tree.leaves, pair), strict=True)]))
        for pair in ((start, near), (near, nearer))
    )
    leaves = jax.tree.leaves(nearer)
    size = 1 + jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in leaves]))
    return second <= jnp.maximum(0.01 * first, 1e3 * float(jnp.finfo(leaves[0].dtype).eps) * size)


def _nan_where(failed, tree: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.where(failed, jnp.nan, leaf) if eqx.is_inexact_array(leaf) else leaf, tree)


def _in_dtype_of(y, increment):
    return jax.tree.map(lambda leaf, like: leaf.astype(like.dtype), increment, y)
