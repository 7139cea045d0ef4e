"""Computes the fields of `Health` from the states of a trajectory.

Arrays have the axes (…, state, component). In NumPy the scalar programs evaluate all members of a batch together; for
traced values, and for scenes without programs, the functions of one member are evaluated in JAX, under `jit` and
`vmap`. The computation from these values is written once, for arrays of either library.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import Sample, borders_of, map_in_chunks, numbers_of_state
from lagjax._interface import Layout, is_concrete
from lagjax._primitives import DOUBLE, widen, with_doubles
from lagjax._run import Members
from lagjax._trust.health._laws import Law, Measurements

# The factor on the bound of what N steps may add up to, since the error of a step is estimated; √(2n) comes on top, for
# solvers that measure a root mean square. Twice as large, drifts of 10 to 20 times the bound would go unreported.
SLACK = 10.0
# The drift of a conserved quantity, as a fraction of its size, that is reported however loose the tolerances were.
VISIBLE = 1e-2
# Units of round-off that are allowed for one evaluation of a conserved quantity.
ROUND_OFF = 100.0
# Units of atol: in a motion that is smaller, the errors that atol allows add up to `VISIBLE` within a hundred steps.
SMALLEST = 1e4
# Numbers of mass matrices that are evaluated together: intermediate results then stay in the caches.
_CHUNK = 2**18


class Extreme(NamedTuple):
    """The most extreme value along each path and the time of its output, (…) each; NaN where nothing was reached."""

    value: jax.Array | np.ndarray
    t: jax.Array | np.ndarray


class SampledPath(NamedTuple):
    """The S states of one member, or in NumPy of N members with a first axis (N, …), and the run's tolerances."""

    q: Any  # (…, S, n), of the T outputs, then of the states just before each transition
    qdot: Any  # (…, S, n)
    t: Any  # (…, S)
    mode: Any  # (…, S)
    ts: Any  # (…, T)
    ends: Any  # (…, T − 1): where the law of each output ends, at the next output or at a transition before it
    steps: Any  # (…)
    tolerances: Any  # rtol, or the round-off of the states, and atol, (…) each; None for fixed steps
    precision: np.dtype  # in which the accelerations were computed

    @property
    def library(self):
        """NumPy or `jax.numpy`, whichever the arrays are of."""
        return np if isinstance(self.q, np.ndarray) else jnp

    @property
    def time(self) -> int:
        return self.q.ndim - 2

    def take_ends(self, x):
        """Return the entries at `ends` of an array over states, (…, T − 1, …)."""
        ends = self.ends.reshape(self.ends.shape + (1,) * (x.ndim - self.ends.ndim))
        return self.library.take_along_axis(x, ends, axis=self.time)


def measure_trajectory(trajectory) -> dict[str, Any]:
    """Return the fields of `Health` that are computed from the states, and the names that go with them."""
    if all(is_concrete(leaf) for leaf in jax.tree.leaves(trajectory)):
        if (report := _measure_in_doubles(Members(trajectory))) is not None:
            return report
    axes, tree = jax.tree.flatten(trajectory.params_axes, is_leaf=lambda axis: axis is None)  # hashable
    arrays = dataclasses.replace(trajectory, stats={}, params_axes=None)
    return _measure_traced(arrays, tuple(axes), tree, jnp.asarray(trajectory.stats["num_accepted_steps"]))


@with_doubles
def _measure_in_doubles(members: Members) -> dict[str, Any] | None:
    """Return the fields of `Health` of all members in float64; None if a scene has no scalar programs."""
    layout = dataclasses.replace(members.layout, dtype=DOUBLE)
    laws = _mode_laws(members.trajectory, layout, widen(members.params))
    if not all(law.derivation.is_lowered for law in laws):
        return None
    return _measure_concrete(members, laws) | _known_fields(laws, layout)


def _computed_dtype(trajectory, q) -> np.dtype:
    return q.dtype if trajectory.engine == "Diffrax" else DOUBLE


