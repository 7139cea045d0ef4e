"""`SceneState`: a scene with its state and parameters as flat arrays, the input of every analysis."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax._engine.taylor import lowered_motion
from lagjax._equations import (
    Derivation,
    MatrixFree,
    Motion,
    Sample,
    Scales,
    borders_of,
    derivation_of,
    forms,
    has_constraints,
    list_decisions,
)
from lagjax._interface import Layout, as_arrays, is_concrete, require_finite
from lagjax._scene import ROLES, System, replace_functions, require_system

Vector = Float[Array, " n"]


def require_matrices(size: int, what: str, advice: str) -> None:
    """Raise `ValueError`, with the `advice`, if `what` needs dense matrices too large for `size` coordinates."""
    if size > forms.LARGEST_ANALYSED:
        raise ValueError(
            f"{what}: not tried for {size} coordinates, which takes matrices of n × n numbers, {8e-9 * size**2:.2g} GB "
            f"each, and some n³ operations. {advice}"
        )


# Roundings of L by which it may change with the signs of velocities: most terms that are even are so exactly.
_ODD = 1e3


class SceneState(NamedTuple):
    """A scene at one state, with its equations as functions of vectors."""

    system: System
    layout: Layout
    motion: Motion
    derivation: Derivation
    q: Vector
    qdot: Vector
    params: PyTree  # as the user gave them, of arrays
    numbers: PyTree  # the numbers among them

    @classmethod
    def from_state(
        cls, system: System, q: PyTree, qdot: PyTree | None, params: PyTree, sparse: bool = False
    ) -> "SceneState":
        """Return the scene at (q, qdot), at rest if `qdot` is None; with `sparse` a large scene stays on arrays."""
        system = require_system(system)
        rest = jax.tree.map(lambda x: jnp.zeros_like(jnp.asarray(x, float)), q) if qdot is None else qdot
        layout = Layout.from_state(q, rest)
        require_finite(q, "q")
        require_finite(rest, "qdot")
        _require_no_velocities(system, q, params)
        state = layout, layout.flatten(q), layout.flatten(rest), as_arrays(params, layout.dtype)
        if sparse and layout.size > forms.LARGEST_ANALYSED_DENSE and system.path == "auto":
            scene = cls.from_arguments(replace_functions(system, {}, "array"), *state)
            if scene.large:
                return scene
        return cls.from_arguments(system, *state)

    @classmethod
    def from_arguments(cls, system: System, layout: Layout, q: Vector, qdot: Vector, params: PyTree) -> "SceneState":
        """Return the scene at the flat state q, q̇ (n,), for use inside a compiled function."""
        derivation = derivation_of(system, layout, params)
        motion = derivation.motion if system.path == "array" else lowered_motion(derivation)
        return cls(system, layout, motion, derivation, q, qdot, params, eqx.filter(params, eqx.is_array_like))

    @property
    def arguments(self) -> tuple:
        return self.system, self.layout, self.q, self.qdot, self.params

    @property
    def concrete(self) -> bool:
        return all(is_concrete(leaf) for leaf in jax.tree.leaves((self.system, self.q, self.qdot, self.numbers)))

    @property
    def large(self) -> bool:
        """True if dense n × n matrices are avoided, because those of the scene are sparse."""
        form = self.derivation.form
        if not form.is_sparse or isinstance(form.mass, MatrixFree) or self.layout.size <= forms.LARGEST_ANALYSED_DENSE:
            return False
        return not list_decisions(self.motion.functions, *self.derivation.state_shapes)

    @property
    def constrained(self) -> bool:
        return has_constraints(self.system)

    @property
    def piecewise(self) -> bool:
        return borders_of(self.derivation) is not None

    def require_autonomous(self, what: str) -> None:
        asking = [role for role in ROLES if (f := getattr(self.system, role)) is not None and "t" in f.extras]
        if not asking:
            return
        terms = self.derivation.terms
        if terms is None or 2 * self.layout.size in terms.find_inputs(range(len(terms.line.outputs))):
            raise ValueError(
                f"{what} is for a scene that does not depend on the time, but {', '.join(asking)} of this one reads t. "
                "Where a drive turns or moves uniformly, write L in coordinates that move with it."
            )

    @property
    def conserved(self) -> tuple[int, ...]:
        """The coordinates that no function depends on and no force acts on, read off the scene's programs."""
        n = self.layout.size
        if self.derivation.form.is_sparse:
            acts = self.constrained or self.motion.forces is not None or self.motion.dissipation is not None
            return () if acts else self.derivation.unread or ()
        if (terms := self.derivation.terms) is None:
            return ()
        read, held = (terms.find_inputs(range(first, len(terms.line.outputs))) for first in (0, n + 1))
        return tuple(i for i in range(n) if terms.line.constant(1 + i) == 0 and i not in read and n + i not in held)

    @property
    def reversible(self) -> bool:
        """True if only L acts and is even in velocities, at random states and parameters: a guess to verify."""
        motion, n = self.motion, self.layout.size
        acting = motion.forces, motion.dissipation, self.system.velocity_constraints
        if any(function is not None for function in acting) or (terms := self.derivation.terms) is None:
            return False
        draws = np.random.default_rng(1).uniform(0.3, 1.2, (3, len(self.derivation.scalar_shapes)))
        draws = draws.astype(self.layout.dtype)
        signs = np.where((np.arange(draws.shape[1]) // n) == 1, -1, 1).astype(draws.dtype)
        with np.errstate(all="ignore"):
            ahead, behind = (terms.evaluate_many((sign * draws).T)[0] for sign in (1, signs))
            even = np.abs(ahead - behind) <= _ODD * np.finfo(ahead.dtype).eps * np.abs(ahead)
        known = np.isfinite(ahead)
        return bool(known.any() and even[known].all())

    @property
    def scales(self) -> Scales:
        """The sizes of coordinates, velocities and the time; the scene must not be traced."""

        def evaluated(name, q, qdot):
            if name == "mass_matrix" and self.derivation.form.is_sparse:  # of which the diagonal alone is read
                n, state = self.layout.size, (self.q, self.qdot, jnp.zeros((), self.q.dtype), self.numbers)
                return np.broadcast_to(1 / np.asarray(jax.jit(self.motion.unit)(*state)) ** 2, (1, n, n))
            return Sample.from_scene(self.system, self.layout, q, qdot, 0.0, self.params).quantities(name)[name]

        return Scales.from_quantities(evaluated, np.asarray(self.q), np.asarray(self.qdot))

    def lagrangian(self, q: Vector, qdot: Vector, t) -> Float[Array, ""]:
        return self.motion.lagrangian(q, qdot, t, self.numbers)

    # ---- quantities at a state (q, q̇) and the time zero ----

    def force(self, q: Vector, qdot: Vector) -> Vector:
        """Return F (n,) of M q̈ = F + Gᵀλ."""
        return -self._unbalanced_force(q, qdot, jnp.zeros_like(q))

    def mass_matrix(self, q: Vector, qdot: Vector) -> Float[Array, "n n"]:
        _, product = jax.linearize(lambda qddot: self._unbalanced_force(q, qdot, qddot), jnp.zeros_like(q))
        return jax.vmap(product, out_axes=1)(jnp.eye(q.size, dtype=q.dtype))

    def _unbalanced_force(self, q: Vector, qdot: Vector, qddot: Vector) -> Vector:
        return self.motion.unbalanced_force(q, qdot, qddot, jnp.zeros((), q.dtype), self.numbers)

    def jacobian(self, q: Vector, qdot: Vector) -> Float[Array, "m n"]:
        """Return G (m, n) of the m constraints."""
        return self.motion.constraints.jacobian(q, qdot, jnp.zeros((), q.dtype), self.numbers)

    def position_constraints(self, q: Vector) -> Float[Array, " k"]:
        """Return f (k,) of the constraints f = 0."""
        return self.motion.constraints.f(q, jnp.zeros((), q.dtype), self.numbers)


def _require_no_velocities(system: System, q: PyTree, params: PyTree) -> None:
    """Raise `ValueError` if params look like velocities, and no function of the scene takes params."""
    functions = [getattr(system, role) for role in ROLES]
    if params is None or any("params" in function.extras for function in functions if function is not None):
        return
    if jax.tree.map(jnp.shape, params) == jax.tree.map(jnp.shape, q):
        raise ValueError(
            "No function of this system asks for params, and those given are like q: name velocities, qdot=…."
        )
