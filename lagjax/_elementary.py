"""Elementary functions in float64 that vectorise on the CPU.

Why.  XLA's CPU backend turns `+ * / sqrt exp` into SIMD code, but calls a scalar routine, one element at a time, for
float64 `sin`, `cos`, `tan`, `atan2`, `pow` and others: 4 to 19 ns an element where SIMD needs 2.  The functions here
are straight-line arithmetic, so that XLA fuses them with their surroundings and LLVM vectorises the whole.

How.  Each function follows one plan, known since the seventies (Cody & Waite, *Software Manual for the Elementary
Functions*, 1980; fdlibm, Sun Microsystems, 1993; Muller, *Elementary Functions*, 2016):

1. *Reduce* the argument to a short interval, exactly.  For `sin`, r = x - k pi/2 with |r| <= pi/4.  The constant is cut
   into parts so short that k times a part has no rounding error, and the subtractions cancel without loss:
   pi/2 = P0 + P1 + P2 + P3.  What does not fit into r is carried along as its `tail`.
2. *Approximate* on the short interval by a polynomial whose leading terms are exact, so that its rounding errors are
   those of a small correction.
3. *Reconstruct*: swap sin with cos, add k ln 2, multiply by 2**k.

Every branch is a select, because `vmap` would turn a `cond` into one and evaluate both sides anyhow.

Accuracy, as tested against mpmath on compiled code, in units in the last place (ulp) of the result:

| function                               | error   | where                                                             |
|----------------------------------------|---------|-------------------------------------------------------------------|
| sin, cos                               | 1 ulp   | |x| <= 2**21; 1 ulp + 2**-80 (absolute) up to 2**53; NaN beyond   |
| tan                                    | 1.5 ulp | |x| <= 2**21; then its relative error grows by 2**-80 / |sin cos| |
| log, log1p, asin, acos, atan           | 1.5 ulp | everywhere                                                        |
| expm1, atan2, sinh, cosh, pow          | 2 ulp   | everywhere                                                        |

Beyond 2**53 neighbouring doubles are more than a radian apart and an angle has lost its meaning; NaN says so.
Subnormal numbers: XLA's CPU code reads them as zero and writes zero for them.  `sin`, `tan`, `asin`, `atan`, `sinh`,
`expm1`, `log1p` return a subnormal argument unchanged, `log` and `pow` read one correctly; a subnormal *result* of
`pow` or `atan2`, and a subnormal argument of `atan2`, count as zero.

Three rules keep the error-free steps error-free whatever a compiler does: a product whose rounding matters is exact
(so contracting it into a fused multiply-add changes nothing), high parts are cut off by masking bits, and nothing
reads (x + constant) - constant, which XLA simplifies to x.

When.  The fast versions serve float64 where JAX's default backend is the CPU, decided while tracing.  Everything else
(float32, integers, complex, Python scalars and other weakly typed values, other platforms) goes to `jax.numpy`.  A
wrong guess of the platform costs time, not digits.  Functions absent here (`exp`, `sqrt`, `tanh`) are vectorised by
XLA already.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero

from lagjax._digits import COS, PI_2, PI_2_ROUNDED, SIN

# ---- constants ------------------------------------------------------------------------------------------------------
# A tuple of parts sums to its constant; all but the last part are short, as noted.

# 4272943 is a numerator among the continued fraction's convergents of 2 pi: as good as 680060 whole turns.
TURNS = 4272943.0
TURNS_EXCESS = (-5.495794539456256e-07, -4.386488188738019e-14, -1.100534058855423e-20)  # less 680060 turns; 22 bits
ANGLE_LIMIT = 2.0**53
LN2 = (0.6931471805592082, 7.371002565161996e-13, 5.8029889835956905e-25)  # ln 2; 40 bits each
ATAN_HALF = (0.4636476090008061, 2.2698777452961687e-17)
SQRT_HALF_BITS = 0x3FE6A09E667F3BCD

# fmt: off
# fdlibm e_log.c: log((1 + s)/(1 - s)) = 2 s + s z L(z), z = s^2, |s| <= 3 - 2 sqrt 2.
LOG = (6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01,
       1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01)
# fdlibm s_atan.c: atan t = t - t z A(z), z = t^2, |t| <= 7/16.
ATAN = (3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01,
        -1.11111104054623557880e-01, 9.09088713343650656196e-02, -7.69187620504482999495e-02,
        6.66107313738753120669e-02, -5.83357013379057348645e-02, 4.97687799461593236017e-02,
        -3.65315727442169155270e-02, 1.62858201153657823623e-02)
# The last four interpolate at Chebyshev nodes, computed with mpmath to 100 digits and rounded.
# exp r = 1 + r + r^2/2 + r^3 E(r), |r| <= ln(2)/2.
EXP = (0.16666666666666669, 0.041666666666666664, 0.008333333333330039, 0.0013888888888886537,
       0.00019841269863171557, 2.4801587317228724e-05, 2.7557268276905696e-06, 2.7557282838800484e-07,
       2.5100472505694996e-08, 2.09112987659402e-09)
# sinh x = x + x z H(z), z = x^2 <= 1.
SINH = (0.16666666666666666, 0.008333333333333299, 0.00019841269841324198, 2.7557319191381816e-06,
        2.5052117695907823e-08, 1.6057679623801638e-10, 7.746178593018827e-13)
# asin x = x + x z N(z), z = x^2 <= 1/4.
ASIN = (0.16666666666666669, 0.07499999999998433, 0.04464285714635543, 0.030381944138531247, 0.02237217294214989,
        0.017352392720869973, 0.013971212973552933, 0.011479177415184906, 0.01032281435018578, 0.005457506718640358,
        0.01740087944269402, -0.014851887071247204, 0.028757851367421566)
# atanh s = s (1 + z/3 + z^2 G(z)), z = s^2, |s| <= 3 - 2 sqrt 2.
ATANH = (0.2, 0.14285714285714682, 0.11111111110828116, 0.09090909167657202, 0.07692297485447729,
         0.06667402119112673, 0.05853124270461193, 0.058615255140488765)
# fmt: on


# ---- dispatch and derivatives ---------------------------------------------------------------------------------------


def _is_fast(*args) -> bool:
    """Whether every argument is a float, at least one a strongly typed float64, and the platform a CPU."""
    weak = [getattr(a, "weak_type", type(a) in (bool, int, float, complex)) for a in args]
    strong = [jnp.result_type(a) for a, w in zip(args, weak, strict=True) if not w]
    floats = all(jnp.issubdtype(jnp.result_type(a), jnp.floating) for a in args)
    return bool(strong) and floats and all(d == jnp.float64 for d in strong) and jax.default_backend() == "cpu"


def _elementary(own: Callable, *slopes: Callable) -> Callable:
    """Makes a float64 kernel public: `own` is XLA's function, for all other inputs.

    `slopes` holds one partial derivative for each argument, called as `slope(out, *args)`.  They are written with the
    public functions, so that derivatives of every order exist.
    """

    def wrap(kernel):
        # Compiled also when called outside `jit`: the accuracy stated is that of compiled code.
        fast = jax.custom_jvp(jax.jit(kernel, inline=True))

        def jvp(args, tangents):
            out = fast(*args)
            # An argument without tangent must not contribute 0 * NaN, as log(x) would for pow(x, 2.0) at x < 0.
            terms = [
                slope(out, *args) * t for slope, t in zip(slopes, tangents, strict=True) if type(t) is not SymbolicZero
            ]
            return out, sum(terms[1:], terms[0]) if terms else jnp.zeros_like(out)

        fast.defjvp(jvp, symbolic_zeros=True)

        @functools.wraps(kernel)
        def public(*args):
            return fast(*(jnp.asarray(a, jnp.float64) for a in args)) if _is_fast(*args) else own(*args)

        return public

    return wrap


# ---- small tools ----------------------------------------------------------------------------------------------------


def _polynomial(z, coefficients):
    """Estrin's scheme: pairs first, then pairs of pairs.  Horner's waits for each product before the next."""
    terms = list(coefficients)
    while len(terms) > 1:
        pairs = [a + b * z for a, b in zip(terms[::2], terms[1::2], strict=False)]
        terms, z = pairs + terms[len(pairs) * 2 :], z * z
    return terms[0]


def _bits(x):
    return lax.bitcast_convert_type(x, jnp.int64)


def _float(bits):
    return lax.bitcast_convert_type(bits, jnp.float64)


def _cut(x):
    """The leading 26 bits of x: the product of two such numbers is exact."""
    return _float(_bits(x) & np.int64(-(1 << 27)))


def _integer_bits(k):
    """The integer-valued k in the low bits of an integer.  AVX2 cannot convert float64 to int64, but it can add."""
    return _bits(k + 1.5 * 2.0**52)


def _two_to(k):
    """2**k for integer-valued k in [-1022, 1023]."""
    return _float((_integer_bits(k) + 1023) << 52)


def _is_zero(x):
    """x == 0, told apart from subnormals, which compare equal to zero; LLVM turns plain tests of the bits into that."""
    fraction = _float((_bits(x) & ((1 << 52) - 1)) | (1023 << 52))
    return (x == 0) & (fraction == 1)


def _with_sign(magnitude, x):
    """Magnitude (not negative) with the sign bit of x."""
    return _float(_bits(magnitude) | (_bits(x) & np.int64(-(1 << 63))))


def _near_zero(x, fx):
    """x where every f(x) = x + O(x^2) rounds to x: keeps the sign of zero, and subnormals, which arithmetic flushes."""
    return jnp.where(jnp.abs(x) < 2.0**-54, x, fx)


# ---- circular functions ---------------------------------------------------------------------------------------------


def _reduce(x):
    """x = k pi/2 + r + tail with |r| <= pi/4 (and a little); returns r, tail and k in the low bits of an integer.

    Two steps: away with multiples of 4272943, nearly whole turns, which leaves k < 2**21 for any |x| <= 2**53; then
    away with k pi/2 itself.  For |x| <= 2**21 the first step changes nothing.
    """
    x = jnp.where(jnp.abs(x) <= ANGLE_LIMIT, x, jnp.nan)
    m = jnp.round(x * (1 / TURNS))
    p, e = PI_2, TURNS_EXCESS
    k = jnp.round((x - m * TURNS + m * e[0]) * (2 / np.pi))
    # Exact: every product, both operands of `r`, and `r` itself, for the large terms cancel.
    high = (x - m * TURNS - k * p[0]) + m * e[0]
    low = m * e[1] - k * p[1]
    r = high + low
    tail = (high - r) + low
    # Once more, for arguments next to a multiple of pi/2, where `r` is all cancellation.
    low = m * e[2] - k * p[2]
    high, r = r, r + low
    return r, tail + ((high - r) + low) - k * p[3], _integer_bits(k)


def _circular(x):
    """(sin, its correction, cos, its correction) of the reduced angle, and the quadrant."""
    r, tail, quadrant = _reduce(x)
    z = r * r
    half = 0.5 * z
    cos_head = 1 - half
    # The tail enters to first order: sin(r + t) = sin r + t (1 - r^2/2), cos(r + t) = cos r - r t.
    sin_rest = r * z * _polynomial(z, SIN) + (tail - half * tail)
    cos_rest = ((1 - cos_head) - half) + (z * z * _polynomial(z, COS) - r * tail)
    return r, sin_rest, cos_head, cos_rest, quadrant


def _sincos_kernel(x):
    r, sin_rest, cos_head, cos_rest, quadrant = _circular(x)
    s, c = r + sin_rest, cos_head + cos_rest
    odd = (quadrant & 1) == 1
    sine, cosine = jnp.where(odd, c, s), jnp.where(odd, s, c)
    # The quadrant's second bit becomes a change of sign.
    sine = _float(_bits(sine) ^ ((quadrant & 2) << 62))
    cosine = _float(_bits(cosine) ^ (((quadrant + 1) & 2) << 62))
    return _near_zero(x, sine), cosine


_sincos = jax.custom_jvp(jax.jit(_sincos_kernel, inline=True))


@_sincos.defjvp
def _sincos_jvp(args, tangents):
    (x,), (dx,) = args, tangents
    s, c = _sincos(x)
    return (s, c), (c * dx, -s * dx)


def sincos(x):
    """(sin x, cos x), for little more than the price of one."""
    return _sincos(jnp.asarray(x)) if _is_fast(x) else (jnp.sin(x), jnp.cos(x))


def sin(x):
    """Sine; see the module's table for its accuracy and range."""
    return sincos(x)[0] if _is_fast(x) else jnp.sin(x)


