"""Designs: points that are chosen by a rule instead of listed, for `over` of `lagjax.sweep`.

- `random`: independent uniform numbers
- `sobol`: Sobol's sequence, scrambled, whose means have small errors
- `latin_hypercube`: one point in each of equal parts of every interval
- `Design`: what they return
"""

import hashlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

__all__ = ["Design", "latin_hypercube", "random", "sobol"]

GROWING = ("random", "sobol")  # more members begin with the same ones
SLICE = 2**20  # values that are in memory together: 8 MiB of one name
_LONGEST_HYPERCUBE = 10_000_000  # scipy makes a latin hypercube as a whole: 80 MB for each name
_LONGEST_SOBOL = 2**30  # scipy's direction numbers have 30 bits by default


@dataclass(frozen=True)
class Design:
    """A rule that gives `count` values to one name of `over`, or to a tuple of names; made by `random` and the like."""

    kind: str
    count: int
    seed: int
    low: tuple[float, ...]
    high: tuple[float, ...]

    def about(self, names: tuple[str, ...]) -> "Design":
        """Return the design with bounds for each of these names; raise `ValueError` if their number does not fit."""
        bounds = [x * len(names) if len(x) == 1 else x for x in (self.low, self.high)]
        for which, x in zip(("low", "high"), bounds, strict=True):
            if len(x) != len(names):
                design = f"the {self.kind} design for {names}"
                raise ValueError(f"`{which}` of {design} has {len(x)} numbers: give one each.")
        return Design(self.kind, self.count, self.seed, *bounds)

    def described(self) -> dict:
        """Return the rule without the count, for a store's description."""
        return {"rule": self.kind, "seed": self.seed, "low": list(self.low), "high": list(self.high)}

    def pieces(self, names: tuple[str, ...]) -> Iterator[np.ndarray]:
        """Yield the values (m, names) in order, at most `SLICE` at a time; a Latin hypercube as a whole."""
        mixed = int.from_bytes(hashlib.sha256("\n".join(names).encode()).digest()[:8], "little")
        key = (mixed << 64) | self.seed  # two axes with one seed are drawn independently
        if self.kind == "random":
            numbers = np.random.Generator(np.random.Philox(key=key))
            draw = lambda n: numbers.random((n, len(names)))  # noqa: E731
        else:
            from scipy.stats import qmc

            kind = qmc.Sobol if self.kind == "sobol" else qmc.LatinHypercube  # the first scrambled, by default
            draw = kind(len(names), rng=np.random.default_rng(key)).random
        low, high = np.array(self.low)[:, None], np.array(self.high)[:, None]
        most = SLICE if self.kind in GROWING else self.count
        for start in range(0, self.count, most):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that the count is no power of two: the user's choice
                units = draw(min(most, self.count - start))
            columns = np.ascontiguousarray(units.T)  # else the loop over so few names would be the inner one
            yield (columns * (high - low) + low).T


def random(count: int, seed: int = 0, low=0.0, high=1.0) -> Design:
    """`count` values drawn evenly from [low, high), for a name in `over` of `sweep`, or for a tuple of names.

    Value k is a function of (seed, names, k) alone, by the counter-based generator Philox 4×64: a larger design begins
    with the same values. `low` and `high` are numbers, or one for each name. Raises `ValueError` for bounds that are no
    interval.

    Source: Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC 2011.

    ```python
    import lagjax

    over = {"length": [0.5, 1.0], ("angle", "speed"): lagjax.designs.random(10_000, seed=1, low=-3.0, high=3.0)}
    ```
    """
    return _make_design("random", count, seed, low, high, None)


def sobol(count: int, seed: int = 0, low=0.0, high=1.0) -> Design:
    """`count` points of Sobol's sequence, scrambled, between `low` and `high`: means over them have small errors.

    The arguments are those of `random`; a larger design begins with the same points. A power of two is the best
    `count`. Raises `ValueError` for bounds that are no interval, and beyond 2³⁰ points.

    Source: `scipy.stats.qmc.Sobol`; Joe & Kuo, SIAM J. Sci. Comput. 30 (2008) 2635; Owen, J. Complexity 14 (1998) 466.

    ```python
    import lagjax

    over = {("angle", "speed"): lagjax.designs.sobol(1024, seed=1, low=(-3.0, 0.0), high=(3.0, 1.0))}
    ```
    """
    return _make_design("sobol", count, seed, low, high, _LONGEST_SOBOL)


def latin_hypercube(count: int, seed: int = 0, low=0.0, high=1.0) -> Design:
    """A Latin hypercube of `count` points: each of the `count` equal parts of every interval contains one of them.

    The arguments are those of `random`. It is a design as a whole: it cannot be extended, and has at most 10⁷ points.
    Raises `ValueError` for bounds that are no interval, and for more points.

    Source: `scipy.stats.qmc.LatinHypercube`; McKay, Beckman & Conover, Technometrics 21 (1979) 239.

    ```python
    import lagjax

    over = {("angle", "speed"): lagjax.designs.latin_hypercube(1000, seed=1, low=(-3.0, 0.0), high=(3.0, 1.0))}
    ```
    """
    return _make_design("latin_hypercube", count, seed, low, high, _LONGEST_HYPERCUBE)


def _make_design(kind: str, count, seed, low, high, most: int | None) -> Design:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"The count of a {kind} design must be a positive whole number; got {count!r}.")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise ValueError(f"The seed of a {kind} design must be a whole number from 0 to 2^63 - 1; got {seed!r}.")
    if most is not None and count > most:
        raise ValueError(f"A {kind} design has at most {most} points, not {count}: take lagjax.designs.random.")
    low, high = (tuple(float(x) for x in np.atleast_1d(np.asarray(bound))) for bound in (low, high))
    names = max(len(low), len(high))
    pairs = zip(*(x * names if len(x) == 1 else x for x in (low, high)), strict=len(low) == len(high))
    for a, b in pairs:
        if not (np.isfinite([a, b]).all() and a < b):
            raise ValueError(f"A {kind} design lies between finite numbers low < high; got {a:g} and {b:g}.")
    return Design(kind, int(count), int(seed), low, high)