def _mode_laws(trajectory, layout: Layout, params) -> list[Law]:
    modes = {"": trajectory.system}
    if isinstance(trajectory.system, dict):
        modes = {name: trajectory.system[name] for name in trajectory.mode_names}
    return [Law.from_system(system, layout, params, name if len(modes) > 1 else "") for name, system in modes.items()]


def does_work(trajectory) -> bool:
    """True if a force or the time does work in some mode of a motion, so that its energy is not constant."""
    members = Members(trajectory)
    return any(law.works for law in _mode_laws(trajectory, members.layout, members.params))


def _known_fields(laws: list[Law], layout: Layout) -> dict[str, Any]:
    """Return the fields of `Health` that follow from the scene alone."""
    momenta = _common_conserved(laws)
    return {
        "works": any(law.works for law in laws),
        "momentum_names": None if momenta is None else tuple(layout.names[i] for i in momenta),
        "constraint_names": tuple(name for law in laws for name in law.names),
    }


def _common_conserved(laws: list[Law]) -> tuple[int, ...] | None:
    if any(law.conserved is None for law in laws):
        return None
    return tuple(sorted({i for law in laws for i in law.conserved or ()}))


# ---- in NumPy, all members at once -----------------------------------------------------------------------------------


def sampled_path(members: Members) -> SampledPath:
    run, ts = members.trajectory, members.shared(members.trajectory.ts, 1)
    transitions = None
    if run.transitions is not None:
        times, source = (np.asarray(x).reshape(members.count, -1) for x in (run.transitions.t, run.transitions.source))
        transitions = members.flat(run.transitions.q), members.flat(run.transitions.qdot), times, source
    tolerances = run.tolerances and [members.shared(x, 0) for x in run.tolerances]
    steps = np.asarray(run.stats["num_accepted_steps"]).reshape(members.count)
    mode, q = None if run.mode is None else np.asarray(run.mode).reshape(ts.shape), members.flat(run.q)
    outputs, precision = (q, members.flat(run.qdot), ts, mode), _computed_dtype(run, q)
    return _join_states(np, outputs, transitions, steps, tolerances, precision)


def _measure_concrete(members: Members, laws: list[Law]) -> dict[str, Any]:
    """Return the measured fields of `Health`, with the batch axes of the trajectory."""
    path, momenta = sampled_path(members), _common_conserved(laws) or ()

    def evaluate_by_mode(function: Callable, q, qdot, t, mode):
        """Evaluate `function(law, index, member, sample)` on the states of each mode; return (N, S, …)."""
        shape, total = t.shape, None
        q, qdot = (np.ascontiguousarray(x.reshape(-1, x.shape[-1])) for x in (q, qdot))
        t, mode = t.reshape(-1), mode.reshape(-1)
        member = np.repeat(np.arange(members.count), shape[1])
        for index, law in enumerate(laws):
            here = np.flatnonzero(mode == index)
            if not len(here):
                continue
            numbers = [x if np.ndim(x) == 0 else x[member[here]] for x in members.numbers]
            sample = Sample(law.derivation, *widen((q[here], qdot[here], t[here], numbers)))
            values = function(law, index, member[here], sample)
            if len(here) == len(mode):
                total = values
                break
            if total is None:
                total = jax.tree.map(lambda x: np.zeros((len(mode), *x.shape[1:]), x.dtype), values)
            for all_states, part in zip(jax.tree.leaves(total), jax.tree.leaves(values), strict=True):
                all_states[here] = part
        return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), total)

    def measure_sample(law, index, member, sample) -> Measurements:
        tolerances = (0.0, 0.0) if path.tolerances is None else (x[member] for x in path.tolerances)
        return _pad_constraints(law.measurements(momenta, tuple(tolerances), sample), laws, index)

    def evaluate_law(function: Callable) -> Callable:
        return partial(evaluate_by_mode, lambda law, index, member, sample: function(law, sample))

    with np.errstate(all="ignore"):
        decides = any(borders_of(law.derivation) is not None for law in laws)
        decided = evaluate_law(lambda law, sample: sample.pieces()) if decides else None
        between = Rates(evaluate_law(Law.energy_rates), evaluate_law(Law.accelerations), decided)
        fields = _measure(path, laws, momenta, partial(evaluate_by_mode, measure_sample), between)
    return jax.tree.map(lambda x: jnp.asarray(np.reshape(x, members.batch + np.shape(x)[1:])), fields)


