"""Functions of one number that are series: log Γ and its derivatives, the modified Bessel functions I₀ and I₁.

log Γ obeys no differential equation from which a Taylor series would follow, and the others would need the powers of
their argument anyway. So all are written out in operations that are there already, to rounding:

    log Γ(x), x > 0    Stirling's series at y = x + 10, less log x(x + 1) … (x + 9)
    Iₙ(x)              the power series up to |x| = 25, whose terms have one sign, and the asymptotic series beyond

Where one of two such forms takes over they agree to rounding, and that is no border. The incomplete Γ functions and the
exponential integrals are left to XLA.

Abramowitz & Stegun, *Handbook of Mathematical Functions* (1964), 6.1.40, 6.1.17, 6.4.6, 6.4.7, 6.4.11, 9.6.10, 9.7.1.
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from lagjax._program import _scalars as xp
from lagjax._program._graph import Unlowerable
from lagjax._program._scalars import Scalars
from lagjax._program.lowering._rules import LOWER

# Steps by which log Γ is shifted, and Bernoulli's numbers B₂ₖ: at y = 10 the next term of the series is 2e-18. With
# twice the shift four of them would do, and the product would be twice as long.
_SHIFT = 10
_BERNOULLI = [Fraction(1, 6), Fraction(-1, 30), Fraction(1, 42), Fraction(-1, 30), Fraction(5, 66),
              Fraction(-691, 2730), Fraction(7, 6), Fraction(-3617, 510)]  # fmt: skip
_MOST_DERIVATIVES = 10  # of ψ: further ones are of no use in mechanics, and long
# Where Bessel's series change over, and their terms: those left out are below 1e-17 of the sum there. Further out the
# power series would need more terms, further in the asymptotic one would never be as exact.
_CHANGE, _POWERS, _ASYMPTOTIC = 25.0, 50, 26


def _polynomial(coefficients: Sequence[float], x: Any) -> Any:
    """Σ cₖ xᵏ, by Horner's rule."""
    total = x * 0.0 + coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


def _reflect(x: Scalars) -> tuple[Any, Any, Any]:
    """A flag that x is negative, the positive one of x and 1 − x, and x where it is negative, else ½."""
    negative = x.map("lt", x, 0.0)
    return negative, xp.where(negative, 1.0 - x, x), xp.where(negative, x, 0.5)


def log_gamma(x: Scalars) -> Any:
    """log |Γ(x)|, to 1e-14 of its largest term; for x < 0 by Γ(x) Γ(1 − x) = π / sin πx."""
    negative, z, reflected = _reflect(x)
    y = z + float(_SHIFT)
    inverse = 1.0 / y
    series = _polynomial([float(b / (2 * k * (2 * k - 1))) for k, b in enumerate(_BERNOULLI, 1)], inverse * inverse)
    product = z * inverse  # of (z + i) / y, which cannot overflow
    for i in range(1, _SHIFT):
        product = product * ((z + float(i)) * inverse)
    value = (z - 0.5) * xp.logarithm(y) - y + 0.5 * math.log(2 * math.pi) + series * inverse - xp.logarithm(product)
    sine = reflected.map("sin", math.pi * reflected)
    return xp.where(negative, math.log(math.pi) - 0.5 * xp.logarithm(sine * sine) - value, value)


def polygamma(order: int, x: Scalars) -> Any:
    """ψ⁽ⁿ⁾(x), the derivative n of ψ = (log Γ)'; for x < 0 as (−1)ⁿ ψ⁽ⁿ⁾(1 − x) − π dⁿ/dxⁿ cot πx.

    With y = x + s it is (−1)ⁿ⁺¹ (n! Σ (x + i)⁻ⁿ⁻¹ + (n − 1)! y⁻ⁿ + n! y⁻ⁿ⁻¹ / 2 + Σ B₂ₖ (2k + n − 1)! / (2k)! y⁻²ᵏ⁻ⁿ),
    i below s, where −log y stands in the place of the second term for n = 0. With n the shift s grows, so that the
    first term left out stays below 1e-17.
    """
    n, factorial, shift = order, float(math.factorial(order)), _SHIFT + 5 * order
    negative, z, reflected = _reflect(x)
    y = z + float(shift)
    inverse = 1.0 / y
    series = [float(b * math.factorial(2 * k + n - 1) / math.factorial(2 * k)) for k, b in enumerate(_BERNOULLI, 1)]
    tail = inverse * (0.5 * factorial + inverse * _polynomial(series, inverse * inverse))
    value = tail - xp.logarithm(y) if n == 0 else (tail + float(math.factorial(n - 1))) * _power(inverse, n)
    for i in range(shift):
        value = value + factorial * _power(1.0 / (z + float(i)), n + 1)
    sign = (-1.0) ** (n + 1)
    cotangent = 1.0 / reflected.map("tan", math.pi * reflected)
    slope = np.polynomial.Polynomial([0.0, 1.0])  # dⁿ/dxⁿ cot x as a polynomial of c = cot x, by c' = −(1 + c²)
    for _ in range(n):
        slope = slope.deriv() * np.polynomial.Polynomial([-1.0, 0.0, -1.0])
    more = math.pi ** (n + 1) * _polynomial(slope.coef.tolist(), cotangent)
    return xp.where(negative, -value - more, sign * value)


def _power(x: Any, n: int) -> Any:
    return math.prod([x] * (n - 1), start=x)


def scaled_bessel(order: int, x: Scalars) -> Any:
    """e^(−|x|) Iₙ(x) for n = 0 or 1."""
    size = xp.absolute(x)
    is_small = xp.prefers(_CHANGE, size)
    near, far = xp.where(is_small, x, 0.0), xp.where(is_small, _CHANGE, size)
    powers = [1.0 / (math.factorial(k) * math.factorial(k + order)) for k in range(_POWERS)]
    small = _polynomial(powers, 0.25 * near * near) * xp.exponential(-xp.absolute(near))
    asymptotic = [1.0]
    for k in range(1, _ASYMPTOTIC):
        asymptotic.append(-asymptotic[-1] * (4 * order**2 - (2 * k - 1) ** 2) / (8 * k))
    large = _polynomial(asymptotic, 1.0 / far) / xp.root(2 * math.pi * far)
    if order:
        small, large = 0.5 * near * small, x.map("sign", x) * large
    return xp.where(is_small, small, large)


def _lower_polygamma(expansion, params, order: np.ndarray, x: np.ndarray):
    orders = set(expansion.require_numbers(order, "the order of a polygamma function").ravel().tolist())
    if len(orders) != 1 or not 0 <= (n := orders.pop()) <= _MOST_DERIVATIVES:
        raise Unlowerable(
            f"polygamma functions of several orders, or of one beyond {_MOST_DERIVATIVES}, are not written out"
        )
    return polygamma(n, Scalars(expansion, x)).ids


LOWER.update(
    {
        "lgamma": lambda e, params, x: log_gamma(Scalars(e, x)).ids,
        "digamma": lambda e, params, x: polygamma(0, Scalars(e, x)).ids,
        "polygamma": _lower_polygamma,
        "bessel_i0e": lambda e, params, x: scaled_bessel(0, Scalars(e, x)).ids,
        "bessel_i1e": lambda e, params, x: scaled_bessel(1, Scalars(e, x)).ids,
    }
)
