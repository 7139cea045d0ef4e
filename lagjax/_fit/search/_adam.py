"""Adam, for scenes with neural terms: gradients in reverse mode.

Gauss–Newton follows every free number along the motion; a network has hundreds. The gradient comes back over the steps
of one batch of motions at the cost of a few, however many numbers there are, and Adam goes down it, with a rate that
rises and then falls like a cosine. It is slower to the last digit than Gauss–Newton, and does not need it: weights of a
network have no last digit. All numbers move in units of their size, the noise of the signals among them.

Source: Kingma & Ba, *Adam* (2015); Loshchilov & Hutter, *SGDR* (2017), for the cosine.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit.model._density import Density
from lagjax._fit.model._noise import AbstractNoise, NoiseScale
from lagjax._fit.model._residuals import Point, Residuals, Trial
from lagjax._show import import_package

_RATE, _WARM = 1e-2, 0.05  # the largest step, in units of each number; the share of steps over which it rises
_PORTION = 100  # steps in one call: of them the best is kept
_STILL = 1.0  # what log L may gain over the last tenth of the steps where the descent is at its end


def descend_gradient(
    residuals: Residuals, point: Point, law: AbstractNoise, steps: int, notify: Callable[[str], None] | None = None
) -> tuple[Point, bool]:
    """The point after n `steps`, and whether log L is at rest. Raises `LostMotion` where the first trial fails."""
    optax = import_package('method="gradient"', "optax", "lagjax[neural]")
    whole = NoiseScale(residuals.size, np.full(len(residuals.size), np.inf))
    density = Density(residuals, law, Trial(*point, [], []), whole, np.ones(len(residuals.size)))
    first = density.first.copy()
    each = [np.asarray(r, float) for r in density.evaluate(density.unknowns(jnp.asarray(first, density.dtype)))]
    for (part, batch), r in zip(((p, batch) for p in residuals.parts for batch in p.batches), each, strict=True):
        if (bad := ~np.isfinite(r).all(axis=(1, 2))).any():
            raise part.lost(batch.rows[np.argmax(bad)], "Its motion could not be followed from the first trial.")
    flat = np.concatenate([r.reshape(-1, r.shape[-1]) for r in each])
    scatter = law.estimate(flat, residuals.weights, residuals.least, residuals.sides)
    first[density.noise_places] = np.log(scatter.sigma)
    scale = jnp.asarray(_units(density, first), density.dtype)
    cost = lambda z: -density.log_likelihood(first + scale * z) / residuals.measured  # noqa: E731
    rate = optax.warmup_cosine_decay_schedule(0.0, _RATE, int(_WARM * steps) + 1, steps)
    adam = optax.apply_if_finite(optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate)), steps)

    def step(carry, _):
        z, state, best = carry
        value, slope = jax.value_and_grad(cost)(z)
        best = jax.tree.map(lambda new, old: jnp.where(value < best[0], new, old), (value, z), best)
        change, state = adam.update(slope, state, z)
        return (optax.apply_updates(z, change), state, best), None

    go = jax.jit(lambda carry: jax.lax.scan(step, carry, None, length=_PORTION)[0])
    z = jnp.zeros(len(first), scale.dtype)
    carry, costs = (z, adam.init(z), (jnp.asarray(jnp.inf, scale.dtype), z)), []
    for k in range(max(1, -(-steps // _PORTION))):
        carry = go(carry)
        costs.append(float(carry[2][0]))
        if notify is not None:
            notify(f"step {(k + 1) * _PORTION}: log likelihood {-costs[-1] * residuals.measured:.6g}")
    if not np.isfinite(costs[-1]):
        raise residuals.parts[0].lost(0, "The gradient is not finite at any trial.")
    x = np.asarray(first + scale * carry[2][1], float)
    rest = costs[-max(1, len(costs) // 10) - 1] if len(costs) > 1 else np.inf
    starts = np.asarray(density.unknowns(jnp.asarray(x, scale.dtype)).starts, float)
    return Point(x[: len(point.u)], starts), bool((rest - costs[-1]) * residuals.measured < _STILL)


def _units(density: Density, x: np.ndarray) -> np.ndarray:
    """The units in which x moves: of parameters one, or as large as they are; of starts their size over all records."""
    residuals, free = density.residuals, len(density.residuals.parameters)
    scale = np.ones(len(x))
    scale[:free] = np.where(np.isinf(residuals.parameters.reach), np.maximum(1.0, np.abs(x[:free])), 1.0)
    for part in residuals.parts:
        fitted = part.frame.rows[part.fitted]
        if len(fitted):
            places = density.start_places[fitted, : part.states]
            size = np.sqrt(np.mean(x[places] ** 2, axis=0))
            scale[places] = np.where(size > 0, size, 1.0)
    return scale
