"""Random expressions in every role of a scene, against plain JAX: is any acceleration, slope or motion wrong?

    python -m benchmarks.expression_population --scenes 1000
    python -m benchmarks.expression_population --scenes 50 --first 200
    python -m benchmarks.expression_population --scenes 200 --float32

A scene of three coordinates has one *expression* as its potential, in its kinetic energy, as its force, dissipation or
constraint. Expressions consist of the functions of `SMOOTH`, `KINKED`, `STEPS` and `OF_VECTORS`, which each take their
turn, alone or one in the other, in exponentials, in sums, products, branches and loops. Starts are random, zero, tied,
whole, negative or next to nothing. Reference is JAX in float64: q̈ from the derivatives of the functions as they are
written, its Jacobian, and for one scene in ten a motion by SciPy's DOP853 on that q̈.

What counts as right: the numbers of JAX to `TOLERANCES`; no number where JAX has none. At a kink a slope is a
convention: there any number in the range that JAX gives at 32 places around the start, 1e-7 from it, is right as
well (*one of both sides*), and where JAX has no number, only those are. Where the slopes of q̈ differ at these places,
it has none at the start, and they are not compared. *Refused* is an error of lagjax's own, or a motion that ends by
name; *raw* is any other error. Numbers beyond 1e100 are not compared, nor motions whose reference depends on its steps.
"""

import argparse
import collections
import itertools
import math
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, nn  # noqa: F401  (what expressions are written in)
from jax.scipy import special  # noqa: F401
from scipy.integrate import solve_ivp

import lagjax
from benchmarks import _report

# Of parts of the largest component, and of what a change of the state by one rounding makes, for float64 and float32.
TOLERANCES = {False: (1e-9, 1e-13), True: (3e-5, 3e-6)}
OF_MOTION = {False: 1e-6, True: 1e-3}
STORE = Path(__file__).parent / "results" / "expressions.json"
BESIDE, SIDES, DURATION, LARGEST, MOST_CALLS = 1e-7, 32, 0.25, 1e100, 20_000

# ---- functions that expressions consist of, as they are written: of a number u ---------------------------------------

