"""`linearize`: the linear equations of small deviations from a motion."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax._analysis._closed_contacts import ClosedScene, constrain_closed, one_sided_reason
from lagjax._analysis._eigen import tangent_basis
from lagjax._analysis._equilibrium import least_multipliers
from lagjax._analysis._scene_state import SceneState, require_matrices
from lagjax._analysis._smoothness import is_smooth, require_smooth
from lagjax._equations import diagonal_scale, factorize, null_space, saddle
from lagjax._interface import (
    Function,
    Layout,
    accept,
    compile_for_one_call,
    is_concrete,
    is_known,
    require_finite,
    require_number,
    show_str,
)
from lagjax._primitives import accepts_singles, nan_unless
from lagjax._run import simulate
from lagjax._scene import (
    DrivenParams,
    System,
    add_input_forces,
    constant_inputs,
    drive_scene,
    require_system,
    roles_with_inputs,
)

Vector = Float[Array, " n"]
Matrix = Float[Array, "n n"]
_SHOWN = 8  # equations that are printed


@jax.tree_util.register_static
class LinearNames(tuple):
    """The names of the coordinates (n,), with those of `states` (2n,), `inputs` (m,) and `outputs` (p,)."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def __new__(cls, coordinates: tuple[str, ...], inputs: tuple[str, ...], outputs: tuple[str, ...] | None = None):
        names = super().__new__(cls, coordinates)
        names.inputs, names.outputs = inputs, names.states if outputs is None else outputs
        return names

    def __getnewargs__(self) -> tuple:
        return tuple(self), self.inputs, self.outputs

    def __eq__(self, other: object) -> bool:
        same = not isinstance(other, LinearNames) or self.__getnewargs__()[1:] == other.__getnewargs__()[1:]
        return same and tuple(self) == other

    __hash__ = tuple.__hash__  # pyright: ignore[reportAssignmentType]

    @property
    def states(self) -> tuple[str, ...]:
        return *(f"δ{name}" for name in self), *(f"δ{name}'" for name in self)


