"""The motion of a scene with contacts: a search for events, without derivatives, and a replay with derivatives.

ContactPlan, start ─► SceneCode.search ─► Found ─► attach_derivative(Replay) ─► ContactEnding, RoundRecord, impacts
"""

import functools
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine.taylor import Surfaces, Tolerances, line_of, make_flow, require_one_number, vector_of
from lagjax._equations import Derivation, derivation_of, forms
from lagjax._interface import Function, Layout, compile_for_one_call, halves
from lagjax._program import Unlowerable
from lagjax._run.contacts._contact_search import LOOPS
from lagjax._run.contacts._corners import append_sides, corners_of
from lagjax._run.contacts._impact_derivatives import construct_impulses
from lagjax._run.contacts._places import ARRAYS, PLACES
from lagjax._run.contacts._replay import ContactReplay, Played
from lagjax._run.jumps import Found, JumpLaw, Mode, SceneCode, mask_rows
from lagjax._scene import ContactParams, Contacts, ContactScene, ContactShapes, FlatContacts
from lagjax._tracing import Program, compose, lower

LAW = JumpLaw(PLACES, LOOPS, ("RESTITUTION", "MU"), ("DOUBTS", "DOUBTED"))
LAWS = "simultaneous", "sequential", "poisson"
# Operations that have a series everywhere, which hides nothing.
_SEEN = frozenset(("input", "constant", "convert", "add", "sub", "mul", "neg", "sin", "cos", "exp", "tanh"))


class ContactPlan(eqx.Module):
    """The constants of a run: the scene, its budgets, and whether the start came in float32.

    The `sections` are watched for sign changes too, each in its direction; a round records one.
    """

    scene: ContactScene
    tolerances: Tolerances = eqx.field(static=True)
    max_transitions: int = eqx.field(static=True)
    is_single: bool = eqx.field(static=True)
    sections: tuple[Function, ...] = ()
    directions: tuple[int, ...] = eqx.field(static=True, default=())


class ContactEnding(NamedTuple):
    """A whole motion: its outputs, its end, its result, and its doubtful events (as in `ContactChanges`)."""

    path: Any  # (T, 2n), NaN where not reached
    of_path: Contacts  # what the contacts did at the outputs, −1 where not reached
    t: Any
    y: Any  # (2n,)
    result: Any
    rounds: Any  # how many ended with a change
    steps: tuple[Any, Any]  # accepted, rejected
    doubts: Any  # (3,)
    doubted: Any


class RoundRecord(NamedTuple):
    """The changes of a motion (N, …), NaN and −1 if there is none: times, velocities before, states after them.

    The impulses (N, k) are normal ones.
    """

    t: Any
    qdot: Any
    y_next: Any
    impulse: Any
    contact: Any  # behind the contacts, a section that was crossed
    change: Any  # its kind


class SearchedScene(NamedTuple):
    """A scene prepared for runs: its replay, and its functions in flat coordinates.

    `coefficients` is the program of e and μ, (k + r,), from the numbers of params; None without one.
    """

    replay: ContactReplay
    flat: FlatContacts
    coefficients: Program | None


@compile_for_one_call
def contact_motion(
    plan: ContactPlan, layout: Layout, ts, y0, params: PyTree
) -> tuple[ContactEnding, RoundRecord, tuple]:
    """The motion from y0 (2n,) at ts[0], its changes, at most `max_transitions`, and its impacts.

    Impacts are given by their times, the normal impulses, the energy lost, and their count.
    """
    ts, y0 = jnp.asarray(ts), jnp.asarray(y0)
    numbers, scene = eqx.filter(params, eqx.is_array_like), scene_of(plan, layout, params, len(ts))
    given = ts, y0, vector_of(numbers).astype(float), scene.flat.restitution(numbers), scene.flat.friction(numbers)
    return _arrange_outcome(scene, *scene.replay.search_and_replay(*given), given[:3])


