"""What happens to velocities at an instant: impulses of contacts that touch.

With G the rows of all constraints, gaps, one-way velocities and slips (m, n), q̇⁺ = q̇ + M⁻¹ Gᵀ E Λ, where E adds the
friction −μ c of a contact that slides to its normal impulse. Newton's law of restitution with Coulomb friction, for all
contacts that touch at once, asks for

    ġ⁺ + e ġ⁻ ≥ 0  ⟂  Λ ≥ 0        |F| ≤ μ Λ,  F = −μ Λ s⁺/|s⁺| where s⁺ ≠ 0

`find_pattern` finds which contacts push and stick, by projected relaxation; `change_velocities` solves for what they
do, and has derivatives. Source: Moreau, in *Nonsmooth Mechanics and Applications* (1988), §11; Glocker, *Set-Valued
Force Laws* (2001), ch. 9; Jean, Comput. Methods Appl. Mech. Engrg. 177 (1999) 235 (relaxation).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import solve_general
from lagjax._scene import Contacts

# Sweeps of the relaxation, and when it ends, as a part of the largest velocity. Chains of contacts converge slowly; one
# that has not, after twice as many, would not either.
SWEEPS, SETTLED = 2000, 1e-15
# By how much of the largest a solution may miss an inequality: some hundred roundings of a solved system.
MISSES = 1e-11


class Rows(NamedTuple):
    """The rows of all constraints at a state, (m, n), and their rates at velocities q̇, (m,); M (n, n).

    Those of the k contacts are at `normal` (k,), those of the slips of r of them, `rough`, at `tangential` (r, d).
    """

    mass: Any
    jacobian: Any
    rates: Any
    normal: np.ndarray
    tangential: np.ndarray
    rough: np.ndarray

    @property
    def still(self) -> "Rows":
        """The rows without derivatives."""
        return Rows(*jax.lax.stop_gradient(tuple(self[:3])), *self[3:])

    @property
    def contact_rows(self) -> np.ndarray:
        return np.concatenate([self.normal, self.tangential.ravel()])


class Pattern(NamedTuple):
    """What contacts do in an impact: `push` (k,), `sticks` (r,), the `direction` (r, d) in which the others slide."""

    push: Any
    sticks: Any
    direction: Any


def responses(rows: Rows):
    """M⁻¹ Gᵀ (n, m)."""
    return solve_general(rows.mass, rows.jacobian.T)


def change_velocities(rows: Rows, held, targets, pattern: Pattern, friction):
    """δq̇ (n,) and the impulses (m,) by which the rates of the rows `held` (m,) become their `targets` (m,).

    Rows that depend on those before them add nothing. The impulse of a row that is not held is zero, that of a contact
    that slides brings its friction.
    """
    inverse = responses(rows)
    slides = friction * pattern.push[rows.rough] * (1.0 - pattern.sticks)
    schur = rows.jacobian @ inverse
    held = held * jax.lax.stop_gradient(_independent(schur, held))

    def impulses_along(direction):
        mixed = jnp.eye(len(rows.rates))
        if rows.rough.size:
            columns = rows.normal[rows.rough][:, None]
            mixed = mixed.at[rows.tangential, columns].add(-slides[:, None] * direction)
        matrix = held[:, None] * (schur @ mixed) + jnp.diag(1.0 - held)
        return mixed @ solve_general(matrix, held * (targets - rows.rates))

    direction = pattern.direction
    if direction.shape[-1] == 2:
        direction = _turn_directions(rows, schur, impulses_along, direction, slides > 0)
    impulses = impulses_along(direction)
    return inverse @ impulses, impulses


def _turn_directions(rows: Rows, schur, impulses_along, direction, slides):
    """The directions (r, 2), which are those of the slips behind the impact, also as the state varies.

    Two steps of Newton's method from where they are give derivatives of first and second order.
    """

    def off(angles):
        along = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
        after = (rows.rates + schur @ impulses_along(along))[rows.tangential]
        across = after[:, 0] * along[:, 1] - after[:, 1] * along[:, 0]
        size = jax.lax.stop_gradient(jnp.abs(after).max(axis=1))
        return jnp.where(slides & (size > 0), across / jnp.where(size > 0, size, 1.0), 0.0)

    angles = jax.lax.stop_gradient(jnp.arctan2(direction[:, 1], direction[:, 0]))
    for _ in range(2):
        slopes = jax.jacfwd(off)(angles)
        still = jnp.diag(jnp.where(jnp.diagonal(slopes) == 0, 1.0, 0.0))
        angles = angles - solve_general(slopes + still, off(angles))
    return jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)


def _independent(schur, held):
    """1 for each of the rows `held` (m,) that does not depend on those before it, by elimination without pivots."""
    size = len(held)

    def eliminate(i, carry):
        matrix, kept = carry
        pivot = matrix[i, i]
        keep = (held[i] > 0) & (pivot > DEPENDENT * schur[i, i])
        taken = jnp.outer(matrix[:, i], matrix[i]) / jnp.where(keep, pivot, 1.0)
        return matrix - jnp.where(keep, taken, 0.0), kept.at[i].set(keep)

    return jax.lax.fori_loop(0, size, eliminate, (schur, jnp.zeros(size)))[1]


# What is left of a pivot, as a part of it, for a row to depend on those before it: as in `_equations._linear`.
DEPENDENT = float(np.finfo(float).eps) ** (2 / 3)


def find_pattern(rows: Rows, touches, restitution, friction) -> tuple[Pattern, Any]:
    """What the contacts that touch (k,) do in an impact, and whether that is a solution of the law."""
    count, (r, d) = len(rows.normal), rows.tangential.shape
    of_contacts = rows.contact_rows
    own = np.setdiff1d(np.arange(len(rows.rates)), of_contacts)
    schur = rows.jacobian @ responses(rows)
    if own.size:  # constraints hold in any case
        taken = solve_general(schur[np.ix_(own, own)], schur[np.ix_(own, of_contacts)])
        coupling = schur[np.ix_(of_contacts, of_contacts)] - schur[np.ix_(of_contacts, own)] @ taken
    else:
        coupling = schur[np.ix_(of_contacts, of_contacts)]
    rates = rows.rates[of_contacts]
    towards = jnp.concatenate([(1.0 + restitution) * rates[:count], rates[count:]])
    diagonal = jnp.diagonal(coupling)
    of_slips = jnp.max(diagonal[count:].reshape(r, d), axis=1, initial=0.0)
    own_step = jnp.concatenate([diagonal[:count], jnp.repeat(of_slips, d)])
    step = jnp.where(own_step > 0, 1.0 / jnp.where(own_step > 0, own_step, 1.0), 0.0)
    places = count + np.arange(r * d).reshape(r, d)

    def sweep(impulses):
        for i in range(count):  # one contact after the other
            change = -step[i] * (towards[i] + coupling[i] @ impulses)
            impulses = impulses.at[i].set(jnp.where(touches[i], jnp.maximum(impulses[i] + change, 0.0), 0.0))
            for j in np.flatnonzero(rows.rough == i):
                at = places[j]
                moved = impulses[at] - step[at] * (towards[at] + coupling[at] @ impulses)
                length, most = jnp.sqrt(jnp.sum(moved * moved)), friction[j] * impulses[i]
                impulses = impulses.at[at].set(
                    moved * jnp.where(length > most, most / jnp.where(length > 0, length, 1.0), 1.0)
                )
        return impulses

    def unsettled(carry):
        _, moved, n = carry
        return (moved > SETTLED * jnp.max(jnp.abs(towards), initial=0.0)) & (n < SWEEPS)

    def relax(carry):
        impulses, _, n = carry
        new = sweep(impulses)
        return new, jnp.max(jnp.abs(new - impulses) * own_step, initial=0.0), n + 1

    impulses, _, _ = jax.lax.while_loop(unsettled, relax, (jnp.zeros(count + r * d), jnp.inf, 0))
    push, forces = impulses[:count] > 0, impulses[count:].reshape(r, d)
    size, most = jnp.sqrt(jnp.sum(forces * forces, axis=1)), friction * impulses[rows.rough]
    sticks = push[rows.rough] & (size < most * (1 - 1e-9))
    direction = -forces / jnp.where(size > 0, size, 1.0)[:, None]
    pattern = Pattern(push.astype(float), sticks.astype(float), direction)
    after = rates + coupling @ impulses
    misses = jnp.max(jnp.where(touches, -(after[:count] + restitution * rates[:count]), 0.0), initial=0.0)
    return pattern, misses <= MISSES * jnp.max(jnp.abs(towards), initial=0.0)


def sliding_coupling(rows: Rows, contacts: Contacts, friction):
    """What is left of each contact's own response, as a part of it, beside the friction it brings while it slides, (r,).

    Where it is not positive no force, or more than one, keeps the contact closed: Painlevé's paradox.
    """
    schur = rows.jacobian @ responses(rows)
    normal = rows.normal[rows.rough]
    own = schur[normal, normal]
    brought = jnp.einsum("rd,rd->r", schur[normal[:, None], rows.tangential], contacts.direction)
    slides = contacts.closed[rows.rough] * (1.0 - contacts.sticks) * friction
    return 1.0 - slides * brought / jnp.where(own > 0, own, 1.0)
