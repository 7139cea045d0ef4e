"""The sizes of coordinates, velocities and time of a scene at a state: the scales for "small" changes there.

A number of a state has the units of its author, who may write a molecule in metres and a planet in seconds. So no
number is small by itself, and nothing here is compared with 1. What coordinates of different units have in common is
the kinetic energy, ½ Mᵢᵢ q̇ᵢ² of each: with |x| = maxᵢ √|Mᵢᵢ| |xᵢ| a length l in that metric is l/√|Mᵢᵢ| of coordinate
i, a radian for an angle φ next to a radius r, whose Mᵢᵢ is m r². The forces give the rest, by how they vary along a
line through the state, F(q + εu) with |u| = 1:

    l    the larger of |q| and |q̇|/√(∂F/∂ε), but the latter no larger than r, the smallest ε at which F is not linear
         any more; where both are zero r, else |F|/(∂F/∂ε), else |q̇|²/|F|,
         where |q̇| is at rest the speed at which momenta are not linear in it any more
    ω    the largest of |q̇|/l, of √(∂F/∂ε), and of ∂F/∂q̇; else √(|F|/l)
    qᵢ ~ max(|qᵢ|, l/√|Mᵢᵢ|),   q̇ᵢ ~ max(|q̇ᵢ|, ω l/√|Mᵢᵢ|),   t ~ 1/ω

F is measured as |F| = maxᵢ |Fᵢ|/√|Mᵢᵢ|. A scene that has none of these has no size, and it is set to 1. New units of
any coordinate, of time and of mass change all of these as they change the state. Alternatives: an array of the user as
a unit of its own would give r and φ of one array equal scales; exact dimensions would have to be declared.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Numbers = Float[np.ndarray, " n"]

# Points of the line at which forces are evaluated, as fractions of l: powers of two, so a reach is known to a factor of
# two. If l is unknown, these are all sizes of a double whose squares are finite and not zero.
_STEPS, _ALL_STEPS = 2.0 ** np.arange(-10.0, 41.0), 2.0 ** np.arange(-400.0, 401.0, 2.0)
# F is not linear if it deviates by this fraction of its change; a change below `_SEEN` may be rounding, and is ignored.
_BENT, _SEEN = 0.25, 1e-6


class Scales(NamedTuple):
    """The sizes of the coordinates `q` (n,), of the velocities `qdot` (n,) and of the time `t` at a state."""

    q: Numbers
    qdot: Numbers
    t: float
    reach: float = 1.0  # by how many times those of q a state may be moved until forces are not linear, 1 at least

    @classmethod
    def from_quantities(cls, evaluate: Callable, q: Numbers, qdot: Numbers) -> "Scales":
        """The scales at (q, qdot); `evaluate(name, q, qdot)` gives force, momentum or mass matrix at S states."""
        q, qdot = np.asarray(q, float), np.asarray(qdot, float)
        with np.errstate(all="ignore"):
            mass = np.diagonal(evaluate("mass_matrix", q[None], qdot[None])[0])
            return _compiled_scales(evaluate, np.sqrt(np.abs(mass)), q, qdot)


def _compiled_scales(evaluate, root: Numbers, q: Numbers, qdot: Numbers) -> Scales:
    heaviest = root.max(where=np.isfinite(root), initial=0.0) or 1.0
    root = np.where((root > 0) & np.isfinite(root), root, heaviest)
    along = np.cos(np.arange(1.0, len(q) + 1)) / root  # no symmetry moves all coordinates like this
    along = along / np.abs(along * root).max()

    def moved(name, steps, of_q, of_v):
        steps = np.asarray(steps)[:, None]
        return evaluate(name, q + steps * of_q, qdot + steps * of_v) / root

    far, fast = np.abs(q * root).max(), np.abs(qdot * root).max()
    steps = far * _STEPS if far > 0 else _ALL_STEPS
    slope, bent = _linear_range(lambda s: moved("force", s, along, 0.0), steps)
    here = float(np.nan_to_num(np.abs(moved("force", [0.0], along, 0.0)).max()))
    swing = fast / np.sqrt(slope) if slope > 0 else 0.0
    length = max(far, min(swing, bent or np.inf)) or bent or (here / slope if slope > 0 else 0.0)
    if not length and here > 0:
        limit = fast or _linear_range(lambda s: moved("momentum", s, 0.0, along), _ALL_STEPS)[1]
        length = limit**2 / here
    length = length or heaviest
    rate = max(fast / length, np.sqrt(slope))
    step = (rate or 1.0) * length
    low, high = moved("force", [-step, step], 0.0, along)
    rate = max(rate, float(np.nan_to_num(np.abs(high - low).max() / (2 * step)))) or np.sqrt(here / length) or 1.0
    reach = max(1.0, (bent or 0.0) / length)
    return Scales(np.maximum(np.abs(q), length / root), np.maximum(np.abs(qdot), rate * length / root), 1 / rate, reach)


def _linear_range(force: Callable, steps: np.ndarray) -> tuple[float, float]:
    """∂F/∂ε along a line, and the smallest step at which F is not linear; 0 if there is none."""
    linear, bent, change = _bracket_nonlinearity(force, steps)
    if not linear.any():  # a jump or a power, which are the same at all scales
        return 0.0, 0.0
    first = int(np.argmax(linear))
    slope = float(change[first] / steps[first])
    if not bent[first:].any():
        return slope, 0.0
    beyond = first + int(np.argmax(bent[first:]))
    low, high = float(steps[beyond - 1]), float(steps[beyond])
    for _ in range(_ROUNDS):  # so that it follows the units to the last digits
        between = np.geomspace(low, high, _BETWEEN)
        bent = _bracket_nonlinearity(force, between)[1]
        beyond = int(np.argmax(bent)) if bent[1:].any() else _BETWEEN - 1
        low, high = float(between[max(0, beyond - 1)]), float(between[beyond])
    return slope, high


# Rounds of this many steps, which leave 1e-11 of a reach that is known by a factor of four.
_ROUNDS, _BETWEEN = 8, 25


def _bracket_nonlinearity(force: Callable, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masks of the steps up to which F is linear and of those where it is not, and its change."""
    ahead, back, twice, twice_back, here = (force(x) for x in (steps, -steps, 2 * steps, -2 * steps, np.zeros(1)))
    odd, even = (ahead - back) / 2, (ahead + back) / 2 - here
    change, size = np.abs(odd).max(axis=1), np.maximum(np.abs(ahead), np.abs(back)).max(axis=1)
    doubled = np.abs((twice - twice_back) / 2 - 2 * odd).max(axis=1)
    off = np.maximum(np.abs(even).max(axis=1), np.where(np.isfinite(doubled), doubled, np.inf))
    seen = (np.maximum(change, np.abs(even).max(axis=1)) > _SEEN * size) & np.isfinite(size)
    linear = seen & (off <= _BENT * change) & (change > 0)
    return linear, seen & ~linear, change
