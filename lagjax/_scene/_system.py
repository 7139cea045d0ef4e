"""`System`: the user's description of a mechanical system, and physical quantities at a single state.

A `System` contains the user's functions. Their signatures are checked when it is built, what they return when they are
first evaluated. `System._motion(layout)` is the same in flat coordinates, for an integration.
"""

import dataclasses
import operator
from collections.abc import Callable
from typing import Any, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax._engine import Problem
from lagjax._engine.taylor import lowered_motion
from lagjax._equations import OF_QUANTITIES, Constraints, Motion, Sample, couple_forces, derivation_of
from lagjax._interface import (
    Function,
    Layout,
    ValueNotKnown,
    accept,
    as_arrays,
    is_concrete,
    present,
    registered,
    require_number,
)
from lagjax._primitives import SINGLE, compute_in_doubles, nan_unless
from lagjax._program import Unlowerable, lack_of_memory
from lagjax._scene._explanation import Explanation, explain

# The functions of a scene by their roles, and the arguments of each that come by position.
ARGUMENTS: dict[str, tuple[str, ...]] = {
    "lagrangian": ("q", "qdot"), "forces": ("q", "qdot"), "dissipation": ("q", "qdot"), "constraints": ("q",),
    "velocity_constraints": ("q", "qdot"), "contacts": ("q",), "one_way": ("q", "qdot"), "restitution": (),
    "friction": (), "slip": ("q", "qdot"),
}  # fmt: skip
ROLES = tuple(ARGUMENTS)
Time = Float[ArrayLike, ""]  # a number, or an array of shape ()