_ENTIRE = (
    "jnp.sin(u)", "jnp.cos(u)", "jnp.tanh(u)", "jnp.arctan(u)", "jnp.sinh(u)", "jnp.cosh(u)", "jnp.exp(u)",
    "jnp.exp2(u)", "jnp.expm1(u)", "jnp.arcsinh(u)", "jnp.square(u)", "jnp.tan(0.3*u)", "u**2", "u**3", "u**4",
    "jnp.power(u, 2)", "jnp.power(u, 3.0)", "jnp.power(2.0, u)", "jnp.power(1 + u**2, 0.3)", "jnp.float_power(u, 2)",
    "lax.integer_pow(u, 5)", "lax.pow(1.5 + jnp.cos(u), u)", "(1 + u**2)**u", "jnp.negative(u)", "jnp.positive(u)",
    "jnp.deg2rad(u)", "jnp.rad2deg(u)", "jnp.real(u)", "jnp.real(jnp.exp(1j*u))", "jnp.imag(jnp.exp(1j*u)**2)",
    "jnp.abs(jnp.exp((0.2 + 1j)*u))", "jnp.real(jnp.conj(u + 1j)*(u + 2j))", "jnp.real(1/(u + 1j))",
    "jnp.real(jnp.sqrt(u + 2j))", "jnp.imag(jnp.log(u + 1j))", "jnp.real((u + 1j)**3)", "jnp.real((2 + 1j*u)**1.5)",
    "jnp.abs(u + 0.5j)**2", "jnp.real(jnp.sin(u + 0.3j))", "jnp.real(jnp.cosh(u + 0.3j))",
    "jnp.angle(2 + jnp.exp(1j*u))", "jnp.sinc(u)", "jnp.i0(u)", "jnp.hypot(u, 1.0)", "jnp.hypot(u + 2, u - 1)",
    "jnp.arctan2(u, 1.5)", "jnp.arctan2(1 + u**2, u)", "jnp.logaddexp(u, 0.3)", "jnp.logaddexp2(u, 1.0)",
    "jnp.log(1 + jnp.exp(u))", "jnp.log(jnp.exp(u))", "jnp.log(2 + jnp.sinh(u)**2)", "1/(1 + jnp.exp(u))",
    "1/(1 + jnp.exp(u/0.1))", "1/jnp.cosh(u)", "1/jnp.cosh(u)**2", "u/jnp.cosh(u)", "jnp.exp(-u**2)",
    "jnp.exp(-jnp.exp(u))", "jnp.exp(-u - jnp.exp(-u))", "jnp.sqrt(jnp.exp(u))", "jnp.sqrt(1 + jnp.exp(u))",
    "jnp.sqrt(1 + u**2)", "jnp.exp(u)**0.5", "jnp.exp(u)**1.3", "(1 + jnp.exp(u))**1.3", "(1 + jnp.exp(u))**-2",
    "jnp.arctan(jnp.exp(u))", "jnp.arcsin(jnp.tanh(u))", "jnp.arccos(0.9*jnp.sin(u))", "jnp.arccosh(1.1 + u**2)",
    "jnp.arctanh(0.9*jnp.tanh(u))", "jnp.sin(jnp.exp(u))", "jnp.tanh(jnp.exp(u))", "jnp.exp(jnp.exp(u)/3)",
    "jnp.cbrt(1 + u**2)", "lax.rsqrt(1 + u**2)", "jnp.reciprocal(1.5 + jnp.sin(u))", "u/(1 + u**2)",
    "(u + 1)/(u**2 + u + 1)", "jnp.log1p(u**2)", "jnp.log10(1 + u**2)", "jnp.log2(1.1 + u**2)",
    "jnp.expm1(u)/(1 + jnp.exp(u))", "jnp.polyval(jnp.array([0.3, -1.0, 0.2]), u)", "jnp.float32(0.5)*u",
    "lax.stop_gradient(2.0)*u", "lax.logistic(u)", "lax.erf(u)", "lax.erfc(u)", "lax.expand_dims(u, (0,))[0]",
    "lax.square(u)", "lax.tan(0.2*u)", "lax.reduce_precision(u, 11, 52)", "lax.mul(u, u)",
    "lax.sub(u, 1.0)*lax.add(u, 1.0)", "lax.div(u, 2 + u*u)", "lax.polygamma(1.0, 2 + u*u)", "nn.sigmoid(u)",
    "nn.softplus(u)", "nn.silu(u)", "nn.swish(3*u)", "nn.log_sigmoid(u)", "nn.soft_sign(u)", "nn.gelu(u)",
    "nn.gelu(u, approximate=False)", "nn.mish(u)", "nn.squareplus(u)", "nn.tanh(u)", "nn.log1mexp(1 + u**2)",
    "special.erf(u)", "special.erfc(u)", "special.expit(u)", "special.logit(0.5 + 0.4*jnp.sin(u))",
    "special.gammaln(1.5 + u**2)", "special.digamma(1.5 + u**2)", "special.gamma(2 + 0.5*jnp.sin(u))",
    "special.beta(1.5 + u**2, 2.0)", "special.betaln(1.5 + u**2, 2.0)", "special.xlogy(2.0, 1 + u**2)",
    "special.xlog1py(u, u**2)", "special.entr(0.3 + u**2)", "special.rel_entr(1 + u**2, 2.0)",
    "special.kl_div(1 + u**2, 2.0)", "special.ndtr(u)", "special.log_ndtr(u)", "special.ndtri(0.5 + 0.3*jnp.sin(u))",
    "special.i0(u)", "special.i1(u)", "special.i0e(1 + u**2)", "special.i1e(1 + u**2)",
    "special.bessel_jn(1 + 0.3*jnp.sin(u), v=2)[1]", "special.sici(1.5 + jnp.sin(u))[0]",
    "special.erfinv(0.5*jnp.sin(u))", "special.zeta(3.0, 2 + u**2)", "special.multigammaln(3 + u**2, 2)",
    "special.factorial(2 + u**2)", "special.spence(2 + jnp.sin(u))", "special.expi(1 + u**2)",
    "special.exp1(1 + u**2)", "special.expn(2, 1 + u**2)", "special.hyp1f1(1.0, 2.0, jnp.sin(u))",
    "special.gammainc(2.0, 1 + u**2)", "special.gammaincc(2.0, 1 + u**2)",
    "special.betainc(2.0, 3.0, 0.5 + 0.3*jnp.sin(u))", "special.poch(2.0, 1 + u**2)", "special.fresnel(u)[0]",
    "lax.fori_loop(0, 4, lambda k, y: jnp.sin(y) + 0.1*k, u)",
    "lax.fori_loop(0, 3, lambda k, y: y*y/(k + 2) + u, u)",
    "lax.scan(lambda c, k: (jnp.cos(c)*k, c), u, jnp.arange(1.0, 4.0))[0]",
    "lax.scan(lambda c, k: (c + k*u, c*c), 0.2*u, jnp.array([0.1, -0.4, 0.2]))[1].sum()",
    "lax.scan(lambda c, k: (0.5*c + u**k, None), 0.0*u, jnp.arange(4))[0]",
    "jnp.sum(lax.map(lambda k: jnp.sin(k*u), jnp.arange(3.0)))",
    "lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, jnp.sin(s[1])), (0, u))[1]",
    "lax.associative_scan(jnp.multiply, jnp.stack([u, 1 + u, u*u + 1]))[-1]", "jax.jit(lambda y: jnp.sin(y)*y)(u)",
    "jax.checkpoint(lambda y: jnp.sin(y)*jnp.exp(y))(u)", "jax.remat(jnp.tanh)(2*u)",
    "jax.grad(lambda y: jnp.sin(y)*y**2)(u)", "jax.vmap(lambda k: jnp.cos(k*u))(jnp.arange(3.0)).sum()",
    "jax.jvp(jnp.sin, (u,), (0.5,))[1]", "own_sine(u)", "own_square(u)", "lax.cond(True, jnp.sin, jnp.cos, u)",
    "lax.switch(1, [jnp.sin, jnp.cos, jnp.tanh], u)", "jnp.vectorize(lambda y: y*jnp.sin(y))(u)",
    "jnp.piecewise(u, [False], [1.0, jnp.sin])", "jnp.where(jnp.isnan(u), 0.0, u**2)", "jnp.nan_to_num(u)",
    "jnp.trunc(2.5)*u", "jnp.arange(4)[2]*u", "jnp.int32(3)*u", "True*u", "(3 // 2)*jnp.sin(u)",
    "u*jnp.array([1, 2, 3])[1]",
)  # fmt: skip
_SINGULAR = (
    "jnp.sqrt(u)", "jnp.log(u)", "jnp.log1p(u)", "1/u", "u**-1", "u**-2.0", "jnp.cbrt(u)", "lax.rsqrt(u)", "u**0.5",
    "u**1.5", "u**2.5", "jnp.power(jnp.abs(u), 1.5)", "jnp.arcsin(u)", "jnp.arccos(u)", "jnp.arctanh(u)",
    "jnp.arccosh(1 + u)", "jnp.sqrt(u**2)", "jnp.sqrt(u**4)", "jnp.log(u**2)", "u*jnp.log(u**2)",
    "special.xlogy(u, u)", "special.entr(u)", "jnp.sin(u)/u", "jnp.exp(-1/u**2)", "1/jnp.sin(u)", "jnp.tan(u)",
    "jnp.arctan(1/u)", "u**jnp.pi", "jnp.hypot(u, 0.0)", "jnp.expm1(u)/u", "u/jnp.sinh(u)",
)  # fmt: skip
SMOOTH = _ENTIRE + _SINGULAR
KINKED = (
    "jnp.abs(u)", "jnp.fabs(u)", "jnp.maximum(u, 0.3)", "jnp.maximum(u, 0.0)", "jnp.minimum(u, 0.0)",
    "jnp.fmax(u, 0.2)", "jnp.fmin(u, 0.2)", "jnp.clip(u, -0.5, 0.5)", "lax.clamp(0.0, u, 1.0)", "nn.relu(u)",
    "nn.relu6(u)", "nn.leaky_relu(u)", "nn.elu(u)", "nn.celu(u)", "nn.selu(u)", "nn.hard_tanh(u)",
    "nn.hard_sigmoid(u)", "nn.hard_silu(u)", "jnp.abs(u)**3", "u*jnp.abs(u)", "jnp.sign(u)*u**2",
    "jnp.maximum(u, 0.0)**2", "jnp.maximum(u, 0.0)**1.5", "jnp.maximum(u, -u)",
    "jnp.maximum(jnp.maximum(u, 0.0), 2*u)", "jnp.where(u > 0, u, 0.2*u)", "jnp.where(u > 0, u**2, u**3)",
    "jnp.where(u > 0, jnp.sqrt(jnp.where(u > 0, u, 1.0)), 0.0)",
    "jnp.select([u < -0.5, u < 0.5], [-0.5 + 0*u, u], 0.5)",
    "jnp.piecewise(u, [u < 0], [lambda y: y**2, lambda y: y])", "lax.cond(u > 0, lambda y: y**2, lambda y: -y, u)",
    "lax.cond(u > 0, lambda: jnp.sqrt(u)*u, lambda: 0.3*u)",
    "lax.cond(u > 0, lambda: u*jnp.log(u), lambda: jnp.sin(u))", "lax.cond(u >= 0, lambda: u**1.5, lambda: u**2)",
    "lax.switch((u > 0)*1 + (u > 1)*1, [lambda y: 0*y, lambda y: y**2, lambda y: 2*y - 1], u)",
    "lax.switch(1*(u > 0), [lambda: -u, lambda: u/jnp.sqrt(u)])", "jnp.abs(u % 1.0 - 0.5)",
    "jnp.abs(u - jnp.round(u))", "jnp.arccos(jnp.cos(u))", "jnp.arcsin(jnp.sin(u))", "jnp.abs(jnp.sin(u))",
    "jnp.interp(u, jnp.array([-1.0, 0.0, 1.5]), jnp.array([0.3, -0.2, 1.0]))", "jnp.abs(jnp.round(u) - u)**2",
    "jnp.hypot(u, jnp.maximum(u, 0.0))", "jnp.logaddexp(jnp.abs(u), 0.0)", "jnp.sqrt(jnp.maximum(u, 0.0))",
    "jnp.exp(-jnp.abs(u))", "1/(1 + jnp.abs(u))", "jnp.tanh(jnp.maximum(u, 0.0))",
    "jnp.log(1 + jnp.exp(jnp.abs(u)))",
)  # fmt: skip
STEPS = (
    "jnp.sign(u)", "jnp.floor(u)", "jnp.ceil(u)", "jnp.round(u)", "jnp.rint(u)", "jnp.trunc(u)",
    "jnp.heaviside(u, 0.5)", "1.0*(u > 0)", "1.0*(u >= 0.5)", "1.0*(u == 0)", "1.0*(u != 1)",
    "1.0*((u > 0) & (u < 1))", "1.0*((u > 0) | (u < -1))", "1.0*((u > 0) ^ (u < 1))", "1.0*~(u > 0)",
    "1.0*jnp.logical_not(u > 0)", "1.0*jnp.logical_xor(u > 0, u > 1)", "jnp.copysign(1.0, u)",
    "jnp.where(jnp.signbit(u), -1.0, 1.0)", "u % 1.0", "jnp.mod(u, 0.7)", "jnp.fmod(u, 0.7)",
    "jnp.remainder(u, -0.7)", "u // 0.7", "jnp.floor_divide(u, 0.3)", "jnp.divmod(u, 0.7)[0]",
    "jnp.divmod(u, 0.7)[1]", "jnp.modf(u)[0]", "jnp.modf(u)[1]", "lax.rem(u, 0.7)",
    "lax.round(u, lax.RoundingMethod.AWAY_FROM_ZERO)", "1.0*u.astype(int)", "1.0*u.astype(jnp.int32)",
    "1.0*jnp.floor(u).astype(jnp.int8)", "1.0*(u > 0).astype(int)", "1.0*(u.astype(int) % 2)",
    "1.0*(u.astype(int) // 2)", "1.0*(jnp.floor(u).astype(int) & 1)", "1.0*(jnp.floor(u).astype(int) ^ 3)",
    "1.0*(jnp.floor(u).astype(int) | 4)", "1.0*(jnp.floor(u).astype(int) >> 1)",
    "1.0*(jnp.floor(u).astype(int) << 1)", "1.0*(~jnp.floor(u).astype(int))",
    "1.0*jnp.abs(jnp.floor(u).astype(int))", "1.0*jnp.maximum(jnp.floor(u).astype(int), 0)",
    "1.0*jnp.clip(jnp.floor(u).astype(int), -1, 1)", "1.0*(jnp.floor(u).astype(int)**2)",
    "1.0*lax.population_count(jnp.floor(u).astype(int))", "1.0*jnp.sign(jnp.floor(u).astype(int))",
    "1.0*jnp.gcd(jnp.floor(u).astype(int), 6)", "1.0*lax.integer_pow(jnp.floor(u).astype(int), 3)",
    "1.0*jnp.bitwise_xor(jnp.floor(u).astype(int), jnp.floor(2*u).astype(int))", "1.0*jnp.isfinite(u)",
    "1.0*jnp.isclose(u, 0.0)", "jnp.array([0.1, -0.3, 0.7, 1.1])[jnp.clip(jnp.floor(u).astype(int) + 2, 0, 3)]",
    "jnp.take(jnp.array([0.1, -0.3, 0.7, 1.1]), jnp.floor(u).astype(int), mode='clip')",
    "1.0*jnp.digitize(u, jnp.array([-0.6, 0.1, 0.8]))", "1.0*jnp.searchsorted(jnp.array([-0.6, 0.1, 0.8]), u)",
    "jnp.select([u < -0.5, u < 0.7], [-1.0, 0.2], 1.0)", "jnp.piecewise(u, [u < 0], [-1.0, 1.0])",
    "lax.cond(u > 0, lambda y: y + 1, lambda y: jnp.sin(y), u)",
    "lax.switch(jnp.clip(jnp.floor(u).astype(int), 0, 2), [lambda: 0.1, lambda: -0.4, lambda: 0.9])",
    "lax.select(u > 0, u, -1.0 + 0*u)", "lax.select_n(u > 0, u + 1, u - 1)", "jnp.choose(1*(u > 0), [u, 1 - u])",
    "u*(u > 0) + 2*(u <= 0)", "jnp.frexp(1.5 + jnp.sin(u))[0]", "jnp.ldexp(u, 2)", "jnp.nextafter(jnp.sign(u), 2.0)",
    "jnp.unwrap(jnp.stack([u, 2*u]))[1]",
)  # fmt: skip

