"""`equilibrium`: the equilibria of a scene, at rest or in steady motion."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree
from scipy.sparse import diags_array

from lagjax._analysis._closed_contacts import constrain_closed
from lagjax._analysis._lowest_modes import Sparse
from lagjax._analysis._scene_state import SceneState
from lagjax._analysis._solve import is_root, levenberg_marquardt, newton, shortest_preimage
from lagjax._analysis._sparse_balance import (
    balance_of,
    constraints_nearby,
    descend,
    has_falling_direction,
    is_balanced,
    multipliers_at_rest,
    singular_direction,
)
from lagjax._equations import ROUNDINGS, least_norm
from lagjax._interface import (
    SimulationError,
    compile_for_one_call,
    describe_numbers,
    is_known,
    require_flag,
    restrict_signature,
    show_str,
)
from lagjax._primitives import accepts_singles, nan_unless
from lagjax._run import simulate
from lagjax._scene import ROLES, System

Vector = Float[Array, " n"]
Unknowns = Float[Array, " n+m"]  # q, then λ


class Equilibrium(NamedTuple):
    """An equilibrium of a scene.

    - `q`: the coordinates, in the user's pytree; NaN where no equilibrium was found.
    - `multipliers`: λ there, in the structure the constraints return; None without constraints.
    - `ok`: whether an equilibrium was found.
    - `contact_forces`: of a scene with contacts their normal forces λ ≥ 0, in the structure that `contacts` returns.
    """

    q: PyTree
    multipliers: PyTree
    ok: Bool[Array, ""]
    contact_forces: PyTree = None

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        if not all(map(is_known, jax.tree.leaves(self))):
            return repr(self)
        ok = np.asarray(self.ok)
        if ok.ndim:
            return f"{ok.sum()} of {ok.size} equilibria were found"
        forces = "" if self.multipliers is None else f"; {describe_numbers(self.multipliers, 'multipliers')}"
        if self.contact_forces is not None:
            forces += f"; {describe_numbers(self.contact_forces, 'contact_forces')}"
        return f"Equilibrium at {describe_numbers(self.q, 'q')}{forces}" if ok else "No equilibrium was found"


@accepts_singles(("q", "qdot"), ("params",))
def equilibrium(
    system: System, q: PyTree, params: PyTree = None, *, qdot: PyTree = None, stable: bool = False, throw: bool = True
) -> Equilibrium:
    r"""The equilibrium of `system` that Newton's method reaches from `q`.

        ∂L/∂q + Q − ∂D/∂q̇ + (∂f/∂q)ᵀλ = 0,   f(q) = 0,   at q̇ = 0

    - `q`: the guess, in the user's pytree.
    - `qdot`: for a steady motion, its velocities in the structure of `q`: those of the cyclic coordinates, and zero for
      all others. The other coordinates are found: they then stay constant (a top that precesses, a bead on a hoop).
    - `stable`: whether to look for one where the scene comes to rest, a minimum of the potential: from `q` it is first
      followed with friction (a chain falls until it hangs). That takes numbers, not traced ones, and no `qdot`.
    - `throw`: whether to raise where no equilibrium is found. With False, and inside `jit` and `vmap`, `ok` is False
      and q is NaN.

    Without `stable`, stable and unstable equilibria are found alike; `normal_modes` tells which it is. Where equilibria
    form a family (along a coordinate that no force acts on), the result is the member that minimum-norm Newton steps
    reach, and its derivatives are those of the nearest member. Far from an equilibrium the steps are damped
    (Levenberg–Marquardt). The result is differentiated implicitly with respect to `params`, to every order. The
    function works under `jit`, `vmap` and `grad`; for large scenes with sparse matrices, where SuperLU finds the steps
    on the host, on numbers alone.

    **Contacts** that are closed at `q`, whose gaps are zero there, stay closed, and what is found is an equilibrium if
    their forces press, λ ≥ 0, and no other gap becomes negative; `contact_forces` are these λ. Contacts with friction
    that are closed are refused. Inside `jit` the gaps must not read what is being traced.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, a scene that depends on the time, a
    velocity of a coordinate that is not cyclic, or where no equilibrium is found, also because a contact opens or
    closes on the way.

    Source: Landau & Lifshitz, *Mechanics*, §21; Nocedal & Wright, *Numerical Optimization*, §10.3, §11.2.

    ```python
    import jax.numpy as jnp, lagjax

    hoop = lagjax.System(lambda q, v, params: 0.5 * v**2 + 0.5 * (params * jnp.sin(q)) ** 2 + 9.81 * jnp.cos(q))
    rest = lagjax.equilibrium(hoop, 1.0, 5.0)  # cos q = 9.81 / 25
    ```
    """
    require_flag(throw, "throw")
    require_flag(stable, "stable")
    held = constrain_closed(system, q, qdot, params, "An equilibrium")
    if held is not None and stable:
        raise ValueError(
            "stable=True is for scenes without contacts: simulate this one with a dissipation until it rests, and give "
            "the end, run.end.q, to equilibrium."
        )
    scene = SceneState.from_state(system if held is None else held.system, q, qdot, params, sparse=True)
    scene.require_autonomous("An equilibrium")
    if scene.large:
        place, multipliers, ok, why = _solve_large_balance(scene, qdot, stable)
    else:
        require_steady(scene)
        if stable:
            scene = _scene_at_rest(scene, qdot)
        place, _, multipliers, ok = find_balance(scene, None)
        why = "" if not throw or not scene.concrete or ok else _explain_no_equilibrium(scene)
    if held is not None and why:
        why += " What rests on a contact is sought from where it is closed: begin at a q with a gap of zero."
    elif held is not None:
        multipliers, ok, why = held.judge(scene, place, multipliers, ok)
        place, multipliers = nan_unless(ok, place), nan_unless(ok, multipliers)
    if throw and why:
        raise ValueError(why)
    of_user, pushes = None, None
    if held is not None:
        of_user, pushes = held.split(multipliers, scene.layout, scene.params)
    elif scene.constrained:
        of_user = scene.system._split_by_constraint(multipliers, scene.layout, scene.params)
    return Equilibrium(scene.layout.restore(place), of_user, ok, pushes)


def find_balance(scene: SceneState, steady: "Steady | None") -> tuple[Vector, Vector, Array, Bool[Array, ""]]:
    """Solve for an equilibrium, or for a `steady` motion: q and q̇ (n,), λ (m,), and whether one was found."""
    found = _solve_balance(False, steady, *scene.arguments)
    if scene.concrete and not found[-1]:  # with the rounding of terms, whose program is compiled where it may matter
        found = _solve_balance(True, steady, *scene.arguments)
    return found


def _scene_at_rest(scene: SceneState, qdot: PyTree) -> SceneState:
    """Return the scene at the state where friction brings it to rest; raise `ValueError` if that fails."""
    if qdot is not None:
        raise ValueError("stable=True finds where a scene comes to rest: leave qdot out, or look at normal_modes.")
    if not scene.concrete:
        raise ValueError(
            "stable=True follows a motion until it rests, and cannot be traced: find q outside of jit, vmap and grad, "
            "and give it to equilibrium(system, q, params) inside; derivatives by params are right there."
        )
    return SceneState.from_state(scene.system, _find_rest_position(scene), None, scene.params)


def require_steady(scene: SceneState) -> None:
    """Raise `ValueError` if a coordinate that is not cyclic has a velocity."""
    if not scene.concrete or not np.any(scene.qdot) or scene.derivation.terms is None:
        return
    cyclic = scene.conserved
    if wrong := [scene.layout.names[i] for i in np.flatnonzero(np.asarray(scene.qdot)) if i not in cyclic]:
        raise ValueError(
            f"{', '.join(wrong)}: has a velocity, but is not cyclic (L, a force or a constraint depends on it or acts "
            "on it), so that it cannot move steadily. Give velocities to cyclic coordinates alone. What rolls is for "
            "lagjax.steady_motion, and its small motions for linearize(…).reduced(motion)."
        )


# ---- the state of rest -----------------------------------------------------------------------------------------------

# The motion of a scene with friction ends at a minimum of the potential and at no saddle. Friction −c M q̇ takes the
# energy from all coordinates alike, in any units. It begins at the rate of the fastest ones and becomes less from stage
# to stage, so that slow ones are not overdamped.

_ASIDE = 1e-3  # sizes of the coordinates off the guess where the motion begins: to leave an unstable equilibrium
# Stages, each with half of the friction of the one before and some of its own times long, and the velocities that are
# rest, in sizes of the velocities: the motion has then come down to where Newton's method finds the equilibrium.
_STAGES, _TIMES, _AT_REST = 16, 20.0, 1e-4
_RTOL = 1e-6


def _find_rest_position(scene: SceneState) -> PyTree:
    """Simulate with friction until the scene is at rest; return q as a pytree, or raise `ValueError`."""
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
    """Return the scene at t = 0 with ½ c q̇ᵀM q̇ added to its dissipation; `params` are {"of": its own, "rate": c}."""

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


# ---- Newton's method -------------------------------------------------------------------------------------------------

_TINY = 1e-6  # of the other multipliers: one that counts as their rounding


class Steady(NamedTuple):
    """A steady motion to find: `cyclic` coordinates (n,) have unknown velocities, others unknown positions.

    Unknowns that are `held` (n,) are given. `moves` (n, n), `turns` (n, n, n) are those of `SteadySymmetries`.
    """

    cyclic: Bool[Array, " n"]
    held: Bool[Array, " n"]
    moves: Float[Array, "n n"]
    turns: Float[Array, "n n n"]

    def state(self, scene: SceneState, x: Vector) -> tuple[Vector, Vector]:
        """Return (q, q̇) from the unknowns (n,)."""
        x = jnp.where(self.held, jnp.where(self.cyclic, scene.qdot, scene.q), x)
        return jnp.where(self.cyclic, scene.q, x), self.moves @ jnp.where(self.cyclic, x, 0)


@compile_for_one_call
def _solve_balance(has_terms: bool, steady: Steady | None, *arguments) -> tuple[Vector, Vector, Array, Array]:
    """Return q and q̇ (n,), λ (m,) and whether they are an equilibrium, or a `steady` motion.

    `has_terms`: near q = 0 the rounding of the terms of the forces decides that.
    """
    scene = SceneState.from_arguments(*arguments)
    n = scene.layout.size

    def state_of(x: Vector) -> tuple[Vector, Vector]:
        return (x, scene.qdot) if steady is None else steady.state(scene, x)

    def force_at(q: Vector, qdot: Vector) -> Vector:
        """Return F − M q̈ (n,), with the q̈ = Σ q̇ᵢ Ωᵢ q̇ of a steady motion; F alone at rest."""
        force = scene.force(q, qdot)
        if steady is None:
            return force
        return force - scene.mass_matrix(q, qdot) @ jnp.einsum("i,ijk,k", qdot, steady.turns, qdot)

    def residual(z: Unknowns) -> Unknowns:
        q, qdot = state_of(z[:n])
        return balance(scene, q, qdot, force_at(q, qdot), z[n:])

    def multipliers_at(q: Vector, qdot: Vector) -> Array:
        return least_multipliers(scene.jacobian(q, qdot), force_at(q, qdot))

    given = scene.q if steady is None else jnp.where(steady.cyclic, scene.qdot, scene.q)
    start = jax.lax.stop_gradient(jnp.concatenate([given, multipliers_at(*state_of(given))]))
    mass = jax.lax.stop_gradient(scene.mass_matrix(scene.q, scene.qdot))
    unit = _number_units(mass, jax.jacfwd(residual)(start), True if steady is None else ~steady.cyclic)
    least = jnp.abs(start).at[n:].max(_TINY * unit[n:] * jnp.max(jnp.abs(start / unit)[n:], initial=0.0))

    def find(_, start):
        z = newton(residual, levenberg_marquardt(residual, start, least, unit), unit)
        # What converges to zero ends at a tiny number: what is nothing beside the start after three roundings is zero.
        return jnp.where(jnp.abs(z) < jnp.finfo(z.dtype).eps ** 3 * jnp.abs(start), 0.0, z)

    z = jax.lax.custom_root(residual, start, find, lambda linear, right: shortest_preimage(linear, right, unit))
    q, qdot = state_of(z[:n])
    terms: Any = 0.0
    if has_terms:
        at = *jax.lax.stop_gradient((q, qdot)), jnp.zeros((), q.dtype), scene.numbers
        terms = ROUNDINGS * jnp.finfo(q.dtype).eps ** 0.5 * scene.derivation.term_sizes(*at, ("force", "residual"))
    ok = is_root(residual, jax.lax.stop_gradient(z), terms, least=least, power=0.5)
    return nan_unless(ok, q), nan_unless(ok, qdot), nan_unless(ok, multipliers_at(q, qdot)), ok


def _number_units(mass: Float[Array, "n n"], jacobian: Float[Array, "n+m n+m"], places: Any) -> Unknowns:
    """Return a unit for each unknown, so that results do not depend on the user's units.

    It is 1/√Mᵢᵢ for qᵢ (`places`); velocities and λ have the unit in which they change forces as much.
    """
    inertia, n = jnp.abs(jnp.diagonal(mass)), len(mass)
    root = jnp.sqrt(jnp.where((inertia > 0) & jnp.isfinite(inertia), inertia, 1))
    scaled = jax.lax.stop_gradient(jacobian)[:n] / root[:, None]
    of_q = jnp.max(jnp.where(places, jnp.abs(scaled[:, :n] / root), 0.0), initial=0.0)
    columns = jnp.max(jnp.abs(scaled), axis=0)
    found = (of_q > 0) & (columns > 0)
    others = jnp.where(found, of_q / jnp.where(found, columns, 1), 1)
    return others.at[:n].set(jnp.where(places, 1 / root, others[:n]))


def balance(scene: SceneState, q: Vector, qdot: Vector, force: Vector, multipliers: Array) -> Unknowns:
    """Return F + Gᵀλ (n,), then the constraints on positions and velocities (m,): all zero in equilibrium."""
    jacobian = scene.jacobian(q, qdot)
    rows = scene.motion.constraints.residual(q, qdot, jnp.zeros((), q.dtype), scene.numbers)
    return jnp.concatenate([force + jacobian.T @ multipliers, rows])


def least_multipliers(jacobian: Float[Array, "m n"], force: Vector) -> Array:
    """Return the λ (m,) of least norm that minimises |F + Gᵀλ|."""
    return -least_norm(jacobian @ jacobian.T, jacobian @ force) if len(jacobian) else jnp.zeros(0, force.dtype)


# ---- large scenes ----------------------------------------------------------------------------------------------------


def _solve_large_balance(scene: SceneState, qdot: PyTree, stable: bool) -> tuple[Vector, Array, Bool[Array, ""], str]:
    """Return q (n,), λ (m,), whether they are an equilibrium, and a message if not."""
    n, state = scene.layout.size, (scene.q, scene.qdot, jnp.zeros((), scene.q.dtype), scene.numbers)
    if qdot is not None:
        raise ValueError(f"Steady motions of {n} coordinates are not sought: leave qdot out, or give fewer of them.")
    of = balance_of(scene, "An equilibrium")
    if stable:
        scene = _scene_at_rest(scene, None)
        of = of._replace(multipliers=multipliers_at_rest(scene))
    start = np.concatenate([scene.q, of.multipliers])
    unit, jacobian = np.asarray(jax.jit(scene.motion.unit)(*state)), of.jacobian(start)
    columns = abs(diags_array(unit) @ jacobian[:n]).max(axis=0).toarray().ravel()
    of_q = (unit * columns[:n]).max()
    unit = np.concatenate([unit, np.where(columns[n:] > 0, of_q / np.where(columns[n:] > 0, columns[n:], 1), 1)])
    least = np.abs(start)
    least[n:] = np.maximum(least[n:], _TINY * unit[n:] * (least / unit)[n:].max(initial=0))
    z = descend(of.residual, of.jacobian, start, least, unit)
    z = np.where(np.abs(z) < np.finfo(float).eps ** 3 * np.abs(start), 0.0, z)
    why = "" if is_balanced(of, z, least) else _explain_no_equilibrium(scene, jacobian)
    if not why and stable and has_falling_direction(of, z, unit[:n]):
        why = "With friction the scene came to rest where it does not stay: at a saddle. Begin farther from it."
    ok = jnp.asarray(not why)
    return nan_unless(ok, jnp.asarray(z[:n])), nan_unless(ok, jnp.asarray(z[n:])), ok, why


def _explain_no_equilibrium(scene: SceneState, gradient: Sparse | None = None) -> str:
    """Return a message on why there is no equilibrium; `gradient`: the sparse force gradient of a large scene."""
    force, names = np.asarray(scene.force(scene.q, scene.qdot)), scene.layout.names
    if gradient is None:
        slopes = np.abs(jax.jacfwd(scene.force)(scene.q, scene.qdot)).sum(axis=1)
    else:
        slopes = abs(gradient).sum(axis=1)[: len(names)]
    pushed = [names[i] for i in np.flatnonzero((force != 0) & (slopes == 0))]
    if pushed and not scene.constrained:
        return (
            f"There is no equilibrium near the guess: the force of {', '.join(pushed)} is not zero, and no coordinate "
            "changes it. What keeps it there is missing from L: a spring, a support, a constraint."
        )
    if gradient is not None and (direction := singular_direction(gradient)) is not None:
        largest = np.argsort(-np.abs(direction[: len(names)]))[:3]
        return (
            "No equilibrium was found: the derivative of the forces is singular at the guess, along a deviation of "
            f"{', '.join(names[i] for i in largest)} and more. What keeps these there is missing from L, or "
            "constraints depend on each other, or the guess is too far away."
        )
    shown = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names[:8], np.asarray(scene.q)[:8], strict=False))
    return (
        f"No equilibrium was found from {shown}: Newton's method reaches no point where the forces balance. "
        "There may be none, or the force is largest at the guess (its slope vanishes): begin nearer to one."
    )
