"""Contacts that are closed at a state, taken as constraints in the analysis, with a check that they stay closed.

    closed: g = 0, force ∇g λ with λ ≥ 0        open: g > 0, λ = 0

A gap that is zero at the state becomes a constraint. The result holds for the scene with contacts if every such λ ≥ 0
and every other gap stays open; else an error names the contact that opens or closes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from scipy.optimize import nnls

from lagjax._analysis._scene_state import SceneState
from lagjax._interface import Layout, accept, is_concrete, restrict_signature
from lagjax._primitives import nan_unless
from lagjax._scene import FlatContacts, System, drop_contacts, replace_functions, require_system

# A gap or its rate that is zero, in sizes of its terms: what six digits, or a state in float32, leave of it.
_CLOSED = 1e-6
_UNLOADED = 1e-9  # of the largest force: one that is rounding


class ClosedScene(NamedTuple):
    """The scene with the gaps at `places` (c,) as constraints, and the scene with contacts (`given`)."""

    system: System
    given: System
    flat: FlatContacts
    places: tuple[int, ...]
    own: int  # constraints on positions that the scene has besides

    @property
    def names(self) -> tuple[str, ...]:
        return self.flat.shapes.names

    @property
    def _contact_rows(self) -> np.ndarray:
        return np.arange(self.own, self.own + len(self.places))

    def split(self, multipliers, layout: Layout, params: PyTree) -> tuple:
        """Split multipliers (m,) into those of constraints and the normal forces of contacts, as user's pytrees."""
        end = self.own + len(self.places)
        forces = jnp.zeros(len(self.names), multipliers.dtype)
        forces = forces.at[np.array(self.places, int)].set(multipliers[self.own : end])
        rest, bare = jnp.concatenate([multipliers[: self.own], multipliers[end:]]), drop_contacts(self.given)
        of_constraints = bare._split_by_constraint(rest, layout, params) if bare._constraint_roles else None
        return of_constraints, self.flat.shapes.name_numbers(forces)

    def judge(self, scene: SceneState, q, multipliers, ok) -> tuple:
        """Return the multipliers (m,) of an equilibrium at q (n,), whether contacts allow it, a message if not."""
        pushes, jacobian = multipliers[self._contact_rows], scene.jacobian(q, scene.qdot)
        gaps, slopes = _gaps_and_slopes(self.flat, q, scene.params)
        rounding = _UNLOADED * jnp.max(jnp.abs(multipliers), initial=0.0)
        presses, stays_open = pushes >= -rounding, gaps >= -_CLOSED * _gap_sizes(gaps, slopes, q)
        fine = jnp.all(presses) & jnp.all(stays_open)
        if not is_concrete(fine) or not ok or fine:
            return multipliers, ok & fine, ""
        for k in np.flatnonzero(~np.asarray(stays_open)):
            why = (
                f"At the equilibrium that was found {self.names[k]} is {gaps[k]:.6g}: this contact closes before. "
                "Begin at a q where it is closed, with a gap of zero: what is closed there stays closed."
            )
            return multipliers, fine, why
        # Of contacts that depend on each other, as the four feet of a table, other shares of the load may press.
        force = np.asarray(scene.force(q, scene.qdot))
        if (shares := _pressing_shares(np.asarray(jacobian), force, self._contact_rows)) is not None:
            return jnp.asarray(shares, multipliers.dtype), jnp.asarray(True), ""
        return multipliers, fine, self._explain_opening(pushes, "At the equilibrium that was found")

    def require_loaded(self, q: PyTree, qdot: PyTree, params: PyTree, why: str) -> PyTree:
        """Return q if every closed contact presses; else raise `ValueError`, or return NaN if traced.

        The message says which contact does not press, and `why` it has to.
        """
        if not self.places:
            return q
        leaves = jax.tree.leaves(self.system.multipliers(q, _allowed_velocities(q, qdot), 0.0, params))
        multipliers = jnp.concatenate([jnp.ravel(x) for x in leaves])
        pushes = multipliers[self._contact_rows]
        loaded = jnp.all(pushes > _UNLOADED * jnp.max(jnp.abs(multipliers)))
        if not is_concrete(loaded):
            return jax.tree.map(lambda x: nan_unless(loaded, jnp.asarray(x, float)), q)
        if not loaded:
            raise ValueError(f"{self._explain_opening(pushes, 'At this state')} {why}")
        return q

    def _explain_opening(self, pushes, where: str) -> str:
        k = int(np.argmin(np.asarray(pushes)))
        name = self.names[self.places[k]]
        return (
            f"{where} {name} would have to pull, or carries nothing (its force is {pushes[k]:.6g}): it opens. Begin "
            "where its gap is positive."
        )


def one_sided_reason(what: str) -> str:
    return f"{what} next to a contact without load is linear on one side of it alone."


