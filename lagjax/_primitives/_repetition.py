"""`Repetition`: a step that is repeated as often as there are rows, with loops for its derivatives.

With R the step, (x, c) ↦ c behind it, three primitives are loops of as many rounds as there are,

    value      c₀ ↦ c₁ ↦ … ↦ cₙ
    forward    along δx, δc₀                     linear in these, transposed: back
    back       from cotangents, from cₙ on       linear in these, transposed: forward

and their derivatives are these again, of the step R′: (x, δx; c, δc) ↦ (R, DR (δx, δc)). `jax.lax.scan` would keep all
that a derivative needs of all rounds, and skip those that there are not by branches: XLA takes twice as long for it.
"""

import functools
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, mlir

from lagjax._primitives._linear_map import LinearMap, is_zero, start_alike


class Repetition:
    """`step(x, carry, still, row)` → (carry, of the round, parts of sums), lists of arrays; it is known by identity.

    There are so many arrays (`inputs`) x, and `fixed` of those that are still; the rest are rows. `of_round` and `sums`
    are shapes of doubles: what is written down of each round, and what is summed over all.
    """

    def __init__(self, step: Callable, inputs: int, carried: int, fixed: int, of_round: tuple, sums: tuple):
        self.step, self.inputs, self.carried, self.fixed = step, inputs, carried, fixed
        self.of_round, self.sums = of_round, sums

    def __call__(self, x: tuple, first: tuple, rows: tuple, count) -> tuple[list, list, list]:
        """The last carry, what was written down (N, …), and the sums, of the first `count` of the rows (N, …)."""
        found = value_p.bind(*x, *first, *rows, count, of=self, axes=())
        return self.split_results(found)

    def split_results(self, found) -> tuple[list, list, list]:
        return _split(found, self.carried, len(self.of_round))

    @functools.lru_cache(maxsize=16)  # noqa: B019  # those of a few
    def hold_still(self, varies: tuple[bool, ...]) -> "Repetition":
        """The repetition whose x are only those that vary; the others come first among what is still."""

        def step(x, carry, still, row):
            moving, others = iter(x), iter(still)
            return self.step([next(moving if here else others) for here in varies], carry, list(others), row)

        moving = sum(varies)
        more = len(varies) - moving
        return Repetition(step, moving, self.carried, self.fixed + more, self.of_round, self.sums)

    @functools.cached_property
    def tangent(self) -> "Repetition":
        """The repetition of R′, with x, δx side by side, and so the others."""

        def step(x, carry, still, row):
            (x, dx), (carry, dcarry) = _halves(x), _halves(carry)
            found, moved = jax.jvp(lambda x, carry: self.step(x, carry, still, row), (x, carry), (dx, dcarry))
            return [[*a, *b] for a, b in zip(found, moved, strict=True)]

        return Repetition(step, 2 * self.inputs, 2 * self.carried, self.fixed, 2 * self.of_round, 2 * self.sums)

    def _one(self, x, carry, still, row, there):
        """A round; none where it is not `there`."""
        behind, *found = self.step(x, carry, still, row)
        behind = [jnp.where(there, new, old) for new, old in zip(behind, carry, strict=True)]
        return behind, *([jnp.where(there, a, 0.0) for a in some] for some in found)

    def run(self, most, x, first, still, rows, count, keeps: bool = False):
        """All rounds, `most` of them of whichever member; if it `keeps` them, the carries before each and no more."""
        length = len(rows[0])
        empty = [jnp.zeros((length, *shape)) for shape in self.of_round], [jnp.zeros(shape) for shape in self.sums]
        if keeps:
            empty = [jnp.zeros((length, *c.shape)) for c in first], []

        def go(i, state):
            carry, written, sums = state
            behind, new, parts = self._one(x, carry, still, [_at(row, i) for row in rows], i < count)
            written = [_put(kept, a, i) for kept, a in zip(written, carry if keeps else new, strict=True)]
            return behind, written, [] if keeps else [a + b for a, b in zip(sums, parts, strict=True)]

        state = start_alike((first, *empty), x, first, still, rows, count)
        carry, written, sums = jax.lax.fori_loop(0, most, go, state)
        return written if keeps else [*carry, *written, *sums]

    def go_back(self, most, x, first, still, rows, count, cotangents):
        """The cotangents of x and of the first carry."""
        before = self.run(most, x, first, still, rows, count, keeps=True)
        last, written, sums = self.split_results(cotangents)

        def go(k, state):
            i, (x_ct, carry_ct) = most - 1 - k, state
            row, here = [_at(row, i) for row in rows], [_at(kept, i) for kept in before]
            _, pull = jax.vjp(lambda x, carry: self._one(x, carry, still, row, i < count), x, here)
            more, carry_ct = pull((carry_ct, [_at(ct, i) for ct in written], sums))
            return [a + b for a, b in zip(x_ct, more, strict=True)], carry_ct

        state = start_alike(([jnp.zeros_like(a) for a in x], last), x, first, still, rows, count, cotangents)
        x_ct, first_ct = jax.lax.fori_loop(0, most, go, state)
        return [*x_ct, *first_ct]


