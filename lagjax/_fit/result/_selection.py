"""Selection: the candidate terms of a law that evidence asks for, by fits of the motion.

The law is fitted with all of its terms. About that fit the motion is linear in the numbers of the terms, also where
these change much, as long as forces change little: so a linear model says which terms explain the most, the first one
alone, each further one with those before it. The fit takes as many as evidence asks for. Then the term that is missed
least leaves, the others are fitted anew from where the linear model puts them, and so forth: a path of nested fits.
Evidence is

    BIC = k log(n/λ) − 2 log L/λ

with k free numbers, and λ the mean factor by which correlated residuals widen the variances of all terms: n samples
tell as much as n/λ independent ones.

BIC finds the law among laws of which one is true. Where residuals are correlated none is, and with many samples every
term improves the fit of the records by something that the law is not about. Then records that are left out decide, if
there are at least three: the smallest law that follows them as well as the best does, within one standard error.

A path of nested fits may lose the better of two terms that are alike. So all small subsets, and each term that left in
the place of each that is kept, are tried in linear models, and the likeliest are fitted.

Others take many terms out by shrinking (Tibshirani's lasso, sequential thresholds of Brunton, Proctor & Kutz): that
biases what is kept, and a threshold has units. Source: Miller, *Subset Selection in Regression* (2002); Kent,
Biometrika 69 (1982) 19, for λ; Kass & Raftery, J. Am. Stat. Assoc. 90 (1995) 773, for what a difference of BIC means.
"""

import contextlib
import itertools
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lagjax._equations import truncated_svd
from lagjax._fit.model._law_parameters import FoundLaw
from lagjax._fit.model._noise import AbstractNoise
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, Trial, qr_triangle
from lagjax._fit.result._comparison import choose_simplest, cross_validate
from lagjax._fit.result._information import Information, information, parameter_rows
from lagjax._fit.search._descent import Descent, column_norms, eliminate, minimise

_ENOUGH, _TRIALS = 1e-3, 60  # of the fit that is taken
_ENOUGH_OF_STEP, _TRIALS_OF_STEP = 1e-2, 20  # of the other fits, whose BIC is then known to 0.02
_DECIDED = 6.0  # of BIC: odds of 20 to 1, as those of an interval of 95 %
_CORRELATED = 0.5  # of neighbouring residuals: beyond, the scene lacks something, and records left out decide
_FEWEST_RECORDS = 3  # of which one can be left out
_FOLDS = 4  # groups of records, at most, that are left out in turn: each fit has three quarters of them
_TRIED_RIVALS = 4  # of the likeliest
_MOST_SUBSETS = 5000  # of as many terms, all of which are looked at: milliseconds for three of thirty
_LISTED = 8  # names in one line; of more it says how many there are
_ALIKE = 1e-3  # of BIC, that two ends of one search differ by
_TRIED_TOGETHER = 6  # terms up to which one leaves at a time
_KEPT = 1e6  # over the norm of a column: the weight that holds an unknown in a linear model
_ALONE = 1e-3  # of a null direction: the part of it in other unknowns, or in a term, that counts as none


class SelectionStep(NamedTuple):
    """One fit of a selection: the terms it has, those that it lacks of the fit before, its BIC, and the geometric mean
    over records of RMS residuals where they were left out, None where none was."""

    terms: tuple[str, ...]
    dropped: tuple[str, ...]
    bic: float
    left_out: float | None


class Selection(NamedTuple):
    """The choice of terms by a fit. Print it for a table with a line for each step.

    - `kept`: the names of the terms that are kept; `steps`: the fits that were compared, from all terms to few.
    - `alike`: sentences for the terms that the data cannot tell apart.
    - `idle`: the free numbers that only terms which are not kept depend on; they stay at their guess.
    """

    kept: tuple[str, ...]
    steps: tuple[SelectionStep, ...]
    alike: tuple[str, ...]
    idle: tuple[str, ...]
    text: str

    def __repr__(self) -> str:
        return self.text


