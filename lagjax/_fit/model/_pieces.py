"""Pieces of records, as rows of batches."""

from typing import Any, NamedTuple

import numpy as np

from lagjax._fit.model._inputs import SampleTable, build_table, inputs_at, samples_between
from lagjax._fit.model._records import Record


class Piece(NamedTuple):
    """The samples `places` of the record `record`, followed as a motion of its own from the first of them.

    `mode` is what holds there: of hybrid motion (1,) the place of the mode, empty for that in which the scene begins;
    of k contacts, r with friction, (k + r,): 1 for what is closed, then for what sticks; empty where none is closed.
    """

    record: int
    places: np.ndarray
    mode: tuple[int, ...] = ()


def whole_pieces(records: list[Record]) -> list[Piece]:
    return [Piece(k, np.arange(len(record))) for k, record in enumerate(records)]


class Samples(NamedTuple):
    """N pieces of records as rows of one batch, with room for the T samples of the longest.

    - `rows` (N,): the place of each piece among all.
    - `ts` (N, T): times, and after the last one of a piece times so close to it that following them costs nothing.
    - `values` (N, T, S), `weights` (N, T, S): signals and how much they count, zero where there is none.
    - `inputs` (N, T, I), I = 0 where there are none: the inputs at these times. `table`: between them.
    - `sides` (N, T, S): 1 where a sample is at the upper limit of its sensor, −1 at the lower one; None for zeros.
    """

    rows: np.ndarray
    ts: np.ndarray
    values: np.ndarray
    weights: np.ndarray
    inputs: np.ndarray
    table: SampleTable | None
    sides: np.ndarray | None = None


def batch_pieces(records: list[Any], pieces: list[Piece], eps: float = 2.3e-16, hold: str = "zero") -> list[Samples]:
    """The pieces in batches, none longer than twice its shortest piece, so that at most half of the room is empty;
    `eps` is the round-off of the motion, `hold` says what inputs are between samples."""
    lengths = np.array([len(piece.places) for piece in pieces])
    order, groups = np.argsort(-lengths, kind="stable"), []
    for row in order.tolist():
        if not groups or 2 * lengths[row] < lengths[groups[-1][0]]:
            groups.append([])
        groups[-1].append(row)
    return [_stack_pieces(records, pieces, np.sort(rows), eps, hold) for rows in groups]


def _stack_pieces(records: list[Record], pieces: list[Piece], rows: np.ndarray, eps: float, hold: str) -> Samples:
    longest, signals = max(len(pieces[row].places) for row in rows), records[pieces[rows[0]].record].matrix.shape[1]
    ts = np.zeros((len(rows), longest))
    values, weights = np.zeros((2, len(rows), longest, signals))
    taken = [(k, records[k]) for k in {pieces[row].record for row in rows}]
    matrices = {k: (record.matrix, record.weight_matrix, record.input_samples) for k, record in taken}
    driven = matrices[pieces[rows[0]].record][2]
    inputs, sampled = np.zeros((len(rows), longest, driven.shape[1])), []
    for i, row in enumerate(rows):
        record, places, _ = pieces[row]
        measured, weight = (matrix[places] for matrix in matrices[record][:2])
        times, count = records[record].ts[places], len(places)
        # Eight units of round-off apart: times that still increase.
        gap = 8 * eps * max(abs(times[0]), abs(times[-1]), times[-1] - times[0])
        ts[i] = np.concatenate([times, times[-1] + gap * np.arange(1, longest - count + 1)])
        values[i, :count], weights[i, :count] = np.where(weight > 0, measured, 0.0), weight
        if not driven.shape[1]:
            continue
        at, samples = records[record].sampled_at, matrices[record][2]
        between = samples_between(at, times[0], times[-1], hold)
        sampled.append((at[between], samples[between]))
        if records[record].input_ts is None:
            inputs[i, :count], inputs[i, count:] = samples[places], samples[places[-1]]
    table = build_table(sampled, hold) if driven.shape[1] else None
    if table is not None and any(records[pieces[row].record].input_ts is not None for row in rows):
        inputs = np.asarray(inputs_at(table, ts, hold)[0])
    return Samples(rows, ts, values, weights, inputs, table)
