"""How a motion is to be integrated: the arguments of `simulate` that do not depend on the scene, checked and completed.

Everything that can be wrong with them is found here, before any work is done, and answered with a sentence. Numbers
become arrays, so that a new value is never a new program. Values that are being traced (inside the user's own `jit`)
have no number yet: for them only shapes are checked.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jax.typing import ArrayLike

from lagjax._arguments import accept
from lagjax._layout import taken_apart
from lagjax._machine_code import MachineCode
from lagjax._solvers import FineOutput

PyTree = Any

# Defaults by dtype. The absolute tolerance is far below the relative one, so that states in small units keep their
# digits; it is there for components that pass through zero.
DEFAULT_RTOL = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-5}
_ATOL_OVER_RTOL = 1e-3
# Units of round-off. Machine code sums with the rounding errors carried along: below one unit its truncation, which
# has a sign, does not add up to more than the round-off of a long run, which has none.
_LEAST, _LEAST_OF_SOLVERS = 0.25, 10


class Settings(eqx.Module):
    """How to integrate, apart from the scene and its state: numbers are arrays, the rest is part of the program."""

    ts: jax.Array | np.ndarray
    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    dt0: jax.Array | None
    event: diffrax.Event | None
    adjoint: diffrax.AbstractAdjoint | None
    max_steps: int = eqx.field(static=True)
    progress: diffrax.AbstractProgressMeter
    by_default: bool = eqx.field(static=True)  # nothing was asked for that only diffrax can do
    insists: bool = eqx.field(static=True)  # on machine code: where there is none, that is an error

    @classmethod
    def of(cls, layout, ts, solver, rtol, atol, dt, max_steps, event, adjoint, progress) -> "Settings":
        """Check the arguments of `simulate` that do not depend on the scene, and fill in the defaults."""
        ts, insists = _output_times(ts, layout.dtype), isinstance(solver, MachineCode)
        solver = None if insists else solver
        by_default = solver is None and adjoint is None and dt is None and event is None and progress is False
        if solver is None:
            # States between steps are wanted for outputs inside and to locate an event.
            between = ts.size > 2 or event is not None
            solver = FineOutput(diffrax.Dopri8()) if between else diffrax.Dopri8()
        _require_solver(solver, adaptive=dt is None)
        require_budget(max_steps, "max_steps")
        if isinstance(progress, bool):
            progress = diffrax.TextProgressMeter() if progress else diffrax.NoProgressMeter()
        _require_instance(progress, "progress", diffrax.AbstractProgressMeter, "True or False")
        if adjoint is not None:
            _require_instance(adjoint, "adjoint", diffrax.AbstractAdjoint, "None")
        if dt is None:
            # Whether it comes to machine code is not known yet: `require_solver_reaches`.
            least = _LEAST if by_default and layout.dtype == np.float64 else _LEAST_OF_SOLVERS
            controller, dt0 = _adaptive(layout.dtype, ts, rtol, atol, least), None
        else:
            controller, dt0 = diffrax.ConstantStepSize(), _fixed_step(dt, ts, rtol, atol, max_steps)
        return cls(
            ts=ts,
            solver=solver,
            controller=controller,
            dt0=dt0,
            event=_event(event, layout.dtype),
            adjoint=adjoint,
            max_steps=max_steps,
            progress=progress,
            by_default=by_default,
            insists=insists,
        )

    @property
    def tolerances(self) -> tuple[ArrayLike, ArrayLike] | None:
        """rtol and atol of a step; None where it has a fixed size."""
        controller = self.controller
        return (controller.rtol, controller.atol) if isinstance(controller, diffrax.PIDController) else None


def as_arrays(tree: PyTree, dtype, name: str = "params") -> PyTree:
    """Every number as an array, so that a new value is no new program; floats in the dtype of the state.

    Raises `TypeError` or `ValueError`, with the name of the leaf, for what is neither a number nor can be a part of the
    program.
    """
    labels, leaves, structure = taken_apart(tree, name)
    return structure.unflatten(_leaf_as_array(*of, dtype) for of in zip(leaves, labels, strict=True))


def _leaf_as_array(leaf, label: str, dtype):
    if not eqx.is_array_like(leaf):  # a function, a string: part of the program
        _require_hashable(leaf, label)
        return leaf
    require_numbers(leaf, label)
    if np.ma.is_masked(leaf):
        raise ValueError(f"{label} is masked in places, where it has no number: fill them first.")
    try:
        return _as_array(leaf, dtype if jnp.issubdtype(jnp.result_type(leaf), jnp.floating) else None)
    except OverflowError:
        raise ValueError(f"{label} is too large for an integer of 64 bits: write it as a float.") from None


def _dtype_of(value):
    """The dtype of a number or an array of numbers; None for all else, of which NumPy has many kinds."""
    try:
        kind = jnp.result_type(value)
    except (TypeError, ValueError):
        return None
    return kind if jnp.issubdtype(kind, jnp.number) or jnp.issubdtype(kind, jnp.bool_) else None


def require_numbers(leaf, label: str) -> None:
    """Raise `TypeError` for a leaf that is not a number or an array of numbers, of a kind that JAX knows."""
    if _dtype_of(leaf) is None:
        kind = getattr(leaf, "dtype", None)
        got = type(leaf).__name__ if kind is None else f"an array of {kind}"
        raise TypeError(f"{label} must hold numbers that JAX knows; got {got}.")


def _require_hashable(leaf, label: str) -> None:
    try:
        hash(leaf)
    except TypeError:
        raise TypeError(
            f"{label} is a {type(leaf).__name__}, neither a number nor hashable: it can be no part of a program."
        ) from None


def _as_array(x, dtype=None):
    """An array of JAX if it is one already, else one of NumPy, which costs nothing and stays a number inside `jit`."""
    if isinstance(x, jax.Array):
        return x if dtype is None or x.dtype == dtype else x.astype(dtype)
    return np.asarray(x, jnp.result_type(x) if dtype is None else dtype)


def is_concrete(value) -> bool:
    return not isinstance(value, Tracer)


def not_finite(tree: PyTree, name: str) -> list[tuple[str, Any]]:
    """Every number that is NaN or infinite, with its name; values that are being traced have none yet."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if eqx.is_array_like(leaf) and is_concrete(leaf) and _dtype_of(leaf) is not None:
            values = np.asarray(leaf)
            finite = np.isfinite(values)
            if finite.all():
                continue
            label = name + jax.tree_util.keystr(path)
            for index in np.argwhere(~finite):
                found.append((label + (str(index.tolist()) if values.ndim else ""), values[tuple(index)]))
    return found


