"""Derivatives of the law of impacts: velocities themselves are those of `_contact_changes.apply_change`.

With G the rows of k gaps and one-way velocities, and of r d slips, (K, n), q̇⁺ = q̇ + M⁻¹ Gᵀ E Λ, where E adds the
friction −μ c of a contact that slides to its normal impulse. Newton's law of restitution with Coulomb friction, for all
contacts that touch at once, requires

    ġ⁺ + e ġ⁻ ≥ 0  ⟂  Λ ≥ 0        |F| ≤ μ Λ,  F = −μ Λ s⁺/|s⁺| where s⁺ ≠ 0

Which contacts push and stick is decided without derivatives (`_law`); here it is given, and impulses have derivatives.
Source: Moreau, in *Nonsmooth Mechanics and Applications* (1988), §11; Glocker, *Set-Valued Force Laws* (2001), ch. 9.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._primitives import solve


class ImpactRows(NamedTuple):
    """The rows of contacts at a state: those of the k normals, then those of the slips, d for each of r contacts.

    `gradients` G (K, n), `responses` G M⁻¹ (K, n), `coupling` G M⁻¹ Gᵀ (K, K), the `values` of gaps, one-way velocities
    and slips (K,), the `rates` that impulses change: those of gaps, and the values of the rest; and `bends` (K,), the
    rates of these while no contact is closed.
    """

    gradients: Any
    responses: Any
    coupling: Any
    values: Any
    rates: Any
    bends: Any

    @classmethod
    def split(cls, numbers, size: int, n: int) -> "ImpactRows":
        """The rows from the outputs of `Accelerations.impact_response` for `size` rows and n coordinates."""
        shapes = (size, n), (size, n), (size, size), (size,), (size,), (size,)
        parts = jnp.split(numbers, np.cumsum([math.prod(shape) for shape in shapes])[:-1])
        return cls(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))


class ActiveRows(NamedTuple):
    """The contacts in an impact: `rows` (K,) are 1 if held, else 0; `rough` are the r contacts with friction.

    Of these, `slides` (r,) is the coefficient of those that slide, else 0, and `direction` (r, d) that of the slip.
    """

    rows: Any
    slides: Any
    direction: Any
    rough: np.ndarray

    @property
    def places(self) -> np.ndarray:
        """The row numbers of the slips, (r, d), which follow those of the normals."""
        size = len(self.rough) * self.direction.shape[1]
        return len(self.rows) - size + np.arange(size).reshape(self.direction.shape)


def find_impulses(rows: ImpactRows, held: ActiveRows, targets):
    """The impulses (K,) that give pushing contacts the rates `targets` (k,), and sticking slips the rate 0.

    The impulse of a free row is zero; that of a sliding contact includes its friction.
    """

    def impulses_along(direction):
        mixed = unit = np.eye(len(held.rows))
        if held.rough.size:
            frictions = -held.slides[:, None] * direction
            of_slips = jnp.where(unit[held.rough][:, None] > 0, frictions[..., None], 0.0)
            mixed = unit + jnp.pad(of_slips.reshape(-1, len(unit)), ((len(unit) - held.places.size, 0), (0, 0)))
        system = held.rows[:, None] * (rows.coupling @ mixed) + jnp.where(unit > 0, 1.0 - held.rows, 0.0)
        right = held.rows * (jnp.pad(targets, (0, held.places.size)) - rows.rates)
        return mixed @ solve(system, right)

    if held.direction.shape[1] == 1 or not held.rough.size:
        return impulses_along(held.direction)
    return _turn_directions(rows, held, impulses_along)


def _turn_directions(rows: ImpactRows, held: ActiveRows, impulses_along):
    """The impulses (K,) with sliding directions equal to those of the slips after the impact, differentiably.

    Two Newton steps from the given directions give derivatives of first and second order.
    """
    slides = held.slides > 0

    def off(angles):
        along = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
        impulses = impulses_along(along)
        after = (rows.rates + rows.coupling @ impulses)[-held.places.size :].reshape(held.direction.shape)
        across = after[:, 0] * along[:, 1] - after[:, 1] * along[:, 0]
        size = jax.lax.stop_gradient(jnp.abs(after).max(axis=1))
        turned = jnp.where(slides & (size > 0), across / jnp.where(size > 0, size, 1.0), 0.0)
        return turned, (turned, impulses)

    angles = jax.lax.stop_gradient(jnp.arctan2(held.direction[:, 1], held.direction[:, 0]))
    for _ in range(2):
        slopes, (turned, _) = jax.jacfwd(off, has_aux=True)(angles)
        still = jnp.where(np.eye(len(angles)) * (slopes == 0) > 0, 1.0, 0.0)  # of those that do not slide, and stay
        angles = angles - solve(slopes + still, turned)
    return off(angles)[1][1]


def rates_behind(rows: ImpactRows, compressed, returned, restitution):
    """The rates (k,) after an impact by Poisson's law, without friction, from the held rows of its two phases.

    Compression ends when no contact approaches; each then returns the fraction e of its impulse, and more if it would
    still approach (Glocker, §9.4).
    """

    def phase(rates, held):
        none = jnp.zeros_like(rates)
        free = ActiveRows(held, none[:0], jnp.zeros((0, 1)), np.zeros(0, int))
        return find_impulses(rows._replace(rates=rates), free, none)

    rates = rows.rates + rows.coupling @ ((1.0 + restitution) * phase(rows.rates, compressed))
    return rates + rows.coupling @ phase(rates, returned)


def construct_impulses(coupling, rates, restitution, coefficients) -> tuple[Any, Any]:
    """The rate (1,) after an impact of one contact in a plane, and −F/μΛ (1, 1), by Routh's construction.

    As the normal impulse Λ grows, friction acts against the current slip. When the slip has stopped the contact sticks,
    if friction suffices, or reverses. Compression ends where the rate is zero, the impact at 1 + e times its impulse
    (Wang & Mason, J. Appl. Mech. 59 (1992) 635).
    """
    (normal, mixed), (_, tangential) = coupling
    (rate, slip), most = rates, coefficients[0]
    side = jnp.where(slip < 0, -1.0, 1.0)
    slows = most * tangential - side * mixed  # of the slip, by Λ; it is positive where friction could jam
    stops = jnp.where((slip == 0) | (slows > 0), jnp.abs(slip) / jnp.where(slows > 0, slows, 1.0), jnp.inf)
    held = jnp.clip(mixed / tangential, -most, most)  # −dF/dΛ from there on
    first, then = normal - most * side * mixed, normal - held * mixed
    stays = first * stops >= -rate  # compression ends before the slip does
    before = jnp.where(stays, 0.0, stops)
    compression = before + (-rate - first * before) / jnp.where(stays, first, then)
    impulse = (1.0 + restitution[0]) * compression
    slides = jnp.minimum(impulse, stops)
    force = -most * side * slides - held * (impulse - slides)
    part = most * impulse
    direction = jnp.where(part > 0, -force / jnp.where(part > 0, part, 1.0), 0.0)
    return (rate + normal * impulse + mixed * force)[None], direction[None, None]
