"""`Statistics`: moments, extremes, histograms and quantiles of a quantity over all members, in bounded memory.

Each unit has one `Partial`, stored with it; they are merged in the order of the units, so that the bits of the result
do not depend on who computed what, and when. Counts, histograms and quantiles are whole numbers; mean and variance are
merged as Chan, Golub & LeVeque do (*Algorithms for computing the sample variance*, Am. Stat. 37 (1983) 242). Quantiles
are read off a histogram in log|x|, whose bins are `RELATIVE` wide: DDSketch (Masson, Rim & Lee, *DDSketch: a fast and
fully-mergeable quantile sketch*, VLDB 12 (2019) 2195).
"""

import io
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from lagjax._sweep._files import arrays_as_bytes

RELATIVE = 1e-3  # of a quantile: its error, as a part of it; bins of a sketch, and its bytes, go as one over it
_LOG_GAMMA = np.log((1 + RELATIVE) / (1 - RELATIVE))
_OFFSET = 2**20  # more than |log x| / log γ of any double


class Statistics:
    """The statistics of a quantity that `reduce` collects: count, mean, variance, and the extremes with their members.

    - `edges` (B + 1,): a histogram between these edges, in increasing order; the last bin includes its upper edge.
    - `quantiles`: levels between 0 and 1, such as (0.05, 0.5, 0.95); resolved to a thousandth of the value.

    Members that failed, and values that are not finite, are left out and counted. Raises `ValueError` for edges that do
    not increase and levels that are none.

    ```python
    import numpy as np, lagjax

    reduce = {"height": lagjax.Statistics(edges=np.linspace(0.0, 2.0, 41), quantiles=(0.5, 0.99))}
    ```
    """

    def __init__(self, edges=None, quantiles: Iterable[float] = ()):
        self.edges = None if edges is None else np.asarray(edges, float)
        self.quantiles = tuple(float(level) for level in quantiles)
        x = self.edges
        if x is not None and not (x.ndim == 1 and x.size > 1 and np.all(np.diff(x) > 0)):
            raise ValueError("edges must be two numbers or more that increase.")
        if any(not 0 <= level <= 1 for level in self.quantiles):
            raise ValueError(f"quantiles must lie between 0 and 1; got {self.quantiles}.")

    def described(self) -> dict:
        edges = None if self.edges is None else self.edges.tolist()
        return {"edges": edges, "quantiles": list(self.quantiles)}


class Partial(NamedTuple):
    """The statistics of a unit or of several, for C columns of a quantity.

    - `count`, `missing` (C,): values that are finite, and those that are not or are of members that failed.
    - `mean`, `square` (C,): Σ x / n and Σ (x − mean)².
    - `least`, `greatest` (C,), and the numbers of their members.
    - `histogram` (C, B); `outside` (C, 2): below the first and above the last edge.
    - `sketch` (K, 3): column, bin and count of what is in it, in the order of columns and bins.
    """

    count: np.ndarray
    missing: np.ndarray
    mean: np.ndarray
    square: np.ndarray
    least: np.ndarray
    least_member: np.ndarray
    greatest: np.ndarray
    greatest_member: np.ndarray
    histogram: np.ndarray
    outside: np.ndarray
    sketch: np.ndarray


class Summary(NamedTuple):
    """The statistics of a quantity over all members; every field has the shape of the quantity, some one axis more.

    - `count`, `missing`: values that entered, and that did not: not finite, or of members that failed.
    - `mean`, `variance`: of what entered, the variance with n − 1.
    - `min`, `max`, and `min_member`, `max_member`: the numbers of the members that have them, −1 without any.
    - `histogram` (…, B), `outside` (…, 2): counts, and those below and above; None without edges.
    - `quantiles` (…, Q): at the given levels; None without levels.
    """

    count: np.ndarray
    missing: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    min: np.ndarray
    min_member: np.ndarray
    max: np.ndarray
    max_member: np.ndarray
    histogram: np.ndarray | None
    outside: np.ndarray | None
    quantiles: np.ndarray | None


def unit_statistics(how: Statistics, values: np.ndarray, ok: np.ndarray, members: np.ndarray) -> Partial:
    """Return the statistics of a unit from `values` (m, …), flags `ok` (m,), and the members' numbers (m,)."""
    columns = np.ascontiguousarray(values.reshape(len(values), -1).astype(float).T)
    rows = [_summarize_column(how, c, x, ok & np.isfinite(x), members) for c, x in enumerate(columns)]
    *fields, sketches = zip(*rows, strict=True)
    return Partial._make([*map(np.array, fields), np.concatenate(sketches)])


