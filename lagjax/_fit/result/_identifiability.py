"""Identifiability: the parameters, and the combinations of them, that the data do not determine, in sentences.

A null direction v of the parameters says that measurements do not change along v, at one point. In logarithms, with the
relative changes dxᵢ/xᵢ as coordinates, what is seen is orthogonal to it: if that has small whole exponents, here and at
another point, then only a product of powers enters, such as m·l. The same with the changes dxᵢ themselves finds sums.
Every other direction is given in numbers.
"""

import contextlib
import re
from fractions import Fraction

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri

from lagjax._equations import echelon_form, truncated_svd
from lagjax._fit.model._inputs import input_functions
from lagjax._fit.model._noise import AbstractNoise, StudentT
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._records import Record
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, Trial
from lagjax._fit.model._sensors import wrap_residuals
from lagjax._fit.result._information import Information, confirmed_null, growth, null_space, row_sizes
from lagjax._fit.search._descent import Descent

_CHANCE = 0.05  # of noise alone to be as likely a motion
_MOST_NAMES = 12  # in one sentence
_LARGEST_EXPONENT, _EXACT = 6, 1e-3  # of recognised products; how near to a whole number an exponent must be


def unseen_sentences(descent: Descent, known: Information) -> tuple[str, ...]:
    """A sentence for every set of parameters of which something is not seen, and one for those that rounding hides."""
    residuals, trial = descent.residuals, descent.trial
    hidden = _sentence_on_rounding(residuals, trial, known)
    null, parameters = known.confirmed, residuals.parameters
    if not null.shape[1]:
        return hidden
    spaces = [(parameters.jacobian(trial.u) @ null, parameters.values(trial.u))]  # here, and a few per cent away
    near = trial.u + parameters.sizes(trial.u) * np.random.default_rng(0).uniform(0.02, 0.06, len(trial.u))
    with contextlib.suppress(LostMotion):
        other = residuals.evaluate(Point(near, trial.starts))
        factors = [np.sqrt(batch.weights) / descent.noise.sigma for batch in residuals.batches]
        triangles = residuals.triangles(other, factors)
        there = null_space(triangles, residuals.states, residuals.unknowns, parameters.prior_weights)[0]
        there = confirmed_null(residuals, other, there)
        spaces.append((parameters.jacobian(near) @ there, parameters.values(near)))
    blocks, elements = _independent_blocks(spaces[0][0]), np.array(parameters.elements)
    alone = [int(block[0]) for block in blocks if len(block) == 1]
    nowhere = {name for name in elements[alone] if np.isin(np.flatnonzero(elements == name), alone).all()}
    nowhere -= {*parameters.names}  # those that all share
    found = [
        f"Nothing that was measured in any record depends on {elements[block[0]]}."
        if len(block) == 1 and elements[block[0]] in nowhere
        else _sentence(parameters, block, spaces)
        for block in blocks
    ]
    found = [*dict.fromkeys(found)]
    if not found:
        ended = dict.fromkeys(parameters.labels[i] for i in np.flatnonzero(np.abs(null).max(axis=1) > 1e-6))
        found = [f"At the end of its set, where nothing that was measured depends on it: {', '.join(ended)}."]
    return (*found, *hidden)


def _sentence_on_rounding(residuals: Residuals, trial: Trial, known: Information) -> tuple[str, ...]:
    if known.confirmed.shape[1] == known.null.shape[1]:
        return ()
    basis = np.linalg.qr(known.confirmed)[0]
    left = known.null / np.linalg.norm(known.null, axis=0)
    left = left - basis @ (basis.T @ left)
    labels = residuals.parameters.labels
    names = list(dict.fromkeys(labels[k] for k in np.flatnonzero(np.linalg.norm(left, axis=1) > 1e-5)))
    grown, record = max(
        (growth([row[None]]), residuals.pieces[place].record)
        for batch, size in zip(residuals.batches, row_sizes(residuals, trial), strict=True)
        for place, row in zip(batch.rows, size, strict=True)
    )
    return (
        f"{residuals.label(record)} is chaotic: motions grow apart within it by a factor of {grown:.0e}, and rounding "
        f"hides what it says about {_join_names(names)}. There are no intervals from records that long: cut it into "
        "several shorter ones.",
    )


