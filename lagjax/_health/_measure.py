"""From the states of a trajectory to the arrays of a report: everything here is under `jit` and `vmap`."""

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._health._laws import Found, Law, found_at
from lagjax._layout import Layout

PyTree = Any

SLACK = 10.0  # on top of √(2n), by which one component may exceed a root mean square
VISIBLE = 1e-2  # of its own size: no tolerance makes a conserved quantity right that is off by more
ROUND_OFF = 100.0  # units of it, in one evaluation
_CHUNK = 2**18  # numbers of mass matrices looked at together: what is made of them stays in the caches


class Extreme(NamedTuple):
    """The worst value along each path and the time of the output where it is found; NaN where nothing was reached."""

    value: jax.Array
    t: jax.Array


class Names(eqx.Module):
    """Text that leaves a compiled function."""

    works: bool = eqx.field(static=True)
    momenta: tuple[str, ...] | None = eqx.field(static=True)
    constraints: tuple[str, ...] = eqx.field(static=True)


class _Member(NamedTuple):
    """What there is of one member."""

    q: PyTree
    qdot: PyTree
    ts: jax.Array
    tolerances: tuple[jax.Array, jax.Array] | None
    params: PyTree
    mode: jax.Array | None
    steps: jax.Array
    transitions: Any


def measured(trajectory) -> tuple[dict[str, Any], Names]:
    """The fields of `Health` that are found along the path, and names for them."""
    axes, tree = jax.tree.flatten(trajectory.params_axes, is_leaf=lambda axis: axis is None)  # hashable
    steps = jnp.asarray(trajectory.stats["num_accepted_steps"])
    lean = dataclasses.replace(trajectory, stats={}, params_axes=None)
    return _measured(lean, tuple(axes), tree, steps)


@eqx.filter_jit
def _measured(trajectory, axes, tree, steps):
    trajectory = dataclasses.replace(trajectory, params_axes=jax.tree.unflatten(tree, axes))
    modes = {"": trajectory.system}
    if isinstance(trajectory.system, dict):
        modes = {name: trajectory.system[name] for name in trajectory.mode_names}
    names, members = {}, max(1, jnp.size(trajectory.result._value))

    def one(q, qdot, given, params, mode, steps, transitions):
        ts, tolerances = given
        layout = Layout.of(*jax.tree.map(lambda leaf: leaf[0], (q, qdot)))
        laws = [Law.of(system, layout, params, name if len(modes) > 1 else "") for name, system in modes.items()]
        momenta = _conserved(laws)
        names["all"] = Names(
            any(law.works for law in laws),
            None if momenta is None else tuple(layout.names[i] for i in momenta),
            tuple(name for law in laws for name in law.names),
        )
        member = _Member(q, qdot, ts, tolerances, eqx.filter(params, eqx.is_array), mode, steps, transitions)
        return _one_member(laws, momenta or (), layout, member, members)

    found = trajectory.over_members(one, steps, trajectory.transitions)
    return found, names["all"]


def _conserved(laws: list[Law]) -> tuple[int, ...] | None:
    """The coordinates whose momenta are conserved in some mode."""
    if any(law.conserved is None for law in laws):
        return None
    return tuple(sorted({i for law in laws for i in law.conserved or ()}))


