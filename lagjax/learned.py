r"""Functions that nobody wrote down, learned from recordings by `lagjax.fit`, and physical whatever their numbers are.

- `potential`: energy of a place; forces that follow from it conserve energy
- `dissipation`: a force of friction, which never drives
- `inertia`: a positive inertia of a place
- `FreeFunction`: what they return

Each is made of one spline S of one, two or three numbers: a cubic B-spline with evenly spaced knots, whose second
derivative is zero at the ends of its range and which is a straight line beyond, so that S, S′ and S″ are continuous
everywhere. How smooth S is, the recordings decide: a prior density proportional to exp(−λ/2 ∫ |S″|²) belongs to it,
and `fit` finds λ by evidence.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit import AbstractLaw, LawParameters, Smooth

__all__ = ["FreeFunction", "dissipation", "inertia", "potential"]

_FEWEST_KNOTS = 4  # knots of an axis: with fewer there is no spline that is not made of its ends
_MOST_ARGUMENTS = 3  # the entries of a step grow as 4ᵈ
# Coefficient k of the four of a piece by powers of the place s in it, 0 ≤ s < 1: Σ s^p _INNER[k, p].
_INNER = np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]) / 6.0


@dataclass(frozen=True)
class _SplineAxis:
    """One argument of a spline: `count` even knots from `low` to `high`; a periodic axis lacks the last one.

    `is_size`: the argument is |v| ≥ `low`, so that the first knot is no border of machine code.
    """

    low: float
    high: float
    count: int
    periodic: bool
    is_size: bool = False

    @property
    def step(self) -> float:
        return (self.high - self.low) / (self.count if self.periodic else self.count - 1)

    @property
    def knots(self) -> np.ndarray:
        return self.low + self.step * np.arange(self.count)

    @functools.cached_property
    def pieces(self) -> np.ndarray:
        """The cubic polynomials (K, 4, 4) of the K pieces, the first before the range and the last behind it."""
        if self.periodic:
            return _INNER[None]
        n = self.count
        found = np.tile(_INNER, (n + 1, 1, 1))
        for piece, outer, edge, inner in ((1, 0, 1, 2), (n - 1, 3, 2, 1)):  # the coefficient beyond is on the line
            found[piece, edge] += 2.0 * _INNER[outer]
            found[piece, inner] -= _INNER[outer]
            found[piece, outer] = 0.0
        found[0] = [[0, 0, 0, 0], [0, 0, 0, 0], [2, -1, 0, 0], [-1, 1, 0, 0]]
        found[n] = [[0, -1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
        return found

    def locate(self, x) -> tuple:
        """Return the polynomials (…, 4, 4) of the piece that contains x, indices (…, 4) of its coefficients, and s."""
        u, four = (x - self.low) / self.step, np.arange(-1, 3)
        table = self.pieces.astype(u.dtype)
        if self.periodic:
            whole = jnp.floor(u)
            place = whole[..., None] + four.astype(u.dtype)
            place = (place - self.count * jnp.floor((place + 0.5) / self.count)).astype(int)
            return jnp.asarray(table[0]), jnp.clip(place, 0, self.count - 1), u - whole
        knots = jnp.asarray(np.arange(self.is_size, self.count), u.dtype)
        piece = self.is_size + jnp.searchsorted(knots, u, side="right")
        place = jnp.clip(piece[..., None] - 1 + four, 0, self.count - 1)
        return jnp.asarray(table)[piece], place, u - (piece - 1).astype(u.dtype)

    def rows(self, x: np.ndarray, order: int = 0) -> np.ndarray:
        """Return derivative number `order` of the basis at x (Q,) in the range, (Q, count)."""
        u = (x - self.low) / self.step
        piece = np.clip(np.floor(u).astype(int), 0, self.count - 1 if self.periodic else self.count - 2)
        powers = np.polynomial.polynomial.polyvander(u - piece, 3)
        factors = [math.perm(p, order) if p >= order else 0 for p in range(4)]
        powers = np.pad(powers, ((0, 0), (order, 0)))[:, :4] * factors / self.step**order
        table = self.pieces[np.zeros_like(piece) if self.periodic else piece + 1]
        weights, found = np.einsum("qkp,qp->qk", table, powers), np.zeros((len(x), self.count))
        for k in range(4):
            place = piece - 1 + k
            place = place % self.count if self.periodic else np.clip(place, 0, self.count - 1)
            np.add.at(found, (np.arange(len(x)), place), weights[:, k])
        return found

    def grams(self) -> list[np.ndarray]:
        """Return ∫ B⁽ʳ⁾ᵢ B⁽ʳ⁾ⱼ over the range for r = 0, 1, 2, each (count, count); the range has length one."""
        length, count = self.high - self.low, self.count if self.periodic else self.count - 1
        nodes, weights = np.polynomial.legendre.leggauss(4)  # exact to degree 7
        x = (self.low + self.step * (np.arange(count)[:, None] + 0.5 * (nodes + 1.0))).ravel()
        w = np.tile(0.5 * weights / count, count)
        rows = [length**order * self.rows(x, order) for order in range(3)]
        return [one.T @ (w[:, None] * one) for one in rows]


@dataclass(frozen=True, eq=False)
class FreeFunction(AbstractLaw):
    """A function of a scene by a spline that is learned; what `potential`, `dissipation` and `inertia` return.

    `params0` is where a fit begins: `{"spline": zeros}`, in the structure of its knots. `knots` are those of every
    argument. Call it with its arguments, numbers or arrays (…), or those of several side by side in the last axis of
    one array, and with its branch of the parameters: `V(q, params=params["V"])`.
    """

    kind: str
    axes: tuple[_SplineAxis, ...]
    shape_value: Callable
    gauge: bool = False

    @functools.cached_property
    def params0(self) -> LawParameters:
        """Parameters {"spline": zeros}: a zero potential, friction of size one, an inertia of one."""
        return LawParameters(self, {"spline": np.zeros([axis.count for axis in self.axes])})

    @property
    def knots(self) -> tuple[np.ndarray, ...]:
        """The knots of each argument, in order."""
        return tuple(axis.knots for axis in self.axes)

    def __repr__(self) -> str:
        ranges = ", ".join(f"{a.count} knots from {a.low:g} to {a.high:g}" for a in self.axes)
        return f"lagjax.learned.{self.kind} of {ranges}"

    def __call__(self, *arguments, params: Mapping[str, Any]):
        """The value (…) at the arguments, each (…)."""
        coefficients = self._read_numbers(params)
        if len(arguments) == 1 < len(self.axes):
            whole = jnp.asarray(arguments[0])
            if not (whole.ndim and whole.shape[-1] == len(self.axes)):
                raise TypeError(f"{self!r} takes {len(self.axes)} numbers; got one argument of shape {whole.shape}.")
            arguments = tuple(whole[..., k] for k in range(len(self.axes)))
        if len(arguments) != len(self.axes):
            raise TypeError(f"{self!r} takes {len(self.axes)} argument(s); got {len(arguments)}.")
        kind = jnp.result_type(float, coefficients, *arguments)
        return self._evaluate(coefficients, *(jnp.asarray(x, kind) for x in arguments))

    @functools.partial(jax.jit, static_argnums=0, inline=True)  # outside of `jit` one program
    def _evaluate(self, coefficients, *x):
        return self.shape_value(functools.partial(self._spline, coefficients), *x)

    def interpolate(self, function: Callable) -> LawParameters:
        """The parameters whose spline takes at its knots the values that `function` of the same arguments gives: where
        a fit begins that knows more than nothing.

        Of a potential `function` is the potential, up to a constant; of an inertia the inertia; of dissipation the
        size of the force, or with `dry=False` the size of the force over the speed. Raises `ValueError` where the last
        three are not positive.

        ```python
        import lagjax

        V = lagjax.learned.potential((-1.0, 1.0))
        print(V(0.5, params=V.interpolate(lambda q: 2 * q**2)))  # 0.5
        ```
        """
        grid = np.meshgrid(*self.knots, indexing="ij")
        values = np.vectorize(function, otypes=[float])(*grid)
        if not np.isfinite(values).all() or (not self.gauge and (values <= 0).any()):
            wanted = "finite" if self.gauge else "positive and finite"
            raise ValueError(f"The function that {self!r} begins at must be {wanted} at all knots; got {values}.")
        values = values if self.gauge else np.log(values)
        for axis in self.axes:  # the first axis is solved for, and becomes the last
            values = np.tensordot(values, np.linalg.inv(axis.rows(axis.knots)), axes=(0, 1))
        return LawParameters(self, {"spline": values})

    def _read_numbers(self, params):
        wanted = tuple(axis.count for axis in self.axes)
        if not (isinstance(params, Mapping) and "spline" in params) or jnp.shape(params["spline"]) != wanted:
            raise TypeError(
                f"params of {self!r} must hold 'spline' of shape {wanted}: give V(q, params=params['V']) the branch of "
                f"the parameters that begins as V.params0; got {params!r}."
            )
        return jnp.asarray(params["spline"])

    def _spline(self, coefficients, *x):
        """Return the spline S at arguments x, each (…)."""
        x = jnp.broadcast_arrays(*x)
        found = [axis.locate(one) for axis, one in zip(self.axes, x, strict=True)]
        count, batch = len(x), x[0].ndim
        index = [
            jnp.expand_dims(place, [batch + j for j in range(count) if j != k]) for k, (_, place, _) in enumerate(found)
        ]
        value = coefficients[tuple(index)]
        for table, _, _ in found:  # of each axis in turn the first; its powers become the last
            value = jnp.einsum("...kp,...kr->...rp", table, value.reshape(*x[0].shape, 4, -1))
            value = value.reshape(*x[0].shape, *[4] * count)
        for _, _, s in found[::-1]:
            s = jnp.expand_dims(s, range(batch, value.ndim - 1))
            value = value[..., 0] + s * (value[..., 1] + s * (value[..., 2] + s * value[..., 3]))
        return value

    @functools.cached_property
    def transforms(self) -> dict[str, Smooth]:
        """The transform for `fit`: numbers have a prior of smoothness, ∫ |S″|² over the range scaled to unit sides."""
        grams, count = [axis.grams() for axis in self.axes], len(self.axes)
        total = np.zeros(2 * (math.prod(axis.count for axis in self.axes),))
        for i in range(count):
            for j in range(count):
                orders = [(i == k) + (j == k) for k in range(count)]
                total += functools.reduce(np.kron, [grams[k][order] for k, order in enumerate(orders)])
        return {"spline": Smooth.from_roughness(total, self.gauge, self.knots[0] if count == 1 else None)}


def potential(range: Any, count: Any = 20, periodic: Any = False) -> FreeFunction:
    r"""A potential that nobody knows, V(q) = S(q) − S(c), where c is the middle of the range: so V(c) = 0 is its gauge.

    Use it in a Lagrangian: `lambda q, qdot, params: 0.5 * qdot**2 - V(q, params=params["V"])`.

    **Takes**

    - `range`: (low, high) of its argument, wherever the motion is expected; ((a, b), (c, d)) for two arguments, or
      three. Beyond it V is a straight line, continuous with its first two derivatives.
    - `count`: knots of every argument, 4 or more: enough for the finest shape that you expect. More cost little, since
      the smoothness is found by evidence; where the data determine a number at every knot, the fit asks for more.
    - `periodic`: whether the range is a period, of an angle for instance; of several arguments each.

    **Gives** a `FreeFunction`, called as `V(q, params=…)`; `V.params0` is where a fit begins.

    Derivatives of V are those of the spline, by JAX; in machine code it is a look-up, and a step ends at every knot.
    V is linear in its numbers.

    **Raises** `TypeError` or `ValueError` for ranges that do not increase and fewer than four knots.

    Source: Eilers & Marx, Statistical Science 11 (1996) 89, for B-splines with a penalty; Wood, *Generalized Additive
    Models* (2017), §5.3, for the smoothness by evidence.

    ```python
    import numpy as np, lagjax

    V = lagjax.learned.potential((-1.5, 1.5), count=12)
    scene = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 - V(q, params=params["V"]))
    double_well = {"V": V.interpolate(lambda q: 0.25 * q**4 - 0.5 * q**2)}
    motion = lagjax.simulate(scene, 1.2, 0.0, np.linspace(0.0, 10.0, 101), double_well)
    print(motion.q[-1])
    ```
    """
    axes = _read_axes(range, count, periodic)
    middle = [0.5 * (axis.low + axis.high) for axis in axes]

    def energy(spline, *x):
        return spline(*x) - spline(*(jnp.asarray(c, x[0].dtype) for c in middle))

    return FreeFunction("potential", axes, energy, gauge=True)


def inertia(range: Any, count: Any = 20, periodic: Any = False) -> FreeFunction:
    """An inertia that nobody knows, M(q) = exp S(q): positive whatever its numbers are, one where they are zero.

    Use it in a Lagrangian: `lambda q, qdot, params: 0.5 * M(q, params=params["M"]) * qdot**2`. Arguments, result,
    errors and source are those of `lagjax.learned.potential`; the fit moves the logarithm of M.

    ```python
    import lagjax

    M = lagjax.learned.inertia((-3.2, 3.2), count=16)
    crank = lagjax.System(lambda q, qdot, params: 0.5 * M(q, params=params["M"]) * qdot**2)
    print(crank.energy(0.3, 2.0, 0.0, {"M": M.params0}))  # 2
    ```
    """
    return FreeFunction("inertia", _read_axes(range, count, periodic), lambda spline, *x: jnp.exp(spline(*x)))


def dissipation(range: Any, count: Any = 20, *, dry: bool = True, odd: bool = True) -> FreeFunction:
    r"""A force of friction that nobody knows, against the velocity v whatever its numbers are: power R(v) v ≤ 0.

        dry         R(v) = −sign(v) exp S(|v|)     jumps at rest: the motion sticks there
        dry=False   R(v) = −v exp S(|v|)           fades at rest

    With `odd=False` S is a function of v, and friction differs from one direction to the other. Of two or three
    arguments the first is the velocity, and S depends on the others as well: a load, a place, a temperature.

    Use it as a force: `System(L, forces=lambda q, qdot, params: R(qdot, params=params["R"]))`. The size of the force is
    one where its numbers are zero; `R.interpolate(lambda v: 20.0)` begins at another one.

    **Takes** `range`: (low, high) of |v|, or of v with `odd=False`; and `count`, as `lagjax.learned.potential` does.

    **Gives** a `FreeFunction`, called as `R(v, params=…)`. Beyond the range the force grows, or falls, as a power of e.

    **Raises** what `lagjax.learned.potential` does, and `ValueError` for a range of |v| with a negative end.

    ```python
    import numpy as np, lagjax

    R = lagjax.learned.dissipation((0.0, 2.0), count=12)
    block = lagjax.System(
        lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, forces=lambda q, qdot, params: R(qdot, params=params["R"])
    )
    stribeck = {"R": R.interpolate(lambda v: 0.1 + 0.1 * np.exp(-v / 0.2) + 0.05 * v)}
    print(lagjax.simulate(block, 1.0, 0.0, np.linspace(0.0, 10.0, 101), stribeck).q[-1])
    ```
    """
    axes = _read_axes(range, count, False)
    axes = replace(axes[0], is_size=odd and axes[0].low == 0.0), *axes[1:]
    if odd and axes[0].low < 0.0:
        raise ValueError(
            f"The range of an odd force of friction is that of |v|, which is not negative; got {axes[0].low:g}. With "
            "odd=False it is that of v."
        )

    def force(spline, v, *others):
        size = jnp.exp(spline(jnp.abs(v) if odd else v, *others))
        return -jnp.sign(v) * size if dry else -v * size

    return FreeFunction("dissipation", axes, force)


def _read_axes(ranges: Any, count: Any, periodic: Any) -> tuple[_SplineAxis, ...]:
    pairs: Any = np.zeros(0)
    with contextlib.suppress(TypeError, ValueError):  # what is no numbers is refused below
        pairs = np.atleast_2d(np.asarray(ranges, float))
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not 1 <= len(pairs) <= _MOST_ARGUMENTS:
        raise ValueError(f"range must be (low, high), or one to three of them; got {ranges!r}.")
    counts, around = ([x] * len(pairs) if np.ndim(x) == 0 else list(x) for x in (count, periodic))
    if len(counts) != len(pairs) or len(around) != len(pairs):
        raise ValueError(f"count and periodic must be one for all {len(pairs)} arguments, or one for each.")
    axes = []
    for (low, high), n, is_periodic in zip(pairs.tolist(), counts, around, strict=True):
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"range must increase, between finite ends; got ({low:g}, {high:g}).")
        if not isinstance(n, int | np.integer) or n < _FEWEST_KNOTS:
            raise ValueError(f"count must be a whole number, {_FEWEST_KNOTS} or larger; got {n!r}.")
        axes.append(_SplineAxis(low, high, int(n), bool(is_periodic)))
    return tuple(axes)