# ---- and of a vector x of three numbers ------------------------------------------------------------------------------

_PLAIN_VECTORS = (
    "jnp.sum(x)", "jnp.prod(x)", "jnp.mean(x**2)", "jnp.var(x)", "jnp.std(x + jnp.array([0.0, 1.0, 3.0]))", "x @ x",
    "jnp.dot(x, x[::-1])", "jnp.vdot(x, x)", "jnp.inner(x, A @ x)", "x @ A @ x", "jnp.einsum('i,ij,j', x, A, x)",
    "jnp.outer(x, x).sum()", "jnp.kron(x, x).sum()", "jnp.cross(x, jnp.array([1.0, 0.5, -0.2]))[0]",
    "jnp.cumsum(x)[1]*x[2]", "jnp.cumprod(x)[2]", "jnp.diff(x) @ jnp.diff(x)", "jnp.roll(x, 1) @ x",
    "jnp.convolve(x, x)[2]", "jnp.linalg.norm(x + 2)", "jnp.linalg.norm(x, ord=4)",
    "jnp.linalg.det(jnp.eye(3) + jnp.outer(x, x))", "jnp.linalg.slogdet(2*jnp.eye(3) + jnp.diag(jnp.sin(x)))[1]",
    "jnp.linalg.inv(2*jnp.eye(3) + jnp.diag(x**2))[0, 0]", "jnp.linalg.solve(2*jnp.eye(3) + jnp.outer(x, x), x) @ x",
    "jnp.linalg.cholesky(jnp.eye(3) + jnp.outer(x, x))[2, 2]", "jnp.trace(jnp.outer(x, x))",
    "jnp.linalg.matrix_power(jnp.diag(x) + A, 2)[0, 1]", "jax.scipy.linalg.expm(0.1*jnp.diag(x))[0, 0]",
    "jnp.tensordot(x, x, 1)", "special.logsumexp(x)", "special.logsumexp(3*x, b=jnp.array([1.0, 2.0, 0.5]))",
    "nn.softmax(x)[0]", "nn.log_softmax(x)[1]", "nn.logsumexp(x)",
    "nn.standardize(x + jnp.array([0.0, 1.0, 3.0]))[0]", "nn.glu(jnp.append(x, 0.3))[0]", "jnp.polyval(x, 0.7)",
    "jnp.trapezoid(x**2)", "jnp.ptp(x*0 + jnp.arange(3))*x[0]",
    "jnp.where(jnp.array([True, False, True]), x, 2*x).sum()", "x[jnp.array([2, 0, 1])] @ jnp.arange(3.0)",
    "x.at[0].add(x[1]) @ x", "x.at[1].set(x[0]*x[2]).sum()", "x.at[jnp.array([0, 0, 1])].add(x).sum()**2",
    "x.at[1].multiply(x[0])[1]", "lax.dynamic_slice(x, (1,), (2,)).sum()",
    "lax.dynamic_update_slice(x, x[:1]**2, (2,)).sum()", "jnp.pad(x, 1, mode='edge') @ jnp.arange(5.0)",
    "jnp.pad(x, 2, mode='wrap').sum()", "jnp.tile(x, 2) @ jnp.arange(6.0)", "jnp.repeat(x, 2).sum()",
    "jnp.flip(x) @ jnp.arange(3.0)", "jnp.concatenate([x, x**2]).sum()", "jnp.stack([x, jnp.sin(x)]).prod(0).sum()",
    "jnp.split(x, 3)[1][0]", "jnp.meshgrid(x, x)[0].sum()", "jnp.tril(jnp.outer(x, x)).sum()",
    "jnp.real(jnp.fft.fft(x)[1])", "jnp.abs(jnp.fft.fft(x)[1])**2", "jnp.ravel(jnp.outer(x, x))[4]",
    "jnp.triu(jnp.outer(x, x), 1).sum()", "jnp.rot90(jnp.outer(x, x + 1))[0, 0]", "jax.vmap(jnp.sin)(x).sum()",
    "jax.vmap(lambda a: a @ x)(A).sum()", "lax.map(lambda y: jnp.exp(y)*y, x).sum()",
    "jax.hessian(lambda y: jnp.prod(y)*y[0])(x)[0, 1]", "jax.jacfwd(lambda y: y[0]*jnp.sin(y))(x)[1, 0]",
    "jnp.sum(jnp.log(1 + jnp.exp(jnp.diff(x))))", "jnp.sum(1/(1 + jnp.exp(x - jnp.roll(x, 1))))",
    "lax.scan(lambda c, y: (c*y + 0.3, c), 1.0 + 0*x[0], x)[0]",
    "lax.fori_loop(0, 3, lambda k, y: y + jnp.sin(x[k])*y, 1.0 + 0*x[0])", "lax.cumlogsumexp(x)[2]",
    "jnp.sum(jnp.triu(A)*jnp.outer(x, x))", "own_norm(x)", "jnp.sqrt(1 + x @ x)", "jnp.sum(jnp.sqrt(1 + x**2))",
    "jnp.geomspace(1.0, 4.0, 3) @ x", "jnp.linspace(0.0, 1.0, 3) @ x",
    "jnp.average(x, weights=jnp.array([1.0, 2.0, 0.5]))", "lax.reduce(x, 0.0, lax.add, (0,))", "lax.dot(x, x)",
    "lax.batch_matmul(x[None, None], x[None, :, None])[0, 0, 0]",
    "lax.conv(x[None, None], x[None, None, :2], (1,), 'VALID').sum()", "jnp.correlate(x, x, mode='full')[2]",
)  # fmt: skip
_KINKED_VECTORS = (
    "jnp.max(x)", "jnp.min(x)", "jnp.amax(jnp.abs(x))", "jnp.ptp(x)", "jnp.linalg.norm(x)",
    "jnp.linalg.norm(x, ord=1)", "jnp.linalg.norm(x, ord=jnp.inf)", "jnp.linalg.norm(x, ord=3)", "jnp.median(x)",
    "jnp.sort(x) @ jnp.array([0.2, 0.5, -0.3])", "jnp.sort(x)[1]", "jnp.quantile(x, 0.3)", "jnp.percentile(x, 75)",
    "lax.cummax(x)[1]*2", "lax.cummin(x).sum()", "lax.top_k(x, 2)[0].sum()", "jnp.partition(x, 1)[0]",
    "jnp.maximum(x[0], x[1])", "jnp.minimum(x[0], x[1])*x[2]", "jnp.nanmax(x)", "x[jnp.argmax(x)]",
    "x[jnp.argsort(x)[0]]", "jnp.take_along_axis(x, jnp.argsort(x), 0)[2]", "jnp.sum(jnp.abs(jnp.diff(x)))",
    "jnp.sum(jnp.maximum(x, 0.0)**2)", "jnp.sum(nn.relu(A @ x))", "x.at[jnp.array([0, 0])].max(x[:2]).sum()",
    "x.at[1].min(x[0]).sum()", "lax.sort((x, x[::-1]), num_keys=1)[1][0]*0 + jnp.sum(jnp.sort(x)**2)",
    "jnp.hypot(x[0], x[1])", "jnp.abs(x[0] + 1j*x[1])", "jnp.real((x[0] + 1j*x[1])**1.5)",
    "jnp.sqrt(x[0]**2 + x[1]**2)", "jnp.sum(jnp.sqrt(jnp.sum((x[:, None] - x[None])**2, 1) + 1e-3))",
    "jnp.where(x @ x > 0, jnp.sqrt(jnp.where(x @ x > 0, x @ x, 1.0)), 0.0)",
    "lax.cond(x[0] > x[1], lambda y: y[0]**2 - y[1]**2, lambda y: 0*y[0], x)",
    "lax.cond(x[0] > 0, lambda: jnp.sqrt(x[0])*x[1]*x[0], lambda: x[1]*x[0])",
    "jnp.linalg.norm(jnp.outer(x, x), ord='fro')", "lax.reduce_max(x, (0,))",
    "lax.reduce(x, -jnp.inf, lax.max, (0,))", "jnp.logaddexp(jnp.max(x), 0.0)", "jnp.fmax(x[0], x[2])",
)  # fmt: skip
_STEP_VECTORS = (
    "1.0*jnp.argmax(x)", "1.0*jnp.argmin(x)", "1.0*jnp.argsort(x)[0]", "1.0*jnp.any(x > 0.5)",
    "1.0*jnp.all(x > -0.5)", "1.0*jnp.count_nonzero(x > 0)", "jnp.sum(x > 0)*x[0]", "1.0*jnp.max(x > 0)",
    "1.0*jnp.sort(x > 0)[1]", "1.0*(jnp.floor(x[0]).astype(int) ^ jnp.floor(x[1]).astype(int))",
    "1.0*(jnp.floor(x[0]).astype(int) & jnp.floor(x[1]).astype(int))",
    "1.0*(jnp.floor(x[0]).astype(int) | jnp.floor(x[1]).astype(int))", "1.0*(jnp.floor(x).astype(int).sum() % 2)",
    "1.0*jnp.sum(jnp.floor(x).astype(int)*jnp.array([1, 2, 4]))",
    "1.0*lax.reduce_xor(jnp.floor(x).astype(int), (0,))", "jnp.asarray(A)[jnp.argmax(x), jnp.argmin(x)]",
    "jnp.asarray(A)[jnp.clip(jnp.floor(x[0]).astype(int) + 1, 0, 2), jnp.clip(jnp.floor(x[1]).astype(int) + 1, 0, 2)]",
    "x[jnp.clip(jnp.floor(x[0]).astype(int) + 1, 0, 2)]", "jnp.sum(jnp.sign(x)*jnp.array([0.3, 1.0, -0.4]))",
    "1.0*(jnp.argmax(x) == 1)", "1.0*jnp.cumsum(x > 0)[1]", "1.0*jnp.array_equal(x, jnp.sort(x))",
    "1.0*jnp.sum(jnp.round(x).astype(int) // 2)",
    "lax.switch(jnp.argmax(x), [lambda: 0.3, lambda: x[0], lambda: x[1]**2])",
    "jnp.dot(jnp.round(x).astype(int), jnp.array([1, 3, -2]))*0.1", "1.0*jnp.floor(x).astype(jnp.int32).max()",
    "jnp.sum(jnp.where(x > jnp.mean(x), x, 0.0))",
)  # fmt: skip
OF_VECTORS = _PLAIN_VECTORS + _KINKED_VECTORS + _STEP_VECTORS
A = np.array([[0.5, -0.2, 0.1], [0.3, 0.8, -0.4], [0.0, 0.6, 1.1]])