def sentence_on_rest(descent: Descent, known: Information, law: AbstractNoise) -> tuple[str, ...]:
    """A sentence where the motion that was fitted, starts and all, is no likelier than rest, as far as noise can tell.

    White noise has some swing at each of T/2 frequencies, and a search finds one of them. Its gain in log-likelihood is
    exponential at each, so that of the best of them is beyond log(T/2) + χ²/2 by chance alone in few fits. Where inputs
    drive the motion, its frequencies are theirs.
    """
    residuals, trial = descent.residuals, descent.trial
    recordings = [record for record in residuals.records if isinstance(record, Record)]
    if not len(residuals.parameters) or len(recordings) < len(residuals.records) or not residuals.fitted.all():
        return ()
    still, constants = [], 0
    for batch in residuals.batches:
        counted = batch.weights > 0
        centre = np.sum(batch.weights * batch.values, axis=1) / np.maximum(batch.weights.sum(axis=1), 1e-300)
        if isinstance(law, StudentT):  # whose mean outliers do not move
            centre = np.nan_to_num(np.nanmedian(np.where(counted, batch.values, np.nan), axis=1))
        still.append(np.where(counted, centre[:, None] - batch.values, 0.0))
        constants += int(counted.any(axis=1).sum())
    rest = trial._replace(residuals=[wrap_residuals(r, residuals.parts[0].frame.periods) for r in still])
    of_rest = residuals.log_likelihood(rest, residuals.noise_scale(rest, law))
    share = known.effective.sum() / residuals.measured
    gain = share * (residuals.log_likelihood(trial, descent.noise) - of_rest)
    driven = all(input_functions(part.scene) for part in residuals.parts)
    many = 1.0 if driven else max(len(record) for record in recordings) / 2
    used = max(len(residuals.parameters) + residuals.free_states - constants - (many > 1), 1)
    least = np.log(many) + 0.5 * float(chdtri(used, _CHANCE))
    if gain >= least:
        return ()
    return (
        f"Nothing is seen to move: the fitted motion is likelier than rest by a factor of e^{max(gain, 0.0):.2g} only, "
        f"and noise alone gives up to e^{least:.2g}. What it says of {_join_names([*residuals.parameters.labels])} is "
        "chance: measure a larger motion, or a longer one, or give start=(q0, qdot0) where it is known.",
    )


def _independent_blocks(null: np.ndarray) -> list[np.ndarray]:
    """Sets of parameters between which no null direction (F, K) is shared: indices of nonzero rows, set by set."""
    reduced = np.abs(echelon_form(null.T))
    moved = (reduced > 1e-5 * reduced.max(axis=1, keepdims=True)).astype(int)
    _, component = connected_components(moved.T @ moved)
    return [np.flatnonzero(component == k) for k in dict.fromkeys(component[moved.any(axis=0)].tolist())]


def _sentence(parameters: Parameters, block: np.ndarray, spaces) -> str:
    """The sentence for one set of parameters, from the null directions of x and the values x at one or two points."""
    names = [parameters.names[i] for i in block]
    if len(block) == 1:
        return f"Nothing that was measured depends on {names[0]}."
    relative = [_directions_within(direction / np.where(x != 0, x, 1.0)[:, None], block) for direction, x in spaces]
    absolute = [_directions_within(direction, block) for direction, _ in spaces]
    if all(np.all(x[block] != 0) for _, x in spaces) and (rows := _whole_numbers(relative)) is not None:
        if relative[0].shape[1] == 1 and np.ptp(relative[0]) < _EXACT * np.abs(relative[0]).max():
            return f"A common factor of {_join_names(names)} is not seen, only their ratios: keep one of them fixed."
        return _sentence_on_seen(names, [_write_product(row, names) for row in rows])
    if (rows := _whole_numbers(absolute)) is not None:
        return _sentence_on_seen(names, [_write_sum(row, names) for row in rows])
    if (count := absolute[0].shape[1]) > 1:
        return f"{count} combinations of {_join_names(names)} are not seen: keep {count} of them fixed."
    changes = absolute[0][:, 0] / np.abs(absolute[0][:, 0]).max()
    together = ", ".join(f"{name} by {change:+.3g}" for name, change in zip(names, changes, strict=True))
    whole = _join_names(names)
    return f"A combination of {whole} is not seen: to change {together}, in proportion, changes nothing measured."