class Linearization(NamedTuple):
    """The linear equations of small deviations from a state, in the order in which the leaves of q lie end to end.

    - `A` (2n, 2n) and `B` (2n, m): d/dt (δq, δq̇) = A (δq, δq̇) + B u. u (m,) are deviations of the inputs, or n
      further generalised forces.
    - `mass_matrix` M, `damping` C, `gyroscopic` G, `stiffness` K, (n, n) each: M δq̈ + (C + G) δq̇ + K δq = u + Jᵀδλ, C
      symmetric and G skew, u the generalised forces. M is symmetric; K is symmetric where all forces have a potential.
    - `constraint_jacobian` J (r, n): constraints allow δq̇ with J δq̇ = 0; no rows without constraints.
    - `names` (n,): those of the coordinates; `names.inputs`, `names.outputs` and `names.states` those of the others.
    - `C` (p, 2n) and `D` (p, m): y = C (δq, δq̇) + D u, the deviations of the outputs; by default of the whole state.
    - `sampled`: with a sample time, `Phi` (2n, 2n) and `Gamma` (2n, m): the deviation after it is Φ (δq, δq̇) + Γ u.
    - `allowed` (s, 2n): constraints allow (δq, δq̇) with `allowed` (δq, δq̇) = 0.
    """

    A: Float[Array, "2n 2n"]
    B: Float[Array, "2n m"]
    mass_matrix: Matrix
    damping: Matrix
    gyroscopic: Matrix
    stiffness: Matrix
    constraint_jacobian: Float[Array, "r n"]
    names: LinearNames
    C: Float[Array, "p 2n"]
    D: Float[Array, "p m"]
    allowed: Float[Array, "s 2n"]
    sampled: tuple[Array, Array] | None

    _repr_pretty_ = show_str

    @property
    def Phi(self) -> Float[Array, "2n 2n"]:
        return self._sampled_pair[0]

    @property
    def Gamma(self) -> Float[Array, "2n m"]:
        return self._sampled_pair[1]

    @property
    def _sampled_pair(self) -> tuple[Array, Array]:
        if self.sampled is None:
            raise AttributeError("Phi and Gamma are those of a sample time: call linearize(…, dt=…).")
        return self.sampled

    def reduced(self, motion: Any = None) -> "ReducedLinearization":
        """The linear equations in the fewest numbers x (s,): those of deviations that constraints allow.

        - `motion`: the `SteadyMotion` that this linearization is about. Deviations along cyclic coordinates are then
          left out, and the others are seen from where it turns: A is constant along it, and its eigenvalues are the
          exponents of its small motions. A zero is that of a steady motion next to it.

        Constraints that depend on each other count once; inside `jit` all are taken as independent.
        """
        n, a, rows = len(self.names), self.A, self.allowed
        if motion is not None:
            layout = Layout.from_state(motion.q, motion.qdot)
            a, rows = _co_rotating_frame(a, rows, layout.flatten(motion.qdot), motion.moves, motion.turns)
            cyclic = np.concatenate([np.ravel(x) for x in jax.tree.leaves(motion.cyclic)])
            rows = rows[np.append(np.ones(len(self.allowed), bool), cyclic)]
        rank = 2 * n - null_space(np.asarray(rows)).shape[1] if is_known(rows) else len(rows)
        return ReducedLinearization._make(_reduced_fields(rank, rows, a, self.B, self.C, self.D, self.sampled))

    def __str__(self) -> str:
        if not is_known(self.A) or np.ndim(self.A) != 2:
            return f"Linearization: A {np.shape(self.A)}, B {np.shape(self.B)}, C {np.shape(self.C)}"
        n, of = len(self.names), [*self.names.states, *self.names.inputs]
        lines = _equation_lines([f"δ{name}''" for name in self.names], np.hstack([self.A, self.B])[n:], of)
        if self.names.outputs != self.names.states:
            lines += _equation_lines([f"δ{name}" for name in self.names.outputs], np.hstack([self.C, self.D]), of)
        return "\n".join(lines)


class ReducedLinearization(NamedTuple):
    """The linear equations of deviations (δq, δq̇) = `basis` x from a state, as LQR and Kalman filters take them.

    - `A` (s, s), `B` (s, m), `C` (p, s), `D` (p, m): dx/dt = A x + B u, y = C x + D u.
    - `basis` (2n, s), of orthonormal columns: x = basisᵀ (δq, δq̇) of a deviation that constraints allow.
    - `Phi` (s, s) and `Gamma` (s, m) of a sample time; None without one.
    """

    A: Float[Array, "s s"]
    B: Float[Array, "s m"]
    C: Float[Array, "p s"]
    D: Float[Array, "p m"]
    basis: Float[Array, "2n s"]
    Phi: Float[Array, "s s"] | None
    Gamma: Float[Array, "s m"] | None

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        states, inputs, outputs = np.shape(self.B)[-2], np.shape(self.B)[-1], np.shape(self.C)[-2]
        shapes = f"Linear equations of {states} states x, {inputs} inputs and {outputs} outputs: dx/dt = A x + B u"
        if not is_known(self.A) or np.ndim(self.A) != 2:
            return shapes
        modes = ", ".join(f"{x:.6g}" for x in np.sort_complex(np.linalg.eigvals(np.asarray(self.A)))[:_SHOWN])
        return f"{shapes}\nEigenvalues of A: {modes}{', …' if states > _SHOWN else ''}"


@compile_for_one_call
def _co_rotating_frame(a: Array, rows: Array, qdot: Vector, moves: Array, turns: Array) -> tuple[Array, Array]:
    """Return A in the frame that rotates with a steady motion, and rows (k + n, 2n) that exclude cyclic coordinates."""
    spin = jnp.einsum("i,ijk", qdot, turns.astype(a.dtype))
    moved = jnp.hstack([moves.T.astype(a.dtype), turns.astype(a.dtype) @ qdot])
    return a - jnp.kron(jnp.eye(2, dtype=a.dtype), spin), jnp.concatenate([rows, moved])


