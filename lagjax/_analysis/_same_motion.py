"""`same_motion`: a test that two Lagrangians have the same motions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax._analysis._noether import FlatState, euler_lagrange
from lagjax._analysis._random_states import perturb_last_digits, random_states
from lagjax._analysis._scene_state import SceneState
from lagjax._interface import Layout, compile_for_one_call, show_str
from lagjax._primitives import accepts_singles
from lagjax._scene import System, require_system

# What may be left of the difference, beside the terms that cancel in it: rounding leaves some 1e-15 of them, and as
# much of what the numbers of two scenes are made of. Where terms cancel within L more is left: this many times what it
# is seen to change between states a few units in the last place apart, but never more than the last.
_SAME, _CHANCE, _LARGEST_ERROR = 1e-13, 100.0, 1e-8
_STATES = 64  # random ones, of which rounding decides at none


class SameMotion(NamedTuple):
    """The answer whether two systems have the same Euler–Lagrange equations up to a factor.

    - `same`: True or False.
    - `factor`: the best f in E_a = f E_b; NaN where b has no equations.
    - `residual`: the largest |E_a − f E_b| over the terms of E_a, of any coordinate at any of the states; `threshold`:
      up to which it may be rounding, and the two count as the same.
    - `where`: a sentence that names the coordinate and the state at which it is largest.
    """

    same: bool
    factor: float
    residual: float
    threshold: float
    where: str

    def __bool__(self) -> bool:
        return self.same

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        left = f"{self.residual:.1g} of the terms are left, and {self.threshold:.1g} may be rounding"
        if self.same:
            return f"The same motions: E_a = {self.factor:.9g} E_b; {left}."
        return f"Other motions: with the best factor, {self.factor:.9g}, {left}: {self.where}."


@accepts_singles(("q", "qdot"), ("params",))
def same_motion(a: System, b: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, seed: int = 0) -> SameMotion:
    r"""Test if L_a = f L_b + dG(q, t)/dt for a number f, so that both systems have the same motions.

        E = d/dt ∂L/∂q̇ − ∂L/∂q − Q,     E_a = f E_b  for all q, q̇, q̈ and t

    The identity is tested to rounding at 64 random states about (q, q̇), as far off as the size of its numbers and the
    forces there suggest, in any units, with random accelerations q̈; no G need be known. Forces Q
    count as well. Lagrangians of one motion may differ by more than f and G (a decoupled coordinate may have a factor
    of its own): those do not count as the same here.

    - `a`, `b`: systems of the same coordinates and parameters, without constraints.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, systems with constraints, or where
    a Lagrangian is not finite about the state.

    Source: Landau & Lifshitz, *Mechanics*, §2; Olver, *Applications of Lie Groups*, Theorem 4.7.

    ```python
    import jax.numpy as jnp, lagjax

    free = lagjax.System(lambda q, v: 0.5 * v**2)
    boosted = lagjax.System(lambda q, v: 0.5 * (v + 3.0) ** 2)
    assert lagjax.same_motion(free, boosted, 0.0, 1.0).same
    ```
    """
    a, b = require_system(a), require_system(b)
    scenes = SceneState.from_state(a, q, qdot, params), SceneState.from_state(b, q, qdot, params)
    if any(scene.constrained for scene in scenes):
        raise ValueError("same_motion compares Lagrangians: give systems without constraints.")
    if not all(scene.concrete for scene in scenes):
        raise ValueError("same_motion looks at numbers: call it outside of jit, vmap and grad, on one state.")
    piecewise = any(scene.piecewise for scene in scenes)
    states = random_states(scenes[0], scenes[0].scales, _STATES, seed, piecewise)
    if (differences := _compare_equations(scenes, states)) is None:
        raise ValueError(
            "A Lagrangian, or a derivative of it, is not finite at most states about (q, qdot): give a state in the "
            "middle of where motions take place."
        )
    factor, relative, well = differences
    beside = _compare_equations(scenes, perturb_last_digits(states))
    noise = 0.0 if beside is None else float(np.median(np.abs(relative - beside[1]).max(axis=1)[well & beside[2]]))
    threshold = min(max(_SAME, _CHANCE * noise), _LARGEST_ERROR)
    state, coordinate = map(int, np.unravel_index(np.argmax(relative), relative.shape))
    residual = float(relative[state, coordinate])
    same = residual <= threshold and np.isfinite(factor) and factor != 0
    where = _transform_point(scenes[0].layout, jax.tree.map(np.asarray, states), state, coordinate)
    return SameMotion(bool(same), factor, residual, threshold, where)


def _compare_equations(scenes, states: FlatState) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Return the factor f, |E_a − f E_b| over its terms (S, n), and which states are finite (S,); None if few are."""
    (of_a, size_a), (of_b, size_b) = (map(np.asarray, _residuals(states, *scene.arguments)) for scene in scenes)
    well = np.asarray(np.isfinite(of_a).all(axis=1) & np.isfinite(of_b).all(axis=1))
    if well.sum() < _STATES // 4:
        return None
    of_a, of_b, size_a, size_b = (np.where(well[:, None], x, 0.0) for x in (of_a, of_b, size_a, size_b))
    unit = size_a.max(axis=0)  # of each coordinate
    unit = np.where(unit > 0, unit, size_b.max(axis=0))
    unit = np.where(unit > 0, unit, 1.0)
    of_a, of_b, size_a, size_b = (x / unit for x in (of_a, of_b, size_a, size_b))
    largest = np.abs(of_b).max(initial=0.0) or 1.0  # whose square need not be a double
    total = float(np.sum((of_b / largest) ** 2))
    factor = float(np.sum(of_a * (of_b / largest))) / total / largest if total > 0 else float("nan")
    left = np.abs(of_a - (factor * of_b if total > 0 else 0))
    terms = np.maximum(size_a.max(axis=0), abs(np.nan_to_num(factor)) * size_b.max(axis=0))
    return factor, left / np.where(terms > 0, terms, 1.0), well


@compile_for_one_call
def _residuals(states: FlatState, *arguments) -> tuple[Array, Array]:
    """Return E (S, n) and the size of its terms (S, n)."""
    scene = SceneState.from_arguments(*arguments)

    def equation_and_size(state):
        rate, by_q = euler_lagrange(scene.lagrangian, state)
        force = scene.motion.nonconservative_force(state.q, state.qdot, state.t, scene.numbers)
        return rate - by_q - force, jnp.abs(rate) + jnp.abs(by_q) + jnp.abs(force)

    return jax.lax.map(equation_and_size, states)


def _transform_point(layout: Layout, states: FlatState, k: int, coordinate: int) -> str:
    def format_values(x):
        return ", ".join(f"{value:.4g}" for value in x[k][:8]) + (", …" if x.shape[1] > 8 else "")

    return (
        f"the equation of {layout.names[coordinate]} at q = ({format_values(states.q)}), "
        f"velocities ({format_values(states.qdot)}), t = {states.t[k]:.4g}"
    )