def _directions_within(directions: np.ndarray, block: np.ndarray) -> np.ndarray:
    """The directions that move only the parameters of one set, (len(block), K)."""
    outside = np.delete(directions, block, axis=0)
    if not outside.size:
        return directions[block]
    size = np.linalg.norm(directions, axis=0)
    return (directions / size @ truncated_svd(outside / size, absolute=1e-5).null)[block]


def _whole_numbers(spaces: list[np.ndarray]) -> list[list[int]] | None:
    """The rows orthogonal to a space of directions as small whole numbers, the same at all points; None if not so."""
    first = spaces[0]
    if len(spaces) < 2 or any(space.shape != first.shape or not space.size for space in spaces):
        return None
    orthogonal = truncated_svd(first.T, 1e-6).null
    if not orthogonal.size:
        return None
    rows = []
    for row in echelon_form(orthogonal.T):
        fractions = [Fraction(float(x)).limit_denominator(_LARGEST_EXPONENT) for x in row]
        common = np.lcm.reduce([f.denominator for f in fractions])
        whole = [int(f * int(common)) for f in fractions]
        if max(map(abs, whole)) > _LARGEST_EXPONENT or np.abs(np.array(whole) / common - row).max() > _EXACT:
            return None
        rows.append(whole)
    rows = _simplify_rows(rows)
    for space in spaces[1:]:
        left = np.array(rows, float) @ space
        if np.abs(left).max() > _EXACT * np.abs(space).max():
            return None
    return rows


def _simplify_rows(rows: list[list[int]]) -> list[list[int]]:
    """Whole rows of the same span with fewer minus signs, and then smaller numbers: a·m and b·m, not a/b and a·m."""

    def weight(row):
        return sum(x < 0 for x in row), sum(map(abs, row)), [-x for x in row]  # the last so that a/b is not b/a

    def positive_sign(row):
        return min(row, [-x for x in row], key=weight)

    rows = [positive_sign(row) for row in rows]
    while True:  # the weights fall at every turn, and are whole
        better = []
        for i, row in enumerate(rows):
            for other in rows[:i] + rows[i + 1 :]:
                sums = [positive_sign([a + sign * b for a, b in zip(row, other, strict=True)]) for sign in (1, -1)]
                better += [(weight(new), i, new) for new in sums if weight(new)[:2] < weight(row)[:2]]
        if not better:
            return sorted(rows, reverse=True)
        _, i, new = min(better)
        rows[i] = new


def _write_product(row: list[int], names: list[str]) -> str:
    powers = [(x, name if abs(x) == 1 else f"{name}^{abs(x)}") for name, x in zip(names, row, strict=True)]
    above, below = [text for x, text in powers if x > 0], [text for x, text in powers if x < 0]
    return "·".join(above) + (f"/({'·'.join(below)})" if len(below) > 1 else f"/{below[0]}" if below else "")


def _write_sum(row: list[int], names: list[str]) -> str:
    parts = [(x, name if abs(x) == 1 else f"{abs(x)} {name}") for x, name in zip(row, names, strict=True) if x]
    return "".join(f" {'+' if x > 0 else '−'} {part}" for x, part in parts).removeprefix(" + ")


def _join_names(names: list[str]) -> str:
    if len(names) > _MOST_NAMES:  # weights of a network: whole arrays instead of their numbers
        names = list(dict.fromkeys(re.sub(r"\[[\d, ]+\]$", "", name) for name in names))
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _sentence_on_seen(names: list[str], seen: list[str]) -> str:
    return f"Of {_join_names(names)} only {_join_names(seen)} {'is' if len(seen) == 1 else 'are'} seen."