@jax.custom_jvp
def own_sine(u):
    """sin u, with the rule of sin u + u as its derivative."""
    return jnp.sin(u)


own_sine.defjvps(lambda g, w, u: g * (jnp.cos(u) + 1.0))


@jax.custom_vjp
def own_square(u):
    """u², with three times its derivative."""
    return u**2


own_square.defvjp(lambda u: (u**2, u), lambda u, g: (6.0 * u * g,))


@jax.custom_jvp
def own_norm(x):
    """|x|, with a derivative of zero at zero."""
    return jnp.sqrt(x @ x)


@own_norm.defjvp
def _(primals, tangents):
    (x,), (of_x,) = primals, tangents
    size = own_norm(x)
    return size, jnp.where(size > 0, x @ of_x / jnp.where(size > 0, size, 1.0), 0.0)


# ---- expressions -----------------------------------------------------------------------------------------------------

ROLES = ("potential", "force", "kinetic", "dissipation", "constraint")
STARTS = ("random", "zero", "tied", "whole", "negative", "nothing")
_KINDS = ((*SMOOTH, *_PLAIN_VECTORS), (*KINKED, *_KINKED_VECTORS), (*STEPS, *_STEP_VECTORS))
_ALL = tuple((text, kind) for kind, texts in enumerate(_KINDS) for text in texts)
_ARGUMENTS = (
    "x[0]", "x[1]", "x[0] - x[1]", "x[0]*x[1]", "2*x[2]", "x[0] + 0.5", "x[1] - 1", "-x[0]",
    "(x[0] + 2*x[1] - x[2])", "x[0]**2 - x[1]", "0.7*x[1] + 0.2",
)  # fmt: skip
_AROUND = (
    "{}", "{}", "{}", "{}", "{} + {}", "({})*({})", "jnp.log(1 + jnp.exp({}))", "1/(1 + jnp.exp({}))",
    "jnp.exp(-({})**2)", "jnp.tanh(jnp.exp({}))", "jnp.sin({})*x[2]", "({})/(1 + jnp.cosh({}))",
    "lax.cond(x[0] > 0.1, lambda: {}, lambda: {})", "jnp.where(x[1] > 0.1, {}, {})", "jnp.maximum({}, {})",
    "jnp.sqrt(1 + ({})**2)",
)  # fmt: skip


