"""`sample`: draws from the posterior of a fit, by the No-U-Turn sampler in the fit's own metric.

`Fit.sample` says how π* proposes (`Surrogate`) and π decides, and what is drawn where π* is too far from π. Draws are
those of π itself, whatever π* is, because the inner steps are reversible for π*, of which nothing is changed after
warming: a poor expansion makes a slow chain, not a wrong one.

Which library: blackjax, whose kernels are plain functions of a log density; arviz for what draws are worth. numpyro
does the same behind a language for models, of which nothing is needed. The warming (`_tune_sampler`) is not
`blackjax.window_adaptation`, which has a step and a metric for every chain and does not say how many draws are worth an
independent one. Along expansions of 7 and 11 unknowns windows of 500 steps take half the time, with compilation, of the
rounds here, to as good a metric; along exact densities they were not measured.

Source: Hoffman & Gelman, *The No-U-Turn sampler*, JMLR 15 (2014) 1593; Christen & Fox, *MCMC using an approximation*,
J. Comput. Graph. Stat. 14 (2005) 795; Vehtari et al., Bayesian Analysis 16 (2021) 667, for dispersed chains, r-hat and
effective draws.
"""

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit.model._density import Density
from lagjax._fit.result._expansion import Chart, Surrogate, Unexpanded, expand_residuals
from lagjax._show import import_package

_ACCEPTED = 0.85  # the mean acceptance that steps are tuned for
_ROUNDS = (400, 800, 3200)  # draws of all chains from π*: each round has the metric of the one before
_ROUNDS_OF_MOTIONS = (200, 400, 800)  # of π, where each costs as many motions as draws do later
_FEWEST = 50  # of them of one chain: its step needs this many
_MOST_INNER = 64  # steps of the sampler along π* for one draw: a motion is waited for no longer than that
_LEAST = 0.2  # of draws of π* are accepted, or π* is given up: fewer, and a chain may stay where π* is too small

# π* is too narrow where weights π/π* have a Pareto tail of this shape: means of them do not settle then (Vehtari et
# al., J. Mach. Learn. Res. 25 (2024) 72). The shape means nothing where nearly all draws are accepted.
_HEAVY, _NEARLY_ALL = 0.7, 0.9
_WORTH = 0.1  # of the draws along π* must be independent, or π is followed: so do draws of the exact density everywhere
_DOUBLINGS = 6  # of one trajectory: 64 steps. In a metric that fits 3 do; a metric that does not would take thousands
_TRIED = 100  # draws for the start of a chain where the density is not zero
_FEWEST_TO_TELL = 4  # draws of a chain, halves of which are compared

# Quantiles at 2.5 % of 100 independent draws are known to 1.6 %: half as many, and an end of an interval may be the
# largest draw of all. Chains of 100 good draws have r-hat up to 1.03; ones that sit in different places, 1.1 and more.
_RELIABLE, _APART = 100, 1.05
_SETTLING = 10  # draws that are thrown away: chains begin at draws of π*, which the exact density has not judged


class Draws(NamedTuple):
    """`x` (C, K, D): K draws of C chains; of each draw log p, the steps of its trajectory, and if that diverged.

    `acceptance` is that of the exact density where draws came from an expansion; `sampler` says in words which it was.
    """

    x: np.ndarray
    log_density: np.ndarray
    steps: np.ndarray
    diverged: np.ndarray
    acceptance: np.ndarray
    sampler: str


def draw(density: Density, draws: int, chains: int, seed: int) -> Draws:
    """Draws of the posterior, from starts that are dispersed as the posterior is."""
    _blackjax()
    chart = Chart.from_density(density)
    try:
        return _sample_expansion(chart, draws, chains, seed)
    except Unexpanded as reason:
        return _sample_exact(chart, draws, chains, seed, str(reason))


