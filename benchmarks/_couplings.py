"""Random couplings of large scenes, written as users write them: gathers, masks, sums over segments, loops, calls.

Each is a term of a kinetic energy, or a constraint on pairs of coordinates. It reads (x, q, t, params): numbers x (n,)
that are coupled, and params, a dict of `index` (n,) whole numbers, `weight` (n,) and `shift`, one whole number. Where
an index comes from is drawn as well: it is known, or made by arithmetic of whole numbers, or is that of params, of t,
or of the order of q.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

BLOCK = 5  # what is reshaped has rows of so many


class Coupling(NamedTuple):
    """Terms `of(x, q, t, params)` (any shape), the names of how they are written, and of where indices are from."""

    names: tuple[str, ...]
    of: Callable


def draw(rng: np.random.Generator, n: int, terms: int) -> Coupling:
    """A coupling of n numbers: so many drawn terms, some of which call the same function twice."""
    drawn = [_draw_term(rng, n) for _ in range(terms)]
    functions = [function for _, function in drawn]
    return Coupling(tuple(name for name, _ in drawn), lambda *state: [function(*state) for function in functions])


def _draw_term(rng: np.random.Generator, n: int) -> tuple[str, Callable]:
    source, index = _draw_index(rng, n)
    name = str(rng.choice(list(_FORMS)))
    other_source, other = _draw_index(rng, n)
    form, weight = _FORMS[name], rng.uniform(0.05, 0.15)
    own = rng.uniform(0.2, 1.0, n) * (rng.random(n) < 0.7)

    def term(x, q, t, params):
        return weight * form(x, _Given(own, index(q, t, params), other(q, t, params), q, t, params))

    return f"{name} ({source}, {other_source})", term


class _Given(NamedTuple):
    """Weights with zeros, two indices, and the state."""

    own: np.ndarray
    index: jax.Array
    other: jax.Array
    q: jax.Array
    t: jax.Array
    params: dict


# ---- indices ---------------------------------------------------------------------------------------------------------


def _draw_index(rng: np.random.Generator, n: int) -> tuple[str, Callable]:
    i, k, d = np.arange(n), int(rng.integers(1, 9)), int(rng.integers(2, 7))
    sources = {
        "known": lambda q, t, p: np.roll(i, k),
        "whole": lambda q, t, p: jnp.arange(n),
        "lax.div": lambda q, t, p: jnp.clip(d * jax.lax.div(jnp.arange(n), d), 0, n - 1),
        "lax.div below 0": lambda q, t, p: jnp.clip(jax.lax.div(jnp.arange(n) - n // 2, d) + n // 2, 0, n - 1),
        "lax.rem": lambda q, t, p: (jax.lax.rem(jnp.arange(n) - n // 2, d) + jnp.arange(n)) % n,
        "//": lambda q, t, p: d * (jnp.arange(n) // d),
        "%": lambda q, t, p: (jnp.arange(n) + k) % n,
        "xor": lambda q, t, p: jnp.minimum(jnp.arange(n) ^ 1, n - 1),
        "shift": lambda q, t, p: (jnp.arange(n) >> 1) << 1,
        "floor": lambda q, t, p: jnp.floor(jnp.arange(n) / d).astype(int) * d,
        "negative": lambda q, t, p: jnp.arange(n) - k,
        "sorted": lambda q, t, p: jnp.argsort(jnp.asarray(np.cos(3.0 * i))),
        "params": lambda q, t, p: p["index"],
        "params shifted": lambda q, t, p: (jnp.arange(n) + p["shift"]) % n,
        "t": lambda q, t, p: (jnp.arange(n) + jnp.floor(3 * t).astype(int)) % n,
        "argsort(q)": lambda q, t, p: jnp.argsort(q),
    }
    name = str(rng.choice(list(sources)))
    return name, sources[name]


# ---- how terms are written -------------------------------------------------------------------------------------------


@jax.jit
def _pick(x, index):
    return x[index]


@jax.jit
def _couple(x, index, weight):
    return weight * x[index] * x


@jax.custom_jvp
def _own_rule(x):
    return jnp.sin(x)


_own_rule.defjvp(lambda x, dx: (jnp.sin(x[0]), jnp.cos(x[0]) * dx[0]))


def _rounds(x, given):
    def body(carry, row):
        i, w = row
        return carry + w * x[i], x[i] * carry

    return jax.lax.scan(body, jnp.zeros((), x.dtype), (given.index[:20], given.own[:20]))[1]


def _calls_in_rounds(x, given):
    known = jnp.asarray(np.arange(4))

    def body(y, k):
        return y + 0.1 * _pick(y, known).sum() + 0.1 * _pick(y, given.index[:4] * 0 + k).sum(), None

    return jax.lax.scan(body, x, jnp.arange(2))[0] * x


_FORMS: dict[str, Callable] = {
    "gather": lambda x, g: x[g.index] * x,
    "take": lambda x, g: jnp.take(x, g.index) * x,
    "two takes": lambda x, g: jnp.take(x, g.index) * x + 2 * jnp.take(x, g.other) * x,
    "take of takes": lambda x, g: jnp.take(jnp.take(x, g.index), g.other) * x,
    "own jit": lambda x, g: _pick(x, g.index) * x + _pick(x, g.other) * x,
    "own bonds": lambda x, g: _couple(x, g.index, g.own) + _couple(x, g.other, g.params["weight"]),
    "bonds by t": lambda x, g: _couple(x, g.index, g.own) + _couple(x, g.index, 0 * g.q + 0.3 * jnp.cos(g.t)),
    "vmap": lambda x, g: jax.vmap(lambda i, y: _pick(x, i) * y)(g.index, x),
    "vmap of jits": lambda x, g: jax.vmap(lambda i, j, y: (_pick(x, i) + _pick(x, j)) * y)(g.index, g.other, x),
    "scatter add": lambda x, g: jnp.zeros_like(x).at[g.index].add(g.own * x) * x,
    "scatter set": lambda x, g: x.at[g.index[: x.size // 2]].set(0.3) * x,
    "scatter multiply": lambda x, g: x.at[g.index[:20]].multiply(0.5) ** 2,
    "segment sum": lambda x, g: jax.ops.segment_sum(x, g.index, x.size) ** 2,
    "segment sum of few": lambda x, g: jax.ops.segment_sum(x, jnp.asarray(g.index) // 50, 60) ** 2 / 50,
    "mask": lambda x, g: jnp.where(g.own > 0.3, x * jnp.roll(x, 1), x**2),
    "two masks": lambda x, g: jnp.where(g.own > 0.3, x, 0) * jnp.roll(x, 1) + jnp.where(g.q > 0, x, 0) * jnp.roll(x, 2),
    "mask by params": lambda x, g: jnp.where(g.params["weight"] > 0.6, x, 0) * jnp.roll(jnp.where(g.own > 0, x, 0), 1),
    "roll": lambda x, g: jnp.roll(x, 3) * x,
    "roll by params": lambda x, g: jnp.roll(x, g.params["shift"]) * x,
    "slice by params": lambda x, g: jax.lax.dynamic_slice(x, (g.params["shift"],), (30,)) * x[:30],
    "fft": lambda x, g: jnp.abs(jnp.fft.rfft(x)) ** 2 / x.size,
    "einsum": lambda x, g: jnp.einsum("ab,ac->abc", *[x.reshape(-1, BLOCK)] * 2).sum(axis=1) / BLOCK,
    "small matrix": lambda x, g: (x.reshape(-1, BLOCK) @ np.cos(np.arange(BLOCK * BLOCK)).reshape(BLOCK, -1)) ** 2,
    "scan": _rounds,
    "jits in a scan": _calls_in_rounds,
    "cond": lambda x, g: jax.lax.cond(g.t > 0.2, lambda y: y * jnp.roll(y, 1), lambda y: y * jnp.roll(y, 4), x),
    "switch": lambda x, g: jax.lax.switch(g.params["shift"] % 2, [lambda y: y * y[::-1], lambda y: y**2], x),
    "sort": lambda x, g: jnp.sort(x.reshape(-1, BLOCK), axis=1)[:, 0] ** 2,
    "maximum": lambda x, g: jnp.maximum(x, jnp.roll(x, 1)) ** 2,
    "cumulative sum": lambda x, g: jnp.cumsum(x.reshape(-1, BLOCK), axis=1) ** 2 / BLOCK,
    "convolution": lambda x, g: jnp.convolve(x, np.array([0.5, 0.0, 0.25]), mode="same") * x,
    "convolution with itself": lambda x, g: jnp.convolve(x, x[:3], mode="same") / x.size,
    "custom_jvp": lambda x, g: _own_rule(0.3 * x) * _own_rule(0.3 * x[jnp.asarray(g.index)]),
    "checkpoint": lambda x, g: jax.checkpoint(lambda y: y * jnp.take(y, g.index) + y * jnp.take(y, g.other))(x),
    "norms of pairs": lambda x, g: jnp.sqrt(1 + (x - jnp.take(x, g.index)) ** 2),
    "reverse": lambda x, g: x[::-1] * x,
    "repeat": lambda x, g: jnp.repeat(x.reshape(-1, BLOCK)[:, 0], BLOCK) * x,
    "power of a whole number": lambda x, g: jnp.where(jnp.arange(x.size) ** 2 % 7 == 3, x, 0) * jnp.roll(x, 1),
}


# ---- scenes ----------------------------------------------------------------------------------------------------------


class CoupledScene(NamedTuple):
    """n coordinates with coupled masses, and constraints in some; `functions` L and f of the state."""

    n: int
    path: str
    names: tuple[str, ...]
    functions: tuple[Callable, Callable | None]

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "CoupledScene":
        """A scene of 100 to 300 coordinates that asks for arrays, or of 1100 to 1500 that is left to the default."""
        large, constrained = rng.random() < 0.3, rng.random() < 0.3
        n = BLOCK * int(rng.integers(220, 300) if large else rng.integers(20, 60))
        masses, linked = draw(rng, n, int(rng.integers(1, 4))), draw(rng, n, int(rng.integers(1, 3)))
        sites = np.arange(0, n, 4)

        def lagrangian(q, v, t, params):
            kinetic = 2.5 * jnp.sum((1 + 0.1 * jnp.sin(q)) * v**2)
            coupled = sum(jnp.sum(term) for term in masses.of(v, q, t, params))
            return kinetic + coupled - 0.5 * jnp.sum(q**2) - 0.1 * jnp.sum((q - jnp.roll(q, 1)) ** 4)

        def constraints(q, t, params):
            terms = (jnp.ravel(term)[: sites.size] for term in linked.of(q, q, t, params))
            return q[sites] + sum(0.5 * jnp.pad(term, (0, sites.size - term.size)) for term in terms) - 0.1

        names = masses.names + (tuple(f"link: {name}" for name in linked.names) if constrained else ())
        return cls(n, "auto" if large else "array", names, (lagrangian, constraints if constrained else None))

    def state(self, rng: np.random.Generator) -> tuple:
        """(q, q̇, t, params)."""
        q, v = rng.normal(size=(2, self.n))
        params = {
            "index": jnp.asarray(rng.permutation(self.n)),
            "weight": jnp.asarray(rng.uniform(0.2, 1.0, self.n)),
            "shift": jnp.asarray(int(rng.integers(1, 6))),
        }
        return jnp.asarray(q), jnp.asarray(v), jnp.asarray(0.7), params

    def missing(self, acceleration, multipliers, state) -> float:
        """By how much M q̈ = F + Gᵀλ and G q̈ = γ are missed, in parts of their terms; by products of derivatives."""
        lagrangian, constraints = self.functions
        q, v, t, params = state

        def along(function, s):  # q̇ stays, q and t move
            return function(q + s * v, t + s)

        def momentum(q, t, v=v):
            return jax.grad(lagrangian, argnums=1)(q, v, t, params)

        one, zero = jnp.ones(()), jnp.zeros(())
        product = jax.jvp(lambda v: momentum(q, t, v), (v,), (acceleration,))[1]
        drift = jax.jvp(lambda s: along(momentum, s), (zero,), (one,))[1]
        terms, missed = [product, drift, force := jax.grad(lagrangian)(q, v, t, params)], product + drift - force
        if constraints is None:
            return float(abs(missed).max() / max(abs(term).max() for term in terms))

        def link(q, t):
            return constraints(q, t, params)

        def rate(s):
            return jax.jvp(lambda s: along(link, s), (s,), (one,))[1]

        bend = jax.jvp(rate, (zero,), (one,))[1]
        pulled = jax.vjp(lambda q: link(q, t), q)[1](multipliers)[0]
        pushed = jax.jvp(lambda q: link(q, t), (q,), (acceleration,))[1]
        by_forces = abs(missed - pulled).max() / max(abs(term).max() for term in [*terms, pulled])
        return float(max(by_forces, abs(pushed + bend).max() / max(abs(pushed).max(), abs(bend).max(), 1e-3)))
