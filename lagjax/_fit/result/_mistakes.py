"""Mistakes in records that explain a poor fit.

Degrees for radians, milliseconds for seconds, two signals in each other's place, a sign, an angle from the upright:
each leaves data that a scene cannot follow, and each can be undone. If the fit then follows them, that is the mistake,
with evidence: how much was left before and after. How the numbers look says only what is tried first. All tries
together take no more time than the fit itself, or some seconds, and what is not found in that time is not reported. A
signal that never changes cannot be undone, and is named as it is.
"""

import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lagjax._fit.model._records import Record, restore_structure
from lagjax._fit.model._sensor_faults import present_samples

_WIDE = 3.0  # rad: a signal of a smaller range is not tried as degrees, which would leave it 0.05
_WIDEST = 20.0  # rad, three turns: of a larger range degrees are tried first
_MOST_TRIED = 4  # signals by signs, places and origins, and records that are left out: pairs grow as a square
_BETTER = 0.2  # of what was left before, that the fit without the mistake may leave: chance halves it at best
_SLOW = 30.0  # times slower than the scene moves, from which milliseconds are tried first: 1000, and a guess is off
SECONDS = 10.0  # of processor time that tries may take where a fit explains nothing: some ten fits that fail


class PossibleMistake(NamedTuple):
    """A mistake in words, and the records without it."""

    text: str
    records: list[Any]


def possible_mistakes(
    records: list[Any], names: tuple[str, ...], worst: list[int], slower: float
) -> Iterator[PossibleMistake]:
    """Possible mistakes in the records, the likeliest first: the data move `slower` times slower than the scene, and
    `worst` are the places of records by what is left of them."""
    count, some = len(names), range(min(len(names), _MOST_TRIED))

    def change(columns: list[int], function: Callable[[np.ndarray], np.ndarray]) -> list[Any]:
        mine = np.isin(np.arange(count), columns)
        return _change_signals(records, lambda matrix: np.where(mine, function(matrix), matrix))

    by_time = [
        replace(r, ts=r.ts / 1e3, input_ts=None if r.input_ts is None else r.input_ts / 1e3)
        if isinstance(r, Record) else r
        for r in records
    ]  # fmt: skip
    milliseconds = [PossibleMistake("with the times in milliseconds", by_time)]
    ranges = [max(np.ptp(present_samples(r, k)) for r in records if isinstance(r, Record)) for k in range(count)]
    wide = [k for k in range(count) if ranges[k] > _WIDE]
    sets = ([wide] if wide else []) + [[k] for k in wide[:_MOST_TRIED] if len(wide) > 1]
    degrees = [PossibleMistake(f"with {_list_names(names, x)} in degrees", change(x, np.radians)) for x in sets]
    yield from milliseconds if slower > _SLOW else []
    yield from degrees if max(ranges) > _WIDEST else []
    swaps = []
    for i, j in itertools.combinations(some, 2):
        order = np.arange(count)
        order[[i, j]], text = (j, i), f"with {names[i]} and {names[j]} swapped"
        swaps.append(PossibleMistake(text, _change_signals(records, np.asarray, order)))
    yield from swaps if len(swaps) == 1 else []  # one try tells
    for place in worst[:_MOST_TRIED] if len(records) > 2 else []:
        yield PossibleMistake(f"without records[{place}]", [*records[:place], *records[place + 1 :]])
    yield from swaps if len(swaps) > 1 else []
    for k in some:
        yield PossibleMistake(f"with the other sign of {names[k]}", change([k], np.negative))
    for turned in [list(some)] + [[k] for k in some if count > 1]:
        text = f"with {_list_names(names, turned)} counted from the opposite direction, π further"
        yield PossibleMistake(text, change(turned, lambda x: x + np.pi))
    yield from degrees if max(ranges) <= _WIDEST else []
    yield from milliseconds if slower <= _SLOW else []


def find_mistake(
    share: Callable[[list[Any]], float | None], possible: Iterable[PossibleMistake], left: float, seconds: float,
    tell: Callable[[str], None] | None = None,
) -> list[str]:  # fmt: skip
    """A sentence for the first mistake whose removal lets a fit follow the records; `share(records)` is what a fit
    leaves of the signals, None where it fails, and `left` what the given fit left. `tell` prints a line for each."""
    until = time.process_time() + seconds
    for suspect in possible:
        if tell:
            tell(f"Motion is left, perhaps by a mistake in the records: they are fitted {suspect.text}.")
        now = share(suspect.records)
        if now is not None and now < _BETTER * left:
            before = "failed" if np.isinf(left) else f"leaves {100 * left:.2g} % of them"
            after = f"that leaves {100 * now:.2g} % of them"
            return [f"The data are followed {suspect.text}: {after}, and this fit {before}."]
        if time.process_time() > until:
            break
    return []


def _list_names(names: tuple[str, ...], which: list[int]) -> str:
    return " and ".join(names[k] for k in which) if len(which) < len(names) or len(names) == 1 else "all signals"


def _change_signals(
    records: list[Any], change: Callable[[np.ndarray], np.ndarray], order: Any = slice(None)
) -> list[Any]:
    """The records with other values (T, S), and with their weights in another order of the signals."""
    found = []
    for record in records:
        if isinstance(record, Record):
            weights = None if record.weights is None else restore_structure(record.weight_matrix[:, order], record)
            record = replace(record, values=restore_structure(change(record.matrix[:, order]), record), weights=weights)
        found.append(record)
    return found
