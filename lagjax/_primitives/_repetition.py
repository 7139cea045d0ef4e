"""`Repetition`: a step repeated once per row of data, evaluated on the host, with loops for its derivatives.

The step R maps (x, c) to the next carry c; J is the Jacobian of the whole loop by x and c₀. Four primitives are loops,

    value      c₀ ↦ c₁ ↦ … ↦ cₙ
    forward    J v                          linear in v, transposed: back
    back       Jᵀ w, from cₙ on             linear in w, transposed: forward
    hessian    (∂/∂x Jᵀ w) d + Jᵀ dw        linear in d and dw, symmetric in d: the derivative of back

and their derivatives are the same four of the step R′: (x, δx; c, δc) ↦ (R, DR (δx, δc)). A round is traced once, and
NumPy evaluates it for all members: XLA would compile a loop for a second, and its derivatives for three.
"""

import functools
import itertools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, mlir

from lagjax._primitives._linear_map import LinearMap, compute_on_host, is_zero
from lagjax._primitives._on_host import HostFunction, call_host


class Repetition:
    """A loop of `step(x, carry, still, row)` → (carry, record of the round, summands), each a list of arrays.

    `inputs`, `carried`, `rows` and `fixed` count the arrays x, in the carry, in a row, and in `still`, which have no
    derivative. `of_round` and `sums` are the shapes of the float64 records of each round, and of the sums over all
    rounds. Two repetitions are equal only if they are one object.
    """

    def __init__(self, step: Callable, inputs: int, carried: int, of_round: tuple, sums: tuple, rows=1, fixed=0):
        self.step, self.inputs, self.carried, self.of_round, self.sums = step, inputs, carried, of_round, sums
        self.rows, self.fixed, self.results = rows, fixed, carried + len(of_round) + len(sums)

    def __call__(self, x: tuple, first: tuple, rows: tuple, count) -> list[list]:
        """The last carry, the records (N, …) and the sums over the first `count` of the N rows."""
        found = value_p.bind(*x, *first, *rows, count, of=self, axes=())
        return self.split_results(found)

    def split_results(self, found) -> list[list]:
        """The flat results as three lists: last carry, records, sums."""
        return _split(found, self.carried, len(self.of_round))

    @functools.lru_cache(maxsize=16)  # noqa: B019  # those of a few
    def restrict_inputs(self, varies: tuple[bool, ...]) -> "Repetition":
        """The repetition in which only those x that vary are inputs; the rest precede the arrays `still`."""

        def step(x, carry, still, row):
            moving, others = iter(x), iter(still)
            return self.step([next(moving if here else others) for here in varies], carry, list(others), row)

        moving = sum(varies)
        fixed = self.fixed + len(varies) - moving
        return Repetition(step, moving, self.carried, self.of_round, self.sums, self.rows, fixed)

    @functools.cached_property
    def tangent(self) -> "Repetition":
        """The repetition of R′, whose lists of arrays are those of R followed by their tangents."""

        def step(x, carry, still, row):
            (x, dx), (carry, dcarry) = _split_halves(x), _split_halves(carry)
            found, moved = jax.jvp(lambda x, carry: self.step(x, carry, still, row), (x, carry), (dx, dcarry))
            return [[*a, *b] for a, b in zip(found, moved, strict=True)]

        doubled = 2 * self.inputs, 2 * self.carried, 2 * self.of_round, 2 * self.sums
        return Repetition(step, *doubled, self.rows, self.fixed)

    @functools.lru_cache(maxsize=8)  # noqa: B019  # those of a few
    def _trace_round(self, shapes: tuple, is_backward: bool) -> HostFunction:
        """One round for arrays of these shapes or, with `is_backward`, its cotangents of x and carry."""

        def pull(x, carry, still, row, cotangents):
            return jax.vjp(lambda x, carry: list(self.step(x, carry, still, row)), x, carry)[1](cotangents)

        arrays = [jax.ShapeDtypeStruct(shape, float) for shape in shapes]
        *given, cotangents = _split(arrays, self.inputs, self.carried, self.fixed, self.rows)
        if is_backward:
            return HostFunction(pull, *given, self.split_results(cotangents))
        return HostFunction(self.step, *given)

    def _round(self, *parts, is_backward: bool = False) -> Callable:
        x, first, still, rows, *more = parts
        shapes = [a.shape[1:] for a in (*x, *first, *still)] + [row.shape[2:] for row in rows]
        for last, written, sums in more:
            shapes += [a.shape[1:] for a in last] + [a.shape[2:] for a in written] + [a.shape[1:] for a in sums]
        return self._trace_round(tuple(shapes), is_backward)

    # The arrays of NumPy that follow have members in front, or one row that all share.

    def run(self, x, first, still, rows, count, keeps: bool = False) -> list:
        """The results of all rounds for all members; with `keeps` instead the carry before each round."""
        go, length = self._round(x, first, still, rows), rows[0].shape[1]
        members = max(map(len, (*x, *first, *still, *rows, count)))
        carry = [np.repeat(c, members // len(c), axis=0) for c in first]
        of_round = [c.shape[1:] for c in first] if keeps else self.of_round
        written = [np.zeros((members, length, *shape)) for shape in of_round]
        sums = [np.zeros((members, *shape)) for shape in self.sums]
        for i, some in _round_members(count, members):
            before = _pick(carry, some)
            found = go(*_pick(x, some), *before, *_pick(still, some), *_pick(rows, some, i))
            behind, new, parts = self.split_results(found)
            for arrays, values in ((written, before if keeps else new), (carry, behind)):
                for kept, a in zip(arrays, values, strict=True):
                    kept[(some, i) if arrays is written else some] = a
            for total, a in zip(sums, parts, strict=True):
                total[some] += a
        return written if keeps else [*carry, *written, *sums]

    def run_backward(self, x, first, still, rows, count, cotangents) -> list:
        """The cotangents of x and of the first carry, from those of the results, by the rounds in reverse order."""
        before = self.run(x, first, still, rows, count, keeps=True)
        last, written, sums = split = self.split_results(cotangents)
        go = self._round(x, first, still, rows, split, is_backward=True)
        members = max(map(len, (*x, *first, *still, *rows, count, *cotangents)))
        x_ct = [np.zeros((members, *a.shape[1:])) for a in x]
        carry_ct = [np.repeat(ct, members // len(ct), axis=0) for ct in last]
        for i, some in reversed(_round_members(count, members)):
            given = (*_pick(x, some), *_pick(before, some, i), *_pick(still, some), *_pick(rows, some, i))
            found = go(*given, *_pick(carry_ct, some), *_pick(written, some, i), *_pick(sums, some))
            more, behind = _split(found, self.inputs)
            for total, a in zip(x_ct, more, strict=True):
                total[some] += a
            for ct, a in zip(carry_ct, behind, strict=True):
                ct[some] = a
        return [*x_ct, *carry_ct]


def _round_members(count, members: int) -> list[tuple]:
    """For each round the members that execute it (their `count` is larger): a slice for all, or an index array."""
    count = np.broadcast_to(count, members)
    of_all = range(int(count.max(initial=0)))
    return [(i, slice(None) if (i < count).all() else np.flatnonzero(i < count)) for i in of_all]


def _pick(arrays, some, i=slice(None)) -> list:
    """The arrays of some members, at round i if it is given; an array with one row is shared by all members."""
    return [x[some, i] if len(x) > 1 else x[:, i] for x in arrays] if isinstance(i, int) else [
        x[some] if len(x) > 1 else x for x in arrays
    ]  # fmt: skip


def _split_halves(arrays) -> list[list]:
    return _split(arrays, len(arrays) // 2)


def _split(arrays, *sizes: int) -> list[list]:
    """The arrays in consecutive lists of these `sizes`, and a list of the rest."""
    ends = [0, *itertools.accumulate(sizes), len(arrays)]
    return [list(arrays[a:b]) for a, b in itertools.pairwise(ends)]


# ---- primitives: (*x, *first carry, *still, *rows, count, *what follows) ---------------------------------------------


def _split_arguments(given, of: Repetition) -> list:
    """The flat arguments as lists: x, first carry, `still`, rows, count, and what follows (tangents, cotangents)."""
    x, first, still, rows, (count, *along) = _split(given, of.inputs, of.carried, of.fixed, of.rows)
    return [x, first, still, rows, count, along]


def _run_members(*given, function, of: Repetition, axes: tuple, **_):
    """Results of `function` for all members; `axes` tells which arguments have which batch axes."""
    batch, shapes = _drop_batch(given, axes)
    rows = [
        _member_rows(np.asarray(x), batch, [of_level[j] for of_level in reversed(axes)], shape)
        for j, (x, shape) in enumerate(zip(given, shapes, strict=True))
    ]
    found, members = function(of, *_split_arguments(rows, of)), math.prod(batch)
    return [np.broadcast_to(x, (members, *x.shape[1:])).reshape((*batch, *x.shape[1:])) for x in found]


def _member_rows(x, batch: tuple, places: list, shape: tuple):
    """The array with one row per member of all batch axes, or with one row if it has none of these axes."""
    if all(place is None for place in places):
        return x[None]
    wide = [1 if place is None else size for place, size in zip(places, batch, strict=True)]
    return np.broadcast_to(x.reshape((*wide, *shape)), (*batch, *shape)).reshape((math.prod(batch), *shape))


def _evaluate_forward(of, x, first, still, rows, count, along):
    dx, dfirst = _split(along, of.inputs)
    return _later_halves(of.tangent.run([*x, *dx], [*first, *dfirst], still, rows, count), of.tangent)


def _evaluate_hessian(of, x, first, still, rows, count, along):
    cts, dx, dfirst, dcts = _split(along, of.results, of.inputs, of.carried)
    doubled = _interleave(of, dcts, cts)
    found = of.tangent.run_backward([*x, *dx], [*first, *dfirst], still, rows, count, doubled)
    return _first_halves(found, of)


def _interleave(of: Repetition, first, second) -> list:
    """Flat cotangents of the results of R′ from those of R's results and those of their tangents."""
    parts = zip(of.split_results(first), of.split_results(second), strict=True)
    return [a for both in parts for some in both for a in some]


def _first_halves(found, of: Repetition) -> list:
    x, first = _split(found, 2 * of.inputs)
    return [*_split_halves(x)[0], *_split_halves(first)[0]]


def _later_halves(found, of: Repetition) -> list:
    return [a for part in of.split_results(found) for a in _split_halves(part)[1]]


def _vary_value(primals, tangents, _, *, of: Repetition, axes: tuple):
    varies = tuple(not is_zero(t) for t in tangents[: of.inputs])

    def sort(given):
        x, first, still, rows, count, _ = _split_arguments(given, of)
        others = itertools.compress(x, (not here for here in varies))
        return [*itertools.compress(x, varies), *first, *others, *still, *rows, count]

    def push(given):
        return [*itertools.compress(given, varies), *given[of.inputs : of.inputs + of.carried]]

    moving = [ad.instantiate_zeros(t) for t in push(tangents)]
    axes = tuple((*sort(of_level), *push(of_level)) for of_level in axes)
    return forward_p.bind(*sort(primals), *moving, of=of.restrict_inputs(varies), axes=axes, linear=len(moving))


def _vary_forward(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    """The tangent of J(x) v along (dx, dv): the tangent part of `forward` of R′ at (x, v) along both."""

    def double(given, moved):
        x, first, still, rows, count, v = _split_arguments(given, of)
        dx, dfirst, _, _, _, dv = _split_arguments(moved, of)
        (vx, vfirst), (dvx, dvfirst) = _split(v, of.inputs), _split(dv, of.inputs)
        return [*x, *vx, *first, *vfirst, *still, *rows, count, *dx, *dvx, *dfirst, *dvfirst]

    axes = tuple(tuple(double(of_level, of_level)) for of_level in axes)
    found = forward_p.bind(*double(primals, tangents), of=of.tangent, axes=axes, linear=2 * linear)
    return _later_halves(found, of.tangent)


def _vary_back(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    def extend(given, moved):
        dx, dfirst, _, _, _, dcts = _split_arguments(moved, of)
        return [*given, *dx, *dfirst, *dcts]

    axes = tuple(tuple(extend(of_level, of_level)) for of_level in axes)
    size = of.inputs + of.carried + of.results
    return hessian_p.bind(*extend(primals, tangents), of=of, axes=axes, linear=size)


def _vary_hessian(primals, tangents, *, of: Repetition, axes: tuple, linear: int):
    """The tangent of `hessian` along all arguments: the x part of `hessian` of R′ at (x, dx), cotangents (dw, w)."""

    def double(given, moved):
        x, first, still, rows, count, along = _split_arguments(given, of)
        parts = [_split(some, of.results, of.inputs, of.carried) for some in (along, _split_arguments(moved, of)[-1])]
        (cts, dx, dfirst, dcts), (ects, edx, edfirst, edcts) = parts
        ex, efirst, *_ = _split_arguments(moved, of)
        at = [*x, *dx, *first, *dfirst, *still, *rows, count, *_interleave(of, dcts, cts)]
        return [*at, *ex, *edx, *efirst, *edfirst, *_interleave(of, edcts, ects)]

    axes = tuple(tuple(double(of_level, of_level)) for of_level in axes)
    found = hessian_p.bind(*double(primals, tangents), of=of.tangent, axes=axes, linear=2 * linear)
    return _first_halves(found, of)


class _RepeatedMap(LinearMap):
    """A loop as a primitive; `axes` has, for each batch axis, innermost first, 0 or None for every argument."""

    def __init__(self, name: str, shapes: Callable, function: Callable, vary: Callable, pull: Callable | None = None):
        def transpose(known, cotangents, moving, *, axes: tuple, linear: int, of: Repetition):
            """The cotangents, summed over the batch axes that the linear arguments lack."""
            assert pull is not None
            size = len(known)
            known_axes = [(*of_level[:size], *[0] * len(cotangents)) for of_level in axes]
            found = pull([*known, *cotangents], of, known_axes)
            absent = zip(*(of_level[size:] for of_level in reversed(axes)), strict=True) if axes else [()] * linear
            return [x.sum([i for i, axis in enumerate(a) if axis is None]) for x, a in zip(found, absent, strict=True)]

        def shape(*given, **settings):
            batch, given = _drop_batch(given, settings["axes"])
            return [ShapedArray((*batch, *shape), np.dtype(float)) for shape in shapes(given, settings["of"])]

        linear, run = (lambda linear, **_: linear) if pull else 0, functools.partial(_run_members, function=function)
        super().__init__(f"lagjax_repetition_{name}", shape, vary, linear, transpose if pull else None)
        self.vary = vary
        compute_on_host(self, run)

        def call(*given, **settings):
            return call_host(functools.partial(run, **settings), shape(*given, **settings), *given)

        mlir.register_lowering(self, mlir.lower_fun(call, multiple_results=True), platform="cpu")

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
    """The sizes of the batch axes, outermost first, and the shapes of the arguments without them."""
    shapes, batch = [x.shape for x in given], []
    for of_level in reversed(axes):
        batch.append(next(shape[0] for shape, axis in zip(shapes, of_level, strict=True) if axis == 0))
        shapes = [shape if axis is None else shape[1:] for shape, axis in zip(shapes, of_level, strict=True)]
    return tuple(batch), shapes


def _forward_shapes(given, of: Repetition) -> list:
    _, first, _, rows, *_ = _split_arguments(given, of)
    return [*first, *((rows[0][0], *shape) for shape in of.of_round), *of.sums]


def _back_shapes(given, of: Repetition) -> list:
    return given[: of.inputs + of.carried]


def _pull_forward(given, of: Repetition, axes):
    return back_p.bind(*given, of=of, axes=tuple(axes), linear=of.results)


def _pull_back(given, of: Repetition, axes):
    return forward_p.bind(*given, of=of, axes=tuple(axes), linear=of.inputs + of.carried)


def _pull_hessian(given, of: Repetition, axes):
    """The transpose of `hessian`: `hessian` itself in d, by symmetry, and J(x) in dw."""
    size = of.inputs + of.carried
    known, cts, moved = _split(given, size + of.fixed + of.rows + 1, of.results)
    still = list(map(jnp.zeros_like, cts))
    count = len(known) + of.results
    wide = tuple((*of_level, *of_level[len(known) : count]) for of_level in axes)
    of_x = hessian_p.bind(*given, *still, of=of, axes=wide, linear=size + of.results)
    narrow = [(*of_level[: len(known)], *of_level[count:]) for of_level in axes]
    return [*of_x, *_pull_back([*known, *moved], of, narrow)]


value_p = _RepeatedMap("value", _forward_shapes, lambda of, *x: of.run(*x[:-1]), _vary_value)
forward_p = _RepeatedMap("forward", _forward_shapes, _evaluate_forward, _vary_forward, _pull_forward)
back_p = _RepeatedMap("back", _back_shapes, lambda of, *x: of.run_backward(*x), _vary_back, _pull_back)
hessian_p = _RepeatedMap("hessian", _back_shapes, _evaluate_hessian, _vary_hessian, _pull_hessian)