def cos(x):
    """Cosine; see the module's table for its accuracy and range."""
    return sincos(x)[1] if _is_fast(x) else jnp.cos(x)


@_elementary(jnp.tan, lambda t, x: 1 + t * t)
def tan(x):
    """Tangent; see the module's table for its accuracy and range."""
    r, sin_rest, cos_head, cos_rest, quadrant = _circular(x)
    s, c = r + sin_rest, cos_head + cos_rest
    ds, dc = (r - s) + sin_rest, (cos_head - c) + cos_rest  # what rounding took from s and c
    odd = (quadrant & 1) == 1
    n, dn = jnp.where(odd, -c, s), jnp.where(odd, -dc, ds)
    d, dd = jnp.where(odd, s, c), jnp.where(odd, ds, dc)
    inverse = 1 / d
    q = n * inverse
    qh, dh = _cut(q), _cut(d)
    remainder = ((n - qh * dh) - qh * (d - dh)) - (q - qh) * d  # n - q d
    return _near_zero(x, q + (remainder + (dn - q * dd)) * inverse)


# ---- inverse circular functions -------------------------------------------------------------------------------------


def _arctan_quadrants(a, b, swap, mirror):
    """arctan(a / b) for 0 <= a <= b; then pi/2 minus it where `swap`; then pi minus that where `mirror`.

    Reduction: arctan v = arctan c + arctan((v - c) / (1 + c v)) with c = 0, 1/2 or 1, the borders being fdlibm's.
    All constants are summed before the small angle joins them.
    """
    v = a / b
    near_one, near_half = v > 11 / 16, v > 7 / 16

    def choose(one, half, zero):
        return jnp.where(near_one, one, jnp.where(near_half, half, zero))

    t = choose(v - 1, 2 * v - 1, v) / choose(v + 1, v + 2, 1.0)
    z = t * t
    rest = choose(PI_2_ROUNDED[1] / 2, ATAN_HALF[1], 0.0) - t * z * _polynomial(z, ATAN)
    head = choose(PI_2_ROUNDED[0] / 2, ATAN_HALF[0], 0.0)
    sign = jnp.where(swap != mirror, -1.0, 1.0)
    turns = jnp.where(swap, 1.0, jnp.where(mirror, 2.0, 0.0))
    base, head = turns * PI_2_ROUNDED[0], sign * head
    total = base + head
    return total + (sign * t + (sign * rest + (((base - total) + head) + turns * PI_2_ROUNDED[1])))


