"""`branch_off`: from a family of periodic orbits to one that crosses it, or that begins there with twice the period.

At a branch point the closing equations have one null vector more than elsewhere on the family. The new family is sought
at some distance along it, in the plane across, which the old family does not meet.

Source: Keller, *Lectures on Numerical Methods in Bifurcation Problems* (1987), §5.26 (method III).
"""

from typing import Any

import jax
import numpy as np

from lagjax._analysis.orbits._arc_motions import Arcs, starts
from lagjax._analysis.orbits._continuation import FamilyPoint, FamilyTangent, Follower, correct, tangent_at
from lagjax._analysis.orbits._family import Family, first_point, parameter_index
from lagjax._analysis.orbits._orbit import RTOL, FlatOrbits, Orbit, assess_orbits, restore_orbits
from lagjax._equations import decide, span_outside
from lagjax._interface import Layout, require_tolerance
from lagjax._primitives import accepts_singles
from lagjax._scene import System

PyTree = Any


@accepts_singles(("family",), ("params",))
def branch_off(
    system: System, family: Family, index: int, params: PyTree = None, *, by: str = "energy", size: float = 0.01
) -> Orbit:
    """A periodic orbit of the family that crosses `family` at its orbit `index`, near that orbit.

    Follow it on by `family(system, branch_off(…), params)`: the halo orbits from the planar ones of Lyapunov, say.

    - `index`: of an orbit where `family.branch` or `family.doubling` is True; of the latter the new orbits have twice
      the period.
    - `params`, `by`: those with which `family` was followed.
    - `size`: how far off the new orbit is, in parts of the size of the old one, as `step` of `family`.

    By symmetry there often are two such families, mirror images, of which this is one.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, an orbit at which no family crosses, and
    where no orbit is found at that distance.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    star = lagjax.System(lambda q, v: 0.5 * (v @ v - q @ q) - q[0] ** 2 * q[1] + q[1] ** 3 / 3)
    orbit = lagjax.periodic_orbit(star, jnp.array([0.0, 0.1]), jnp.zeros(2), 6.3)
    along = lagjax.family(star, orbit, until=0.15)
    twice = lagjax.branch_off(star, along, int(jnp.argmax(along.doubling)))
    ```
    """
    require_tolerance(size, "size")
    places = np.flatnonzero(np.asarray(family.branch | family.doubling)).tolist()
    if index not in places:
        raise ValueError(
            f"No family crosses at orbit {index}: index must be that of a branch point or a doubling, "
            f"{' or '.join(map(str, places)) or 'of which this family has none'}."
        )
    turns = 2 if bool(family.doubling[index]) else 1
    beside = next(k for k in (index - 1, index + 1, index) if 0 <= k < len(family.value))
    (y0, period, layout), (y0_beside, period_beside, _) = (_start(family, k, turns) for k in (index, beside))
    place = None if by == "energy" else parameter_index(params, by)
    arcs = Arcs.from_system(system, layout, params, RTOL, "Families")
    numbers, numbers_beside = (_numbers(arcs, place, family, k) for k in (index, beside))
    follower = Follower(arcs.with_numbers(numbers), place, y0, period)
    here = first_point(follower, y0, period, numbers)
    before = tangent_at(follower, first_point(follower, y0_beside, period_beside, numbers_beside), None)
    point = None if before is None else _branching_orbit(follower, here, before, float(size))
    if before is None or point is None:
        raise ValueError(
            f"No orbit of another family was found {size:.3g} from orbit {index}: try another size, or follow the "
            "family again with another first step, so that its neighbours lie elsewhere."
        )
    found = assess_orbits(follower.closing(point.numbers), point.chain, before.symmetries.shape[1])
    return restore_orbits(follower.arcs.layout, FlatOrbits(*(x[0] for x in found)), found.message[0])


def _start(family: Family, k: int, turns: int) -> tuple[np.ndarray, np.ndarray, Layout]:
    """The first state (1, 2n) of orbit k and its period (1,), traversed `turns` times, and the layout of the state."""
    q0, qdot0 = jax.tree.map(lambda x: x[k], (family.q0, family.qdot0))
    period, layout, y0 = starts(q0, qdot0, turns * family.period[k], "period")
    return y0, period.ravel(), layout


def _numbers(arcs: Arcs, place: int | None, family: Family, k: int) -> np.ndarray:
    numbers = np.array(arcs.numbers)
    if place is not None:
        numbers[place] = float(family.value[k])
    return numbers


def _branching_orbit(follower: Follower, here: FamilyPoint, before: FamilyTangent, size: float) -> FamilyPoint | None:
    """The orbit at a distance from a branch point along the null vector that is no symmetry, nor of the old family.

    Symmetries are known from a neighbour: at the branch point singular values do not tell them from the new direction.
    """
    states, count = here.matrix.shape[0], before.symmetries.shape[1]
    still = decide(here.matrix[:, :states]).right[:, states - count - 1 :]
    null = decide(here.matrix).right[:, before.rank - 1 :]
    known = np.zeros((null.shape[0], count + 1))
    known[:states, :count] = still @ (still.T @ before.symmetries[:states])
    known[:, count] = null @ (null.T @ before.vector)
    directions = span_outside(null, np.linalg.qr(known)[0])
    if not directions.shape[1]:
        return None
    across = FamilyTangent(directions[:, 0], before.rank, before.symmetries)
    there = correct(follower, follower.move(here, size * across.vector, 0.0), across)
    return None if there is None else there[0]
