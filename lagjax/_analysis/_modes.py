"""`normal_modes`: small oscillations about an equilibrium, or about a steady motion.

    deviations x e^{st}:  (s² M + s (C + G) + K) x = 0     on the tangent space of the constraints

Cyclic coordinates are eliminated at constant momentum first (as Routh does): each is a mode of frequency zero. Where
all forces have a potential and L is even in the velocities, s² = −ω² are the eigenvalues of symmetric matrices.
Otherwise s are those of the first-order equations of motion.
"""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree
from scipy.sparse import csr_array, diags_array

from lagjax._analysis._closed_contacts import constrain_closed, one_sided_reason
from lagjax._analysis._eigen import exponents_and_modes, symmetric_modes, tangent_basis
from lagjax._analysis._equilibrium import require_steady
from lagjax._analysis._linearize import steady_matrices
from lagjax._analysis._lowest_modes import NO_MODES, lowest_modes, lowest_shift, needs_all
from lagjax._analysis._scene_state import SceneState
from lagjax._analysis._smoothness import is_smooth, require_smooth
from lagjax._analysis._solve import shortest_solution
from lagjax._analysis._sparse_balance import balance_of
from lagjax._equations import SparseMotion, dependent_rows, diagonal_scale, factorize, schur_complements
from lagjax._equations import rank as rank_of
from lagjax._interface import Layout, compile_for_one_call, is_concrete, show_str
from lagjax._primitives import accepts_singles, nan_unless
from lagjax._scene import System

Vector = Float[Array, " n"]
Matrix = Float[Array, "n n"]

# Eigenvalues below this many units of round-off of the largest, times n, are zero: ten times what LAPACK is off.
_UNITS = 16


class Modes(eqx.Module):
    """Small oscillations of n degrees of freedom: n modes, in ascending order of frequency. Print them for a table.

    - `frequencies` (n,): ω in radians per unit of time; zero for a mode that does not oscillate.
    - `shapes`: the deviation of every coordinate, in the structure of q with the mode as first axis. Real, xᵀM x = 1
      and the largest entry positive, where nothing turns or damps and L has a scalar program (see
      `System.explain`); else complex with xᴴM x = 1.
    - `stable` (): whether no mode grows exponentially. A mode of frequency zero may still drift away.
    - `exponents` (n, 2), complex: both s of e^{st}, iω and −iω of an oscillation, ±κ of an instability.
    - `damping_ratios` (n,): −Re s/|s| of the first of them; zero without damping.
    """

    frequencies: Float[Array, " n"]
    shapes: PyTree
    stable: Bool[Array, ""]
    exponents: Complex[Array, "n 2"]
    damping_ratios: Float[Array, " n"]

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        if self.frequencies.ndim != 1 or not is_concrete(self.frequencies):
            return repr(self)
        frequencies, exponents = np.asarray(self.frequencies), np.asarray(self.exponents)
        size = np.abs(exponents).max(initial=0)
        rows = [f"{'mode':>4} {'frequency':>14} {'damping ratio':>14}  "]
        for k, (frequency, pair) in enumerate(zip(frequencies, exponents, strict=True)):
            ratio = float(np.asarray(self.damping_ratios)[k])
            rows.append(f"{k:4d} {frequency:14.8g} {ratio:14.4g}  {_mode_kind(pair, size)}")
        rows.append("stable" if self.stable else "unstable")
        return "\n".join(row.rstrip() for row in rows)


def _mode_kind(pair: np.ndarray, size: float) -> str:
    small, real, imaginary = _growth_threshold(size), np.real(pair), np.imag(pair)
    if np.abs(pair).max() <= small:
        return "zero mode: neutral, may drift"
    if real.max() > small:
        return f"grows, e-fold in {1 / real.max():.4g}"
    if np.abs(imaginary).max() > 0:
        return "oscillates" if real.min() >= -small else "oscillates and decays"
    return "decays" if real.max() < -small else "decays to a neutral position"