class Scene(NamedTuple):
    """A scene: its role, its expression in x, what kind its start is, and the state."""

    number: int
    role: str
    text: str
    start: str
    q: np.ndarray
    qdot: np.ndarray
    constant: float = 0.0

    @property
    def snippet(self) -> str:
        """The scene as it is made, in Python, with its acceleration."""
        q, qdot = (f"np.array({x.tolist()})" for x in (self.q, self.qdot))
        return (
            "import jax; from benchmarks.expression_population import *; jax.config.update('jax_enable_x64', True)\n"
            f"scene = Scene(0, {self.role!r}, {self.text!r}, {self.start!r}, {q}, {qdot}, {self.constant!r})\n"
            "print(scene.system().acceleration(scene.q, scene.qdot), scene.refer(scene.q, scene.qdot))"
        )

    def evaluate(self, x):
        """The expression."""
        return eval(self.text, {**globals(), "x": x})

    def functions(self):
        """L, the forces, the dissipation and the constraints, or None."""
        role, free = self.role, lambda q, v: 0.5 * v @ (WEIGHTS[: len(v)] * v)
        if role == "potential":
            return lambda q, v: free(q, v) - self.evaluate(q), None, None, None
        if role == "kinetic":
            return (
                lambda q, v: free(q, v) * (1.5 + jnp.tanh(0.5 * self.evaluate(q))) + 0.1 * jnp.sum(q),
                None,
                None,
                None,
            )
        if role == "force":
            return free, lambda q, v: WAYS * self.evaluate(q + 0.0 * v), None, None
        if role == "dissipation":
            return lambda q, v: free(q, v) - 0.1 * jnp.sum(q**2), None, lambda q, v: self.evaluate(v), None

        def constraint(q):
            return q[3] + 0.3 * self.evaluate(q[:3]) - self.constant

        return lambda q, v: free(q, v) - 0.4 * jnp.sum(q), None, None, constraint

    def system(self) -> lagjax.System:
        """The scene in lagjax."""
        lagrangian, forces, dissipation, constraints = self.functions()
        return lagjax.System(lagrangian, forces=forces, dissipation=dissipation, constraints=constraints)

    def refer(self, q, v):
        """The acceleration in plain JAX."""
        lagrangian, forces, dissipation, constraint = self.functions()
        q, v = jnp.asarray(q, float), jnp.asarray(v, float)
        momentum = jax.grad(lagrangian, 1)
        force = jax.grad(lagrangian)(q, v) - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]
        force = force if forces is None else force + forces(q, v)
        force = force if dissipation is None else force - jax.grad(dissipation, 1)(q, v)
        mass = jax.jacfwd(momentum, 1)(q, v)
        if constraint is None:
            return jnp.linalg.solve(mass, force)
        gradient = jax.grad(constraint)(q)
        bend = jax.jvp(lambda q: jax.grad(constraint)(q) @ v, (q,), (v,))[1]
        left = jnp.block([[mass, gradient[:, None]], [gradient[None], jnp.zeros((1, 1))]])
        return jnp.linalg.solve(left, jnp.append(force, -bend))[: len(q)]


