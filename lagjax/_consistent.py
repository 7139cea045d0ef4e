"""Whether a motion with constraints starts on them, asked before any work is done.

A constraint fₖ is off by the distance |fₖ| / |∂fₖ/∂q|: that, and not fₖ, has the units of a coordinate. Up to
`TOLERANCE` of the size of the state the first projection takes care of it; beyond, a silent jump would be a wrong
answer to a question that was not asked.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._derivation import columns_of, derivation_of, numbers_of
from lagjax._layout import Layout
from lagjax._linear import coupling_many, dependent_rows, rank
from lagjax._motion import Motion
from lagjax._program import Unlowerable
from lagjax._validate import is_concrete

PyTree = Any

TOLERANCE = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}


def require_consistent(system, layout: Layout, ts, q0: PyTree, qdot0: PyTree, params: PyTree) -> None:
    """Raise `ValueError`, naming the constraint, where a single start is off. Values being traced are not looked at."""
    if _free(system) or not _known((ts, q0, qdot0, params, system)):
        return
    names = system.constraint_names(layout, params)
    positions, velocities, demands, lengths, coupling, driven = _looked_at(system, layout, ts, q0, qdot0, params)
    tolerance = TOLERANCE[layout.dtype]
    for name, *found, length in zip(names, positions, velocities, demands, lengths, strict=True):
        if not np.isfinite([*found, length]).all():
            raise ValueError(f"{name} is not finite at the initial state (value {found[0]}, gradient {length}).")
        if length == 0:
            raise ValueError(f"{name} has zero gradient at the initial state, where it holds nothing.")
    dependent = dependent_rows(coupling)
    independent = len(names) - len(dependent)
    crowded = len(names) > layout.size <= independent and np.isfinite(coupling).all()
    if crowded and not (driven or _timed(system)):
        raise ValueError(
            f"There are {len(names)} constraints ({', '.join(names)}) for {layout.size} coordinates, and {independent} "
            "of them are independent at the initial state: nothing can move. Drop those that are not meant."
        )
    for values, what, state in ((positions, "q0", "it"), (velocities, "qdot0", "its rate of change")):
        clash = _contradiction(names, values, what, lengths, dependent, tolerance)
        if clash and (what == "qdot0" or _nowhere(system, q0, qdot0, ts[0], params)):
            raise ValueError(clash)
        for name, off, length in zip(names, values, lengths, strict=True):
            distance = abs(off) / length
            if distance > tolerance:
                raise ValueError(
                    f"{what} does not satisfy {name}: {state} is {off:.3g} there, a distance of {distance:.3g}. "
                    "Put the state on the constraints first: q0, qdot0 = system.project(q0, qdot0, t, params)."
                )
    if clash := _contradiction(names, demands, "the acceleration", lengths, dependent, tolerance):
        raise ValueError(clash)


def _contradiction(names, values, what, lengths, dependent, tolerance) -> str | None:
    """A sentence where a constraint is a combination of others, but does not ask for the same combination."""
    size = max(1, np.max(np.abs(values) / lengths))
    for row, factors in dependent.items():
        weights = np.abs(factors) * lengths
        if abs(values[row] - factors @ values) > tolerance * size * (lengths[row] + weights.sum()):
            others = ", ".join(name for name, weight in zip(names, weights, strict=True) if weight)
            return (
                f"{names[row]} contradicts {others}: at the initial state it is a combination of them, but asks for "
                f"another value of {what}. They cannot all hold: drop or correct one."
            )
    return None


def _nowhere(system, q0, qdot0, t, params) -> bool:
    """Whether no state on the constraints is found: what asks for different steps may still meet somewhere."""
    found = jax.tree.leaves(eqx.filter_jit(system.project)(q0, qdot0, t, params)[0])
    return not all(np.isfinite(leaf).all() for leaf in found)


def inconsistent_members(system, layout: Layout, ts, values: dict, axes: dict) -> jax.Array | None:
    """Which members of a batch start off their constraints; None where that cannot be or cannot be known."""
    if _free(system) or not _known((ts, values, system)):
        return None
    each = jax.vmap(lambda *one: _compiled(system, ts, *one), in_axes=tuple(axes.values()))
    positions, velocities, _, lengths, _, _ = each(*values.values())
    off = jnp.maximum(jnp.abs(positions), jnp.abs(velocities)) / lengths
    return ~(off <= TOLERANCE[layout.dtype]).all(axis=1)


def _looked_at(system, layout: Layout, ts, q0: PyTree, qdot0: PyTree, params: PyTree) -> tuple:
    """The numbers of `_compiled`, in NumPy; without compiling anything where the scene has programs."""
    q, qdot = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(x)]) for x in (q0, qdot0))
    q, qdot, t = (np.asarray(x, layout.dtype) for x in (q, qdot, ts[0]))
    derivation = derivation_of(system, layout, params)
    names = ("mass_matrix", "jacobian", "target", "residual", "rates", "driving")
    try:
        numbers = numbers_of(eqx.filter(params, eqx.is_array_like))
        values = derivation.evaluate(names, columns_of(q[None], qdot[None], t, numbers))
    except Unlowerable:
        return tuple(map(np.asarray, _compiled(system, ts, q0, qdot0, params)))
    coupling = coupling_many(values["mass_matrix"], values["jacobian"])[0]
    one = {name: value[0] for name, value in values.items()}
    positions = np.where(np.arange(len(one["residual"])) < derivation.position_count, one["residual"], 0)
    sizes, lengths = (1 + np.abs(q).max(), 1 + np.abs(qdot).max()), np.linalg.norm(one["jacobian"], axis=1)
    driven = (one["driving"] != 0).any()
    return positions / sizes[0], one["rates"] / sizes[1], one["target"], lengths, coupling, driven


@eqx.filter_jit
def _compiled(system, ts, q0: PyTree, qdot0: PyTree, params: PyTree):
    """For every constraint its value and rate over the size of the state, what it asks of q̈, |gradient|; and of all S
    and whether they move what is at rest.
    """
    layout = Layout.of(q0, qdot0)
    numbers = eqx.filter(params, eqx.is_array_like)
    motion = system.motion(layout, params)
    state = layout.flatten(q0), layout.flatten(qdot0), jnp.asarray(ts[0]), numbers
    return _off(motion, *state)


def _off(motion: Motion, q, qdot, t, params):
    rows, demands = motion.rows_and_targets(q, qdot, t, params)
    lengths = jnp.sqrt(jnp.sum(rows**2, axis=1))
    rates = -motion.velocity_saddle(q, qdot, t, params)[2]
    values = jnp.zeros_like(rates)
    if motion.constraints is not None:
        held = motion.constraints(q, t, params)
        values = values.at[: len(held)].set(held)
    sizes = 1 + jnp.max(jnp.abs(q)), 1 + jnp.max(jnp.abs(qdot))
    coupling, driven = motion.coupling(q, qdot, t, params), motion.velocity_saddle(q, jnp.zeros_like(q), t, params)[2]
    return values / sizes[0], rates / sizes[1], demands, lengths, coupling, jnp.any(driven != 0)


def rank_lost(motion: Motion, start, end) -> jax.Array:
    """Whether fewer constraints are independent at `end` than at `start`, both (q, q̇, t, params).

    Counted are the independent rows of S = G K⁻¹ Gᵀ, with every row of G in units of its length at the start: a
    gradient that fades away is lost as well.
    """
    start, end = jax.lax.stop_gradient((start, end))
    first, last = motion.coupling(*start), motion.coupling(*end)
    diagonal = jnp.diagonal(first)
    scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))

    def count(coupling):
        return rank(scale[:, None] * coupling * scale)

    return jnp.isfinite(last).all() & (count(last) < count(first))


def _free(system) -> bool:
    return system.constraints is None and system.velocity_constraints is None


def _timed(system) -> bool:
    """Whether a constraint asks for the time: it may prescribe a motion."""
    return any("t" in held.extras for held in (system.constraints, system.velocity_constraints) if held is not None)


def _known(tree: PyTree) -> bool:
    return all(is_concrete(leaf) for leaf in jax.tree.leaves(tree))
