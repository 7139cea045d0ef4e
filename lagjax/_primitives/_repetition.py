"""`Repetition`: a step that is repeated as often as there are rows, with loops for its derivatives.

With R the step, (x, c) ↦ c behind it, and J the derivative of all rounds, four primitives are loops,

    value      c₀ ↦ c₁ ↦ … ↦ cₙ
    forward    J v                          linear in v, transposed: back
    back       Jᵀ w, from cₙ on             linear in w, transposed: forward
    turn       (∂/∂x Jᵀ w) d + Jᵀ dw        linear in d and dw, symmetric in d

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

    There are so many arrays x (`inputs`), `carried`, `rows`, and `fixed` of those that are still. `of_round` and `sums`
    are shapes of doubles: what is written down of each round, and what is summed over all.
    """

    def __init__(self, step: Callable, inputs: int, carried: int, of_round: tuple, sums: tuple, rows=1, fixed=0):
        self.step, self.inputs, self.carried, self.of_round, self.sums = step, inputs, carried, of_round, sums
        self.rows, self.fixed, self.results = rows, fixed, carried + len(of_round) + len(sums)

    def __call__(self, x: tuple, first: tuple, rows: tuple, count) -> list[list]:
        """The last carry, what was written down (N, …), and the sums, of the first `count` of the rows (N, …)."""
        found = value_p.bind(*x, *first, *rows, count, of=self, axes=())
        return self.split_results(found)

    def split_results(self, found) -> list[list]:
        """The last carry, what was written down, and the sums."""
        return _split(found, self.carried, len(self.of_round))

    @functools.lru_cache(maxsize=16)  # noqa: B019  # those of a few
    def hold_still(self, varies: tuple[bool, ...]) -> "Repetition":
        """The repetition whose x are only those that vary; the others come first among what is still."""

        def step(x, carry, still, row):
            moving, others = iter(x), iter(still)
            return self.step([next(moving if here else others) for here in varies], carry, list(others), row)

        moving = sum(varies)
        fixed = self.fixed + len(varies) - moving
        return Repetition(step, moving, self.carried, self.of_round, self.sums, self.rows, fixed)

    @functools.cached_property
    def tangent(self) -> "Repetition":
        """The repetition of R′, with x, δx side by side, and so the others."""

        def step(x, carry, still, row):
            (x, dx), (carry, dcarry) = _halves(x), _halves(carry)
            found, moved = jax.jvp(lambda x, carry: self.step(x, carry, still, row), (x, carry), (dx, dcarry))
            return [[*a, *b] for a, b in zip(found, moved, strict=True)]

        doubled = 2 * self.inputs, 2 * self.carried, 2 * self.of_round, 2 * self.sums
        return Repetition(step, *doubled, self.rows, self.fixed)

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
            behind, new, parts = self._one(x, carry, still, [_take(row, i) for row in rows], i < count)
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
            row, here = [_take(row, i) for row in rows], [_take(kept, i) for kept in before]
            _, pull = jax.vjp(lambda x, carry: self._one(x, carry, still, row, i < count), x, here)
            more, carry_ct = pull((carry_ct, [_take(ct, i) for ct in written], sums))
            return [a + b for a, b in zip(x_ct, more, strict=True)], carry_ct

        state = start_alike(([jnp.zeros_like(a) for a in x], last), x, first, still, rows, count, cotangents)
        x_ct, first_ct = jax.lax.fori_loop(0, most, go, state)
        return [*x_ct, *first_ct]


def _take(array, i):
    return jax.lax.dynamic_index_in_dim(array, i, keepdims=False)


def _put(array, x, i):
    return jax.lax.dynamic_update_index_in_dim(array, x, i, 0)


