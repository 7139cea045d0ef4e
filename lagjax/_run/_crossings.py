"""`crossings`: where a function of the state changes sign along a motion.

The motion is one run of machine code, which writes every crossing down and continues (`_native.steps._events`).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import Problem, Solution
from lagjax._engine.taylor import FoundCrossings, MachineCode, Surfaces, surfaces_of
from lagjax._equations import has_constraints, require_consistent
from lagjax._interface import (
    RESULTS,
    SUCCESSFUL,
    Layout,
    SimulationError,
    accept,
    as_arrays,
    code_of,
    halves,
    is_concrete,
    is_known,
    require_budget,
    require_flag,
    show_str,
)
from lagjax._primitives import allows_nan, raise_where_failed, sentence, undefined_unless
from lagjax._program import Unlowerable
from lagjax._run._trajectory import Trajectory
from lagjax._run.contacts import find_section_changes
from lagjax._run.hybrid import Hybrid, Scene, require_scene, simulate_modes

_TOO_MANY = code_of(RESULTS.max_crossings_reached)


class Crossings(NamedTuple):
    """The crossings of a section, in the order of the motion; NaN beyond the last crossing.

    - `t`, shape (count,): when; `q`, `qdot`: the state then, with that axis in front of every leaf.
    - `count`: how many crossings there were, which may be more than there is room for.
    - `ok`: whether the motion reached its end and all its crossings are stored.
    """

    t: jax.Array
    q: PyTree
    qdot: PyTree
    count: jax.Array
    ok: jax.Array

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        if not all(map(is_known, (self.t, self.count, self.ok))):
            return repr(self)
        t, count, ok = (np.asarray(x) for x in (self.t, self.count, self.ok))
        many = f" of {' × '.join(map(str, count.shape))} motions" if count.ndim else ""
        when = f" from t = {np.nanmin(t):.6g} to {np.nanmax(t):.6g}" if np.isfinite(t).any() else ""
        return f"{count.sum()} crossings{many}{when}, {'all there' if ok.all() else f'not all there in {(~ok).sum()}'}"


@allows_nan
def crossings(
    system: Scene,
    section: Callable | dict[str, Callable],
    q0: PyTree,
    qdot0: PyTree,
    ts: jax.Array,
    params: PyTree = None,
    *,
    direction: int | dict[str, int] = 0,
    count: int = 64,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 65_536,
    throw: bool = True,
) -> Crossings | dict[str, Crossings]:
    r"""The crossings of a section s(q, q̇, t) = 0 by the motion of `system` from (q0, qdot0), from `ts[0]` to `ts[-1]`.

    - `section`: a function of (q, qdot), and of `t` and `params` by name, that returns one real number. A crossing is
      where that changes sign; to touch zero is not a crossing, nor is to begin on it. A dict of functions gives a dict
      of `Crossings`, found in one run.
    - `ts`: times, of which only the first and the last are used; decreasing to go back in time.
    - `direction`: −1 for crossings where the section falls along the motion, +1 where it rises, 0 for both; for a dict
      of sections one for all, or a dict.
    - `count`: the largest number of crossings of each section. A motion with more crossings is an error, or with
      `throw=False` not `ok`: the result then has the first `count`, and `Crossings.count` tells how many there were.

    The other arguments are those of `simulate`. Crossings are found on the Taylor series of the section along each
    step, by a bound on that polynomial and without sampling, so that none is missed, down to the rounding of the time,
    and of the section: a pair of crossings between which its value is less than that is touching zero.
    A jump of the section through zero is a crossing, too. Sections may be piecewise (`abs`, `where`, `max`, …).

    In a `Hybrid` a section is watched in every mode, and with contacts whatever these do; a reset or an impact through
    zero is no crossing. Where a section of both directions is zero as another mode begins, it has to leave zero first.

    `crossings` works under `jax.jit` and `jax.vmap`, which makes one batch of all members, and has first and second
    derivatives. With s′ the rate of the section along the motion, the derivative of a crossing time is −ds / s′, and
    that of the state there includes the rate of the state times it. Derivatives take one more run. Where the motion
    only grazes the section, s′ is zero and there is no derivative.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right; `SimulationError` when the motion cannot
    be followed to its end, or has more crossings than `count`. It needs a scene that has machine code (see
    `System.explain`), on the CPU.

    Source: Hénon, *On the numerical computation of Poincaré maps*, Physica D 5 (1982) 412, for the problem; Jorba &
    Zou, Exp. Math. 14 (2005) 99, for the series.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q))
    upward = lagjax.crossings(pendulum, lambda q, qdot: q, 1.0, 0.0, jnp.array([0.0, 10.0]), direction=1)
    period = upward.t[1] - upward.t[0]
    ```
    """
    scene = require_scene(system)
    require_flag(throw, "throw")
    require_budget(count, "count")
    names, functions = sections_of(section)
    directions = directions_of(direction, names)
    layout = Layout.from_state(q0, qdot0)
    inputs = jax.tree.map(jnp.asarray, eqx.filter((q0, qdot0, ts, params), eqx.is_array_like))
    if isinstance(scene, Hybrid):
        ts = jnp.asarray(ts)[jnp.array([0, -1])]
        watched = scene.with_sections(functions, directions, count)
        run = simulate_modes(watched, q0, qdot0, ts, params, rtol, atol, max_steps, throw=False)
        notes = _notes_from_hybrid(run, len(scene.transitions), len(functions))
        return _read_crossings(notes, ts, len(functions), count, layout, names, throw, inputs)
    problem = Problem.from_arguments(scene, layout, q0, qdot0, ts, params, rtol, atol, max_steps)
    if has_constraints(scene):
        q0, qdot0 = as_arrays((q0, qdot0), layout.dtype, "state")
        require_consistent(scene, layout, problem.ts, q0, qdot0, problem.params)
    if scene.touches:
        notes = find_section_changes(problem, functions, directions, count)
        return _read_crossings(notes, problem.ts, len(functions), count, layout, names, throw, inputs)
    surfaces = surfaces_in(problem, functions, directions, names)
    solution, noted = MachineCode().crossings(problem, surfaces, count)
    how = _overall_result if isinstance(solution.y_end, np.ndarray) else _how_it_ended_traced
    result, end, ok = how(noted, solution, count)
    if throw:
        noted = _raise_unless_ok(layout, problem.ts, end, noted, result)
    return restore_crossings(problem.layout, names, noted, ok)


def _notes_from_hybrid(run: Trajectory, first: int, sections: int) -> tuple:
    """The notes of a hybrid motion, as from `find_section_changes`: its transitions with numbers from `first` on."""
    changes, flatten = run.transitions, Layout.from_state(*run.end[1:]).flatten
    assert changes is not None
    # A section that holds where the motion begins is met at once, and not crossed.
    which = jnp.where((changes.number >= first) & (changes.t > run.ts[0]), (changes.number - first) % sections, -1)
    y = jnp.concatenate([jax.vmap(flatten)(part) for part in (changes.q, changes.qdot)], axis=1)
    end = run.end.t, jnp.concatenate([flatten(part) for part in run.end[1:]])
    return (which, changes.t, y), run.result._value, end


def _read_crossings(notes: tuple, ts, sections: int, count: int, layout: Layout, names, throw: bool, inputs):
    """The crossings among the changes of a motion that jumps; differentiable by the `inputs`, or NaN derivatives."""
    (which, t, y), result, end = notes
    there = which == jnp.arange(sections)[:, None]
    places = jnp.argsort(~there, axis=1, stable=True)[:, :count]
    found = jnp.take_along_axis(there, places, axis=1)
    t, y = undefined_unless(found, t[places], inputs), undefined_unless(found[..., None], y[places], inputs)
    noted, many = FoundCrossings(t, y, there.sum(axis=1)), there.sum(axis=1) > count
    if throw:
        noted = _raise_unless_ok(layout, ts, end, noted, jnp.where(many.any(), _TOO_MANY, result))
    return restore_crossings(layout, names, noted, (result == SUCCESSFUL) & ~many)


def _overall_result(noted: FoundCrossings, solution: Solution, count: int, library: Any = np) -> tuple:
    """The result code, the time and state up to which it is complete, and which sections have all crossings."""
    well, many = solution.result == SUCCESSFUL, noted.count > count
    too_many = well & library.any(many)
    # The last crossing that there was room for, of the first section to run out of it.
    last = library.where(many, noted.t[:, -1], solution.t_end)
    first = library.argmax(library.abs(last - solution.t_end))
    result = library.where(too_many, _TOO_MANY, solution.result)
    t_end = library.where(too_many, last[first], solution.t_end)
    return result, (t_end, library.where(too_many, noted.y[first, -1], solution.y_end)), well & ~many


_how_it_ended_traced = jax.jit(functools.partial(_overall_result, library=jnp), static_argnums=2)


def _raise_unless_ok(layout: Layout, ts, end: tuple, noted: FoundCrossings, result) -> FoundCrossings:
    """The crossings if all went well; else `SimulationError`, at run time if traced."""
    if not all(map(is_concrete, (result, *end, ts))):
        t, y = raise_where_failed((noted.t, noted.y), result, end, ts[-1], layout.names)
        return noted._replace(t=t, y=y)
    if text := sentence(result, end[0], np.asarray(ts)[-1], end[1], layout.names):
        raise SimulationError(text, None)
    return noted


def restore_crossings(layout: Layout, names, noted: FoundCrossings, ok) -> Crossings | dict[str, Crossings]:
    """The crossings in the user's pytree, in a dict if the sections have names."""

    def section_crossings(k: int) -> Crossings:
        q, qdot = map(layout.restore, halves(jnp.asarray(noted.y[k])))
        return Crossings(jnp.asarray(noted.t[k]), q, qdot, jnp.asarray(noted.count[k]).astype(int), jnp.asarray(ok[k]))

    if names is None:
        return section_crossings(0)
    return {name: section_crossings(k) for k, name in enumerate(names)}


# ---- what can be wrong -----------------------------------------------------------------------------------------------


def sections_of(section) -> tuple[tuple[str, ...] | None, tuple]:
    """The names of a dict of sections, or None, and the functions."""
    if not isinstance(section, dict):
        return None, (accept(section, "section"),)
    if not section:
        raise ValueError("section is an empty dict: give a function, or a dict of functions by name.")
    return tuple(section), tuple(accept(function, f"section[{name!r}]") for name, function in section.items())


def directions_of(direction, names) -> tuple[int, ...]:
    if isinstance(direction, dict):
        if names is None or set(direction) != set(names):
            raise ValueError("direction is a dict: give the same names as in the dict of sections.")
        ways = [direction[name] for name in names]
    else:
        ways = [direction] * (1 if names is None else len(names))
    for way in ways:
        if isinstance(way, bool) or not isinstance(way, int | np.integer) or abs(way) > 1:
            raise ValueError(f"direction must be -1 (falling), +1 (rising) or 0 (both); got {way!r}.")
    return tuple(map(int, ways))


def surfaces_in(problem: Problem, functions, directions, names) -> Surfaces:
    """The sections as programs. Raises `ValueError` without machine code, or if a section never changes."""
    if problem.is_single:
        with jax.enable_x64(True):
            return surfaces_in(problem.double_precision, functions, directions, names)
    try:
        if refusal := MachineCode().refuses(problem):
            raise Unlowerable(refusal)
        surfaces = surfaces_of(problem, functions, directions, "A section")
        if refusal := MachineCode().refuses_crossings(problem, surfaces):
            raise Unlowerable(refusal)
    except Unlowerable as reason:
        text = (
            f"crossings are found with machine code, and there is none for this scene: {reason}. In a large scene "
            "simulate(..., event=…) stops at the first; a second call continues from it."
        )
        raise ValueError(text) from None
    for k in range(len(functions)):
        if not surfaces.values.depends(k) & set(range(2 * problem.layout.size + 1)):
            which = "section" if names is None else f"section[{names[k]!r}]"
            raise ValueError(f"{which} depends on neither the state nor the time: it cannot change its sign.")
    return surfaces