@_elementary(jnp.arctan, lambda out, x: 1 / (1 + x * x))
def arctan(x):
    """Inverse tangent."""
    a = jnp.abs(x)
    swap = a > 1
    angle = _arctan_quadrants(jnp.where(swap, 1.0, a), jnp.where(swap, a, 1.0), swap, jnp.zeros_like(swap))
    return _near_zero(x, _with_sign(angle, x))


@_elementary(
    jnp.arctan2,
    lambda out, y, x: x / (x * x + y * y),
    lambda out, y, x: -y / (x * x + y * y),
)
def arctan2(y, x):
    """Angle of the point (x, y), with the signed zeros and infinities of IEEE 754."""
    ax, ay = jnp.abs(x), jnp.abs(y)
    a, b = jnp.minimum(ax, ay), jnp.maximum(ax, ay)
    b = jnp.where(b == 0, 1.0, b)
    a, b = jnp.where(a == jnp.inf, 1.0, a), jnp.where(a == jnp.inf, 1.0, b)
    return _with_sign(_arctan_quadrants(a, b, ay > ax, _bits(x) < 0), y)


def _arcsin_parts(x):
    """Heads and corrections of arcsin v, with v = |x| below 1/2, and v = sqrt((1 - |x|)/2) above."""
    a = jnp.abs(x)
    large = a > 0.5
    z = jnp.where(large, 0.5 * (1 - a), a * a)
    v = jnp.where(large, jnp.sqrt(z), a)
    return large, v, v * (z * _polynomial(z, ASIN))


