"""Parameters: the numbers that are fitted, their names, and the transforms that keep them in a set.

It holds the transforms and `Parameters`.

**Transforms.** The search moves numbers u that may be any real, the scene gets x = x(u):

    positive        x = eᵘ                               0 < x
    between(a, b)   x = a + (b − a) / (1 + e⁻ᵘ)          a < x < b
    angle           x = u, less whole turns              −π < x ≤ π
    simplex         x = c softmax(H u)                   0 < xᵢ, Σ xᵢ = c
    inertia         J = U(u) U(u)ᵀ                       what a rigid body of positive density can have

so that no step leaves the set and no bound is ever active: a parameter that the data push onto a bound comes near it,
with an interval that says so. The first three move every number by itself. The others move all numbers of one leaf
together, and there may be fewer u than x. Intervals end inside the set, or at its bound where that is not excluded.

**Parameters.** The scene's parameters are a pytree of any structure. Its P numbers end to end are one vector; F of them
are free, and the search moves these through their transforms.
"""

import abc
import functools
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np

from lagjax._interface import as_arrays, labelled_leaves, require_finite

PyTree = Any


class AbstractTransform(abc.ABC):
    """A smooth map x(u) from real numbers (m,) onto the values (n,) that the numbers of one leaf may have.

    `reach` is how far a step of the search may change u: beyond it x(u) is nothing like its tangent. `room` is the
    distance from one u within which another one is neither at a bound of the set nor the same value again. Functions
    that take `xp` compute with NumPy, or with `jax.numpy` inside of a program of JAX.
    """

    reach: ClassVar[float] = 2.0
    room: ClassVar[float] = 40.0

    def specialize(self, x: np.ndarray, shape: tuple[int, ...]) -> "AbstractTransform":
        """The map for a leaf of this shape that starts at `x` (n,), where the map depends on that."""
        return self

    def count_unknowns(self, count: int) -> int:
        """m, how many u move a leaf of n = `count` numbers."""
        return count

    @abc.abstractmethod
    def refuses(self, x: np.ndarray) -> str | None:
        """The condition on the values, as the end of a sentence, where `x` is outside the set; None where it is not."""

    @abc.abstractmethod
    def value(self, u, xp: Any = np) -> Any:
        """x(u), (m,) → (n,)."""

    @abc.abstractmethod
    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """∂x/∂u, (n, m)."""

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

    def take_step(self, u: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The end of a step (m,) from u (m,)."""
        return u + step

    @property
    def separable(self) -> bool:
        """True if every number moves by itself, so that one can be kept and the others moved."""
        return False

    @property
    def bounds(self) -> tuple[float, float]:
        """Between which two numbers each number moves by itself; ∓∞ where there is no such bound."""
        return -np.inf, np.inf


class AbstractSeparable(AbstractTransform):
    """A map that moves every number by itself, x_i = x(u_i), and increases."""

    @abc.abstractmethod
    def slope(self, u, xp: Any = np) -> Any:
        """dx/du."""

    @property
    def separable(self) -> bool:
        return True

    def jacobian(self, u):
        return np.diag(self.slope(u))

    def ends(self, x, spread):
        """x(u ± spread / slope): relative for logarithms, and inside of the bounds.

        Where x ± spread does not exclude a bound, its logarithm says nothing: the ends are those of x ± spread then,
        cut off at the bounds.
        """
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

    def refuses(self, x):
        return None


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
        each = _logistic(u) * _logistic(-u)
        with np.errstate(invalid="ignore", divide="ignore"):  # NaN, no limit, where x is rounded to its bound
            low, high = (
                np.where(u < 0, _logistic(u + by) - _logistic(u), _logistic(-u) - _logistic(-u - by)) / each
                for by in (-self.reach, self.reach)
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
        """The complaint that values must lie between the bounds, where one does not."""
        if np.all((x > self.lower) & (x < self.upper)):
            return None
        return f"must start between {self.lower:g} and {self.upper:g}, because its transform is {self!r}"

    def __repr__(self) -> str:
        return f"lagjax.between({self.lower:g}, {self.upper:g})"


@dataclass(frozen=True)
class Angle(AbstractSeparable):
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

    def slope(self, u, xp: Any = np):
        return xp.ones_like(u)

    def inverse(self, x):
        return x

    def draw(self, u, rng):
        return rng.uniform(-np.pi, np.pi, len(u))

    def ends(self, x, spread):
        """x ± spread, at most a turn in all."""
        half = np.minimum(spread, np.pi)
        return x - half, x + half

    def refuses(self, x):
        return None

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
        logs = _helmert(u.shape[0] + 1) @ u
        shares = xp.exp(logs - xp.max(logs))
        return self.total * shares / xp.sum(shares)

    def jacobian(self, u):
        """c (diag p − p pᵀ) H with the shares p."""
        shares = self.value(u) / self.total
        return self.total * (np.diag(shares) - np.outer(shares, shares)) @ _helmert(len(u) + 1)

    def inverse(self, x):
        return _helmert(len(x)).T @ np.log(x)

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

    def _numbers(self, pseudo, xp):
        """The leaf of pseudo-inertias (..., 4, 4), (..., n)."""
        if not self.vector:
            return pseudo.reshape(*pseudo.shape[:-2], 16)
        at = lambda i, j: pseudo[..., i, j]  # noqa: E731
        return xp.stack(
            [
                at(3, 3), at(0, 3), at(1, 3), at(2, 3),
                at(1, 1) + at(2, 2), at(0, 0) + at(2, 2), at(0, 0) + at(1, 1), -at(0, 1), -at(0, 2), -at(1, 2),
            ],
            axis=-1,
        )  # fmt: skip

    def _factor(self, u, xp):
        """U, (4, 4)."""
        alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = u
        zero, one = xp.zeros_like(alpha), xp.ones_like(alpha)
        rows = [[xp.exp(d1), s12, s13, t1], [zero, xp.exp(d2), s23, t2], [zero, zero, xp.exp(d3), t3],
                [zero, zero, zero, one]]  # fmt: skip
        return xp.exp(alpha) * xp.stack([xp.stack(row) for row in rows])

    def value(self, u, xp: Any = np):
        factor = self._factor(u, xp)
        return self._numbers(factor @ factor.T, xp)

    def jacobian(self, u):
        factor, size = self._factor(u, np), np.exp(u[0])
        moves = np.zeros((10, 4, 4))
        moves[0] = factor
        for k in range(3):
            moves[1 + k, k, k] = factor[k, k]
        for k, place in enumerate(((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))):
            moves[(4 + k, *place)] = size
        products = moves @ factor.T
        return self._numbers(products + products.swapaxes(1, 2), np).T

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


def _logistic(u, xp: Any = np):
    """1 / (1 + e⁻ᵘ), without overflow, and right to rounding where it is small."""
    return xp.exp(-xp.logaddexp(0.0, -u))


def _helmert(n: int) -> np.ndarray:
    """Orthonormal columns (n, n − 1) of sum zero."""
    matrix = np.zeros((n, n - 1))
    for k in range(1, n):
        matrix[:k, k - 1], matrix[k, k - 1] = 1.0 / k, -1.0
        matrix[:, k - 1] *= np.sqrt(k / (k + 1))
    return matrix


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


class Part(NamedTuple):
    """The numbers of one leaf that are free: where they stand among all numbers, and how they may move."""

    label: str
    shape: tuple[int, ...]
    places: np.ndarray
    transform: AbstractTransform


@dataclass(frozen=True)
class Parameters:
    """The numbers of a pytree of parameters, and those among them that are free.

    - `leaves`, `tree`: the pytree with arrays for numbers; a leaf that is no number is a part of the program.
    - `first` (P,): all numbers at the start of the search.
    - `names` (X,): what the free numbers are called, `params['m']`.
    - `parts`: the leaves among them, each with its transform. All of their u end to end are the F unknowns.
    """

    leaves: list
    tree: Any
    first: np.ndarray
    names: tuple[str, ...]
    parts: tuple[Part, ...]

    @classmethod
    def from_pytree(
        cls, params: PyTree, free: PyTree = None, transforms: PyTree = None, dtype: Any = np.float64
    ) -> "Parameters":
        """The parameters as the user gives them; `free` and `transforms` are prefixes of the same structure.

        Raises `TypeError` or `ValueError` with the name of the parameter that cannot be right.
        """
        require_finite(params, "params0")
        labels, leaves, tree = labelled_leaves(as_arrays(params, dtype, "params0"), "params")
        is_free = _broadcast_prefix(True if free is None else free, tree, leaves, "free")
        moved_by = _broadcast_prefix(Unbounded() if transforms is None else transforms, tree, leaves, "transforms")
        numbers, names, parts = [], [], []
        count = 0
        for label, leaf, may_move, transform in zip(labels, leaves, is_free, moved_by, strict=True):
            if not eqx.is_array_like(leaf):
                continue
            values = np.asarray(leaf, np.float64).ravel()
            numbers.append(values)
            fitted = _fitted_mask(label, leaf, may_move, free)
            if fitted.any():
                shape = np.shape(leaf)
                for one, some in _split_by_transform(label, transform, fitted, shape):
                    if isinstance(one, AbstractTransform) and not (len(some) == values.size or one.separable):
                        raise ValueError(f"{label} is free as a whole or not at all: its transform is {one!r}.")
                    one = _specialize_transform(label, one, values[some], shape)
                    parts.append(Part(label, shape, count + some, one))
                ends = [f"[{', '.join(map(str, index))}]" if shape else "" for index in np.ndindex(shape)]
                names += [label + end for end, free_too in zip(ends, fitted, strict=True) if free_too]
            count += values.size
        if not names and free is None:
            raise ValueError(
                "No parameter is free: give params0 at least one float for which `free` is True, or free=False to fit "
                "starts and noise alone."
            )
        return cls(leaves, tree, np.concatenate([np.zeros(0), *numbers]), tuple(names), tuple(parts))

    @functools.cached_property
    def _cuts(self) -> list[tuple[slice, slice, Part]]:
        """The u and the free numbers that belong to each part."""
        cuts, begin, u_begin = [], 0, 0
        for part in self.parts:
            size = part.transform.count_unknowns(len(part.places))
            cuts.append((slice(u_begin, u_begin + size), slice(begin, begin + len(part.places)), part))
            begin, u_begin = begin + len(part.places), u_begin + size
        return cuts

    @functools.cached_property
    def places(self) -> np.ndarray:
        """The places of the free numbers among all (X,)."""
        return np.concatenate([np.zeros(0, int), *(part.places for part in self.parts)])

    def __len__(self) -> int:
        """F, the number of unknowns."""
        return self._cuts[-1][0].stop if self.parts else 0

    def inverse(self, values: np.ndarray) -> np.ndarray:
        """u (F,) of the free numbers among all `values` (P,)."""
        return np.concatenate([np.zeros(0), *(part.transform.inverse(values[part.places]) for part in self.parts)])

    def numbers(self, u, xp: Any = np):
        """All numbers (P,) where the free ones stand at u (F,)."""
        if xp is np:
            values = self.first.copy()
            values[self.places] = self.values(u)
            return values
        return xp.asarray(self.first, u.dtype).at[self.places].set(self.values(u, xp))

    def values(self, u, xp: Any = np):
        """The free numbers (X,) at u (F,)."""
        parts = [part.transform.value(u[own], xp) for own, _, part in self._cuts]
        return xp.concatenate([u[:0], *parts])

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """The derivative of the free numbers by u, (X, F)."""
        matrix = np.zeros((len(self.names), len(self)))
        for own, rows, part in self._cuts:
            matrix[rows, own] = part.transform.jacobian(u[own])
        return matrix

    def directions(self, u: np.ndarray) -> np.ndarray:
        """The derivative of all numbers by u, with a row for each unknown, (F, P)."""
        rows = np.zeros((len(self), len(self.first)))
        rows[:, self.places] = self.jacobian(u).T
        return rows

    def ends(self, u: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The ends (X,) of intervals of the free numbers at u (F,), of half widths `spread` (X,), inside their sets."""
        x, low, high = self.values(u), np.empty(len(spread)), np.empty(len(spread))
        for _, rows, part in self._cuts:
            low[rows], high[rows] = part.transform.ends(x[rows], spread[rows])
        return low, high

    def covariance(self, u: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """The covariance (X, X) of the free numbers from that of u (F, F).

        What moves with an unknown of infinite variance has infinite variance, and NaN beside it.
        """
        jacobian, unseen = self.jacobian(u), ~np.isfinite(np.diag(matrix))
        finite = np.where(unseen[:, None] | unseen, 0.0, matrix)
        moved = jacobian @ finite @ jacobian.T
        lost = (jacobian[:, unseen] != 0).any(axis=1)
        moved[lost], moved[:, lost] = np.nan, np.nan
        moved[lost, lost] = np.inf
        return moved

    def log_volume(self, u, xp: Any = np):
        """log of the volume of the free numbers per volume of u, up to a constant."""
        return sum(part.transform.log_volume(u[own], xp) for own, _, part in self._cuts)

    def draw(self, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Another u (F,) to begin a search from."""
        return np.concatenate([u[:0], *(part.transform.draw(u[own], rng) for own, _, part in self._cuts)])

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the unknowns (F,): as their numbers, or as the whole leaf that they move together."""
        found = []
        for own, rows, part in self._cuts:
            together = [part.label] * (own.stop - own.start)
            found += self.names[rows] if part.transform.separable else together
        return tuple(found)

    def limits(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) between which one step of the search from u (F,) may lie."""
        pairs = [part.transform.limits(u[own]) for own, _, part in self._cuts]
        low, high = (np.concatenate([np.zeros(0), *ends]) for ends in zip(*pairs, strict=True)) if pairs else (u, u)
        return low, high

    def take_step(self, u: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The end of a step (F,) from u (F,): along the tangent of x(u), where every number moves by itself."""
        parts = [part.transform.take_step(u[own], step[own]) for own, _, part in self._cuts]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def maps(self) -> tuple[AbstractTransform, ...]:
        """The transform of each unknown (F,)."""
        return tuple(part.transform for own, _, part in self._cuts for _ in range(own.stop - own.start))

    @property
    def reach(self) -> np.ndarray:
        """The largest change of each u (F,) in one step."""
        return self._gather_attribute("reach")

    @property
    def room(self) -> np.ndarray:
        """The distance from one value of each u (F,) at which others are distinct."""
        return self._gather_attribute("room")

    def _gather_attribute(self, name: str) -> np.ndarray:
        rows = (np.full(own.stop - own.start, getattr(part.transform, name)) for own, _, part in self._cuts)
        return np.concatenate([np.zeros(0), *rows])

    def sizes(self, u: np.ndarray) -> np.ndarray:
        """Changes of u (F,), each of which changes the free numbers by about their own size."""
        x, jacobian = self.values(u), self.jacobian(u)
        size = np.where(x != 0, np.abs(x), 1.0)
        return np.minimum(1.0 / (np.abs(jacobian) / size[:, None]).max(axis=0, initial=1e-300), self.reach)

    def row(self, name: str) -> int:
        """The place among the free numbers of the one of this name, or of the only one whose name ends in it.

        `dry` is `params['joint']['dry']`, `l[1]` is `params['l'][1]`. Raises `ValueError` where none or several are.
        """
        if name in self.names:
            return self.names.index(name)
        cut = name.rfind("[") if name.endswith("]") else len(name)
        key, index = name[:cut], name[cut:]
        ends = f"[{key!r}]{index}", f".{key}{index}"
        rows = [k for k, own in enumerate(self.names) if own.endswith(ends)]
        if len(rows) != 1:
            several = [self.names[k] for k in rows]
            reason = f"{name!r} may be {', '.join(several)}" if rows else f"No free parameter is called {name!r}"
            raise ValueError(f"{reason}; there are {', '.join(self.names) or 'none: all are kept'}.")
        return rows[0]

    def unknown(self, name: str) -> int:
        """The place of the unknown that moves the free number of this name (`row`) alone.

        Raises `ValueError` where there is no such number, or where it moves only together with others.
        """
        row = self.row(name)
        name = self.names[row]
        own, rows, part = next(cut for cut in self._cuts if cut[1].start <= row < cut[1].stop)
        if not part.transform.separable:
            raise ValueError(
                f"{name} moves only together with the other numbers of {part.label}, whose transform is "
                f"{part.transform!r}: one of them cannot be kept while the others move."
            )
        return own.start + row - rows.start

    def fix(self, u: np.ndarray, which: int | None = None) -> "Parameters":
        """The parameters at u (F,), where the unknown `which` of a number of its own is kept there; None: all are."""
        at, parts, names = replace(self, first=self.numbers(u)), [], []
        for own, rows, part in self._cuts:
            if which is None:
                continue
            keep = np.ones(len(part.places), bool)
            if own.start <= which < own.stop:
                keep[which - own.start] = False
            if keep.any():
                parts.append(part._replace(places=part.places[keep]))
            names += [name for name, stays in zip(self.names[rows], keep, strict=True) if stays]
        return replace(at, parts=tuple(parts), names=tuple(names))

    def restore(self, numbers) -> PyTree:
        """The user's pytree of all numbers (P,)."""
        leaves, begin = [], 0
        for leaf in self.leaves:
            if eqx.is_array_like(leaf):
                end = begin + np.size(leaf)
                leaf = numbers[begin:end].reshape(np.shape(leaf)).astype(np.asarray(leaf).dtype)
                begin = end
            leaves.append(leaf)
        return jax.tree.unflatten(self.tree, leaves)


def _broadcast_prefix(prefix: PyTree, tree, leaves: list, name: str) -> list:
    """A prefix of the parameters spread over every leaf. Raises `ValueError` where it is no prefix."""
    whole = jax.tree.unflatten(tree, leaves)
    try:
        spread = jax.tree.broadcast(prefix, whole, is_leaf=lambda leaf: leaf is None)
        return tree.flatten_up_to(spread)
    except ValueError:
        raise ValueError(
            f"{name} must be one value for all parameters, or name every one of them as params0 does; got {prefix!r}. "
            f"The parameters are {', '.join(labelled_leaves(whole, 'params')[0][:12])}."
        ) from None


def _fitted_mask(label: str, leaf, may_move, free) -> np.ndarray:
    """True for each number of a leaf (n,) that is fitted. Raises where the user asks to fit one that cannot move."""
    wanted = np.asarray(may_move)
    if wanted.dtype != bool:
        raise TypeError(f"free must hold True or False; got {may_move!r} for {label}.")
    if wanted.shape not in ((), np.shape(leaf)):
        raise ValueError(
            f"free must hold True, False, or an array of them of the shape {np.shape(leaf)} for {label}; got one of "
            f"the shape {wanted.shape}."
        )
    if not np.issubdtype(np.asarray(leaf).dtype, np.floating):
        if wanted.any() and free is not None and free is not True:
            raise TypeError(f"{label} is free but not a float: write 1.0 instead of 1, or leave it out of `free`.")
        return np.zeros(np.size(leaf), bool)
    return np.broadcast_to(wanted, np.shape(leaf)).ravel()


def _split_by_transform(
    label: str, transform, fitted: np.ndarray, shape: tuple[int, ...]
) -> list[tuple[Any, np.ndarray]]:
    """Neighbours among the fitted numbers of a leaf that share a transform, each with their places in it, in order."""
    places = np.flatnonzero(fitted)
    if not isinstance(transform, np.ndarray):
        return [(transform, places)]
    if transform.shape != shape:
        raise ValueError(
            f"transforms must hold one for {label}, or an array of them of its shape {shape}; got one of the shape "
            f"{transform.shape}."
        )
    each = transform.ravel()
    edges = [k for k in range(1, len(places)) if each[places[k]] != each[places[k - 1]]]
    return [(each[some[0]], some) for some in np.split(places, edges)]


def _specialize_transform(label: str, transform, values: np.ndarray, shape: tuple[int, ...]) -> AbstractTransform:
    """The transform of a free leaf. Raises where it is none, or where the values start outside of its set."""
    transform = Unbounded() if transform is None else transform
    if not isinstance(transform, AbstractTransform):
        raise TypeError(
            "transforms must hold lagjax.positive, lagjax.between(a, b), lagjax.angle, lagjax.simplex, lagjax.inertia "
            f"or None; got {transform!r} for {label}."
        )
    if reason := transform.refuses(values):
        raise ValueError(f"{label} {reason}; got {values if values.size > 1 else values[0]}.")
    return transform.specialize(values, shape)
