"""Three bodies in double-double numbers (32 digits): the ends of arcs by power series, independent of the package.

Of three equal masses the positions x and y of two relative to the third follow, with z = x − y and f(r) = r / |r|³,

    ẍ = −2 f(x) − f(y) − f(z),   ÿ = −2 f(y) − f(x) + f(z)

A number is an unevaluated sum of two doubles. Eight motions are followed at once, in the lanes of vectors: their
numbers stand one behind the other in one array, 2 × 8 doubles each.

Source: Jorba & Zou, *A software package for the numerical integration of ODEs by means of high-order Taylor methods*,
Exp. Math. 14 (2005) 99; Dekker, *A floating-point technique for extending the available precision*, Numer. Math. 18
(1971) 224.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
ORDER = 28  # with steps of e⁻² of the radius of convergence the last terms are then 1e-25
LAST_TERMS = 1e-25  # of the size of a position, or a velocity
MOST_STEPS = 50_000


def ends(y: np.ndarray, span: np.ndarray, work: np.ndarray) -> np.ndarray:
    """The states (R, 2, 8) after times (R, 2) from (R, 2, 8): (x, y, ẋ, ẏ), two numbers each.

    Those that take about as much `work` (R,), the number of their steps, are followed together.
    """
    order = np.argsort(-work)
    padded = np.concatenate([order, np.repeat(order[-1:], -len(order) % LANES)])
    out, blocks = np.empty_like(y), padded.reshape(-1, LANES)

    def run(block):
        state = np.ascontiguousarray(y[block].transpose(2, 1, 0))
        _follow(state, np.ascontiguousarray(span[block].T))
        out[block] = state.transpose(2, 1, 0)

    run(blocks[-1])  # compiled before threads begin
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        _ = list(pool.map(run, blocks[:-1]))
    return out


def rate(y: np.ndarray) -> np.ndarray:
    """(ẋ, ẏ, ẍ, ÿ) of states (R, 8), in doubles."""
    places = np.stack([y[:, :2], y[:, 2:4], y[:, :2] - y[:, 2:4]])
    x, y_, z = places / np.linalg.norm(places, axis=2, keepdims=True) ** 3
    return np.concatenate([y[:, 4:], -2 * x - y_ - z, -2 * y_ - x + z], axis=1)


def add(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Double-double a (..., 2, ·) with b of doubles added, (..., ·)."""
    total = a[..., 0, :] + b
    part = total - a[..., 0, :]
    rest = (a[..., 0, :] - (total - part)) + (b - part) + a[..., 1, :]
    high = total + rest
    return np.stack([high, rest - (high - total)], axis=-2)


# Where numbers stand: r of x, y and z with two components each and their squares s and s^(−3/2), one order behind the
# other; 1/s, f, and what else a step needs.
PER_ORDER = 12
OF_S, OF_U = 6, 9
INVERSE = PER_ORDER * (ORDER + 1)
FORCE, WORK, STATE = INVERSE + 3, INVERSE + 9, INVERSE + 12
STEP, LEFT, NOTHING, ONE = STATE + 8, STATE + 9, STATE + 10, STATE + 11
NUMBERS = ONE + 1