def _growth_threshold(size):
    """Return the real part that counts as growth: rounding splits a double zero by √eps of the largest exponent."""
    return 7 * float(np.finfo(size.dtype).eps) ** 0.5 * size


@accepts_singles(("q", "qdot"), ("params",))
def normal_modes(
    system: System, q: PyTree, params: PyTree = None, *, qdot: PyTree = None, count: int | None = None
) -> Modes:
    r"""The small oscillations of `system` about its equilibrium `q`.

        (s² M + s (C + G) + K) x = 0,   q(t) = q + Re(x e^{st}),   s = ±iω where nothing damps and nothing turns

    with M = ∂²L/∂q̇², the stiffness K = −∂F/∂q and the damping and gyroscopic terms C + G = −∂F/∂q̇ of the force F.

    - `q`: an equilibrium, as `equilibrium` finds it.
    - `qdot`: for a steady motion, its velocities, as `equilibrium` takes them. The modes are then the oscillations
      about that motion at constant momenta of the cyclic coordinates, in coordinates that move with it.
    - `count`: how many modes to give, the lowest ones; by default all of them. `stable` is about all of them. A large
      scene with sparse matrices (see `System.explain`) needs it: of 10⁴ coordinates, the 50 lowest take seconds. There
      constraints have to be independent, nothing may damp or turn, and the call cannot be traced.

    With constraints, the modes are those of the deviations that the constraints allow, as many as there are degrees of
    freedom, and the constraint forces contribute (a pendulum is held by its rod). So it is with contacts that are
    closed at q and press. Works under `jit`, `vmap` and `grad`, also where frequencies are equal: first derivatives are
    right for functions that are symmetric in the modes of equal frequency (their sum, say); the derivative of a single
    mode is that of the mode as it is numbered. Second derivatives are right for the sum of ω² alone. The frequency of a
    zero mode has the derivative zero, which is right where a symmetry makes the mode zero. With friction or gyroscopic
    forces, derivatives are NaN where two modes coincide and share one shape (critical damping).

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, for a scene that depends on the time, for
    a q that is no equilibrium, where M is not positive definite, or where the force jumps or has a kink at q, as dry
    friction at rest does: nothing is linear there. Inside `jit` the modes are NaN instead. There all
    constraints are taken as independent, and modes are NaN where they are not.

    Source: Landau & Lifshitz, *Mechanics*, §23–25; Routh, *Stability of a Given State of Motion*, ch. IV; derivatives:
    Fox & Kapoor, AIAA J. 6 (1968) 2426.

    ```python
    import jax.numpy as jnp, lagjax

    pendulum = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q))
    print(lagjax.normal_modes(pendulum, 0.0))  # sqrt(9.81)
    ```
    """
    if count is not None and (type(count) is not int or count < 1):
        raise ValueError(f"count must be a positive integer, or None for all modes; got {count!r}.")
    if held := constrain_closed(system, q, qdot, params, "A normal mode"):
        system, q = held.system, held.require_loaded(q, qdot, params, one_sided_reason("A small oscillation"))
    scene = SceneState.from_state(system, q, qdot, params, sparse=True)
    scene.require_autonomous("A normal mode")
    if scene.large:
        modes, residual = _large_modes(scene, qdot, count)
    else:
        require_steady(scene)
        require_smooth(scene, "A normal mode")
        cyclic, rank = scene.conserved, _count_independent_constraints(scene)
        reversible = scene.reversible and qdot is None
        modes, residual = _dense_modes(cyclic, rank, reversible, *scene.arguments)
    if scene.concrete and not residual <= _BALANCED:
        made = f" that a deviation of {float(residual):.2g} of q's size would make" if np.isfinite(residual) else ""
        raise ValueError(
            f"q is not an equilibrium: forces are left{made}. Find one first: "
            "q = lagjax.equilibrium(system, q, params).q."
        )
    if scene.concrete and not np.isfinite(np.asarray(modes.exponents)).all():
        raise ValueError(NO_MODES)
    frequencies, exponents, ratios = (x[:count] for x in (modes.frequencies, modes.exponents, modes.damping_ratios))
    shapes = jax.tree.map(lambda x: x[:count], modes.shapes)
    return Modes(frequencies, shapes, modes.stable, exponents, ratios)


