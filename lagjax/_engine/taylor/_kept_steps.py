"""The steps that motions in machine code have taken, kept for their transposes.

A reverse-mode derivative goes back over the steps of the motion itself. They are too many to travel through a program
of JAX as arrays; what travels through its residuals is a ticket, an integer for each member.
"""

import itertools
import threading
from collections import OrderedDict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lagjax._native import Kernel, StepRecord

LARGEST_KEPT = 2**26  # numbers of steps that are kept for a derivative that may follow: half a GiB


class Steps(NamedTuple):
    """The steps of a run of N members in one kernel, by a series of this order.

    A row of `table` holds the time and the size of a step, the numbers of its member and of the step, and its first
    state; those of a member are `counts` (N,) rows from `first` (N,) on. `complete` (N,) is false for a member whose
    steps are not all there.
    """

    kernel: Kernel
    order: int
    table: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    complete: np.ndarray

    def record(self, members) -> StepRecord:
        return StepRecord(self.table, self.first[members], self.counts[members], self.order)


class StepStore:
    """Steps by the number of their run; the oldest are dropped when all together exceed `limit` numbers.

    A ticket is run · 2³² + member: an integer that travels through the residuals of a derivative, so that the transpose
    finds the steps that belong to it, or knows that they are gone and follows the motion once more.
    """

    _runs = itertools.count()  # of all stores: a ticket of one means nothing to another

    def __init__(self, limit: float = float("inf")):
        self.limit = limit
        self._steps: OrderedDict[int, Steps] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, steps: Steps) -> np.ndarray:
        """The tickets of the members, −1 for those that are not complete."""
        with self._lock:
            run = next(self._runs)
            self._steps[run] = steps
            while len(self._steps) > 1 and sum(kept.table.size for kept in self._steps.values()) > self.limit:
                self._steps.popitem(last=False)
        return np.where(steps.complete, run * 2**32 + np.arange(len(steps.first)), -1)

    def runs(self, tickets: np.ndarray) -> Iterator[tuple[Steps, np.ndarray, np.ndarray]]:
        """The steps of every run that is here, with the tickets that are its members, and these members."""
        for run in np.unique(tickets[tickets >= 0] >> 32).tolist():
            with self._lock:
                steps = self._steps.get(run)
            if steps is not None:
                places = np.flatnonzero(tickets >> 32 == run)
                yield steps, places, tickets[places] & (2**32 - 1)


KEPT = StepStore(LARGEST_KEPT)