def integrate_concrete(plan: ContactPlan, layout: Layout, params: PyTree, ts, y0, vectors) -> tuple:
    """The motions of N members with concrete numbers: `y0` (N, 2n), `ts` (N or 1, T), `vectors` (N or 1, P).

    `params` are those of one member. The records are as long as the largest number of changes.
    """
    scene, members = scene_of(plan, layout, params, ts.shape[1]), len(y0)
    vectors = np.broadcast_to(np.asarray(vectors, float), (members, np.shape(vectors)[-1]))
    if scene.coefficients is None:
        rows = [_coefficients_at(scene.flat, params, vector) for vector in vectors]
        coefficients = [np.stack(column) for column in zip(*rows, strict=True)]
    else:
        values = [np.broadcast_to(x, members) for x in scene.coefficients.evaluate_many(list(vectors.T))]
        coefficients = np.split(np.stack(values, axis=-1), [scene.flat.shapes.count], axis=1)
    code, given = scene.replay.code, (np.asarray(ts, float), np.asarray(y0, float), vectors)
    found = code.search_batch(*given, *coefficients, room=None)
    return _arrange_outcome(scene, found, *scene.replay.read(found), ())


def _coefficients_at(flat: FlatContacts, params: PyTree, vector) -> list[np.ndarray]:
    """The coefficients e and μ for the numbers (P,) of parameters of this structure."""
    numbers, structure = jax.tree.flatten(eqx.filter(params, eqx.is_array_like))
    parts = np.split(vector, np.cumsum([np.size(x) for x in numbers])[:-1])
    given = structure.unflatten([part.reshape(np.shape(x)) for part, x in zip(parts, numbers, strict=True)])
    return [np.asarray(flat.restitution(given)), np.asarray(flat.friction(given))]


def _arrange_outcome(scene: SearchedScene, found: Found, row, played: Played, inputs: tuple) -> tuple:
    """The ending, the changes, and the impacts first; differentiable by `inputs`, if these are traced."""
    library: Any = jnp if inputs else np

    code = scene.replay.code
    k, r, d = (code.sizes[name] for name in "KRD")
    happened, hits = row.happens > 0, row.hits > 0
    ends = [k, k + r, k + r + r * d, code.sizes["DOING"] - 1]
    closed, sticks, direction, held, near = library.split(found.did, ends, axis=-1)
    of_path = Contacts(closed, sticks, direction.reshape(*direction.shape[:-1], r, d), held, near[..., 0])
    of = code.read_ending(found.ending)
    result, rounds, accepted, rejected = (x.astype(int) for x in of[:4])
    ending = ContactEnding(
        mask_rows((closed >= 0).all(axis=-1), played.path, inputs), of_path, played.t, played.y, result, rounds,
        (accepted, rejected), of.doubts.astype(int), of.doubted,
    )  # fmt: skip
    changes = (mask_rows(happened, x, inputs) for x in (played.at, played.before, played.behind, played.impulse))
    kinds = (library.where(happened, x, -1).astype(int) for x in (row.contact, row.change))
    impacts, front = [], library.argsort(~hits, axis=-1, stable=True)
    for x in (played.t_impact, played.impulse, played.lost):
        places = front[(..., *[None] * (x.ndim - hits.ndim))]
        impacts.append(library.take_along_axis(mask_rows(hits, x, inputs), places, axis=hits.ndim - 1))
    t_impact, impulse, energy = impacts
    return (
        ending,
        RoundRecord(*changes, *kinds),
        (t_impact, scene.flat.shapes.name_numbers(impulse), energy, hits.sum(-1)),
    )


# ---- what is made once -----------------------------------------------------------------------------------------------


