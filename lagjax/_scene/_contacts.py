"""The contacts of a scene in flat coordinates: gaps ≥ 0, one-way velocities ≥ 0, their friction, and their state.

One compiled program serves all combinations of closed and sticking contacts: the combination is data (`ContactParams`).
With gaps g, one-way velocities γ and slips s, the program has a row of the constraint matrix for each of

closed: g = 0, γ = 0 open: λ = 0 sticks: s = 0 slides: f = −μ λ c, c the direction of s

and a number, 1 or 0, that switches the row on or off.
"""

import re
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jaxtyping import PyTree

from lagjax._equations import Constraints, Motion, couple_forces, once_for_structure
from lagjax._interface import Layout, is_concrete
from lagjax._scene._system import System, name_numbers


class Contacts(NamedTuple):
    """The state of k contacts, of which r have friction in d directions.

    - `closed` (k,): 1 where the contact is closed, else 0; `sticks` (r,): 1 where it sticks, 0 where it slides.
    - `direction` (r, d): the direction of a slip that begins; in a plane its sign. In space its length is a velocity
      far below those of the motion, which is added to the slip: its direction is then defined at rest, too.
    - `held` (k + r d,): 1 for each row (gaps, one-way velocities, slips) that is in the constraint matrix. It is given
      where there are more rows than coordinates, so that only independent rows may be taken; else (0,).
    - `near` (): the distance below which a state counts as at a corner of a gap (`_run.contacts._corners`).
    """

    closed: Any
    sticks: Any
    direction: Any
    held: Any
    near: Any


class ContactParams(NamedTuple):
    """Parameters (params of the user, contacts): of a program that integrates a system with contacts."""

    params: PyTree
    contacts: Contacts


class ContactScene(eqx.Module):
    """A scene that takes `ContactParams`; its closed contacts are constraints, as machine code integrates it.

    With `is_open` all contacts are taken as open, whatever the parameters say. With `slots` = (gaps, velocities) the
    constraint matrix has only this many rows, which `Contacts.held` selects: a body is held by few independent rows,
    however many contacts it has.
    """

    system: System
    is_open: bool = eqx.field(static=True, default=False)
    slots: tuple[int, int] | None = eqx.field(static=True, default=None)

    @property
    def path(self) -> str:
        return "array" if self.system.path == "array" else "scalar"  # arrays do not jump, however large the scene is

    def _motion(self, layout: Layout, params: ContactParams) -> Motion:
        """Return the equations of motion with the contacts in the state `params.contacts`."""
        free, flat = (
            self.system._motion(layout, params.params),
            FlatContacts.from_system(self.system, layout, params.params),
        )
        own = free.constraints

        def ask_user(function: Callable | None):
            return function and (lambda *arguments: function(*arguments[:-1], arguments[-1].params))

        constraints = self._hold_contacts(own, flat, layout)
        if self.is_open:
            constraints = Constraints(ask_user(own.on_positions), ask_user(own.on_velocities))
        lagrangian, forces, dissipation = map(ask_user, (free.lagrangian, free.forces, free.dissipation))
        motion = Motion(cast(Callable, lagrangian), forces, dissipation, constraints)
        if not self.system.reads_multipliers:
            return motion
        of_user = self.system.multiplier_law(layout, params.params)

        def law(*state_and_multipliers):
            *state, p, rows = state_and_multipliers
            if not self.is_open:
                gaps = flat.gap_count if self.slots is None else self.slots[0]
                others, normal, _ = self.split_forces(flat, rows, _row_counts(own, layout, p)[0] + gaps, p)
                rows = jnp.append(others, normal)
            return of_user(*state, p.params, rows)

        return couple_forces(motion, law, layout, params)

    def _hold_contacts(self, own: Constraints, flat: "FlatContacts", layout: Layout) -> Constraints:
        """Return the system's own constraints, followed by the rows of the contacts, with the friction forces."""

        def held_positions(q, t, p):
            gaps = flat.gaps(q, t, p.params)
            held = p.contacts.closed[: flat.gap_count] * gaps if self.slots is None else self.rows(flat, p)[0] @ gaps
            return jnp.concatenate([own.f(q, t, p.params), held])

        def held_velocities(q, qdot, t, p):
            one_way, slips = flat.one_way(q, qdot, t, p.params), flat.slips(q, qdot, t, p.params).ravel()
            held = [p.contacts.closed[flat.gap_count :] * one_way, flat.held_slips(p.contacts) * slips]
            if self.slots is not None:
                held = [self.rows(flat, p)[1] @ jnp.concatenate([one_way, slips])]
            return jnp.concatenate([own.a(q, qdot, t, p.params), *held])

        def held(p):
            (f, a), closed = _row_counts(own, layout, p), p.contacts.closed
            gaps, velocities = jnp.split(jnp.append(closed, flat.held_slips(p.contacts)), [flat.gap_count])
            if self.slots is not None:
                gaps, velocities = (rows.sum(axis=1) for rows in self.rows(flat, p))
            return jnp.concatenate([jnp.ones_like(closed, shape=f), gaps, jnp.ones_like(closed, shape=a), velocities])

        def drag(q, qdot, t, p):
            (f, _), slides = _row_counts(own, layout, p), flat.friction(p.params) * (1.0 - p.contacts.sticks)
            along = flat.slip_direction(q, qdot, t, p)
            slopes = jax.jacrev(flat.slips, argnums=1)(q, qdot, t, p.params)  # (r, d, n), few rows
            forces = -slides[:, None] * jnp.einsum("rd,rdn->rn", along, slopes)
            places = f + flat.rough
            if self.slots is not None:
                places, forces = f + np.arange(self.slots[0]), self.rows(flat, p)[0][:, flat.rough] @ forces
            return jnp.zeros((layout.size, held(p).size), q.dtype).at[:, places].set(forces.T)

        drags = drag if flat.rough.size else None, flat.shapes.directions > 1
        return Constraints(held_positions, held_velocities, held, *drags)

    def split_forces(self, flat: "FlatContacts", forces, positions: int, p: ContactParams) -> tuple:
        """Split the multipliers, `positions` of them on positions: own constraints, normals (k,), slips (r, d)."""
        one_way, (r, d) = flat.shapes.count - flat.gap_count, (flat.rough.size, flat.shapes.directions)
        gaps, velocities = (flat.gap_count, one_way + r * d) if self.slots is None else self.slots
        first, last = positions - gaps, forces.size - velocities
        own, normal, along = jnp.append(forces[:first], forces[positions:last]), forces[first:positions], forces[last:]
        if self.slots is not None:
            of_gaps, of_velocities = self.rows(flat, p)
            normal, along = normal @ of_gaps, along @ of_velocities
        return own, jnp.append(normal, along[:one_way]), along[one_way:].reshape(r, d)

    def rows(self, flat: "FlatContacts", p: ContactParams) -> list:
        """Return two 0/1 matrices (slots, rows): which row of gaps, and which of velocities, each slot takes."""
        assert self.slots is not None
        found = []
        for held, count in zip(jnp.split(p.contacts.held, [flat.gap_count]), self.slots, strict=True):
            place = np.tri(held.size) @ held
            found.append(jnp.where(place == np.arange(1.0, count + 1)[:, None], held, 0.0))
        return found