class _Lanes:
    """Writes operations on numbers in vectors: of the array `m`, by their places."""

    def __init__(self, context, builder, kind, m):
        self.builder, self.base = builder, context.make_array(kind)(context, builder, m).data
        self.vector = ir.VectorType(ir.DoubleType(), LANES)
        signature = ir.FunctionType(self.vector, [self.vector] * 3)
        self.fused = cgutils.get_or_insert_function(builder.module, signature, f"llvm.fma.v{LANES}f64")
        self.add, self.sub, self.mul, self.div = builder.fadd, builder.fsub, builder.fmul, builder.fdiv

    def fma(self, *xs):
        return self.builder.call(self.fused, xs)

    def minus(self, x):
        return self.builder.fneg(x)

    def _halves(self, place):
        first = self.builder.mul(place, place.type(2 * LANES))
        for half in range(2):
            where = self.builder.gep(self.base, [self.builder.add(first, place.type(LANES * half))])
            yield self.builder.bitcast(where, self.vector.as_pointer())

    def load(self, place):
        return [self.builder.load(half, align=8) for half in self._halves(place)]

    def store(self, values, place):
        for value, half in zip(values, self._halves(place), strict=True):
            self.builder.store(value, half, align=8)

    def of(self, x):
        """A double in all lanes."""
        blank, one = ir.Constant(self.vector, ir.Undefined), ir.IntType(32)
        first = self.builder.insert_element(blank, x, one(0))
        return self.builder.shuffle_vector(first, blank, ir.Constant(ir.VectorType(one, LANES), [0] * LANES))

    def plus(self, total, term, rest):
        """total + term, by Knuth's two-sum; what rounding takes, and `rest`, is added to the second half."""
        before, low = total
        after = self.add(before, term)
        part = self.sub(after, before)
        off = self.add(self.sub(before, self.sub(after, part)), self.sub(term, part))
        return after, self.add(low, self.add(off, rest))

    def times(self, x, factor):
        """A whole number times a double-double, not settled."""
        high = self.mul(x[0], factor)
        return high, self.fma(x[1], factor, self.fma(x[0], factor, self.minus(high)))

    def settled(self, x):
        """As a double and what rounding took from it; for |x[0]| larger than |x[1]|."""
        high = self.add(*x)
        return high, self.sub(x[1], self.sub(high, x[0]))


def _operation(generate, indices: int, doubles: int):
    """A function of the array, places (indices) and factors (doubles), whose code `generate` writes."""
    kinds = [types.intp] * indices + [types.float64] * doubles

    def of_types(typing, m, *others):
        def codegen(context, builder, signature, arguments):
            generate(_Lanes(context, builder, signature.args[0], arguments[0]), *arguments[1:])
            return context.get_dummy_value()

        return types.void(m, *kinds), codegen

    names = ", ".join(f"x{k}" for k in range(len(kinds)))
    return intrinsic(eval(f"lambda typing, m, {names}: of_types(typing, m, {names})", {"of_types": of_types}))


def _sum_of_products(lanes: _Lanes, total, count, a, by_a, b, by_b, weight, more, by):
    """total = by (total + Σ (weight + j more) a_j b_j), j < count, with places so far apart; by is a power of two.

    Some fifteen operations of vectors for each j, without memory between them.
    """
    builder, double = lanes.builder, ir.DoubleType()
    sums = [cgutils.alloca_once_value(builder, x) for x in lanes.load(total)]
    with cgutils.for_range(builder, count, intp=count.type) as loop:
        x, y = (lanes.load(builder.add(first, builder.mul(loop.index, step))) for first, step in ((a, by_a), (b, by_b)))
        factor = lanes.of(builder.fadd(weight, builder.fmul(builder.sitofp(loop.index, double), more)))
        high = lanes.mul(x[0], y[0])
        low = lanes.add(lanes.fma(x[0], y[0], lanes.minus(high)), lanes.fma(x[0], y[1], lanes.mul(x[1], y[0])))
        before = tuple(builder.load(one) for one in sums)
        for value, one in zip(lanes.plus(before, *lanes.times((high, low), factor)), sums, strict=True):
            builder.store(value, one)
    settled = lanes.settled([builder.load(one) for one in sums])
    lanes.store([lanes.mul(x, lanes.of(by)) for x in settled], total)


def _weighted_sum(lanes: _Lanes, total, a, b, c, by_a, by_b, by_c):
    """total = by_a a + by_b b + by_c c, with whole numbers as factors."""
    terms = [lanes.times(lanes.load(x), lanes.of(by)) for x, by in ((a, by_a), (b, by_b), (c, by_c))]
    value = terms[0]
    for term in terms[1:]:
        value = lanes.plus(value, *term)
    lanes.store(lanes.settled(value), total)


def _quotient(lanes: _Lanes, total, k):
    """total /= k, a whole number."""
    (high, low), k = lanes.load(total), lanes.of(k)
    first = lanes.div(high, k)
    rest = lanes.div(lanes.add(lanes.fma(lanes.minus(first), k, high), low), k)
    lanes.store(lanes.settled((first, rest)), total)