# How far from an equilibrium modes are still those of it, in units of the size of q. Linear in that are their errors.
# An equilibrium of n coordinates that is given in float32 is off by 6e-8 √n at most.
_BALANCED = 1e-6


def _count_independent_constraints(scene: SceneState) -> int:
    """Return the number of independent constraints at q; if q is traced, of all constraints."""
    if not scene.constrained:
        return 0
    jacobian = scene.jacobian(scene.q, scene.qdot)
    if not scene.concrete:
        if len(jacobian) >= scene.layout.size:
            raise ValueError(
                f"There are {len(jacobian)} constraints for {scene.layout.size} coordinates, which leave nothing to "
                "oscillate if they are independent, as they count inside jit, vmap and grad. Drop the redundant ones."
            )
        return len(jacobian)
    mass = scene.mass_matrix(scene.q, scene.qdot)
    return len(jacobian) - len(dependent_rows(schur_complements(*(np.asarray(x)[None] for x in (mass, jacobian)))[0]))


@compile_for_one_call
def _dense_modes(cyclic: tuple[int, ...], rank: int, reversible: bool, *arguments) -> tuple:
    """Return the modes of the k degrees of freedom, and the distance of q from an equilibrium."""
    scene = SceneState.from_arguments(*arguments)
    q, matrices = scene.q, steady_matrices(scene, scene.q)
    unit = jax.lax.stop_gradient(diagonal_scale(matrices[0]))
    mass, rates, stiffness = (unit[:, None] * x * unit for x in matrices[:3])
    jacobian = matrices[3] * unit
    slopes = jnp.sqrt(jnp.sum(jnp.concatenate([stiffness, jacobian]) ** 2, axis=1))
    rows = scene.motion.constraints.residual(q, scene.qdot, jnp.zeros((), q.dtype), scene.numbers)
    force = None if scene.constrained else lambda place: scene.force(unit * place, scene.qdot) * unit
    values = jnp.concatenate([matrices[4] * unit, rows])
    residual = jax.lax.stop_gradient(_imbalance(values, slopes, q / unit, stiffness, shortest_solution, force))
    residual = residual + jnp.where(_has_rank(jacobian, rank), 0, jnp.nan)
    gone, keep = np.array(cyclic, int), np.setdiff1d(np.arange(len(q)), cyclic)
    reduced, follow = _eliminate_cyclic(mass, rates, stiffness, keep, gone)
    basis = tangent_basis(jacobian[:, keep], rank)
    within = tuple(basis.T @ x @ basis for x in reduced)
    solve = _reversible_modes if reversible else _general_modes
    nothing = jnp.zeros((0, 2), jnp.result_type(q.dtype, jnp.complex64)), jnp.zeros((0, 0), q.dtype)
    exponents, amplitudes = solve(*within) if basis.shape[1] else nothing
    moved = (basis.astype(amplitudes.dtype) @ amplitudes).T  # (k, n without the cyclic ones)
    shapes = jnp.zeros((len(moved), len(q)), moved.dtype).at[:, keep].set(moved)
    shapes = shapes.at[:, gone].set(follow(moved, exponents[:, 0]))
    if len(gone):
        own = jnp.eye(len(q), dtype=shapes.dtype)[gone]
        exponents = jnp.concatenate([jnp.zeros((len(gone), 2), exponents.dtype), exponents])
        shapes = jnp.concatenate([own, shapes])
    balanced = (residual <= _BALANCED) & is_smooth(scene)
    return _build_modes(scene.layout, exponents, shapes, shapes @ mass.T.astype(shapes.dtype), unit, balanced), residual


