"""Cuts of records into segments, each level twice as long as the one before."""

import itertools

import numpy as np

from lagjax._fit.model._pieces import Piece
from lagjax._fit.model._records import Record

_FEWEST_IN_SEGMENT = 8  # samples


def levels(records: list[Record | None], scales: list[float]) -> list[list[Piece]]:
    """Cuts of the records, from segments of two time scales to whole records, each twice as long as the one before.

    Each record has its time scale. Without any where records are hardly longer than that; None in the place of a record
    is left out.
    """
    edges = [(k, record, _edges(record, 2.0 * scales[k])) for k, record in enumerate(records) if record is not None]
    most, found, stride = max(len(e) - 1 for *_, e in edges), [], 1
    while stride < most:
        pieces = []
        for k, record, e in edges:
            cut = [*e[:-1:stride].tolist(), len(record)]
            if len(cut) > 2 and 2 * (e[-1] - cut[-2]) < e[min(stride, len(e) - 1)] - e[0]:
                del cut[-2]  # a rest shorter than half a segment joins the one before
            pieces += [Piece(k, np.arange(a, b)) for a, b in itertools.pairwise(cut)]
        found.append(pieces)
        stride *= 2
    return found


def _edges(record: Record, length: float) -> np.ndarray:
    """The first samples of the shortest segments of one record, and its length."""
    ts = record.ts
    count = max(1, int((ts[-1] - ts[0]) / length)) if np.isfinite(length) else 1
    count = max(1, min(count, len(ts) // _FEWEST_IN_SEGMENT))
    return np.unique(np.append(np.searchsorted(ts, np.linspace(ts[0], ts[-1], count + 1)[:-1]), len(ts)))
