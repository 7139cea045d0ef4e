"""Transforms: parameters that must stay in a set, as numbers that may be anything.

The search moves a number u that may be any real, the scene gets x = x(u):

    positive        x = eᵘ                               0 < x
    between(a, b)   x = a + (b − a) / (1 + e⁻ᵘ)          a < x < b

so that no step leaves the set and no bound is ever active: a parameter that the data push onto a bound comes near it,
with an interval that says so. Intervals are made in u and carried to x, where they end inside the set.
"""

import abc
from dataclasses import dataclass
from typing import ClassVar

import numpy as np


class AbstractTransform(abc.ABC):
    """A smooth increasing map x(u) from all real numbers onto the values that a parameter may have.

    `reach` is how far a step of the search may change u: beyond it x(u) is nothing like its tangent.
    """

    reach: ClassVar[float] = 2.0

    @abc.abstractmethod
    def value(self, u: np.ndarray) -> np.ndarray:
        """x(u)."""

    @abc.abstractmethod
    def slope(self, u: np.ndarray) -> np.ndarray:
        """dx/du."""

    @abc.abstractmethod
    def inverse(self, x: np.ndarray) -> np.ndarray:
        """u(x), of values inside the set."""

    @abc.abstractmethod
    def refuses(self, x: np.ndarray) -> str | None:
        """What a value must be, as the end of a sentence, where one of `x` is outside the set; None where none is."""


@dataclass(frozen=True)
class Unbounded(AbstractTransform):
    """x = u: any real number."""

    reach: ClassVar[float] = np.inf

    def value(self, u):
        """x(u)."""
        return u

    def slope(self, u):
        """dx/du."""
        return np.ones_like(u)

    def inverse(self, x):
        """u(x)."""
        return x

    def refuses(self, x):
        """None: every number is allowed."""
        return None


@dataclass(frozen=True)
class Positive(AbstractTransform):
    """x = eᵘ: numbers above zero. The ready instance is `lagjax.positive`."""

    def value(self, u):
        """x(u)."""
        return np.exp(u)

    def slope(self, u):
        """dx/du."""
        return np.exp(u)

    def inverse(self, x):
        """u(x), of positive x."""
        return np.log(x)

    def refuses(self, x):
        """That values must be positive, where one is not."""
        return None if np.all(x > 0) else "must start above zero, because its transform is lagjax.positive"


@dataclass(frozen=True)
class Between(AbstractTransform):
    """x = a + (b − a)/(1 + e⁻ᵘ): numbers between a and b. `lagjax.between(a, b)` makes one."""

    lower: float
    upper: float

    def value(self, u):
        """x(u)."""
        return self.lower + (self.upper - self.lower) * _logistic(u)

    def slope(self, u):
        """dx/du."""
        return (self.upper - self.lower) * _logistic(u) * _logistic(-u)

    def inverse(self, x):
        """u(x), of x between the bounds."""
        return np.log((x - self.lower) / (self.upper - x))

    def refuses(self, x):
        """That values must lie between the bounds, where one does not."""
        if np.all((x > self.lower) & (x < self.upper)):
            return None
        return f"must start between {self.lower:g} and {self.upper:g}, because its transform is {self!r}"

    def __repr__(self) -> str:
        return f"lagjax.between({self.lower:g}, {self.upper:g})"


def _logistic(u):
    """1 / (1 + e⁻ᵘ), without overflow."""
    return 0.5 * (1.0 + np.tanh(0.5 * u))


positive = Positive()


def between(lower: float, upper: float) -> Between:
    """A parameter that stays between two numbers: x = lower + (upper − lower)/(1 + e⁻ᵘ).

    Raises `ValueError` where the two are not finite numbers in order.

    ```python
    import lagjax

    transforms = {"friction": lagjax.between(0.0, 2.0), "mass": lagjax.positive}
    ```
    """
    if not (np.ndim(lower) == np.ndim(upper) == 0 and np.isfinite(lower) and np.isfinite(upper) and lower < upper):
        raise ValueError(f"between(a, b) needs two finite numbers with a < b; got a = {lower!r} and b = {upper!r}.")
    return Between(float(lower), float(upper))
