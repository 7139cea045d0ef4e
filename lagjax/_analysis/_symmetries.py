"""`conserved_quantities`: which transformations are symmetries of L, and what they conserve.

A change Λ of L is some dG(q, t)/dt if and only if its Euler–Lagrange expression is zero, whatever q, q̇ and q̈ are. Λ is
linear in the transformation, so symmetries are the null space of a matrix: a column for each transformation, rows for
the expression of each coordinate at random states, and for the work of forces and constraints. No G need be guessed.

    random states ─► columns ─► null space ─► named ones, then the rest ─► verified on the motion at fresh states
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lagjax._analysis._fields import Fields, fields_of, named
from lagjax._analysis._gauge import changes_of, gauge_of, is_right
from lagjax._analysis._noether import State, euler_lagrange, flat_generator, variation
from lagjax._analysis._scene import Scene, spread
from lagjax._arguments import accept
from lagjax._display import as_printed
from lagjax._layout import Layout
from lagjax._system import System
from lagjax._trajectory import Trajectory

PyTree = Any

# Singular values of the columns, which are of order one, below which a combination is a symmetry. Rounding leaves some
# 1e-14; what breaks a symmetry by less than this part is not seen.
_NULL = 1e-10

# What is left of the same at fresh states for a symmetry to be reported.
_VERIFIED = 1e-8


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

        def of_member(q, qdot, times, params, mode):
            values = jax.vmap(self.charge, in_axes=(0, 0, 0, None))(q, qdot, times[0], params)
            return jnp.max(jnp.abs(values - values[0]))

        return trajectory.over_members(of_member)


class ConservedQuantities(list[Conserved]):
    """A list of `Conserved`; `notes` are sentences about symmetries of L that conserve nothing."""

    def __init__(self, quantities: list[Conserved], notes: tuple[str, ...] = ()):
        super().__init__(quantities)
        self.notes = notes

    _repr_pretty_ = as_printed

    def __str__(self) -> str:
        rows = [f"{c.name}{'' if c.gauge is None else ' (with a gauge term)'}" for c in self]
        return "\n".join([*rows, *self.notes] or ["no symmetry among the transformations that were tried"])

    def report(self, trajectory: Trajectory) -> str:
        """How far each quantity drifts along a trajectory, a line each; the worst member of a batch."""
        rows = [f"{'conserved':40s} {'largest drift':>14s}"]
        rows += [f"{c.name[:40]:40s} {float(jnp.max(c.drift(trajectory))):14.2e}" for c in self]
        return "\n".join(rows)


def conserved_quantities(
    system: System,
    q: PyTree,
    qdot: PyTree,
    params: PyTree = None,
    *,
    generators: dict[str, Callable] | None = None,
    seed: int = 0,
) -> ConservedQuantities:
    r"""What `system` conserves by a symmetry of its Lagrangian, found from L alone.

    All linear combinations of these point transformations are tried,

        ξ = b + c t + A q,   τ = α + β t     (translations, boosts, rotations, scalings, the time)

    together with `generators`. A is any matrix for up to 12 coordinates; beyond, the rotations and scalings of each
    leaf. A transformation is a symmetry where it changes L by some dG(q, t)/dt, and neither forces nor constraints do
    work on it. Energy, momenta, angular momenta and the like come first, under these names; what is left comes as
    combinations ("translation of z, rotation": a helix). Each conserved quantity I is verified at new random states,
    where dI/dt must vanish to near rounding.

    - `q`, `qdot`: a state of numbers, not traced. The random states are drawn about it; nothing else about it matters.
    - `params`: the parameters at which symmetries are sought.
    - `generators`: the user's own by name, as `noether_charge` takes them.
    - `seed`: of the random states.

    Conserved quantities that come from no point symmetry are not found: the Laplace–Runge–Lenz vector of Kepler's
    problem, the third integral of Toda's chain. In coordinates that are not Cartesian, rotations are not linear: those
    along a cyclic angle are found; for others give generators.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, a generator of the wrong structure,
    float32, or where L is not finite about the state.

    Source: Olver, *Applications of Lie Groups to Differential Equations*, §4.4 (variational symmetries), §5.3.

    ```python
    import jax.numpy as jnp, lagjax

    kepler = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) + 1 / jnp.sqrt(jnp.sum(q**2)))
    print(lagjax.conserved_quantities(kepler, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.2])))  # energy, angular momentum
    ```
    """
    scene = Scene.of(system, q, qdot, params)
    scene.require_double("conserved_quantities")
    if not scene.concrete:
        raise ValueError("conserved_quantities looks at numbers: call it outside of jit, vmap and grad, on one state.")
    piecewise = scene.piecewise
    scale = spread(scene.q, piecewise)
    fields = fields_of(scene.layout, scale, _own(generators, scene.layout))
    count = 8 + 4 * fields.count // scene.layout.size
    of_lagrangian, of_others = _measured(scene, fields, _states(scene, scale, count, seed))
    known = named(scene.layout, fields)
    of_both = np.concatenate([of_lagrangian, of_others])
    chosen = _chosen(_null_space(of_both), known, fields, scene.layout.names)
    fresh = _states(scene, scale, count, seed + 1)
    again = np.concatenate(_measured(scene, fields, fresh))
    chosen = [(name, w) for name, w in chosen if np.abs(again @ w).max() <= _VERIFIED * np.abs(w).max()]
    quantities, notes = _quantities(scene, fields, chosen, fresh)
    if of_others.size:
        names = {name for name, _ in chosen}
        symmetries = [name for name, _ in _chosen(_null_space(of_lagrangian), known, fields, scene.layout.names)]
        broken = [name for name in symmetries if name not in names and not name.startswith(_COMBINATION)]
        notes += [f"not conserved: {name}, by a symmetry of L that a force or a constraint breaks" for name in broken]
    if piecewise:
        notes.append("L or a force is piecewise: beyond borders farther off than states were drawn nothing was tested")
    return ConservedQuantities(quantities, tuple(notes))


_COMBINATION = "combination: "


def _measured(scene: Scene, fields: Fields, states: State) -> tuple[np.ndarray, np.ndarray]:
    """The columns of L and of forces and constraints at states (rows, K) each, where they are finite."""
    of_lagrangian, of_others = _columns(fields, states, *scene.arguments)
    return _finite(np.asarray(of_lagrangian), np.asarray(of_others))


def _own(generators, layout: Layout) -> dict[str, Callable]:
    if generators is None:
        return {}
    if not isinstance(generators, dict):
        raise TypeError(f"generators must be a dict of functions by name; got {type(generators).__name__}.")
    return {name: flat_generator(accept(f, f"generators[{name!r}]", ("q",)), layout) for name, f in generators.items()}


# ---- the columns -----------------------------------------------------------------------------------------------------


def _states(scene: Scene, scale: np.ndarray, count: int, seed: int) -> State:
    """Random states about that of the scene, (count, …) each, on the constraints if there are any."""
    draws = np.random.default_rng(seed).uniform(-1, 1, (3, count, scene.layout.size))
    speed = 0.3 + np.abs(np.asarray(scene.qdot))
    q, qdot = np.asarray(scene.q) + scale * draws[0], np.asarray(scene.qdot) + speed * draws[1]
    t = np.random.default_rng(seed + 100).uniform(-1, 1, count)
    if scene.constrained:
        q, qdot = _projected(q, qdot, t, scene.system, scene.layout, scene.params)
    dtype = scene.layout.dtype
    return State(*(jnp.asarray(x, dtype) for x in (q, qdot, speed * draws[2], t)))


@eqx.filter_jit
def _projected(q, qdot, t, system, layout, params):
    motion, numbers = system.motion(layout, params), eqx.filter(params, eqx.is_array_like)
    return jax.vmap(lambda *y: motion.nearest_consistent(*y, numbers))(q, qdot, t)


@eqx.filter_jit
def _columns(fields: Fields, states: State, *arguments) -> tuple[Array, Array]:
    """What each of K transformations leaves at S states: of L (S, n, K), of forces and constraints (S, r, K).

    Both in units of the terms that would have to cancel, so that entries are of order one unless there is a symmetry.
    """
    scene = Scene.flat(*arguments)

    def lagrangian(q, qdot, t):
        return scene.motion.lagrangian(q, qdot, t, scene.numbers)

    def of_state(state):
        def expression(weights):
            transform = fields.transform(weights, scene.params)
            rate, by_q = euler_lagrange(lambda *y: variation(scene, transform, *y), state)
            return rate - by_q, _work(scene, transform, state)

        of_l, of_others = jax.vmap(jax.linearize(expression, jnp.zeros(fields.count, state.q.dtype))[1], out_axes=-1)(
            jnp.eye(fields.count, dtype=state.q.dtype)
        )
        terms = [jnp.abs(x) for x in euler_lagrange(lagrangian, state)]
        return of_l, of_others, terms[0] + terms[1]

    of_l, of_others, terms = jax.lax.map(of_state, states)
    size = jnp.sqrt(jnp.nanmean(terms**2, axis=0))[:, None]
    others = jnp.nanmax(jnp.abs(of_others), axis=(0, 2), initial=0)[:, None]
    return of_l / jnp.where(size > 0, size, 1), of_others / jnp.where(others > 0, others, 1)


def _work(scene: Scene, transform: Callable, state: State) -> Array:
    """The work of forces on ξ − q̇ τ (1,) or (0,), and the rates (m,) at which it leaves constraints."""
    (change, of_time), place = transform(state.q, state.t), (state.q, state.qdot, state.t, scene.numbers)
    moved = change - state.qdot * of_time
    rows = [jnp.zeros(0, state.q.dtype)]
    if scene.motion.forces is not None or scene.motion.dissipation is not None:
        rows.append((scene.motion.nonconservative_force(*place) @ moved)[None])
    if scene.constrained:
        rows.append(scene.motion.constraints.jacobian_and_gamma(*place)[0] @ moved)
    return jnp.concatenate(rows)


def _finite(of_lagrangian: np.ndarray, of_others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows (rows, K) of states where all is finite. Raises `ValueError` where there are too few of them."""
    well = np.asarray(np.isfinite(of_lagrangian).all(axis=(1, 2)) & np.isfinite(of_others).all(axis=(1, 2)))
    if well.sum() < max(4, len(well) // 4):
        raise ValueError(
            "The Lagrangian, or a derivative of it, is not finite at most states about (q, qdot): give a state in the "
            "middle of where motions take place."
        )
    count = of_lagrangian.shape[-1]
    return of_lagrangian[well].reshape(-1, count), of_others[well].reshape(-1, count)


# ---- the null space --------------------------------------------------------------------------------------------------


def _null_space(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis (K, d) of the combinations of columns that are zero."""
    _, sizes, vectors = np.linalg.svd(columns, full_matrices=len(columns) < columns.shape[1])
    rank = int((sizes > _NULL * np.sqrt(len(columns))).sum())
    return vectors[rank:].T


def _chosen(
    space: np.ndarray, known: list[tuple[str, np.ndarray]], fields: Fields, names: tuple[str, ...]
) -> list[tuple[str, np.ndarray]]:
    """A basis of the space: those of the known vectors that lie in it, then combinations of few parts."""
    chosen, taken = [], np.zeros((len(space), 0))
    for name, weights in known:
        unit = weights / np.linalg.norm(weights)
        if np.linalg.norm(unit - space @ (space.T @ unit)) > 1e-7:
            continue
        new = unit - taken @ (taken.T @ unit)
        if np.linalg.norm(new) > 1e-7:
            taken = np.column_stack([taken, new / np.linalg.norm(new)])
            chosen.append((name, weights))
    rest = space - taken @ (taken.T @ space)
    left = np.linalg.svd(rest, full_matrices=False)[0][:, : space.shape[1] - taken.shape[1]]
    return chosen + [(_composed(row, fields, names), row) for row in _reduced(left.T)]


def _reduced(rows: np.ndarray) -> np.ndarray:
    """The reduced echelon form of rows (d, K), pivots the largest of each row, each row with a largest entry of 1."""
    rows = rows.copy()
    for k in range(len(rows)):
        pivot = int(np.argmax(np.abs(rows[k])))
        rows[k] /= rows[k, pivot]
        for j in range(len(rows)):
            if j != k:
                rows[j] -= rows[j, pivot] * rows[k]
    rows[np.abs(rows) < 1e-9] = 0
    return rows


def _readable(weights: np.ndarray, fields: Fields) -> np.ndarray:
    """The weights in the units of q: the largest entry of α, b, c, A, β is 1."""
    alpha, b, c, of_maps, beta, own = fields.apart(weights)
    a = np.tensordot(of_maps, fields.maps, 1)
    return weights / max(np.abs(x).max(initial=0) for x in (alpha, b * fields.scale, c * fields.scale, a, beta, own))


def _composed(weights: np.ndarray, fields: Fields, layout_names: tuple[str, ...]) -> str:
    """A combination in words: its parts by size, six at most."""
    alpha, b, c, of_maps, beta, own = fields.apart(_readable(weights, fields))
    names, a = layout_names, np.tensordot(of_maps, fields.maps, 1)
    parts = [(alpha, "time translation"), (beta, "scaling of the time")]
    parts += [(x, f"translation of {name}") for x, name in zip(b * fields.scale, names, strict=True)]
    parts += [(x, f"boost of {name}") for x, name in zip(c * fields.scale, names, strict=True)]
    parts += list(zip(own, fields.names[len(fields.names) - len(own) :], strict=True))
    for i in range(len(a)):
        parts.append((a[i, i], f"scaling of {names[i]}"))
        for j in range(i):
            if abs(a[i, j] + a[j, i]) < 1e-9:
                parts.append((a[i, j], f"rotation from {names[j]} to {names[i]}"))
            else:
                parts += [(a[i, j], f"d{names[i]} = {names[j]}"), (a[j, i], f"d{names[j]} = {names[i]}")]
    parts = sorted([part for part in parts if abs(part[0]) > 1e-9], key=lambda part: -abs(part[0]))
    return _COMBINATION + ", ".join(f"{x:+.6g} {name}" for x, name in parts[:6]) + (", …" if len(parts) > 6 else "")


# ---- the charge ------------------------------------------------------------------------------------------------------


def _quantities(scene: Scene, fields: Fields, chosen: list, states: State) -> tuple[list[Conserved], list[str]]:
    """The conserved quantities of the chosen symmetries, and what is to be said about others."""
    if not chosen:
        return [], []
    names, weights = [name for name, _ in chosen], np.array([_readable(w, fields) for _, w in chosen])
    changes, states = changes_of(scene, fields, weights, states)
    quantities, notes = [], []
    for k in _independent(names, changes.gradients):
        gauge = gauge_of(scene, fields, weights[k], k, changes)
        if gauge is None or is_right(gauge, scene, k, changes, states):
            quantities.append(Conserved(names[k], _charge(scene, fields, weights[k], gauge), gauge))
        else:
            notes.append(f"not given: {names[k]}, by a symmetry whose gauge term could not be integrated")
    return quantities, notes


def _independent(names: list[str], gradients: np.ndarray) -> list[int]:
    """Which to keep of D charges with these gradients (S, D, 2n): all that have a name, and of combinations those that
    are no function of the others.

    A function of others has a gradient in the space of theirs at every state. So the angular momentum of the centre of
    mass is left out where its momentum and its start are there.
    """
    kept = [k for k, name in enumerate(names) if not name.startswith(_COMBINATION)]
    for k in range(len(names)):
        if k not in kept and any(_outside(of_state[kept], of_state[k]) > 1e-6 for of_state in gradients):
            kept.append(k)
    return kept


def _outside(rows: np.ndarray, row: np.ndarray) -> float:
    """The part of a vector (2n,) outside of the space of some others (k, 2n)."""
    size = np.linalg.norm(row)
    if not len(rows) or size == 0:
        return float(size > 0)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    _, sizes, basis = np.linalg.svd(rows / np.where(lengths > 0, lengths, 1), full_matrices=False)
    basis = basis[sizes > 1e-9 * sizes.max(initial=1)]
    return float(np.linalg.norm(row - basis.T @ (basis @ row)) / size)


def _charge(scene: Scene, fields: Fields, weights: np.ndarray, gauge: Callable | None) -> Callable:
    """p·ξ − h τ − G of the symmetry with these weights (K,)."""
    system, layout = scene.system, scene.layout

    def charge(q, qdot, t=0.0, params=None):
        here = system.motion(layout, params)
        numbers = eqx.filter(params, eqx.is_array_like)
        state = layout.flatten(q), layout.flatten(qdot), jnp.asarray(t, layout.dtype), numbers
        change, of_time = fields.transform(jnp.asarray(weights, layout.dtype), params)(state[0], state[2])
        value = here.momentum(*state) @ change - of_time * here.energy(*state)
        return value if gauge is None else value - gauge(q, t, params)

    return charge
