"""Sine and cosine in float64 that vectorise on the CPU.

Why.  XLA's CPU backend turns `+ * / sqrt exp` into SIMD code, but calls a scalar routine, one element at a time, for
float64 `sin` and `cos`: 4 to 19 ns an element where SIMD needs 2.  The functions here are straight-line arithmetic, so
that XLA fuses them with their surroundings and LLVM vectorises the whole.  They serve scalar programs that diffrax
integrates on the CPU: a batch of 1024 chains of 4 pendulums by Tsit5 takes 2 to 3 times as long with XLA's own.  Scenes
made of other functions, measured in the same way with forms like these, take 0.5 to 1.2 times as long with XLA's own.

How.  Cody & Waite's plan (*Software Manual for the Elementary Functions*, 1980; fdlibm, Sun Microsystems, 1993;
Muller, *Elementary Functions*, 2016):

1. *Reduce* the argument to r = x - k pi/2 with |r| <= pi/4, exactly.  pi/2 is cut into parts so short that k times a
   part has no rounding error, and the subtractions cancel without loss: pi/2 = P0 + P1 + P2 + P3.  What does not fit
   into r is carried along as its `tail`.
2. *Approximate* on the short interval by a polynomial whose leading terms are exact, so that its rounding errors are
   those of a small correction.
3. *Reconstruct*: swap sin with cos, and change signs.

Every branch is a select, because `vmap` would turn a `cond` into one and evaluate both sides anyhow.

Accuracy, as tested against mpmath on compiled code: 1 unit in the last place of the result for |x| <= 2**21, and
another 2**-80, absolute, up to 2**53.  Beyond, neighbouring doubles are more than a radian apart and an angle has lost
its meaning; NaN says so.  `sin` returns a subnormal argument unchanged, which arithmetic on XLA's CPUs reads as zero.

Three rules keep the error-free steps error-free whatever a compiler does: a product whose rounding matters is exact
(so contracting it into a fused multiply-add changes nothing), bits are moved by masks, and nothing reads
(x + constant) - constant, which XLA simplifies to x.

When.  The fast versions serve float64 where JAX's default device is a CPU, decided while tracing.  Everything else
(float32, integers, complex, Python scalars and other weakly typed values, other platforms) goes to `jax.numpy`.  A
wrong guess of the platform costs time, not digits.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lagjax._interface import default_platform
from lagjax._program._digits import COS, PI_2, SIN

# 4272943 is a numerator among the continued fraction's convergents of 2 pi: as good as 680060 whole turns.
TURNS = 4272943.0
# It less 680060 turns.  The parts sum to that; all but the last have 22 bits.
TURNS_EXCESS = (-5.495794539456256e-07, -4.386488188738019e-14, -1.100534058855423e-20)
ANGLE_LIMIT = 2.0**53


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


# ---- sine and cosine ------------------------------------------------------------------------------------------------


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
    # The low bits of a sum are those of k: AVX2 cannot convert float64 to int64, but it can add.
    return r, tail + ((high - r) + low) - k * p[3], _bits(k + 1.5 * 2.0**52)


def _sincos_kernel(x):
    r, tail, quadrant = _reduce(x)
    z = r * r
    half = 0.5 * z
    cos_head = 1 - half
    # The tail enters to first order: sin(r + t) = sin r + t (1 - r^2/2), cos(r + t) = cos r - r t.
    s = r + (r * z * _polynomial(z, SIN) + (tail - half * tail))
    c = cos_head + (((1 - cos_head) - half) + (z * z * _polynomial(z, COS) - r * tail))
    odd = (quadrant & 1) == 1
    sine, cosine = jnp.where(odd, c, s), jnp.where(odd, s, c)
    # The quadrant's second bit becomes a change of sign.
    sine = _float(_bits(sine) ^ ((quadrant & 2) << 62))
    cosine = _float(_bits(cosine) ^ (((quadrant + 1) & 2) << 62))
    # Where sin x rounds to x it is x: that keeps the sign of zero, and subnormals, which arithmetic flushes.
    return jnp.where(jnp.abs(x) < 2.0**-54, x, sine), cosine


# Compiled also when called outside `jit`: the accuracy stated is that of compiled code.
_sincos = jax.custom_jvp(jax.jit(_sincos_kernel, inline=True))


@_sincos.defjvp
def _sincos_jvp(args, tangents):
    (x,), (dx,) = args, tangents
    s, c = _sincos(x)
    return (s, c), (c * dx, -s * dx)


def sincos(x):
    """(sin x, cos x), for little more than the price of one."""
    weak = getattr(x, "weak_type", type(x) in (bool, int, float, complex))
    is_fast = not weak and jnp.result_type(x) == jnp.float64 and default_platform() == "cpu"
    return _sincos(jnp.asarray(x)) if is_fast else (jnp.sin(x), jnp.cos(x))