WEIGHTS, WAYS = np.array([1.0, 2.0, 0.7, 1.5]), np.array([1.0, -0.5, 0.3])


def draw(number: int, seed: int) -> Scene:
    """Scene `number` of the population; every function takes its turn."""
    rng = np.random.default_rng([seed, number])
    order = np.random.default_rng([seed, number // len(_ALL)]).permutation(len(_ALL))
    role = ROLES[int(rng.choice(len(ROLES), p=(0.4, 0.25, 0.15, 0.1, 0.1)))]
    first, jumps = _ALL[order[number % len(_ALL)]]
    role = "force" if jumps == 2 else role
    most, around = 2 if role == "force" else 1, str(rng.choice(_AROUND))
    if role != "force" and ("where" in around or "cond" in around):  # what jumps is no matter of derivatives
        around = "{}"

    def fill(text):
        return text if text in OF_VECTORS else _put(text, str(rng.choice(_ARGUMENTS)))

    others = [text for text, kind in _ALL if kind <= most]
    parts = [first, *rng.choice(others, around.count("{}") - 1)]
    filled = [fill(str(part)) for part in parts]
    if rng.random() < 0.15 and "(lambda" not in filled[0]:  # one in the other
        inner = filled[0]
        outer = str(rng.choice([text for text, kind in _ALL[: len(SMOOTH)] if "lambda" not in text]))
        filled[0] = _put(outer, f"({inner})")
    text, start = around.format(*filled), str(rng.choice(STARTS, p=(0.2, 0.25, 0.2, 0.15, 0.12, 0.08)))
    q = {
        "random": lambda: rng.normal(size=3) * 0.7,
        "zero": lambda: np.zeros(3),
        "tied": lambda: np.full(3, rng.choice([0.4, -0.3, 1.25])) * np.array([1, 1, rng.choice([1, -1, 0.5])]),
        "whole": lambda: rng.integers(-2, 3, 3).astype(float),
        "negative": lambda: -np.abs(rng.normal(size=3)) - 0.2,
        "nothing": lambda: rng.choice([1e-300, -1e-200, 1e-170, 1e-100, 0.0], 3),
    }[start]()
    v = rng.normal(size=3) * 0.5 if rng.random() < 0.7 else np.zeros(3)
    if role == "dissipation":
        q, v = v, q
    scene = Scene(number, role, text, start, q, v)
    if role == "constraint":
        value, slope = jax.value_and_grad(scene.evaluate)(jnp.asarray(q))
        last = -0.3 * float(slope @ v)
        v = np.append(v, last) if math.isfinite(last) else np.zeros(4)
        scene = scene._replace(q=np.append(q, 0.5), qdot=v, constant=0.5 + 0.3 * float(value))
    return scene


def _put(text: str, argument: str) -> str:
    """The text with an argument in the place of every u that stands alone."""
    result = ""
    for i, letter in enumerate(text):
        before, behind = text[i - 1 : i], text[i + 1 : i + 2]
        alone = letter == "u" and not before.isalnum() and before not in ("_", ".") and not behind.isalpha()
        result += f"({argument})" if alone else letter
    return result


# ---- comparison ------------------------------------------------------------------------------------------------------


def _is_own(error: BaseException) -> bool:
    """True for an error that lagjax says, and not one that went through it."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    plain = isinstance(error, (ValueError, TypeError, lagjax.SimulationError)) and " " in str(error)
    return plain and f"{os.sep}lagjax{os.sep}" in frame.filename


def _compare(found, exact, beside, allowed, is_slope: bool = False) -> str:
    """How numbers compare with those of JAX (components,), and with those at places beside (places, components)."""
    found, size = np.asarray(found, float), np.abs(exact[np.isfinite(exact)]).max(initial=0.0)
    if max(size, np.abs(beside[np.isfinite(beside)]).max(initial=0.0)) > LARGEST:
        return "not compared"
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        same = (np.abs(found - exact) <= allowed) | (~np.isfinite(found) & ~np.isfinite(exact)) | (found == exact)
        if same.all():
            return "right"
        low, high = np.nanmin(beside, 0), np.nanmax(beside, 0)
        if np.isnan(low).all():  # JAX has no derivative of it anywhere
            return "not compared"
        if is_slope and not (high - low <= 1e-3 * (1 + size)).all():  # there is none, or more than one
            return "not compared"
        wide = allowed + 1e-4 * (1 + size)
        between = (found >= low - wide) & (found <= high + wide)
    if (same | between).all():
        return "one of both sides"
    return "NaN without need" if (np.isfinite(exact) & ~np.isfinite(found)).any() else "wrong"


FINE = ("right", "one of both sides", "not compared", "not in JAX")


class Exact(NamedTuple):
    """q̈ and its Jacobian by JAX at a state, and at places beside it."""

    rates: np.ndarray
    slopes: np.ndarray
    rates_beside: np.ndarray
    slopes_beside: np.ndarray


def _refer(rates: Callable, z: np.ndarray, places: np.ndarray, compiled: bool) -> Exact:
    def both(z):
        return (rates(z), jax.jacfwd(rates)(z))

    points = jnp.asarray(np.vstack([z, places]))
    if compiled:
        found = jax.jit(jax.vmap(both))(points)
    else:
        found = zip(*map(both, points), strict=True)
    (of_rates, of_slopes) = (np.array([np.asarray(x) for x in some]) for some in found)
    return Exact(of_rates[0], of_slopes[0], of_rates[1:], of_slopes[1:])


def compare(scene: Scene, single: bool, motion: bool) -> tuple[str, str]:
    """The verdict on a scene, and what it is about."""
    rng, n = np.random.default_rng(scene.number), len(scene.q)
    z = np.concatenate([scene.q, scene.qdot])
    z = z.astype(np.float32).astype(float) if single else z
    aside = BESIDE * rng.normal(size=(SIDES // 2, 2 * n)) * (1 + np.abs(z))
    rates, places = (lambda z: scene.refer(z[:n], z[n:])), np.concatenate([z + aside, z - aside])
    system, kind = scene.system(), jnp.float32 if single else float
    q, v = jnp.asarray(z[:n], kind), jnp.asarray(z[n:], kind)
    mode = jax.jacfwd if scene.number % 2 else jax.jacrev
    found: list[np.ndarray] = []
    for compiled in (True, False):  # what XLA makes of `jit` of `vmap` is wrong at times: then operation by operation
        with jax.enable_x64(True):
            try:
                exact = _refer(rates, z, places, compiled)
            except Exception as error:  # JAX has no second derivative
                return "not in JAX", f"{type(error).__name__}: {str(error)[:100]}"
        if not found:
            found.append(np.asarray(system.acceleration(q, v), float))
            found.append(np.asarray(mode(lambda q: system.acceleration(q, v))(q), float))
        verdict, about = _verdict(found, exact, z, single)
        if verdict in FINE:
            break
    if verdict not in FINE:
        return f"{verdict}, {mode.__name__}" if about.startswith("slopes") else verdict, about
    if motion and np.isfinite(exact.rates).all() and np.abs(exact.rates).max() < 1e6:
        return _compare_motion(q, v, system, rates, single)
    return verdict, ""


def _verdict(found: list[np.ndarray], exact: Exact, z: np.ndarray, single: bool) -> tuple[str, str]:
    (tolerance, unit), n = TOLERANCES[single], len(z) // 2

    def size(x):
        return 1 + np.abs(np.nan_to_num(x, posinf=0.0, neginf=0.0)).max()

    rounding = unit * np.abs(np.nan_to_num(exact.slopes, posinf=0.0, neginf=0.0)) @ np.abs(z)
    verdict = _compare(found[0], exact.rates, exact.rates_beside, tolerance * size(exact.rates) + rounding)
    if verdict not in FINE:
        return verdict, f"acceleration {found[0].tolist()} for {exact.rates.tolist()}"
    right, allowed = exact.slopes[:, :n], (1000 if single else 10) * tolerance
    sides = exact.slopes_beside[:, :, :n].reshape(SIDES, -1)
    of_slopes = _compare(found[1].ravel(), right.ravel(), sides, allowed * size(right), is_slope=True)
    if of_slopes not in FINE:
        return of_slopes, f"slopes {found[1].tolist()} for {right.tolist()}"
    return verdict, ""


class _SpentError(Exception):
    """The reference took too many evaluations."""


def _compare_motion(q, v, system, rates, single: bool) -> tuple[str, str]:
    n, ends = len(q), []
    with jax.enable_x64(True):
        compiled, z = jax.jit(rates), np.concatenate([q, v]).astype(float)
        for step in (DURATION / 40, DURATION / 53):
            calls = itertools.count()

            def right(t, z, calls=calls):
                if next(calls) > MOST_CALLS:
                    raise _SpentError
                return np.concatenate([z[n:], np.nan_to_num(compiled(jnp.asarray(z)))])

            try:
                end = solve_ivp(right, (0.0, DURATION), z, "DOP853", rtol=1e-10, atol=1e-12, max_step=step)
            except _SpentError:  # the reference slides along a border in ever smaller steps
                return "not compared", ""
            ends.append(end.y[:, -1] if end.status == 0 else np.full(2 * n, np.nan))
    allowed = OF_MOTION[single] * (1 + np.abs(ends[0]).max())
    if not np.abs(ends[0] - ends[1]).max() < 0.1 * allowed:
        return "not compared", ""
    run = lagjax.simulate(system, q, v, jnp.array([0.0, DURATION], q.dtype))
    found = np.concatenate([run.q[-1], run.qdot[-1]]).astype(float)
    wrong = np.abs(found - ends[0]).max() > allowed
    return ("wrong, motion", f"{found.tolist()} for {ends[0].tolist()}") if wrong else ("right", "")


def judge(number: int, seed: int, single: bool, every: int) -> tuple[Scene | None, str, str]:
    """Scene `number`, the verdict on it and what that is about."""
    with jax.enable_x64(True):
        try:
            scene = draw(number, seed)
            scene.evaluate(jnp.asarray(scene.q))
        except Exception as error:  # JAX does not have it, or not of these operands
            return None, "not in JAX", f"{type(error).__name__}: {str(error)[:100]}"
    with jax.enable_x64(not single):
        try:
            return scene, *compare(scene, single, bool(every) and number % every == 0)
        except Exception as error:
            words = f"{type(error).__name__}: {str(error)[:300]}"
            return scene, "refused" if _is_own(error) else "raw", words


def main(arguments=None) -> dict[str, int]:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.expression_population", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--float32", action="store_true", help="JAX's default precision")
    parser.add_argument("--motions", type=int, default=10, help="one scene in so many is followed; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true", help="store the counts and what is not right")
    given = parser.parse_args(arguments)
    counts: collections.Counter = collections.Counter()
    offenders = []
    for number in range(given.first, given.first + given.scenes):
        scene, verdict, about = judge(number, given.seed, given.float32, given.motions)
        counts[verdict] += 1
        if verdict not in FINE and scene is not None:
            offenders.append({"scene": number, "verdict": verdict, "role": scene.role, "expression": scene.text})
            print(f"# scene {number}, {scene.start}: {verdict}: {about}\n{scene.snippet}\n", flush=True)
        if number % 50 == 49:
            jax.clear_caches()
            print(f"# {number + 1}: {dict(counts.most_common())}", file=sys.stderr, flush=True)
    print(dict(counts.most_common()))
    if given.write:
        record, last = _report.read_json(STORE), given.first + given.scenes - 1
        name = f"{'float32' if given.float32 else 'float64'}, scenes {given.first} to {last}"
        done = {"seed": given.seed, "counts": dict(counts.most_common()), "not right": offenders}
        _report.write_json(STORE, record | {name: done | {"circumstances": _report.circumstances()}})
    return dict(counts)


if __name__ == "__main__":
    main(sys.argv[1:])