@compile_for_one_call
def _reduced_fields(rank: int, rows: Array, a: Array, b: Array, c: Array, d: Array, sampled: tuple | None) -> tuple:
    """The fields of a `ReducedLinearization` onto the null space of `rows`, which have this `rank`."""
    basis = tangent_basis(rows, rank)
    inverse = factorize(basis.T @ basis).solve_columns(basis.T)  # orthonormal columns, but for derivatives
    phi, gamma = (None, None) if sampled is None else (inverse @ sampled[0] @ basis, inverse @ sampled[1])
    return inverse @ a @ basis, inverse @ b, c @ basis, d, basis, phi, gamma


def _equation_lines(left: list[str], rows: np.ndarray, of: list[str]) -> list[str]:
    """Return lines such as "δq'' = -1 δq +1 u" for the rows (k, l) of factors; the last says how many are left out.

    Factors of a few round-offs of the largest in their row and column are omitted.
    """
    rows, more = np.asarray(rows)[:_SHOWN], len(left) - _SHOWN
    sizes = np.abs(rows)
    bounds = np.minimum(sizes.max(axis=1, keepdims=True), sizes.max(axis=0, keepdims=True))
    rows = np.where(sizes > 16 * np.finfo(rows.dtype).eps * bounds, rows, 0.0)
    shown = [" ".join(f"{c:+.6g} {name}" for c, name in zip(row, of, strict=True) if c) or "0" for row in rows]
    lines = [f"{name} = {line.removeprefix('+')}" for name, line in zip(left, shown, strict=False)]
    return [*lines, *([f"… ({more} more)"] if more > 0 else [])]


@accepts_singles(("q", "qdot"), ("params", "inputs", "dt"))
def linearize(
    system: System,
    q: PyTree,
    qdot: PyTree = None,
    params: PyTree = None,
    *,
    inputs: PyTree = None,
    outputs: Callable | None = None,
    dt: Any = None,
) -> Linearization:
    r"""The equations of motion of `system`, linear in small deviations from the state (q, q̇), at rest by default.

        d/dt (δq, δq̇) = A (δq, δq̇) + B u,     A = ∂(q̇, q̈)/∂(q, q̇),   B = ∂(q̇, q̈)/∂u
                    y = C (δq, δq̇) + D u,     (δq, δq̇) at t + dt = Φ (δq, δq̇) + Γ u

    At an equilibrium A is constant and the solutions are exponentials (`normal_modes`); along a motion these are the
    variational equations at that instant. With constraints, λ responds to a deviation, and A and B keep a deviation on
    the constraints if it satisfies them: `reduced()` has such deviations alone. So it is with contacts that are closed
    at the state and press: their gaps are the last rows of `constraint_jacobian`. The function works under `jit`,
    `vmap` (over the states of a trajectory, say) and `grad`.

    - `inputs`: their value at the state, a number, an array or any pytree of them. Functions of the scene, L or the
      forces, ask for `inputs` by name. u are the deviations from it. By default u are additional generalised forces.
    - `outputs(q, qdot)`: what is measured, a number, an array or any pytree of them; it may ask for `t`, `params`,
      `inputs`. By default y is the whole state, as in the package control.
    - `dt`: the sample time, during which inputs are held. Φ and Γ are the derivatives of the motion from the state by
      where it starts and by the inputs, to 1e-12 for each step of it; at an equilibrium they are those of
      `scipy.signal.cont2discrete`. Contacts that are open at the state may strike within dt; a closed one that opens
      then is an error.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, for a scene that depends on the time, for
    constraints that ask for inputs, and for a state at which the force jumps or has a kink, as dry friction at rest
    does: nothing is linear there. Inside `jit` the derivatives of the force are NaN there instead. So are Φ and Γ of a
    motion that cannot be followed over dt.

    Source: Landau & Lifshitz, *Mechanics*, §23; Meirovitch, *Methods of Analytical Dynamics*, §9; Franklin, Powell &
    Workman, *Digital Control of Dynamic Systems*, §4.3.

    ```python
    import jax.numpy as jnp, lagjax

    pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q), forces=lambda q, qdot, inputs: inputs)
    print(lagjax.linearize(pendulum, 0.0, inputs=0.0).A)  # [[0, 1], [-9.81, 0]]
    print(lagjax.linearize(pendulum, 0.0, inputs=0.0, outputs=lambda q, qdot: jnp.sin(q), dt=0.01))
    ```
    """
    require_matrices(
        sum(map(np.size, jax.tree.leaves(q))),
        "A linearization",
        "The lowest modes are normal_modes(system, q, params, count=50); jax.jvp of system.acceleration gives the "
        "acceleration of one deviation.",
    )
    system = require_system(system, contacts=True)
    sensor = None if outputs is None else accept(outputs, "outputs", extras=("t", "params", "inputs"))
    if inputs is not None:
        inputs = _require_inputs(system, sensor, inputs)
        system, params = drive_scene(system, constant_inputs), DrivenParams(params, inputs)
    if held := constrain_closed(system, q, qdot, params, "A linearization"):
        system, q = held.system, held.require_loaded(q, qdot, params, one_sided_reason("A motion"))
    scene = SceneState.from_state(system, q, qdot, params)
    scene.require_autonomous("A linearization")
    require_smooth(scene, "A linearization")
    layout = scene.layout
    of_inputs = None if inputs is None else Layout.from_numbers(inputs, "inputs", layout.dtype)
    pushed = layout.names if of_inputs is None else of_inputs.names
    shown = None if sensor is None else _output_names(sensor, scene, of_inputs is not None)
    if sensor is not None:
        require_smooth(scene, "A linearization of outputs", _flat_outputs(sensor, scene, of_inputs, scene.params))
    names = LinearNames(layout.names, tuple(f"u{re.sub('^(q|inputs)', '', name)}" for name in pushed), shown)
    found, of_state = _linearize(of_inputs, sensor, *scene.arguments)
    return Linearization._make((*found, names, *of_state, None if dt is None else _sample(scene, held, of_inputs, dt)))


