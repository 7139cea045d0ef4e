"""Random states near that of a scene, at which identities are tested."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._analysis._noether import FlatState
from lagjax._analysis._scene_state import SceneState
from lagjax._equations import Scales
from lagjax._interface import compile_for_one_call

# How far states are drawn from that of the scene, in its scales: so that they do not come near an origin that is one
# scale away, and terms of different powers differ by more than rounding. Halved or doubled, the same symmetries are
# found in the ready scenes.
_NEAR = 0.5
_FAR = 5.0  # times as far those of a piecewise scene are drawn: one piece may have what the next one has not
_THIRD = 3  # of this many states one is drawn as far off as it takes for the forces not to be linear


def random_states(scene: SceneState, scales: Scales, count: int, seed: int, piecewise: bool) -> FlatState:
    """Return random states, (count, …) each, near that of the scene, on the constraints if there are any."""
    size, random = scene.layout.size, np.random.default_rng(seed)
    draws, t = random.uniform(-1, 1, (3, count, size)), random.uniform(-1, 1, count)
    beyond = np.where(np.arange(count) % _THIRD, 1.0, scales.reach ** random.uniform(0, 1, count))[:, None]
    q = np.asarray(scene.q) + (_FAR if piecewise else 1.0) * _NEAR * beyond * scales.q * draws[0]
    qdot, t = np.asarray(scene.qdot) + _NEAR * scales.qdot * draws[1], scales.t * t
    if scene.constrained:
        q, qdot = _project_states(q, qdot, t, scene.system, scene.layout, scene.params)
    return FlatState(*(jnp.asarray(x, scene.layout.dtype) for x in (q, qdot, scales.qdot / scales.t * draws[2], t)))


@compile_for_one_call
def _project_states(q, qdot, t, system, layout, params):
    motion, numbers = system._motion(layout, params), eqx.filter(params, eqx.is_array_like)
    return jax.vmap(lambda *y: motion.nearest_consistent(*y, numbers))(q, qdot, t)


def perturb_last_digits(states: FlatState) -> FlatState:
    """Return the states with every number changed by a few round-offs at random."""
    random = np.random.default_rng(0)
    return FlatState(*(x * (1 + _LAST * np.finfo(float).eps * random.choice([-1.0, 1.0], x.shape)) for x in states))


_LAST = 4  # units in the last place, which change what rounding leaves and nothing else