def select_terms(
    done: Descent, law: AbstractNoise, laws: list[FoundLaw], tell: Callable[[str], None] | None
) -> tuple[Descent, Selection]:
    """The fit with the terms that evidence asks for, from that with all of them; `tell` prints a line for each fit."""
    search = _PathSearch.from_fit(done, law, _label_terms(laws), tell or (lambda _: None))
    search.shrink()
    best, why = search.choose()
    best, rivals = search.exchange(best)
    kept = frozenset(best.columns)
    alike = [_alike_sentence([name], same) for name, same in search.same.items() if same and kept.issuperset(same)]
    alike += [_alike_sentence(one.columns.keys() - kept, kept - one.columns.keys()) for one in rivals]
    alike = list(dict.fromkeys(alike))
    kept, count = tuple(best.columns), len(search.names)
    said = f"Of {count} terms {len(kept)} {'is' if len(kept) == 1 else 'are'} kept, {why}: {', '.join(kept) or 'none'}."
    residuals, point, idle = best.hold_idle(search.path[0])
    end = minimise(residuals, point, law, _ENOUGH, _TRIALS)
    if len(done.residuals.pieces) > len(done.residuals.records):
        end = end._replace(message=done.message, converged=done.converged and end.converged)
    end = end._replace(trials=done.trials + search.trials, message=" ".join([end.message, said, *alike]))
    unused = [f"Nothing that was measured depends on {name!r}." for name, same in search.same.items() if not same]
    unused += [f"Only terms that are not kept depend on {label}, which stays at its guess." for label in idle]
    text = "\n".join([*search.table_lines(), said, *alike, *unused])
    return end, Selection(kept, tuple(search.steps), tuple(alike), tuple(idle), text)


def keep_selected(parameters: Parameters, selection: Selection, laws: list[FoundLaw]) -> Parameters:
    """The parameters without the terms that a selection does not keep."""
    columns = _term_columns(_label_terms(laws), parameters)
    lost = [own for name, own in columns.items() if name not in selection.kept]
    stays = np.isin(np.arange(len(parameters)), np.concatenate([np.zeros(0, int), *lost]))
    fewer = parameters.zero(parameters.inverse(parameters.first), stays)
    return fewer.fix(fewer.inverse(fewer.first), _mark_unknowns(fewer, selection.idle))


def _mark_unknowns(parameters: Parameters, labels: Collection[str]) -> np.ndarray:
    """True for each unknown (F,) of the numbers with these labels."""
    marks = [np.full(own.stop - own.start, part.label in labels) for own, _, part in parameters.cuts]
    return np.concatenate([np.zeros(0, bool), *marks])


def _alike_sentence(others, kept) -> str:
    a, b = (" with ".join(map(repr, sorted(names))) for names in (others, kept))
    return f"The data cannot tell {a} from {b}: either fits."


def _are_nested(a: "_TermFit", b: "_TermFit") -> bool:
    """True if one of two fits has all terms of the other."""
    return a.columns.keys() <= b.columns.keys() or b.columns.keys() <= a.columns.keys()


