"""`Repetition`: a step that is repeated as often as there are rows, with loops for its derivatives.

With R the step, (x, c) ↦ c behind it, three primitives are loops of as many rounds as there are,

    value      c₀ ↦ c₁ ↦ … ↦ cₙ
    forward    along δx, δc₀                     linear in these, transposed: back
    back       from cotangents, from cₙ on       linear in these, transposed: forward

and their derivatives are these again, of the step R′: (x, δx; c, δc) ↦ (R, DR (δx, δc)). `jax.lax.scan` would keep all
that a derivative needs of all rounds, and skip those that there are not by branches: XLA takes twice as long for it.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.interpreters import ad, mlir

from lagjax._primitives._linear_map import LinearMap, start_alike

PyTree = object


class Repetition:
    """`step(x, carry, row)` → (carry, of the round, parts of sums), lists of arrays; it is known by identity.

    `of_round` and `sums` are shapes of doubles: what is written down of each round, and what is summed over all.
    """

    def __init__(self, step: Callable, inputs: int, of_round: tuple, sums: tuple):
        self.step, self.inputs, self.of_round, self.sums = step, inputs, of_round, sums

    def __call__(self, x: tuple, first: tuple, rows: tuple, count) -> tuple[list, list, list]:
        """The last carry, what was written down (N, …), and the sums, of the first `count` of the rows (N, …)."""
        found = value_p.bind(*x, *first, *rows, count, of=self, rows=len(rows), batch=0)
        ends = len(first), len(first) + len(self.of_round)
        return found[: ends[0]], found[ends[0] : ends[1]], found[ends[1] :]

    @functools.cached_property
    def tangent(self) -> "Repetition":
        """The repetition of R′, with x, δx side by side, and so the others."""

        def step(x, carry, row):
            (x, dx), (carry, dcarry) = _halves(x), _halves(carry)
            found, moved = jax.jvp(lambda x, carry: self.step(x, carry, row), (x, carry), (dx, dcarry))
            return [[*a, *b] for a, b in zip(found, moved, strict=True)]

        return Repetition(step, 2 * self.inputs, 2 * self.of_round, 2 * self.sums)

    def split(self, given: tuple, rows: int) -> tuple[list, list, list]:
        """x, the first carry, and the rows, of all that is given; the count is left."""
        return list(given[: self.inputs]), list(given[self.inputs : -1 - rows]), list(given[-1 - rows : -1])

    def _one(self, x, carry, row, there):
        """A round; none where it is not `there`."""
        behind, *found = self.step(x, carry, row)
        behind = [jnp.where(there, new, old) for new, old in zip(behind, carry, strict=True)]
        return behind, *([jnp.where(there, a, 0.0) for a in some] for some in found)

    def run(self, most, x, first, rows, count, keeps: bool = False):
        """All rounds, `most` of them of whichever member; if it `keeps` them, the carries before each as well."""
        length = len(rows[0])
        empty = [jnp.zeros((length, *shape)) for shape in self.of_round], [jnp.zeros(shape) for shape in self.sums]
        before = [jnp.zeros((length, *c.shape)) for c in first] if keeps else []

        def go(i, state):
            carry, written, sums, before = state
            before = [_put(kept, c, i) for kept, c in zip(before, carry, strict=keeps)]
            carry, new, parts = self._one(x, carry, [_at(row, i) for row in rows], i < count)
            written = [_put(kept, a, i) for kept, a in zip(written, new, strict=True)]
            return carry, written, [a + b for a, b in zip(sums, parts, strict=True)], before

        state = start_alike((first, *empty, before), x, first, rows, count)
        carry, written, sums, before = jax.lax.fori_loop(0, most, go, state)
        return before if keeps else [*carry, *written, *sums]

    def go_back(self, most, x, first, rows, count, cotangents):
        """The cotangents of x and of the first carry."""
        before = self.run(most, x, first, rows, count, keeps=True)
        ends = len(first), len(first) + len(self.of_round)
        last, written, sums = cotangents[: ends[0]], cotangents[ends[0] : ends[1]], cotangents[ends[1] :]

        def go(k, state):
            i, (x_ct, carry_ct) = most - 1 - k, state
            row, here = [_at(row, i) for row in rows], [_at(kept, i) for kept in before]
            _, pull = jax.vjp(lambda x, carry: self._one(x, carry, row, i < count), x, here)
            more, carry_ct = pull((carry_ct, [_at(ct, i) for ct in written], sums))
            return [a + b for a, b in zip(x_ct, more, strict=True)], carry_ct

        state = start_alike(([jnp.zeros_like(a) for a in x], last), x, first, rows, count, cotangents)
        x_ct, first_ct = jax.lax.fori_loop(0, most, go, state)
        return [*x_ct, *first_ct]


def _at(array, i):
    return jax.lax.dynamic_index_in_dim(array, i, keepdims=False)


def _put(array, x, i):
    return jax.lax.dynamic_update_index_in_dim(array, x, i, 0)


def _halves(arrays) -> tuple[list, list]:
    half = len(arrays) // 2
    return list(arrays[:half]), list(arrays[half:])


# ---- primitives: (x, first carry, rows, count) and what they are linear in -------------------------------------------


def _shapes(*given, of: Repetition, rows: int, batch: int, linear: int = 0):
    given = given[: len(given) - linear]
    x, first, _ = of.split(given, rows)
    in_front, length = first[0].shape[:batch], given[-2].shape[batch]
    written = [ShapedArray((*in_front, length, *shape), first[0].dtype) for shape in of.of_round]
    return [*(ShapedArray(c.shape, c.dtype) for c in first), *written, *(ShapedArray((*in_front, *s), first[0].dtype) for s in of.sums)]


def _back_shapes(*given, of: Repetition, rows: int, batch: int, linear: int):
    x, first, _ = of.split(given[: len(given) - linear], rows)
    return [ShapedArray(a.shape, a.dtype) for a in (*x, *first)]


def _over_batch(function: Callable) -> Callable:
    """`function(of, most, x, first, rows, count, linear)` of all members."""

    def run(*given, of: Repetition, rows: int, batch: int, linear: int = 0):
        given, along = given[: len(given) - linear], list(given[len(given) - linear :])
        call = functools.partial(function, of, jnp.max(given[-1]))
        for _ in range(batch):
            call = jax.vmap(call)
        return call(*of.split(given, rows), given[-1], along)

    return run


def _value(of, most, x, first, rows, count, _):
    return of.run(most, x, first, rows, count)


def _forward(of, most, x, first, rows, count, along):
    dx, dfirst = along[: len(x)], along[len(x) :]
    found = of.tangent.run(most, [*x, *dx], [*first, *dfirst], rows, count)
    return _moved(found, len(first), of)


def _moved(found, carried: int, of: Repetition) -> list:
    """Of what a repetition of R′ gives what belongs to the tangents."""
    parts, place = [], 0
    for size in (carried, len(of.of_round), len(of.sums)):
        parts += found[place + size : place + 2 * size]
        place += 2 * size
    return parts


def _back(of, most, x, first, rows, count, cotangents):
    return of.go_back(most, x, first, rows, count, cotangents)


def _vary_value(primals, tangents, _, **settings):
    of, rows = settings["of"], settings["rows"]
    moving = [ad.instantiate_zeros(t) for t in tangents[: len(tangents) - 1 - rows]]
    return forward_p.bind(*primals, *moving, **settings, linear=len(moving))


def _beside(primals, tangents, settings) -> tuple[list, list, list, list, dict]:
    """x and the first carry, how these vary, all that follows, what is linear; and settings of R′."""
    of, rows, linear = settings["of"], settings["rows"], settings["linear"]
    given = primals[: len(primals) - linear]
    x, first, _ = of.split(given, rows)
    moving = [ad.instantiate_zeros(t) for t in tangents[: len(x) + len(first)]]
    dx, dfirst = moving[: len(x)], moving[len(x) :]
    return [x, dx, first, dfirst], list(given[-1 - rows :]), list(primals[len(given) :]), settings | {"of": of.tangent}


def _vary_forward(primals, tangents, _, **settings):
    (x, dx, first, dfirst), rest, along, settings_of = _beside(primals, tangents, settings)
    still = [jnp.zeros_like(a) for a in along]
    vx, vfirst = along[: len(x)], along[len(x) :]
    moved = [*dx, *still[: len(x)], *dfirst, *still[len(x) :]]
    found = forward_p.bind(*x, *vx, *first, *vfirst, *rest, *moved, **settings_of | {"linear": len(moved)})
    return _moved(found, len(first), settings["of"])


def _vary_back(primals, tangents, _, **settings):
    (x, dx, first, dfirst), rest, cts, settings_of = _beside(primals, tangents, settings)
    of, doubled, place = settings["of"], [], 0
    for size in (len(first), len(of.of_round), len(of.sums)):
        some = cts[place : place + size]
        doubled, place = [*doubled, *(jnp.zeros_like(a) for a in some), *some], place + size
    found = back_p.bind(*x, *dx, *first, *dfirst, *rest, *doubled, **settings_of | {"linear": len(doubled)})
    return [*found[: len(x)], *found[2 * len(x) : 2 * len(x) + len(first)]]


def _pull(primitive_name: str):
    def transpose(known, cotangents, moving, **settings):
        primitive = back_p if primitive_name == "back" else forward_p
        return primitive.bind(*known, *cotangents, **settings | {"linear": len(cotangents)})

    return transpose


class _Loops(LinearMap):
    def __init__(self, name: str, shapes: Callable, function: Callable, vary: Callable, transposed: str | None = None):
        linear = (lambda linear, **_: linear) if transposed else 0
        super().__init__(f"lagjax_repetition_{name}", shapes, vary, linear, transposed and _pull(transposed))
        run = _over_batch(function)
        self.def_impl(lambda *given, **settings: jax.jit(functools.partial(run, **settings))(*given))
        mlir.register_lowering(self, mlir.lower_fun(run, multiple_results=True))

    def _batch(self, arrays, axes, *, batch: int, **settings):
        return super()._batch(arrays, axes, batch=batch + 1, **settings)


value_p = _Loops("value", _shapes, _value, _vary_value)
forward_p = _Loops("forward", _shapes, _forward, _vary_forward, "back")
back_p = _Loops("back", _back_shapes, _back, _vary_back, "forward")
