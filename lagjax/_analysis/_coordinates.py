"""`change_coordinates`: the same scene in other coordinates.

With q = q(Q, t), q̇ = (∂q/∂Q) Q̇ + ∂q/∂t, L is a function of (Q, Q̇, t), and Lagrange's equations hold for it as they do
for every set of coordinates. Forces become (∂q/∂Q)ᵀ F, so that they do the same work.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from lagjax._analysis._scene_state import require_matrices
from lagjax._analysis._solve import is_root, newton, shortest_preimage, shortest_solution
from lagjax._interface import Function, Layout, accept, present, restrict_signature
from lagjax._primitives import nan_unless
from lagjax._scene import System, require_system


class ChangedCoordinates(NamedTuple):
    """A scene in new coordinates, and the transformations of states between new and old coordinates.

    - `system`: the scene in the new coordinates, a `System`.
    - `old_from_new(Q, Qdot, t=0.0, params=None)`: the state (q, q̇) in the old coordinates.
    - `new_from_old(q, qdot, guess, t=0.0, params=None)`: (Q, Q̇), with Q by Newton's method from a `guess` of Q; NaN
      where that does not converge, as at a pole of the new coordinates. Both functions are differentiable and work
      under `jit` and `vmap`.
    """

    system: System
    old_from_new: Callable
    new_from_old: Callable

    def __repr__(self) -> str:
        return (
            f"ChangedCoordinates: system {self.system!r}\n"
            "old_from_new(Q, Qdot, t, params) for states in the old coordinates\n"
            "new_from_old(q, qdot, guess, t, params) for states in the new ones"
        )


def change_coordinates(system: System, old_from_new: Callable) -> ChangedCoordinates:
    r"""`system` in new coordinates Q, from which `old_from_new(Q)` computes the old ones q.

        L'(Q, Q̇, t) = L(q(Q, t), (∂q/∂Q) Q̇ + ∂q/∂t, t)

    - `old_from_new(Q)`: the old coordinates in their structure, from the new ones in any; it may ask for `t` (frames
      that move) and `params` by name.

    Forces, dissipation and constraints are transformed as well. In a moving frame the energy is a different function,
    and may be conserved where the energy in the old coordinates is not.

    **Raises** `TypeError` for a function of another signature; `ValueError` when a state is changed whose new
    coordinates are more or fewer than the old ones.

    Source: Landau & Lifshitz, *Mechanics*, §1, §39 (rotating frames).

    ```python
    import jax.numpy as jnp, lagjax

    plane = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q @ q)
    polar = lagjax.change_coordinates(plane, lambda p: p["r"] * jnp.array([jnp.cos(p["phi"]), jnp.sin(p["phi"])]))
    polar.system.energy({"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": 1.0})  # 1.0
    ```
    """
    system = require_system(system)
    place = accept(old_from_new, "old_from_new", ("Q",))

    def old_state(Q, Qdot, t: Any = 0.0, params=None):
        Q, Qdot, t = jax.tree.map(lambda x: jnp.asarray(x, float), (Q, Qdot, t))
        return jax.jvp(lambda Q, t: present(place)(Q, t=t, params=params), (Q, t), (Qdot, jnp.ones_like(t)))

    def compose_state(function: Function):
        return lambda Q, Qdot, t, params, **more: function(*old_state(Q, Qdot, t, params), t=t, params=params, **more)

    def compose_force(function: Function):
        def forces(Q, Qdot, t, params, **more):
            force = compose_state(function)(Q, Qdot, t, params, **more)
            return jax.vjp(lambda Q: place(Q, t=t, params=params), Q)[1](force)[0]

        return forces

    def change(function: Function | None, how: Callable = compose_state, roles: int = 2) -> Any:
        return function and restrict_signature(how(function), {*function.extras, *place.extras}, roles)

    changed = System(
        change(system.lagrangian),
        forces=change(system.forces, compose_force),
        dissipation=change(system.dissipation),
        constraints=change(
            system.constraints, lambda f: lambda Q, t, params: f(place(Q, t=t, params=params), t=t, params=params), 1
        ),
        velocity_constraints=change(system.velocity_constraints),
        path=system.path,  # pyright: ignore[reportArgumentType]
    )

    def to_new(q, qdot, guess, t=0.0, params=None):
        return _new_state(present(place), q, qdot, guess, t, params)

    return ChangedCoordinates(changed, old_state, to_new)


def _new_state(place: Function, q: PyTree, qdot: PyTree, guess: PyTree, t, params: PyTree) -> tuple[PyTree, PyTree]:
    """Solve q(Q, t) = q and (∂q/∂Q) Q̇ + ∂q/∂t = q̇ for (Q, Q̇), by Newton's method from `guess`."""
    old, new = Layout.from_state(q, qdot), Layout.from_state(guess, guess)
    if old.size != new.size:
        raise ValueError(
            f"There are {new.size} new coordinates for {old.size} old ones: a state has new coordinates where both are "
            "as many. Where the old ones are constrained, compute the new ones by hand."
        )
    require_matrices(old.size, "A change to new coordinates", "Write the inverse function yourself, and its jax.jvp.")
    t, wanted = jnp.asarray(t, old.dtype), old.flatten(q)

    def residual(x, t):
        return old.flatten(place(new.restore(x), t=t, params=params)) - wanted

    start, at_t = jax.lax.stop_gradient(new.flatten(guess)), functools.partial(residual, t=t)
    x = jax.lax.custom_root(at_t, start, newton, shortest_preimage)
    x = nan_unless(jax.lax.stop_gradient(is_root(at_t, x, wanted)), x)
    jacobian, drift = jax.jacfwd(residual, argnums=(0, 1))(x, t)
    return new.restore(x), new.restore(shortest_solution(jacobian, old.flatten(qdot) - drift))
