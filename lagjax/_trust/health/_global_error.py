"""The error of a whole motion, by comparison with a second trajectory of tighter tolerance."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._interface import is_concrete
from lagjax._trust.health._measurements import Extreme, find_extreme

# The largest rtol of a reference, over that of the trajectory: its error is then a tenth of what it measures. With a
# fifth, an error estimate could be off by a quarter.
TIGHTER = 0.1
_FLOOR = 1e-3  # atol/rtol for fixed steps, which have no tolerances: the default ratio


def global_error(trajectory, reference) -> Extreme:
    """Return the largest |yᵢ − reference| relative to the size of yᵢ along the path, (…), over common outputs."""
    require_comparable(trajectory, reference)
    floor = _FLOOR
    if trajectory.tolerances is not None:
        rtol, atol = trajectory.tolerances
        floor = atol / rtol
        floor = jnp.reshape(floor, jnp.shape(floor) + (1,) * (jnp.ndim(trajectory.ok) + 1 - jnp.ndim(floor)))
    return _global_error(*(_output_states(one) for one in (trajectory, reference)), trajectory.ts, floor)


def require_comparable(trajectory, reference) -> None:
    """Raise if two trajectories cannot be compared, or if the reference is not more accurate."""
    if not isinstance(reference, type(trajectory)):
        raise TypeError(f"reference must be a Trajectory; got {type(reference).__name__}.")
    for name in ("q", "qdot", "ts"):
        ours, theirs = (jax.tree.map(jnp.shape, getattr(one, name)) for one in (trajectory, reference))
        if ours != theirs:
            raise ValueError(f"The reference must have the shapes of the trajectory: {name} is {ours}, there {theirs}.")
    eps = max(float(jnp.finfo(jnp.result_type(one.ts)).eps) for one in (trajectory, reference))
    if not _arrays_agree(trajectory.ts, reference.ts, eps):
        raise ValueError("The reference has different output times: integrate it with ts=trajectory.ts.")
    if not eqx.tree_equal(trajectory.system, reference.system):
        raise ValueError("The reference is a motion of another system: integrate it with system=trajectory.system.")
    numbers = [jax.tree.leaves(eqx.filter(one.params, eqx.is_array_like)) for one in (trajectory, reference)]
    if not all(jnp.shape(a) == jnp.shape(b) and _arrays_agree(a, b, eps) for a, b in zip(*numbers, strict=True)):
        raise ValueError("The reference has different parameters: integrate it with params=trajectory.params.")
    rtols = [one.tolerances and one.tolerances[0] for one in (trajectory, reference)]
    if all(rtol is not None and is_concrete(rtol) for rtol in rtols):
        ours, theirs = (float(np.max(rtol)) for rtol in rtols)
        if theirs > TIGHTER * ours:
            raise ValueError(
                f"The reference was integrated with rtol = {theirs:.3g} and the trajectory with {ours:.3g}: it cannot "
                f"judge it. Integrate the reference with at most {TIGHTER * ours:.1g}."
            )


def _arrays_agree(ours, theirs, eps: float) -> bool:
    """True if two arrays agree to 4 eps; also if one is traced."""
    if not (is_concrete(ours) and is_concrete(theirs)):
        return True
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    return bool(np.all(np.abs(ours - theirs) <= 4 * eps * np.max(np.abs(theirs), initial=0.0)))


def _output_states(trajectory) -> jax.Array:
    """Return the states (q, q̇) at all outputs, (..., T, 2n)."""
    axes = jnp.ndim(trajectory.ok) + 1
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves((trajectory.q, trajectory.qdot))]
    return jnp.concatenate([leaf.reshape(*leaf.shape[:axes], -1) for leaf in leaves], axis=-1)


@jax.jit
def _global_error(states, reference, ts, floor) -> Extreme:
    both = jnp.isfinite(states).all(axis=-1) & jnp.isfinite(reference).all(axis=-1)
    size = jnp.max(jnp.where(both[..., None], jnp.abs(reference), 0.0), axis=-2, keepdims=True) + floor
    error = jnp.max(jnp.abs(states - reference) / size, axis=-1)
    return find_extreme(jnp, error.ndim - 1, jnp.broadcast_to(ts, error.shape), error, both)
