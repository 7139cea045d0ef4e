"""Transforms: maps from any real numbers onto the set that parameters stay in.

The search moves numbers u that may be any real, the scene gets x = x(u):

    positive        x = eᵘ                               0 < x
    between(a, b)   x = a + (b − a) / (1 + e⁻ᵘ)          a < x < b
    angle           x = u, less whole turns              −π < x ≤ π
    simplex         x = c softmax(H u)                   0 < xᵢ, Σ xᵢ = c
    inertia         J = U(u) U(u)ᵀ                       what a rigid body of positive density can have

so that no step leaves the set and no bound is ever active: a parameter that the data push onto a bound comes near it,
with an interval that says so. The first three move every number by itself. The others move all numbers of one leaf
together, and there may be fewer u than x. Intervals end inside the set, or at its bound where that is not excluded.
"""

import abc
import functools
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import helmert

_STRAIGHT = 1e-10  # of the largest roughness: below it a function is not rough but by rounding


class AbstractTransform(abc.ABC):
    """A smooth map x(u) from real numbers (m,) onto the values (n,) that the numbers of one leaf may have.

    `reach` is how far a step of the search may change u: beyond it x(u) is nothing like its tangent. `room` is the
    distance from one u within which another one is neither at a bound of the set nor the same value again. `separable`
    maps move every number by itself, so that one can be kept and the others moved. Functions that take `xp` compute
    with NumPy, or with `jax.numpy` inside of a program of JAX.
    """

    reach: ClassVar[float] = 2.0
    room: ClassVar[float] = 40.0
    separable: ClassVar[bool] = False

    def specialize(self, x: np.ndarray, shape: tuple[int, ...]) -> "AbstractTransform":
        """The map for a leaf of this shape that starts at `x` (n,), where the map depends on that."""
        return self

    def count_unknowns(self, count: int) -> int:
        """m, how many u move a leaf of n = `count` numbers."""
        return count

    def refuses(self, x: np.ndarray) -> str | None:
        """The condition on the values, as the end of a sentence, where `x` is outside the set; None where it is not."""
        return None

    @abc.abstractmethod
    def value(self, u, xp: Any = np) -> Any:
        """x(u), (m,) → (n,)."""

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """∂x/∂u, (n, m)."""
        return np.asarray(_compile_jacobian(self)(u))

    def slopes(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The entries of ∂x/∂u that are not zero by construction: rows, columns, and values."""
        matrix = self.jacobian(u)
        rows, columns = np.indices(matrix.shape)
        return rows.ravel(), columns.ravel(), matrix.ravel()

    @abc.abstractmethod
    def inverse(self, x: np.ndarray) -> np.ndarray:
        """u(x) of values inside the set, (n,) → (m,)."""

    @abc.abstractmethod
    def ends(self, x: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The ends of intervals about `x` (n,) whose half width is `spread` where the set does not bend them."""

    @abc.abstractmethod
    def draw(self, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Another u (m,) to begin a search from, anywhere in the set if that is bounded, else about `u`."""

    @abc.abstractmethod
    def log_volume(self, u, xp: Any = np) -> Any:
        """log of the volume of x per volume of u, up to a constant: what makes a density of x one of u."""

    def limits(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) between which one step of the search may lie, (m,) each."""
        return np.full(len(u), -self.reach), np.full(len(u), self.reach)

    def leaps(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) between which a step may end anywhere in the set, (m,) each."""
        return self.limits(u)

    def take_step(self, u: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The end of a step (m,) from u (m,)."""
        return u + step

    def prior_weights(self, count: int) -> np.ndarray:
        """The weights w (m,) of a prior density exp(−Σ (w u)²/2) of the u of a leaf of n = `count` numbers."""
        return np.zeros(self.count_unknowns(count))

    @property
    def bounds(self) -> tuple[float, float]:
        """Between which two numbers each number moves by itself; ∓∞ where there is no such bound."""
        return -np.inf, np.inf


class AbstractSeparable(AbstractTransform):
    """A map that moves every number by itself, x_i = x(u_i), and increases."""

    separable: ClassVar[bool] = True

    @abc.abstractmethod
    def slope(self, u, xp: Any = np) -> Any:
        """dx/du."""

    def jacobian(self, u):
        return np.diag(self.slope(u))

    def slopes(self, u):
        return np.arange(len(u)), np.arange(len(u)), self.slope(u)

    def ends(self, x, spread):
        """x(u ± spread / slope): relative for logarithms, and inside of the bounds. Where x ± spread does not exclude a
        bound, its logarithm says nothing: there x ± spread is cut off."""
        low, high = np.maximum(x - spread, self.bounds[0]), np.minimum(x + spread, self.bounds[1])
        excluded = (low > self.bounds[0]) & (high < self.bounds[1])
        u = self.inverse(x)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            wide = spread / self.slope(u)
            return np.where(excluded, self.value(u - wide), low), np.where(excluded, self.value(u + wide), high)

    def log_volume(self, u, xp: Any = np):
        return xp.sum(xp.log(self.slope(u, xp)))


@dataclass(frozen=True)
class Unbounded(AbstractSeparable):
    """x = u: any real number."""

    reach: ClassVar[float] = np.inf
    room: ClassVar[float] = np.inf

    def value(self, u, xp: Any = np):
        return u

    def slope(self, u, xp: Any = np):
        return xp.ones_like(u)

    def inverse(self, x):
        return x

    def draw(self, u, rng):
        """Normal about u, as wide as it is large; as wide as one about zero."""
        return u + np.where(u != 0, np.abs(u), 1.0) * rng.normal(size=len(u))


@dataclass(frozen=True)
class Positive(AbstractSeparable):
    """x = eᵘ: a number above zero. `lagjax.positive` is its instance.

    ```python
    import lagjax

    transforms = {"mass": lagjax.positive, "friction": lagjax.positive}  # lagjax.fit(..., transforms=transforms)
    ```
    """

    @property
    def bounds(self):
        return 0.0, np.inf

    def value(self, u, xp: Any = np):
        return xp.exp(u)

    def slope(self, u, xp: Any = np):
        return xp.exp(u)

    def inverse(self, x):
        return np.log(x)

    def limits(self, u):
        """The steps that lower or raise x by the factor e to the power of `reach`."""
        return np.full(len(u), np.expm1(-self.reach)), np.full(len(u), np.expm1(self.reach))

    def leaps(self, u):
        return self.limits(u)[0], np.full(len(u), np.inf)

    def take_step(self, u, step):
        """u of x + dx/du · step: signals are more nearly linear in a coefficient than in its logarithm."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return u + np.log1p(step)

    def draw(self, u, rng):
        """Normal in the logarithm, with the standard deviation of a decade."""
        return u + np.log(10.0) * rng.normal(size=len(u))

    def refuses(self, x):
        return None if np.all(x > 0) else "must start above zero, because its transform is lagjax.positive"

    def __repr__(self) -> str:
        return "lagjax.positive"


@dataclass(frozen=True)
class Between(AbstractSeparable):
    """x = a + (b − a)/(1 + e⁻ᵘ): numbers between a and b. `lagjax.between(a, b)` makes one."""

    lower: float
    upper: float

    @property
    def bounds(self):
        return self.lower, self.upper

    def value(self, u, xp: Any = np):
        return self.lower + (self.upper - self.lower) * _logistic(u, xp)

    def slope(self, u, xp: Any = np):
        return (self.upper - self.lower) * _logistic(u, xp) * _logistic(-u, xp)

    def inverse(self, x):
        return np.log((x - self.lower) / (self.upper - x))

    def limits(self, u):
        return self._steps_to(u, u - self.reach, u + self.reach)

    def leaps(self, u):
        return self._steps_to(u, np.minimum(u, 0.0) - self.reach, np.maximum(u, 0.0) + self.reach)

    def _steps_to(self, u, *ends):
        each = _logistic(u) * _logistic(-u)
        with np.errstate(invalid="ignore", divide="ignore"):  # NaN, no limit, where x is rounded to its bound
            low, high = (
                np.where(u < 0, _logistic(end) - _logistic(u), _logistic(-u) - _logistic(-end)) / each for end in ends
            )
        return low, high

    def take_step(self, u, step):
        """u of x + dx/du · step, as for `Positive`."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return u + np.log1p(_logistic(-u) * step) - np.log1p(-_logistic(u) * step)

    def draw(self, u, rng):
        share = rng.uniform(size=len(u))
        return np.log(share / (1.0 - share))

    def refuses(self, x):
        if np.all((x > self.lower) & (x < self.upper)):
            return None
        return f"must start between {self.lower:g} and {self.upper:g}, because its transform is {self!r}"

    def __repr__(self) -> str:
        return f"lagjax.between({self.lower:g}, {self.upper:g})"


@dataclass(frozen=True)
class Angle(Unbounded):
    """x = u less whole turns, in (−π, π]: an angle. `lagjax.angle` is its instance.

    The search may go round; the scene must have the period 2π in x. An interval may end beyond ±π; one that is wider
    than a turn is (x − π, x + π), which means that the data do not determine x.

    ```python
    import lagjax

    transforms = {"phase": lagjax.angle}  # lagjax.fit(..., transforms=transforms)
    ```
    """

    reach: ClassVar[float] = 0.5 * np.pi
    room: ClassVar[float] = np.pi

    def value(self, u, xp: Any = np):
        return u - 2 * np.pi * xp.ceil((u - np.pi) / (2 * np.pi))

    def draw(self, u, rng):
        return rng.uniform(-np.pi, np.pi, len(u))

    def ends(self, x, spread):
        """x ± spread, at most a turn in all."""
        half = np.minimum(spread, np.pi)
        return x - half, x + half

    def __repr__(self) -> str:
        return "lagjax.angle"


@dataclass(frozen=True)
class Simplex(AbstractTransform):
    """x = c softmax(H u): an array of n numbers above zero with a constant sum c. `lagjax.simplex` is its instance.

    The sum is that of the array in `params0`. H (n, n − 1) has orthonormal columns of sum zero (Helmert's), so that all
    numbers are treated alike.

    ```python
    import lagjax

    transforms = {"shares": lagjax.simplex}  # lagjax.fit(..., transforms=transforms)
    ```

    Source: Egozcue et al., *Isometric logratio transformations for compositional data*, Math. Geology 35 (2003) 279.
    """

    total: float = 1.0

    def specialize(self, x, shape):
        return Simplex(float(np.sum(x)))

    def count_unknowns(self, count):
        return count - 1

    def refuses(self, x):
        if len(x) < 2 or not np.all(x > 0):
            return "must start as several numbers above zero in one array, because its transform is lagjax.simplex"
        return None

    def value(self, u, xp: Any = np):
        logs = helmert(u.shape[0] + 1).T @ u
        shares = xp.exp(logs - xp.max(logs))
        return self.total * shares / xp.sum(shares)

    def inverse(self, x):
        return helmert(len(x)) @ np.log(x)

    def draw(self, u, rng):
        return self.inverse(rng.dirichlet(np.ones(len(u) + 1)))

    def ends(self, x, spread):
        """Intervals of every share, made in its logit."""
        return Between(0.0, self.total).ends(x, spread)

    def log_volume(self, u, xp: Any = np):
        return xp.sum(xp.log(self.value(u, xp)))

    def __repr__(self) -> str:
        return "lagjax.simplex"


@dataclass(frozen=True)
class Inertia(AbstractTransform):
    """The inertia of a rigid body of positive density, by its log-Cholesky form. `lagjax.inertia` is its instance.

    With the mass m, its first moments h = ∫ r dm and second ones Σ = ∫ r rᵀ dm = ½ tr(I) 1 − I, about any point,

        J = [[Σ, h], [hᵀ, m]] = U Uᵀ,
        U = e^α [[e^d₁, s₁₂, s₁₃, t₁], [0, e^d₂, s₂₃, t₂], [0, 0, e^d₃, t₃], [0, 0, 0, 1]]

    is positive definite for every u = (α, d₁, d₂, d₃, s₁₂, s₂₃, s₁₃, t₁, t₂, t₃). The leaf is J itself, (4, 4), or
    (m, h_x, h_y, h_z, I_xx, I_yy, I_zz, I_xy, I_xz, I_yz), where I_xy is the element of the matrix, −∫ x y dm.

    ```python
    import lagjax

    transforms = {"forearm": lagjax.inertia}  # lagjax.fit(..., transforms=transforms)
    ```

    Source: Rucker & Wensing, *Smooth parameterization of rigid-body inertia*, IEEE RA-L 7 (2022) 2771.
    """

    vector: bool = True

    def specialize(self, x, shape):
        return Inertia(vector=shape != (4, 4))

    def count_unknowns(self, count):
        return 10

    def refuses(self, x):
        if len(x) not in (10, 16):
            return "must have the shape (10,) or (4, 4), because its transform is lagjax.inertia"
        matrix = self._pseudo(x) if len(x) == 10 else x.reshape(4, 4)
        if not np.allclose(matrix, matrix.T, rtol=1e-9) or np.linalg.eigvalsh(matrix).min() <= 0:
            return (
                "must start as the inertia of a body whose density is positive everywhere, because its transform is "
                "lagjax.inertia: its pseudo-inertia must be symmetric and positive definite"
            )
        return None

    @staticmethod
    def _pseudo(x) -> np.ndarray:
        m, hx, hy, hz, xx, yy, zz, xy, xz, yz = x
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        return np.block([[moments, np.array([[hx], [hy], [hz]])], [np.array([[hx, hy, hz, m]])]])

    def value(self, u, xp: Any = np):
        alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = u
        zero, one = xp.zeros_like(alpha), xp.ones_like(alpha)
        rows = [[xp.exp(d1), s12, s13, t1], [zero, xp.exp(d2), s23, t2], [zero, zero, xp.exp(d3), t3],
                [zero, zero, zero, one]]  # fmt: skip
        factor = xp.exp(alpha) * xp.stack([xp.stack(row) for row in rows])
        pseudo = factor @ factor.T
        if not self.vector:
            return pseudo.ravel()
        a, b, c = pseudo[0, 0], pseudo[1, 1], pseudo[2, 2]
        products = -pseudo[0, 1], -pseudo[0, 2], -pseudo[1, 2]
        return xp.stack([pseudo[3, 3], *pseudo[:3, 3], b + c, a + c, a + b, *products])

    def inverse(self, x):
        pseudo = self._pseudo(x) if self.vector else x.reshape(4, 4)
        flipped = np.linalg.cholesky(pseudo[::-1, ::-1])
        factor = flipped[::-1, ::-1] / flipped[0, 0]
        off = [factor[place] for place in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
        return np.array([np.log(flipped[0, 0]), *np.log(np.diag(factor)[:3]), *off])

    def draw(self, u, rng):
        """Normal about u with the standard deviation of a factor 1.65 in masses and lengths."""
        return u + 0.5 * rng.normal(size=len(u))

    def ends(self, x, spread):
        """Relative intervals for what is positive, the mass and the diagonal; others are x ± spread."""
        diagonal = [0, 4, 5, 6] if self.vector else [0, 5, 10, 15]
        low, high = x - spread, x + spread
        low[diagonal], high[diagonal] = positive.ends(x[diagonal], spread[diagonal])
        return low, high

    def log_volume(self, u, xp: Any = np):
        """log |∂J/∂u| = 20 α + 2 d₁ + 3 d₂ + 4 d₃, up to a constant."""
        return 20 * u[0] + 2 * u[1] + 3 * u[2] + 4 * u[3]

    def __repr__(self) -> str:
        return "lagjax.inertia"


@dataclass(frozen=True, eq=False)
class Smooth(AbstractTransform):
    """x = B u: the numbers of a function that is rough by |D x|², along directions that are rough by |u_k|² each, and
    along those that are not rough at all.

    So a prior density exp(−λ |D x|²/2), with λ the `strength`, is one of independent u. `basis` (n, m) is B, `back`
    (m, n) its inverse, `rough` (m,) is 1 or 0 for each of the u; `knots` (n,) are the places of the numbers, None of
    several arguments. One direction changes x by `largest` in one step of the search: those of a potential, in which
    motion is nearly linear, by anything, logarithms of friction and inertia as those of a positive number; u_0, which
    then raises all x alike, moves as the logarithm of one.
    """

    reach: ClassVar[float] = np.inf
    room: ClassVar[float] = np.inf

    basis: np.ndarray
    back: np.ndarray
    rough: np.ndarray
    knots: np.ndarray | None
    largest: float
    strength: float = 1e-6

    @classmethod
    def from_roughness(cls, square: np.ndarray, gauge: bool, knots: np.ndarray | None) -> "Smooth":
        """The map of numbers whose roughness is xᵀ `square` x; with `gauge` a constant is no part of them."""
        sizes, vectors = np.linalg.eigh(square)
        rough = sizes > _STRAIGHT * sizes[-1]
        straight, one = vectors[:, ~rough], np.ones((len(square), 1)) / np.sqrt(len(square))
        straight = np.linalg.svd(straight - one @ (one.T @ straight))[0][:, : straight.shape[1] - 1]
        straight = straight if gauge else np.concatenate([one, straight], axis=1)
        scale = np.sqrt(sizes[rough])
        basis = np.concatenate([straight, vectors[:, rough] / scale], axis=1)
        back = np.concatenate([straight.T, scale[:, None] * vectors[:, rough].T])
        rough_ones = (np.arange(basis.shape[1]) >= straight.shape[1]).astype(float)
        return cls(basis, back, rough_ones, knots, np.inf if gauge else AbstractTransform.reach)

    def count_unknowns(self, count):
        return self.basis.shape[1]

    def limits(self, u):
        ends = self.largest / np.abs(self.basis).max(axis=0)
        low, high = -ends, ends.copy()
        if np.isfinite(self.largest):
            low[0], high[0] = np.expm1([-self.largest, self.largest]) / self.basis[0, 0]
        return low, high

    def leaps(self, u):
        low, high = self.limits(u)
        high[0] = np.inf
        return low, high

    def take_step(self, u, step):
        end = u + step
        if np.isfinite(self.largest):
            with np.errstate(invalid="ignore", divide="ignore"):
                end[0] = u[0] + np.log1p(self.basis[0, 0] * step[0]) / self.basis[0, 0]
        return end

    def prior_weights(self, count):
        return np.sqrt(self.strength) * self.rough

    def value(self, u, xp: Any = np):
        return xp.asarray(self.basis, u.dtype) @ u

    def jacobian(self, u):
        return self.basis

    def inverse(self, x):
        return self.back @ x

    def ends(self, x, spread):
        return x - spread, x + spread

    def draw(self, u, rng):
        """The same u: at given smoothness there is one minimum."""
        return u

    def log_volume(self, u, xp: Any = np):
        return xp.sum(0.0 * u)

    def __repr__(self) -> str:
        return "that of a learned function"


def _logistic(u, xp: Any = np):
    """1 / (1 + e⁻ᵘ), without overflow, and right to rounding where it is small."""
    return xp.exp(-xp.logaddexp(0.0, -u))


@functools.lru_cache
def _compile_jacobian(transform: AbstractTransform) -> Any:
    return jax.jit(jax.jacfwd(lambda u: transform.value(u, jnp)))


positive = Positive()
angle = Angle()
simplex = Simplex()
inertia = Inertia()


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