# ---- in JAX, one member ----------------------------------------------------------------------------------------------


@eqx.filter_jit
def _measure_traced(trajectory, axes, tree, steps):
    trajectory = dataclasses.replace(trajectory, params_axes=jax.tree.unflatten(tree, axes))
    names, members = {}, max(1, jnp.size(trajectory.result._value))

    def one(q, qdot, times_and_tolerances, params, mode, steps, transitions):
        layout = Layout.from_state(*jax.tree.map(lambda leaf: leaf[0], (q, qdot)))
        laws = _mode_laws(trajectory, layout, params)
        names.update(_known_fields(laws, layout))
        flat, (ts, tolerances) = jax.vmap(layout.flatten), times_and_tolerances
        more = transitions and (flat(transitions.q), flat(transitions.qdot), transitions.t, transitions.source)
        outputs, precision = (flat(q), flat(qdot), ts, mode), _computed_dtype(trajectory, layout)
        path = _join_states(jnp, outputs, more, steps, tolerances, precision)
        momenta, numbers = _common_conserved(laws) or (), eqx.filter(params, eqx.is_array)
        tolerances = (0.0, 0.0) if path.tolerances is None else path.tolerances
        size = _CHUNK // (members * max(numbers_of_state(law.derivation) for law in laws))

        def evaluate_in_chunks(function):
            return lambda *states: map_in_chunks(partial(_evaluate_mode, laws, function), states, size)

        sample = evaluate_in_chunks(lambda law, *state: law.measurements_at(momenta, tolerances, *state, numbers))
        between = Rates(
            evaluate_in_chunks(lambda law, *state: law.power_at(*state, numbers)),
            evaluate_in_chunks(lambda law, *state: law.motion.acceleration(*state, numbers)),
        )
        return _measure(path, laws, momenta, sample, between)

    return trajectory.map_members(one, steps, trajectory.transitions) | names


def _evaluate_mode(laws: list[Law], function: Callable, q, qdot, t, mode):
    """Evaluate `function(law, q, qdot, t)` by the law of a state's mode; constraints of other modes give 0."""
    total = None
    for index, law in enumerate(laws):
        value = function(law, q, qdot, t)
        if isinstance(value, Measurements):
            value = _pad_constraints(value, laws, index)
        if total is not None:
            value = jax.tree.map(partial(jnp.where, mode == index), value, total)
        total = value
    return total


# ---- what the path shows: arrays of either library -------------------------------------------------------------------


def _join_states(xp, outputs: tuple, transitions: tuple | None, steps, tolerances, precision) -> SampledPath:
    """Append the states before transitions to those of outputs, both (q, q̇, t, mode); mode None: a single one."""
    q, qdot, ts, mode = outputs
    ends = xp.broadcast_to(xp.arange(1, ts.shape[-1]), (*ts.shape[:-1], ts.shape[-1] - 1))
    t, mode, dtype = ts, xp.zeros(ts.shape, int) if mode is None else mode, q.dtype
    if transitions is not None:
        ends = _law_ends(xp, ts, transitions[2])
        q, qdot, t, mode = (
            xp.concatenate(pair, axis=ts.ndim - 1) for pair in zip((q, qdot, t, mode), transitions, strict=True)
        )
    if tolerances is not None:
        rtol, atol = (xp.asarray(x, dtype) for x in tolerances)
        tolerances = xp.maximum(rtol, np.finfo(dtype).eps), atol
    return SampledPath(q, qdot, t, mode, ts, ends, xp.asarray(steps, dtype), tolerances, precision)


def _pad_constraints(measured: Measurements, laws: list[Law], index: int) -> Measurements:
    """Return one law's measurements, padded with zeros at the constraints of the other laws."""
    counts = [len(law.names) for law in laws]
    around = sum(counts[:index]), sum(counts[index + 1 :])

    def pad(x):
        return x.__array_namespace__().pad(x, [(0, 0)] * (x.ndim - 1) + [around])

    return measured._replace(distances=pad(measured.distances), rates=pad(measured.rates))


