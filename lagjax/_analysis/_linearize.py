"""`linearize`: the motions next to a motion."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lagjax._analysis._closed_contacts import hold_closed, one_sided_reason
from lagjax._analysis._equilibrium import least_multipliers
from lagjax._analysis._scene_state import SceneState, require_matrices
from lagjax._analysis._smoothness import is_smooth, require_smooth
from lagjax._equations import diagonal_scale, factorize, saddle
from lagjax._interface import compile_for_one_call, is_known, show_str
from lagjax._primitives import accepts_singles, nan_unless
from lagjax._scene import System

PyTree = Any
Vector = Float[Array, " n"]
Matrix = Float[Array, "n n"]
_SHOWN = 8  # equations that are printed


class Linearization(NamedTuple):
    """The linear equations of small deviations from a state, in the order in which the leaves of q lie end to end.

    - `A` (2n, 2n) and `B` (2n, n): d/dt (δq, δq̇) = A (δq, δq̇) + B u, where u (n,) are further generalised forces.
    - `mass_matrix` M, `damping` C, `gyroscopic` G, `stiffness` K, (n, n) each: M δq̈ + (C + G) δq̇ + K δq = u + Jᵀδλ, C
      symmetric and G skew. M is symmetric; K is symmetric where all forces have a potential.
    - `constraint_jacobian` J (m, n): constraints allow δq̇ with J δq̇ = 0; no rows without constraints.
    - `names` (n,): those of the coordinates.
    """

    A: Float[Array, "2n 2n"]
    B: Float[Array, "2n n"]
    mass_matrix: Matrix
    damping: Matrix
    gyroscopic: Matrix
    stiffness: Matrix
    constraint_jacobian: Float[Array, "m n"]
    names: tuple[str, ...]

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        if not is_known(self.A) or np.ndim(self.A) != 2:
            return f"Linearization: A {np.shape(self.A)}, B {np.shape(self.B)}"
        n, more = len(self.names), len(self.names) - _SHOWN
        of = [*(f"δ{name}" for name in self.names), *(f"δ{name}'" for name in self.names)]
        of += [f"u{name.removeprefix('q')}" for name in self.names]
        rows = np.hstack([self.A, self.B])[n : n + _SHOWN]
        shown = [" ".join(f"{c:+.6g} {name}" for c, name in zip(row, of, strict=True) if c) or "0" for row in rows]
        lines = [f"δ{name}'' = {line.removeprefix('+')}" for name, line in zip(self.names, shown, strict=False)]
        return "\n".join([*lines, *([f"… ({more} more)"] if more > 0 else [])])


@accepts_singles(("q", "qdot"), ("params",))
def linearize(system: System, q: PyTree, qdot: PyTree = None, params: PyTree = None) -> Linearization:
    r"""The equations of motion of `system`, linear in small deviations from the state (q, q̇), at rest by default.

        d/dt (δq, δq̇) = A (δq, δq̇) + B u,     A = ∂(q̇, q̈)/∂(q, q̇),   B = ∂(q̇, q̈)/∂u

    u are additional generalised forces. At an equilibrium A is constant and the solutions are exponentials
    (`normal_modes`); along a motion these are the variational equations at that instant. With constraints, λ responds
    to a deviation, and A and B keep a deviation on the constraints if it satisfies them. So it is with contacts that
    are closed at the state and press: their gaps are the last rows of `constraint_jacobian`. The function works under
    `jit`, `vmap` and `grad`.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, for a scene that depends on the time, and
    for a state at which the force jumps or has a kink, as dry friction at rest does: nothing is linear there. Inside
    `jit` the derivatives of the force are NaN there instead.

    Source: Landau & Lifshitz, *Mechanics*, §23; Meirovitch, *Methods of Analytical Dynamics*, §9.

    ```python
    import jax.numpy as jnp, lagjax

    pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q))
    print(lagjax.linearize(pendulum, 0.0).A)  # [[0, 1], [-9.81, 0]]
    ```
    """
    require_matrices(
        sum(map(np.size, jax.tree.leaves(q))),
        "A linearization",
        "The lowest modes are normal_modes(system, q, params, count=50); jax.jvp of system.acceleration gives the "
        "acceleration of one deviation.",
    )
    if held := hold_closed(system, q, qdot, params, "A linearization"):
        system, q = held.system, held.require_loaded(q, qdot, params, one_sided_reason("A motion"))
    scene = SceneState.from_state(system, q, qdot, params)
    scene.require_autonomous("A linearization")
    require_smooth(scene, "A linearization")
    return Linearization(*_linearize(*scene.arguments), names=scene.layout.names)


@compile_for_one_call
def _linearize(*arguments) -> tuple:
    scene = SceneState.from_arguments(*arguments)
    n, state = scene.layout.size, (scene.q, scene.qdot, jnp.zeros((), scene.q.dtype), scene.numbers)
    zero, one = jnp.zeros((n, n), scene.q.dtype), jnp.eye(n, dtype=scene.q.dtype)
    unbalanced, constraints = scene.motion.unbalanced_force, scene.motion.constraints
    force, mass = jax.linearize(lambda a: -unbalanced(*state[:2], a, *state[2:]), zero[0])
    mass = -jax.vmap(mass, out_axes=1)(one)
    jacobian, gamma = constraints.jacobian(*state), constraints.gamma(*state)
    if scene.constrained:
        solve = jax.vmap(lambda b, c: saddle(mass, b, jacobian, c)[0], in_axes=1, out_axes=1)
        acceleration, multipliers, _ = saddle(mass, force, jacobian, gamma)
    else:
        inverse = factorize(mass)
        acceleration, multipliers = inverse.solve(force), gamma

        def solve(b, c):
            return inverse.solve_columns(b)

    def balance(q, qdot):
        """F + Gᵀλ − M q̈ and γ − G q̈ at fixed q̈ and λ."""
        jacobian, gamma = (of(q, qdot, *state[2:]) for of in (constraints.jacobian, constraints.gamma))
        force = unbalanced(q, qdot, acceleration, *state[2:])
        return jacobian.T @ multipliers - force, gamma - jacobian @ acceleration

    smooth = is_smooth(scene)
    of_balance, of_rows = jax.jacfwd(balance, argnums=(0, 1))(*state[:2])
    by_q, by_qdot = (nan_unless(smooth, x) for x in of_balance)
    response = solve(one, jnp.zeros((len(gamma), n), one.dtype))
    a = jnp.block([[zero, one], [solve(by_q, of_rows[0]), solve(by_qdot, of_rows[1])]])
    b, rates = jnp.concatenate([zero, response]), -by_qdot
    return a, b, mass, 0.5 * (rates + rates.T), 0.5 * (rates - rates.T), -by_q, jacobian


def steady_matrices(scene: SceneState, q: Vector) -> tuple[Matrix, Matrix, Matrix, Array, Vector]:
    """M, C + G, K and J at an equilibrium, where q̈ is zero whatever M is, and what is left of the forces there (n,)."""
    jacobian, force = scene.jacobian(q, scene.qdot), scene.force(q, scene.qdot)
    multipliers = least_multipliers(jacobian, force)

    def balance(q, qdot):
        return scene.force(q, qdot) + scene.jacobian(q, qdot).T @ multipliers

    stiffness, rates = jax.jacfwd(balance, argnums=(0, 1))(q, scene.qdot)
    mass, held = scene.mass_matrix(q, scene.qdot), jacobian.T @ multipliers
    if scene.constrained:  # what rounding leaves of forces that balance is nothing
        lengths = jnp.max(jnp.abs(jacobian * diagonal_scale(mass)), axis=1)
        lengths = jnp.where(lengths > 0, lengths, 1)
        largest = jnp.max(jnp.abs(multipliers) * lengths, initial=0)
        rounding = _ROUNDED * jnp.finfo(q.dtype).eps * (jnp.abs(force) + jnp.abs(jacobian).T @ (largest / lengths))
        held = jnp.where(jnp.abs(force + held) <= rounding, -force, held)
    return mass, -rates, -stiffness, jacobian, force + held


# Roundings of a force and of the constraint force that balances it, which are left where nothing is.
_ROUNDED = 64
