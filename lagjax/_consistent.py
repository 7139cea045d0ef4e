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

from lagjax._layout import Layout
from lagjax._motion import Motion
from lagjax._settings import is_concrete
from lagjax._system import System

PyTree = Any

TOLERANCE = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}


def require_consistent(system: System, layout: Layout, ts, q0: PyTree, qdot0: PyTree, params: PyTree) -> None:
    """Raise `ValueError`, naming the constraint, where a single start is off. Values being traced are not looked at."""
    if _free(system) or not _known((ts, q0, qdot0, params, system)):
        return
    names = _names(system, layout, params)
    if len(names) > layout.size:
        raise ValueError(
            f"There are {len(names)} constraints ({', '.join(names)}) for {layout.size} coordinates: no more than "
            f"{layout.size} can be independent. Drop those that follow from the others."
        )
    positions, velocities, lengths = map(np.asarray, _compiled(system, ts, q0, qdot0, params))
    tolerance = TOLERANCE[layout.dtype]
    for name, position, velocity, length in zip(names, positions, velocities, lengths, strict=True):
        if not np.isfinite(position + velocity + length):
            raise ValueError(f"{name} is not finite at the initial state (value {position}, gradient {length}).")
        if length == 0:
            raise ValueError(f"{name} has zero gradient at the initial state, where it holds nothing.")
        for off, what, state in ((position, "q0", "it"), (velocity, "qdot0", "its rate of change")):
            if off / length > tolerance:
                raise ValueError(
                    f"{what} does not satisfy {name}: {state} is {off:.3g} there, a distance of {off / length:.3g}. "
                    "Put the state on the constraints first: q0, qdot0 = system.project(q0, qdot0, t, params)."
                )


def inconsistent_members(system: System, layout: Layout, ts, values: dict, axes: dict) -> jax.Array | None:
    """Which members of a batch start off their constraints; None where that cannot be or cannot be known."""
    if _free(system) or not _known((ts, values, system)):
        return None
    each = jax.vmap(lambda *one: _compiled(system, ts, *one), in_axes=tuple(axes.values()))
    positions, velocities, lengths = each(*values.values())
    off = jnp.maximum(positions, velocities) / lengths
    return ~(off <= TOLERANCE[layout.dtype]).all(axis=1)


@eqx.filter_jit
def _compiled(system: System, ts, q0: PyTree, qdot0: PyTree, params: PyTree):
    """For every constraint |value|, |rate| over the size of the state, and |gradient|."""
    layout = Layout.of(q0, qdot0)
    numbers = eqx.filter(params, eqx.is_array_like)
    motion = system.motion(layout, params)
    state = layout.flatten(q0), layout.flatten(qdot0), jnp.asarray(ts[0]), numbers
    return _off(motion, *state)


def _off(motion: Motion, q, qdot, t, params):
    rows, _ = motion.rows_and_targets(q, qdot, t, params)
    lengths = jnp.sqrt(jnp.sum(rows**2, axis=1))
    rates = -motion.velocity_saddle(q, qdot, t, params)[2]
    values = jnp.zeros_like(rates)
    if motion.constraints is not None:
        held = motion.constraints(q, t, params)
        values = values.at[: len(held)].set(held)
    return jnp.abs(values) / (1 + jnp.max(jnp.abs(q))), jnp.abs(rates) / (1 + jnp.max(jnp.abs(qdot))), lengths


def _free(system: System) -> bool:
    return system.constraints is None and system.velocity_constraints is None


def _known(tree: PyTree) -> bool:
    return all(is_concrete(leaf) for leaf in jax.tree.leaves(tree))


def _names(system: System, layout: Layout, params: PyTree) -> list[str]:
    """One for every number that is to be zero: constraints['rod'], velocity_constraints[1]."""
    roles = [role for role in ("constraints", "velocity_constraints") if getattr(system, role) is not None]
    names = []
    for role, part in zip(roles, system.constraint_structure(layout, params), strict=True):
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            label = role + jax.tree_util.keystr(path)
            names += [label + (str(list(index)) if leaf.shape else "") for index in np.ndindex(leaf.shape)]
    return names