@_elementary(jnp.arcsin, lambda out, x: 1 / jnp.sqrt((1 - x) * (1 + x)))
def arcsin(x):
    """Inverse sine: above 1/2 by arcsin x = pi/2 - 2 arcsin sqrt((1 - x)/2)."""
    large, v, rest = _arcsin_parts(x)
    angle = jnp.where(large, PI_2_ROUNDED[0] - 2 * v - (2 * rest - PI_2_ROUNDED[1]), v + rest)
    return _near_zero(x, _with_sign(angle, x))


@_elementary(jnp.arccos, lambda out, x: -1 / jnp.sqrt((1 - x) * (1 + x)))
def arccos(x):
    """Inverse cosine: above 1/2 by arccos x = 2 arcsin sqrt((1 - x)/2)."""
    large, v, rest = _arcsin_parts(x)
    negative = x < 0
    v, rest = jnp.where(negative, -v, v), jnp.where(negative, -rest, rest)
    pi = [jnp.where(negative, 2 * part, 0.0) for part in PI_2_ROUNDED]
    outer = pi[0] + 2 * (v + (rest + 0.5 * pi[1]))
    return jnp.where(large, outer, PI_2_ROUNDED[0] - (v - (PI_2_ROUNDED[1] - rest)))


# ---- logarithm, exponential and what is made of them ----------------------------------------------------------------