def _project(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The part of a vector (M,) that lies in the span of some columns (M, K), whatever the units of each."""
    norms = np.linalg.norm(columns, axis=0)
    decided = truncated_svd(columns / np.where(norms > 0.0, norms, 1.0), _ALONE**2)
    basis = decided.left[:, : int(decided.rank)]
    return basis @ (basis.T @ target)


def _label_terms(laws: list[FoundLaw]) -> dict[str, str]:
    """The terms of all laws that select: the name of each by its label among parameters. They are called as in their
    law, and where two laws have one of the same name by their whole label."""
    labels = {f"{law.label}[{name!r}]": name for law in laws if law.law.selects for name in law.params}
    called = list(labels.values())
    return {label: label if called.count(name) > 1 else name for label, name in labels.items()}


def _term_columns(names: dict[str, str], parameters: Parameters) -> dict[str, np.ndarray]:
    """The unknowns that move each term of which a number is free, by its name."""
    found: dict[str, np.ndarray] = {}
    for own, _, part in parameters.cuts:
        for label, name in names.items():
            if part.label == label or part.label.startswith(f"{label}["):
                found[name] = np.append(found.get(name, np.zeros(0, int)), np.arange(own.start, own.stop))
    return {name: found[name] for name in names.values() if name in found}


class _TermFit(NamedTuple):
    """A fit with some of the terms: the unknowns of each, the steps (F,) that would make each of them zero, and the
    information about them. `rows` (M, F) are those of the terms in the linear model, orthogonal to all other unknowns,
    in units of the noise."""

    done: Descent
    columns: dict[str, np.ndarray]
    zero: np.ndarray
    known: Information
    rows: np.ndarray
    log_likelihood: float

    @classmethod
    def from_descent(cls, done: Descent, names: dict[str, str]) -> "_TermFit":
        parameters, u = done.residuals.parameters, done.trial.u
        columns, slopes, values = _term_columns(names, parameters), parameters.jacobian(u), parameters.values(u)
        zero = np.zeros(len(parameters))
        for k in np.concatenate([np.zeros(0, int), *columns.values()]):
            row = np.argmax(np.abs(slopes[:, k]))
            zero[k] = -values[row] / slopes[row, k]
        own = np.concatenate([np.zeros(0, int), *columns.values()])
        others = np.setdiff1d(np.arange(len(parameters)), own)
        residuals = done.residuals
        triangles = residuals.linearise(done.trial, done.noise)
        whole = parameter_rows(triangles, residuals.states, residuals.unknowns)
        rows = np.zeros((len(own), len(parameters)))
        rows[:, own] = qr_triangle(whole[:, [*others, *own]])[len(others) :, len(others) :]
        return cls(done, columns, zero, information(done), rows, residuals.log_likelihood(done.trial, done.noise))

    def places(self, names) -> np.ndarray:
        """The unknowns of some terms."""
        return np.concatenate([np.zeros(0, int), *(self.columns[name] for name in names)])

    def widening(self, names) -> float:
        """The mean factor by which correlated residuals widen the variances of some terms."""
        own = self.places(names)
        white, whole = (np.diag(matrix)[own] for matrix in (self.known.white, self.known.identifiable))
        seen = white > 0
        return max(float(np.mean(whole[seen] / white[seen])), 1.0) if seen.any() else 1.0

    def loss(self, names) -> float:
        """Twice the log likelihood that a linear model loses without some terms, as if residuals were white."""
        left = self.places(name for name in self.columns if name not in names)
        target = self.rows @ self.zero
        return float(np.sum((target - _project(self.rows[:, left], target)) ** 2))

    def rank_terms(self) -> list[str]:
        """The terms in the order in which they explain the most of what all together do, each with those before it."""
        order, lost = [], list(self.columns)
        while lost:
            losses = [self.loss([other for other in lost if other != name]) for name in lost]
            order.append(lost.pop(int(np.argmin(losses))))
        return order

    def find_least(self) -> list[str]:
        """The term that is missed least; of many those that together are missed no more than chance has it."""
        missed = {name: self.loss([name]) / self.widening([name]) / len(own) for name, own in self.columns.items()}
        order = sorted(missed, key=lambda name: missed[name])
        found = order[:1]
        for name in order[1 : len(order) // 2 if len(order) > _TRIED_TOGETHER else 1]:
            more = [*found, name]
            if self.loss(more) / self.widening(more) > len(self.places(more)):
                break
            found = more
        return found

    def find_same(self) -> dict[str, list[str]]:
        """The terms that others do exactly as well, by the name of each that is superfluous, with these others; a term
        that nothing depends on has none. Directions that also move other parameters say nothing about terms."""
        residuals = self.done.residuals
        triangles = residuals.linearise(self.done.trial, self.done.noise)
        norms = column_norms(triangles, residuals.states, residuals.unknowns)[1]
        null, alive, found = self.known.confirmed * norms[:, None], self.rank_terms(), {}
        null = null / np.linalg.norm(null, axis=0)
        while alive:
            others = np.setdiff1d(np.arange(len(null)), self.places(alive))
            inside = null @ truncated_svd(null[others], absolute=_ALONE).null
            if not inside.shape[1]:
                break
            sizes = {name: np.abs(inside[self.columns[name], 0]).max() for name in alive}
            same = [name for name, size in sizes.items() if size > _ALONE * max(sizes.values())]
            alive.remove(same[-1])
            found[same[-1]] = same[:-1]
        return found

    def hold_idle(self, whole: "_TermFit") -> tuple[Residuals, Point | Trial, list[str]]:
        """The residuals and the point, or the trial, of this fit where the numbers that nothing depends on, but did in
        the fit with the `whole` law, stay at their guess; and the labels of these."""
        unread = []
        for fit in (self, whole):
            residuals = fit.done.residuals
            triangles = residuals.linearise(fit.done.trial, fit.done.noise)
            rows = parameter_rows(triangles, residuals.states, residuals.unknowns)
            unread.append({part.label for own, _, part in residuals.parameters.cuts if not rows[:, own].any()})
        residuals, trial, first = self.done.residuals, self.done.trial, whole.done.residuals.parameters
        labels = sorted(unread[0] - unread[1])
        if not labels:
            return residuals, trial, labels
        stays, u = _mark_unknowns(residuals.parameters, labels), trial.u.copy()
        u[stays] = first.inverse(first.first)[_mark_unknowns(first, labels)]
        residuals = residuals.with_parameters(residuals.parameters.fix(u, stays))
        return residuals, Point(u[~stays], trial.starts), labels

    def drop(self, names, law: AbstractNoise) -> Descent | None:
        """The fit without some terms, from where the linear model puts the others; None where none can be followed."""
        residuals, trial = self.done.residuals, self.done.trial
        parameters, stays = residuals.parameters, np.isin(np.arange(len(trial.u)), self.places(names))
        triangles = residuals.linearise(trial, self.done.noise)
        scale = column_norms(triangles, residuals.states, residuals.unknowns)
        weight = _KEPT * np.where(stays, scale[1], 0.0)
        pull = weight, -weight * self.zero
        step = eliminate(triangles, residuals.states, scale, 1e-14, pull, residuals.unknowns)
        u = parameters.take_step(trial.u, np.where(stays, 0.0, step.u))
        residuals, begun = residuals.with_parameters(parameters.zero(trial.u, stays)), []
        for point in (Point(u[~stays], trial.starts + step.starts), Point(trial.u[~stays], trial.starts)):
            with contextlib.suppress(LostMotion):
                there = residuals.evaluate(point, slopes=False)
                begun.append((residuals.log_likelihood(there, residuals.noise_scale(there, law)), point, there))
        for _, point, there in sorted(begun, key=lambda one: -one[0]):
            with contextlib.suppress(LostMotion):
                there = residuals.evaluate(point, begun=there)
                return minimise(residuals, there, law, _ENOUGH_OF_STEP, _TRIALS_OF_STEP)
        return None


@dataclass(eq=False)
class _PathSearch:
    """The search of terms along a path of nested fits: `worth` is that of a sample in independent ones, `count` the
    number of independent samples; `same` are terms that others do exactly as well."""

    law: AbstractNoise
    names: dict[str, str]
    tell: Callable[[str], None]
    path: list[_TermFit]
    steps: list[SelectionStep]
    same: dict[str, list[str]]
    worth: float
    count: float
    trials: int = 0
    by_records: bool = False
    scores: dict[tuple[str, ...], np.ndarray] = field(default_factory=dict)

    @classmethod
    def from_fit(cls, done: Descent, law: AbstractNoise, names: dict[str, str], tell: Callable) -> "_PathSearch":
        """The search from a fit with all terms."""
        first = _TermFit.from_descent(done, names)
        known, measured = first.known, done.residuals.measured
        seen = not known.null.shape[1]  # else variances allow for no correlation
        worth = 1.0 / first.widening(first.columns) if seen else known.effective.sum() / measured
        found = cls(law, names, tell, [], [], first.find_same(), worth, max(worth * measured, 2.0))
        found.append(first, [])
        return found

    def drop(self, fit: _TermFit, names) -> _TermFit | None:
        done = fit.drop(names, self.law)
        if done is None:
            return None
        self.trials += done.trials
        return _TermFit.from_descent(done, self.names)

    def append(self, fit: _TermFit, dropped: list[str]) -> None:
        self.path.append(fit)
        self.steps.append(SelectionStep(tuple(fit.columns), tuple(dropped), self.bic(fit), None))
        self.tell(f"terms: {', '.join(fit.columns) or 'none'}; BIC {self.steps[-1].bic:.1f}")

    def bic(self, fit: _TermFit, loss: float = 0.0, dropped: int = 0) -> float:
        """The BIC of a fit, or of one without some of its unknowns, by twice the log likelihood that this loses."""
        free = len(fit.done.trial.u) - fit.known.null.shape[1] - dropped
        return free * float(np.log(self.count)) - self.worth * (2 * fit.log_likelihood - loss)

    def shrink(self) -> None:
        """Append fits with ever fewer terms, as long as a smaller one may be better than the best."""
        if (
            not self._try_best_subset()
            and self.same
            and (smaller := self.drop(self.path[0], list(self.same))) is not None
        ):
            self.append(smaller, list(self.same))
        while self.path[-1].columns:
            last = self.path[-1]
            dropped = last.find_least()
            smaller = self.drop(last, dropped)
            if smaller is None:
                break
            self.append(smaller, dropped)
            if -2 * self.worth * smaller.log_likelihood > min(step.bic for step in self.steps):
                break

    def _try_best_subset(self) -> bool:
        """Append the fit with the terms that explain the most, as many as the linear model of the first fit asks for;
        True where it is better than that."""
        first = self.path[0]
        order = first.rank_terms()
        rests = [order[count:] for count in range(1, len(order) - 1)]
        bics = [self.bic(first, first.loss(rest), len(first.places(rest))) for rest in rests]
        if not bics or min(bics) > self.steps[0].bic:
            return False
        rest = rests[int(np.argmin(bics))]
        smaller = self.drop(first, rest)
        if smaller is None or self.bic(smaller) > self.steps[0].bic:
            return False
        self.append(smaller, rest)
        return True

    def choose(self) -> tuple[_TermFit, str]:
        """The chosen fit, and the name of the criterion that chose it."""
        best = self.path[int(np.argmin([step.bic for step in self.steps]))]
        enough = len(best.done.residuals.records) >= _FEWEST_RECORDS and len(self.path) > 1
        self.by_records = bool(enough and np.nanmax(best.known.correlation) > _CORRELATED)
        if not self.by_records:
            return best, f"by BIC with {self.count:.0f} effective samples"
        scores = [self.score(fit) for fit in self.path]
        free = tuple(len(fit.done.trial.u) for fit in self.path)
        rms = [float(np.exp(np.mean(score))) for score in scores]
        self.steps = [step._replace(left_out=x) for step, x in zip(self.steps, rms, strict=True)]
        return self.path[choose_simplest(free, np.array(scores))], "by records left out and simulated"

    def score(self, fit: _TermFit) -> np.ndarray:
        """The mean logarithm of RMS residuals of each record where it is left out."""
        key = tuple(fit.columns)
        if key not in self.scores:
            done = fit.done
            folds = min(len(done.residuals.records), _FOLDS)
            self.tell(f"terms: {', '.join(key) or 'none'}; records are left out in {folds} groups")
            found = cross_validate(done.residuals, done.trial, done.noise, self.law, folds)[1]
            self.scores[key] = found
            self.tell(f"terms: {', '.join(key) or 'none'}; RMS {np.exp(np.mean(found)):.4g} of records left out")
        return self.scores[key]

    def exchange(self, best: _TermFit) -> tuple[_TermFit, list[_TermFit]]:
        """The best fit with other terms in the place of some, and those that fit as well, with no more terms."""
        tried: dict[tuple[str, ...], _TermFit] = {}
        while True:
            for _, wider, rest in self._likely_rivals(best)[:_TRIED_RIVALS]:
                key = tuple(name for name in wider.columns if name not in rest)
                if key not in tried and (found := self.drop(wider, rest)) is not None:
                    tried[key] = found
                    self.tell(f"terms: {', '.join(key)}; BIC {self.bic(found):.1f}")
            rivals = [one for one in tried.values() if one.columns.keys() != best.columns.keys()]
            behind = [self._measure_lag(one, best) for one in rivals]
            if not rivals or min(lag + least for lag, _, least in behind) > 0:
                near = [one for one, (lag, most, _) in zip(rivals, behind, strict=True) if lag < most]
                return best, [
                    one for one in near if len(one.columns) <= len(best.columns) and not _are_nested(one, best)
                ]
            lost, first = best.columns, rivals[int(np.argmin([lag + least for lag, _, least in behind]))]
            best, dropped = first, tuple(name for name in lost if name not in first.columns)
            left_out = float(np.exp(np.mean(self.score(best)))) if self.by_records else None
            self.steps.append(SelectionStep(tuple(best.columns), dropped, self.bic(best), left_out))

    def _measure_lag(self, rival: _TermFit, best: _TermFit) -> tuple[float, float, float]:
        """The lag of another fit behind the best one, by BIC or over records left out, the lag up to which it is as
        good, and the lead that it needs to be taken."""
        if not self.by_records:
            return self.bic(rival) - self.bic(best), _DECIDED, _ALIKE
        behind = self.score(rival) - self.score(best)
        error = float(behind.std(ddof=1) / np.sqrt(len(behind)))
        return float(behind.mean()), error, error

    def _likely_rivals(self, best: _TermFit) -> list[tuple[float, _TermFit, list[str]]]:
        """Other terms, no more of them, that may do as well as those of the best fit, the likeliest first: their BIC in
        a linear model, a wider fit, and the terms that it is to lose."""
        kept, widest, found = frozenset(best.columns), self.path[0], {}
        for new in widest.columns.keys() - kept:
            found |= dict.fromkeys(kept - {old} | {new} for old in kept)
        for count in range(1, len(kept) + 1):
            if math.comb(len(widest.columns), count) <= _MOST_SUBSETS:
                found |= dict.fromkeys(map(frozenset, itertools.combinations(widest.columns, count)))
        here, likely = self.bic(best), []
        for wanted in found:
            wider = next(fit for fit in reversed(self.path) if wanted <= fit.columns.keys())
            rest = [name for name in wider.columns if name not in wanted]
            bic = self.bic(wider, wider.loss(rest), len(wider.places(rest)))
            if bic < here + 2 * _DECIDED and wanted != kept:
                likely.append((bic, wider, rest))
        return sorted(likely, key=lambda one: one[0])

    def table_lines(self) -> list[str]:
        """The printed table: for each step the terms dropped, the BIC, and the residuals."""
        heads = ["without", "BIC", "RMS left out", "terms"]
        rows = [
            [_list_names(step.dropped), f"{step.bic:.1f}", f"{step.left_out:.4g}" if step.left_out else "",
             _list_names(step.terms) or "none"]
            for step in self.steps
        ]  # fmt: skip
        widths = [max(len(row[k]) for row in [heads, *rows]) for k in range(3)]
        if not any(row[2] for row in rows):
            heads[2], widths[2] = "", 0
        aligns = (str.ljust, str.rjust, str.rjust)
        cut = [[align(row[k], widths[k]) for k, align in enumerate(aligns) if widths[k]] for row in [heads, *rows]]
        return ["  ".join([*cells, row[3]]) for cells, row in zip(cut, [heads, *rows], strict=True)]


def _list_names(names: tuple[str, ...]) -> str:
    return ", ".join(names) if len(names) <= _LISTED else f"{len(names)} terms"
