"""`conserved_quantities`: the symmetries of L among given transformations, and their conserved quantities.

A change Λ of L is some dG(q, t)/dt if and only if its Euler–Lagrange expression is zero, whatever q, q̇ and q̈ are. Λ
is linear in the transformation, so symmetries are the null space of a matrix: a column for each transformation, rows
for the expression of each coordinate at random states, and for the work of forces and constraints. No G need be
guessed.

    random states ─► columns ─► null space ─► named ones, then the rest ─► verified on the motion at fresh states
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax._analysis._gauge import changes_of, gauge_of, verify_gauge
from lagjax._analysis._noether import FlatState, charge_at, euler_lagrange, flat_generator, variation
from lagjax._analysis._potential import absorb_potential_forces
from lagjax._analysis._random_states import perturb_last_digits, random_states
from lagjax._analysis._scene_state import SceneState, require_matrices
from lagjax._analysis._transformations import Fields, fields_of, textbook_symmetries
from lagjax._equations import echelon_form, span_outside, truncated_svd
from lagjax._interface import Layout, accept, compile_for_one_call, show_str
from lagjax._primitives import accepts_singles
from lagjax._run import Trajectory
from lagjax._scene import System

# Singular values of the columns, which are of order one, below which a combination is a symmetry. Rounding leaves some
# 1e-15 of the terms, and as much of what numbers of a scene are made of (a mass that is 0.1 · 3). What breaks a
# symmetry by less than this part is not seen. Halved, it would come within ten of what the ready scenes leave.
_NULL = 1e-13
# Where terms cancel inside of L rounding leaves more: this many times what it is seen to leave. A broken symmetry is
# off by the same at a state and a few units in its last place beside it; one that holds is off by chance.
_CHANCE = 30.0
_LARGEST_REST = 1e-8  # part of L that may be left: beyond, nothing is told from rounding, and none is reported
_SLACK = 100.0  # times as much may be left of a symmetry at fresh states: the largest of many, not their mean
_NEARLY = 1e-6  # is left of a near symmetry, at most: relativity in the solar system breaks those of Newton by 1e-8


class Conserved(NamedTuple):
    """A quantity that is constant along the motions of a scene.

    - `name`: what it is called; "combination: …" with its parts where it has no name.
    - `charge`: the function `charge(q, qdot, t=0.0, params=None)`, a scalar.
    - `gauge`: the function G(q, t=0.0, params=None) where L changes by dG/dt under the symmetry; None where it does not
      change.
    """

    name: str
    charge: Callable
    gauge: Callable | None

    def drift(self, trajectory: Trajectory) -> Float[Array, "..."]:
        """max |I(t) − I(0)| over a trajectory (), or for each member of a batch, in the units of the charge."""

        def member_drift(q, qdot, times, params, mode):
            values = jax.vmap(self.charge, in_axes=(0, 0, 0, None))(q, qdot, times[0], params)
            return jnp.max(jnp.abs(values - values[0]))

        return trajectory.map_members(member_drift)

    def __repr__(self) -> str:
        return f"Conserved({self.name!r}{'' if self.gauge is None else ', with a gauge term'})"


class ConservedQuantities(list[Conserved]):
    """A list of `Conserved`.

    - `notes`: sentences about symmetries of L that conserve nothing, and about those that nearly hold.
    - `threshold`: what breaks a symmetry by less than this part of the terms of L could not be told from rounding.
    """

    def __init__(self, quantities: list[Conserved], notes: tuple[str, ...] = (), threshold: float = 0.0):
        super().__init__(quantities)
        self.notes, self.threshold = notes, threshold

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        rows = [f"{c.name}{'' if c.gauge is None else ' (with a gauge term)'}" for c in self]
        rows = rows or ["no symmetry among the transformations that were tried"]
        resolution = f"(what breaks a symmetry by less than {self.threshold:.0e} of L's terms would not be seen)"
        return "\n".join([*rows, *self.notes, resolution])

    def report(self, trajectory: Trajectory) -> str:
        """The drift of each quantity along a trajectory, a line each; the worst member of a batch."""
        rows = [f"{'conserved':40s} {'largest drift':>14s}"]
        rows += [f"{c.name[:40]:40s} {float(jnp.max(c.drift(trajectory))):14.2e}" for c in self]
        return "\n".join(rows)


@accepts_singles(("q", "qdot"), ("params",))
def conserved_quantities(
    system: System,
    q: PyTree,
    qdot: PyTree,
    params: PyTree = None,
    *,
    generators: dict[str, Callable] | None = None,
    seed: int = 0,
) -> ConservedQuantities:
    r"""The quantities that `system` conserves by symmetries of its Lagrangian, found from L alone.

    All linear combinations of these point transformations are tried,

        ξ = b + c t + A q,   τ = α + β t     (translations, boosts, rotations, scalings, the time)

    together with `generators`. A is any matrix for up to 12 coordinates; beyond, the rotations and scalings of each
    leaf. A transformation is a symmetry where it changes L by some dG(q, t)/dt, and neither forces nor constraints do
    work on it. Forces that have a potential count as part of L: the energy contains their work from the state that is
    given, NaN where that is not resolved. Energy, momenta, angular momenta and the like come first, under these names;
    what is left comes as combinations ("translation of z, rotation": a helix). Each is verified at new random states.
    What a symmetry may leave there is told from rounding by how it differs between states a few units in the last place
    apart; the `threshold` of the result says what would not be seen. A symmetry that is broken by less than a millionth
    is named in the notes ("nearly conserved").

    - `q`, `qdot`: a state of numbers, not traced. The random states are drawn about it, as far as the size of its
      numbers and the forces there suggest, in any units; nothing else about it matters.
    - `params`: the parameters at which symmetries are sought.
    - `generators`: the user's own by name, as `noether_charge` takes them.
    - `seed`: of the random states.

    Conserved quantities that come from no point symmetry are not found: the Laplace–Runge–Lenz vector of Kepler's
    problem, the third integral of Toda's chain. In coordinates that are not Cartesian, rotations are not linear: those
    along a cyclic angle are found; for others give generators.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, a generator of the wrong structure, or
    where L is not finite about the state.

    Source: Olver, *Applications of Lie Groups to Differential Equations*, §4.4 (variational symmetries), §5.3.

    ```python
    import jax.numpy as jnp, lagjax

    kepler = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) + 1 / jnp.sqrt(jnp.sum(q**2)))
    print(lagjax.conserved_quantities(kepler, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.2])))  # energy, angular momentum
    ```
    """
    require_matrices(
        sum(map(np.size, jax.tree.leaves(q))),
        "A search for symmetries",
        "Which coordinates are cyclic, cyclic_coordinates(system, q, qdot, params) tells; of a symmetry that you know, "
        "noether_charge(system, generator) is what it conserves, as the total momentum by a generator of ones.",
    )
    scene = SceneState.from_state(system, q, qdot, params)
    if not scene.concrete:
        raise ValueError("conserved_quantities looks at numbers: call it outside of jit, vmap and grad, on one state.")
    piecewise, scales = scene.piecewise, scene.scales
    fields = fields_of(scene.layout, scales.q, scales.t, _flatten_generators(generators, scene.layout))
    count = 8 + 4 * fields.count // scene.layout.size
    here, fresh = (random_states(scene, scales, count, seed + k, piecewise) for k in range(2))
    scene = absorb_potential_forces(scene, scales, here)
    measured = _measure_columns(scene, fields, here)
    known, names = textbook_symmetries(scene.layout, fields), scene.layout.names
    space = measured.symmetries(measured.of_lagrangian, measured.of_others)
    verified = _measure_columns(scene, fields, fresh)
    rows, left = np.concatenate([verified.of_lagrangian, verified.of_others]), _SLACK * verified.threshold
    basis = _choose_basis(space, known, fields, names)
    chosen = [(name, w) for name, w in basis if np.abs(rows @ w).max() <= left * np.abs(w).max()]
    quantities, notes = _conserved_quantities(scene, fields, chosen, fresh)
    found = {name for name, _ in chosen}
    if measured.of_others.size:
        of_lagrangian = _choose_basis(measured.symmetries(measured.of_lagrangian), known, fields, names)
        broken = [name for name, _ in of_lagrangian if name not in found and not name.startswith(_DEPENDENT)]
        notes += [f"not conserved: {name}, by a symmetry of L that a force or a constraint breaks" for name in broken]
    notes += _approximate_symmetries(measured, space, known)
    if piecewise:
        notes.append("L or a force is piecewise: beyond borders farther off than states were drawn nothing was tested")
    return ConservedQuantities(quantities, tuple(notes), measured.threshold)


def _approximate_symmetries(
    measured: "_SymmetryColumns", space: np.ndarray, known: list[tuple[str, np.ndarray]]
) -> list[str]:
    """Return a sentence for each transformation in `known` that is broken by less than `_NEARLY`."""
    rows, taken, notes = np.concatenate([measured.of_lagrangian, measured.of_others]), space, []
    for name, weights in known:
        unit = weights / np.linalg.norm(weights)
        part = np.sqrt(np.mean((rows @ unit) ** 2))
        if not measured.threshold < part <= _NEARLY or np.linalg.norm(unit - taken @ (taken.T @ unit)) <= 1e-7:
            continue
        taken = np.linalg.qr(np.column_stack([taken, unit]))[0]
        notes.append(f"nearly conserved: {name}, by a symmetry that {part:.1g} of the terms of L break")
    return notes


_COMBINATION, _SHOWN = "combination: ", 6  # and how many parts of one are named
# Names of what is given only where it is no function of other quantities, as it is for free particles.
_DEPENDENT = (_COMBINATION, "dilation")


class _SymmetryColumns(NamedTuple):
    """The matrix of the changes of L, and of forces and constraints, (rows, K) each, and its rounding error."""

    of_lagrangian: np.ndarray
    of_others: np.ndarray
    threshold: float

    def symmetries(self, *columns: np.ndarray) -> np.ndarray:
        """Return an orthonormal basis (K, d) of the null space of these columns."""
        rows = np.concatenate(columns)
        return truncated_svd(rows, absolute=self.threshold * np.sqrt(len(rows))).null


def _measure_columns(scene: SceneState, fields: Fields, states: FlatState) -> _SymmetryColumns:
    """Return the finite rows of the matrix, and their rounding error, from nearly equal states."""
    both = states, perturb_last_digits(states)
    here, beside = (
        _select_finite_rows(*map(np.asarray, _symmetry_columns(fields, at, *scene.arguments))) for at in both
    )
    pairs = [(a, b) for a, b in zip(here, beside, strict=True) if a.size and a.shape == b.shape]
    noise = max((float(np.sqrt(np.mean((a - b) ** 2))) for a, b in pairs), default=0.0)
    return _SymmetryColumns(*here, min(max(_NULL, _CHANCE * noise), _LARGEST_REST))


def _flatten_generators(generators, layout: Layout) -> dict[str, Callable]:
    if generators is None:
        return {}
    if not isinstance(generators, dict):
        raise TypeError(f"generators must be a dict of functions by name; got {type(generators).__name__}.")
    return {name: flat_generator(accept(f, f"generators[{name!r}]", ("q",)), layout) for name, f in generators.items()}


# ---- the columns -----------------------------------------------------------------------------------------------------


@compile_for_one_call
def _symmetry_columns(fields: Fields, states: FlatState, *arguments) -> tuple[Array, Array]:
    """Return the change by each of K transformations at S states: of L (S, n, K), of forces, constraints (S, r, K).

    Both are relative to the terms that would have to cancel: of order one unless there is a symmetry.
    """
    scene = SceneState.from_arguments(*arguments)

    def expressions_at(state):
        def expression(weights):
            transform = fields.combine(weights, scene.params)
            rate, by_q = euler_lagrange(lambda *y: variation(scene, transform, *y), state)
            return rate - by_q, _work_and_drift(scene, transform, state)

        none, each = jnp.zeros(fields.count, state.q.dtype), jnp.eye(fields.count, dtype=state.q.dtype)
        of_l, of_others = jax.vmap(jax.linearize(expression, none)[1], out_axes=-1)(each)
        return of_l, of_others, sum(map(jnp.abs, euler_lagrange(scene.lagrangian, state)))

    of_l, of_others, terms = jax.lax.map(expressions_at, states)
    size = jnp.sqrt(jnp.nanmean(terms**2, axis=0))[:, None]
    others = jnp.nanmax(jnp.abs(of_others), axis=(0, 2), initial=0)[:, None]
    return of_l / jnp.where(size > 0, size, 1), of_others / jnp.where(others > 0, others, 1)


def _work_and_drift(scene: SceneState, transform: Callable, state: FlatState) -> Array:
    """Return the work of forces on ξ − q̇ τ, (1,) or (0,), and the rates (m,) of change of the constraints."""
    (change, of_time), place = transform(state.q, state.t), (state.q, state.qdot, state.t, scene.numbers)
    moved = change - state.qdot * of_time
    rows = [jnp.zeros(0, state.q.dtype)]
    if scene.motion.forces is not None or scene.motion.dissipation is not None:
        rows.append((scene.motion.nonconservative_force(*place) @ moved)[None])
    if scene.constrained:
        rows.append(scene.motion.constraints.jacobian(*place) @ moved)
    return jnp.concatenate(rows)


def _select_finite_rows(of_lagrangian: np.ndarray, of_others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (rows, K) of finite states; raise `ValueError` if there are too few."""
    well = np.asarray(np.isfinite(of_lagrangian).all(axis=(1, 2)) & np.isfinite(of_others).all(axis=(1, 2)))
    if well.sum() < max(4, len(well) // 4):
        raise ValueError(
            "The Lagrangian, or a derivative of it, is not finite at most states about (q, qdot): give a state in the "
            "middle of where motions take place."
        )
    count = of_lagrangian.shape[-1]
    return of_lagrangian[well].reshape(-1, count), of_others[well].reshape(-1, count)


# ---- the null space --------------------------------------------------------------------------------------------------


def _choose_basis(
    space: np.ndarray, known: list[tuple[str, np.ndarray]], fields: Fields, names: tuple[str, ...]
) -> list[tuple[str, np.ndarray]]:
    """Return a basis of `space`: the vectors of `known` that lie in it, then combinations of few parts."""
    chosen, taken = [], np.zeros((len(space), 0))
    for name, weights in known:
        unit = weights / np.linalg.norm(weights)
        if np.linalg.norm(unit - space @ (space.T @ unit)) > 1e-7:
            continue
        new = unit - taken @ (taken.T @ unit)
        if np.linalg.norm(new) > 1e-7:
            taken = np.column_stack([taken, new / np.linalg.norm(new)])
            chosen.append((name, weights))
    rest = span_outside(space, taken)
    return chosen + [(_describe_combination(row, fields, names), row) for row in echelon_form(rest.T)]


def _normalise_weights(weights: np.ndarray, fields: Fields) -> np.ndarray:
    """Scale the weights so that in the user's units the largest entry of α, b, c, A, β is 1."""
    return weights / max(np.abs(x).max(initial=0) for x in _restore_units(weights, fields))


def _restore_units(weights: np.ndarray, fields: Fields) -> tuple:
    """Convert weights (K,) to the user's units: α, b (n,), c (n,), A (n, n), β, and those of the user's generators."""
    alpha, b, c, of_maps, beta, own = fields.split_weights(weights)
    shift, drift = b * fields.scale, c * fields.scale / fields.time
    return alpha * fields.time, shift, drift, np.tensordot(of_maps, fields.matrices, 1), beta, own


def _describe_combination(weights: np.ndarray, fields: Fields, names: tuple[str, ...]) -> str:
    """Return the six largest parts of a combination as text, relative to the sizes of coordinates."""
    alpha, b, c, a, beta, own = _restore_units(_normalise_weights(weights, fields), fields)
    scale, time = fields.scale, fields.time
    parts = [(alpha, 1 / time, "time translation"), (beta, 1.0, "scaling of the time")]
    parts += [(x, 1 / one, f"translation of {name}") for x, one, name in zip(b, scale, names, strict=True)]
    parts += [(x, time / one, f"boost of {name}") for x, one, name in zip(c, scale, names, strict=True)]
    parts += [(x, 1.0, name) for x, name in zip(own, fields.names[len(fields.names) - len(own) :], strict=True)]
    for i in range(len(a)):
        parts.append((a[i, i], 1.0, f"scaling of {names[i]}"))
        for j in range(i):
            if abs(a[i, j] + a[j, i]) < 1e-9 * abs(a[i, j]):
                parts.append((a[i, j], scale[j] / scale[i], f"rotation from {names[j]} to {names[i]}"))
            else:
                parts.append((a[i, j], scale[j] / scale[i], f"d{names[i]} = {names[j]}"))
                parts.append((a[j, i], scale[i] / scale[j], f"d{names[j]} = {names[i]}"))
    parts = [part for part in parts if part[0] != 0]
    least = sorted((abs(x) * unit for x, unit, _ in parts), reverse=True)[:_SHOWN][-1]
    shown = [f"{x:+.6g} {name}" for x, unit, name in parts if abs(x) * unit >= least]
    return _COMBINATION + ", ".join(shown[:_SHOWN]) + (", …" if len(parts) > _SHOWN else "")


# ---- the charge ------------------------------------------------------------------------------------------------------


def _conserved_quantities(
    scene: SceneState, fields: Fields, chosen: list, states: FlatState
) -> tuple[list[Conserved], list[str]]:
    """Return the conserved quantities of the chosen symmetries, and notes on those without one."""
    quantities, notes = [], []
    if not chosen:
        return quantities, notes
    names, weights = [name for name, _ in chosen], np.array([_normalise_weights(w, fields) for _, w in chosen])
    changes, states = changes_of(scene, fields, weights, states)
    for k in _select_independent_charges(names, changes.gradients):
        gauge = gauge_of(scene, fields, weights[k], k, changes)
        if gauge is None or verify_gauge(gauge, scene, fields, k, changes, states):
            quantities.append(Conserved(names[k], _noether_charge(scene, fields, weights[k], gauge), gauge))
        else:
            notes.append(f"not given: {names[k]}, by a symmetry whose gauge term could not be integrated")
    return quantities, notes


def _select_independent_charges(names: list[str], gradients: np.ndarray) -> list[int]:
    """Return the indices of independent charges among D with these gradients (S, D, 2n).

    Combinations and dilations are dropped if their gradients lie in the span of the others at every state.
    """
    kept = [k for k, name in enumerate(names) if not name.startswith(_DEPENDENT)]
    for k in range(len(names)):
        if k not in kept and any(_independent_fraction(of_state[kept], of_state[k]) > 1e-6 for of_state in gradients):
            kept.append(k)
    return kept


def _independent_fraction(rows: np.ndarray, row: np.ndarray) -> float:
    """Return the fraction, 0 to 1, of the length of `row` (2n,) that is orthogonal to the span of `rows` (k, 2n)."""
    size = np.linalg.norm(row)
    if not len(rows) or size == 0:
        return float(size > 0)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    decided = truncated_svd(rows / np.where(lengths > 0, lengths, 1), 1e-9)
    basis = decided.right[:, : int(decided.rank)]
    return float(np.linalg.norm(row - basis @ (basis.T @ row)) / size)


def _noether_charge(scene: SceneState, fields: Fields, weights: np.ndarray, gauge: Callable | None) -> Callable:
    """Return the function p·ξ − h τ − G of the symmetry with these weights (K,)."""
    system, layout = scene.system, scene.layout

    @accepts_singles(("q", "qdot"), ("t", "params"))
    def charge(q, qdot, t=0.0, params=None):
        numbers = eqx.filter(params, eqx.is_array_like)
        state = layout.flatten(q), layout.flatten(qdot), jnp.asarray(t, layout.dtype), numbers
        transform = fields.combine(jnp.asarray(weights, layout.dtype), params)
        value = charge_at(system._motion(layout, params), transform, *state)
        return value if gauge is None else value - gauge(q, t, params)

    return charge