def constrain_closed(system: Any, q: PyTree, qdot: PyTree, params: PyTree, what: str) -> ClosedScene | None:
    """Return the scene with the gaps that are zero at the state as constraints; None if it has no contacts.

    Raises `ValueError` if a gap is negative or closes with a velocity, if a closed contact has friction, and if q is
    traced, so that it is not known which are closed.
    """
    if not isinstance(system, System) or not system.touches:
        return None
    system = require_system(system, contacts=True)
    if system.one_way is not None:
        raise ValueError(f"{what} is for contacts without one_way=…: leave out what is open, hold what is closed.")
    if system.reads_multipliers:
        raise ValueError(
            f"{what} of a scene with contacts is for forces that read no multipliers: write the contacts that stay "
            "closed as constraints=…, whose multipliers they may read there."
        )
    with jax.ensure_compile_time_eval():
        rest = _allowed_velocities(q, qdot)
        layout = Layout.from_state(q, rest)
        flat = FlatContacts.from_system(system, layout, params)
        at, rate = layout.flatten(q), layout.flatten(rest)
        gaps, slopes = _gaps_and_slopes(flat, at, params)
        rates = slopes @ rate
    if not all(map(is_concrete, (gaps, rates))):
        raise ValueError(
            f"{what} of a scene with contacts has to know which of them are closed at q: call it outside of jax.jit "
            "and jax.vmap, or with a q and gaps in which no number is being traced."
        )
    gaps, rates, at, slopes, rate = map(np.asarray, (gaps, rates, at, slopes, rate))
    near, slow = _CLOSED * _gap_sizes(gaps, slopes, at), _CLOSED * (np.abs(slopes) @ np.abs(rate))
    for k in np.flatnonzero(gaps < -near):
        name = flat.shapes.names[k]
        raise ValueError(f"{name} = {gaps[k]:.6g} is negative at q, and gaps stay >= 0: begin where none is.")
    closed = gaps <= near
    for k in np.flatnonzero(closed & (rates < -slow)):
        raise ValueError(f"{flat.shapes.names[k]} is struck at this state, and nothing is linear there: its gap falls.")
    places = tuple(np.flatnonzero(closed & (rates <= slow)).tolist())
    _require_no_friction(flat, places, params, what)
    own = 0 if system.constraints is None else sum(
        leaf.size for leaf in jax.tree.leaves(system._output_shapes("constraints", layout, params))
    )  # fmt: skip
    return ClosedScene(_hold_contacts(system, places), system, flat, places, own)


def _pressing_shares(jacobian: np.ndarray, force: np.ndarray, rows: np.ndarray) -> np.ndarray | None:
    """Return λ (m,) with F + Gᵀλ = 0 that is not negative in these `rows`; None if there is none."""
    both = np.delete(np.arange(len(jacobian)), rows)
    shares, left = nnls(np.concatenate([jacobian[rows], jacobian[both], -jacobian[both]]).T, -force)
    if left > _UNLOADED * np.linalg.norm(force):
        return None
    multipliers = np.zeros(len(jacobian))
    pushes, up, down = np.split(shares, [len(rows), len(rows) + len(both)])
    multipliers[rows], multipliers[both] = pushes, up - down
    return multipliers


def _allowed_velocities(q: PyTree, qdot: PyTree) -> PyTree:
    return jax.tree.map(lambda x: jnp.zeros_like(jnp.asarray(x, float)), q) if qdot is None else qdot


def _gaps_and_slopes(flat: FlatContacts, q, params: PyTree) -> tuple:
    """Return all gaps (k,) and their gradients (k, n) at q (n,)."""
    time = jnp.zeros((), q.dtype)
    return flat.gaps(q, time, params), jax.jacfwd(flat.gaps)(q, time, params)


def _gap_sizes(gaps, slopes, q):
    """Return the magnitudes (k,) of the terms of each gap, for the rounding error of the gap."""
    return abs(slopes) @ abs(q) + 1e-8 * (1.0 + abs(gaps))


def _require_no_friction(flat: FlatContacts, places: tuple[int, ...], params: PyTree, what: str) -> None:
    rough = [k for k in flat.rough.tolist() if k in places]
    if not rough:
        return
    friction = flat.friction(params)
    for place, k in enumerate(flat.rough.tolist()):
        if k in rough and (not is_concrete(friction) or float(friction[place])):
            raise ValueError(
                f"{what} is not made for closed contacts with friction, as {flat.shapes.names[k]} is: what sticks is "
                "held along the slip, too. Write what sticks as constraints=…, or leave friction and slip out."
            )


def _hold_contacts(system: System, places: tuple[int, ...]) -> System:
    """Return the scene with these gaps as constraints, and without contacts."""
    bare, own, contacts = drop_contacts(system), system.constraints, system.contacts
    if not places or contacts is None:
        return bare

    def hold_gaps(q, t, params):
        gaps = jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(contacts(q, t=t, params=params))])
        held = gaps[np.array(places)]
        return held if own is None else (own(q, t=t, params=params), held)

    asked = set(contacts.extras) | set(() if own is None else own.extras)
    held = accept(restrict_signature(hold_gaps, asked, 1), "constraints", ("q",))
    return replace_functions(bare, {"constraints": held})
