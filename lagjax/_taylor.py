r"""The Taylor series method, as a solver of diffrax.

With x from 0 to 1 along a step of size h, ẏ = f(t, y) reads dy/dx = h f. The coefficients of y(x) = Σ yₖ xᵏ follow from

    yₖ₊₁ = h fₖ / (k+1)        fₖ: coefficient of order k of f(t(x), y(x)), from orders 0 … k of t and y

and a step of order p is the polynomial itself: its value at x = 1 is the next state, its value between is the output.

    vector field ──lower──► scalar program ──series──► start, sweep ──emit──► coefficients ──► step

`start` gives f₀ and what the recurrences need at order zero, `sweep` gives fₖ; both are one compiled body each, however
often they are called. In between stand the sums Σ aⱼ bₖ₋ⱼ of the products (see `_program._series`): one array operation
an order, for all products together. Because the coefficients contain the powers of h they neither overflow nor
underflow, even in float32.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.flatten_util import ravel_pytree

from lagjax._program import Series, Unlowerable, emit, lower, plain_elementary, series

PyTree = Any


class Taylor(diffrax.AbstractAdaptiveSolver):
    r"""The Taylor series method: yₙ₊₁ = yₙ + Σ yₖ hᵏ, 0 < k ≤ p, with the derivatives by recurrences, not differences.

    The method for tight tolerances: its order is whatever one asks for, and its output between steps is as good as the
    steps. The order p that needs least work at a relative tolerance is p ≈ 2 − ln(rtol)/2: 9 for 1e-6, 13 for 1e-9,
    16 for 1e-12. It is between 4 and 20.

    For a single `ODETerm` with any vector field that has a scalar program: arithmetic, elementary functions, loops of
    known length, a few thousand operations; the state is any pytree of floats. Jit, vmap, forward and reverse mode work
    as with any solver of diffrax. Two things to know:

    - The vector field is traced when a step is compiled, and its derivatives are those of the arithmetic found there:
      a `custom_jvp` in it is not asked.
    - It must be smooth where a step begins. Where a step crosses a border (`abs`, `where`, a contact) its error shows
      at its end, and the step is shortened until it fits, as with other solvers.

    The error estimate is, per component, the largest of

        |y_p|        |y_p₋₁| / e²        |P′(1) − h f(P(1))| / (p+1)

    with the powers of h in the coefficients. The first two are the a-priori estimate of Jorba and Zou: at the order
    above terms fall by e² each. The third is the defect of the polynomial P in the equation at the end of the step: the
    first term left out, where f is smooth, and it sees what no coefficient can: a border that was crossed.

    Raises `ValueError` for another order, and, when a step is traced, for a vector field without a series, naming the
    operation to blame.

    Source: Jorba & Zou, *A software package for the numerical integration of ODEs by means of high-order Taylor
    methods*, Exp. Math. 14 (2005) 99–117, §2.1, §3.2.

    ```python
    import diffrax, jax.numpy as jnp
    from lagjax._taylor import Taylor

    diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, k: {"q": y["v"], "v": -k * jnp.sin(y["q"])}),
        Taylor(13),
        0.0, 5.0, None, {"q": jnp.array(1.0), "v": jnp.array(0.0)}, jnp.array(9.81),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
    )
    ```
    """

    degree: int = eqx.field(static=True)

    interpolation_cls: ClassVar[Callable]

    def __init__(self, order: int = 12):
        if isinstance(order, bool) or not isinstance(order, int) or not 4 <= order <= 20:
            raise ValueError(f"Taylor takes a whole number from 4 to 20 as its order; got {order!r}.")
        self.degree = order

    @property
    def term_structure(self):
        """One term, of an ordinary differential equation."""
        return diffrax.ODETerm

    def order(self, terms) -> int:
        """p: the polynomial leaves out hᵖ⁺¹."""
        return self.degree

    def error_order(self, terms) -> int:
        """p: the error estimate is its last term."""
        return self.degree

    def init(self, terms, t0, t1, y0, args):
        """Nothing is kept from one step to the next."""
        return None

    def func(self, terms, t0, y0, args):
        """The slope."""
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step, its error estimate, and its polynomial."""
        y, restore = ravel_pytree(y0)
        # Where time runs backward, diffrax counts it forward and turns the sign of `contr`.
        span, h = (jnp.asarray(x, y.dtype) for x in (t1 - t0, terms.contr(t0, t1)))
        field = _Field(self._series_of(terms, t0, y0, args), y.dtype)
        coefficients = field.coefficients(t0, y, span, h, self.degree)
        y1 = y + _horner(coefficients, 1)
        slope = sum(k * c for k, c in enumerate(coefficients, start=1))
        defect = slope - h * field.slope(t1, y1)
        last, before = coefficients[-1], coefficients[-2] / math.e**2
        error = jnp.maximum(jnp.maximum(abs(last), abs(before)), abs(defect) / (self.degree + 1))
        # Step sizes are not differentiated, as everywhere in diffrax.
        error, dense = restore(jax.lax.stop_gradient(error)), {"y0": y0, "coefficients": coefficients}
        return restore(y1), error, dense, None, diffrax.RESULTS.successful

    def _series_of(self, terms, t, y, args) -> tuple[Series, list[jax.Array]]:
        try:
            return _lowered(terms, t, y, args)
        except Unlowerable as reason:
            raise ValueError(
                f"Taylor({self.degree}) needs the Taylor series of the vector field, and there is none: {reason}. "
                "A Runge-Kutta solver takes any vector field: diffrax.Dopri8(), for example."
            ) from None