def _one_member(laws: list[Law], momenta: tuple[int, ...], layout: Layout, given: _Member, members: int) -> dict:
    dtype, T = layout.dtype, given.ts.size
    promised = (0.0, 0.0) if given.tolerances is None else given.tolerances
    promised = tuple(jnp.asarray(x, dtype) for x in promised)
    q, qdot, t, mode = _states(layout, given)
    reached = jnp.isfinite(q).all(axis=1) & jnp.isfinite(qdot).all(axis=1) & (mode >= 0)
    # What was not reached is looked at as if it were the start, and then not counted.
    q, qdot, t = (jnp.where(reached.reshape(-1, *[1] * (x.ndim - 1)), x, x[0]) for x in (q, qdot, t))
    look = partial(_in_its_mode, laws, momenta, promised, given.params)
    found = _in_chunks(look, (q, qdot, t, jnp.maximum(mode, 0)), _CHUNK // (members * layout.size**2))

    ends = _ends(given)
    drifts, work_error = _drifts(laws, momenta, found, t, mode, reached, ends)
    here = jax.tree.map(lambda leaf: leaf[:T], found)
    on_path, worst = reached[:T], partial(_extreme, given.ts)
    limits = _limits(here, on_path, given.steps.astype(dtype), layout, given.tolerances is None)
    owner = np.repeat(np.arange(len(laws)), [len(law.names) for law in laws])
    held = on_path[:, None] & (mode[:T, None] == owner)
    sizes = [jnp.max(jnp.where(on_path[:, None], jnp.abs(x[:T]), 0.0)) for x in (q, qdot)]
    eps = float(jnp.finfo(dtype).eps)
    near = math.sqrt(eps) if given.tolerances is None else jnp.maximum(promised[0], ROUND_OFF * eps)
    singular = any(law.motion.constrained for law in laws)  # M may be, where constraints hold what it does not
    finest = max(math.sqrt(eps), SLACK * eps) if given.tolerances is None else SLACK * promised[0]
    fine = here.finite | ~on_path
    return {
        "energy": worst(drifts[:, 0], on_path),
        "energy_allowed": limits[0],
        "work_error": work_error,
        "momentum": worst(drifts[:, 1:], on_path),
        "momentum_allowed": limits[1:],
        "constraint_distance": worst(here.distances, held),
        "constraint_rate": worst(here.rates, held),
        "constraint_allowed": near * (1 + jnp.stack(sizes)),
        "smallest_eigenvalue": worst(here.mass[:, 0], on_path, largest=False),
        "condition": worst(here.mass[:, 1], on_path),
        "scaled_condition": worst(here.mass[:, 2], on_path),
        "scaled_condition_allowed": jnp.asarray(jnp.inf if singular else finest / eps, dtype),
        "gradients_finite": jnp.all(fine),
        "gradients_time": jnp.where(jnp.all(fine), jnp.nan, given.ts[jnp.argmin(fine)]),
    }


# ---- states and pieces of the path ----


def _states(layout: Layout, given: _Member):
    """q, q̇, t and the mode at the outputs, and after them at the transitions, just before their resets."""

    def flat(tree):
        return jax.vmap(layout.flatten)(tree)

    mode = jnp.zeros(given.ts.size, int) if given.mode is None else given.mode
    states = flat(given.q), flat(given.qdot), given.ts, mode
    if given.transitions is None:
        return states
    ends = given.transitions
    more = flat(ends.q), flat(ends.qdot), ends.t, ends.source
    return tuple(jnp.concatenate(pair) for pair in zip(states, more, strict=True))


def _ends(given: _Member) -> jax.Array:
    """Where the law of each output ends: the place of the next output, or of a transition before it."""
    T = given.ts.size
    following = jnp.arange(1, T)
    if given.transitions is None:
        return following
    times = jnp.where(jnp.isnan(given.transitions.t), jnp.inf, given.transitions.t)
    first = jnp.minimum(jnp.searchsorted(times, given.ts[:-1]), times.size - 1)
    between = (times[first] >= given.ts[:-1]) & (times[first] < given.ts[1:])
    return jnp.where(between, T + first, following)


def _in_its_mode(laws: list[Law], momenta, tolerances, params, q, qdot, t, mode) -> Found:
    """By the law of its mode; constraints of the others are zero."""
    starts = np.cumsum([0, *(len(law.names) for law in laws)])
    each = []
    for index, law in enumerate(laws):
        found = found_at(law, momenta, tolerances, q, qdot, t, params)
        held = [
            jnp.zeros(starts[-1], q.dtype).at[starts[index] : starts[index + 1]].set(off)
            for off in (found.distances, found.rates)
        ]
        each.append(found._replace(distances=held[0], rates=held[1]))
    total = each[0]
    for index, found in enumerate(each[1:], 1):
        total = _where(mode == index, found, total)
    return total


def _where(which, new, old):
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), new, old)