def _at(array, i):
    return jax.lax.dynamic_index_in_dim(array, i, keepdims=False)


def _put(array, x, i):
    return jax.lax.dynamic_update_index_in_dim(array, x, i, 0)


def _halves(arrays) -> tuple[list, list]:
    return tuple(_split(arrays, len(arrays) // 2))


def _split(arrays, *sizes: int) -> list[list]:
    """The first ones, so many, and so on, and those that are left."""
    ends = [0, *itertools.accumulate(sizes), len(arrays)]
    return [list(arrays[a:b]) for a, b in itertools.pairwise(ends)]


# ---- primitives: (*x, *first carry, *still, *rows, count, *what they are linear in) ----------------------------------


def _parts(given, of: Repetition, linear: int = 0) -> list:
    """x, the first carry, what is still, the rows, (count,), and what is linear."""
    x, first, still, rest = _split(given, of.inputs, of.carried, of.fixed)
    rows, (count, *along) = _split(rest, len(rest) - 1 - linear)
    return [x, first, still, rows, count, along]


def _run(*given, function, of: Repetition, axes: tuple, linear: int = 0):
    """`function` of all members, in front of which some arrays have these axes."""
    x, first, still, rows, count, along = _parts(given, of, linear)
    call = functools.partial(function, of, jnp.max(count))
    for in_front in axes:
        x_in, first_in, still_in, rows_in, count_in, along_in = _parts(in_front, of, linear)
        call = jax.vmap(call, in_axes=(x_in, first_in, still_in, rows_in, count_in, along_in))
    return call(x, first, still, rows, count, along)


def _value(of, most, x, first, still, rows, count, _):
    return of.run(most, x, first, still, rows, count)


def _forward(of, most, x, first, still, rows, count, along):
    dx, dfirst = along[: of.inputs], along[of.inputs :]
    return _later_halves(of.tangent.run(most, [*x, *dx], [*first, *dfirst], still, rows, count), of.tangent)


def _back(of, most, x, first, still, rows, count, cotangents):
    return of.go_back(most, x, first, still, rows, count, cotangents)


def _later_halves(found, of: Repetition) -> list:
    return [a for part in of.split_results(found) for a in _halves(part)[1]]


def _vary_value(primals, tangents, _, *, of: Repetition, axes: tuple):
    varies = tuple(not is_zero(t) for t in tangents[: of.inputs])

    def sort(given):
        x, first, *rest, count, _ = _parts(given, of)
        others = itertools.compress(x, (not here for here in varies))
        return [*itertools.compress(x, varies), *first, *others, *itertools.chain(*rest), count]

    def along(given):
        return [*itertools.compress(given, varies), *given[of.inputs : of.inputs + of.carried]]

    moving = [ad.instantiate_zeros(t) for t in along(tangents)]
    axes = tuple((*sort(of_level), *along(of_level)) for of_level in axes)
    return forward_p.bind(*sort(primals), *moving, of=of.hold_still(varies), axes=axes, linear=len(moving))


def _vary_forward(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    """J(x) v along (dx, dv): what belongs to v in the derivative of R′, of (x, v), along these."""

    def double(given, moved):
        x, first, *rest, count, along = _parts(given, of, linear)
        dx, dfirst, *_, more = _parts(moved, of, linear)
        (vx, vfirst), (dvx, dvfirst) = _split(along, of.inputs), _split(more, of.inputs)
        return [*x, *vx, *first, *vfirst, *itertools.chain(*rest), count, *dx, *dvx, *dfirst, *dvfirst]

    axes = tuple(tuple(double(of_level, of_level)) for of_level in axes)
    found = forward_p.bind(*double(primals, tangents), of=of.tangent, axes=axes, linear=2 * linear)
    return _later_halves(found, of.tangent)


def _vary_back(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    """J(x)ᵀ w along (dx, dw): what belongs to x in the transposed derivative of R′ at (x, dx), of (dw, w)."""

    def double(given, moved):
        x, first, *rest, count, cts = _parts(given, of, linear)
        dx, dfirst, *_, dcts = _parts(moved, of, linear)
        parts = zip(of.split_results(dcts), of.split_results(cts), strict=True)
        doubled = itertools.chain(*(itertools.chain(*part) for part in parts))
        return [*x, *dx, *first, *dfirst, *itertools.chain(*rest), count, *doubled]

    axes = tuple(tuple(double(of_level, of_level)) for of_level in axes)
    found = back_p.bind(*double(primals, tangents), of=of.tangent, axes=axes, linear=2 * linear)
    x, first = _split(found, 2 * of.inputs)
    return [*_halves(x)[0], *_halves(first)[0]]


class _Loops(LinearMap):
    """A loop; of each axis of a batch, the first one innermost, `axes` says which arrays have it."""

    def __init__(self, name: str, shapes: Callable, function: Callable, vary: Callable, transposed: str = ""):
        of_linear = (lambda linear, **_: linear) if transposed else 0
        pull = functools.partial(_pull, transposed) if transposed else None
        run = functools.partial(_run, function=function)

        def shape(*given, **settings):
            batch, given = _without_batch(given, settings["axes"])
            return [ShapedArray((*batch, *shape), np.dtype(float)) for shape in shapes(given, **settings)]

        super().__init__(f"lagjax_repetition_{name}", shape, vary, of_linear, pull)
        self.vary = vary
        self.def_impl(lambda *given, **settings: jax.jit(functools.partial(run, **settings))(*given))
        mlir.register_lowering(self, mlir.lower_fun(run, multiple_results=True))

    def _derive(self, primals, tangents, **settings):
        if not settings.get("linear") or all(map(is_zero, tangents[: -settings["linear"]])):
            return super()._derive(primals, tangents, **settings)
        along = list(map(ad.instantiate_zeros, tangents))  # what varies with x and what is linear takes one loop
        return self.bind(*primals, **settings), self.vary(primals, along, **settings)

    def _batch(self, arrays, places, *, axes: tuple, **settings):
        arrays = [x if at is None else jnp.moveaxis(x, at, 0) for x, at in zip(arrays, places, strict=True)]
        more = tuple(None if at is None else 0 for at in places)
        outs = self.bind(*arrays, axes=(*axes, more), **settings)
        return outs, [0] * len(outs)


def _without_batch(given, axes: tuple) -> tuple[tuple[int, ...], list[tuple[int, ...]]]:
    """The axes of a batch, the outermost one first, and the shapes of arrays without them."""
    shapes, batch = [x.shape for x in given], []
    for of_level in reversed(axes):
        batch.append(next(shape[0] for shape, axis in zip(shapes, of_level, strict=True) if axis == 0))
        shapes = [shape if axis is None else shape[1:] for shape, axis in zip(shapes, of_level, strict=True)]
    return tuple(batch), shapes


def _shapes(given, *, of: Repetition, axes: tuple, linear: int = 0) -> list:
    _, first, _, rows, *_ = _parts(given, of, linear)
    return [*first, *((rows[0][0], *shape) for shape in of.of_round), *of.sums]


def _back_shapes(given, *, of: Repetition, axes: tuple, linear: int) -> list:
    return given[: of.inputs + of.carried]


def _pull(transposed: str, known, cotangents, moving, *, axes: tuple, linear: int, **settings):
    """The other loop, whose results are summed over those axes that what moves does not have."""
    primitive = back_p if transposed == "back" else forward_p
    size = len(axes) and len(axes[0]) - linear
    of_others = tuple((*of_level[:size], *[0] * len(cotangents)) for of_level in axes)
    found = primitive.bind(*known, *cotangents, axes=of_others, linear=len(cotangents), **settings)
    absent = zip(*(of_level[size:] for of_level in reversed(axes)), strict=True) if axes else [()] * linear
    return [x.sum([i for i, axis in enumerate(of) if axis is None]) for x, of in zip(found, absent, strict=True)]


value_p = _Loops("value", _shapes, _value, _vary_value)
forward_p = _Loops("forward", _shapes, _forward, _vary_forward, "back")
back_p = _Loops("back", _back_shapes, _back, _vary_back, "forward")
