"""Constraints in flat coordinates: their equations, the distance of a state from them, and the projection onto them.

A scene has k constraints on positions and m − k on velocities, of n coordinates:

    f(q, t) = 0,  shape (k,)        a(q, q̇, t) = 0,  shape (m − k,)

Both are differentiated by the time until the acceleration appears linearly, f twice and a once:

    J q̇ + ∂f/∂t = 0,  J = ∂f/∂q                      the rate of f
    G q̈ = γ,          G = (J; ∂a/∂q̇), shape (m, n)   the constraint Jacobian and the acceleration-level right-hand side

A scene without constraints has m = 0 rows here, not a different kind of object. This file does not use the Lagrangian:
the mass matrix M, by which distances between states are measured, is an argument.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

Vector = Float[Array, " n"]  # one number for each coordinate
Row = Float[Array, " m"]  # one number for each constraint
Time = Float[Array, ""]


class Constraints(eqx.Module):
    """The constraint functions of a scene: f(q, t, params) → (k,) and a(q, qdot, t, params) → (m − k,), or None.

    q and qdot have shape (n,). Every result lists the constraints on positions first. `held(params)` (m,) is 1 for each
    row that is active and 0 for one that is released, as an open contact: its value, its rows of G and γ and its
    multiplier are then zero. `drag(q, qdot, t, params)` (n, m) is the force, in addition to Gᵀλ, that each multiplier
    causes, as friction does. `turns`: that force has the direction of a velocity in space.
    """

    on_positions: Callable | None = None
    on_velocities: Callable | None = None
    held: Callable | None = None
    drag: Callable | None = None
    turns: bool = eqx.field(static=True, default=False)

    @property
    def exist(self) -> bool:
        return self.on_positions is not None or self.on_velocities is not None

    def f(self, q: Vector, t: Time, params: PyTree) -> Float[Array, " k"]:
        return jnp.zeros(0, q.dtype) if self.on_positions is None else self.on_positions(q, t, params)

    def a(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Float[Array, " m-k"]:
        """The values of the constraints on velocities."""
        return jnp.zeros(0, q.dtype) if self.on_velocities is None else self.on_velocities(q, qdot, t, params)

    def residual(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Row:
        """The values f, then a: zero where the constraints are satisfied."""
        return jnp.concatenate([self.f(q, t, params), self.a(q, qdot, t, params)])

    def rates(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Row:
        """The rates J q̇ + ∂f/∂t, then a: zero where the velocities are consistent."""
        rate = jax.jvp(lambda q, t: self.f(q, t, params), (q, t), (qdot, jnp.ones_like(t)))[1]
        return jnp.concatenate([rate, self.a(q, qdot, t, params)])

    def driving(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Row:
        """The driving terms ∂f/∂t, then a(q, 0, t): a constraint does no work where its driving is zero."""
        by_t = jax.jvp(lambda t: self.f(q, t, params), (t,), (jnp.ones_like(t),))[1]
        return jnp.concatenate([by_t, self.a(q, jnp.zeros_like(qdot), t, params)])

    def jacobian(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Float[Array, "m n"]:
        """The constraint Jacobian G = (J; ∂a/∂q̇)."""
        return jnp.concatenate([jax.jacfwd(self.f)(q, t, params), jax.jacfwd(self.a, argnums=1)(q, qdot, t, params)])

    def gamma(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Row:
        """The right-hand side γ of G q̈ = γ: minus all terms of the time derivatives of f and a other than G q̈."""
        forward = qdot, jnp.ones_like(t)

        def rate(function):
            return lambda q, t: jax.jvp(function, (q, t), forward)[1]

        rates = rate(rate(lambda q, t: self.f(q, t, params))), rate(lambda q, t: self.a(q, qdot, t, params))
        return -jnp.concatenate([of(q, t) for of in rates])

    def products(self, q: Vector, qdot: Vector, t: Time, params: PyTree, positions=False) -> tuple[Callable, Callable]:
        """The functions x ↦ G x and λ ↦ Gᵀλ; with `positions`, of the constraints on positions only."""
        if positions:
            _, push = jax.linearize(lambda q: self.f(q, t, params), q)
        else:
            by_q = jax.linearize(lambda q: self.f(q, t, params), q)[1]
            by_qdot = jax.linearize(lambda qdot: self.a(q, qdot, t, params), qdot)[1]

            def push(x):
                return jnp.concatenate([by_q(x), by_qdot(x)])

        pull = jax.linear_transpose(push, q)
        return push, lambda y: pull(y)[0]


# ---- how far a state is from its constraints -------------------------------------------------------------------------

# The distance from a constraint, over the size of q or q̇, up to which a motion may start: an initial state that was
# computed or typed with six digits; in float32 one that forty roundings have made. The first projection takes care of
# it, of up to `_native.START`. It would also take care of more, but by moving the start elsewhere.
TOLERANCE = {np.dtype("float64"): 1e-6, np.dtype("float32"): 5e-6}

# A constraint also holds if its value is at most `ROUNDINGS` roundings of its own terms, whatever the size of q:
# coordinates that are deviations from a drawn pose begin at zero, with links of a metre. The bound for float32 above is
# as many. Doubled, a link of a kilometre may be wrong by 18 nm instead of 9.
ROUNDINGS = 40


def is_inconsistent(motion, state: tuple, span, dtype, terms) -> Bool[Array, ""]:
    """True if no motion over this time span may start from a state: it violates a constraint, or one has no gradient.

    It violates one if it is farther away than `TOLERANCE` of the size of the state, and the value is more than
    `ROUNDINGS` of the `terms` (2m,) of `residual` and of `rates` (see `Derivation.term_sizes`), in a start of this
    dtype. A state that is not a number is inconsistent.
    """
    (q, qdot, t, params), of, unit = state, motion.constraints, motion.unit(*state)
    values, lengths = jnp.stack([of.residual(*state), of.rates(*state)]), motion.row_lengths(unit, *state)
    off = jnp.stack(distances(values[0], values[1], lengths, of.f(q, t, params).size))
    near = off <= TOLERANCE[dtype] * jnp.stack(sizes(unit, q, qdot, span))[:, None]
    rounded = jnp.abs(values) <= ROUNDINGS * np.finfo(dtype).eps * rows_of_terms(terms, values.shape)
    return ~jnp.all((near | rounded) & (lengths > 0))


def exceeds(left: Row, lengths: Row, terms, unit: Vector, *accelerations: Vector) -> Bool[Array, " m"]:
    """For each constraint: the residual `left` of G q̈ − γ (m,) exceeds `TOLERANCE` and the rounding of its `terms`."""
    dtype = np.dtype(left.dtype)
    rounding = ROUNDINGS * np.finfo(dtype).eps * rows_of_terms(terms, left.shape)
    return left > jnp.maximum(TOLERANCE[dtype] * lengths * _size(unit, *accelerations), rounding)


def sizes(unit, q, qdot, span):
    """The sizes of q and of q̇, (…) each: the largest coordinate in its `unit` (…, n), 1/√Mᵢᵢ.

    The size of the velocities is at least that of q divided by the time span. Takes q and qdot (…, n) of NumPy or JAX.
    """
    xp = unit.__array_namespace__()
    of_q, of_qdot = (xp.max(xp.abs(x / unit), axis=-1) for x in (q, qdot))
    return of_q, xp.maximum(of_qdot, of_q / span)


def distances(residual, rates, lengths, positions: int):
    """The distances of positions and velocities from each constraint, two arrays (..., m).

    The ratio |fₖ|/|∂fₖ/∂q| has the units of a coordinate, which fₖ has not: to first order q has to move so far. The
    rates divided by the same `lengths` of the rows of G are, likewise, velocities. Constraints on velocities do not
    restrict q. Takes arrays (..., m) of NumPy or JAX; the first `positions` of the m are f. A satisfied constraint is
    at distance zero, even without a gradient; otherwise that is infinity.
    """
    xp = lengths.__array_namespace__()
    of_positions = xp.where(xp.arange(residual.shape[-1]) < positions, residual, 0)
    of_q, of_qdot = (xp.where(x == 0, 0, xp.abs(x) / xp.where(x == 0, 1, lengths)) for x in (of_positions, rates))
    return of_q, of_qdot


def rows_of_terms(terms, shape: tuple[int, ...]):
    """The sizes of the terms of some quantities of m constraints, (…, m); 0 for a scene without programs."""
    xp = np if isinstance(terms, float | np.ndarray) else jnp
    return xp.reshape(xp.broadcast_to(terms, math.prod(shape)), shape)


def velocity_scales(diagonal: Vector, jacobian: Float[Array, "m k"], qdot: Vector, touched: np.ndarray) -> Vector:
    """The velocity scales (k,) of the `touched` coordinates for an error norm: the speeds that others cause through G.

    In constraint k, coordinate j contributes Gₖⱼ q̇ⱼ, which corresponds to the velocity |Gₖⱼ q̇ⱼ / Gₖᵢ| of coordinate
    i; the largest over j is the scale that k gives to i, and the smallest over k counts. So a coupler that does not
    turn is as exact as the cranks that carry it, and not relative to its own velocity, which is rounding. Where Gₖᵢ
    happens to pass through zero that grows without bound; it is therefore limited by maxⱼ √(Mⱼⱼ/Mᵢᵢ) |q̇ⱼ|, the
    velocity of equal kinetic energy. Zero for coordinates in no constraint. `diagonal` (n,) is that of M.
    """
    by_constraints = jnp.min(_largest_term(jacobian * qdot[touched], jacobian), axis=0)
    root = jnp.sqrt(jnp.abs(diagonal))[None]
    by_energy = _largest_term(root * qdot, root[:, touched])[0]
    return jnp.where(by_constraints < jnp.inf, jnp.minimum(by_constraints, by_energy), 0.0)


def _largest_term(terms, weights):
    """The maximum over j of |termsₖⱼ|, divided by |weightsₖᵢ|, shape (m, n); infinite where a weight is zero."""
    nonzero = weights != 0
    largest = jnp.max(jnp.abs(terms), axis=1, keepdims=True)
    return jnp.where(nonzero, largest / jnp.abs(jnp.where(nonzero, weights, 1.0)), jnp.inf)


# ---- the way back ----------------------------------------------------------------------------------------------------


# Newton's method doubles its digits from where it converges, and needs 4 to 8 steps from anywhere near; 300 times the
# size of a circle away it takes 16. Doubled, this changes nothing but the time that is lost where there is no solution.
_NEWTON_STEPS = 50


def nearest_consistent(motion, q: Vector, qdot: Vector, t: Time, params: PyTree, terms=0.0) -> tuple[Vector, Vector]:
    """The consistent state of a `Motion` nearest to (q, q̇), shape (n,) each; NaN where it is not found.

    q̂ minimises (q̂ − q)ᵀM(q̂ − q) with M = M(q, q̇) among all with f = 0, and then the velocities minimise the same form
    with M = M(q̂, q̇) among all that are consistent at q̂. The derivatives are those of that function, to every order:
    q̂ is a root of `_stationary`, and differentiated implicitly. A state that is not found has NaN for derivatives.
    `terms` (2m,) are the sizes of the terms of `residual` and of `rates`, of which rounding is left.
    """
    constraints, given = motion.constraints, qdot
    of_f, of_rates = rows_of_terms(terms, (2, len(constraints.residual(q, qdot, t, params))))
    if constraints.on_positions is not None:
        q = _nearest_positions(motion, q, qdot, t, params, of_f)
    unit = motion.unit(q, qdot, t, params)
    qdot = qdot + motion.velocity_step(q, qdot, t, params)
    rates, lengths = constraints.rates(q, qdot, t, params), motion.row_lengths(unit, q, qdot, t, params)
    reached = _constraints_hold(rates, lengths, of_rates, unit, qdot, given)
    return q, qdot * jnp.where(reached, 1.0, jnp.nan)  # a product, so that derivatives are NaN as well


def _nearest_positions(motion: Any, q0, qdot, t, params, terms) -> Vector:
    """The q with f = 0 nearest to q0 in the metric of M(q0, q̇), by Newton's method for M (q − q0) + Jᵀν = 0, f = 0.

    These are the conditions of the constrained minimum (sequential quadratic programming: Nocedal & Wright, *Numerical
    Optimization*, §18.1). The method starts where shortest steps to f = 0 alone converge, since its own steps diverge
    far away. NaN where either does not converge, or where the second converges farther away: at another stationary
    point.

    The loop is written here and its derivative is `jax.lax.custom_root`'s. `optimistix.root_find` with its `Newton`, an
    own solver for `lineax` (theirs call LAPACK, see `_linear`) and `ImplicitAdjoint` was measured instead. Its
    derivatives are right to every order, but it loses three things. A member of a batch that has no nearest state makes
    the derivative of the whole batch raise, from a call back to the host: lineax solves for tangents with `throw=True`.
    Its test of convergence compares f and M (q − q0) with the tolerance for q: masses of 1e6 do not converge. And from
    44 radii outside a circle it does not converge without the first loop.
    """
    constraints, start = motion.constraints, (q0, qdot, t, params)
    multiply = motion.mass_product(*start)
    unit = jax.lax.stop_gradient(motion.unit(*start))

    def lengths(q):
        return motion.row_lengths(unit, q, qdot, t, params, positions=True)

    # The size of the terms, as a distance: where q is smaller it is their rounding that moves it.
    of_rows, terms = jax.lax.stop_gradient(lengths(q0)), terms[: constraints.f(q0, t, params).size]
    least = jnp.max(jnp.where(terms > 0, terms / of_rows, 0.0), initial=0.0)

    def resolution(q):
        return _AT_REST * jnp.finfo(q.dtype).eps * jnp.maximum(_size(unit, q, q0), least)

    def is_at_rest(q, moved):
        return jnp.max(jnp.abs(moved / unit)) <= resolution(q)

    def stationary(place):
        q, nu = place
        f, pull_back = jax.vjp(lambda q: constraints.f(q, t, params), q)
        return multiply(q - q0) + pull_back(nu)[0], f

    def solve(linear, right):
        return motion.solve_newton(linear, right, *start)

    def shortest_step(place):
        q, nu = place
        return q + motion.position_step(q, qdot, t, params), nu

    def newton_step(place):
        value, linear = jax.linearize(stationary, place)
        return jax.tree.map(jnp.subtract, place, solve(linear, value))

    def find(_, start):
        nearby = _iterate_to_rest(shortest_step, start, is_at_rest)
        q, nu = _iterate_to_rest(newton_step, (nearby[0], start[1]), is_at_rest)

        def distance(q):
            return jnp.sqrt((q - q0) @ multiply(q - q0))

        # For a q0 that is consistent both distances are round-off.
        farther = distance(q) > 1.001 * distance(nearby[0]) + resolution(q) * q.size
        holds = _constraints_hold(constraints.f(q, t, params), lengths(q), terms, unit, q, q0)
        return jnp.where(holds & ~farther, q, jnp.nan), nu

    begin = q0, jnp.zeros_like(constraints.f(q0, t, params))
    return jax.lax.custom_root(stationary, begin, find, solve)[0]


def _iterate_to_rest(step: Callable, start: tuple[Vector, Row], is_at_rest: Callable) -> tuple[Vector, Row]:
    """Repeat `step` on (q, ν) until q moves no more than rounding; q is NaN if it does not converge."""

    def moves(carry):
        (q, _), moved, count = carry
        return ~is_at_rest(q, moved) & (count < _NEWTON_STEPS)

    def once(carry):
        place, _, count = carry
        new = step(place)
        return new, new[0] - place[0], count + 1

    (q, nu), moved, _ = jax.lax.while_loop(moves, once, (start, jnp.full_like(start[0], jnp.inf), 0))
    return jnp.where(is_at_rest(q, moved), q, jnp.nan), nu


def _constraints_hold(residual: Row, lengths: Row, terms: Row, unit: Vector, *states: Vector) -> Bool[Array, ""]:
    """True if the constraints are satisfied, as opposed to small steps between constraints that contradict each other.

    A distance of √eps of the state is allowed: the last step of Newton's method was at the level of rounding, so that
    constraints which can hold do so far better, and those that contradict each other are off by far more. The second
    term is for a gradient that vanishes, where rounding of the others' size is the limit. Coordinates are in their
    `unit` (n,), and so are the `lengths` (m,) of the rows of G, and as large as in any of the states (n,). Rounding of
    `terms` (m,) is allowed as well.
    """
    eps = jnp.finfo(residual.dtype).eps
    allowed = jnp.sqrt(eps) * lengths + 100 * eps * jnp.max(lengths)
    return jnp.all(jnp.abs(residual) <= jnp.maximum(allowed * _size(unit, *states), ROUNDINGS * eps * terms))


def _size(unit: Vector, *states: Vector) -> Float[Array, ""]:
    """The largest coordinate of some states (n,), in the `unit` (n,) of each."""
    return jnp.max(jnp.abs(jnp.stack(states) / unit))


# Steps of q at which Newton's method is at rest, in units of round-off of the largest coordinate. Those of a converged
# method are some eps times the condition of the scaled saddle point; below 16 an occasional one would not come to rest
# and count as not found, and twice that still leaves all but one digit.
_AT_REST = 16