def _sample_expansion(chart: Chart, draws: int, chains: int, seed: int) -> Draws:
    """Draws that the exact density accepts or refuses. Raises `Unexpanded` where the expansion is not good enough."""
    surrogate = expand_residuals(chart)
    warming, going = jax.random.split(jax.random.key(seed))
    sampler, state, many = _tune_sampler(surrogate, chart, _ROUNDS, chains, warming)
    if math.isinf(many):
        raise Unexpanded("Along the expansion of its residuals to second order the chains did not move.")
    sampler = sampler._replace(inner=min(max(math.ceil(many), 1), _MOST_INNER))
    exact = jax.jit(jax.vmap(chart.log_density))
    drawn, tail = _correct_draws(surrogate, sampler, exact, Chains.from_state(state, exact), draws, going)
    share, expansion = drawn.acceptance.mean(), "the expansion of its residuals to second order"
    if share < _LEAST:
        raise Unexpanded(f"Of draws of {expansion} the exact density accepts {share:.2f}.")
    if share < _NEARLY_ALL and tail > _HEAVY:
        raise Unexpanded(f"{expansion.capitalize()} is too narrow: π/π* has a Pareto tail of {tail:.2f}.")
    if (worth := agreement(drawn.x)[0].min()) < _WORTH * draws * chains:
        raise Unexpanded(f"Of {draws * chains} draws along {expansion} {worth:.0f} were independent.")
    return drawn


class Sampler(NamedTuple):
    """The sampler along a density: `move` (keys, state, step, metric) of C chains, compiled once for warming and
    drawing, its step and metric (D, D), and how many steps make a draw."""

    move: Callable
    step: float
    metric: Any
    inner: int

    def draw(self, key, state) -> tuple[Any, np.ndarray, np.ndarray]:
        """The state after the steps of one draw, how many steps of trajectories they took (C,), and which diverged."""
        steps, diverged = 0, np.zeros(len(state.position), bool)
        for k in range(self.inner):
            state, info = self.move(_keys(key, k, state), state, self.step, self.metric)
            steps, diverged = steps + np.asarray(info.num_integration_steps), diverged | np.asarray(info.is_divergent)
        return state, np.asarray(steps), diverged


def _keys(key, k: int, state):
    return jax.random.split(jax.random.fold_in(key, k), len(state.position))