def require_budget(value, name: str) -> None:
    """Raise for what is no positive integer of 32 bits, in which steps and transitions are counted."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be a positive integer, so that every run ends; got {value!r}.")
    if value >= 2**31:
        raise ValueError(f"{name} must be less than 2**31, more than any run could use up.")


def require_flag(value, name: str) -> None:
    """Raise `TypeError` for what is neither true nor false."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False; got {value!r}.")


def require_finite(tree: PyTree, name: str) -> None:
    """Raise where a number is NaN or infinite, naming it."""
    if bad := not_finite(tree, name):
        where, value = bad[0]
        raise ValueError(f"{where} is {value}: every number given must be finite.")


def _output_times(ts, dtype) -> jax.Array | np.ndarray:
    try:
        kind = jnp.result_type(ts if isinstance(ts, jax.Array) else np.asarray(ts))
    except (TypeError, ValueError):
        raise TypeError(f"ts must be an array of output times; got {type(ts).__name__}.") from None
    if np.ndim(ts) != 1 or np.size(ts) < 2:
        raise ValueError(f"ts must hold at least two output times, ts[0] the start; got shape {np.shape(ts)}.")
    if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise TypeError(f"ts must hold real numbers; got {kind}.")
    whole = ts if isinstance(ts, jax.Array) else np.asanyarray(ts)
    given = _as_array(_leaf_as_array(whole, "ts", dtype), dtype)
    require_finite(given, "ts")
    if is_concrete(given):
        gaps = np.diff(np.asarray(given))
        if not (np.all(gaps > 0) or np.all(gaps < 0)):
            raise ValueError(
                f"ts must be strictly increasing or strictly decreasing, in {np.dtype(dtype).name}; it is not between "
                f"ts[{_first_bad_gap(gaps)}] and the next."
            )
    return given


