"""`Density`: the logarithm of the posterior density of a fit's unknowns, a function of one vector for JAX.

    log p(x) = Σ_s (effective_s/samples_s) log L_s + log prior(params) + log |∂params/∂u|

x holds u, which moves the free parameters, the starts that are fitted, and of every signal log σ and, for Student's t,
a number that moves ν. All records of a system go in one batch of motions, and the gradient comes back over their
steps: about five motions, however many unknowns there are. Without a `prior` the density is flat in the parameters
within their sets, in the starts and in log σ and log ν. A motion that cannot be followed has the density zero.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from scipy.special import polygamma

from lagjax._doubles import accepts_singles
from lagjax._fit._inputs import Driven, asks
from lagjax._fit._noise import AbstractNoise, StudentT, Widths
from lagjax._fit._records import Samples, started
from lagjax._fit._residuals import AbstractQuestion, Part, Point
from lagjax._fit._wrapped import on_circle
from lagjax._hybrid import Scene
from lagjax._hybrid import follow as follow_scene
from lagjax._layout import halves
from lagjax._system import System

_LEAST_DOF, _MOST_DOF = 1.0, 200.0  # ν is between these, with a flat density of its logarithm


class Unknowns(NamedTuple):
    """One vector x taken apart: u (F,), the starts of all records (N, 2n), and the noise σ (S,), ν (S,)."""

    u: Any
    starts: Any
    sigma: Any
    dof: Any


class OfSystem:
    """The residuals of the records of one system, for JAX: gradients come back over the steps of their motions.

    `rows` (N,) says which of all records these are.
    """

    def __init__(self, part: Part, rows: np.ndarray, system: Scene):
        question = part.question
        if question.manifold is not None and question.fitted.any():
            raise ValueError("There is no density for starts on constraints that are fitted: give start=(q0, qdot0).")
        if question.signals.delays is not None:
            raise ValueError("There is no density for lagjax.Delayed sensors: keep the delay, and shift the times.")
        self.question, self.rows, self.signals = question, rows, part.signals
        form = question.signals.form
        self._form = form if form is not None and asks(system) else None
        self._scene = system
        if self._form is not None and isinstance(system, System):
            self._scene = self._form.driven(system)

    def begun(self, starts, params):
        """The starts of all records (N, 2n), of which some of this system are functions of the parameters."""
        layout, states = self.question.layout, self.question.states
        for row, piece in zip(self.rows, self.question.pieces, strict=True):
            start = self.question.records[piece.record].start
            if callable(start) and piece.places[0] == 0:
                pair = started(start, params)
                starts = starts.at[row, :states].set(jnp.concatenate([layout.flatten(half) for half in pair]))
        return starts

    def residuals(self, batch: Samples, at: Unknowns):
        """The outputs of the sensors less the measurements, (N, T, S of this system), of the records of one batch."""
        layout, signals = self.question.layout, self.question.signals
        numbers = self.question.parameters.numbers(at.u, jnp)
        params = self.question.parameters.restore(numbers)
        starts = at.starts[self.rows[batch.rows], : self.question.states]
        record = self.question.pieces[batch.rows[0]].record
        if record in self.question.clocks:
            times = self.question.clocks[record].times(starts[0], numbers)
            shown = jnp.zeros(batch.values.shape).at[0, :, -1].set(times)
            return jnp.where(batch.weights > 0, shown - batch.values, 0.0)

        def follow(ts, y0, inputs, table):
            q, qdot = map(layout.restore, halves(y0))
            own = params if self._form is None else Driven(params, *table)
            motion = follow_scene(self._scene, q, qdot, ts, own, rtol=self.question.rtol, throw=False)
            rows = jax.vmap(lambda q, v: jnp.concatenate([layout.flatten(q), layout.flatten(v)]))(motion.q, motion.qdot)
            return jax.vmap(lambda y, t, i: signals.at_one_time(y, t, numbers, i))(rows, ts, inputs)

        ts, values, inputs = (jnp.asarray(x, at.u.dtype) for x in (batch.ts, batch.values, batch.inputs))
        table = None if batch.table is None else tuple(jnp.asarray(x, at.u.dtype) for x in batch.table)
        shown = jax.vmap(follow)(ts, starts, inputs, table)
        shown = jnp.zeros(values.shape, values.dtype).at[..., : shown.shape[-1]].set(shown)
        return jnp.where(batch.weights > 0, on_circle(shown - values, self.question.periods, jnp), 0.0)


class Density:
    """log p(x), called with x (D,), for records whose residuals are those of `question` at `point`.

    - `systems`: the scenes by the names that they have in the question, None for the only one.
    - `first` (D,): the fit; `names` (D,): what the numbers are called.
    - `of_starts` (N, 2n): which numbers of x the starts are; D for one that is known, or that a system does not have.
    - `shares` (S,): how many independent samples one sample of each signal is worth.
    """

    def __init__(
        self, question: AbstractQuestion, systems: dict[str | None, Scene], noise: AbstractNoise, point: Point,
        widths: Widths, shares: np.ndarray, prior: Callable | None = None,
    ):  # fmt: skip
        self.question, self.shares, self.prior, self.point, self.widths = question, shares, prior, point, widths
        self.systems = [OfSystem(part, rows, systems[part.name]) for part, rows in question.apart]
        self.dtype = np.result_type(*(one.question.layout.dtype for one in self.systems))
        self._tails = np.isfinite(widths.dof)
        self.moves_dof = isinstance(noise, StudentT) and noise.dof is None
        share = np.log(np.clip(widths.dof, 1.01 * _LEAST_DOF, 0.99 * _MOST_DOF) / _LEAST_DOF)
        share = share / math.log(_MOST_DOF / _LEAST_DOF)
        dof = np.log(share / (1 - share)) if self.moves_dof else np.zeros(0)
        moves = np.zeros((len(question.pieces), question.states), bool)
        for one in self.systems:
            moves[one.rows, : one.question.states] = question.fitted[one.rows, None]
        free, starts = len(point.u), point.starts[moves]
        self.first = np.concatenate([point.u, starts, np.log(widths.sigma), dof])
        self.of_starts = np.full(moves.shape, len(self.first))
        self.of_starts[moves] = np.arange(free, free + len(starts))
        self.of_noise = slice(free + len(starts), free + len(starts) + len(widths.sigma))
        self.names = (*question.parameters.labels, *self._names_of_starts(), *self._names_of_noise())

    def _names_of_starts(self) -> list[str]:
        question = self.question
        layouts = {row: one.question.layout for one in self.systems for row in one.rows.tolist()}
        return [
            f"starts{question.called(question.pieces[row].record).removeprefix('records')}.{half}{name[1:]}"
            for row in np.flatnonzero(question.fitted).tolist()
            for half in ("q", "qdot")
            for name in layouts[row].names
        ]

    def _names_of_noise(self) -> list[str]:
        names = self.question.names
        return [f"log σ of {name}" for name in names] + [f"ν of {name}" for name in names] * self.moves_dof

    def __len__(self) -> int:
        return len(self.first)

    def unknowns(self, x) -> Unknowns:
        """A vector (D,) taken apart."""
        u, starts = x[: len(self.question.parameters)], jnp.asarray(self.point.starts, x.dtype)
        starts = jnp.where(self.of_starts < len(self), jnp.append(x, 0.0)[self.of_starts], starts)
        for one in self.systems:
            starts = one.begun(starts, self.params(u))
        dof = self._dof(x[self.of_noise.stop :]) if self.moves_dof else jnp.asarray(self.widths.dof, x.dtype)
        return Unknowns(u, starts, jnp.exp(x[self.of_noise]), dof)

    @staticmethod
    def _dof(moved):
        return _LEAST_DOF * jnp.exp(math.log(_MOST_DOF / _LEAST_DOF) * jax.nn.sigmoid(moved))

    def params(self, u):
        """The user's pytree of parameters at u (F,)."""
        return self.question.parameters.restore(self.question.parameters.numbers(u, jnp))

    @accepts_singles(("x",))
    def __call__(self, x):
        """log p(x), up to a constant; −∞ where a motion could not be followed."""
        return self.posterior(x, self.log_likelihood(x))

    def posterior(self, x, log_likelihood):
        """log p(x) with what the measurements contribute to it; −∞ where that is no number."""
        at = self.unknowns(jnp.asarray(x, self.dtype))
        total = log_likelihood + self.question.parameters.log_volume(at.u, jnp)
        if self.prior is not None:
            total = total + self.prior(self.params(at.u))
        if self.moves_dof:
            moved = x[-len(self.widths.sigma) :]
            total = total + jnp.sum(jax.nn.log_sigmoid(moved) + jax.nn.log_sigmoid(-moved))
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def log_likelihood(self, x):
        """Σ_s shares_s log L_s, up to a constant; NaN where a motion could not be followed."""
        at = self.unknowns(jnp.asarray(x, self.dtype))
        pairs = zip(self.question.batches, self.residuals(at), strict=True)
        weighted = [np.sqrt(batch.weights) * residuals for batch, residuals in pairs]
        return self.of_weighted(weighted, [batch.weights > 0 for batch in self.question.batches], at)

    def residuals(self, at: Unknowns) -> list:
        """The outputs of the sensors less the measurements, (N, T, S), of every batch of the question."""
        found, signals = [], len(self.question.names)
        for one in self.systems:
            for batch in one.question.batches:
                own = one.residuals(batch, at)
                found.append(jnp.zeros((*own.shape[:2], signals), own.dtype).at[..., one.signals].set(own))
        return found

    def of_weighted(self, weighted: list, counted: list, at: Unknowns):
        """Σ_s shares_s log L_s, up to a constant, of √weight · residual (N, T, S) of every batch, where they count.

        For a signal whose noise is Gaussian other numbers with the same sum of squares do as well.
        """
        total = -jnp.sum(self.shares * (self.question.weights > 0).sum(axis=0) * jnp.log(at.sigma))
        dof = jnp.where(self._tails, at.dof, 1.0)
        norm = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * jnp.log(dof)
        for rows, counts in zip(weighted, counted, strict=True):
            squares = (rows / at.sigma) ** 2
            each = jnp.where(self._tails, norm - (dof + 1) / 2 * jnp.log1p(squares / dof), -0.5 * squares)
            total = total + jnp.sum(jnp.where(counts, each * self.shares, 0.0))
        return total

    def _of_noise(self, samples: np.ndarray) -> np.ndarray:
        """The covariance of log σ, and of the numbers that move ν, from Fisher's information of this many samples (S,).

        Per sample of Student's t it is 2ν/(ν+3) for log σ, [ψ′(ν/2) − ψ′((ν+1)/2)]/4 − (ν+5)/(2ν(ν+1)(ν+3)) for ν and
        −2/((ν+1)(ν+3)) between them. Source: Lange, Little & Taylor (1989), appendix B.
        """
        count, d = len(samples), np.where(self._tails, self.widths.dof, 1.0)
        information = np.diag(samples * np.where(self._tails, 2 * d / (d + 3), 2.0))
        if self.moves_dof:
            share = 1 / (1 + np.exp(-self.first[-count:]))
            rate = d * math.log(_MOST_DOF / _LEAST_DOF) * share * (1 - share)
            own = 0.25 * (polygamma(1, d / 2) - polygamma(1, (d + 1) / 2)) - (d + 5) / (2 * d * (d + 1) * (d + 3))
            both = np.diag(-2 * samples * rate / ((d + 1) * (d + 3)))
            information = np.block(
                [[information, both], [both, np.diag(samples * own * rate**2 + 2 * share * (1 - share))]]
            )
        return np.linalg.inv(information)

    def covariance(self) -> np.ndarray:
        """The covariance (D, D) of x in the approximation of least squares, about the fit.

        Raises `ValueError` where something is not seen: there is no density then without a prior.
        """
        question, point = self.question, self.point
        robust = np.array([(d + 1) / (d + 3) if np.isfinite(d) else 1.0 for d in self.widths.dof])
        weight = np.sqrt(self.shares * robust) / self.widths.sigma
        triangles = question.triangles(point, [np.sqrt(batch.weights) * weight for batch in question.batches])
        free, size = len(point.u), self.of_noise.start
        precision = np.zeros((len(self) + 1, len(self) + 1))
        for own, triangle in zip(self.of_starts, triangles, strict=True):
            own = [*own, *range(free)]
            precision[np.ix_(own, own)] += triangle[:, :-1].T @ triangle[:, :-1]
        precision = precision[:size, :size]
        scale = np.sqrt(np.diag(precision))
        if not (scale > 0).all():
            raise ValueError(
                f"Nothing that was measured depends on {self.names[int(np.argmin(scale))]}: fix it with `free`."
            )
        unit = precision / np.outer(scale, scale)
        if np.linalg.eigvalsh(unit).min() < 1e-13:
            raise ValueError(
                "The data do not determine some combination of parameters and starts: fix one parameter with `free`."
            )
        found = np.zeros((len(self), len(self)))
        found[size:, size:] = self._of_noise((question.weights > 0).sum(axis=0) * self.shares)
        found[:size, :size] = np.linalg.inv(unit) / np.outer(scale, scale)
        return found