def scene_of(plan: ContactPlan, layout: Layout, params: PyTree, times: int) -> SearchedScene:
    """The prepared scene for parameters of this structure and a number of outputs."""
    flat = FlatContacts.from_system(plan.scene.system, layout, params)
    inside = ContactParams(params, open_contacts(flat, layout.size))
    numbers = vector_of(eqx.filter(inside, eqx.is_array_like))
    system = plan.scene.system
    closed, other, whole = (
        derivation_of(of, layout, inside).with_numbers(numbers).lowered
        for of in (plan.scene, ContactScene(system, is_open=True), ContactScene(system))
    )
    code, structure = jax.tree.flatten(eqx.filter(inside, eqx.is_array_like, inverse=True))
    given = plan.max_transitions, plan.is_single, plan.sections, plan.directions, tuple(code), structure, times
    return _make_scene(closed, other, whole, plan.scene, plan.tolerances, *given)


@functools.lru_cache(maxsize=64)
def _make_scene(
    derivation: Derivation, open_derivation: Derivation, whole: Derivation, scene: ContactScene,
    tolerances: Tolerances, most: int, single: bool, sections: tuple, ways: tuple, code: tuple, structure, times: int
) -> SearchedScene:  # fmt: skip
    flat = _flat_functions(derivation, scene, structure, code)
    places, shapes, n = RowPlaces.from_derivation(whole, flat), flat.shapes, derivation.layout.size
    corners = corners_of(whole, places.all, shapes)
    turns, r, d, k = 0 if corners is None else len(corners.touch), flat.rough.size, shapes.directions, shapes.count
    watched = turns, sections, ways, code, structure, single
    open_scene, watches = ContactScene(scene.system, is_open=True), k + r + 2 * turns + len(sections)
    modes, more = [], lambda: {"MULTIPLIERS": line_of(_all_multipliers(derivation, scene, flat))}
    for of, law, make_lines in ((open_derivation, open_scene, dict), (derivation, scene, more)):
        find = functools.partial(_contact_watches, of, law, *watched)

        def make(of=of, find=find):
            return make_flow(of, scene.path, find().guards(remembers=True))

        modes.append(Mode(make, watches, find, make_lines))
    doing, inputs = k + r + r * d + count_row_flags(shapes, n) + 1, len(derivation.scalar_shapes)
    response = whole.accelerations.impact_response(places.all, doing, open_derivation)
    bends = response.select_outputs(range(len(response.line.outputs))[-len(places.all) :][:k])
    acceleration = line_of((open_derivation if corners is None else derivation).accelerations.program, n)
    lines = {"RESPONSE": line_of(response), "BENDS": line_of(bends).with_derivative, "ACCELERATION": acceleration}
    if scene.system.impacts == "poisson" and r:
        construct = lambda x: construct_impulses(x[:4].reshape(2, 2), x[4:6], x[6:7], x[7:])  # noqa: E731
        lines["CONSTRUCT"] = line_of(lower(construct, jax.ShapeDtypeStruct((8,), float)))
    if corners is not None:
        lines["SIDES"] = line_of(corners.sides)
        lines["SIDE_SLOPES"] = lines["SIDES"].forward
    sizes = {
        "N": n, "K": k, "R": r, "D": d, "GAPS": flat.gap_count, "CORNERS": turns, "SECTIONS": len(sections),
        "NUMBERS": inputs - 2 * n - 1 - doing, "INPUTS": inputs, "TIMES": times, "DOING": doing,
        "MOST": most, "LAW": LAWS.index(scene.system.impacts), "SINGLE": int(single), "HEIGHT": len(places.all),
        "MAY_MISS": int(not {op for op, _, _ in modes[0].find_surfaces().values.line.nodes} <= _SEEN),
        "MULTIPLIERS_COUNT": max(derivation.shape("jacobian")[0], k + r * d),
        "GAP_SLOTS": (scene.slots or (0, 0))[0], "SLOTS": (scene.slots or (0, 0))[1],
    }  # fmt: skip
    touch = np.zeros((0, k)) if corners is None else corners.touch
    tangential = places.tangential if scene.slots is None else k + np.arange(r * d)
    arrays = dict(zip(ARRAYS, (flat.rough, tangential, touch), strict=True))
    searched = SceneCode(LAW, sizes, arrays, modes, lines, tolerances)
    flow = functools.cache(functools.partial(make_flow, derivation, scene.path, None))
    return SearchedScene(ContactReplay(searched, flow), flat, _lower_coefficients(flat, derivation.numbers.params))