class System(eqx.Module):
    r"""A mechanical system, described by its Lagrangian.

    The equations of motion are those of Lagrange, with generalised forces Q and a Rayleigh dissipation function D,

        d/dt ∂L/∂q̇ = ∂L/∂q + Q − ∂D/∂q̇ + (∂f/∂q)ᵀλ + (∂a/∂q̇)ᵀμ.

    The multipliers λ, μ are those for which f and a stay zero. Their sign is that of L̄ = L + Σ λ f, so that (∂f/∂q)ᵀλ
    is the force that the constraint exerts. Constraints on velocities follow the principle of d'Alembert and Lagrange:
    their force does no work on the velocities they allow, and they are not added to L. M may be singular where
    constraints determine the accelerations that L leaves open. Redundant constraints change nothing but the
    multipliers, which are then those of least norm.

    **Arguments**

    - `lagrangian(q, qdot)`: a plain JAX function that returns the scalar L. `q` is any pytree of real floats (a number,
      an array, a dict, a NamedTuple); `qdot` has the same structure. L need not be T − U.
    - `forces(q, qdot)`: the generalised forces Q that have no potential, in the structure of `q`.
    - `dissipation(q, qdot)`: the scalar D, half the power that is dissipated when D is quadratic in `qdot`.
    - `constraints(q)`: what must stay zero, f(q, t) = 0: a number, an array, or a dict of named ones.
    - `velocity_constraints(q, qdot)`: a(q, q̇, t) = 0 that cannot be integrated to such an f: rolling, skates.

    Each may also take, by name, the time `t` and the parameters `params` (any pytree), and in a scene that is fitted to
    records their sampled `inputs` (`lagjax.Record`). Forces may also ask for the `multipliers` of constraints and
    contacts, in the structure of `System.multipliers`, as the friction μ|N| of a bead on a wire or of a bearing does:
    both are solved for together, of constraints that are independent. No acceleration exists (it is NaN) where none, or
    of a single multiplier more than one, satisfies the law. At rest such friction holds where its direction is that of
    a speed, `jnp.sign(tangent @ v)`.

    **Contacts**

    - `contacts(q)`: gaps that stay ≥ 0, each a distance: a number, an array, or a dict of named ones. A contact closes
      where its gap falls to zero, holds with a force λ ≥ 0 (`Trajectory.contact_forces`), and opens where λ would fall
      below zero.
    - `one_way(q, qdot)`: velocities that stay ≥ 0, as of freewheels and ratchets, in the same structures.
    - `restitution`: e of Newton's law, ġ⁺ = −e ġ⁻, from 0 to 1: a number, a dict by name, or a function of `params`.
      Bounces that accumulate end at the limit of their times, and the contact holds from there.
    - `friction`: Coulomb's μ ≥ 0, likewise: |f| ≤ μλ where the contact sticks, f = −μλ s/|s| where it slides. It needs
      `slip(q, qdot)`, the sliding velocity s at each contact in the structure of the gaps: a number in a plane, an
      array of two in space.
    - `forces(q, qdot, multipliers)` may read the normal force λ of a contact by its name, beside the multipliers of
      constraints (one dict where all are dicts, else a tuple): zero while it is open, λ ≥ 0 while it is closed, as
      rolling resistance −c λ sign(ω) does, and a brake. What is linear in λ joins the equations of the contacts; other
      laws, with finite slopes at λ = 0, are solved for, of contacts that are independent. An impact is none of a force:
      its impulse brings nothing of such a law, not even where bounces accumulate.
    - `impacts`: several contacts that touch take a blow together, by the linear complementarity problem of all of them
      ("simultaneous", Moreau and Glocker), or one after the other ("sequential", as Newton's cradle does). "poisson":
      together, and each gives back the part e of the impulse of its compression; without friction, or for one contact
      in a plane, whose slip may stop and turn within the impact (Routh's construction).

    At a start a closed gap that moves inwards is an impact at once. `simulate` and `simulate_batch` follow motions with
    contacts, in machine code on a CPU, and `fit`, `sweep`, `check` and `health` take such scenes. First and second
    derivatives go through impacts, rest, opening and accumulation. Where contacts that share an impact close at one
    instant by themselves, as the feet of a rod that falls flat, they exist along directions that keep them together; in
    others, in reverse mode in all, they are NaN. So they are of a slip in space that begins from rest. For meshes and
    hundreds of contacts take MuJoCo.

    - `path`: how the equations are evaluated. A small scene is reduced to a scalar program that holds only the
      arithmetic it needs, a large one keeps arrays; "auto" chooses, "scalar" and "array" insist. The motion is the
      same.

    **Units.** Any consistent ones; coordinates of different units may be mixed. The momentum of q has units
    mass·length²·time⁻¹/{q}, its force mass·length²·time⁻²/{q}, so that p q̇, F q and L are energies. A change of units
    changes nothing but numbers.

    **Raises** `TypeError` when a function has another signature, when coordinates are not real floats or when a
    function does not return what its role asks for; `ValueError` when `q` and `qdot` differ in structure or shape.

    Source: Landau & Lifshitz, *Mechanics*, §2 (Lagrange's equations), §6 (energy), §25 (dissipation); Moreau,
    *Unilateral contact and dry friction in finite freedom dynamics* (1988), Glocker, *Set-Valued Force Laws* (2001).

    ```python
    import jax.numpy as jnp, lagjax

    def pendulum(q, qdot, params):
        return 0.5 * params["m"] * params["l"]**2 * qdot**2 + params["m"] * 9.81 * params["l"] * jnp.cos(q)

    scene = lagjax.System(pendulum)
    scene.acceleration(0.1, 0.0, params={"m": 1.0, "l": 0.5})

    ball = lagjax.System(lambda q, v: 0.5 * v**2 - 9.81 * q, contacts=lambda q: {"floor": q}, restitution=0.8)
    lagjax.simulate(ball, 1.0, 0.0, jnp.linspace(0.0, 6.0, 61)).impacts
    ```
    """

    lagrangian: Function
    forces: Function | None
    dissipation: Function | None
    constraints: Function | None
    velocity_constraints: Function | None
    contacts: Function | None
    one_way: Function | None
    restitution: Function | None
    friction: Function | None
    slip: Function | None
    impacts: str = eqx.field(static=True)
    path: str = eqx.field(static=True)

    def __init__(
        self,
        lagrangian: Callable,
        *,
        forces: Callable | None = None,
        dissipation: Callable | None = None,
        constraints: Callable | None = None,
        velocity_constraints: Callable | None = None,
        contacts: Callable | None = None,
        one_way: Callable | None = None,
        restitution: Any = 0.0,
        friction: Any = 0.0,
        slip: Callable | None = None,
        impacts: Literal["simultaneous", "sequential", "poisson"] = "simultaneous",
        path: Literal["auto", "scalar", "array"] = "auto",
    ):
        if not isinstance(path, str) or path not in ("auto", "scalar", "array"):
            raise ValueError(f"path must be 'auto', 'scalar' or 'array'; got {path!r}.")
        if impacts not in ("simultaneous", "sequential", "poisson"):
            raise ValueError(f"impacts must be 'simultaneous', 'sequential' or 'poisson'; got {impacts!r}.")
        self.path, self.impacts = path, impacts
        restitution, friction = _coefficients(contacts, one_way, restitution, friction, slip)
        functions = (
            lagrangian, forces, dissipation, constraints, velocity_constraints,
            contacts, one_way, restitution, friction, slip,
        )  # fmt: skip
        for role, function in zip(ROLES, functions, strict=True):
            absent, extras = function is None and role != ROLES[0], ("t", "params", "inputs")
            extras = (*extras, "multipliers") if role == "forces" else extras if ARGUMENTS[role] else ("params",)
            accepted = None if absent else accept(cast(Callable, function), role, ARGUMENTS[role], extras)
            setattr(self, role, accepted)
        if self.reads_multipliers and not self._multiplier_roles:
            raise ValueError(
                "forces asks for `multipliers`, those of constraints=..., velocity_constraints=..., contacts=... and "
                "one_way=..., which this System has not."
            )

    def __repr__(self) -> str:
        """One line: the functions of the scene and what each asks for. `equinox.tree_pprint` prints the fields."""
        functions = [(role, getattr(self, role)) for role in ROLES]
        # Mapped to another pytree (axes, filters), a scene is no longer made of functions.
        shown = [f"{role}={getattr(f, 'name', f)}" for role, f in functions if f is not None]
        return f"System({', '.join(shown)}, path={self.path!r})"

    @property
    def touches(self) -> bool:
        """True if the scene has contacts or one-way velocities."""
        return self.contacts is not None or self.one_way is not None

    @property
    def reads_multipliers(self) -> bool:
        """True if the forces ask for the multipliers of the constraints."""
        return isinstance(self.forces, Function) and "multipliers" in self.forces.extras

    def _require_present(self) -> None:
        """Raise `ValueError` where something that a function of the scene reads has changed since this one was made."""
        for function in (getattr(self, role) for role in ROLES):
            if isinstance(function, Function):
                function.code.require_present()

    # ---- the physics of one state: q and qdot in the user's pytree, the time t, the parameters params ----

    def acceleration(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> PyTree:
        """q̈ from Lagrange's equations, in the structure of `q`; NaN where no acceleration is determined.

        That is so where M is singular, or, with constraints, where M and the constraints together leave some
        acceleration free.
        """
        return self._evaluate_quantity(Motion.acceleration, q, qdot, t, params, restore=True)

    def mass_matrix(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> Float[Array, "n n"]:
        """M = ∂²L/∂q̇², in the order in which the leaves of `q` lie end to end.

        The entry of two coordinates a and b has units energy·time²/({a}{b}).

        **Raises** `ValueError` where n × n numbers do not fit into memory.
        """
        layout = Layout.from_state(q, qdot)
        if lack := lack_of_memory(4 * layout.size**2 * layout.dtype.itemsize):
            raise ValueError(f"The mass matrix of {layout.size} coordinates {lack}.")
        return self._evaluate_quantity(Motion.mass_matrix, q, qdot, t, params)

    def momentum(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> PyTree:
        """The conjugate momentum p = ∂L/∂q̇, in the structure of `q`, in units energy·time/{q}."""
        return self._evaluate_quantity(Motion.momentum, q, qdot, t, params, restore=True)

    def generalized_force(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> PyTree:
        """∂L/∂q + Q − ∂D/∂q̇, in the structure of `q`, in units energy/{q}.

        Along a motion dp/dt equals this force plus, with constraints, `constraint_force`.
        """
        return self._evaluate_quantity(Motion.generalized_force, q, qdot, t, params, restore=True)

    def energy(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> Float[Array, ""]:
        """h = p·q̇ − L, a scalar. It changes by dh/dt = −∂L/∂t + (Q − ∂D/∂q̇)·q̇, and need not equal T + U.

        Constraints that depend on the time do work as well: −λ ∂f/∂t.
        """
        return self._evaluate_quantity(Motion.energy, q, qdot, t, params)

    def multipliers(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> PyTree:
        """λ, in the structure that the constraint functions return: a dict by name if they return dicts.

        With both kinds of constraints: one dict if both return dicts, else the pair (λ, μ). Where constraints are
        redundant, their forces are shared by the multipliers of least norm. λ has units energy/{f}. In a scene with
        contacts they are those while none is closed; `Trajectory.multipliers` are those of the motion.

        **Raises** `ValueError` for a system without constraints.
        """
        return self._evaluate_constraints(Motion.multipliers, q, qdot, t, params)

    def constraint_residual(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> PyTree:
        """f and a, in the structure of `multipliers`: zero where the constraints hold.

        **Raises** `ValueError` for a system without constraints.
        """
        return self._evaluate_constraints(Motion.residual, q, qdot, t, params)

    def constraint_force(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> PyTree:
        """(∂f/∂q)ᵀλ + (∂a/∂q̇)ᵀμ, in the structure of `q`, in units energy/{q}.

        **Raises** `ValueError` for a system without constraints.
        """
        self._require_constraints()
        return self._evaluate_quantity(Motion.constraint_force, q, qdot, t, params, restore=True)

    def project(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> tuple[PyTree, PyTree]:
        """The consistent state (q̂, v̂) nearest to (q, q̇), in the structure of `q`.

            q̂ minimises (q̂ − q)ᵀ M(q, q̇) (q̂ − q)    among all with f(q̂, t) = 0
            v̂ minimises (v̂ − q̇)ᵀ M(q̂, q̇) (v̂ − q̇)   among all with J v̂ + ∂f/∂t = 0 and a(q̂, v̂, t) = 0

        The projection has derivatives of every order with respect to the state, the time and the parameters. Values and
        derivatives are NaN where Newton's method does not converge, as for constraints that contradict each other.

        **Raises** `ValueError` for a system without constraints.

        ```python
        import jax.numpy as jnp, lagjax

        circle = lagjax.System(lambda q, v: 0.5 * v @ v, constraints=lambda q: q @ q - 1.0)
        q0, qdot0 = circle.project(jnp.array([3.0, 4.0]), jnp.array([0.0, 1.0]))  # (0.6, 0.8), (-0.48, 0.36)
        ```
        """
        self._require_constraints()
        layout = Layout.from_state(q, qdot)
        q, qdot = self._evaluate_quantity(Motion.nearest_consistent, q, qdot, t, params)
        return layout.restore(q), layout.restore(qdot)

    def explain(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None) -> Explanation:
        """The contents of this scene, and what was left out of its equations; print it, or read its fields.

        It is read from the scene's programs, so that all of it holds for every state and time, except which constraints
        depend on which. Raises the errors of `System` for invalid coordinates and functions.

        ```python
        import lagjax

        scene = lagjax.scenes.wedge()
        print(scene.system.explain(scene.q0, scene.qdot0, params=scene.params))
        ```
        """
        require_number(t, "t")
        self, layout = present_system(self), Layout.from_state(q, qdot)
        facts = explain(Problem.from_system(self, layout, params))
        if self.touches:
            facts = dataclasses.replace(facts, contacts=self.contact_names(layout, params), energy_conserved=None)
        if not self._constraint_roles:
            return facts
        names = self.constraint_names(layout, params)
        if derivation_of(self, layout, params).form.is_sparse:
            return facts.with_constraints(names, None)
        schur = self._evaluate_quantity(Motion.schur_complement, q, qdot, t, params)
        return facts.with_constraints(names, np.asarray(schur) if is_concrete(schur) else None)

    def equations(self, q: PyTree, qdot: PyTree, t: Time = 0.0, params: PyTree = None, *, inputs: PyTree = None) -> Any:
        """The equations of motion to read, M q̈ = F + Gᵀλ and G q̈ = γ: print them, or show them in a notebook.

        They are `lagjax.results.Equations`, formulas in the names of the leaves of `q` and `params`: q["theta"] is
        theta, its velocity theta_dot, params["m"] is m, q[0] is q0. All of them hold for every state, time and
        parameters, of which only the structure is read here; so are `inputs` of functions that ask for them. Of a scene
        that takes more than 500 operations, or has no scalar program, the result holds a sentence.

        **Raises** the errors of `System` for invalid coordinates and functions.

        ```python
        import jax.numpy as jnp, lagjax

        def L(q, qdot, params):
            return 0.5 * params["m"] * params["l"]**2 * qdot**2 + params["m"] * params["g"] * params["l"] * jnp.cos(q)

        equations = lagjax.System(L).equations(0.1, 0.0, params={"m": 1.0, "l": 0.5, "g": 9.81})
        print(equations)
        equations.force  # {"q": "-m*g*l*sin(q)"}
        ```
        """
        require_number(t, "t")
        self, layout = present_system(self), Layout.from_state(q, qdot)
        return registered().write_equations(self, layout, params, inputs)

    def to_c(
        self,
        q: PyTree,
        qdot: PyTree,
        t: Time = 0.0,
        params: PyTree = None,
        *,
        inputs: PyTree = None,
        name: str = "scene",
        dtype: Literal["float64", "float32"] = "float64",
    ) -> str:
        """The equations of motion as C99, which needs `math.h` and nothing else: to run where there is no Python.

        The text has the functions

            {name}_acceleration(q, qdot, t, params, inputs, qddot)      n numbers; NaN where M is singular
            {name}_mass_matrix(q, qdot, t, params, inputs, M)           n rows of n
            {name}_energy(q, qdot, t, params, inputs, h)                one number
            {name}_step(q, qdot, t, params, inputs, dt, steps)          steps of the classical Runge–Kutta method
            {name}_project(q, qdot, t, params, inputs, state)           one Newton step back to constraints, if any

        of arrays of `dtype`, whose order a comment names; `params` and `inputs` are left out where a scene has none.
        Only the structure of the arguments is read here: one text serves all values. Compiled with `-ffp-contract=off`
        and without `-ffast-math`, accelerations have the bits of `jax.jit(system.acceleration)`; sine and cosine are
        written out, other functions are those of `math.h`. In float32 everything is computed in float32.

        A step takes four accelerations, of global order 4, and ends with a projection where there are constraints.
        Steps of fixed length do not end where accelerations jump or have corners, as dry friction does: such a scene
        has no `{name}_step`, and a comment says so.

        **Raises** `TypeError` for a scene with contacts, `ValueError` for one without a scalar program, and for a name
        that is no identifier.

        ```python
        import jax.numpy as jnp, lagjax

        pendulum = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 + params["g"] * jnp.cos(q))
        text = pendulum.to_c(0.1, 0.0, params={"g": 9.81}, name="pendulum")
        ```
        """
        require_number(t, "t")
        self, layout = present_system(self), Layout.from_state(q, qdot)
        return registered().write_c(self, layout, params, inputs, name, dtype)

    def _motion(self, layout: Layout, params: PyTree = None) -> Motion:
        """Return the equations in the flat coordinates of `layout`; raise if a function has the wrong output."""
        # The functions of the result take the numbers in `params` alone, with None in the place of everything else.
        self._check_outputs(layout, params)

        def concatenate(tree: PyTree) -> jax.Array:  # of float64, as constants may be, in a scene in float32
            return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(tree)]).astype(layout.dtype)

        def to_scalar(value):
            return value

        to_arrays = to_scalar, layout.flatten, to_scalar, concatenate, concatenate
        lagrangian, forces, dissipation, *of_constraints = (
            self._flat_function(role, layout, params, to_array)
            for role, to_array in zip(ROLES, to_arrays, strict=False)
        )
        motion = Motion(lagrangian, None, dissipation, Constraints(*of_constraints))
        if self.reads_multipliers:
            return couple_forces(motion, self.multiplier_law(layout, params), layout, params)
        return dataclasses.replace(motion, forces=forces)

    def _flat_function(self, role: str, layout: Layout, params: PyTree, to_array: Callable) -> Any:
        """Return the user's function with flat arguments (…, t, params); `to_array` flattens what it returns."""
        function: Any = getattr(self, role)
        code = eqx.filter(params, eqx.is_array_like, inverse=True)  # functions and strings: no part of the data

        def flat(*arguments, **more):
            *vectors, t, numbers = arguments
            trees = map(layout.restore, vectors)
            return to_array(function(*trees, t=t, params=eqx.combine(numbers, code), **more))

        return function and flat

    def multiplier_law(self, layout: Layout, params: PyTree) -> Callable:
        """Return Q(q, qdot, t, params, multipliers), all flat, of forces that read multipliers (m,).

        The multipliers are those of constraints, then of contacts; missing ones, of open contacts, are zero.
        """
        forces = self._flat_function("forces", layout, params, layout.flatten)
        trees = self._role_shapes(self._multiplier_roles, layout, params)
        count = count_numbers(trees)

        def law(*state_and_multipliers):
            *state, flat = state_and_multipliers
            return forces(*state, multipliers=name_numbers(jnp.pad(flat, (0, count - flat.size)), trees))

        return law

    def _require_constraints(self) -> None:
        if not self._constraint_roles:
            raise ValueError("This system has no constraints: give constraints=... or velocity_constraints=... to it.")

    def _evaluate_constraints(self, quantity: Callable, q, qdot, t, params) -> PyTree:
        self._require_constraints()
        self = present_system(self)
        flat = self._evaluate_quantity(quantity, q, qdot, t, params)
        return self._split_by_constraint(flat, Layout.from_state(q, qdot), params)

    def _split_by_constraint(self, flat: jax.Array, layout: Layout, params: PyTree) -> PyTree:
        """Return `flat` (m,), a number for each constraint, in the structure of `multipliers`."""
        return name_numbers(flat, self._constraint_structure(layout, params))

    def _constraint_structure(self, layout: Layout, params: PyTree) -> tuple:
        """Return the shapes that the constraint functions return, a tuple of one or two pytrees."""
        return self._role_shapes(self._constraint_roles, layout, params)

    def _role_shapes(self, roles: list[str], layout: Layout, params: PyTree) -> tuple:
        return tuple(self._output_shapes(role, layout, params) for role in roles)

    def _given_roles(self, *roles: str) -> list[str]:
        return [role for role in roles if getattr(self, role) is not None]

    @property
    def _constraint_roles(self) -> list[str]:
        return self._given_roles("constraints", "velocity_constraints")

    @property
    def _contact_roles(self) -> list[str]:
        return self._given_roles("contacts", "one_way")

    @property
    def _multiplier_roles(self) -> list[str]:
        return self._constraint_roles + self._contact_roles

    def constraint_names(self, layout: Layout, params: PyTree) -> list[str]:
        """Return a name for each of the m constraints, such as constraints['rod'] or velocity_constraints[1]."""
        return self._output_names(self._constraint_roles, layout, params)

    def contact_names(self, layout: Layout, params: PyTree) -> tuple[str, ...]:
        """Return a name for each gap and one-way velocity, such as contacts['floor'] or one_way[1]."""
        return tuple(self._output_names(self._contact_roles, layout, params))

    def _output_names(self, roles: list[str], layout: Layout, params: PyTree) -> list[str]:
        names = []
        for role in roles:
            for path, leaf in jax.tree_util.tree_leaves_with_path(self._output_shapes(role, layout, params)):
                label = role + jax.tree_util.keystr(path)
                names += [label + (str(list(index)) if leaf.shape else "") for index in np.ndindex(leaf.shape)]
        return names

    def _required_force(self, q: PyTree, qdot: PyTree, t: Time, params: PyTree, qddot: PyTree) -> tuple:
        """Return the force that gives `qddot`, like `q`, and the index of a constraint that qddot violates, or −1.

        Where it violates one, the forces are NaN.
        """
        layout, _ = Layout.from_state(q, qdot), Layout.from_state(q, qddot, "qddot")
        force, violated = self._evaluate_quantity(Motion.required_force, q, qdot, t, params, qddot=qddot)
        place = jnp.where(violated.any(), jnp.argmax(violated), -1) if violated.size else jnp.array(-1)
        return layout.restore(nan_unless(place < 0, force) if violated.size else force), place.astype(float)

    def _evaluate_quantity(self, quantity: Callable, q, qdot, t, params, restore: bool = False, **more: PyTree):
        """Evaluate a method of `Motion` at a state given as pytrees; with `restore` the result is a pytree like q.

        `more` are further arguments of the method, pytrees like q.
        """
        self, layout = present_system(self), Layout.from_state(q, qdot)
        require_number(t, "t")
        q, qdot, t, more = as_arrays((q, qdot, 1.0 * t, more), layout.dtype, "state")
        params = as_arrays(params, layout.dtype)

        def evaluate_at(self, q, qdot, t, params, more):
            layout = Layout.from_state(q, qdot)
            more = {name: layout.flatten(x) for name, x in more.items()}
            value = self._evaluate_program(quantity, layout, q, qdot, t, params)
            if value is None and quantity is Motion.nearest_consistent:
                numbers, flat = eqx.filter(params, eqx.is_array_like), (layout.flatten(q), layout.flatten(qdot), t)
                terms = derivation_of(self, layout, params).term_sizes(*flat, numbers)
                return _evaluate_motion(self, quantity, q, qdot, t, params, terms=terms)
            return _evaluate_motion(self, quantity, q, qdot, t, params, **more) if value is None else value

        given = self, q, qdot, t, params, more
        # A tracer that a function closes over would be lost in doubles.
        closes = any(f.code.tracers for role in ROLES if isinstance(f := getattr(self, role), Function))
        is_single = layout.dtype == SINGLE and not closes
        value = compute_in_doubles(evaluate_at, *given) if is_single else evaluate_at(*given)
        return jax.tree.map(jnp.asarray, layout.restore(value) if restore else value)

    def _evaluate_program(self, quantity: Callable, layout: Layout, q, qdot, t, params) -> np.ndarray | None:
        """Evaluate a quantity at a concrete state by scalar programs in NumPy; None if traced or on arrays."""
        concrete = all(is_concrete(leaf) for leaf in jax.tree.leaves((self, q, qdot, t, params)))
        if self.path == "array" or quantity not in OF_QUANTITIES or not concrete:
            return None
        names, function = OF_QUANTITIES[quantity]
        q, qdot = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(x)])[None] for x in (q, qdot))
        q, qdot, t = (np.asarray(x, layout.dtype) for x in (q, qdot, t))
        try:
            sample = Sample.from_scene(self, layout, q, qdot, t, params)._replace(scene=None)
            values = sample.quantities(*names)
        except Unlowerable:
            return None
        with np.errstate(all="ignore"):
            return function(values, qdot)[0]

    def _check_outputs(self, layout: Layout, params: PyTree) -> None:
        """Trace each function once, on shapes alone; raise `TypeError` if it returns a wrong structure."""
        for role in ("lagrangian", "dissipation", "forces"):
            if getattr(self, role) is None:
                continue
            try:
                shapes = self._output_shapes(role, layout, params)
            except ValueNotKnown:
                raise
            except (TypeError, KeyError, IndexError, AttributeError) as error:
                # A dict, where it expects a number, speaks of neither.
                of_leaves = list(zip(layout.paths, layout.shapes, strict=True))[:8]
                shown = ", ".join(f"{path} of shape {shape}" for path, shape in of_leaves)
                error.add_note(f"{role} was called with {shown}. Give q, qdot and params the structure that it reads.")
                raise
            _require_structure(shapes, layout) if role == "forces" else _require_scalar(shapes, role)
        roles = self._multiplier_roles if self.reads_multipliers else self._constraint_roles
        shapes = self._role_shapes(roles, layout, params)
        if self._constraint_roles:
            _require_constraints(shapes[: len(self._constraint_roles)])
        _require_own_names(shapes)

    def _output_shapes(self, role: str, layout: Layout, params: PyTree) -> PyTree:
        """Return the shapes that the function of this role returns, traced on shapes alone."""
        numbers, code = eqx.partition(params, eqx.is_array_like)
        function, count = getattr(self, role), len(ARGUMENTS[role])
        state, t = layout.restore(np.zeros(layout.size, layout.dtype)), np.zeros((), layout.dtype)
        more = self.multiplier_shapes(layout, params) if role == "forces" else {}
        return jax.eval_shape(
            lambda q, t, p, more: function(*[q] * count, t=t, params=eqx.combine(p, code), **more),
            state, t, numbers, more,
        )  # fmt: skip

    def multiplier_shapes(self, layout: Layout, params: PyTree) -> dict[str, PyTree]:
        """Return {"multipliers": shapes}, the extra argument of forces that read multipliers; {} for other forces."""
        if not self.reads_multipliers:
            return {}
        trees = self._role_shapes(self._multiplier_roles, layout, params)
        flat = np.zeros(count_numbers(trees), layout.dtype)
        return {"multipliers": jax.eval_shape(lambda x: name_numbers(x, trees), flat)}


def describe_violation(constraint: str) -> str:
    """Return the error message for an acceleration that this constraint does not allow."""
    return (
        f"qddot violates the constraint {constraint}, so that no force brings it about: q̈ has to satisfy G q̈ = γ. The "
        "nearest one that does is the acceleration of this System with forces=lambda q, v: tau, where tau = "
        "inverse_dynamics of the scene without constraints."
    )


def count_numbers(trees: PyTree) -> int:
    """Return the total number of elements of the arrays, or of the shapes, in a pytree."""
    return sum(x.size for x in jax.tree.leaves(trees))


def name_numbers(numbers, trees: tuple) -> PyTree:
    """Split numbers (…, m) into the structures `trees`: one dict if all are dicts, else a tuple of several."""
    leaves, structure = jax.tree.flatten(trees)
    ends = np.cumsum([leaf.size for leaf in leaves])
    pieces = (numbers[..., end - leaf.size : end] for end, leaf in zip(ends, leaves, strict=True))
    shaped = [x.reshape(*x.shape[:-1], *leaf.shape) for x, leaf in zip(pieces, leaves, strict=True)]
    parts = structure.unflatten(shaped)
    if len(parts) == 1:
        return parts[0]
    if not all(isinstance(part, dict) for part in parts):
        return parts
    return {name: x for part in parts for name, x in part.items()}


def _coefficients(contacts, one_way, restitution, friction, slip) -> tuple:
    """Return restitution and friction as functions of params, None without contacts; raise `ValueError`."""
    given = {"restitution": restitution, "friction": friction}
    given = {name: 0.0 if value is None else value for name, value in given.items()}
    if contacts is None:
        some = [name for name, x in given.items() if callable(x) or jax.tree.leaves(x) != [0.0]]
        if slip is not None or some:
            raise ValueError(f"{[*some, 'slip'][0]} is that of contacts: give contacts=..., the gaps, to the System.")
        return (None, None) if one_way is None else (lambda: 0.0, lambda: 0.0)
    for name, value in given.items():
        if not callable(value):
            _require_range(name, value)
    friction = given["friction"]
    rubs = callable(friction) or any(not is_concrete(x) or np.any(x) for x in jax.tree.leaves(friction))
    if rubs and slip is None:
        raise ValueError(
            "friction needs the sliding velocity at every contact: give slip=lambda q, qdot: ... in the structure of "
            "the gaps."
        )
    return tuple(x if callable(x) else _constant_function(x) for x in given.values())


def require_coefficients(system: "System", params: PyTree) -> None:
    """Raise `ValueError` where restitution or friction is out of its range at these params, which are numbers."""
    for name in ("restitution", "friction"):
        if (function := getattr(system, name)) is not None and "params" in function.extras:
            _require_range(name, function(params=params))


def _require_range(name: str, values: PyTree) -> None:
    for value in filter(is_concrete, jax.tree.leaves(values)):
        numbers = np.asarray(value)  # of JAX's own, each comparison would be compiled
        if not np.issubdtype(numbers.dtype, np.number):
            raise TypeError(f"{name} must be a number, a dict of numbers by name, or a function; got {value!r}.")
        if not (np.isfinite(numbers).all() and numbers.min(initial=0.0) >= 0.0):
            raise ValueError(f"{name} must be a number that is not negative; got {value}.")
        if name == "restitution" and numbers.max(initial=0.0) > 1.0:
            raise ValueError(f"restitution must be between 0 and 1: more would add energy; got {value}.")


def _constant_function(value) -> Callable:
    """Return a function without arguments that returns `value`, in its closure, where an `Edition` reads it."""
    return lambda: value


def require_system(system: Any, contacts: bool = False) -> System:
    """Raise `TypeError` if this is no `System`, else return it with the current edition of its functions."""
    # Raises `TypeError` for anything else in its place, a bare Lagrangian most often; and for a scene with contacts,
    # where these would be left out.
    if not isinstance(system, System):
        kind = type(system).__name__
        if kind == "Hybrid":
            raise TypeError(
                "This is for one System: a lagjax.Hybrid is taken by simulate, simulate_batch, crossings, "
                "periodic_orbit, lyapunov_spectrum, fit and sweep."
            )
        name = getattr(system, "__name__", kind) if callable(system) else kind
        raise TypeError(f"system must be a lagjax.System, as lagjax.System(lagrangian) is; got {name}.")
    if system.touches and not contacts:
        raise TypeError(
            "This is for scenes without contacts, which it would leave out: simulate, simulate_batch, crossings, "
            "equilibrium, normal_modes, linearize, periodic_orbit and lyapunov_spectrum take these. For the motion "
            "while none is closed, build the System without contacts=... and one_way=...."
        )
    return present_system(system)


def present_system(system: System) -> System:
    """Return the scene with the current `Edition` of each function; the same object if none has changed."""
    fields = object.__getattribute__(system, "__dict__")  # an attribute of an equinox.Module takes 2 µs
    functions = [fields[role] for role in ROLES]
    now = [present(f) if isinstance(f, Function) else f for f in functions]
    if all(map(operator.is_, functions, now)):
        return system
    return replace_functions(system, dict(zip(ROLES, now, strict=True)))


def replace_functions(system: System, functions: dict[str, Function | None], path: str | None = None) -> System:
    """Return a copy of the scene with other functions by role, without the constructor, which is slow."""
    other, fields = object.__new__(type(system)), object.__getattribute__(system, "__dict__")
    for name, value in (fields | functions | {"path": path or fields["path"]}).items():
        object.__setattr__(other, name, value)
    return other


def drop_contacts(system: System) -> System:
    """The scene without contacts; itself where it has none."""
    names = "contacts", "one_way", "restitution", "friction", "slip"
    return replace_functions(system, dict.fromkeys(names)) if system.touches else system


@eqx.filter_jit
def _evaluate_motion(system: System, quantity: Callable, q, qdot, t, params, **more):
    """Evaluate a method of `Motion` in one jitted program; without `jit` XLA would compile operation by operation."""
    layout = Layout.from_state(q, qdot)
    numbers, derivation = eqx.filter(params, eqx.is_array), derivation_of(system, layout, params)
    motion = derivation.motion if system.path == "array" else lowered_motion(derivation)
    return getattr(motion, quantity.__name__)(layout.flatten(q), layout.flatten(qdot), t, numbers, **more)


def _require_scalar(value: PyTree, role: str) -> None:
    if not isinstance(value, jax.ShapeDtypeStruct):
        raise TypeError(f"{role} must return one scalar; got {value}.")
    if value.shape != ():
        raise TypeError(f"{role} must return one scalar; got an array of shape {value.shape} (a missing sum?).")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"{role} must return a real floating-point number; got {value.dtype}.")


def _require_constraints(structure: tuple) -> None:
    leaves = jax.tree.leaves(structure)
    if not sum(leaf.size for leaf in leaves):
        raise TypeError("constraints must return at least one number that is to be zero.")
    if not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
        raise TypeError("constraints must return real floating-point numbers.")


def _require_own_names(structure: tuple) -> None:
    names = [name for part in structure if isinstance(part, dict) for name in part]
    if shared := sorted({name for name in names if names.count(name) > 1}):
        two = "Two of constraints, velocity_constraints, contacts and one_way"
        raise ValueError(f"{two} have the same name: {', '.join(shared)}.")


def _require_structure(value: PyTree, layout: Layout) -> None:
    leaves, tree = jax.tree.flatten(value)
    shapes = tuple(leaf.shape for leaf in leaves)
    if tree != layout.tree or shapes != layout.shapes:
        raise TypeError(
            f"forces must return the structure of q, one force per coordinate; q is {layout.tree} with shapes "
            f"{layout.shapes}, forces returned {tree} with shapes {shapes}."
        )
    if any(jnp.issubdtype(leaf.dtype, jnp.complexfloating) for leaf in leaves):
        raise TypeError("forces must return real numbers: take jnp.real of what is complex.")