@compile_for_one_call
def _build_modes(layout: Layout, exponents: Array, shapes: Array, weighted: Array, unit: Vector, balanced) -> Modes:
    """Return `Modes` of exponents (k, 2) and shapes x (k, n) in the `unit` (n,) of coordinates; NaN unless `balanced`.

    `weighted` are the M x (k, n).
    """
    shapes = _normalise_shapes(shapes, weighted)
    order = jnp.argsort(jax.lax.stop_gradient(exponents[:, 0].imag), stable=True)
    shapes = shapes[order] * unit
    exponents = jax.lax.complex(*(nan_unless(balanced, x) for x in (exponents.real, exponents.imag)))[order]
    shapes = layout.restore(jnp.where(balanced, shapes, jnp.nan))
    size = jnp.max(jnp.abs(exponents), initial=0)
    stable = jnp.all(exponents.real <= _growth_threshold(size)) & jnp.all(jnp.isfinite(exponents))
    first = exponents[:, 0]
    ratios = jnp.where(first.real == 0, 0, -first.real / jnp.abs(jnp.where(first == 0, 1, first)))
    return Modes(first.imag, shapes, stable, exponents, ratios)


def _large_modes(scene: SceneState, qdot: PyTree, count: int | None) -> tuple[Modes, Array]:
    """Return the `count` lowest modes of a large scene, None: all, and the distance of q from an equilibrium."""
    n, motion = scene.layout.size, scene.motion
    state = scene.q, scene.qdot, jnp.zeros((), scene.q.dtype), scene.numbers
    freedoms = n - jax.eval_shape(motion.residual, *state).size
    if needs_all(count, freedoms) and n > _MOST_MODES:
        raise ValueError(
            f"{count or freedoms} modes of {n} coordinates take {8 * n * n / 2**30:.2g} GB of shapes, and more on the "
            f"way: ask for the lowest ones, normal_modes(…, count=50), up to {freedoms // 4}."
        )
    if qdot is not None:
        raise ValueError(f"Modes about a steady motion of {n} coordinates are not tried: leave qdot out.")
    of = balance_of(scene, "A normal mode")
    z, x = np.concatenate([scene.q, of.multipliers]), np.random.default_rng(0).normal(size=n)
    entries, unit, rate = map(np.asarray, _scaled_mass_and_damping(motion, jnp.asarray(x), *state))
    form = cast(Any, motion).structure.mass
    scale, whole = diags_array(unit), of.jacobian(z)
    mass = scale @ csr_array((entries, (form.rows, form.columns))) @ scale
    forces, jacobian = scale @ whole[:n, :n] @ scale, whole[n:, :n] @ scale
    size, small = float(abs(forces).sum(axis=1).max()), np.finfo(float).eps ** 0.6
    if np.abs(rate).max() > small * size**0.5 or abs(forces - forces.T).max() > small * size:
        raise ValueError(
            f"Of {n} coordinates, modes are found where all forces have a potential: some of these damp, turn (as in a "
            "rotating frame or a magnetic field), or have a curl. Leave them out, or simulate and look at the motion."
        )
    stiffness, mass = -0.5 * (forces + forces.T), 0.5 * (mass + mass.T)
    slopes = np.sqrt(np.concatenate([(stiffness**2).sum(axis=1), (jacobian**2).sum(axis=1)]))
    values, units = of.residual(z), np.append(unit, np.ones(len(z) - n))
    force = None if scene.constrained else lambda place: unit * of.residual(unit * place)
    solve = lambda _, b: lowest_shift(stiffness, mass)[1].solve(b)  # noqa: E731
    residual = _imbalance(units * values, slopes, scene.q / unit, stiffness, solve, force)
    squares, shapes = lowest_modes(stiffness, mass, jacobian, count)
    exponents = _exponents_of_squares(squares, _UNITS * n**0.5 * np.finfo(float).eps * size)
    return _build_modes(scene.layout, exponents, shapes.T, (mass @ shapes).T, unit, residual <= _BALANCED), residual


