"""Influence: the records without which the parameters would move by more than they can have by chance.

The agreement of records needs no other search. With Hₖ and gₖ what record k adds to the matrix H and the gradient
of the parameters, starts eliminated, the fit without record k is near u + (H − Hₖ)⁻¹ gₖ, since all gradients together
are zero. If the records agree, that shift has the covariance (H − Hₖ)⁻¹ − H⁻¹. Source: Cook & Weisberg, *Residuals and
Influence in Regression* (1982), §3.4, for one observation.

With enough samples every model is wrong beyond chance, and records show it in different ways. So a record contradicts
the others only if parameters of its own would explain a fair share of the motion that the fit leaves in it: for another
machine that is nearly all, for what the scene lacks a few per cent.
"""

from typing import NamedTuple

import numpy as np

from lagjax._equations import decide
from lagjax._fit.model._residuals import Residuals, compress_rows
from lagjax._fit.result._information import Information, eliminate_starts
from lagjax._fit.search._unexplained import MOST_NAMED

_DISAGREE = 5.0  # standard deviations of a shift: twenty records of ten parameters show it in one of 1e4 fits
_SEEN = 1e-5  # of the largest singular value of columns in units of their standard deviations
_OWN = 0.2  # of the motion left in a record, explained by parameters of its own: 0.9 and more for another machine


def disagreements(
    residuals: Residuals, triangles: np.ndarray, known: Information, inside: np.ndarray, motion: dict[int, float]
) -> tuple[list[str], list[str]]:
    """Sentences for the records of another motion, and for those that show, each in its way, what the scene lacks.

    Only of parameters `inside` (F,) of their sets: at a bound the sum of squares has a slope. `motion` is the sum of
    squares of what the fit leaves in a record beyond white noise.
    """
    records = np.array([piece.record for piece in residuals.pieces])
    count = len(np.unique(records))
    if known.null.shape[1] or count < 2 or not inside.any():
        return [], []
    columns = np.concatenate([np.ones(residuals.states, bool), inside, [True]])
    variances = np.diag(known.covariance)[inside], np.diag(known.white)[inside]
    shifts = shifts_without(residuals.states, triangles[..., columns], records, *variances)
    labels = [label for label, keep in zip(residuals.parameters.labels, inside, strict=True) if keep]
    worst = [(k, int(np.argmax(np.abs(shift.sizes)))) for k, shift in shifts.items()]
    worst = sorted((-abs(shifts[k].sizes[i]), k, i) for k, i in worst if abs(shifts[k].sizes[i]) > _DISAGREE)
    apart = [(k, i) for _, k, i in worst if shifts[k].explained > _OWN * motion.get(k, 0.0)]
    pulls = [(k, i) for _, k, i in worst if (k, i) not in apart]
    if count == 2:  # each moves as far without the other
        apart, pulls, how = apart[:1], [] if apart else pulls[:1], "contradicts the other record"
    else:
        apart, pulls, how = apart[:MOST_NAMED], pulls[:1], "disagrees with the others"
    return (
        [f"{residuals.label(k)} {how}: without it {_shift_clause(labels[i], shifts[k].sizes[i])}." for k, i in apart],
        [
            f"Without {residuals.label(k)} {_shift_clause(labels[i], shifts[k].sizes[i])}, more than its interval "
            f"allows for. Parameters of its own would explain {100 * shifts[k].explained / motion[k]:.2g} % of the "
            "motion that is left in it: the scene lacks something that differs from record to record."
            for k, i in pulls
        ],
    )


def _shift_clause(label: str, shift: float) -> str:
    way = "up" if shift > 0 else "down"  # parameters move up with their unknowns
    return f"{label} would move {way} by {abs(shift):.1f} of the standard deviations that chance gives it"


class Shift(NamedTuple):
    """A fit without a record: how far each u moves (F,), in standard deviations of that for records that agree, and by
    how much parameters of its own would lower the record's sum of squares."""

    sizes: np.ndarray
    explained: float


def shifts_without(states: int, triangles, records: np.ndarray, variances, white) -> dict[int, Shift]:
    """The fit without one record, for each of them.

    `triangles` (N, …, 2n + F + 1) are those of the pieces, `records` (N,) says whose they are; `variances` (F,) are
    those of u, and `white` (F,) what they were if residuals were white. A record without which something is not
    seen is left out, since there is nothing that it could disagree with.
    """
    # The residual is one more column of the parameters, so that the starts are taken out of it as well.
    own = eliminate_starts(np.concatenate([triangles, triangles[..., -1:]], axis=-1), triangles, states)
    size, growth = 1.0 / np.sqrt(white), np.sqrt(np.maximum(variances / white, 1.0))
    whole, found = compress_rows(own.reshape(1, -1, own.shape[-1]))[0][:, :-1] / size, {}
    for k in np.unique(records):
        rows = own[records != k].reshape(-1, own.shape[-1])
        rest = compress_rows(rows[None])[0][:, :-1] / size
        if decide(rest, _SEEN).rank < rest.shape[1]:
            continue
        mine = own[records == k].reshape(-1, own.shape[-1])
        slopes, residuals = mine[:, :-1] / size, mine[:, -1]
        without, beside = np.linalg.inv(rest.T @ rest), np.linalg.inv(whole.T @ whole)
        shift = without @ slopes.T @ residuals
        chance = np.sqrt(np.maximum(np.diag(without) - np.diag(beside), 1e-12 * np.diag(without)))
        decided = decide(slopes, _SEEN)
        along = decided.left[:, : int(decided.rank)].T @ residuals
        found[int(k)] = Shift(shift / (chance * growth), float(along @ along))
    return found