def _row_counts(own: Constraints, layout: Layout, p: ContactParams) -> tuple[int, int]:
    """Return the numbers of the system's own position constraints and velocity constraints."""
    q, t = jnp.zeros(layout.size, layout.dtype), jnp.zeros((), layout.dtype)
    f = jax.eval_shape(own.f, q, t, p.params).size
    return f, jax.eval_shape(own.a, q, q, t, p.params).size


class FlatContacts(NamedTuple):
    """The contact functions in flat coordinates: each takes (q, [qdot,] t, params), with arrays for params."""

    shapes: "ContactShapes"
    gaps: Callable
    one_way: Callable
    slips: Callable  # (r, d)
    restitution: Callable  # (k,) of params
    friction: Callable  # (r,) of params

    @property
    def gap_count(self) -> int:
        return self.shapes.of_gaps

    @property
    def rough(self) -> np.ndarray:
        return self.shapes.rough

    @classmethod
    def from_system(cls, system: System, layout: Layout, params: PyTree) -> "FlatContacts":
        code, shapes = (
            eqx.filter(params, eqx.is_array_like, inverse=True),
            ContactShapes.from_system(system, layout, params),
        )

        def call(role: str, vectors, t, numbers):
            function, whole = getattr(system, role), eqx.combine(numbers, code)
            return function(*map(layout.restore, vectors), t=t, params=whole)

        def numbers_of(tree):
            leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(tree)]
            return jnp.concatenate(leaves).astype(layout.dtype) if leaves else jnp.zeros(0, layout.dtype)

        def gaps(q, t, p):
            given = _replace_infinite(lambda *state: call("contacts", state[:1], *state[1:]))
            return numbers_of(() if system.contacts is None else given(q, t, p))

        def one_way(q, qdot, t, p):
            return numbers_of(() if system.one_way is None else call("one_way", (q, qdot), t, p))

        def slips(q, qdot, t, p):
            if not shapes.rough.size:
                return jnp.zeros((0, shapes.directions), layout.dtype)
            return numbers_of(call("slip", (q, qdot), t, p)).reshape(-1, shapes.directions)

        def coefficient(role: str):
            def spread_value(p):
                value = call(role, (), jnp.zeros((), layout.dtype), p)
                return shapes.spread(value, role).astype(layout.dtype)

            return spread_value

        friction = coefficient("friction")
        return cls(shapes, gaps, one_way, slips, coefficient("restitution"), lambda p: friction(p)[shapes.rough])

    def held_slips(self, contacts: Contacts):
        """Return (r d,): 1 for every slip that is held at zero (the contact is closed and sticks), else 0."""
        held = contacts.closed[self.rough] * contacts.sticks
        return jnp.broadcast_to(held[:, None], (held.size, self.shapes.directions)).ravel()

    def slip_direction(self, q, qdot, t, p: ContactParams):
        """Return the unit vectors (r, d) along the slips; of slips at rest, along `Contacts.direction`."""
        given = p.contacts.direction
        if self.shapes.directions == 1:
            return given
        unit, along, across = self.turning_slips(q, qdot, t, p)
        turn = across / along
        aside = jnp.stack([-unit[:, 1], unit[:, 0]], axis=1)
        return (unit + turn[:, None] * aside) / jnp.sqrt(1.0 + turn * turn)[:, None]

    def turning_slips(self, q, qdot, t, p: ContactParams) -> tuple:
        """Return in space `direction` as unit vectors (r, 2), and the slips (r,) along and across them."""
        given, slips = p.contacts.direction, self.slips(q, qdot, t, p.params)
        length = jnp.sqrt((given * given).sum(1))
        unit = given / length[:, None]
        return unit, (slips * unit).sum(1) + length, slips[:, 1] * unit[:, 0] - slips[:, 0] * unit[:, 1]