def _tune_sampler(
    log_density: Callable, chart: Chart, rounds: tuple[int, ...], chains: int, key
) -> tuple[Sampler, Any, float]:
    """The sampler along the logarithm of a density with a step and a metric from its own draws, where its chains are,
    and how many draws of theirs are worth an independent one: infinitely many where a chain does not move."""
    blackjax = _blackjax()
    kernel = blackjax.nuts.build_kernel()
    size, dtype = len(chart.centre), chart.density.dtype

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0, None, None))
    def move(key, state, step, metric):
        return kernel(key, state, log_density, step, metric, _DOUBLINGS)

    start, update, _ = blackjax.adaptation.step_size.dual_averaging_adaptation(_ACCEPTED)
    update = jax.jit(update)
    z, metric, step = _draw_possible_states(log_density, (chains, size), dtype, key), jnp.eye(size, dtype=dtype), 0.25
    state = jax.jit(jax.vmap(lambda z: blackjax.nuts.init(z, log_density)))(z)
    late = np.zeros((chains, 0, size))
    for part, pooled in enumerate(rounds):
        if part > 0:
            metric = jnp.asarray(_shrink_covariance(late.reshape(-1, size)), dtype)
        count, own = max(_FEWEST, math.ceil(pooled / chains)), jax.random.fold_in(key, part)
        path, tuning = [], start(step)
        for k in range(count):
            state, info = move(_keys(own, k, state), state, jnp.exp(tuning.log_step_size), metric)
            tuning = update(tuning, info.acceptance_rate.mean())
            path.append(np.asarray(state.position, float))
        late, step = np.stack(path[count // 2 :], axis=1), float(jnp.exp(tuning.log_step_size_avg))
    sampler = Sampler(move, step, metric, 1)
    if not (np.ptp(late, axis=1) > 0).all():  # there is no effective number of draws then
        return sampler, state, math.inf
    effective = float(np.asarray(blackjax.ess(late, chain_axis=0, sample_axis=1)).min())
    return sampler, state, late.shape[0] * late.shape[1] / max(effective, 1.0)


def _draw_possible_states(log_density: Callable, shape: tuple[int, int], dtype, key):
    """Draws (C, D) of the fit's normal density where `log_density` is finite: elsewhere a chain does not move."""
    density, z = jax.jit(jax.vmap(log_density)), jax.random.normal(key, shape, dtype)
    for k in range(_TRIED):
        outside = ~jnp.isfinite(density(z))
        if not outside.any():
            return z
        z = jnp.where(outside[:, None], jax.random.normal(jax.random.fold_in(key, _TRIED + k), shape, dtype), z)
    raise ValueError(
        f"The posterior density was zero at each of {_TRIED} draws about the fit: the prior is zero where the records "
        "put the parameters. Give a prior that is not, or fit again from params0 within it."
    )


def _shrink_covariance(rows: np.ndarray) -> np.ndarray:
    """The covariance of draws (M, D), drawn towards that of the fit as if D + 5 draws had shown it."""
    count, size = rows.shape
    return (count * np.cov(rows.T).reshape(size, size) + (5 + size) * np.eye(size)) / (count + 5 + size)


class Chains(NamedTuple):
    """The positions of C chains: the sampler's state along π*, log π (C,) and log π − log π* (C,)."""

    state: Any
    exact: np.ndarray
    ratio: np.ndarray

    @staticmethod
    def from_state(state, exact: Callable) -> "Chains":
        log_exact, log_expansion = np.asarray(exact(state.position), float), np.asarray(state.logdensity, float)
        with np.errstate(invalid="ignore"):
            ratio = np.where(np.isfinite(log_exact), log_exact - log_expansion, -np.inf)
        return Chains(state, log_exact, ratio)


def _correct_draws(
    surrogate: Surrogate, sampler: Sampler, exact: Callable, at: Chains, draws: int, key
) -> tuple[Draws, float]:
    """Draws of π, every proposal of π* accepted or refused by the exact density; and the Pareto tail of π/π*."""
    kept, choices, ratios = [], np.random.default_rng(np.asarray(jax.random.key_data(key))), []
    for k in range(_SETTLING + draws):
        state, steps, diverged = sampler.draw(jax.random.fold_in(key, k), at.state)
        proposed = Chains.from_state(state, exact)
        ratios.append(proposed.ratio)
        with np.errstate(invalid="ignore"):
            change = proposed.ratio - at.ratio  # −∞ where the motion cannot be followed, +∞ where that of x cannot
        accepted = np.where(np.isfinite(proposed.exact), np.exp(np.minimum(0.0, change)), 0.0)
        goes = choices.uniform(size=len(accepted)) < accepted
        at = jax.tree.map(lambda new, old: np.where(goes.reshape(-1, *[1] * (new.ndim - 1)), new, old), proposed, at)  # noqa: B023
        kept.append((at.state.position, at.exact, steps, diverged, accepted))
    z, log_density, steps, diverged, accepted = (np.stack(part[_SETTLING:], axis=1) for part in zip(*kept, strict=True))
    words = (
        f"{sampler.inner} steps of the No-U-Turn sampler along the second-order expansion of the residuals for every "
        f"draw, which the exact density then accepts or refuses; it accepts {accepted.mean():.2f}."
    )
    ratios = np.concatenate(ratios)
    _, tail = _arviz().psislw(ratios[np.isfinite(ratios)])
    return Draws(*_unknowns(surrogate.chart, z, log_density), steps, diverged, accepted, words), float(tail)


def _sample_exact(chart: Chart, draws: int, chains: int, seed: int, why: str) -> Draws:
    """Draws by gradients through the motions; `why` says what speaks against the expansion."""
    warming, going = jax.random.split(jax.random.key(seed))
    sampler, state, _ = _tune_sampler(chart.log_density, chart, _ROUNDS_OF_MOTIONS, chains, warming)
    kept = []
    for k in range(draws):
        state, info = sampler.move(_keys(going, k, state), state, sampler.step, sampler.metric)
        kept.append((state.position, state.logdensity, info.num_integration_steps, info.is_divergent,
                     info.acceptance_rate))  # fmt: skip
    z, log_density, steps, diverged, accepted = (np.stack(part, axis=1) for part in zip(*kept, strict=True))
    words = f"The No-U-Turn sampler along the exact density, with gradients through the motions. {why}"
    return Draws(*_unknowns(chart, z, log_density), steps, diverged, accepted, words)


def _unknowns(chart: Chart, z: np.ndarray, log_density: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unknowns x (C, K, D) at coordinates z (C, K, D), and log p of x where that of z is given (C, K)."""
    x, _, volume = jax.jit(jax.vmap(jax.vmap(chart)))(jnp.asarray(z, chart.density.dtype))
    return np.asarray(x), log_density - np.asarray(volume)


def agreement(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The effective number of draws (C, K, D) of each unknown, for the bulk or the tails; r-hat, that chains disagree.
    NaN where draws are too few to tell, r-hat also for a single chain."""
    arviz = _arviz()
    if x.shape[1] < _FEWEST_TO_TELL:
        return np.full(x.shape[2], np.nan), np.full(x.shape[2], np.nan)
    ranked = arviz.convert_to_dataset(x)
    bulk, tail = (np.asarray(arviz.ess(ranked, method=method).x) for method in ("bulk", "tail"))
    return np.minimum(bulk, tail), np.asarray(arviz.rhat(ranked).x) if len(x) > 1 else np.full(x.shape[2], np.nan)


def _check_agreement(density: Density, drawn: Draws) -> dict[str, float]:
    """The worst of the agreement of chains, by name; a warning where that is too little to read quantiles off draws."""
    each, r_hat = agreement(drawn.x)
    effective, apart, count = float(np.min(each)), float(np.max(r_hat)), drawn.x.shape[0] * drawn.x.shape[1]
    if not effective >= _RELIABLE or apart > _APART:
        at = density.names[int(np.argmin(each) if not effective >= _RELIABLE else np.argmax(r_hat))]
        warnings.warn(
            f"The {count} draws of {at} are worth {effective:.0f} independent ones, and r-hat is {apart:.2f}: do not "
            f"read intervals off them. {_RELIABLE} and r-hat below {_APART} are the least; ask for more draws.",
            stacklevel=4,
        )
    return {"effective_draws": effective, "r_hat": apart}


def inference_data(density: Density, drawn: Draws) -> Any:
    """Draws as arviz knows them: the parameters, `q0` and `qdot0` of the records, `sigma` and `dof` of the signals."""
    arviz = _arviz()
    residuals, parameters = density.residuals, density.residuals.parameters
    chains, draws, size = drawn.x.shape

    def unknowns(x):
        at = density.unknowns(x)
        return parameters.numbers(at.u, jnp), at.starts, at.sigma, jnp.broadcast_to(at.dof, at.sigma.shape)

    at = jax.jit(jax.vmap(unknowns))(jnp.asarray(drawn.x.reshape(-1, size)))
    values, starts, sigma, dof = (np.asarray(x).reshape(chains, draws, *x.shape[1:]) for x in at)
    posterior, dims, coords = {}, {}, {}
    for part in parameters.parts:
        if len(part.places) == math.prod(part.shape):
            posterior[part.label] = values[..., part.places].reshape(chains, draws, *part.shape)
            dims[part.label] = [f"{part.label} {axis}" for axis in range(len(part.shape))]
        else:  # numbers of the array that are kept have no draws: the others go by their own names
            names = dict(zip(parameters.places.tolist(), parameters.names, strict=True))
            posterior |= {names[place]: values[..., place] for place in part.places.tolist()}
    for part in residuals.parts:
        fitted, layout = part.fitted, part.layout
        of = "" if part.name is None else f"{part.name}: "
        if fitted.any():
            own, axes = starts[..., part.frame.rows[fitted], : part.states], [f"{of}record", f"{of}coordinate"]
            coords |= dict(zip(axes, (np.flatnonzero(fitted), list(layout.names)), strict=True))
            posterior |= {f"{of}q0": own[..., : layout.size], f"{of}qdot0": own[..., layout.size :]}
            dims |= {f"{of}q0": axes, f"{of}qdot0": axes}
    coords["signal"] = list(residuals.names)
    posterior["sigma"], dims["sigma"] = sigma, ["signal"]
    if np.isfinite(density.noise.dof).any():
        posterior["dof"], dims["dof"] = dof, ["signal"]
    stats = dict(lp=drawn.log_density, n_steps=drawn.steps, diverging=drawn.diverged, acceptance_rate=drawn.acceptance)
    attributes = {"sampler": drawn.sampler, **_check_agreement(density, drawn)}
    return arviz.from_dict(posterior=posterior, sample_stats=stats, dims=dims, coords=coords, attrs=attributes)


def _blackjax() -> Any:
    return import_package("Fit.sample", "blackjax", "lagjax[sample]", "adaptation.step_size")


def _arviz() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # arviz tells of its own next version
        return import_package("Fit.sample", "arviz", "lagjax[sample]")