def _measure(path: SampledPath, laws: list[Law], momenta: tuple[int, ...], sample: Callable, between: "Rates") -> dict:
    """Return all measured fields; `sample(q, qdot, t, mode)` returns the `Measurements` at states."""
    xp, axis, T, dtype = path.library, path.time, path.ts.shape[-1], path.q.dtype
    q, qdot, t, mode = path[:4]
    reached = xp.isfinite(q).all(axis=-1) & xp.isfinite(qdot).all(axis=-1) & (mode >= 0)
    # States that were not reached are evaluated as if they were the start, and then not counted.
    q, qdot = (xp.where(reached[..., None], x, x[..., :1, :]) for x in (q, qdot))
    path = path._replace(q=q, qdot=qdot, t=xp.where(reached, t, t[..., :1]))
    samples = sample(q, qdot, path.t, xp.maximum(mode, 0))
    drifts, work_error = _drifts(path, laws, momenta, samples, reached, between)
    here = jax.tree.map(lambda leaf: leaf[(slice(None),) * axis + (slice(T),)], samples)
    on_path, most = reached[..., :T], partial(find_extreme, xp, axis, path.ts)
    limits, size = _drift_limits(path, here, on_path)
    owner = np.repeat(np.arange(len(laws)), [len(law.names) for law in laws])
    in_force = on_path[..., None] & (mode[..., :T, None] == owner)
    far, fast = (xp.max(xp.where(on_path[..., None], xp.abs(x[..., :T, :]), 0.0), axis=(-2, -1)) for x in (q, qdot))
    # A velocity that moves nothing by its own size in the whole time is rounding beside one that does.
    spans = [far, xp.maximum(fast, far / xp.abs(path.ts[..., -1] - path.ts[..., 0]))]
    eps = float(np.finfo(dtype).eps)
    fixed = path.tolerances is None
    near = math.sqrt(eps) if fixed else xp.maximum(path.tolerances[0], ROUND_OFF * eps)[..., None]
    may_be_singular = any(law.motion.constrained for law in laws)  # the constraints may hold what M does not
    finest = max(math.sqrt(eps), SLACK * eps) if fixed else SLACK * path.tolerances[0]
    all_fine, none = xp.all(here.finite | ~on_path, axis=axis), xp.zeros(path.ts.shape[:-1], dtype)
    energy, knows_mass = most(drifts[..., 0], on_path), all(law.knows_mass for law in laws)
    return {
        "energy": energy,
        "energy_allowed": limits[..., 0],
        "work_error": work_error,
        "outputs_needed": _count_outputs_needed(xp, T, energy.value, work_error, size[..., 0]),
        "amplitude": _largest_excursion(xp, q[..., :T, :], on_path),
        "amplitude_needed": none if fixed else SMALLEST * path.tolerances[1] + none,
        "momentum": most(drifts[..., 1:], on_path),
        "momentum_allowed": limits[..., 1:],
        "constraint_distance": most(here.distances, in_force),
        "constraint_rate": most(here.rates, in_force),
        "constraint_allowed": near * xp.stack(spans, axis=-1),
        "smallest_eigenvalue": most(here.mass[..., 0], on_path, largest=False) if knows_mass else None,
        "condition": most(here.mass[..., 1], on_path) if knows_mass else None,
        "scaled_condition": most(here.mass[..., 2], on_path) if knows_mass else None,
        "scaled_condition_allowed": none + (math.inf if may_be_singular else finest / np.finfo(path.precision).eps),
        "gradients_finite": all_fine,
        "gradients_time": xp.where(all_fine, math.nan, most(1.0 - here.finite, on_path).t),
    }


def _law_ends(xp, ts, transitions):
    """Return the index (…, T − 1) of the state where each output's mode ends: next output or earlier transition."""
    T = ts.shape[-1]
    times = xp.where(xp.isnan(transitions), math.inf, transitions)
    before = xp.sum(times[..., None, :] < ts[..., :-1, None], axis=-1)
    first = xp.minimum(before, times.shape[-1] - 1)
    when = xp.take_along_axis(times, first, axis=-1)
    between = (when >= ts[..., :-1]) & (when < ts[..., 1:])
    return xp.where(between, T + first, xp.arange(1, T))


