"""`sample`: draws from the posterior of a fit, by the No-U-Turn sampler in the fit's own metric.

The covariance of the fit, C = L Lᵀ, turns its posterior into one that is nearly round: x = x̂ + L z. In z the sampler
needs no warm-up for a metric, only for its step, and trajectories are short. All chains go side by side in one batch of
motions.

Which library: blackjax, whose kernels are plain functions of a log density, so that chains, the loop and what is kept
are a few lines here. numpyro does the same behind a language for models, of which nothing is needed.

Source: Hoffman & Gelman, *The No-U-Turn sampler*, JMLR 15 (2014) 1593; Vehtari et al., Bayesian Analysis 16 (2021) 667,
for dispersed chains and what arviz tells of them.
"""

import functools
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit._density import Density

_WARM, _ACCEPTED = 200, 0.85  # draws for the step of every chain; the mean acceptance it is tuned for


class Draws(NamedTuple):
    """`x` (C, K, D): K draws of C chains; of each draw log p, the steps of its trajectory, and if that diverged."""

    x: np.ndarray
    log_density: np.ndarray
    steps: np.ndarray
    diverged: np.ndarray
    acceptance: np.ndarray


def draw(density: Density, draws: int, chains: int, seed: int) -> Draws:
    """Draws of the posterior, from starts that are dispersed as the posterior is."""
    blackjax = _blackjax()
    root = jnp.asarray(np.linalg.cholesky(density.covariance()), density.question.layout.dtype)
    centre = jnp.asarray(density.first, root.dtype)
    of_z = lambda z: density(centre + root @ z)  # noqa: E731
    kernel = blackjax.nuts.build_kernel()
    start, update, _ = blackjax.adaptation.step_size.dual_averaging_adaptation(_ACCEPTED)
    metric = jnp.ones(len(centre), root.dtype)
    moved = functools.partial(kernel, logdensity_fn=of_z, inverse_mass_matrix=metric)

    def go(carry, key_and_place):  # one loop for warming and drawing: the trajectory is compiled once
        state, tuning = carry
        key, warms = key_and_place
        step = jnp.exp(jnp.where(warms, tuning.log_step_size, tuning.log_step_size_avg))
        state, info = moved(key, state, step_size=step)
        tuned = update(tuning, info.acceptance_rate)
        tuning = jax.tree.map(lambda new, old: jnp.where(warms, new, old), tuned, tuning)
        kept = state.position, state.logdensity, info.num_integration_steps, info.is_divergent, info.acceptance_rate
        return (state, tuning), kept

    def chain(key):
        first, going = jax.random.split(key)
        state = blackjax.nuts.init(jax.random.normal(first, centre.shape, root.dtype), of_z)
        keys = jax.random.split(going, _WARM + draws)
        _, kept = jax.lax.scan(go, (state, start(0.5)), (keys, jnp.arange(_WARM + draws) < _WARM))
        return jax.tree.map(lambda leaf: leaf[_WARM:], kept)

    z, *rest = jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(seed), chains))
    return Draws(np.asarray(centre + z @ root.T), *(np.asarray(leaf) for leaf in rest))


def inference_data(density: Density, drawn: Draws) -> Any:
    """Draws as arviz knows them: the parameters, `q0` and `qdot0` of the records, `sigma` and `dof` of the signals."""
    arviz = _arviz()
    question, parameters = density.question, density.question.parameters
    chains, draws, size = drawn.x.shape
    at = jax.jit(jax.vmap(lambda x: _told(density, x)))(jnp.asarray(drawn.x.reshape(-1, size)))
    values, starts, sigma, dof = (np.asarray(x).reshape(chains, draws, *x.shape[1:]) for x in at)
    posterior, begin, dims, coords = {}, 0, {}, {}
    for part in parameters.parts:
        count, shape = len(part.places), part.shape
        posterior[part.label] = values[..., begin : begin + count].reshape(chains, draws, *shape)
        dims[part.label] = [f"{part.label} {axis}" for axis in range(len(shape))]
        begin += count
    if question.fitted.any():
        n = question.layout.size
        coords |= {"record": np.flatnonzero(question.fitted), "coordinate": list(question.layout.names)}
        posterior |= {"q0": starts[..., question.fitted, :n], "qdot0": starts[..., question.fitted, n:]}
        dims |= {"q0": ["record", "coordinate"], "qdot0": ["record", "coordinate"]}
    coords["signal"] = list(question.names)
    posterior["sigma"], dims["sigma"] = sigma, ["signal"]
    if np.isfinite(density.widths.dof).any():
        posterior["dof"], dims["dof"] = dof, ["signal"]
    stats = {
        "lp": drawn.log_density, "n_steps": drawn.steps, "diverging": drawn.diverged,
        "acceptance_rate": drawn.acceptance,
    }  # fmt: skip
    return arviz.from_dict(posterior=posterior, sample_stats=stats, dims=dims, coords=coords)


def _told(density: Density, x):
    at = density.unknowns(x)
    numbers = density.question.parameters.numbers(at.u, jnp)
    return numbers[density.question.parameters.places], at.starts, at.sigma, jnp.broadcast_to(at.dof, at.sigma.shape)


def _blackjax() -> Any:
    try:
        import blackjax
        import blackjax.adaptation.step_size
    except ImportError:
        raise ImportError("Fit.sample needs the packages blackjax and arviz: pip install lagjax[sample].") from None
    return blackjax


def _arviz() -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # arviz tells of its own next version
            import arviz
    except ImportError:
        raise ImportError("Fit.sample needs the packages blackjax and arviz: pip install lagjax[sample].") from None
    return arviz