def _split_binary(x):
    """x = 2**k m with m in [sqrt 1/2, sqrt 2), for x > 0 and finite.  Reads subnormals by their bits."""
    bits = _bits(x)
    subnormal = bits < (1 << 52)
    # As the fraction of a number in [1, 2), less 1, a subnormal becomes a normal number 2**1022 times as large.
    bits = jnp.where(subnormal, _bits(_float(bits | (1023 << 52)) - 1), bits)
    offset = bits + ((1023 << 52) - SQRT_HALF_BITS)
    exponent = _float(lax.shift_right_logical(offset, np.int64(52)) | np.int64(0x433 << 52))  # 2**52 + k + 1023
    k = exponent - jnp.where(subnormal, 2.0**52 + 1023 + 1022, 2.0**52 + 1023)
    return k, _float((offset & ((1 << 52) - 1)) + SQRT_HALF_BITS)


def _log_positive(x, correction=0.0):
    """log x + correction, for x > 0 and finite."""
    k, m = _split_binary(x)
    f = m - 1
    s = f / (2 + f)
    z = s * s
    half = 0.5 * f * f
    return k * LN2[0] + (f - (half - (s * (half + z * _polynomial(z, LOG)) + (k * LN2[1] + correction))))


@_elementary(jnp.log, lambda out, x: 1 / x)
def log(x):
    """Natural logarithm."""
    bits = _bits(x)
    finite = jnp.where(x < jnp.inf, _log_positive(x), x)
    return jnp.where(_is_zero(x), -jnp.inf, jnp.where(bits < 0, jnp.nan, finite))


@_elementary(jnp.log1p, lambda out, x: 1 / (1 + x))
def log1p(x):
    """log(1 + x): the logarithm of the rounded sum, and to first order what the rounding took."""
    total = 1 + x
    lost = jnp.minimum(x, 1) - (total - jnp.maximum(x, 1))
    inside = jnp.where(x < jnp.inf, _log_positive(total, lost / total), x)
    return _near_zero(x, jnp.where(x > -1, inside, jnp.where(x == -1, -jnp.inf, jnp.nan)))


def _exp_parts(x, tail=0.0):
    """(k, e) with exp(x + tail) = 2**k (1 + e) and |e| < 0.42.  Takes x exact to 52 bits, |x| < 1000."""
    k = jnp.round(x * float(np.log2(np.e)))
    r = (x - k * LN2[0]) - (k * LN2[1] - tail)
    return k, r + (0.5 * r * r + r * r * r * _polynomial(r, EXP))


@_elementary(jnp.expm1, lambda out, x: out + 1)
def expm1(x):
    """exp(x) - 1.  Below -40 it is -1, and above 710 infinite."""
    k, e = _exp_parts(jnp.clip(x, -40, 710))
    scale = _two_to(k - 1)
    return _near_zero(x, 2 * ((scale - 0.5) + scale * e))