class ContactShapes(NamedTuple):
    """The structure of a system's k contacts, of which the first `of_gaps` are gaps and the others one-way velocities.

    `rough` (r,) are the indices of those with friction, with slips in `directions` dimensions; `names` (k,) are all
    names.
    """

    trees: tuple  # the structures that `contacts` and `one_way` return, None without any
    of_gaps: int
    count: int
    rough: np.ndarray
    directions: int
    names: tuple[str, ...]

    @staticmethod
    @once_for_structure
    def from_system(system: System, layout: Layout, params: PyTree) -> "ContactShapes":
        """Trace the contact functions; raise `TypeError` or `ValueError` if one returns the wrong structure."""
        trees = [
            None if getattr(system, role) is None else system._output_shapes(role, layout, params)
            for role in ("contacts", "one_way")
        ]
        for role, tree in zip(("contacts", "one_way"), trees, strict=True):
            if any(not jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(tree)):
                raise TypeError(f"{role} must return real numbers, the gaps or velocities that stay >= 0.")
        counts = [sum(x.size for x in jax.tree.leaves(tree)) for tree in trees]
        if not sum(counts):
            raise ValueError("contacts, or one_way, returns no number: it must return the gaps that stay >= 0.")
        names = system.contact_names(layout, params)
        rough, directions = _friction_directions(system, layout, params, trees[0])
        shapes = ContactShapes(tuple(trees), counts[0], sum(counts), rough, directions, names)
        numbers, code = eqx.partition(params, eqx.is_array_like)
        for role in ("restitution", "friction"):
            function = getattr(system, role)
            jax.eval_shape(
                lambda p, of=function, role=role: shapes.spread(of(params=eqx.combine(p, code)), role), numbers
            )
        friction, slips = None, None
        if system.friction is not None and "params" not in system.friction.extras:
            friction = system.friction(params=params)
        if isinstance(friction, dict) and system.slip is not None:
            slips = system._output_shapes("slip", layout, params)
        for name, value in (friction or {}).items() if isinstance(slips, dict) else ():
            if name not in slips and (not is_concrete(value) or np.any(value)):
                raise ValueError(f"friction names {name!r}, and slip does not: give its sliding velocity, too.")
        return shapes

    def spread(self, value: PyTree, role: str):
        """Return a coefficient per contact, (k,), of one number or a dict by name; 0 for one-way velocities."""
        tree, none = self.trees[0], jnp.zeros(self.count - self.of_gaps)
        if tree is None:
            return none
        if isinstance(value, dict) and isinstance(tree, dict):
            if unknown := [name for name in value if name not in tree]:
                raise ValueError(f"{role} names {unknown[0]!r}, and the contacts are {', '.join(map(repr, tree))}.")
            of = [_spread_coefficient(leaf.shape, value.get(name, 0.0), role) for name, leaf in sorted(tree.items())]
            return jnp.concatenate([*map(jnp.ravel, of), none])
        if len(jax.tree.leaves(value)) != 1:
            raise TypeError(f"{role} must be a number for all contacts, or a dict by the names of the contacts.")
        (leaf,) = jax.tree.leaves(value)
        if jnp.ndim(leaf) and jnp.size(leaf) > 1 and isinstance(tree, dict):
            raise ValueError(
                f"{role} must be a dict by the names of the contacts, which are {', '.join(map(repr, tree))}."
            )
        flat = leaf if jnp.ndim(leaf) < 2 else jnp.ravel(leaf)
        return jnp.concatenate([_spread_coefficient((self.of_gaps,), flat, role), none])

    def name_numbers(self, numbers) -> PyTree:
        """Return numbers of all contacts, (…, k), in the structure that the user's contact functions return."""
        return name_numbers(numbers, tuple(tree for tree in self.trees if tree is not None))