def _require_inputs(system: System, sensor: Function | None, inputs: PyTree) -> PyTree:
    """Return the inputs as floats; raise if no function takes them, or a constraint does."""
    integers = lambda x: eqx.is_array_like(x) and jnp.issubdtype(jnp.result_type(x), jnp.integer)  # noqa: E731
    inputs = jax.tree.map(lambda x: 1.0 * x if integers(x) else x, inputs)
    Layout.from_numbers(inputs, "inputs", float)
    require_finite(inputs, "inputs")
    asking = roles_with_inputs(system)
    if not asking and (sensor is None or "inputs" not in sensor.extras):
        raise ValueError(
            "inputs are given, and no function of the scene asks for `inputs`: let forces (or L) do, as "
            "forces=lambda q, qdot, inputs: …; without inputs=… u are generalised forces."
        )
    if moved := [role for role in asking if role not in ("lagrangian", "forces", "dissipation")]:
        raise ValueError(
            f"{moved[0]} asks for `inputs`: an input that jumps would then make coordinates or velocities jump, which "
            "no B says. Make what is prescribed a coordinate, with a force as the input that moves it."
        )
    return inputs


def _output_names(sensor: Function, scene: SceneState, driven: bool) -> tuple[str, ...]:
    """Return the names of the outputs (p,); raise `TypeError` if they are no real floats."""
    shapes = jax.eval_shape(lambda q, v: _outputs(sensor, scene, driven, q, v, scene.params), scene.q, scene.qdot)
    if not (names := Layout.from_numbers(shapes, "outputs", scene.layout.dtype).names):
        raise TypeError("outputs must return at least one number.")
    return tuple(f"y{name.removeprefix('outputs')}" for name in names)