def _half_exp(x):
    """exp(x)/2 for x >= 0, infinite only beyond the range of sinh and cosh."""
    k, e = _exp_parts(jnp.minimum(x, 712))
    scale = _two_to(k - 5)
    return (scale + scale * e) * 16


@_elementary(jnp.sinh, lambda out, x: cosh(x))
def sinh(x):
    """Hyperbolic sine: a polynomial up to 1, exponentials beyond."""
    a = jnp.abs(x)
    z = jnp.minimum(a, 1) ** 2
    half_exp = _half_exp(a)
    large = _with_sign(half_exp - 0.25 / half_exp, x)
    return _near_zero(x, jnp.where(a < 1, x + x * (z * _polynomial(z, SINH)), large))


@_elementary(jnp.cosh, lambda out, x: sinh(x))
def cosh(x):
    """Hyperbolic cosine."""
    half_exp = _half_exp(jnp.abs(x))
    return half_exp + 0.25 / half_exp


def _log_three_halves(x):
    """3/2 log x, for x > 0 and finite, as a sum of two with a relative error of 2**-64: fdlibm e_pow.c.

    With x = 2**k m and s = (m - 1)/(m + 1), 3/2 log m = s (3 + z + 3 z^2 G(z)), z = s^2: the factor 3/2 makes both
    leading coefficients integers.
    """
    k, m = _split_binary(x)
    f = m - 1
    d = _cut(2 + f)
    inverse = 1 / (2 + f)
    s = f * inverse
    sh = _cut(s)
    sl = ((f - sh * d) - sh * (f - (d - 2))) * inverse
    z = s * s
    head = 3 + sh * sh
    small = 3 * z * z * _polynomial(z, ATANH) + sl * (sh + s)
    th = _cut(head + small)
    tl = small - ((th - 3) - sh * sh)
    high, low = sh * th, sl * th + tl * s
    whole = k * (1.5 * LN2[0])
    total = whole + high
    return total, ((whole - total) + high) + (low + k * (1.5 * LN2[1]))


def _power_positive(x, y):
    """x**y for x >= 0, as exp(y log x) with log x and the product in two parts each."""
    high, low = _log_three_halves(x)
    high = jnp.where(_is_zero(x), -jnp.inf, jnp.where(x < jnp.inf, high, x))
    yh = _cut(y * (2 / 3))
    yl = (2 * y - 3 * yh) * (1 / 3)
    lh = _cut(high)
    product = jnp.clip(yh * lh, -800, 800)
    tail = jnp.where(jnp.abs(product) < 800, yh * ((high - lh) + low) + yl * (high + low), 0.0)
    k, e = _exp_parts(product, tail)
    half = jnp.round(0.5 * k)  # 2**k in two factors: k may lie outside the exponents of normal numbers
    return (1 + e) * _two_to(half) * _two_to(k - half)


def _pow_slope_x(out, x, y):
    # At y = 0 the power of -1 must not be met: 0 * inf.
    return jnp.where(y == 0, 0.0, y * pow(x, jnp.where(y == 0, 1.0, y - 1)))


def _pow_slope_y(out, x, y):
    # 0**y is flat in y > 0, though log 0 is infinite.
    return out * log(jnp.where(x == 0, 1.0, x))


@_elementary(jnp.power, _pow_slope_x, _pow_slope_y)
def pow(x, y):
    """x**y for floating-point exponents, with the special cases of IEEE 754."""
    value = _power_positive(jnp.abs(x), y)
    whole, odd = jnp.round(y) == y, jnp.round(0.5 * y) != 0.5 * y
    negative = _bits(x) < 0
    value = jnp.where(negative & whole & odd, -value, value)
    value = jnp.where((x < 0) & (x > -jnp.inf) & ~whole, jnp.nan, value)
    one = (y == 0) | (x == 1) | ((x == -1) & (jnp.abs(y) == jnp.inf))
    return jnp.where(one, 1.0, value)


# Keyed by the name of the JAX primitive each one stands in for.
FAST = {
    "sin": sin, "cos": cos, "tan": tan, "asin": arcsin, "acos": arccos, "atan": arctan, "atan2": arctan2,
    "sinh": sinh, "cosh": cosh, "log": log, "log1p": log1p, "expm1": expm1, "pow": pow,
}  # fmt: skip