def _lower_coefficients(flat: FlatContacts, numbers: PyTree) -> Program | None:
    try:
        return lower(lambda p: jnp.concatenate([flat.restitution(p), flat.friction(p)]), numbers)
    except Unlowerable:
        return None


def _flat_functions(derivation: Derivation, scene: ContactScene, structure, code: tuple) -> FlatContacts:
    """The functions of contacts; `code` and `structure` are the parts of the parameters that are not numbers."""
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), derivation.numbers)
    return FlatContacts.from_system(
        scene.system, derivation.layout, eqx.combine(zeros, structure.unflatten(code)).params
    )


def open_contacts(flat: FlatContacts, n: int) -> Contacts:
    """The contact states, for n coordinates, in which all are open."""
    (k, r), d, held = (flat.shapes.count, flat.rough.size), flat.shapes.directions, count_row_flags(flat.shapes, n)
    return Contacts(np.zeros(k), np.ones(r), np.ones((r, d)), np.zeros(held), np.zeros(()))


def count_row_flags(shapes: ContactShapes, n: int) -> int:
    """The size of `Contacts.held` for n coordinates."""
    rows = shapes.count + shapes.rough.size * shapes.directions
    return rows if rows > n else 0


def count_independent_rows(whole: Derivation, flat: FlatContacts) -> tuple[int, int] | None:
    """The most independent rows of gaps, and of velocities, active at once; None to keep all rows.

    They are ranks at random states, for rows without corners. The slips of few contacts may add more to the rank of
    their gaps than those of all do: all sets whose gaps leave some rank are tested.
    """
    places, shapes, n = RowPlaces.from_derivation(whole, flat), flat.shapes, whole.layout.size
    if (
        not count_row_flags(shapes, n)
        or shapes.count > flat.gap_count
        or corners_of(whole, places.all, shapes) is not None
    ):
        return None
    rows = [sample.toarray() for _, sample in whole.accelerations.samples()]
    own = np.setdiff1d(np.arange(len(rows[0])), places.all)

    def rank(*some) -> int:
        chosen = np.concatenate([own, *some]).astype(int)
        return max(int(np.linalg.matrix_rank(row[chosen], 1e-9 * abs(row).max())) for row in rows) - len(own)

    gaps = rank(places.normal)
    if gaps > 3:
        return None
    normal, slips = places.normal[flat.rough], places.tangential
    sets = [list(x) for size in range(1, gaps) for x in itertools.combinations(range(len(slips)), size)]
    most = [rank(normal[x], slips[x].ravel()) - rank(normal[x]) for x in sets]
    slots = gaps, max([*most, rank(places.normal, slips.ravel()) - gaps])
    return slots if sum(slots) < count_row_flags(shapes, n) else None


def _all_multipliers(derivation: Derivation, scene: ContactScene, flat: FlatContacts) -> Program:
    """The program of all multipliers; with slots those of the contacts, (k + r d,)."""
    if scene.slots is None:
        return derivation.accelerations.multipliers
    moving, positions = 2 * derivation.layout.size + 1, derivation.position_count

    def spread(_, inside, forces):
        return jnp.concatenate([x.ravel() for x in scene.split_forces(flat, forces, positions, inside)[1:]])

    multipliers = derivation.accelerations.multipliers
    y, forces = (jax.ShapeDtypeStruct((size,), float) for size in (moving, len(multipliers.line.outputs)))
    program = lower(spread, y, derivation.numbers, forces, moving=moving)
    return compose(program, multipliers, forms.OPERATION_BUDGET, moving)


