"""`steady_motion`: motions in which cyclic coordinates have constant velocities and the others are constant."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PyTree

from lagjax._analysis._equilibrium import Steady, find_balance
from lagjax._analysis._scene_state import SceneState, require_matrices
from lagjax._analysis._steady_symmetries import find_symmetries
from lagjax._interface import describe_numbers, is_known, require_flag, show_str
from lagjax._primitives import accepts_singles
from lagjax._scene import System


class SteadyMotion(NamedTuple):
    """A steady motion of a scene, at one instant.

    - `q`, `qdot`: the state, in the user's pytree; NaN where no steady motion was found.
    - `multipliers`: λ there, in the structure the constraints return; None without constraints.
    - `ok`: whether a steady motion was found.
    - `cyclic`: which coordinates are cyclic, in the structure of q; of coordinates that move together, as those of
      rotors that springs couple, it is one. The others are constant, or move with these.
    - `moves` (n, n): with the cyclic coordinate i the others move by `moves[:, i]`, itself by 1.
    - `turns` (n, n, n): `turns[i]` is the matrix Ω by which velocities turn with the cyclic coordinate i: all but zero
      is that of a yaw, with which the velocity of a place turns.
    """

    q: PyTree
    qdot: PyTree
    multipliers: PyTree
    ok: Bool[Array, ""]
    cyclic: PyTree
    moves: Any
    turns: Any

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        if not all(map(is_known, jax.tree.leaves(self))):
            return repr(self)
        ok = np.asarray(self.ok)
        if ok.ndim:
            return f"{ok.sum()} of {ok.size} steady motions were found"
        if not ok:
            return "No steady motion was found"
        forces = "" if self.multipliers is None else f"; {describe_numbers(self.multipliers, 'multipliers')}"
        return f"Steady motion: {describe_numbers(self.q, 'q')}; {describe_numbers(self.qdot, 'qdot')}{forces}"


@accepts_singles(("q", "qdot"), ("params",))
def steady_motion(
    system: System,
    q: PyTree,
    qdot: PyTree,
    params: PyTree = None,
    *,
    hold: str | tuple[str, ...] | None = None,
    throw: bool = True,
) -> SteadyMotion:
    r"""The steady motion of `system` near the state (q, q̇), also of what rolls.

        F + Gᵀλ = M Ωq̇,   f(q) = 0,   a(q, q̇) = 0        q̇ = 0 of all but the cyclic coordinates

    Cyclic are coordinates along which the scene looks the same at every place: an angle that L does not read, the turn
    of a wheel and the place of its contact, and its yaw, with which the velocity of that place turns by Ω. They move at
    constant velocities (that of a place turns with the yaw), and the other coordinates are constant: a top that
    precesses, a bicycle or a coin that goes in a circle, a car that a motor drives against its friction. Which are
    cyclic is found, `SteadyMotion.cyclic`.

    - `q`, `qdot`: the guess, in the user's pytree. Places of cyclic coordinates stay as they are; velocities of the
      others are taken as zero.
    - `hold`: names of numbers that keep their given values, such as `"q['lean']"` or `("q['lean']", "qdot['spin']")`; a
      name without an index holds a whole array. Steady motions form families, by speed and curvature, and without
      `hold` the member is found that the shortest steps reach.
    - `throw`: whether to raise where no steady motion is found. With False, and inside `jit` and `vmap`, `ok` is False
      and the state is NaN.

    `linearize(system, motion.q, motion.qdot, params).reduced(motion)` are the small motions about it: the eigenvalues
    of its `A` tell whether it is stable. The result is differentiated implicitly by params and by what is held, to
    every order. The function works under `jit`, `vmap` and `grad`.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, a scene that depends on the time or has
    contacts, a name that is none of a number, or where no steady motion is found.

    Source: Routh, *Stability of a Given State of Motion*, ch. IV; Neimark & Fufaev, *Dynamics of Nonholonomic Systems*,
    ch. VI (rolling); Marsden & Ratiu, *Introduction to Mechanics and Symmetry*, §1.10 (relative equilibria).

    ```python
    import jax.numpy as jnp, lagjax

    hoop = lagjax.System(lambda q, v: 0.5 * (v[0] ** 2 + (v[1] * jnp.sin(q[0])) ** 2) + 9.81 * jnp.cos(q[0]))
    turning = lagjax.steady_motion(hoop, jnp.array([1.0, 0.0]), jnp.array([0.0, 5.0]), hold="qdot[1]")
    print(turning)  # cos q[0] = 9.81 / 25
    ```
    """
    require_flag(throw, "throw")
    n = sum(map(np.size, jax.tree.leaves(q)))
    require_matrices(n, "A steady motion", "Follow the motion by simulate until it is steady.")
    scene = SceneState.from_state(system, q, qdot, params)
    scene.require_autonomous("A steady motion")
    chosen = _held_coordinates(scene, hold)
    cyclic, moves, turns = find_symmetries(scene, chosen[1])
    held = _held_unknowns(scene, chosen, cyclic, moves)
    steady = Steady(jnp.asarray(cyclic), jnp.asarray(held), *(jnp.asarray(x, scene.q.dtype) for x in (moves, turns)))
    place, rate, multipliers, ok = find_balance(scene, steady)
    if throw and scene.concrete and not ok:
        raise ValueError(_explain_failure(scene, cyclic, hold))
    of_user = scene.system._split_by_constraint(multipliers, scene.layout, scene.params) if scene.constrained else None
    restore = scene.layout.restore
    return SteadyMotion(restore(place), restore(rate), of_user, ok, restore(cyclic), moves, turns)


def _held_coordinates(scene: SceneState, hold: Any) -> np.ndarray:
    """Return the coordinates and velocities (2, n) that `hold` names; raise if a name is none of them."""
    names = scene.layout.names
    both = names, tuple(f"qdot{name.removeprefix('q')}" for name in names)
    chosen = np.zeros((2, len(names)), bool)
    if not (hold is None or np.iterable(hold)):
        raise TypeError(f"hold is a name, such as 'qdot[0]', or a tuple of names; got {hold!r}.")
    for wanted in (hold,) if isinstance(hold, str) else hold or ():
        within = (f"{wanted}[", f"{wanted}.") if isinstance(wanted, str) else ()
        named = np.array([[name == wanted or name.startswith(within) for name in of] for of in both])
        if not named.any():
            raise ValueError(f"hold names {wanted!r}, and the numbers are {', '.join(sum(both, ())[:24])}.")
        chosen |= named
    return chosen


def _held_unknowns(scene: SceneState, chosen: np.ndarray, cyclic: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return the unknowns (n,) that are held: velocities of `cyclic` coordinates, positions of the others."""
    for k in np.flatnonzero(chosen[1] & ~moves.any(axis=1)):
        if scene.concrete and scene.qdot[k] != 0:
            name = scene.layout.names[k]
            raise ValueError(
                f"qdot{name.removeprefix('q')} cannot be held at {scene.qdot[k]}: something depends on {name}, which "
                "is constant in a steady motion."
            )
    return np.where(cyclic, chosen[1], chosen[0])


def _explain_failure(scene: SceneState, cyclic: np.ndarray, hold: Any) -> str:
    names = scene.layout.names
    moving = ", ".join(name for name, moves in zip(names, cyclic, strict=True) if moves) or "none"
    sought = ", ".join(name for name, moves in zip(names, cyclic, strict=True) if not moves) or "none"
    freed = f"Hold less than {hold!r}, or begin" if hold else "Begin"
    return (
        f"No steady motion was found near the state: nothing balances with constant velocities of {moving} (cyclic) at "
        f"constant {sought}. {freed} nearer to one: a motion followed by simulate shows what it tends to."
    )