_products = _operation(_sum_of_products, 6, 3)
_combine = _operation(_weighted_sum, 4, 3)
_divide = _operation(_quotient, 1, 1)
_compiled = numba.njit(nogil=True, error_model="numpy")


@_compiled
def _clear(m, place):
    for i in range(2 * LANES):
        m[2 * LANES * place + i] = 0.0


@_compiled
def _scale(m, place, by):
    """A number times powers of two, one for each lane, (8,)."""
    for i in range(LANES):
        m[2 * LANES * place + i] *= by[i]
        m[2 * LANES * place + LANES + i] *= by[i]


@_compiled
def _multiply(m, total, a, b):
    """total = a b."""
    _clear(m, total)
    _products(m, total, 1, a, 0, b, 0, 1.0, 0.0, 1.0)


@_compiled
def _start_power(m, u, inverse, s):
    """u = s^(−3/2) and inverse = 1/s, by Newton's method: each step doubles the digits."""
    for i in range(LANES):
        x = m[2 * LANES * s + i]
        m[2 * LANES * inverse + i], m[2 * LANES * u + i] = 1 / x, 1 / (x * np.sqrt(x))
        m[2 * LANES * inverse + LANES + i], m[2 * LANES * u + LANES + i] = 0.0, 0.0
    for _ in range(2):
        _combine(m, WORK, ONE, NOTHING, NOTHING, 1.0, 0.0, 0.0)
        _products(m, WORK, 1, s, 0, inverse, 0, -1.0, 0.0, 1.0)  # 1 − s/s
        _products(m, inverse, 1, inverse, 0, WORK, 0, 1.0, 0.0, 1.0)
        _multiply(m, WORK, s, u)
        _multiply(m, WORK + 1, WORK, WORK)
        _combine(m, WORK, ONE, NOTHING, NOTHING, 1.0, 0.0, 0.0)
        _products(m, WORK, 1, s, 0, WORK + 1, 0, -1.0, 0.0, 0.5)  # (1 − s³ u²)/2
        _products(m, u, 1, u, 0, WORK, 0, 1.0, 0.0, 1.0)