def _halves(arrays) -> list[list]:
    return _split(arrays, len(arrays) // 2)


def _split(arrays, *sizes: int) -> list[list]:
    """The first ones, so many, and so on, and those that are left."""
    ends = [0, *itertools.accumulate(sizes), len(arrays)]
    return [list(arrays[a:b]) for a, b in itertools.pairwise(ends)]


# ---- primitives: (*x, *first carry, *still, *rows, count, *what follows) ---------------------------------------------


def _parts(given, of: Repetition) -> list:
    """x, the first carry, what is still, the rows, the count, and what follows."""
    x, first, still, rows, (count, *along) = _split(given, of.inputs, of.carried, of.fixed, of.rows)
    return [x, first, still, rows, count, along]


def _run(*given, function, of: Repetition, axes: tuple, **_):
    """`function` of all members, in front of which some arrays have these axes."""
    parts = _parts(given, of)
    call = functools.partial(function, of, jnp.max(parts[-2]))
    for of_level in axes:
        call = jax.vmap(call, in_axes=tuple(_parts(of_level, of)))
    return call(*parts)


def _value(of, most, x, first, still, rows, count, _):
    return of.run(most, x, first, still, rows, count)


def _forward(of, most, x, first, still, rows, count, along):
    dx, dfirst = _split(along, of.inputs)
    return _later_halves(of.tangent.run(most, [*x, *dx], [*first, *dfirst], still, rows, count), of.tangent)


def _back(of, most, x, first, still, rows, count, cotangents):
    return of.go_back(most, x, first, still, rows, count, cotangents)


def _turn(of, most, x, first, still, rows, count, along):
    cts, dx, dfirst, dcts = _split(along, of.results, of.inputs, of.carried)
    doubled = _interleave(of, dcts, cts)
    found = of.tangent.go_back(most, [*x, *dx], [*first, *dfirst], still, rows, count, doubled)
    return _first_halves(found, of)


def _interleave(of: Repetition, first, second) -> list:
    """Results of a repetition of R′ from those for R and those for the tangents."""
    parts = zip(of.split_results(first), of.split_results(second), strict=True)
    return [a for both in parts for some in both for a in some]


def _first_halves(found, of: Repetition) -> list:
    x, first = _split(found, 2 * of.inputs)
    return [*_halves(x)[0], *_halves(first)[0]]


def _later_halves(found, of: Repetition) -> list:
    return [a for part in of.split_results(found) for a in _halves(part)[1]]


def _vary_value(primals, tangents, _, *, of: Repetition, axes: tuple):
    varies = tuple(not is_zero(t) for t in tangents[: of.inputs])

    def sort(given):
        x, first, still, rows, count, _ = _parts(given, of)
        others = itertools.compress(x, (not here for here in varies))
        return [*itertools.compress(x, varies), *first, *others, *still, *rows, count]

    def push(given):
        return [*itertools.compress(given, varies), *given[of.inputs : of.inputs + of.carried]]

    moving = [ad.instantiate_zeros(t) for t in push(tangents)]
    axes = tuple((*sort(of_level), *push(of_level)) for of_level in axes)
    return forward_p.bind(*sort(primals), *moving, of=of.hold_still(varies), axes=axes, linear=len(moving))


def _vary_forward(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    """J(x) v along (dx, dv): what belongs to v in the derivative of R′ at (x, v), along these."""

    def double(given, moved):
        x, first, still, rows, count, v = _parts(given, of)
        dx, dfirst, _, _, _, dv = _parts(moved, of)
        (vx, vfirst), (dvx, dvfirst) = _split(v, of.inputs), _split(dv, of.inputs)
        return [*x, *vx, *first, *vfirst, *still, *rows, count, *dx, *dvx, *dfirst, *dvfirst]

    axes = tuple(tuple(double(of_level, of_level)) for of_level in axes)
    found = forward_p.bind(*double(primals, tangents), of=of.tangent, axes=axes, linear=2 * linear)
    return _later_halves(found, of.tangent)


def _vary_back(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    def extend(given, moved):
        dx, dfirst, _, _, _, dcts = _parts(moved, of)
        return [*given, *dx, *dfirst, *dcts]

    axes = tuple(tuple(extend(of_level, of_level)) for of_level in axes)
    size = of.inputs + of.carried + of.results
    return turn_p.bind(*extend(primals, tangents), of=of, axes=axes, linear=size)


def _vary_turn(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    """It along all at once: what belongs to x in `turn` of R′ at (x, dx) and (dw, w), along what these vary."""

    def double(given, moved):
        x, first, still, rows, count, along = _parts(given, of)
        parts = [_split(some, of.results, of.inputs, of.carried) for some in (along, _parts(moved, of)[-1])]
        (cts, dx, dfirst, dcts), (ects, edx, edfirst, edcts) = parts
        ex, efirst, *_ = _parts(moved, of)
        at = [*x, *dx, *first, *dfirst, *still, *rows, count, *_interleave(of, dcts, cts)]
        return [*at, *ex, *edx, *efirst, *edfirst, *_interleave(of, edcts, ects)]

    axes = tuple(tuple(double(of_level, of_level)) for of_level in axes)
    found = turn_p.bind(*double(primals, tangents), of=of.tangent, axes=axes, linear=2 * linear)
    return _first_halves(found, of)


class _RepeatedMap(LinearMap):
    """A loop; of each axis of a batch, the first one innermost, `axes` says which arrays have it."""

    def __init__(self, name: str, shapes: Callable, function: Callable, vary: Callable, pull: Callable | None = None):
        def transpose(known, cotangents, moving, *, axes: tuple, linear: int, of: Repetition):
            """The cotangents, summed over those axes that what moves does not have."""
            assert pull is not None
            size = len(known)
            known_axes = [(*of_level[:size], *[0] * len(cotangents)) for of_level in axes]
            found = pull([*known, *cotangents], of, known_axes)
            absent = zip(*(of_level[size:] for of_level in reversed(axes)), strict=True) if axes else [()] * linear
            return [x.sum([i for i, axis in enumerate(a) if axis is None]) for x, a in zip(found, absent, strict=True)]

        def shape(*given, **settings):
            batch, given = _drop_batch(given, settings["axes"])
            return [ShapedArray((*batch, *shape), np.dtype(float)) for shape in shapes(given, settings["of"])]

        linear, run = (lambda linear, **_: linear) if pull else 0, functools.partial(_run, function=function)
        super().__init__(f"lagjax_repetition_{name}", shape, vary, linear, transpose if pull else None)
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


def _drop_batch(given, axes: tuple) -> tuple[tuple[int, ...], list[tuple[int, ...]]]:
    """The axes of a batch, the outermost one first, and the shapes of arrays without them."""
    shapes, batch = [x.shape for x in given], []
    for of_level in reversed(axes):
        batch.append(next(shape[0] for shape, axis in zip(shapes, of_level, strict=True) if axis == 0))
        shapes = [shape if axis is None else shape[1:] for shape, axis in zip(shapes, of_level, strict=True)]
    return tuple(batch), shapes


def _shapes(given, of: Repetition) -> list:
    _, first, _, rows, *_ = _parts(given, of)
    return [*first, *((rows[0][0], *shape) for shape in of.of_round), *of.sums]


def _back_shapes(given, of: Repetition) -> list:
    return given[: of.inputs + of.carried]


def _pull_forward(given, of: Repetition, axes):
    return back_p.bind(*given, of=of, axes=tuple(axes), linear=of.results)


def _pull_back(given, of: Repetition, axes):
    return forward_p.bind(*given, of=of, axes=tuple(axes), linear=of.inputs + of.carried)


def _pull_turn(given, of: Repetition, axes):
    """It is symmetric in dx; and J(x)ᵀ dw is transposed to J(x)."""
    size = of.inputs + of.carried
    known, cts, moved = _split(given, size + of.fixed + of.rows + 1, of.results)
    still = list(map(jnp.zeros_like, cts))
    count = len(known) + of.results
    wide = tuple((*of_level, *of_level[len(known) : count]) for of_level in axes)
    of_x = turn_p.bind(*given, *still, of=of, axes=wide, linear=size + of.results)
    narrow = [(*of_level[: len(known)], *of_level[count:]) for of_level in axes]
    return [*of_x, *_pull_back([*known, *moved], of, narrow)]


value_p = _RepeatedMap("value", _shapes, _value, _vary_value)
forward_p = _RepeatedMap("forward", _shapes, _forward, _vary_forward, _pull_forward)
back_p = _RepeatedMap("back", _back_shapes, _back, _vary_back, _pull_back)
turn_p = _RepeatedMap("turn", _back_shapes, _turn, _vary_turn, _pull_turn)
