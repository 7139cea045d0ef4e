"""Experiment design: planned records in the order of what they would tell.

With M the information that the fit has, and G the rows of a planned record in units of the noise, made orthogonal to
those of its start where that has to be fitted too,

    gain = log det(M + GᵀG) − log det M

is twice the logarithm by which the volume of the confidence ellipsoid shrinks (D-optimality), expected at the fitted
parameters. A record that sees a combination which was not seen so far comes first, whatever its gain in the others.
Source: Atkinson, Donev & Tobias, *Optimum Experimental Designs* (2007), ch. 11.
"""

from typing import NamedTuple

import numpy as np

from lagjax._equations import truncated_svd
from lagjax._fit.result._information import Information


class Experiments(NamedTuple):
    """Planned records ranked by their expected information. Print it for a table.

    - `names` (E,); `gain` (E,): log det(M + GᵀG) − log det M of what is seen already.
    - `newly_seen` (E,): how many combinations a record would see that were not seen.
    - `parameters` (F,), `deviations` (E, F): the standard deviation of each unknown afterwards, over that of now.
    """

    names: tuple[str, ...]
    gain: np.ndarray
    newly_seen: np.ndarray
    parameters: tuple[str, ...]
    deviations: np.ndarray

    def __repr__(self) -> str:
        width = max(len(name) for name in (*self.names, "experiment"))
        rows = [f"{'experiment':<{width}}  {'gain':>8}  {'volume':>8}  {'newly seen':>10}  most for"]
        for name, gain, new, after in zip(self.names, self.gain, self.newly_seen, self.deviations, strict=True):
            known = np.where(np.isfinite(after), after, 1.0)
            place = int(np.argmin(known))
            change = f"{self.parameters[place]}, whose interval becomes {known[place]:.2g} of now"
            change = change if known[place] < 1 else ""
            rows.append(f"{name:<{width}}  {gain:>8.3g}  {np.exp(-gain / 2):>8.3g}  {new:>10}  {change}")
        return "\n".join(rows)


def rank_experiments(
    names: list[str], rows: list[np.ndarray], labels: tuple[str, ...], known: Information
) -> Experiments:
    """The information of planned records; their rows (M, F) have starts eliminated and are in units of the noise."""
    unseen = known.null
    basis = truncated_svd(unseen.T).null if unseen.size else np.eye(len(labels))
    have = np.linalg.inv(basis.T @ known.identifiable @ basis)
    gains = [_gain(g, basis, unseen, have) for g in rows]
    order = sorted(range(len(rows)), key=lambda k: (-gains[k][1], -gains[k][0]))
    gain, new, deviations = (np.array([gains[k][i] for k in order]) for i in range(3))
    return Experiments(tuple(names[k] for k in order), gain, new, labels, deviations)


def _gain(g: np.ndarray, basis: np.ndarray, unseen: np.ndarray, have: np.ndarray) -> tuple[float, int, np.ndarray]:
    """The gain of one record, how many unseen combinations it sees, and deviations afterwards over those of now."""
    seen = g @ basis
    gain = np.linalg.slogdet(have + seen.T @ seen)[1] - np.linalg.slogdet(have)[1]
    new = 0
    if unseen.size:
        size = float(np.linalg.norm(g)) or 1.0
        new = int(truncated_svd(g @ unseen, absolute=1e-6 * size * float(np.linalg.norm(unseen, 2))).rank)
    before, after = (np.diag(basis @ np.linalg.inv(m) @ basis.T) for m in (have, have + seen.T @ seen))
    lost = np.linalg.norm(unseen, axis=1) > 1e-6 if unseen.size else np.zeros(len(before), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(gain), new, np.where(lost, np.nan, np.sqrt(after / before))