@compile_for_one_call
def _scaled_mass_and_damping(motion: SparseMotion, x: Vector, *state) -> tuple[Array, Vector, Vector]:
    """Return the entries of M, the unit (n,) of each coordinate, and ∂F/∂q̇ x in these units."""
    (q, qdot, t, numbers), form = state, cast(Any, motion.structure.mass)
    entries, unit = form.read(motion.mass_product(*state), q.dtype), motion.unit(*state)
    return entries, unit, unit * jax.jvp(lambda v: motion.force(q, v, t, numbers), (qdot,), (unit * x,))[1]


# Modes that are given where all are asked for: 2000 shapes of 2000 numbers are 32 MB, and take LAPACK half a minute.
_MOST_MODES = 2000


def _has_rank(jacobian: Float[Array, "m n"], rank: int) -> Bool[Array, ""]:
    if not len(jacobian):
        return jnp.asarray(True)
    lengths = jnp.sqrt(jnp.sum(jacobian**2, axis=1, keepdims=True))
    unit = jax.lax.stop_gradient(jacobian / jnp.where(lengths > 0, lengths, 1))
    return rank_of(unit @ unit.T) == rank


def _imbalance(values: Any, slopes: Any, place: Any, stiffness: Any, solve: Callable, force: Callable | None):
    """The distance of q from an equilibrium, in units of its size, by `values` (n + m,) of forces and constraints, in
    the unit of each coordinate; q is the `place`, `slopes` (n + m,) the lengths of the rows of K and J, `solve(K, b)` a
    solution of K x = b. Zero also where without constraints the `force` is linear up to a thousand times as far: no
    mode changes."""
    xp = slopes.__array_namespace__()
    # A row without any gradient may be left with the rounding of the others.
    slopes = xp.where(slopes > 0, slopes, xp.max(slopes, initial=0) * 1e-6)
    allowed = slopes * xp.max(xp.abs(place), initial=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = xp.max(xp.where(values == 0, 0, xp.abs(values) / xp.where(allowed > 0, allowed, 0)), initial=0)
    if force is not None:
        step = solve(stiffness, values)
        expected = values - _FURTHER * stiffness @ step
        size = xp.max(xp.abs(values), initial=0)
        balances = xp.max(xp.abs(stiffness @ step - values), initial=0) <= 1e-3 * size
        bends = xp.max(xp.abs(force(place + _FURTHER * step) - expected), initial=0) > _BENT * _FURTHER * size
        off = xp.where(balances & ~bends, 0, off)
    return off


# How many times as far as an equilibrium is forces are looked at, and by which part they may differ from linear ones
# there: the modes are then off by a millionth.
_FURTHER, _BENT = 1e3, 1e-3


def _eliminate_cyclic(mass: Matrix, rates: Matrix, stiffness: Matrix, keep: np.ndarray, gone: np.ndarray):
    """Return M, C + G, K of the coordinates `keep` at constant momenta of the cyclic `gone`; and a function that

    computes the amplitudes of these.
    """
    if not len(gone):
        return (mass, rates, stiffness), lambda moved, exponents: moved[:, :0]
    within, across = np.ix_(keep, keep), np.ix_(keep, gone)
    own = factorize(mass[np.ix_(gone, gone)])
    by_mass = own.solve_columns(mass[np.ix_(gone, keep)])  # δq̇ of the cyclic ones is −(by_mass δq̇ + by_rates δq)
    by_rates = own.solve_columns(rates[np.ix_(gone, keep)])
    reduced = (
        mass[within] - mass[across] @ by_mass,
        rates[within] - mass[across] @ by_rates - rates[across] @ by_mass,
        stiffness[within] - rates[across] @ by_rates,
    )

    def follow(moved, exponents):
        shifted = -moved @ by_mass.T.astype(moved.dtype)
        if not jnp.iscomplexobj(moved):  # nothing turns
            return shifted
        at_rest = exponents == 0
        drift = moved @ by_rates.T.astype(moved.dtype) / jnp.where(at_rest, 1, exponents)[:, None]
        return jnp.where(at_rest[:, None], 0, shifted - drift)

    return reduced, follow


def _reversible_modes(mass: Matrix, rates: Matrix, stiffness: Matrix) -> tuple[Array, Array]:
    """Return exponents (k, 2) and real amplitudes (k, k), in columns, of K x = ω² M x; NaN if velocities matter."""
    squares, shapes = symmetric_modes(stiffness, mass)
    size = jnp.max(jnp.abs(squares))
    zero = _UNITS * len(mass) * jnp.finfo(size.dtype).eps * jax.lax.stop_gradient(size)
    ignored = jnp.max(jnp.abs(shapes.T @ rates @ shapes)) <= jnp.finfo(size.dtype).eps ** 0.6 * jnp.sqrt(size)
    return _exponents_of_squares(squares, zero, ignored), shapes


@compile_for_one_call
def _exponents_of_squares(squares: Array, zero, ok=True) -> Array:
    """Return s = iω, −iω, or κ, −κ, (k, 2), of squares ω² (k,); 0 for those up to `zero`, NaN if not `ok`."""
    rate = jnp.sqrt(jnp.where(jnp.abs(squares) > zero, jnp.abs(squares), 1))
    frequency, growth = jnp.where(squares > zero, rate, 0), jnp.where(squares < -zero, rate, 0)
    frequency, growth = nan_unless(ok, frequency), nan_unless(ok, growth)
    return jnp.stack([jax.lax.complex(growth, frequency), jax.lax.complex(-growth, -frequency)], axis=1)


def _general_modes(mass: Matrix, rates: Matrix, stiffness: Matrix) -> tuple[Array, Array]:
    """Return two exponents for each mode (k, 2), and the complex amplitudes of the coordinates (k, k), in columns."""
    k, inverse = len(mass), factorize(mass)
    by_q, by_qdot = -inverse.solve_columns(stiffness), -inverse.solve_columns(rates)
    fastest = jax.lax.stop_gradient(jnp.maximum(jnp.sqrt(jnp.max(jnp.abs(by_q))), jnp.max(jnp.abs(by_qdot))))
    fastest = jnp.where((fastest > 0) & (fastest < jnp.inf), fastest, 1)
    above = [jnp.zeros_like(mass), fastest * jnp.eye(k, dtype=mass.dtype)]
    values, vectors = exponents_and_modes(jnp.block([above, [by_q / fastest, by_qdot]]))
    return jnp.stack([values[:k], values[k:]], axis=1), vectors[:k, :k]


def _normalise_shapes(shapes: Array, weighted: Array) -> Array:
    """Scale shapes x (k, n) to xᴴM x = 1 and a positive largest entry; `weighted` (k, n) are the M x."""
    shapes = shapes / jnp.sqrt(jnp.sum(shapes.conj() * weighted, axis=1, keepdims=True).real).astype(shapes.dtype)
    sizes = jnp.abs(jax.lax.stop_gradient(shapes))
    # The first of those that are equal but for rounding: a symmetric shape has its sign by no accident.
    at = jnp.argmax(sizes > 0.999 * jnp.max(sizes, axis=1, keepdims=True), axis=1)
    largest = jnp.take_along_axis(shapes, at[:, None], axis=1)
    if not jnp.iscomplexobj(shapes):
        return shapes * jnp.sign(jax.lax.stop_gradient(largest))
    return shapes * (largest.conj() / jnp.abs(largest))
