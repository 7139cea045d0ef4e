"""`cyclic_coordinates`, `noether_charge`: a symmetry of L, and its conserved quantity.

A point transformation q → q + ε ξ(q, t), t → t + ε τ(q, t) changes L dt by ε Λ dt,

    Λ = ξ·∂L/∂q + (ξ̇ − q̇ τ̇)·p + τ ∂L/∂t + L τ̇,

and is a symmetry where Λ = dG/dt for some gauge G(q, t). Then p·ξ − h τ − G is constant along every motion.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax._analysis._scene_state import SceneState
from lagjax._equations import Motion
from lagjax._interface import Function, Layout, accept, present
from lagjax._program import Unlowerable
from lagjax._scene import System, present_system, require_system

Vector = Float[Array, " n"]


def cyclic_coordinates(system: System, q: PyTree, qdot: PyTree, params: PyTree = None) -> tuple[str, ...]:
    r"""The names of the coordinates that L does not depend on, as `q['phi']`.

    They are read off the scalar program of L, or its pattern where that is large, in which no operation uses them: the
    answer holds for every state, time and parameter. The momentum of a cyclic coordinate is conserved where no force,
    and no constraint force, acts on it; `conserved_quantities` tells which are. Of q and qdot only the structure
    matters.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, or where L has no scalar program.

    Source: Landau & Lifshitz, *Mechanics*, §40.

    ```python
    import lagjax

    kepler = lagjax.System(lambda q, v: 0.5 * (v["r"] ** 2 + (q["r"] * v["phi"]) ** 2) + 1 / q["r"])
    lagjax.cyclic_coordinates(kepler, {"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": 1.0})  # ("q['phi']",)
    ```
    """
    scene = SceneState.from_state(system, q, qdot, params)
    if scene.derivation.form.is_sparse:
        return tuple(scene.layout.names[i] for i in scene.derivation.unread or ())
    try:
        read = scene.derivation.reads("lagrangian")
    except Unlowerable as reason:
        raise ValueError(f"Which coordinates are cyclic is read off the scalar program of L, but {reason}.") from None
    return tuple(name for i, name in enumerate(scene.layout.names) if i not in read)


def noether_charge(system: System, generator: Callable, gauge: Callable | None = None) -> Callable:
    r"""The function that Noether's theorem says is conserved: `charge(q, qdot, t=0.0, params=None)`, a scalar.

        I = p·ξ − h τ − G,    p = ∂L/∂q̇,  h = p·q̇ − L

    - `generator(q)`: how q changes, ξ(q, t), in the structure of `q`; or a pair (ξ, τ), τ the change of the time.
    - `gauge(q)`: the scalar G(q, t) with dG/dt = the change of L; 0 by default.

    Both may also ask for `t` and `params` by name. The function does not check that the transformation is a symmetry:
    along a motion İ = Λ − dG/dt + Q·(ξ − q̇ τ), with Λ the change of L and Q the forces, and `conserved_quantities`
    with `generators=` tells whether that is zero. Generators that depend on velocities are no point transformations:
    the Laplace–Runge–Lenz vector of Kepler's problem comes from none.

    **Raises** `TypeError` when a function has another signature, or, when the charge is called, where the generator
    does not return the structure of q.

    Source: Noether, Nachr. Ges. Wiss. Göttingen (1918) 235; Arnold, *Mathematical Methods of Classical Mechanics*, §20.

    ```python
    import jax.numpy as jnp, lagjax

    kepler = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) + 1 / jnp.sqrt(jnp.sum(q**2)))
    angular_momentum = lagjax.noether_charge(kepler, lambda q: jnp.array([-q[1], q[0]]))
    angular_momentum(jnp.array([1.0, 0.0]), jnp.array([0.0, 1.2]))  # 1.2
    ```
    """
    system = require_system(system)
    generator = accept(generator, "generator", ("q",))
    gauge = None if gauge is None else accept(gauge, "gauge", ("q",))

    def charge(q: PyTree, qdot: PyTree, t=0.0, params: PyTree = None) -> Float[Array, ""]:
        layout = Layout.from_state(q, qdot)
        change, t = flat_generator(present(generator), layout), jnp.asarray(t, layout.dtype)
        state = layout.flatten(q), layout.flatten(qdot), t, eqx.filter(params, eqx.is_array_like)
        value = charge_at(present_system(system)._motion(layout, params), lambda q, t: change(q, t, params), *state)
        return value if gauge is None else value - present(gauge)(q, t=t, params=params)

    return charge


def flat_generator(generator: Function, layout: Layout) -> Callable:
    """Return the user's generator as a function of (q (n,), t, params) that returns (ξ (n,), τ ())."""

    def flat(q, t, params):
        value = generator(layout.restore(q), t=t, params=params)
        if _fits_state(value, layout):
            return layout.flatten(value), jnp.zeros((), layout.dtype)
        if isinstance(value, tuple) and len(value) == 2 and _fits_state(value[0], layout) and jnp.ndim(value[1]) == 0:
            return layout.flatten(value[0]), jnp.asarray(value[1], layout.dtype)
        got = jax.tree.map(jnp.shape, value)
        raise TypeError(
            f"{generator.name}: a generator must return the change of every coordinate, in the structure of q, or the "
            f"pair of that and the change of the time; q is {layout.tree} with shapes {layout.shapes}, returned were "
            f"the shapes {got}."
        )

    return flat


def _fits_state(value: PyTree, layout: Layout) -> bool:
    leaves, tree = jax.tree.flatten(value)
    return tree == layout.tree and tuple(jnp.shape(leaf) for leaf in leaves) == layout.shapes


def charge_at(motion: Motion, transform: Callable, q: Vector, qdot: Vector, t, numbers: PyTree) -> Float[Array, ""]:
    """Return p·ξ − h τ of the transformation (ξ, τ) = `transform(q, t)` at a state."""
    change, of_time = transform(q, t)
    return motion.momentum(q, qdot, t, numbers) @ change - of_time * motion.energy(q, qdot, t, numbers)


# ---- the variation of L ----------------------------------------------------------------------------------------------


class FlatState(NamedTuple):
    """Arbitrary q, q̇ and q̈ (n,) at the time t: q̈ need not satisfy the equations of motion."""

    q: Vector
    qdot: Vector
    qddot: Vector
    t: Float[Array, ""]


def variation(scene: SceneState, transform: Callable, q: Vector, qdot: Vector, t) -> Float[Array, ""]:
    """Return Λ of the transformation (ξ, τ) = `transform(q, t)`."""
    (change, of_time), (rate, rate_of_time) = jax.jvp(transform, (q, t), (qdot, jnp.ones_like(t)))
    value, moved = jax.jvp(scene.lagrangian, (q, qdot, t), (change, rate - qdot * rate_of_time, of_time))
    return moved + value * rate_of_time


def euler_lagrange(function: Callable, state: FlatState) -> tuple[Vector, Vector]:
    """Return d/dt ∂Λ/∂q̇ and ∂Λ/∂q (n,) of Λ(q, q̇, t): they are equal where Λ is some dG(q, t)/dt."""
    place, onwards = (state.q, state.qdot, state.t), (state.qdot, state.qddot, jnp.ones_like(state.t))
    return jax.jvp(jax.grad(function, argnums=1), place, onwards)[1], jax.grad(function, argnums=0)(*place)
