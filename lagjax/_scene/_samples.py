"""`samples`: a measured or designed input, given at instants, as a function of time."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from lagjax._interface import is_concrete
from lagjax._primitives import VaryingPrimitive

HOLDS = ("zero", "linear", "cubic", "band")
# Of "band": samples on either side of a time; the shape parameter of Kaiser's window; the degree of the polynomials in
# a piece. A unit sinusoid at 0.8 of the Nyquist frequency is off by 1e-5, below by less. A larger parameter is more
# exact at low frequencies and reaches less far (12: 2e-6 up to 0.7), half the samples reach 0.6. Degree 7 shows at 0.9.
_HALF, _KAISER, _DEGREE = 16, 10.0, 9
MARGINS = {"zero": 0, "linear": 0, "cubic": 1, "band": _HALF - 1}  # samples outside of a piece that count in it
_UNEVEN = 1e-3  # of the spacing, by which knots of "band" may be off: rounded times are, by what they are measured to


def samples(
    knots: Float[Any, " K"], values: Float[Any, " K *m"], hold: str = "zero"
) -> Callable[[Any], Float[Array, "*m"]]:
    r"""The function of time that has these `values` at these `knots`: for `forces`, a Lagrangian, a constraint.

    Between two knots, for xᵢ ≤ t < xᵢ₊₁ and with s = (t − xᵢ)/(xᵢ₊₁ − xᵢ),

        zero      u(t) = vᵢ                                the last sample stays until the next one (a D/A converter)
        linear    u(t) = (1 − s) vᵢ + s vᵢ₊₁
        cubic     u(t) = the cubic with the values vᵢ, vᵢ₊₁ and the slopes mᵢ, mᵢ₊₁ at its ends
        band      u(t) = Σⱼ vᵢ₊ⱼ w(s − j) sinc(s − j), over 16 samples on either side, for evenly spaced knots

    With "cubic" mᵢ is the slope at xᵢ of the parabola through the three samples about it, at the ends through the three
    nearest. That is `scipy.interpolate.CubicHermiteSpline(x, v, numpy.gradient(v, x, axis=0, edge_order=2))`: its slope
    is continuous, no sample matters farther than two knots away, and it may overshoot. It is not a natural spline,
    whose coefficients depend on all samples at once.

    "band" is band-limited interpolation: for inputs that were sampled, or generated, below the Nyquist frequency, as
    multisines and filtered noise are. w is Kaiser's window (β = 10) whose weights are scaled to the sum 1, and w sinc
    is in each piece its interpolating polynomial of degree 9. A sinusoid of up to 0.8 of the Nyquist frequency is right
    to 1e-5 of its size. At the ends, where 16 samples are missing, the input is taken to continue as its reflection
    in the last sample, 2 v₀ − v₋ⱼ: it is continuous with its slope, and as exact as that is for some samples. Constants
    and samples are exact. An input with jumps overshoots: for a D/A converter take "zero".

    There is no extrapolation: before the first knot u is NaN; after the last knot "zero" keeps the last sample, and u
    is NaN with the others; so it is with "band" between traced knots that are not even. The last knot itself is inside.
    A motion that reaches a time at which u is NaN fails there, with a sentence that says when.

    **Takes**

    - `knots` (K,): instants in increasing order, not necessarily evenly spaced but for "band"; K ≥ 2, or 1 with "zero".
    - `values` (K,) or (K, m): the samples. Both may be arrays of NumPy or JAX, or leaves of `params`.
    - `hold`: "zero", "linear", "cubic" or "band".

    **Gives** u, a function of a time () that returns () or (m,); or of times (…), that returns (…) or (…, m).

    u is a plain JAX function: it can be batched, compiled, and differentiated with respect to t, the values, and the
    knots except those where it jumps. In machine code a step ends exactly at every knot, without a search; entries are
    read where they are needed, and a gradient with respect to all samples costs as much as one with respect to a single
    number. This holds if knots and values are known numbers or unchanged leaves of `params`: compute with u(t) instead
    of with the values. Where u jumps, with "zero", derivatives of the motion with respect to the values are exact, and
    those with respect to the knots include the effect of a jump that comes later; so do second and third ones. Where
    knots of two inputs coincide, and one of them varies, its derivatives do not exist and are NaN. Adaptive steps of
    diffrax end at the knots of a scalar program, too.

    **Raises** `TypeError` or `ValueError` for knots that do not increase, shapes that do not fit, samples that are not
    finite, an unknown `hold`, and knots of "band" that are not evenly spaced. Only the shapes of traced arrays can
    be checked.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    knots = jnp.linspace(0.0, 2.0, 2001)[:-1]  # a force measured at 1 kHz


    def motor(q, qdot, t, params):
        return lagjax.samples(knots, params["force"])(t) - 0.3 * qdot


    axis = lagjax.System(lambda q, qdot: 0.5 * qdot**2, forces=motor)


    def end(force):
        return lagjax.simulate(axis, 0.0, 0.0, jnp.array([0.0, 2.0]), {"force": force}).q[-1]


    slopes = jax.grad(end)(jnp.sin(knots))  # by each of the 2000 samples
    ```
    """
    if hold not in HOLDS:
        raise ValueError(f"hold={hold!r} is not known. It is one of 'zero', 'linear', 'cubic' and 'band'.")
    knots, values = _check_samples(knots, values, hold)
    functions = {"zero": _held_value, "linear": _linear_value, "cubic": _cubic_value, "band": _band_limited_value}
    return functools.partial(functions[hold], knots, values)


def _check_samples(knots: Any, values: Any, hold: str) -> tuple:
    """Return knots and values as float arrays of one dtype; raise for samples that `samples` does not take."""
    arrays = []
    for name, x in (("knots", knots), ("values", values)):
        x = x if hasattr(x, "dtype") else np.asarray(x)
        if np.issubdtype(x.dtype, np.complexfloating) or x.dtype.kind not in "fiubV":
            raise TypeError(f"samples: `{name}` must be real numbers, not of type {x.dtype}.")
        arrays.append(x)
    knots, values = arrays
    least = 1 if hold == "zero" else 2
    if knots.ndim != 1 or len(knots) < least:
        raise ValueError(f"samples: `knots` must have the shape (K,) with K ≥ {least}, not {knots.shape}.")
    if values.ndim not in (1, 2) or len(values) != len(knots):
        raise ValueError(
            f"samples: `values` must have the shape (K,) or (K, m) with one row for each of {len(knots)} knots, not "
            f"{values.shape}."
        )
    if is_concrete(knots):
        _require_increasing(np.asarray(knots))
        if hold == "band" and (reason := unevenly_spaced(np.asarray(knots), "knots")):
            raise ValueError(f"samples: {reason}")
    if is_concrete(values) and not np.isfinite(np.asarray(values)).all():
        first = int(np.flatnonzero(~np.isfinite(np.asarray(values)).reshape(len(values), -1).all(axis=1))[0])
        raise ValueError(f"samples: values[{first}] is {np.asarray(values)[first]}, but samples are finite numbers.")
    dtype = jnp.result_type(float, *(x for x in (knots, values) if jnp.issubdtype(x.dtype, jnp.floating)))
    return tuple(np.array(x, dtype) if is_concrete(x) else x.astype(dtype) for x in (knots, values))


def _require_increasing(knots: np.ndarray) -> None:
    wrong = np.flatnonzero(~(np.diff(knots) > 0))
    if not np.isfinite(knots).all():
        first = int(np.flatnonzero(~np.isfinite(knots))[0])
        raise ValueError(f"samples: knots[{first}] is {knots[first]}, but knots must be finite numbers.")
    if wrong.size:
        i = int(wrong[0])
        raise ValueError(
            f"samples: knots must increase, but knots[{i + 1}] = {knots[i + 1]:g} comes after knots[{i}] = "
            f"{knots[i]:g}. Sort the samples by time, and keep one of those at the same time."
        )


def unevenly_spaced(knots: np.ndarray, name: str) -> str | None:
    """Return an error message if the knots (K,) are not evenly spaced, as "band" requires; else None."""
    knots = knots if knots.dtype.kind == "f" else knots.astype(float)
    steps, (spacing, tolerance) = np.diff(knots), _mean_spacing(knots[0], knots[-1], len(knots))
    i = int(np.argmax(np.abs(steps - spacing)))
    if abs(steps[i] - spacing) <= tolerance:
        return None
    return (
        f"hold='band' takes evenly spaced {name}, but {name}[{i + 1}] - {name}[{i}] = {steps[i]:g} where the mean is "
        f"{spacing:g}. Use hold='cubic', or bring the input to even instants first."
    )


def _mean_spacing(first, last, count: int) -> tuple:
    """Return the mean spacing of `count` knots, and the largest deviation from it that counts as even."""
    mean, eps = (last - first) / (count - 1), np.finfo(first.dtype).eps
    return mean, _UNEVEN * mean + 4 * eps * (abs(first) + abs(last))


def append_samples(values: np.ndarray, count: int, hold: str) -> np.ndarray:
    """Return `count` samples (count, …) to append to `values` (K, …), which keep the function on the given knots.

    A parabola for "cubic", the reflection for "band" (of 16 samples at least), else the last sample.
    """
    last, behind = values[-1], np.arange(1, count + 1)
    if hold == "band":
        return 2.0 * last - values[np.maximum(len(values) - 1 - behind, 0)]
    found = np.broadcast_to(last, (count, *values.shape[1:])).copy()
    if hold == "cubic" and count and len(values) > 2:
        found[0] = 3.0 * last - 3.0 * values[-2] + values[-3]
    elif hold == "cubic" and count and len(values) > 1:
        found[0] = 2.0 * last - values[-2]
    return found


# ---- the functions ---------------------------------------------------------------------------------------------------


@jax.jit
def _held_value(knots, values, t):
    t = jnp.asarray(t, knots.dtype)
    i = _locate_knots(knots, t, closed=False)
    (v,) = _table_window(values, i, 1)
    return jnp.where(_expand_like(i < 0, v), jnp.nan, v)


@jax.jit
def _linear_value(knots, values, t):
    t, (i, inside) = jnp.asarray(t, knots.dtype), _piece_index(knots, t)
    (x0, x1), (v0, v1) = _table_window(knots, i, 2), _table_window(values, i, 2)
    slope = jnp.where(_expand_like(inside, v0), (v1 - v0) / _expand_like(x1 - x0, v0), jnp.nan)
    return v0 + slope * _expand_like(t - x0, v0)


@jax.jit
def _cubic_value(knots, values, t):
    t, (i, inside) = jnp.asarray(t, knots.dtype), _piece_index(knots, t)
    (x0, x1), (v0, v1) = _table_window(knots, i, 2), _table_window(values, i, 2)
    step, s = _expand_like(x1 - x0, v0), _expand_like(t - x0, v0)
    chord = (v1 - v0) / step
    m0, m1 = _end_slopes(knots, values, i, chord)
    second, third = (3.0 * chord - 2.0 * m0 - m1) / step, (m0 + m1 - 2.0 * chord) / (step * step)
    m0 = jnp.where(_expand_like(inside, v0), m0, jnp.nan)  # and so is the slope of u
    return v0 + s * (m0 + s * (second + s * third))


@jax.jit
def _band_limited_value(knots, values, t):
    t, (i, inside) = jnp.asarray(t, knots.dtype), _piece_index(knots, t)
    (x0, x1), count = _table_window(knots, i, 2), len(knots)
    (begin,), (end,) = (_table_window(knots, jnp.full_like(i, k), 1) for k in (0, count - 1))
    spacing, tolerance = _mean_spacing(begin, end, count)
    inside &= abs(x1 - x0 - spacing) <= tolerance  # of known knots that was checked
    j = i[..., None] + np.arange(1 - _HALF, _HALF + 1, dtype=np.int32)
    # Inside the last two terms are zero; beyond an end they reflect.
    (first,), (last,) = (_table_window(values, jnp.full_like(j, k), 1) for k in (0, count - 1))
    (v,), (before,), (behind,) = (_table_window(values, at, 1) for at in (j, -j, 2 * (count - 1) - j))
    v = v + (first - before) + (last - behind)
    coefficients = jnp.tensordot(v, _weight_polynomials().astype(knots.dtype), axes=((i.ndim,), (1,)))
    total = [coefficients[..., d] for d in range(_DEGREE + 1)]
    c = _expand_like(2.0 * (t - x0) / (x1 - x0) - 1.0, total[0])
    total[1] = jnp.where(_expand_like(inside, total[1]), total[1], jnp.nan)
    return functools.reduce(lambda u, coefficient: coefficient + c * u, total[::-1])


@functools.cache
def _weight_polynomials() -> np.ndarray:
    """Return (10, 32): powers of c = 2 s − 1 in [−1, 1] by samples, of the weight of sample i − 15 + k in piece i."""
    # They interpolate at Chebyshev's points with both ends, so that u passes through its samples.
    nodes = -np.cos(np.pi * np.arange(_DEGREE + 1) / _DEGREE)
    distance = 0.5 * (nodes[:, None] + 1.0) - np.arange(1 - _HALF, _HALF + 1)
    weights = np.sinc(distance) * np.i0(_KAISER * np.sqrt(np.clip(1.0 - (distance / _HALF) ** 2, 0.0, 1.0)))
    weights /= weights.sum(axis=1, keepdims=True)
    return np.linalg.solve(np.vander(nodes, increasing=True), weights)


def _piece_index(knots, t):
    """Return the index of the piece that contains t, and True where t is between the first and the last knot."""
    i = _locate_knots(knots, jnp.asarray(t, knots.dtype), closed=True)
    return i, (i >= 0) & (i < len(knots) - 1)


def _end_slopes(knots, values, i, chord):
    """Return the slopes at both ends of piece i, of the parabolas through three samples; `chord` is its mean slope."""
    count = len(knots)
    if count == 2:
        return chord, chord
    size = min(count, 4)
    x, v = _table_window(knots, i - 1, size), _table_window(values, i - 1, size)
    steps = [_expand_like(b - a, v[0]) for a, b in itertools.pairwise(x)]
    chords = [(b - a) / step for (a, b), step in zip(itertools.pairwise(v), steps, strict=True)]

    def central_slope(k):  # sample k + 1 of the window
        return (steps[k + 1] * chords[k] + steps[k] * chords[k + 1]) / (steps[k] + steps[k + 1])

    def end_slope(one, other):  # of the first of two pieces, at its outer end
        return chords[one] - steps[one] * (chords[other] - chords[one]) / (steps[one] + steps[other])

    first, last = _expand_like(i <= 0, v[0]), _expand_like(i >= count - 2, v[0])
    left, right = central_slope(0), central_slope(size - 3)
    m0 = jnp.where(first, end_slope(0, 1), jnp.where(last, right, left))
    m1 = jnp.where(last, end_slope(-1, -2), jnp.where(first, left, right))
    return m0, m1


def _table_window(table, start, size: int) -> list:
    """Return entries `start`, …, `start + size − 1` of a table as a list; near an end the nearest window that fits."""
    where = start.ndim
    offsets = tuple(range(where, where + table.ndim))
    dimensions = jax.lax.GatherDimensionNumbers(offsets, collapsed_slice_dims=(), start_index_map=(0,))
    found = jax.lax.gather(table, start[..., None], dimensions, (size, *table.shape[1:]), mode="clip")
    return [jax.lax.index_in_dim(found, k, where, keepdims=False) for k in range(size)]


def _expand_like(x, v):
    """Append an axis to x, an array over times, if v also has columns, so that the two broadcast."""
    return x if x.ndim == v.ndim else x[..., None]


# ---- where a time is -------------------------------------------------------------------------------------------------


def _locate_knots(knots, t, closed: bool):
    """Return (number of knots ≤ t) − 1 as int32; with `closed` the last knot belongs to the last piece."""
    return _locate_p.bind(jnp.asarray(knots), t, closed=closed)


def _search_knots(knots, t, *, closed):
    i = jnp.searchsorted(knots, t, side="right").astype(np.int32) - 1
    if closed:
        i = jnp.where(t == knots[-1], len(knots) - 2, i)
    return jnp.where(jnp.isnan(t), -1, i).astype(np.int32)


def _batch_search(arguments, axes, *, closed):
    knots, t = arguments
    if axes[0] is None:  # knots that all share
        return _locate_p.bind(knots, t, closed=closed), axes[1]
    return jax.vmap(functools.partial(_search_knots, closed=closed), in_axes=tuple(axes))(knots, t), 0


def _search_jvp(primals, tangents, *, closed):
    found = _locate_p.bind(*primals, closed=closed)
    return found, ad.Zero(jax.typeof(found).to_tangent_aval())


_locate_p = VaryingPrimitive("lagjax_locate")  # `_tracing.lowering._rules` knows it by this name
_locate_p.def_impl(jax.jit(_search_knots, static_argnames="closed"))
_locate_p.def_abstract_eval(lambda knots, t, *, closed: ShapedArray(t.shape, np.dtype(np.int32)))
mlir.register_lowering(_locate_p, mlir.lower_fun(_search_knots, multiple_results=False))
ad.primitive_jvps[_locate_p] = _search_jvp
batching.primitive_batchers[_locate_p] = _batch_search