def _first_bad_gap(gaps: np.ndarray) -> int:
    return int(np.argmax(np.sign(gaps) != np.sign(gaps[0]))) if gaps[0] != 0 else 0


def require_solver_reaches(settings: Settings, dtype) -> None:
    """Raise where machine code would reach a tolerance that the solvers of diffrax do not."""
    if settings.tolerances is not None:
        _require_within(settings.tolerances[0], dtype, _LEAST_OF_SOLVERS)


def _require_within(rtol, dtype, least: float) -> None:
    """Raise where rtol is below `least` units of round-off."""
    eps = float(jnp.finfo(dtype).eps)
    if is_concrete(rtol) and float(rtol) < least * eps:
        more = "; call jax.config.update('jax_enable_x64', True) and pass float64 states" if dtype == np.float32 else ""
        raise ValueError(
            f"{dtype.name} cannot meet rtol={float(rtol):.3g}: its round-off is {eps:.1e}, "
            f"so rtol must be at least {least * eps:.1e}{more}."
        )


def _adaptive(dtype, ts, rtol, atol, least: float) -> diffrax.PIDController:
    """Adaptive steps, with tolerances that the dtype can meet and with an end to shrinking."""
    eps = float(jnp.finfo(dtype).eps)
    rtol = DEFAULT_RTOL[dtype] if rtol is None else _tolerance(rtol, "rtol")
    atol = rtol * _ATOL_OVER_RTOL if atol is None else _tolerance(atol, "atol")
    _require_within(rtol, dtype, least)
    ts, library = (np.asarray(ts), np) if is_concrete(ts) else (ts, jnp)
    return diffrax.PIDController(
        rtol=_as_array(rtol, dtype),
        atol=_as_array(atol, dtype),
        norm=_norm_or_inf,
        # Below this a step no longer moves the time reliably.
        dtmin=np.asarray(4 * eps, dtype) * library.maximum(abs(ts[0]), abs(ts[-1])),
        force_dtmin=False,
    )


def _norm_or_inf(error: PyTree) -> jax.Array:
    """Root mean square, with NaN as infinity: an undefined step is then rejected and shortened like any bad one."""
    norm = optx.rms_norm(error)
    return jnp.where(jnp.isnan(norm), jnp.inf, norm)


def _tolerance(value, name):
    require_number(value, name)
    if is_concrete(value) and not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be positive; got {value}.")
    if name == "rtol" and is_concrete(value) and value >= 1:
        raise ValueError(f"rtol must be less than 1, which would leave no digit of the motion; got {value}.")
    return value


def require_number(value, name: str) -> None:
    """Raise for anything but one real number."""
    kind = _dtype_of(value) if eqx.is_array_like(value) else None
    if kind is None or kind == jnp.bool_ or jnp.issubdtype(kind, jnp.complexfloating):
        raise TypeError(f"{name} must be a real number; got {value!r}.")
    if isinstance(value, int) and abs(value) >= 2**63:
        raise ValueError(f"{name} is too large for an integer of 64 bits: write it as a float.")
    if jnp.ndim(value) != 0:
        raise ValueError(f"{name} must be one number; got shape {jnp.shape(value)}.")