def _lowered(terms, t, y, args) -> tuple[Series, list[jax.Array]]:
    """The recurrences of the vector field, and the numbers in it that JAX is tracing (parameters), one by one."""
    with plain_elementary():  # a program of lagjax inside shows its `sin`, not the polynomial behind it
        closed = eqx.filter_closure_convert(terms.vf, t, y, args)
    # A number that is known already is folded into the program; what is traced becomes an input of it.
    traced, known = eqx.partition((closed, args), lambda x: isinstance(x, jax.core.Tracer))

    def slope(y, t, traced):
        field, args = eqx.combine(traced, known)
        return field(t, y, args)

    program = lower(slope, y, t, traced)
    size = sum(jnp.size(leaf) for leaf in jax.tree.leaves(y))
    numbers = [x for leaf in jax.tree.leaves(traced) for x in ([leaf] if jnp.ndim(leaf) == 0 else jnp.ravel(leaf))]
    return series(program, size, moving=size + 1), numbers


class _Field:
    """The recurrences of one vector field, run in JAX in one precision."""

    def __init__(self, lowered: tuple[Series, list[jax.Array]], dtype):
        self.series, numbers = lowered
        self.dtype, self.size = dtype, self.series.size
        self.numbers = [x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x for x in numbers]
        self._start = jax.jit(lambda *scalars: emit(*self.series.start, scalars))
        self._sweep = jax.jit(self._order)

    def slope(self, t, y) -> jax.Array:
        """f(t, y), a vector as y is."""
        return jnp.stack(self._begin(t, y)[: self.size])

    def coefficients(self, t, y, span, h, order: int) -> tuple[jax.Array, ...]:
        """The vectors y₁ … y_p, when t = t₀ + `span` x and dy/dx = `h` f."""
        out, pairs = self._begin(t, y), []
        found, values = [tuple(h * slope for slope in out[: self.size])], out[self.size :]
        for k in range(1, order):
            time = span if k == 1 else jnp.zeros_like(span)
            numbers = (jnp.asarray(x, self.dtype) for x in (k, 1 / k, h / (k + 1)))
            # Sums go in whole: taken apart out here, XLA would fuse all of them into every one.
            following, rows = _compiled_once(self._sweep, found[-1], time, *numbers, values, self._sums(pairs))
            found.append(following)
            pairs.append(self._factors(rows))
        return tuple(jnp.stack(scalars) for scalars in found)

    def _begin(self, t, y) -> tuple:
        return _compiled_once(self._start, *y, jnp.asarray(t, self.dtype), *self.numbers)

    def _order(self, y, time, k, inverse_k, factor, values, sums) -> tuple[tuple, tuple]:
        """The coefficients of order k+1 of the state, and those of order k of the rows."""
        out = emit(*self.series.sweep, (*y, time, k, inverse_k, *values, *sums))
        return tuple(factor * slope for slope in out[: self.size]), out[self.size :]

    def _factors(self, rows) -> tuple[jax.Array, jax.Array] | None:
        """The first factor of every product, and the second, at one order."""
        if not self.series.products:
            return None
        first, second = zip(*self.series.products, strict=True)
        return jnp.stack([rows[a] for a in first]), jnp.stack([rows[b] for b in second])

    def _sums(self, pairs) -> jax.Array:
        """Σ aⱼ bₖ₋ⱼ over 0 < j < k for every product."""
        if not pairs or not self.series.products:
            return jnp.zeros(len(self.series.products), self.dtype)
        return sum(a * b for (a, _), (_, b) in zip(pairs, reversed(pairs), strict=True))


def _compiled_once(function, *arguments):
    """Call a jitted function without XLA inlining it: one compiled body, however many orders call it."""
    with set_xla_metadata(inlineable="false"):
        return function(*arguments)


def _horner(coefficients, x):
    """y₁ x + y₂ x² + …"""
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total * x


class _Polynomial(diffrax.AbstractLocalInterpolation):
    """The Taylor polynomial of a step, at both ends the state to the last bit: the same sums in the same order."""

    t0: jax.Array
    t1: jax.Array
    y0: PyTree
    coefficients: tuple[jax.Array, ...]

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        span = self.t1 - self.t0
        x = jnp.where(span == 0, 0, (t0 - self.t0) / jnp.where(span == 0, 1, span))
        y, restore = ravel_pytree(self.y0)
        return restore(y + _horner(self.coefficients, x.astype(y.dtype)))


Taylor.interpolation_cls = _Polynomial
