"""`check`: what is wrong with a scene at a state, before anything is integrated.

Everything is computed once, by the programs of the scene: values, derivatives, their finite differences, the mass
matrix at states nearby, the linearised motion. What follows is NumPy and sentences, each file for one question.
`_scene_at_start` is what they all look at, `_findings` what they return. In their order: `_derivative_checks` (by
`_differences`), `_constraint_checks` (with contacts), `_mass`, `_jumps_near`, `_stiffness`.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, PyTree

from lagjax._engine import DEFAULT_RTOL
from lagjax._equations import derivation_of, forms
from lagjax._interface import Layout, is_concrete, join_names, not_finite, require_number
from lagjax._native import ATOL_OVER_MOTION, ATOL_OVER_RTOL
from lagjax._primitives import accepts_singles
from lagjax._scene import ROLES, System, replace_functions, require_system
from lagjax._trust.checks import _constraint_checks, _derivative_checks, _jumps_near, _mass, _stiffness
from lagjax._trust.checks._findings import Finding, Findings
from lagjax._trust.checks._mass import describe_direction
from lagjax._trust.checks._scene_at_start import CheckedScene

# Units of atol: in a motion that is smaller, the errors that atol allows add up to a hundredth within a hundred steps.
_SMALLEST_COORDINATE = 1e4


def check(system: System, q: PyTree, qdot: PyTree, t: Float[ArrayLike, ""] = 0.0, params: PyTree = None) -> Findings:
    r"""Check `system` at the state (q, qdot): what is wrong with it, or worth knowing before it is integrated.

    Derivatives are compared with finite differences, [L(x + hᵢ) − L(x − hᵢ)]/2hᵢ and those of higher order, with steps
    over many scales, centred and one-sided; in large scenes along random lines, and what is not looked at stands in
    `Findings.omitted`. Where the mass matrix M = ∂²L/∂q̇² is singular, it is examined in the neighbourhood as well, to
    find the reason. The arguments are those of `System.acceleration`: numbers, not batches.

    **Kinds** of findings, by level (`Finding.level` may be lower for a mild case):

    - error: `not_finite` (a number given), `value_not_finite` (of L, a force, D), `derivative_not_finite`, `kink` (of L
      by a velocity, or of a constraint, at this state; where the acceleration jumps it is advice), `wrong_derivative`
      (of a custom rule), `constraint_not_finite`, `constraint_zero_gradient`, `inconsistent_start`; for a singular mass
      matrix `velocity_unused`, `linear_in_velocity`, `velocity_combination`, `gauge`, `coordinate_singularity`,
      `singular_at_velocity`, `singular_saddle_point`; `acceleration_not_finite`; `contact_inside` (a negative gap),
      `contact_zero_gradient`.
    - warning: `creates_energy` (a dissipation function of the wrong sign), `indefinite_mass_matrix`,
      `near_coordinate_singularity`, `velocity_constraint_not_affine`, `discontinuity`.
    - advice: `single_precision`, `integer_parameter`, `small_state`, `ill_conditioned`, `dependent_constraints`,
      `stiff`, `explicit_time`, `contact_inwards` (a closed gap that moves inwards).

    **Raises** `TypeError` or `ValueError`, with the messages of `simulate`, for a state or functions with which no
    motion can begin; `ValueError` inside `jit`, where there are no numbers.

    Source: Press et al., *Numerical Recipes*, §5.7 (differences); Hairer & Wanner, *Solving Ordinary Differential
    Equations II*, §IV.1 (stiffness).

    ```python
    import jax.numpy as jnp, lagjax

    light = lagjax.System(lambda q, qdot: -jnp.sqrt(1.0 - jnp.sum(qdot**2)) - jnp.sum(q**2))  # relativistic
    findings = lagjax.check(light, jnp.ones(2), jnp.array([1.0, 0.0]))
    print(findings)  # the root has no derivative at the speed of light: names the line
    assert not findings.ok
    ```
    """
    system = require_system(system, contacts=True)
    layout = Layout.from_state(q, qdot)
    require_number(t, "t")
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves((q, qdot, t, params))):
        raise ValueError("check needs numbers, not traced values: call it outside of jit, vmap and grad, on one state.")
    reported = list(_check_inputs(layout, q, qdot, t, params))
    if any(finding.level == "error" for finding in reported):
        return Findings.sort(reported)
    found, omitted = _scene_findings(system, q, qdot, t, params)
    return Findings.sort([*reported, *found], omitted)


@accepts_singles(("q", "qdot"), ("t", "params"))
def _scene_findings(system, q, qdot, t, params) -> tuple[list[Finding], str]:
    layout = Layout.from_state(q, qdot)
    if layout.size > forms.LARGEST_DENSE and not derivation_of(system, layout, params).form.is_sparse:
        system = replace_functions(system, {}, "array")
    scene = CheckedScene.from_state(system, layout, q, qdot, t, params)
    reported = [*_derivative_checks.findings(scene), *_check_dissipation(scene), *_constraint_checks.findings(scene)]
    reported += [*_constraint_checks.contact_findings(scene), *_mass.findings(scene)]
    if scene.is_large:
        reported += [] if any(finding.level == "error" for finding in reported) else _check_acceleration(scene)
        return [*reported, *_check_time(scene)], (
            f"Not looked at: time scales, jumps nearby, which constraints follow from others, and derivatives one by "
            f"one. That would take long for {layout.size} coordinates ({scene.derivation.form.structure})."
        )
    if not any(finding.level == "error" for finding in reported):
        known = {finding.where for finding in reported if finding.kind == "kink"}  # one finding for each direction
        nearby = [finding for finding in _jumps_near.findings(scene) if finding.where not in known]
        reported += [*_check_acceleration(scene), *nearby, *_stiffness.findings(scene)]
    return [*reported, *_check_time(scene)], ""


# ---- the arguments ---------------------------------------------------------------------------------------------------


def _check_inputs(layout: Layout, q, qdot, t, params) -> Iterator[Finding]:
    for name, tree in (("q", q), ("qdot", qdot), ("t", t), ("params", params)):
        for where, value in not_finite(tree, name):
            message = f"{where} is {value}: every number must be finite."
            yield Finding("not_finite", "error", (where,), message)
    yield from _check_precision(layout, q, qdot, params)
    yield from _check_small_coordinates(layout, q)


def _check_small_coordinates(layout: Layout, q) -> list[Finding]:
    """Return advice if an array of coordinates is so small beside another that the default atol is too coarse."""
    rtol, eps = DEFAULT_RTOL, float(np.finfo(layout.dtype).eps)
    paths = jax.tree_util.tree_leaves_with_path(q)
    leaves = {"q" + jax.tree_util.keystr(path): float(np.abs(np.asarray(leaf)).max(initial=0)) for path, leaf in paths}
    largest = max(leaves.values(), default=0.0)
    atol = rtol * min(ATOL_OVER_RTOL, ATOL_OVER_MOTION * largest)
    # What is no more than the rounding of the others stands for zero.
    small = tuple(name for name, size in leaves.items() if eps * largest < size < _SMALLEST_COORDINATE * atol)
    if not small:
        return []
    size = max(leaves[name] for name in small)
    message = (
        f"{join_names(small)}: {size:.1e} at most beside coordinates as large as {largest:.1e}, near the default atol "
        f"of {atol:.0e}, which is for all of them: errors of that size are allowed in every step. Use units in which "
        f"all coordinates are of one size, or pass atol={ATOL_OVER_RTOL * rtol * size:.0e}."
    )
    return [Finding("small_state", "advice", small, message)]


def _check_precision(layout: Layout, q, qdot, params) -> Iterator[Finding]:
    if layout.dtype == np.float32:
        wide = any(getattr(leaf, "dtype", None) == np.float64 for leaf in jax.tree.leaves((q, qdot, params)))
        what = "float64 was given, but JAX makes float32 of it" if wide else "The state is in float32"
        do = "" if jax.config.jax_enable_x64 else "call jax.config.update('jax_enable_x64', True) first and "  # pyright: ignore[reportAttributeAccessIssue]
        message = (
            f"{what}: machine code computes in float64 and rounds the result to {np.finfo(np.float32).eps / 2:.0e} of "
            f"its size; solvers of diffrax, on a GPU or where they are asked for, compute in float32. For more digits, "
            f"{do}pass float64."
        )
        yield Finding("single_precision", "advice", layout.names, message)
    integers = [
        "params" + jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(params)
        if eqx.is_array_like(leaf) and jnp.issubdtype(jnp.result_type(leaf), jnp.integer)
    ]
    if integers:
        message = (
            f"{join_names(integers)}: integers. Their products wrap around when they overflow, and nothing can be "
            "differentiated by them. Write 1.0 for 1 unless it counts something."
        )
        yield Finding("integer_parameter", "advice", tuple(integers), message)


# ---- what the forces do ----------------------------------------------------------------------------------------------


def _check_dissipation(scene: CheckedScene) -> list[Finding]:
    """Return a warning if the dissipation function adds energy to the motion at some velocity."""
    power, size = scene.measured.power.T
    usable = np.isfinite(power)
    gains = power < -np.sqrt(np.finfo(scene.layout.dtype).eps) * size
    if not (usable & gains).any():
        return []
    loses = (usable & (power > 0)).any()
    when = "at some velocities, and takes it out at others" if loses else "at every velocity that was tried"
    message = (
        f"The dissipation function puts energy in {when}: its force is -dD/dqdot, so that friction has D = + c/2 "
        "qdot**2 with c > 0. Turn its sign; a force that is meant to drive belongs into forces=..."
    )
    return [Finding("creates_energy", "warning", (), message)]


def _check_acceleration(scene: CheckedScene) -> list[Finding]:
    bad = ~np.isfinite(scene.solve_saddle()[0])
    if not bad.any():
        return []
    where = tuple(name for name, b in zip(scene.layout.names, bad, strict=True) if b)
    message = (
        f"The acceleration of {join_names(where)} is not finite, although M and the forces are: numbers overflow, or M "
        "is singular to working precision. Use units in which the motion is of order one."
    )
    return [Finding("acceleration_not_finite", "error", where, message)]


def _check_time(scene: CheckedScene) -> list[Finding]:
    functions = {role: getattr(scene.system, role) for role in ROLES}
    timed = tuple(role for role, f in functions.items() if f is not None and "t" in f.extras)
    if not timed:
        return []
    message = (
        f"{join_names(timed)}: may depend on the time, so that the energy h need not be conserved and a run must start "
        "at the right ts[0]."
    )
    return [Finding("explicit_time", "advice", timed, message)]
