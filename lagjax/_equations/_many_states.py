"""`Sample`: the quantities of a scene at many states, in NumPy, for tests of a scene or a motion.

They come from the programs of the scene, without compilation. If a scene has none (arrays in its functions, operations
without a scalar form, far too many of them), a `Sample` with the scene itself has XLA compile them; one without raises
`Unlowerable`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._equations._derivation import Derivation, columns_of, derivation_of, numbers_of
from lagjax._equations._linear import factorize, saddle, saddle_many, schur_complements
from lagjax._equations._motion import Motion
from lagjax._equations._sparse import Diagonal, Entries
from lagjax._interface import Layout, halves
from lagjax._program import Unlowerable
from lagjax._tracing import Program

SADDLE = ("mass_matrix", "force", "jacobian", "gamma")  # of M q̈ − Gᵀλ = F, G q̈ = γ
_AT_ONCE = 2**20  # entries of mass matrices that XLA computes side by side, 8 MB: memory grows like their number


class Sample(NamedTuple):
    """A scene at S states: `q`, `qdot` (S, n), `t` () or (S,), and `numbers` of its parameters, () or (S,) each."""

    derivation: Derivation
    q: np.ndarray
    qdot: np.ndarray
    t: Any
    numbers: Sequence
    scene: tuple[Any, PyTree] | None = None  # the system and its parameters, where XLA may evaluate them

    @classmethod
    def from_scene(cls, system: Any, layout: Layout, q, qdot, t, params: PyTree) -> "Sample":
        """States q, q̇ (S, n) of a scene with one set of parameters; XLA evaluates them if the scene has no programs."""
        derivation, numbers = derivation_of(system, layout, params), numbers_of(eqx.filter(params, eqx.is_array_like))
        return cls(derivation, q, qdot, t, numbers, (system, params))

    @classmethod
    def from_states(cls, derivation: Derivation, y: np.ndarray, t, numbers: Sequence | np.ndarray) -> "Sample":
        """A sample of states y = (q, q̇), (S, 2n), of a scene that has programs."""
        return cls(derivation, *halves(y), t, list(numbers))

    @property
    def columns(self) -> list:
        return columns_of(self.q, self.qdot, self.t, self.numbers)

    def quantities(self, *names: str) -> dict[str, np.ndarray]:
        """The quantities of `Motion.quantities` with these names, (S, …) each. Raises `Unlowerable`."""
        try:
            return self.derivation.evaluate(names, self.columns)
        except Unlowerable:
            if self.scene is None:
                raise
        (system, params), layout = self.scene, self.derivation.layout
        q, qdot, t = (jnp.asarray(x, layout.dtype) for x in (self.q, self.qdot, self.t))
        return jax.tree.map(np.asarray, _evaluate_compiled(names, system, layout, q, qdot, t, params))

    def flat(self, *names: str) -> np.ndarray:
        """The `quantities` with these names, flattened and concatenated, (S, outputs)."""
        values = self.quantities(*names)
        return np.concatenate([values[name].reshape(len(self.q), -1) for name in names], axis=1)

    def round_off(self, *names: str) -> dict[str, np.ndarray]:
        """The rounding errors of quantities, (S, …) each. Raises `Unlowerable`."""
        return self.derivation.round_off(names, self.columns)

    def evaluate(self, program: Program) -> np.ndarray:
        """The outputs (S, outputs) of a program of the scene."""
        outputs = program.evaluate_many(self.columns)
        return np.broadcast_to(outputs, (len(outputs), len(self.q))).T

    def acceleration(self) -> np.ndarray:
        """q̈ (S, n) by the same program, or arrays, with which the motion is integrated. Raises `Unlowerable`."""
        if self.derivation.form.is_sparse:
            return self.quantities("acceleration")["acceleration"]
        return self.evaluate(self.derivation.accelerations.program)[:, : self.derivation.layout.size]

    def momenta_by_q(self, momenta: tuple[int, ...]) -> np.ndarray:
        """∂pᵢ/∂q of the coordinates i in `momenta`, (S, len(momenta), n)."""
        shape = len(self.q), len(momenta), self.derivation.layout.size
        if not momenta:
            return np.zeros(shape, self.q.dtype)
        return self.evaluate(self.derivation.momenta_by_q(momenta)).reshape(shape)

    def evaluate_in_parts(self, function: Callable, size: int, *more):
        """`function(sample, *more)` on chunks of at most `size` states; `more` are arrays (S,), or numbers for all."""

        def cut(x, start):
            return x if np.ndim(x) == 0 else x[start : start + size]

        parts = []
        for start in range(0, len(self.q), size):
            q, qdot, t, *others = (cut(x, start) for x in (self.q, self.qdot, self.t, *more))
            part = self._replace(q=q, qdot=qdot, t=t, numbers=[cut(x, start) for x in self.numbers])
            parts.append(function(part, *others))
        return parts[0] if len(parts) == 1 else jax.tree.map(lambda *some: np.concatenate(some), *parts)

    def pieces(self) -> np.ndarray:
        """A number (S,) that differs between states where the accelerations are on different pieces."""
        borders = borders_of(self.derivation)
        if borders is None:
            return np.zeros(len(self.q))
        flags = np.zeros(2 * len(borders.switches))
        found = borders.decide.evaluate([*self.columns, *flags])
        return np.sqrt(np.arange(2, 2 + len(found))) @ np.where(np.isfinite(found), found, 0.5)


def borders_of(derivation: Derivation):
    """The borders of the accelerations; None if they are smooth, or the scene has no programs."""
    try:
        borders = derivation.borders
    except Unlowerable:
        return None
    return borders if borders is not None and borders.switches else None


@np.errstate(all="ignore")
def solve_saddle(of: dict[str, Any]) -> tuple[Any, Any]:
    """q̈ and λ from the quantities `SADDLE`, of many states in NumPy or one in JAX; a large scene has its own."""
    if "mass_matrix" not in of:
        return of["acceleration"], of["multipliers"]
    matrix, b, jacobian, c = (of[name] for name in SADDLE)
    if isinstance(b, np.ndarray):
        x, multipliers = saddle_many(matrix, b[:, :, None], jacobian, c[:, :, None])
        return x[:, :, 0], multipliers[:, :, 0]
    return saddle(matrix, b, jacobian, c)[:2] if c.size else (factorize(matrix).solve(b), c)


_OF_SCHUR, _OF_ENERGY = ("mass_matrix", "jacobian"), ("lagrangian", "momentum")
# The functions of `Motion` in terms of `Motion.quantities` and q̇ (S, n) at S states: which of them, and the formula.
OF_QUANTITIES: dict[Callable, tuple[tuple[str, ...], Callable]] = {
    Motion.acceleration: (SADDLE, lambda of, v: solve_saddle(of)[0]),
    Motion.multipliers: (SADDLE, lambda of, v: solve_saddle(of)[1]),
    Motion.constraint_force: (SADDLE, lambda of, v: np.einsum("skn,sk->sn", of["jacobian"], solve_saddle(of)[1])),
    Motion.schur_complement: (_OF_SCHUR, lambda of, v: schur_complements(of["mass_matrix"], of["jacobian"])),
    Motion.mass_matrix: (("mass_matrix",), lambda of, v: of["mass_matrix"]),
    Motion.momentum: (("momentum",), lambda of, v: of["momentum"]),
    Motion.generalized_force: (("generalized_force",), lambda of, v: of["generalized_force"]),
    Motion.residual: (("residual",), lambda of, v: of["residual"]),
    Motion.energy: (_OF_ENERGY, lambda of, v: np.einsum("si,si->s", of["momentum"], v) - of["lagrangian"]),
}


@eqx.filter_jit
def _evaluate_compiled(names: tuple[str, ...], system: Any, layout: Layout, q, qdot, t, params) -> dict[str, jax.Array]:
    derivation, numbers = derivation_of(system, layout, params), eqx.filter(params, eqx.is_array_like)
    motion = derivation.motion

    def quantities_at(q, qdot, t):
        values = motion.quantities(q, qdot, t, numbers)
        return {name: values[name] for name in names}

    if len(q) == 1:
        return jax.tree.map(lambda x: x[None], quantities_at(q[0], qdot[0], jnp.ravel(t)[0]))
    size = numbers_of_state(derivation)
    return map_in_chunks(quantities_at, (q, qdot, jnp.broadcast_to(t, len(q))), _AT_ONCE // size)


def numbers_of_state(derivation: Derivation) -> int:
    """The number of entries in the quantities of one state: n², or n for a sparse scene."""
    return derivation.layout.size ** (1 if derivation.form.is_sparse else 2)


def map_in_chunks(function, arrays, size: int):
    """`function` mapped over the states in `arrays`, at most `size` of them at a time."""
    count = len(arrays[0])
    size = max(1, min(size, count))
    missing = -count % size
    padded = [jnp.concatenate([x, jnp.broadcast_to(x[-1:], (missing, *x.shape[1:]))]) for x in arrays]
    chunks = [x.reshape(-1, size, *x.shape[1:]) for x in padded]
    values = jax.lax.map(lambda chunk: jax.vmap(function)(*chunk), chunks)
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * size, *x.shape[2:])[:count], values)


def sparse_spectrum(derivation: Derivation, state: tuple) -> tuple | None:
    """The eigenvalues of the scaled M of a large scene that are nearest to zero, lowest, and largest in size.

    The first two come with their eigenvectors in coordinates. None if the pattern of M is unknown. For a diagonal M
    they are exact, else good to a hundredth, by Lanczos' method (Lehoucq, Sorensen & Yang, *ARPACK Users' Guide*,
    1998).
    """
    from scipy.sparse import csc_array, eye_array
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, splu

    form = derivation.form.mass
    if not isinstance(form, Entries):
        return None
    entries = np.asarray(_mass_entries(derivation.motion, form, *state))
    diagonal = np.abs(entries[form.on_diagonal])
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, np.abs(entries).max(initial=0) or 1))
    scaled: Any = csc_array((scale[form.rows] * entries * scale[form.columns], (form.rows, form.columns)))
    if isinstance(form, Diagonal):
        values = scaled.diagonal()
        i, k = np.argmin(np.abs(values)), np.argmin(values)
        unit = np.eye(1, len(values))[0]
        return (values[i], np.roll(unit, i)), (values[k], np.roll(unit, k)), np.abs(values).max()
    start, size = np.cos(np.arange(1.0, len(diagonal) + 1)), np.abs(scaled).sum(axis=0).max()
    regular = csc_array(scaled + np.finfo(float).eps * size * eye_array(len(diagonal)))  # to rounding, where M is not
    inverse = LinearOperator(scaled.shape, splu(regular).solve)
    options = {"k": 1, "v0": start, "tol": 1e-2}
    try:
        near, lowest = eigsh(scaled, sigma=0.0, OPinv=inverse, **options), eigsh(scaled, which="SA", **options)
        largest = eigsh(scaled, which="LM", return_eigenvectors=False, **options)[0]
    except ArpackNoConvergence:
        return None
    return *((values[0], scale * vectors[:, 0]) for values, vectors in (near, lowest)), abs(largest)


@partial(jax.jit, static_argnums=(0, 1))
def _mass_entries(motion: Motion, form: Entries, *state) -> jax.Array:
    return form.read(motion.mass_product(*state), state[0].dtype)