def _drifts(path: SampledPath, laws, momenta, samples: Measurements, reached, between: "Rates") -> tuple[Any, Any]:
    """Return |h − h₀ − W| and |pᵢ − pᵢ₀| at every output, a column each, and the error of W, (…)."""
    # A piece of the path, from an output to its entry in `ends`, counts for a quantity that its mode conserves;
    # whatever changes the quantity between there and the next output, such as a transition, is left out.
    xp, until, T, values = path.library, path.take_ends, path.ts.shape[-1], samples.conserved
    start = values[..., : T - 1, :]
    measurable = until(reached) & reached[..., : T - 1]
    work, work_error = xp.zeros_like(start[..., 0]), xp.zeros_like(start[..., 0, 0])
    if any(law.works for law in laws):
        work, work_error = _work_integrals(path, samples, measurable, between)
    expected = xp.concatenate([work[..., None], xp.zeros_like(start[..., 1:])], axis=-1)
    conserves = xp.asarray(np.array([[True, *(i in (law.conserved or ()) for i in momenta)] for law in laws]))
    counted = conserves[xp.maximum(until(path.mode), 0)] & measurable[..., None]
    rise = values[..., 1:T, :] - start
    excused = rise - xp.where(counted, until(values) - start - expected, 0.0)
    # Where the piece lasts to the next output this is what is expected, without the rounding of three differences.
    excused = xp.where(counted & (path.ends < T)[..., None], expected, excused)
    before = xp.concatenate([xp.zeros_like(values[..., :1, :]), xp.cumsum(excused, axis=-2)], axis=-2)
    return xp.abs(values[..., :T, :] - values[..., :1, :] - before), work_error


class Rates(NamedTuple):
    """Functions of states (q, q̇, t, mode) between outputs: dh/dt, q̈, and the sides of borders, if piecewise."""

    power: Callable
    acceleration: Callable
    decided: Callable | None = None


