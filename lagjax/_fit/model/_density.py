"""The posterior density of a fit's unknowns, a function of one vector for JAX.

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

from lagjax._fit.model._noise import LEAST_DOF, MOST_DOF, AbstractNoise, NoiseScale, StudentT
from lagjax._fit.model._residuals import Residuals, Trial
from lagjax._primitives import accepts_singles


class PosteriorUnknowns(NamedTuple):
    """The parts of a vector x of all unknowns: u (F,), the starts (N, 2n), and the noise σ (S,), ν (S,)."""

    u: Any
    starts: Any
    sigma: Any
    dof: Any


class Density:
    """log p(x), called with x (D,), for records whose residuals are those of `residuals` at `point`.

    - `first` (D,): the fit; `names` (D,): what the numbers are called.
    - `start_places` (N, 2n): the places in x of the starts; D for one that is known, or that a system does not have.
    - `noise_places`: the places in x of log σ.
    - `shares` (S,): how many independent samples one sample of each signal is worth.
    """

    def __init__(
        self, residuals: Residuals, law: AbstractNoise, point: Trial, noise: NoiseScale, shares: np.ndarray,
        prior: Callable | None = None,
    ):  # fmt: skip
        self.residuals, self.shares, self.prior, self.point, self.noise = residuals, shares, prior, point, noise
        for part in residuals.parts:
            if part.manifold and part.fits_on_constraints and (part.manifold.constrained or any(map(any, part.modes))):
                raise ValueError(
                    "There is no density for fitted starts on constraints, or on closed contacts: give "
                    "start=(q0, qdot0)."
                )
            if part.signals.delays is not None:
                raise ValueError("There is no density for lagjax.Delayed sensors: keep the delay, and shift the times.")
        self.dtype = np.result_type(*(part.layout.dtype for part in residuals.parts))
        self._tails = np.isfinite(noise.dof)
        self.moves_dof = isinstance(law, StudentT) and law.dof is None
        share = np.log(np.clip(noise.dof, 1.01 * LEAST_DOF, 0.99 * MOST_DOF) / LEAST_DOF)
        share = share / math.log(MOST_DOF / LEAST_DOF)
        dof = np.log(share / (1 - share)) if self.moves_dof else np.zeros(0)
        moves = np.zeros((len(residuals.pieces), residuals.states), bool)
        for part in residuals.parts:
            moves[part.frame.rows, : part.states] = residuals.own_starts[part.frame.rows, None]
        free, starts = len(point.u), point.starts[moves]
        self.first = np.concatenate([point.u, starts, np.log(noise.sigma), dof])
        self.start_places = np.full(moves.shape, len(self.first))
        self.start_places[moves] = np.arange(free, free + len(starts))
        self.start_places = self.start_places[residuals.leads]
        self.noise_places = slice(free + len(starts), free + len(starts) + len(noise.sigma))
        of_noise = [f"log σ of {name}" for name in residuals.names]
        of_noise += [f"ν of {name}" for name in residuals.names] * self.moves_dof
        self.names = (*residuals.parameters.labels, *self._start_names(), *of_noise)

    def _start_names(self) -> list[str]:
        residuals = self.residuals
        layouts = {row: part.layout for part in residuals.parts for row in part.frame.rows.tolist()}
        return [
            f"starts{residuals.label(residuals.pieces[row].record).removeprefix('records')}.{half}{name[1:]}"
            for row in np.flatnonzero(residuals.own_starts).tolist()
            for half in ("q", "qdot")
            for name in layouts[row].names
        ]

    def __len__(self) -> int:
        return len(self.first)

    def unknowns(self, x) -> PosteriorUnknowns:
        """The parts of a vector x (D,)."""
        u, starts = x[: len(self.residuals.parameters)], jnp.asarray(self.point.starts, x.dtype)
        starts = jnp.where(self.start_places < len(self), jnp.append(x, 0.0)[self.start_places], starts)
        starts = self.residuals.trace_starts(starts, u)
        dof = jnp.asarray(self.noise.dof, x.dtype)
        if self.moves_dof:
            share = jax.nn.sigmoid(x[self.noise_places.stop :])
            dof = LEAST_DOF * jnp.exp(math.log(MOST_DOF / LEAST_DOF) * share)
        return PosteriorUnknowns(u, starts, jnp.exp(x[self.noise_places]), dof)

    def params(self, x):
        """The user's pytree of parameters at x (D,), of which the first F numbers move them."""
        parameters = self.residuals.parameters
        return parameters.restore_records(parameters.numbers(x[: len(parameters)], jnp))

    @accepts_singles(("x",))
    def __call__(self, x):
        """log p(x), up to a constant; −∞ where a motion could not be followed."""
        at = self.unknowns(jnp.asarray(x, self.dtype))
        total = self.log_likelihood(x) + self.residuals.parameters.log_volume(at.u, jnp)
        if self.prior is not None:
            total = total + self.prior(self.params(at.u))
        if self.moves_dof:
            moved = x[-len(self.noise.sigma) :]
            total = total + jnp.sum(jax.nn.log_sigmoid(moved) + jax.nn.log_sigmoid(-moved))
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def log_likelihood(self, x):
        """Σ_s shares_s log L_s, up to a constant; NaN where a motion could not be followed."""
        at = self.unknowns(jnp.asarray(x, self.dtype))
        exact = (self.residuals.weights > 0) & (True if self.residuals.sides is None else self.residuals.sides == 0)
        total = -jnp.sum(self.shares * exact.sum(axis=0) * jnp.log(at.sigma))
        dof = jnp.where(self._tails, at.dof, 1.0)
        norm = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * jnp.log(dof)
        for batch, left in zip(self.residuals.batches, self.evaluate(at), strict=True):
            rows, side = np.sqrt(batch.weights) * left, batch.sides
            squares = (rows / at.sigma) ** 2
            each = jnp.where(self._tails, norm - (dof + 1) / 2 * jnp.log1p(squares / dof), -0.5 * squares)
            if side is not None:
                at_limit = jax.scipy.special.log_ndtr(jnp.where(side != 0, side * rows / at.sigma, 0.0))
                each = jnp.where(side != 0, at_limit, each)
            total = total + jnp.sum(jnp.where(batch.weights > 0, each * self.shares, 0.0))
        return total

    def evaluate(self, at: PosteriorUnknowns) -> list:
        """The outputs of the sensors less the measurements, (N, T, S), of every batch."""
        return self.residuals.trace(at.u, at.starts)

    def _noise_covariance(self, samples: np.ndarray) -> np.ndarray:
        """The covariance of log σ, and of the numbers that move ν, from Fisher's information of this many samples (S,).

        Per sample of Student's t it is 2ν/(ν+3) for log σ, [ψ′(ν/2) − ψ′((ν+1)/2)]/4 − (ν+5)/(2ν(ν+1)(ν+3)) for ν and
        −2/((ν+1)(ν+3)) between them. Source: Lange, Little & Taylor (1989), appendix B.
        """
        count, d = len(samples), np.where(self._tails, self.noise.dof, 1.0)
        information = np.diag(samples * np.where(self._tails, 2 * d / (d + 3), 2.0))
        if self.moves_dof:
            share = 1 / (1 + np.exp(-self.first[-count:]))
            rate = d * math.log(MOST_DOF / LEAST_DOF) * share * (1 - share)
            own = 0.25 * (polygamma(1, d / 2) - polygamma(1, (d + 1) / 2)) - (d + 5) / (2 * d * (d + 1) * (d + 3))
            both = np.diag(-2 * samples * rate / ((d + 1) * (d + 3)))
            own = np.diag(samples * own * rate**2 + 2 * share * (1 - share))
            information = np.block([[information, both], [both, own]])
        return np.linalg.inv(information)

    def covariance(self) -> np.ndarray:
        """The covariance (D, D) of x in the approximation of least squares, about the fit.

        Raises `ValueError` where something is not seen: there is no density then without a prior.
        """
        residuals, point = self.residuals, self.point
        robust = np.array([(d + 1) / (d + 3) if np.isfinite(d) else 1.0 for d in self.noise.dof])
        factors = [f * np.sqrt(self.shares * robust) for f in residuals.fisher_factors(point, self.noise)]
        triangles = residuals.triangles(point, factors)
        free, size, columns = len(point.u), self.noise_places.start, residuals.unknowns.columns
        precision, columns = np.zeros((len(self) + 1, len(self) + 1)), np.where(columns < free, columns, len(self))
        for own, triangle in zip(np.concatenate([self.start_places, columns], axis=1), triangles, strict=True):
            precision[np.ix_(own, own)] += triangle[:, :-1].T @ triangle[:, :-1]
        precision = precision[:size, :size]
        scale = np.sqrt(np.diag(precision))
        if not (scale > 0).all():
            raise ValueError(
                f"Nothing that was measured depends on {self.names[np.argmin(scale)]}: fix it with `free`."
            )
        unit = precision / np.outer(scale, scale)
        if np.linalg.eigvalsh(unit).min() < 1e-13:
            raise ValueError("The data do not determine all parameters and starts: fix one parameter with `free`.")
        found = np.zeros((len(self), len(self)))
        found[size:, size:] = self._noise_covariance((residuals.weights > 0).sum(axis=0) * self.shares)
        found[:size, :size] = np.linalg.inv(unit) / np.outer(scale, scale)
        return found