def _spread_coefficient(shape: tuple[int, ...], value, role: str):
    """Broadcast `value` to `shape`, one number per gap; raise `ValueError` if it does not fit."""
    try:
        return jnp.broadcast_to(value, shape)
    except ValueError:
        raise ValueError(
            f"{role} has the shape {jnp.shape(value)} where the contacts have {shape}: give one number, or one for "
            "each contact. Where params have one for each member of a batch, say so by batch_axes=(0, 0, 0)."
        ) from None


def _friction_directions(system: System, layout: Layout, params: PyTree, tree: PyTree) -> tuple[np.ndarray, int]:
    """Return the indices (r,) of contacts with friction, and the number of directions of a slip."""
    if system.slip is None:
        return np.zeros(0, int), 1
    slip = system._output_shapes("slip", layout, params)
    numbers = np.arange(sum(leaf.size for leaf in jax.tree.leaves(tree)))
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    places = jax.tree.unflatten(structure, np.split(numbers, ends))
    pairs = _pair_by_name(slip, tree, places)
    kinds = {leaf.shape[len(gap.shape) :] for leaf, gap, _ in pairs}
    alike = all(leaf.shape[: len(gap.shape)] == gap.shape for leaf, gap, _ in pairs)
    if not alike or len(kinds) > 1 or not kinds <= {(), (1,), (2,)}:
        found = ", ".join(str(leaf.shape) for leaf, _, _ in pairs)
        raise ValueError(
            "slip must return, in the structure of the contacts, a number for each of them (in a plane), or an array "
            f"of two for each (in space); got shapes {found}."
        )
    return np.concatenate([place for _, _, place in pairs]), int(np.prod(kinds.pop(), dtype=int))


def _pair_by_name(slip: PyTree, tree: PyTree, places: PyTree) -> list[tuple]:
    """Return (slip, gap, indices) of each contact with a slip; a dict may leave out contacts without friction."""
    if isinstance(slip, dict) and isinstance(tree, dict):
        if unknown := [name for name in slip if name not in tree]:
            raise ValueError(f"slip names {unknown[0]!r}, and the contacts are {', '.join(map(repr, tree))}.")
        return [(slip[name], tree[name], places[name]) for name in sorted(slip)]
    if jax.tree.structure(slip) != jax.tree.structure(tree):
        raise ValueError("slip must return the structure that contacts returns.")
    return list(zip(*map(jax.tree.leaves, (slip, tree, places)), strict=True))


# ---- gaps that are switched off --------------------------------------------------------------------------------------

_OPEN = 1e30  # a gap of infinity, which has no series: nothing comes across it, and its square is finite


def _replace_infinite(function: Callable) -> Callable:
    """Return the function with `_OPEN`, a large finite number, in place of every infinite constant in its jaxpr."""

    def capped(*arguments):
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
        if not re.search(r"\binf\b", str(program)) and not any(map(_is_infinite, program.consts)):
            return function(*arguments)
        outputs = jaxpr_as_fun(_cap_constants(program))(*jax.tree.leaves(arguments))
        return jax.tree.unflatten(jax.tree.structure(shapes), outputs)

    return capped


def _is_infinite(x) -> bool:
    return is_concrete(x) and jnp.issubdtype(jnp.result_type(x), jnp.floating) and bool(np.isposinf(x).any())


def _cap_constants(program: Any) -> Any:
    """Replace infinite constants by `_OPEN` in a jaxpr, or in the value of a jaxpr's parameter that contains one."""
    if isinstance(program, tuple | list):
        return type(program)(map(_cap_constants, program))
    if isinstance(program, ClosedJaxpr):
        consts = [np.where(np.isposinf(x), _OPEN, x) if _is_infinite(x) else x for x in program.consts]
        return ClosedJaxpr(_cap_constants(program.jaxpr), consts)
    if not isinstance(program, Jaxpr):
        return program

    def cap(x):
        return (
            Literal(np.asarray(_OPEN, jnp.result_type(x.val)), x.aval)
            if isinstance(x, Literal) and _is_infinite(x.val)
            else x
        )

    lines = [
        line.replace(
            invars=[*map(cap, line.invars)], params={name: _cap_constants(x) for name, x in line.params.items()}
        )
        for line in program.eqns
    ]
    return program.replace(eqns=lines, outvars=[*map(cap, program.outvars)])
