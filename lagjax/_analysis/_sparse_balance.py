"""The balance of forces of a large scene at rest, F + Gᵀλ and f, its sparse derivative by z = (q, λ), and its roots.

It is for scenes with a `Structure`. Derivatives are read off by products (`sparse_jacobian`) and solved by SuperLU on
the host, so that nothing here is traced.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from lagjax._analysis._scene_state import SceneState
from lagjax._equations import sparse_jacobian

Unknowns = Float[np.ndarray, " n+m"]


class SparseBalance(NamedTuple):
    """`residual(z)` (n + m,): F + Gᵀλ, then f; `jacobian(z)`, sparse; `multipliers` (m,) at the state of the scene."""

    residual: Callable[[Unknowns], Unknowns]
    jacobian: Callable[[Unknowns], csr_array]
    multipliers: np.ndarray


def balance_of(scene: SceneState, what: str) -> SparseBalance:
    """The balance of a large scene. Raises `ValueError`, about `what` it is for, where it is not tried."""
    motion, n = scene.motion, scene.layout.size
    large = f"{what} of {n} coordinates is found with sparse matrices on the host"
    if not scene.concrete:
        raise ValueError(f"{large}: call it outside of jit, vmap and grad.")
    if motion.constraints.on_velocities is not None:
        raise ValueError(f"{large}, and not with velocity constraints: give constraints on positions alone.")
    rest, t = jnp.zeros_like(scene.q), jnp.zeros((), scene.q.dtype)

    @jax.jit
    def residual(z, numbers):
        state = z[:n], rest, t, numbers
        _, pull = motion.constraints.products(*state)
        return jnp.concatenate([motion.force(*state) + pull(z[n:]), motion.constraints.residual(*state)])

    multipliers = np.zeros(0)
    if scene.constrained:
        multipliers = np.asarray(jax.jit(motion.multipliers)(scene.q, rest, t, scene.numbers))
    shape = jax.ShapeDtypeStruct((n + len(multipliers),), scene.q.dtype)
    jacobian = sparse_jacobian(residual, (shape, scene.numbers))
    if jacobian is None:
        raise ValueError(
            f"{large}, and the derivatives of its forces are not sparse, or hold products of large matrices: write "
            "forces as sums over neighbours, in slices and with jnp.roll, or give the scene fewer coordinates."
        )
    numbers = scene.numbers
    return SparseBalance(
        lambda z: np.asarray(residual(z, numbers)), lambda z: jacobian(jnp.asarray(z), numbers), multipliers
    )