def _gauss_rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and weights of Gauss-Legendre on (0, 1), exact for polynomials of degree 2 count − 1."""
    points, weights = np.polynomial.legendre.leggauss(count)
    return points / 2 + 0.5, weights / 2


_POINTS, _WEIGHTS = _gauss_rule(4)
_MORE_POINTS, _MORE_WEIGHTS = _gauss_rule(8)
# s³ (1 − s)³ and s⁴ (1 − s)³ as rows of coefficients of s⁰ … s⁷, and the combinations of them whose second derivative
# is 1 at one and 0 at the other of two points; at these neither of them is near zero, as it would be at 0.3.
_CHECKED = np.array([0.4, 0.6])
_VANISHING = np.array([[0, 0, 0, 1, -3, 3, -1, 0], [0, 0, 0, 0, 1, -3, 3, -1]], float)
_BENDS = np.array([[np.polynomial.Polynomial(row).deriv(2)(x) for row in _VANISHING] for x in _CHECKED])
_CORRECTIONS = np.linalg.inv(_BENDS).T @ _VANISHING  # (2, 8)
INSIDE = 1e-9  # how far from its ends a piece of the path is asked what its program decides there


def _work_integrals(path: SampledPath, samples: Measurements, measurable, between: Rates) -> tuple[Any, Any]:
    """Return ∫ P dt between consecutive outputs, (…, T − 1), and the error of their sum, (…).

    The motion between two outputs is replaced by polynomials. The quintic through q, q̇ and q̈ has an error of order
    six, and so has W. At two points the equations of motion give the error of its second derivative; the polynomial of
    degree seven that is right there gives W to order eight, with twice as many points, so that a power that four points
    do not resolve is seen. The difference of both bounds the error. The cubic through q and q̇ is of order four, the
    trapezoidal rule of order two. Where pieces of the program change, the error is as large as the power varies.
    """
    xp, until, last = path.library, path.take_ends, path.ts.shape[-1] - 1
    (q, v, a, p), dtype = (path.q, path.qdot, samples.acceleration, samples.power), path.q.dtype
    h = until(path.t) - path.t[..., :last]
    first, second = h[..., None], (h**2)[..., None]
    cubic, quintic = _hermite_interpolants(
        *((at(q), first * at(v), second * at(a)) for at in (lambda x: x[..., :last, :], until))
    )
    checked, corrections = _CHECKED.astype(dtype), _CORRECTIONS.astype(dtype)
    bends = _combine_curves(quintic, [k * (k - 1) * checked ** max(k - 2, 0) for k in range(6)])
    defects = second[..., None] * _evaluate_on_curves(path, quintic, between.acceleration, checked) - bends
    fixes = [sum(defects[..., i, :] * corrections[i, k] for i in range(len(corrections))) for k in range(8)]
    septic = [*(c + fix for c, fix in zip(quintic, fixes, strict=False)), *fixes[6:]]

    def integrate(coefficients, points, weights):
        """Return ∫ P ds from s = 0 to 1, times h."""
        powers = _evaluate_on_curves(path, coefficients, between.power, points.astype(dtype))
        return h * xp.sum(powers * weights.astype(dtype), axis=-1)

    trapezoidal = h / 2 * (p[..., :last] + until(p))
    fourth, sixth = (integrate(of, _POINTS, _WEIGHTS) for of in (cubic, quintic))
    found = xp.stack([trapezoidal, fourth, sixth, integrate(septic, _MORE_POINTS, _MORE_WEIGHTS)])
    smooth = xp.isfinite(found).all(axis=0)  # elsewhere the error is not known
    error = _work_error(xp, found)
    if between.decided is not None:
        inside = np.concatenate([[INSIDE], _POINTS.astype(dtype), [1 - INSIDE]])
        pieces, values = (_evaluate_on_curves(path, quintic, of, inside) for of in (between.decided, between.power))
        jumps = (pieces != pieces[..., :1]).any(axis=-1)
        error = xp.where(jumps, h * (values.max(axis=-1) - values.min(axis=-1)), error)
    error = xp.where(smooth, error, math.inf)
    return xp.where(smooth, found[3], trapezoidal), xp.sum(xp.where(measurable, error, 0.0), axis=-1)


def _combine_curves(coefficients, powers) -> Any:
    """Return Σ cₖ pₖ, (…, T − 1, S, n), of coefficients (…, T − 1, n) and powers (S,)."""
    return sum(c[..., None, :] * x[:, None] for c, x in zip(coefficients, powers, strict=True))


def _evaluate_on_curves(path: SampledPath, coefficients, function: Callable, points):
    """Evaluate a function of states at points s (S,) of polynomials with coefficients (…, T − 1, n) of s⁰, s¹, …."""
    xp, until, last = path.library, path.take_ends, path.ts.shape[-1] - 1
    t, degrees = path.t[..., :last], range(len(coefficients))
    h = until(path.t) - t
    at = _combine_curves(coefficients, [points**k for k in degrees])
    velocities = _combine_curves(coefficients, [k * points ** max(k - 1, 0) for k in degrees]) / h[..., None, None]
    times = t[..., None] + h[..., None] * points
    modes = xp.broadcast_to(xp.maximum(until(path.mode), 0)[..., None], times.shape)
    shape = at.shape[:-3] + (-1,)
    found = function(
        *(x.reshape(*shape, x.shape[-1]) for x in (at, velocities)), times.reshape(shape), modes.reshape(shape)
    )
    return found.reshape(times.shape + found.shape[len(shape) :])


def _hermite_interpolants(begin, end) -> tuple[list, list]:
    """Return coefficients of s⁰, s¹, … of the cubic with these q, dq/ds at s = 0, 1, and the quintic with d²q/ds²."""
    (q0, v0, a0), (q1, v1, a1) = begin, end
    a0, rise = a0 / 2, q1 - q0
    # The three conditions at s = 1 on the coefficients of s³, s⁴ and s⁵.
    missing, slope, bend = rise - v0 - a0, v1 - v0 - 2 * a0, a1 - 2 * a0
    last = 10 * missing - 4 * slope + bend / 2, -15 * missing + 7 * slope - bend, 6 * missing - 3 * slope + bend / 2
    return [q0, v0, 3 * rise - 2 * v0 - v1, v0 + v1 - 2 * rise], [q0, v0, a0, *last]


def _work_error(xp, found):
    """Return the error of the work of every piece, from its values `found` (4, …) by rules of order 2, 4, 6, 8."""
    # Once pieces are short enough, errors fall from order to order by the same factor, or a larger one; one of the
    # first two may be small by accident. Where they do not fall eightfold each, the pieces are longer than what they
    # should show, and a small difference proves nothing. Of 240 motions with coarse outputs the work was off by at most
    # 1.5 times its error; by ten times where fourfold is enough, and eightfold twice sees as many wrong forces as it
    # can where 256 in all sees a quarter less.
    rough, fine, finest = xp.abs(found[1:] - found[:-1])
    largest = xp.maximum(rough, fine)
    return xp.where(finest <= largest / 64, finest, xp.maximum(finest, largest))


def _count_outputs_needed(xp, T: int, imbalance, work_error, size):
    """Return about how many outputs would decide whether the power is balanced; T if the present ones do."""
    # They do not where the balance is off by more than `VISIBLE` of the energy and the error of the work may be as
    # large as both. That error is of order six, so that a sixth root gives the number.
    visible = VISIBLE * size
    excess = SLACK * work_error / xp.where(visible > 0, visible, 1.0)
    undecided = (excess > 1) & (imbalance > visible) & ~(imbalance > 2 * SLACK * work_error)
    return T * xp.where(undecided, xp.maximum(2.0, xp.ceil(xp.abs(excess) ** (1 / 6))), 1.0)


def _largest_excursion(xp, q, on_path):
    """Return the largest change of a coordinate along the path; infinite if nothing moves beyond rounding."""
    high = xp.max(xp.where(on_path[..., None], q, -math.inf), axis=-2)
    low = xp.min(xp.where(on_path[..., None], q, math.inf), axis=-2)
    largest = xp.max(high - low, axis=-1)
    rounding = ROUND_OFF * float(np.finfo(q.dtype).eps) * xp.max(xp.maximum(xp.abs(high), xp.abs(low)), axis=-1)
    return xp.where(largest > rounding, largest, math.inf)


def _drift_limits(path: SampledPath, here: Measurements, on_path) -> tuple[Any, Any]:
    """Return the drift of h and the momenta that step errors and round-off allow, and their sizes, (…, k) each."""
    # Fixed steps have no tolerances: there `VISIBLE` of the size is the limit.
    xp, n = path.library, path.q.shape[-1]
    slope, size = (xp.max(xp.where(on_path[..., None], x, 0.0), axis=-2) for x in (here.slopes, here.sizes))
    allowed, steps = VISIBLE * size, path.steps[..., None]
    if path.tolerances is not None:
        allowed = xp.minimum(allowed, SLACK * math.sqrt(2 * n) * (steps + 1) * slope)
    return allowed + ROUND_OFF * float(np.finfo(size.dtype).eps) * (1 + xp.sqrt(steps)) * size, size


def find_extreme(xp, axis: int, ts, values, at, largest: bool = True) -> Extreme:
    """Return the extreme of `values` along the time axis where `at` is True; NaN counts as most extreme."""
    extra = (1,) * (values.ndim - ts.ndim)
    at = xp.broadcast_to(at.reshape(at.shape + (1,) * (values.ndim - at.ndim)), values.shape)
    ranked = xp.where(at, values if largest else -values, -math.inf)
    place = xp.expand_dims(xp.argmax(ranked, axis=axis), axis)  # the first NaN, if there is one
    times = xp.broadcast_to(ts.reshape(ts.shape + extra), values.shape)
    value, when = (xp.squeeze(xp.take_along_axis(x, place, axis=axis), axis) for x in (values, times))
    any_at = xp.any(at, axis=axis)
    return Extreme(xp.where(any_at, value, math.nan), xp.where(any_at, when, math.nan))