def _require_instance(value, name: str, kind: type, example: str) -> None:
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be an instance of diffrax.{kind.__name__}, or {example}; got {value!r}.")


def _fixed_step(dt, ts, rtol, atol, max_steps) -> jax.Array:
    """`dt`, positive as the user gives it, as a signed array in the direction of time."""
    if rtol is not None or atol is not None:
        raise ValueError("dt asks for fixed steps and rtol/atol for adaptive ones: give one or the other.")
    require_number(dt, "dt")
    if is_concrete(dt) and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt must be a positive step size, also backward in time; got {dt}.")
    if is_concrete(dt) and is_concrete(ts):
        needed = float(abs(np.asarray(ts)[-1] - np.asarray(ts)[0])) / float(dt)
        if needed > max_steps + 0.5:
            raise ValueError(f"dt={dt} needs {needed:.0f} steps, more than max_steps={max_steps}: raise one of them.")
    ts, library = (np.asarray(ts), np) if is_concrete(ts) else (ts, jnp)
    return _as_array(dt, ts.dtype) * library.sign(ts[-1] - ts[0])


def _require_solver(solver, adaptive: bool) -> None:
    name = type(solver).__name__
    if not isinstance(solver, diffrax.AbstractSolver):
        raise TypeError(f"solver must be an instance of a diffrax solver, such as diffrax.Tsit5(); got {solver!r}.")
    if isinstance(solver.term_structure, tuple) or not _takes_one_term(solver):
        raise ValueError(
            f"{name} splits the equations into several terms, which those of a general Lagrangian do not allow; "
            "use a solver of ordinary differential equations, such as diffrax.Dopri8() or diffrax.ImplicitMidpoint()."
        )
    if adaptive and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(f"{name} has no error estimate to adapt its steps to: give a fixed step with dt=...")


def _takes_one_term(solver) -> bool:
    structure = solver.term_structure
    return isinstance(structure, type) and issubclass(diffrax.ODETerm, structure)


def _event(event, dtype) -> diffrax.Event | None:
    """The event with its functions' signatures checked, and with a root finder that uses the dtype's digits."""
    if event is None:
        return None
    given = event.cond_fn if isinstance(event, diffrax.Event) else event
    _, functions, _ = taken_apart(given, "event", is_leaf=lambda leaf: leaf is None or callable(leaf))
    if not functions or not all(map(callable, functions)):
        raise TypeError(f"event must be a function event(q, qdot), or a pytree of such; got {given!r}.")
    if not isinstance(event, diffrax.Event):
        event = diffrax.Event(event)
    conditions = jax.tree.map(lambda function: accept(function, "event"), event.cond_fn, is_leaf=callable)
    tolerance = 4 * float(jnp.finfo(dtype).eps)
    root_finder = event.root_finder or _SignChange(rtol=tolerance, atol=tolerance)
    return diffrax.Event(conditions, root_finder, event.direction)


class _SignChange(optx.Bisection):
    """Bisection that stops when the interval is as small as the dtype resolves, whatever the size of the function.

    The sign change that fired an event brackets its root, so that this always arrives. It also does where there is
    nothing to find, as in the members of a batch that had no event, or in a Boolean one: there diffrax asks for the end
    of the step.
    """

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        lower, upper = (jnp.asarray(options[end], f_struct.dtype) for end in ("lower", "upper"))
        state = optx.Bisection(self.rtol, self.atol, flip=True).init(fn, y, args, options, f_struct, aux_struct, tags)
        return eqx.tree_at(lambda s: s.flip, state, fn(lower, args)[0] > fn(upper, args)[0])

    def terminate(self, fn, y, args, options, state, tags):
        scale = jnp.maximum(jnp.abs(state.lower), jnp.abs(state.upper))
        small = jnp.abs(state.upper - state.lower) <= self.rtol * scale
        return small & jnp.isfinite(state.error), optx.RESULTS.successful
