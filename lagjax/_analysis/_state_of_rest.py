"""The state of rest of a scene: its motion with friction, which ends at a minimum of the potential and at no saddle.

Friction −c M q̇ takes the energy from all coordinates alike, in any units. It begins at the rate of the fastest ones and
becomes less from stage to stage, so that slow ones are not overdamped.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._analysis._coordinates import restrict_signature
from lagjax._analysis._scene_state import SceneState
from lagjax._analysis._solve import levenberg_marquardt
from lagjax._analysis._sparse_balance import constraints_nearby
from lagjax._interface import SimulationError
from lagjax._run import simulate
from lagjax._scene import ROLES, System

PyTree = Any

_ASIDE = 1e-3  # sizes of the coordinates off the guess where the motion begins: to leave an unstable equilibrium
# Stages, each with half of the friction of the one before and some of its own times long, and the velocities that are
# rest, in sizes of the velocities: the motion has then come down to where Newton's method finds the equilibrium.
_STAGES, _TIMES, _AT_REST = 16, 20.0, 1e-4
_RTOL = 1e-6


def settle(scene: SceneState) -> PyTree:
    """q where the scene comes to rest with friction, in the user's pytree. Raises `ValueError` where it does not."""
    scales, layout = scene.scales, scene.layout
    # Links between neighbours are short beside a large scene.
    off = _ASIDE / layout.size if scene.large and scene.constrained else _ASIDE
    aside = np.asarray(scene.q) + off * scales.q * np.cos(np.arange(1.0, layout.size + 1))
    q, qdot = layout.restore(jnp.asarray(aside, layout.dtype)), layout.restore(jnp.zeros(layout.size, layout.dtype))
    system = _add_friction(scene.system)
    for stage in range(_STAGES):
        rate = 0.5**stage / scales.t
        params = {"of": scene.params, "rate": jnp.asarray(rate, layout.dtype)}
        if scene.constrained:
            # By damped least squares towards the constraints first: the projection converges only near them.
            place, unit = layout.flatten(q), jnp.asarray(scales.q, layout.dtype)
            if scene.large:
                near = jnp.asarray(constraints_nearby(scene, np.asarray(place), scales.q))
            else:
                near = levenberg_marquardt(scene.position_constraints, place, jnp.abs(place), unit)
            q, qdot = system.project(layout.restore(near), qdot, 0.0, params)
        try:
            run = simulate(system, q, qdot, jnp.array([0.0, _TIMES / rate], layout.dtype), params, rtol=_RTOL)
        except SimulationError as error:
            raise ValueError(f"With friction the scene does not come to rest: {error}") from None
        q, qdot = run.end.q, run.end.qdot
        if (np.abs(np.asarray(layout.flatten(qdot))) <= _AT_REST * scales.qdot).all():
            return q
    raise ValueError(
        f"With friction the scene has not come to rest after a time of {2**_STAGES * _TIMES * scales.t:.3g}: there may "
        "be no minimum of the potential near the guess, as of a force that always pushes."
    )


def _add_friction(system: System) -> System:
    """The scene at t = 0 with ½ c q̇ᵀM q̇ added to its dissipation; `params` are {"of": its own, "rate": c}."""

    def dissipation(q, qdot, params):
        def scale_velocity(s):
            return system.lagrangian(q, jax.tree.map(lambda v: s * v, qdot), t=0.0, params=params["of"])

        kinetic = 0.5 * jax.grad(jax.grad(scale_velocity))(0.0)
        own = 0.0 if system.dissipation is None else system.dissipation(q, qdot, t=0.0, params=params["of"])
        return own + params["rate"] * kinetic

    def fix_time(function, roles: int) -> Any:
        def function_at_zero(*state_t_params):
            return function(*state_t_params[:roles], t=0.0, params=state_t_params[-1]["of"])

        return function and restrict_signature(function_at_zero, {"params"}, roles)

    fixed: dict[str, Any] = {x: fix_time(getattr(system, x), 1 if x == "constraints" else 2) for x in ROLES}
    fixed["dissipation"] = dissipation
    return System(**fixed)