def _outputs(sensor: Function, scene: SceneState, driven: bool, q: Vector, qdot: Vector, params: PyTree) -> PyTree:
    """Return the outputs in the user's structure; with inputs, `params` are `DrivenParams`."""
    restore, extras = scene.layout.restore, {"inputs": params.inputs} if driven else {}
    return sensor(restore(q), restore(qdot), t=0.0, params=params.params if driven else params, **extras)


def _flat_outputs(sensor: Function, scene: SceneState, of_inputs: Layout | None, params: PyTree) -> Callable:
    """Return the outputs (p,) as a function of (q, q̇, …)."""

    def measure(q, qdot, *_):
        shown = _outputs(sensor, scene, of_inputs is not None, q, qdot, params)
        return jnp.concatenate([jnp.ravel(x).astype(q.dtype) for x in jax.tree.leaves(shown)])

    return measure


def _output_matrices(of_inputs: Layout | None, sensor: Function | None, scene: SceneState, u: Vector) -> list[Array]:
    """Return C (p, 2n) and D (p, m); without a sensor, of the whole state."""
    if sensor is None:
        return [jnp.eye(2 * scene.q.size, dtype=u.dtype), jnp.zeros((2 * scene.q.size, u.size), u.dtype)]

    def measure(q, qdot, u):
        return _flat_outputs(sensor, scene, of_inputs, _driven_params(of_inputs, scene, u))(q, qdot)

    smooth = is_smooth(scene, _flat_outputs(sensor, scene, of_inputs, scene.params))
    *of_state, d = jax.jacfwd(measure, argnums=(0, 1, 2))(scene.q, scene.qdot, u)
    return [nan_unless(smooth, x) for x in (jnp.hstack(of_state), d)]


def _driven_params(of_inputs: Layout | None, scene: SceneState, u: Vector) -> PyTree:
    return scene.params if of_inputs is None else scene.params._replace(inputs=of_inputs.restore(u))


@compile_for_one_call
def _linearize(of_inputs: Layout | None, sensor: Function | None, *arguments) -> tuple:
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

    def balance(q, qdot, u):
        """Return F + Gᵀλ − M q̈ and γ − G q̈ at fixed q̈ and λ; the constraints and their rates."""
        place = q, qdot, state[2], eqx.filter(_driven_params(of_inputs, scene, u), eqx.is_array_like)
        jacobian, gamma = constraints.jacobian(*place), constraints.gamma(*place)
        allowed = jnp.concatenate([constraints.f(q, *place[2:]), constraints.rates(*place)])
        force = unbalanced(q, qdot, acceleration, *place[2:])
        return jacobian.T @ multipliers - force, gamma - jacobian @ acceleration, allowed

    smooth, of_state = is_smooth(scene), (0, 1) if of_inputs is None else (0, 1, 2)
    u = jnp.zeros(n, one.dtype) if of_inputs is None else of_inputs.flatten(scene.params.inputs)
    of_balance, of_rows, allowed = jax.jacfwd(balance, argnums=of_state)(*state[:2], u)
    by_q, by_qdot, *by_u = (nan_unless(smooth, x) for x in of_balance)
    pushes = solve(by_u[0], of_rows[2]) if by_u else solve(one, jnp.zeros((len(gamma), n), one.dtype))
    a = jnp.block([[zero, one], [solve(by_q, of_rows[0]), solve(by_qdot, of_rows[1])]])
    b, rates = jnp.concatenate([jnp.zeros_like(pushes), pushes]), -by_qdot
    matrices = a, b, mass, 0.5 * (rates + rates.T), 0.5 * (rates - rates.T), -by_q, jacobian
    return matrices, (*_output_matrices(of_inputs, sensor, scene, u), jnp.hstack(allowed[:2]))