class RowPlaces(NamedTuple):
    """The row numbers of contacts among all constraints: those of the normals (k,) and of the slips (r, d)."""

    normal: np.ndarray
    tangential: np.ndarray

    @property
    def all(self) -> tuple[int, ...]:
        return (*self.normal.tolist(), *self.tangential.ravel().tolist())

    @classmethod
    def from_derivation(cls, derivation, flat: FlatContacts) -> "RowPlaces":
        total, (r, d) = derivation.shape("jacobian")[0], (flat.rough.size, flat.shapes.directions)
        gaps_end, slips = derivation.position_count, total - r * d
        one_way = flat.shapes.count - flat.gap_count
        normal = [*range(gaps_end - flat.gap_count, gaps_end), *range(slips - one_way, slips)]
        return cls(np.array(normal, int), slips + np.arange(r * d).reshape(r, d))


@functools.lru_cache(maxsize=64)
def _contact_watches(
    derivation, scene: ContactScene, turns: int, sections: tuple, ways: tuple, code: tuple, structure, single
) -> Surfaces:
    """The watches of all contacts as programs: the k normal ones, r of friction, those of corners, the sections.

    `code` and `structure` are the parts of the parameters that are not numbers.
    """
    flat = _flat_functions(derivation, scene, structure, code)
    shapes, rough = flat.shapes, flat.rough
    corners = None
    if turns and not scene.is_open:
        corners = corners_of(derivation, RowPlaces.from_derivation(derivation, flat).all, shapes)

    def values_at(y, inside: ContactParams, *forces):
        user, (closed, sticks, direction, _, near) = eqx.filter(inside.params, eqx.is_array_like), inside.contacts
        state = (*halves(y[:-1]), y[-1])
        open_values = jnp.concatenate([flat.gaps(state[0], state[2], user), flat.one_way(*state, user)])
        user_state = (*map(derivation.layout.restore, state[:2]),)
        more = [require_one_number(of(*user_state, t=y[-1], params=inside.params), "A section") for of in sections]
        if scene.is_open:
            return jnp.concatenate([open_values, jnp.ones(rough.size + 2 * turns), jnp.array(more)])
        positions, own = derivation.position_count, len(forces[0]) - (0 if corners is None else turns)
        _, normal, held = scene.split_forces(flat, forces[0][:own], positions, inside._replace(params=user))
        if corners is not None:
            matters = [1.0 - jnp.prod(1.0 - closed[np.flatnonzero(row)]) for row in corners.touch]
            sides = forces[0][-turns:] * jnp.stack(matters)  # 0 where all that is closed is elsewhere
            more = [*(sides - near), *(sides + near), *more]
        watches = jnp.concatenate([normal + (1.0 - closed) * open_values, jnp.array(more)])
        if not rough.size:
            return watches
        most = flat.friction(user) * normal[rough]
        if shapes.directions == 1:
            slides = jnp.sum(flat.slips(*state, user) * direction, axis=1)
        else:  # zero where it stops, and where it has turned by 60°: at 90° its direction has a pole
            unit, along, across = flat.turning_slips(*state, inside._replace(params=user))
            slides = jnp.sum(flat.slips(*state, user) * unit, axis=1) - across**2 / (3.0 * along)
        of_friction = sticks * (most**2 - jnp.sum(held**2, axis=1)) + (1.0 - sticks) * slides
        of_friction = closed[rough] * of_friction + (1.0 - closed[rough])
        return jnp.concatenate([watches[: shapes.count], of_friction, watches[shapes.count :]])

    directions = (-1,) * (shapes.count + rough.size + turns) + (1,) * turns + ways
    forces = None if scene.is_open else derivation.accelerations.multipliers
    forces = forces if corners is None or forces is None else append_sides(forces, corners)
    surfaces = Surfaces.from_function(derivation, values_at, directions, code, structure, given=forces)
    return surfaces._replace(is_rounded=single)