def _summarize_column(how: Statistics, c: int, x: np.ndarray, use: np.ndarray, members: np.ndarray) -> tuple:
    missing, x, members = int(np.sum(~use)), x[use], members[use]
    mean, ends = np.sum(x) / max(1, len(x)), (np.inf, -1, -np.inf, -1)
    if x.size:
        least, greatest = np.argmin(x), np.argmax(x)
        ends = x[least], members[least], x[greatest], members[greatest]
    histogram, outside, sketch = np.zeros(0, int), np.zeros(2, int), np.zeros((0, 3), int)
    if how.edges is not None:
        histogram = np.histogram(x, how.edges)[0]
        outside = np.array([np.sum(x < how.edges[0]), np.sum(x > how.edges[-1])])
    if how.quantiles:
        keys, counts = np.unique(_bin_indices(x), return_counts=True)
        sketch = np.stack([np.full(len(keys), c), keys, counts], axis=1)
    return len(x), missing, mean, np.sum((x - mean) ** 2), *ends, histogram, outside, sketch


def _bin_indices(x: np.ndarray) -> np.ndarray:
    """Return the bin of each number, increasing with it; 0 for zero."""
    with np.errstate(divide="ignore"):
        size = np.ceil(np.log(np.abs(x)) / _LOG_GAMMA)
    return np.where(x == 0, 0, np.sign(x) * (np.where(x == 0, 0.0, size) + _OFFSET)).astype(np.int64)


def _bin_centres(bins: np.ndarray) -> np.ndarray:
    """Return the centre of each bin, within `RELATIVE` of all numbers in it."""
    size = np.exp((np.abs(bins) - _OFFSET) * _LOG_GAMMA) * 2 / (1 + np.exp(_LOG_GAMMA))
    return np.where(bins == 0, 0.0, np.sign(bins) * size)


def merge_statistics(one: Partial | None, two: Partial) -> Partial:
    """Merge the statistics of two sets of members, those of `one` before those of `two`."""
    if one is None:
        return two
    count, step = one.count + two.count, two.mean - one.mean
    share = two.count / np.maximum(count, 1)
    lower, higher = two.least < one.least, two.greatest > one.greatest
    keys, where = np.unique(np.concatenate([one.sketch[:, :2], two.sketch[:, :2]]), axis=0, return_inverse=True)
    counts = np.zeros(len(keys), int)
    np.add.at(counts, where.ravel(), np.concatenate([one.sketch[:, 2], two.sketch[:, 2]]))
    return Partial(
        count=count,
        missing=one.missing + two.missing,
        mean=np.where(one.count > 0, one.mean + step * share, two.mean),
        square=one.square + two.square + step**2 * one.count * share,
        least=np.where(lower, two.least, one.least),
        least_member=np.where(lower, two.least_member, one.least_member),
        greatest=np.where(higher, two.greatest, one.greatest),
        greatest_member=np.where(higher, two.greatest_member, one.greatest_member),
        histogram=one.histogram + two.histogram,
        outside=one.outside + two.outside,
        sketch=np.concatenate([keys, counts[:, None]], axis=1),
    )


def summarize(how: Statistics, total: Partial, shape: tuple[int, ...]) -> Summary:
    """Return the statistics `how` asks for, in the `shape` of the quantity, from the accumulated `total`."""
    empty = total.count == 0
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.where(total.count > 1, total.square / (total.count - 1), np.nan)
    mean, least, greatest = (np.where(empty, np.nan, x) for x in (total.mean, total.least, total.greatest))
    ends = least, total.least_member, greatest, total.greatest_member
    quantiles = np.full((len(total.count), len(how.quantiles)), np.nan)
    for c in np.flatnonzero(~empty) if how.quantiles else ():
        bins, counts = total.sketch[total.sketch[:, 0] == c, 1:].T
        ranks = np.array(how.quantiles) * (counts.sum() - 1)
        quantiles[c] = _bin_centres(bins[np.searchsorted(np.cumsum(counts), ranks, side="right")])
    return Summary(
        *(x.reshape(shape) for x in (total.count, total.missing, mean, variance, *ends)),
        histogram=None if how.edges is None else total.histogram.reshape(*shape, -1),
        outside=None if how.edges is None else total.outside.reshape(*shape, 2),
        quantiles=quantiles.reshape(*shape, -1) if how.quantiles else None,
    )


# ---- as bytes --------------------------------------------------------------------------------------------------------


def statistics_to_bytes(partials: dict[str, Partial]) -> bytes:
    rows = ((f"{name}/{field}", x) for name, part in partials.items() for field, x in part._asdict().items())
    return arrays_as_bytes(dict(rows))


def statistics_from_bytes(data: bytes) -> dict[str, Partial]:
    with np.load(io.BytesIO(data)) as file:
        names = dict.fromkeys(key.rsplit("/", 1)[0] for key in file)
        return {name: Partial(*(file[f"{name}/{field}"] for field in Partial._fields)) for name in names}
