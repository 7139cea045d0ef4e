"""Mistakes in the data of a fit that explains nothing: each one is undone, and the fit tried again.

Degrees for radians, milliseconds for seconds, two signals in each other's place, a sign, an angle from the upright:
each leaves data that a scene cannot follow, and each can be undone. If the fit then follows them, that is the mistake,
with evidence: how much was left before and after. How the numbers look says only what is tried first. All tries
together take no more time than the fit itself, or some seconds, and what one cannot tell in that time is not told. A
signal that never changes cannot be undone, and is named as it is.
"""

import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lagjax._fit._records import Record, in_structure

_WIDE = 3.0  # rad: a signal of a smaller range is not tried as degrees, which would leave it 0.05
_WIDEST = 20.0  # rad, three turns: of a larger range degrees are tried first
_MOST = 4  # signals of which signs, places and origins are tried, and records that are left out: pairs grow as a square
_BETTER = 0.2  # of what was left before, that the fit without the mistake may leave: chance halves it at best
_FEWEST = 8  # samples that do not change
_SLOW = 30.0  # times slower than the scene moves, from which milliseconds are tried first: 1000, and a guess is off
SECONDS = 10.0  # of processor time that tries may take where a fit explains nothing: some ten fits that fail


class Suspect(NamedTuple):
    """A mistake in words, and the records without it."""

    text: str
    records: list[Any]


def suspects(records: list[Any], names: tuple[str, ...], worst: list[int], slower: float) -> Iterator[Suspect]:
    """The mistakes that may be in the records, the likeliest first, where the data move so many times slower than the
    scene does, and `worst` has the places of the records in the order of what is left of them."""
    count, some = len(names), range(min(len(names), _MOST))
    by_time = [_in_milliseconds(r) if isinstance(r, Record) else r for r in records]
    milliseconds = [Suspect("with the times in milliseconds", by_time)]
    ranges = [max(np.ptp(_there(r, k)) for r in records if isinstance(r, Record)) for k in range(count)]
    wide = [k for k in range(count) if ranges[k] > _WIDE]
    degrees = [
        Suspect(f"with {_listed(names, turned)} in degrees", _scaled(records, turned, np.pi / 180))
        for turned in ([wide] if wide else []) + [[k] for k in wide[:_MOST] if len(wide) > 1]
    ]
    yield from milliseconds if slower > _SLOW else []
    yield from degrees if max(ranges) > _WIDEST else []
    swaps = []
    for i, j in itertools.combinations(some, 2):
        order = np.arange(count)
        order[[i, j]] = j, i
        swaps.append(Suspect(f"with {names[i]} and {names[j]} swapped", _reordered(records, order)))
    yield from swaps if len(swaps) == 1 else []  # one try tells
    for place in worst[:_MOST] if len(records) > 2 else []:
        yield Suspect(f"without records[{place}]", [*records[:place], *records[place + 1 :]])
    yield from swaps if len(swaps) > 1 else []
    for k in some:
        yield Suspect(f"with the other sign of {names[k]}", _scaled(records, [k], -1.0))
    for turned in [list(some)] + [[k] for k in some if count > 1]:
        text = f"with {_listed(names, turned)} counted from the opposite direction, π further"
        yield Suspect(text, _changed(records, turned, lambda x: x + np.pi))
    yield from degrees if max(ranges) <= _WIDEST else []
    yield from milliseconds if slower <= _SLOW else []


def _in_milliseconds(record: Record) -> Record:
    """A record whose times were taken for seconds."""
    return replace(record, ts=record.ts / 1e3, input_ts=None if record.input_ts is None else record.input_ts / 1e3)


def find_mistake(
    share: Callable[[list[Any]], float | None], possible: Iterable[Suspect], left: float, seconds: float
) -> list[str]:
    """A sentence for the first mistake without which a fit follows the records; none where there is no such.

    `share(records)` is what a fit of other records leaves of the signals, None where it fails as well; `left` is what
    the fit of these left. No try begins after this many seconds of processor time.
    """
    until = time.process_time() + seconds
    for suspect in possible:
        now = share(suspect.records)
        if now is not None and now < _BETTER * left:
            before = "failed" if np.isinf(left) else f"leaves {100 * left:.2g} % of them"
            return [
                f"The data are followed {suspect.text}: that leaves {100 * now:.2g} % of them, and this fit {before}."
            ]
        if time.process_time() > until:
            break
    return []


def hanging(records: list[Any], names: tuple[str, ...]) -> list[str]:
    """A sentence for every signal, of these names, that is the same at all samples of a record of one system."""
    return [
        f"{name} is {there[0]:.6g} at all {len(there)} samples of records[{place}]: it does not move, or its "
        "sensor hangs."
        for place, record in enumerate(records)
        if isinstance(record, Record)
        for k, name in enumerate(names)
        if len(there := _there(record, k)) >= _FEWEST and np.ptp(there) == 0.0
    ]


def _there(record: Record, signal: int) -> np.ndarray:
    """The samples of a signal that are not missing; a zero where all are."""
    column = record.matrix[:, signal]
    return column[np.isfinite(column)] if np.isfinite(column).any() else np.zeros(1)


def _listed(names: tuple[str, ...], which: list[int]) -> str:
    return " and ".join(names[k] for k in which) if len(which) < len(names) or len(names) == 1 else "all signals"


def _scaled(records: list[Any], columns: list[int], factor: float) -> list[Any]:
    return _changed(records, columns, lambda x: factor * x)


def _reordered(records: list[Any], order: np.ndarray) -> list[Any]:
    """The records with signals in another order, and their weights with them."""
    found = []
    for record in records:
        if isinstance(record, Record):
            weights = None if record.weights is None else in_structure(record.weight_matrix[:, order], record)
            record = replace(record, values=in_structure(record.matrix[:, order], record), weights=weights)
        found.append(record)
    return found


def _changed(records: list[Any], columns: list[int], change: Callable[[np.ndarray], np.ndarray]) -> list[Any]:
    """The records with some signals changed."""
    found = []
    for record in records:
        if isinstance(record, Record):
            matrix = record.matrix
            matrix[:, columns] = change(matrix[:, columns])
            record = replace(record, values=in_structure(matrix, record))
        found.append(record)
    return found
