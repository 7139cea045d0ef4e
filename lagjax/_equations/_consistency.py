"""The test that the start of a motion satisfies its constraints, before any work is done.

The measures and tolerances are those of `_constraints`. Here they are evaluated with the user's own arguments, and
violations become error sentences. Traced values, as under `jax.jit`, are not tested.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._equations._constraints import ROUNDINGS, TOLERANCE, is_inconsistent, rows_of_terms, sizes
from lagjax._equations._derivation import derivation_of
from lagjax._equations._linear import dependent_rows, diagonal_scale, schur_complements
from lagjax._equations._many_states import Sample
from lagjax._interface import Layout, is_concrete
from lagjax._primitives import accepts_singles


@accepts_singles(("q0", "qdot0"), ("ts", "params"))
def require_consistent(system, layout: Layout, ts, q0: PyTree, qdot0: PyTree, params: PyTree) -> None:
    """Raise `ValueError`, naming the constraint, if the start of a single motion is inconsistent.

    That is: a constraint is not finite, or has no gradient; as many are independent as there are coordinates, so that
    nothing can move; two of them contradict each other; or q0 or qdot0 is farther from one than `TOLERANCE` of its
    size, and the value of the constraint is more than `ROUNDINGS` of its own terms. Dependences between constraints are
    not tested in a large scene, where steps that do not arrive at the constraints end the motion.
    """
    if not has_constraints(system) or not all(map(is_concrete, jax.tree.leaves((ts, q0, qdot0, params, system)))):
        return
    names = system.constraint_names(layout, params)
    start = _measure_start(system, layout, ts, q0, qdot0, params)
    _require_gradients(names, start)
    dependent = {} if start.schur is None else dependent_rows(start.schur)
    functions = system.constraints, system.velocity_constraints  # one that asks for the time may prescribe a motion
    if not (start.driven or any("t" in function.extras for function in functions if function is not None)):
        _require_room(names, start, layout.size, len(names) - len(dependent))
    tolerance = TOLERANCE[layout.dtype]
    if next(_start_faults(names, start, dependent, tolerance, np.zeros((3, len(names)))), None) is None:
        return  # as most starts, without a look at rounding
    derivation, q, qdot, t, numbers, _ = start.sample
    terms = derivation.term_sizes(q[0], qdot[0], t, numbers, ("residual", "rates", "gamma"))
    rounding = ROUNDINGS * np.finfo(layout.dtype).eps * rows_of_terms(terms, (3, len(names)))
    for is_of_q, sentence in _start_faults(names, start, dependent, tolerance, rounding):
        if is_of_q:  # constraints that ask for different steps may still meet somewhere
            nearest, _ = eqx.filter_jit(system.project)(q0, qdot0, ts[0], params)
            if all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(nearest)):
                continue
        raise ValueError(sentence)


def _start_faults(names, start, dependent, tolerance, rounding) -> Iterator[tuple[bool, str]]:
    """Pairs (is a contradiction of positions, sentence) for faults beyond `rounding` (3, m) of values, rates and γ."""
    of_rows = (
        (start.values, start.size_q, "q0", "it"),
        (start.rates, start.size_qdot, "qdot0", "its rate of change"),
        (start.gamma, 0.0, "the acceleration", None),
    )
    for (values, size, what, quantity), left in zip(of_rows, rounding, strict=True):
        if clash := _contradiction(names, values, what, start.scaled_lengths, dependent, tolerance, size, left):
            yield what == "q0", clash
        for k, (name, value) in enumerate(zip(names, values, strict=True)):
            if quantity and abs(value) > max(tolerance * size * start.scaled_lengths[k], left[k]):
                distance = abs(value) / start.lengths[k]
                yield (
                    False,
                    f"{what} does not satisfy {name}: {quantity} is {value:.3g} there, a distance of {distance:.3g}. "
                    "Put the state on the constraints first: q0, qdot0 = system.project(q0, qdot0, t, params).",
                )


class _StartConditions(NamedTuple):
    """The residuals and sizes of m constraints at the first state of a motion with n coordinates, in NumPy."""

    values: np.ndarray  # f, and zero for constraints on velocities, (m,)
    rates: np.ndarray  # J q̇ + ∂f/∂t, then a, (m,)
    gamma: np.ndarray  # γ of G q̈ = γ, (m,)
    lengths: np.ndarray  # of the rows of G, (m,)
    scaled_lengths: np.ndarray  # the same with coordinates in units of 1/√Mᵢᵢ, (m,)
    schur: np.ndarray | None  # the Schur complement, (m, m); None for a large scene
    driven: np.ndarray  # whether the constraints move what is at rest, ()
    size_q: np.ndarray  # the largest coordinate in these units, ()
    size_qdot: np.ndarray  # the largest velocity, ()
    sample: Sample


def _require_gradients(names: list[str], start: _StartConditions) -> None:
    bad = np.flatnonzero(~np.isfinite(start[:4]).all(axis=0) | (start.lengths == 0))
    for k in bad[:1]:
        name, (value, rate, gamma, length) = names[k], (x[k] for x in start[:4])
        if not np.isfinite([value, rate, gamma, length]).all():
            raise ValueError(
                f"{name} is not finite at the initial state (value {value}, gradient {length}): start where it is "
                "finite, or write it so that it is finite there."
            )
        if length == 0 and name.startswith("velocity_constraints"):
            raise ValueError(
                f"{name} does not depend on qdot at the initial state, so that no force can keep it: pass what depends "
                "on q alone as constraints=…."
            )
        if length == 0:
            raise ValueError(
                f"{name} has zero gradient at the initial state, so that it exerts no force there: write it with a "
                "gradient that does not vanish where it is zero, f instead of f², say."
            )


def _require_room(names: list[str], start: _StartConditions, coordinates: int, independent: int) -> None:
    """Raise if as many constraints are independent as there are coordinates, so that nothing can move."""
    if len(names) > coordinates <= independent and start.schur is not None and np.isfinite(start.schur).all():
        raise ValueError(
            f"There are {len(names)} constraints ({', '.join(names)}) for {coordinates} coordinates, and {independent} "
            "of them are independent at the initial state: nothing can move. Drop those that are not meant."
        )


def _contradiction(names, values, what, lengths, dependent, tolerance, size, rounding) -> str | None:
    """A sentence if a constraint is a combination of others, but its value is not that combination of `values` (m,)."""
    # Errors of the quantity `what` count by `size`, or by the largest of `values`, of which `rounding` (m,) may be
    # left.
    size = max(size, np.max(np.abs(values) / lengths))
    for row, factors in dependent.items():
        weights = np.abs(factors) * lengths
        allowed = tolerance * size * (lengths[row] + weights.sum())
        if abs(values[row] - factors @ values) > max(allowed, rounding[row] + np.abs(factors) @ rounding):
            others = ", ".join(name for name, weight in zip(names, weights, strict=True) if weight)
            return (
                f"{names[row]} contradicts {others}: at the initial state it is a combination of them, but asks for "
                f"another value of {what}. They cannot all hold: drop or correct one."
            )
    return None


@accepts_singles(("values",), ("ts",))
def inconsistent_members(system, layout: Layout, ts, values: dict, axes: dict) -> jax.Array | None:
    """For each member of a batch: True if it starts off its constraints, (N,); None if that cannot be known."""
    # `values` holds q0, qdot0 and params of the batch, `axes` which axis of each counts the members.
    if not has_constraints(system) or not all(map(is_concrete, jax.tree.leaves((ts, values, system)))):
        return None

    begin, span = jnp.asarray(ts[..., 0]), jnp.abs(jnp.asarray(ts[..., -1]) - ts[..., 0])
    numbers, of = zip(*((values[name], axes[name]) for name in ("q0", "qdot0", "params")), strict=True)
    of_times = None if begin.ndim == 0 else 0

    def inconsistent(has_terms: bool):
        test = functools.partial(_inconsistent, has_terms, system, layout.dtype)
        return jax.vmap(test, in_axes=(of_times, of_times, *of))(begin, span, *numbers)

    found = inconsistent(False)
    return inconsistent(True) if found.any() else found  # what terms there are is compiled where it matters


@eqx.filter_jit
def _inconsistent(has_terms: bool, system, dtype, t, span, q0: PyTree, qdot0: PyTree, params: PyTree) -> jax.Array:
    layout = Layout.from_state(q0, qdot0)
    state = layout.flatten(q0), layout.flatten(qdot0), t, eqx.filter(params, eqx.is_array_like)
    derivation = derivation_of(system, layout, params)
    motion, terms = derivation.motion, derivation.term_sizes(*state) if has_terms else 0.0
    return is_inconsistent(motion, state, span, dtype, terms)


def _measure_start(system, layout: Layout, ts, q0: PyTree, qdot0: PyTree, params: PyTree) -> _StartConditions:
    """The conditions at the start of a motion; nothing is compiled if the scene has programs."""
    layout = dataclasses.replace(layout, dtype=Layout.from_state(q0, qdot0).dtype)  # in float64 also for float32
    q, qdot = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(x)]) for x in (q0, qdot0))
    q, qdot, t = (np.asarray(x, layout.dtype) for x in (q, qdot, ts[0]))
    sample = Sample.from_scene(system, layout, q[None], qdot[None], t, params)
    large = sample.derivation.form.is_sparse
    of = {name: value[0] for name, value in sample.quantities(*_ASKED, *(_LENGTHS if large else _MATRICES)).items()}
    on_positions = np.arange(len(of["residual"])) < sample.derivation.position_count
    if not large:
        mass, jacobian, unit = of["mass_matrix"], of["jacobian"], diagonal_scale(of["mass_matrix"])
        of |= {"unit": unit, "row_lengths": np.linalg.norm(jacobian, axis=1)}
        of |= {"unit_lengths": np.linalg.norm(jacobian * unit, axis=1)}
        of |= {"schur": schur_complements(mass[None], jacobian[None])[0]}
    size_q, size_qdot = sizes(of["unit"], q, qdot, abs(float(ts[-1]) - float(t)) or np.inf)
    values, driven = np.where(on_positions, of["residual"], 0), (of["driving"] != 0).any()
    rows = values, of["rates"], of["gamma"], of["row_lengths"], of["unit_lengths"]
    return _StartConditions(*rows, of.get("schur"), driven, size_q, size_qdot, sample)


_ASKED, _MATRICES = ("gamma", "residual", "rates", "driving"), ("mass_matrix", "jacobian")
_LENGTHS = ("unit", "row_lengths", "unit_lengths")


def has_constraints(system) -> bool:
    return system.constraints is not None or system.velocity_constraints is not None
