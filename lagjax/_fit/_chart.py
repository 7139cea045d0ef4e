"""`Chart`: coordinates z of the unknowns in which their posterior is nearly round, beside a bound too.

Residuals are more nearly linear in a number y than in its logarithm, and beside a bound a posterior is a normal density
of y that the bound cuts off. The search's own unknown u = log y has a variance (σ/y)² there, which means nothing where
y is smaller than its standard error σ. So the numbers y of `positive` and `between` take the place of their u:

    y = ŷ + L ζ,      L Lᵀ the covariance of y,      y_b = φ(t),      t = t̂ + L_bb z

for the bounded numbers y_b, which come first, and ζ = z for all others. With s(τ) = log(1 + e^τ), the map

    φ(t) = a + σ [s((t − a)/σ) − s((t − b)/σ)]

from all real t onto (a, b) is t itself a few σ inside of both bounds, and falls off exponentially where t lies beyond.
A density of y that is flat at its bound has there the logarithm t/σ: no wall, and one length for all directions. The
density stays that of the unknowns x: `log_volume` is the logarithm of |∂x/∂z|.

Stan takes log y for a number above a bound (Stan Reference Manual, *Constraint transforms*): the two agree where y is
known to a few per cent, and y alone stays round where it is known worse.
"""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit._density import Density
from lagjax._fit._transforms import AbstractSeparable

# In σ: a centre nearer to a bound is moved to here, where φ′ = ½ (log 2), so that both sides of it are inside the set.
_NEAREST = float(np.log(2.0))


class Chart(NamedTuple):
    """The coordinates z (D,), where z = 0 is y = `centre` (D,), and ζ moves y by `root` (D, D).

    `bounded` (B,) are the places of numbers between `low` and `high` (B,); `scale` (B,) is σ, `middle` (B,) is t̂.
    """

    density: Density
    centre: np.ndarray
    root: np.ndarray
    bounded: np.ndarray
    low: np.ndarray
    high: np.ndarray
    scale: np.ndarray
    middle: np.ndarray

    @staticmethod
    def of(density: Density) -> "Chart":
        """The chart about a fit. Raises `ValueError` where something is not seen."""
        parameters, u = density.question.parameters, density.point.u
        ends = np.array([transform.bounds for transform in parameters.maps]).reshape(-1, 2)
        bounded = np.flatnonzero(np.isfinite(ends).any(axis=1))
        low, high = ends[bounded].T
        y, by_u = density.first.copy(), np.ones(len(density))
        for k in bounded.tolist():
            own = cast(AbstractSeparable, parameters.maps[k])
            y[k], by_u[k] = own.value(u[k]), own.slope(u[k])
        covariance = density.covariance() * np.outer(by_u, by_u)
        narrowed = np.ones(len(density))  # where data say less than the bounds, these say how wide the density is
        deviation = np.sqrt(np.diag(covariance)[bounded])
        narrowed[bounded] = scale = np.minimum(deviation, 0.5 * (high - low)) / deviation
        scale = scale * deviation
        order = np.concatenate([bounded, np.setdiff1d(np.arange(len(density)), bounded)])
        root, count = np.zeros_like(covariance), len(bounded)
        root[order] = np.linalg.cholesky((covariance * np.outer(narrowed, narrowed))[np.ix_(order, order)])
        inside = np.clip(y[bounded], low + _NEAREST * scale, high - _NEAREST * scale)
        centre = y + root[:, :count] @ np.linalg.solve(root[bounded, :count], inside - y[bounded])
        centre[bounded] = inside
        offset = (inside - low) / scale
        middle = offset + np.log(-np.expm1(-offset)) - np.log(-np.expm1((inside - high) / scale))
        return Chart(density, centre, root, bounded, low, high, scale, low + scale * middle)

    def __call__(self, z):
        """x (D,), ζ (D,) and the logarithm of |∂x/∂z|, up to a constant, at z (D,)."""
        array = lambda of: jnp.asarray(of, z.dtype)  # noqa: E731
        b, count = self.bounded, len(self.bounded)
        own, finite = array(self.root[b, :count]), np.isfinite(self.high)
        t = array(self.middle) + own @ z[:count]
        above, below = (t - array(self.low)) / array(self.scale), (t - array(self.high)) / array(self.scale)
        to_low = jax.nn.softplus(above) - jax.nn.softplus(below)  # the distances of y from its bounds, over σ
        to_high = jnp.where(finite, jax.nn.softplus(-below) - jax.nn.softplus(-above), 1.0)
        moved = array(self.low - self.centre[b]) + array(self.scale) * to_low
        zeta = z.at[:count].set(jax.scipy.linalg.solve_triangular(own, moved, lower=True))
        x = array(self.centre) + array(self.root) @ zeta
        one = array(np.where(finite, 1.0, self.scale))  # u = log[(y − a)/(b − y)], or log(y − a)
        x = x.at[b].set(jnp.log(one * to_low) - jnp.log(to_high))
        steep = jax.nn.log_sigmoid(above) + jax.nn.log_sigmoid(-below)
        return x, zeta, jnp.sum(steep - jnp.log(to_low) - jnp.log(to_high))

    def x(self, z):
        """The unknowns x (D,) at z (D,)."""
        return self(z)[0]

    def log_density(self, z):
        """The logarithm of the posterior density of z (D,), up to a constant; −∞ where that is no number."""
        x, _, volume = self(z)
        total = self.density(x) + volume
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def at(self, zeta: np.ndarray) -> np.ndarray:
        """The unknowns x (D,) where y = centre + root ζ is inside of its bounds."""
        x = self.centre + self.root @ zeta
        y = x[self.bounded]
        with np.errstate(divide="ignore"):
            x[self.bounded] = np.log(y - self.low) - np.where(np.isfinite(self.high), np.log(self.high - y), 0.0)
        return x

    def columns(self, zeta: np.ndarray) -> np.ndarray:
        """∂x/∂ζ (D, D)."""
        by_y = np.ones(len(self.centre))
        by_y[self.bounded] = _slope((self.centre + self.root @ zeta)[self.bounded], self.low, self.high)
        return by_y[:, None] * self.root

    def room(self, ways: np.ndarray) -> np.ndarray:
        """The reach of ζ from zero, both ways, along each of `ways` (D, K), (K,): nine tenths of the way to a bound.

        A number that is not bounded has room for one standard deviation.
        """
        y = self.centre[self.bounded, None]
        most = 0.9 * np.minimum(y - self.low[:, None], self.high[:, None] - y)
        moved = np.abs(self.root @ ways)[self.bounded]
        with np.errstate(divide="ignore"):
            return np.min(most / moved, axis=0, initial=1.0)


def _slope(y: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """du/dy (B,) of u = log[(y − a)/(b − y)], or log(y − a) where b is infinite."""
    return 1.0 / (y - low) + 1.0 / (high - y)
