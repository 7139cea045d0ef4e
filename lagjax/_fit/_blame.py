"""Whose fault it was that a function of the user failed: the parameters it reads are not there, or something else."""

import linecache
import traceback
from pathlib import Path

import jax

_OURS = str(Path(__file__).parents[1]), str(Path(jax.__file__).parent)


def reading_params(reason: Exception) -> str | None:
    """The expression that read `params` where a function of the user failed; None where something else failed."""
    if reason.__traceback__ is None:
        return None
    frames = traceback.extract_tb(reason.__traceback__)
    theirs = [frame for frame in frames if not frame.filename.startswith(_OURS)]
    if not theirs or theirs[-1].lineno is None:
        return None
    last = theirs[-1]
    text = linecache.getline(last.filename, last.lineno or 0).encode()[last.colno : last.end_colno].decode()
    return text if text.startswith(("params", "(params")) else None