def _sample(scene: SceneState, held: ClosedScene | None, of_inputs: Layout | None, dt) -> tuple[Array, Array]:
    """Return Φ (2n, 2n) and Γ (2n, m); raise `ValueError` if the motion over dt fails.

    Contacts that are open at the state may close within dt: the motion is that with them.
    """
    require_number(dt, "dt")
    if is_concrete(dt) and not 0 < dt < np.inf:
        raise ValueError(f"dt is the sample time, a positive number; got {dt}.")
    given = scene.system if held is None else held.given
    system, params = given if held is None or not held.places else scene.system, scene.params
    if of_inputs is None:  # u are generalised forces
        none = scene.layout.restore(jnp.zeros_like(scene.q))
        given, system = (drive_scene(add_input_forces(x), constant_inputs) for x in (given, system))
        params, of_inputs = DrivenParams(params, none), scene.layout
    state = scene.layout, scene.q, scene.qdot, params
    phi, gamma = _flow_derivatives(of_inputs, dt, system, *state)
    if held is not None and held.places:
        phi, gamma = _require_same_end(dt, given, system, state, (phi, gamma))
    if all(map(is_concrete, (phi, gamma))) and not np.isfinite(phi).all():
        raise ValueError(
            f"The motion from this state cannot be followed over dt = {dt}, or has no derivative there: "
            "lagjax.simulate(system, q, qdot, [0, dt], params) says why. Give a shorter dt, or another state."
        )
    return phi, gamma


def _require_same_end(dt, given: System, system: System, state: tuple, sampled: tuple) -> tuple:
    """Return `sampled`; raise `ValueError` if a contact that is taken as closed opens within dt, or another closes."""
    same = _compare_ends(dt, given, system, *state)
    if not is_concrete(same):
        return tuple(nan_unless(same, x) for x in sampled)
    if not same:
        raise ValueError(
            f"Within dt = {dt} a contact that is closed at this state opens, or another one closes: Φ and Γ are those "
            "of contacts that stay as they are. Give a shorter dt, or another state."
        )
    return sampled


@eqx.filter_jit
def _compare_ends(dt, given: System, system: System, layout: Layout, q, qdot, params: DrivenParams) -> Array:
    """True if the motion over dt with contacts ends in the same state as with the closed ones as constraints."""
    ts = jnp.stack([jnp.zeros((), q.dtype), jnp.asarray(dt, q.dtype)])
    start = layout.restore(q), layout.restore(qdot)
    ends = [simulate(of, *start, ts, params, rtol=_RTOL, throw=False).end for of in (given, system)]
    equal = jnp.array(True)
    for one, other in (map(layout.flatten, x) for x in zip(*((end.q, end.qdot) for end in ends), strict=True)):
        size = jnp.max(jnp.abs(other)) + jnp.max(jnp.abs(one))
        equal &= jnp.all(jnp.abs(one - other) <= _SAME_END * size)
    return equal


@eqx.filter_jit
def _flow_derivatives(of_inputs: Layout, dt, system: System, layout: Layout, q, qdot, params: DrivenParams):
    """Return the derivatives of the state (2n,) after dt by the one before, and by constant inputs."""

    def follow(q, qdot, u):
        driven = params._replace(inputs=of_inputs.restore(u))
        ts = jnp.stack([jnp.zeros((), q.dtype), jnp.asarray(dt, q.dtype)])
        run = simulate(system, layout.restore(q), layout.restore(qdot), ts, driven, rtol=_RTOL, throw=False)
        return jnp.concatenate([layout.flatten(run.end.q), layout.flatten(run.end.qdot)])

    *of_state, of_u = jax.jacfwd(follow, argnums=(0, 1, 2))(q, qdot, of_inputs.flatten(params.inputs))
    return jnp.hstack(of_state), of_u


_SAME_END = 1e-6  # of the largest coordinate or velocity: what six digits leave of a gap that is zero
_RTOL = 1e-12  # of a step: what the order of Taylor series makes cheap, and rounding leaves room for


def steady_matrices(scene: SceneState, q: Vector) -> tuple[Matrix, Matrix, Matrix, Array, Vector]:
    """Return M, C + G, K and J at an equilibrium, where q̈ is zero whatever M is, and the residual force (n,)."""
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
