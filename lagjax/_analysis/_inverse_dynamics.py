"""`inverse_dynamics`: the forces that produce a given acceleration."""

from jaxtyping import PyTree

from lagjax._analysis._closed_contacts import constrain_closed
from lagjax._interface import Layout, is_concrete
from lagjax._scene import System, Time, describe_violation, require_system


def inverse_dynamics(
    system: System, q: PyTree, qdot: PyTree, qddot: PyTree, t: Time = 0.0, params: PyTree = None
) -> PyTree:
    r"""The generalised forces τ, in the structure of `q`, that the acceleration `qddot` of a state takes.

        τ = d/dt ∂L/∂q̇ − ∂L/∂q − Q + ∂D/∂q̇            with d/dt along q̇, q̈ and the time

    They come on top of all that the scene has: with τ among its forces, its acceleration is `qddot`. Nothing is solved
    for: M may be singular, and ∂τ/∂q̈ = M. As computed torque they drive a robot along a path, and in a record they are
    what the model leaves unexplained. They are energies per unit of `q`: N m for an angle.

    **With constraints** the multipliers carry all that they can. Of the forces with that acceleration these are the
    shortest in the metric of M⁻¹ (Gauss's principle of least constraint),

        τ = M (q̈ − a),    G M⁻¹τ = 0,    with a the acceleration of the scene by itself

    so that τ leaves the multipliers as they are, forces that read them, too, and is zero for the acceleration of the
    scene. Where M is singular, a is that which M and the constraints determine together. A `qddot` that violates G q̈ =
    γ is an error. Contacts that are closed at the state and press are constraints as well; open ones are left out.

    **Dry friction** at rest may take any value up to its bound. τ counts it as the functions are written there, as
    zero by `jnp.sign`: forces that hold the state lie within the bound on either side of τ.

    It works under `jit`, `vmap` and all derivatives; without constraints it is one line of machine code. A path of many
    states is `jax.vmap` of it, that of a simulation `Trajectory.required_forces`.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right; `ValueError` for a `qddot` that violates
    a constraint by more than 1e-6 of its size (5e-6 in float32) and beyond rounding; inside `jit`, `vmap` and
    derivatives τ is NaN there instead. `ValueError` for contacts that are closed and do not press, have friction, or
    depend on the time.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, §5 (inverse dynamics); Udwadia & Kalaba, *Analytical
    Dynamics*, §3 (Gauss's principle).

    ```python
    import jax.numpy as jnp, lagjax

    def pendulum(q, qdot):
        return 0.5 * qdot**2 + 9.81 * jnp.cos(q)

    tau = lagjax.inverse_dynamics(lagjax.System(pendulum), 0.3, 0.0, 2.0)  # 2 + 9.81 sin 0.3
    lagjax.System(pendulum, forces=lambda q, qdot: tau).acceleration(0.3, 0.0)  # 2
    ```
    """
    if isinstance(system, System) and system.contacts is not None and "t" in system.contacts.extras:
        raise ValueError("Inverse dynamics is for contacts that do not depend on the time: which are closed at t?")
    closed: dict[int, str] = {}  # contacts by their places among the constraints
    if held := constrain_closed(system, q, qdot, params, "Inverse dynamics"):
        alone = "Which part of the forces it takes is not known: build the System without this contact, or move q."
        system, q = held.system, held.require_loaded(q, qdot, params, alone)
        closed = {held.own + k: held.names[place] for k, place in enumerate(held.places)}
    system = require_system(system)
    force, place = system._required_force(q, qdot, t, params, qddot)
    if is_concrete(place) and int(place) in closed:
        raise ValueError(
            f"{closed[int(place)]} is closed at this state, and its gap does not stay zero with this qddot. A contact "
            "that opens pushes no more: for such accelerations build the System without it."
        )
    if is_concrete(place) and place >= 0:
        names = system.constraint_names(Layout.from_state(q, qdot), params)
        raise ValueError(f"At this state {describe_violation(names[int(place)])}")
    return force
