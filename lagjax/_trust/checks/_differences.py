"""Slopes by finite differences, with an estimate of their error, to verify derivatives.

f is evaluated at x ± hₖ e for steps that halve from rung to rung, hₖ = h₀ 2⁻ᵏ. On every rung

    two-sided  (8 (f(h) − f(−h)) − (f(2h) − f(−2h))) / 12h       forward  (4 f(h) − f(2h) − 3 f(0)) / 2h

and backward likewise. Large steps have a truncation error, small ones a rounding error. The error on a rung is taken as
the largest change between neighbouring rungs, but at least the rounding error of f; the rung with the least error is
used. Where forward and backward slopes differ by more than their errors, f has a kink.

Source: Press et al., *Numerical Recipes*, §5.7 (the two errors); Ridders, Adv. Eng. Softw. 4 (1982) 75.
"""

from typing import NamedTuple

import numpy as np

# The factor within which an estimated error is trusted. Slopes that differ by less count as equal: doubled, derivatives
# that are wrong by less than 16 errors pass.
_SAFETY = 8.0


class Slopes(NamedTuple):
    """Estimated slopes and their errors, each of shape (directions, outputs)."""

    value: np.ndarray
    error: np.ndarray


def step_ladder(size: np.ndarray, dtype) -> np.ndarray:
    """Return steps (rungs, coordinates) for coordinates of these sizes: from 1/4 down to eps^(2/3) of a size."""
    rungs = int(-np.log2(np.finfo(dtype).eps) * 2 / 3)
    return (size * 0.25 * 2.0 ** -np.arange(rungs)[:, None]).astype(dtype)


def slopes(minus, here, plus, steps, place, eps: float, noise=0.0) -> tuple[Slopes, Slopes, Slopes]:
    """Return two-sided, forward and backward slopes from f(x − h e), f(x) and f(x + h e), each (directions, outputs).

    `minus` and `plus` have the shape (directions, rungs, outputs), `here` (outputs,), `steps` (rungs, directions),
    `place` (directions,): the coordinate itself, whose rounding changes f. `noise` (outputs,): the rounding error of f
    from terms that cancel, beyond that of its value.
    """
    h, here = steps.T[:, 1:, None], np.asarray(here, float)
    least = float(np.finfo(steps.dtype).tiny)  # smaller numbers underflow
    minus, plus = np.asarray(minus, float), np.asarray(plus, float)
    near, far = (plus[:, 1:], minus[:, 1:]), (plus[:, :-1], minus[:, :-1])
    size = np.maximum(np.maximum(np.abs(near[0]), np.abs(near[1])), np.abs(here))
    with np.errstate(all="ignore"):
        both = (8 * (near[0] - near[1]) - (far[0] - far[1])) / (12 * h)
        ahead = (4 * near[0] - far[0] - 3 * here) / (2 * h)
        behind = (4 * near[1] - far[1] - 3 * here) / (-2 * h)

        def best(x):
            # f has the rounding of its value, and of every coordinate in it.
            terms = np.abs(place)[:, None, None] * np.abs(x)
            rounding = eps * (size + np.sum(np.where(np.isfinite(terms), terms, 0), axis=0)) + noise
            return _best_estimate(x, (rounding + least) / h)

        return best(both), best(ahead), best(behind)


def _best_estimate(estimates: np.ndarray, rounding: np.ndarray) -> Slopes:
    """Return the estimates (directions, rungs, outputs) of the rung with the least error."""
    changes = np.abs(np.diff(estimates, axis=1))
    # The largest of the changes to two rungs on either side.
    padded = np.pad(changes, ((0, 0), (2, 2), (0, 0)), mode="edge")
    nearby = np.max([padded[:, i : i + estimates.shape[1]] for i in range(4)], axis=0)
    error = nearby + rounding
    error = np.where(np.isfinite(error), error, np.inf)
    trusted = np.where(_agrees_below(estimates, error), error, np.inf)
    rung = np.argmin(trusted, axis=1)[:, None]
    return Slopes(*(np.take_along_axis(x, rung, axis=1)[:, 0] for x in (estimates, trusted)))


def _agrees_below(estimates: np.ndarray, error: np.ndarray) -> np.ndarray:
    """True if a rung agrees with all smaller steps, within errors: large steps over many periods would give 0."""
    value, reach = np.where(np.isfinite(error), estimates, 0.0), _SAFETY * error
    lowest = np.maximum.accumulate((value - reach)[:, ::-1], axis=1)[:, ::-1]
    highest = np.minimum.accumulate((value + reach)[:, ::-1], axis=1)[:, ::-1]
    return (value + reach >= lowest) & (value - reach <= highest)


def slopes_differ(one: Slopes, other: Slopes, dtype) -> np.ndarray:
    """True where two slopes differ by more than their errors and by more than eps^(1/3) of them."""
    allowed = _SAFETY * (one.error + other.error) + np.finfo(dtype).eps ** (1 / 3) * (abs(one.value) + abs(other.value))
    with np.errstate(invalid="ignore"):
        return np.abs(one.value - other.value) > allowed
