"""The three-line summary of a trajectory: its contents, its times and steps, and how it ended.

    Trajectory of 1000 members, float64: q['theta'] (1000, 101), q['x'] (1000, 101), and qdot
    t from 0 to 10 at 101 outputs, 241 steps in the median, at most 388 (12 rejected)
    998 of 1000 reached the end, 2 nonfinite_state: the first that failed is member 17, at t = 0.5

Traced numbers, inside `jax.jit` or `jax.vmap`, are left out. The fields themselves are printed by
`equinox.tree_pprint(trajectory)`.
"""

import importlib
from typing import Any

import equinox as eqx
import jax
import numpy as np

from lagjax._interface import ENDED_WELL, is_known, labelled_leaves, name_of

COUNTS = ("num_steps", "num_rejected_steps")
LEAVES_SHOWN = 6  # of q, which may have any number of leaves


def summary(trajectory) -> str:
    """Return the three lines for a `Trajectory`, batched or not, of values, tracers or shapes alone.

    For a trajectory mapped to a pytree without arrays (axes, filters), its fields.
    """
    counts = [trajectory.stats[name] for name in COUNTS]
    essential = trajectory.ts, trajectory.q, trajectory.qdot, trajectory.result, trajectory.end, counts
    leaves = jax.tree.leaves(essential, is_leaf=lambda leaf: leaf is None)
    if not all(hasattr(leaf, "shape") and hasattr(leaf, "dtype") for leaf in leaves):
        return eqx.tree_pformat(trajectory)
    return "\n".join([_fields(trajectory), _describe_span(trajectory), _describe_verdict(trajectory)])


def canonical_summary(trajectory) -> str:
    """Return the three lines for a `CanonicalTrajectory`; its fields if it has no shapes."""
    leaves = jax.tree.leaves((*trajectory,), is_leaf=lambda leaf: leaf is None)
    if not all(hasattr(leaf, "shape") and hasattr(leaf, "dtype") for leaf in leaves):
        return f"CanonicalTrajectory{tuple(trajectory)}"
    ts, ok, batch = trajectory.ts, trajectory.ok, trajectory.ok.shape
    ended = "the result is being traced"
    if is_known(ok):
        well = np.asarray(ok)
        ended = f"{well.sum()} of {well.size} reached the end" if batch else f"{'' if well else 'not '}reached the end"
    members = f" of {' × '.join(map(str, batch))} members" if batch else ""
    lines = f"CanonicalTrajectory{members}, {ts.dtype}: {_coordinates(trajectory.q)}, and p", _outputs(ts), ended
    return "\n".join(lines)


def require_numbers(trajectory, what: str) -> None:
    """Raise `ValueError` if a trajectory is traced; `what` begins the message, as in "to_pandas() copies"."""
    if not all(map(is_known, jax.tree.leaves((trajectory.ts, trajectory.q, trajectory.qdot)))):
        raise ValueError(f"{what} numbers: call it outside of jit, vmap and grad.")


def import_package(what: str, name: str, source: str, *parts: str) -> Any:
    """Import the package `name` and its submodules `parts`; raise `ImportError` naming the pip `source` if missing."""
    try:
        for part in parts:
            importlib.import_module(f"{name}.{part}")
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(f"{what} needs the package {name}: pip install {source}.") from None


def _fields(trajectory) -> str:
    batch = trajectory.result._value.shape
    members = f" of {' × '.join(map(str, batch))} members" if batch else ""
    modes = f"; modes {', '.join(trajectory.mode_names)}" if trajectory.mode_names else ""
    off = trajectory.ts.dtype == np.float32 and not jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    dtype = "float32, as jax_enable_x64 is off" if off else trajectory.ts.dtype
    return f"Trajectory{members}, {dtype}: {_coordinates(trajectory.q)}, and qdot{modes}"


def _coordinates(q) -> str:
    leaves = jax.tree_util.tree_leaves_with_path(q)
    named = [f"q{jax.tree_util.keystr(path)} {tuple(leaf.shape)}" for path, leaf in leaves]
    if len(named) > LEAVES_SHOWN:
        named[LEAVES_SHOWN - 1 :] = [f"… ({len(named) - LEAVES_SHOWN + 1} more)"]
    return ", ".join(named)


def _outputs(ts) -> str:
    text = f"{ts.shape[-1]} outputs"
    if not is_known(ts):
        return text
    # Under `jax.vmap` members may have times of their own.
    start, end = (_format_range(np.asarray(ts)[..., place]) for place in (0, -1))
    return f"t from {start} to {end} at {text}"


def _describe_span(trajectory) -> str:
    text, counts = _outputs(trajectory.ts), [trajectory.stats[name] for name in COUNTS]
    if not all(map(is_known, counts)):
        return f"{text}; the steps are being traced"
    steps, rejected = map(np.asarray, counts)
    if steps.size == 0:
        return text
    counted = f"{steps} steps ({rejected} rejected)"
    if steps.ndim:
        counted = f"{np.median(steps):.0f} steps in the median, at most {steps.max()} ({rejected.max()} rejected)"
    changes = trajectory.transitions
    if changes is not None and is_known(changes.count):
        counted += f", {'at most ' if steps.ndim else ''}{np.max(np.asarray(changes.count))} transitions"
    return f"{text}, {counted}"


def _describe_verdict(trajectory) -> str:
    code, t_end = trajectory.result._value, trajectory.end.t
    if not (is_known(code) and is_known(t_end) and is_known(trajectory.ts)):
        return "the result is being traced"
    codes, times = np.asarray(code), np.asarray(t_end)
    if codes.ndim == 0:
        name = name_of(codes)
        return "reached the end" if name == "successful" else f"ended at t = {times:.6g}: {name}{_events(trajectory)}"
    if codes.size == 0:
        return "no members"
    parts = []
    for value, count in zip(*np.unique(codes, return_counts=True), strict=True):
        name = name_of(value)
        parts.append(f"{count} of {codes.size} reached the end" if name == "successful" else f"{count} {name}")
    failed = np.argwhere(~np.isin(codes, ENDED_WELL))
    if not len(failed):
        return ", ".join(parts)
    first = tuple(failed[0].tolist())
    shown = first[0] if len(first) == 1 else first
    return f"{', '.join(parts)}: the first that failed is member {shown}, at t = {times[first]:.6g}"


def _events(trajectory) -> str:
    """Return the names of the event functions that ended the motion, as text; "" for a single function."""
    labels, leaves, _ = labelled_leaves(trajectory.event, "event")
    ended = [label for label, leaf in zip(labels, leaves, strict=True) if is_known(leaf) and bool(leaf)]
    return f", by {', '.join(ended)}" if len(leaves) > 1 and ended else ""


def _format_range(values: np.ndarray) -> str:
    if values.size == 0:
        return "?"
    least, largest = f"{values.min():.6g}", f"{values.max():.6g}"
    return least if least == largest else f"{least} … {largest}"
