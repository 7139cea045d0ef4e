"""The scene of a fit: a `System`, or a `Hybrid`, whose motion goes through several."""

from typing import Any

from lagjax._hybrid import Hybrid, simulate_hybrid
from lagjax._simulate import simulate
from lagjax._system import System, require_system
from lagjax._trajectory import Trajectory

PyTree = Any
Scene = System | Hybrid


def require_scene(scene: Any) -> Scene:
    """The scene with its functions as they are now.

    Raises `TypeError` for what is neither a `System` nor a `Hybrid`.
    """
    return scene.now() if isinstance(scene, Hybrid) else require_system(scene)


def first_law(scene: Scene) -> System:
    """The system that a motion begins in."""
    return scene.modes[scene.start] if isinstance(scene, Hybrid) else scene


def laws(scene: Scene) -> tuple[System, ...]:
    """The systems that a motion may be in."""
    return tuple(scene.modes.values()) if isinstance(scene, Hybrid) else (scene,)


def follow(scene: Scene, q0: PyTree, qdot0: PyTree, ts, params: PyTree, **options) -> Trajectory:
    """The motion of a scene, with the `options` that `simulate` and `simulate_hybrid` share."""
    if not isinstance(scene, Hybrid):
        return simulate(scene, q0, qdot0, ts, params, **options)
    modes, transitions, start = scene.modes, scene.transitions, scene.start
    return simulate_hybrid(
        modes, transitions, start, q0, qdot0, ts, params, max_transitions=scene.max_transitions, **options
    )