def _in_chunks(function, arrays, size: int):
    """`jax.vmap`, so many at a time."""
    count = len(arrays[0])
    size = max(1, min(size, count))
    missing = -count % size
    padded = [jnp.concatenate([x, jnp.broadcast_to(x[-1:], (missing, *x.shape[1:]))]) for x in arrays]
    chunks = [x.reshape(-1, size, *x.shape[1:]) for x in padded]
    found = jax.lax.map(lambda some: jax.vmap(function)(*some), chunks)
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * size, *x.shape[2:])[:count], found)


# ---- what the path shows ----


def _drifts(laws, momenta, found: Found, t, mode, reached, ends) -> tuple[jax.Array, jax.Array]:
    """|h − h₀ − W| and |p − p₀| at every output, a column each; and how far W may be off.

    A piece of the path from an output to `ends` is measured if its mode has the law; what else happens before the next
    output is left out.
    """
    T = len(ends) + 1
    start, values = found.kept[: T - 1], found.kept
    work, work_error = _work(found.power, t, ends, reached)
    expected = jnp.zeros_like(start).at[:, 0].set(work)
    keeps = np.array([[True, *(i in (law.conserved or ()) for i in momenta)] for law in laws])
    counted = jnp.asarray(keeps)[jnp.maximum(mode[ends], 0)] & (reached[ends] & reached[: T - 1])[:, None]
    rise = values[1:T] - start
    excused = rise - jnp.where(counted, values[ends] - start - expected, 0.0)
    # The same without the rounding of a sum of differences, where the piece goes on to the next output.
    excused = jnp.where(counted & (ends < T)[:, None], expected, excused)
    before = jnp.concatenate([jnp.zeros_like(values[:1]), jnp.cumsum(excused, axis=0)])
    return jnp.abs(values[:T] - values[0] - before), work_error


def _work(power, t, ends, reached) -> tuple[jax.Array, jax.Array]:
    """∫ P dt over every piece, by the rule of order six, and the error of the sum, from those of order four and two."""
    smooth = jnp.isfinite(power).all(axis=1)  # elsewhere there is only P itself, and no word about the error
    power = power.at[:, 1:].set(jnp.where(smooth[:, None], power[:, 1:], 0.0))
    a, b, h = power[: len(ends)], power[ends], t[ends] - t[: len(ends)]
    second = h / 2 * (a[:, 0] + b[:, 0])
    fourth = second + h**2 / 12 * (a[:, 1] - b[:, 1])
    sixth = second + h**2 / 10 * (a[:, 1] - b[:, 1]) + h**3 / 120 * (a[:, 2] + b[:, 2])
    rough, fine = jnp.abs(fourth - second), jnp.abs(sixth - fourth)
    # Errors fall from order to order by the same factor, or a larger one.
    error = fine * jnp.minimum(1.0, fine / jnp.where(rough > 0, rough, fine + 1.0))
    error = jnp.where(smooth[: len(ends)] & smooth[ends], error, jnp.inf)
    return sixth, jnp.sum(jnp.where(reached[: len(ends)] & reached[ends], error, 0.0))


def _limits(here: Found, on_path, steps, layout: Layout, fixed_steps: bool) -> jax.Array:
    """What steps and round-off may add up to, for h and the momenta; of fixed steps nothing is promised."""
    slope, size = (jnp.max(jnp.where(on_path[:, None], x, 0.0), axis=0) for x in (here.slopes, here.sizes))
    allowed = VISIBLE * size
    if not fixed_steps:
        allowed = jnp.minimum(allowed, SLACK * math.sqrt(2 * layout.size) * (steps + 1) * slope)
    return allowed + ROUND_OFF * float(jnp.finfo(layout.dtype).eps) * (1 + jnp.sqrt(steps)) * size


def _extreme(ts, values, at, largest: bool = True) -> Extreme:
    """Along the first axis, where `at` says so; a NaN there is the most extreme of all."""
    at = jnp.broadcast_to(at.reshape(at.shape + (1,) * (values.ndim - at.ndim)), values.shape)
    ranked = jnp.where(at, values if largest else -values, -jnp.inf)
    place = jnp.argmax(ranked, axis=0)  # the first NaN, if there is one
    value = jnp.take_along_axis(values, place[None], axis=0)[0]
    found = jnp.any(at, axis=0)
    return Extreme(jnp.where(found, value, jnp.nan), jnp.where(found, ts[place], jnp.nan))