@_compiled
def _fill(m, unit):
    """The series of x, y and z, from their first two terms, in units of time (8,)."""
    of = PER_ORDER
    for k in range(ORDER - 1):
        now, next_one = k * of, (k + 2) * of
        for pair in range(3):
            square, power = now + OF_S + pair, now + OF_U + pair
            _clear(m, square)
            for c in range(2):
                one = 2 * pair + c
                _products(m, square, (k + 1) // 2, one, of, now + one, -of, 2.0, 0.0, 1.0)
                if k % 2 == 0:
                    middle = k // 2 * of + one
                    _products(m, square, 1, middle, 0, middle, 0, 1.0, 0.0, 1.0)
            if k == 0:
                _start_power(m, power, INVERSE + pair, square)
                _scale(m, power, unit * unit)
            else:  # s u̇ = −3/2 ṡ u
                _clear(m, WORK)
                first, last = of + OF_S + pair, power - of
                _products(m, WORK, k, first, of, last, -of, -(2.0 * k + 1), -1.0, 0.5)
                _divide(m, WORK, float(k))
                _multiply(m, power, WORK, INVERSE + pair)
            for c in range(2):
                force = FORCE + 2 * pair + c
                _clear(m, force)
                _products(m, force, k + 1, OF_U + pair, of, now + 2 * pair + c, -of, 1.0, 0.0, 1.0)
        for c in range(2):
            x, y, z = next_one + c, next_one + 2 + c, next_one + 4 + c
            _combine(m, x, FORCE + c, FORCE + 2 + c, FORCE + 4 + c, -2.0, -1.0, -1.0)
            _combine(m, y, FORCE + c, FORCE + 2 + c, FORCE + 4 + c, -1.0, -2.0, 1.0)
            for one in (x, y):
                _divide(m, one, float((k + 1) * (k + 2)))
            _combine(m, z, x, y, NOTHING, 1.0, -1.0, 0.0)


@_compiled
def _unit_of_time(m, unit):
    """Powers of two (8,) near the time that the closest two of the bodies take, r^(3/2).

    In other units the last terms of a series in a close encounter would be larger than the largest double.
    """
    for i in range(LANES):
        unit[i] = np.inf
        for pair in range(3):
            a = 2 * pair * 2 * LANES + i
            unit[i] = min(unit[i], (m[a] ** 2 + m[a + 2 * LANES] ** 2) ** 0.75)
        unit[i] = 2.0 ** np.floor(np.log2(unit[i]))


@_compiled
def _step(m, h, unit):
    """The longest step (8,) whose last two terms are small beside positions and beside velocities."""
    width = 2 * LANES
    for i in range(LANES):
        h[i] = np.inf
        for pair in range(3):
            a, b = 2 * pair * width + i, (2 * pair + 1) * width + i
            place = np.sqrt(m[a] ** 2 + m[b] ** 2)
            rate = PER_ORDER * width
            velocity = np.sqrt(m[a + rate] ** 2 + m[b + rate] ** 2) + unit[i] / np.sqrt(place)
            for k in (ORDER - 1, ORDER):
                last = max(abs(m[a + k * rate]), abs(m[b + k * rate]))  # its square may overflow
                of_place = (LAST_TERMS * place / last) ** (1.0 / k)
                of_velocity = (LAST_TERMS * velocity / (k * last)) ** (1.0 / (k - 1))
                h[i] = min(h[i], of_place, of_velocity)


@_compiled
def _advance(m, unit):
    """The state at the end of the step: Σ r_k hᵏ and Σ k r_k hᵏ⁻¹, the latter in units of the time (8,)."""
    for c in range(4):
        _clear(m, WORK + 1)
        _clear(m, WORK + 2)
        for k in range(ORDER, 0, -1):
            term = k * PER_ORDER + c
            _combine(m, WORK, WORK + 1, term, NOTHING, 1.0, 1.0, 0.0)
            _multiply(m, WORK + 1, WORK, STEP)
            if k > 1:
                _combine(m, WORK, WORK + 2, term, NOTHING, 1.0, float(k), 0.0)
                _multiply(m, WORK + 2, WORK, STEP)
        _scale(m, WORK + 2, 1 / unit)
        _combine(m, STATE + c, STATE + c, WORK + 1, NOTHING, 1.0, 1.0, 0.0)
        _combine(m, STATE + 4 + c, STATE + 4 + c, WORK + 2, NOTHING, 1.0, 1.0, 0.0)


@_compiled
def _follow(state, span):
    """Eight states (8, 2, 8), moved by times (2, 8); NaN where that takes too many steps."""
    width = 2 * LANES
    m, guess, unit = np.zeros(NUMBERS * width), np.zeros(LANES), np.zeros(LANES)
    m[STATE * width : (STATE + 8) * width] = state.ravel()
    m[LEFT * width : (LEFT + 1) * width] = span.ravel()
    m[ONE * width : ONE * width + LANES] = 1.0
    for _ in range(MOST_STEPS):
        for d in range(2):
            for c in range(4):
                _combine(m, d * PER_ORDER + c, STATE + 4 * d + c, NOTHING, NOTHING, 1.0, 0.0, 0.0)
            for c in range(2):
                first = d * PER_ORDER + c
                _combine(m, first + 4, first, first + 2, NOTHING, 1.0, -1.0, 0.0)
        _unit_of_time(m, unit)
        for c in range(6):
            _scale(m, PER_ORDER + c, unit)
        _fill(m, unit)
        _step(m, guess, unit)
        going = False
        for i in range(LANES):
            left, step = LEFT * width + i, STEP * width + i
            size = guess[i] * unit[i]
            on = size < m[left]  # a state that is not finite is at its end
            m[step] = size if on else m[left]
            m[step + LANES] = 0.0 if on else m[left + LANES]
            going = going or on
        _combine(m, LEFT, LEFT, STEP, NOTHING, 1.0, -1.0, 0.0)
        _scale(m, STEP, 1 / unit)
        _advance(m, unit)
        if not going:
            break
    for i in range(LANES):
        if m[LEFT * width + i] > 0.0:
            m[STATE * width + i] = np.nan
    state[:] = m[STATE * width : (STATE + 8) * width].copy().reshape(8, 2, LANES)
