"""How many effective samples an hour: NUTS on the posterior of 447 transit times of TRAPPIST-1, 37 unknowns.

The metric is the covariance of the best fit, and the step is fixed: what is counted is what a long run goes on with.
Masses are printed beside those of a published fit, their widths beside those of least squares.

python benchmarks/trappist1_posterior.py trappist1_transit_times.csv trappist1_elements_agol2021.csv --draws 40
"""

import argparse
import sys
import time
from pathlib import Path

import blackjax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))
import trappist1  # pyright: ignore[reportMissingImports]

ENOUGH = 6400  # effective samples of the published run, which took 112 cores nine days


def draws_of(density, chains, count, warm, step, seed):
    """Draws (K, C, D) of chains side by side, after `warm` that are thrown away; yields them with the steps taken."""
    root, centre = jnp.linalg.cholesky(jnp.asarray(density.covariance())), jnp.asarray(density.first)
    of_z = lambda z: density(centre + root @ z)  # noqa: E731
    kernel = blackjax.nuts.build_kernel()
    moved = lambda key, state: kernel(  # noqa: E731
        key, state, logdensity_fn=of_z, step_size=step, inverse_mass_matrix=jnp.ones(len(centre))
    )
    moved, first = jax.jit(jax.vmap(moved)), jax.jit(jax.vmap(lambda z: blackjax.nuts.init(z, of_z)))
    key = jax.random.key(seed)
    state = first(0.7 * jax.random.normal(key, (chains, len(centre))))
    for k in range(warm + count):
        state, info = moved(jax.random.split(jax.random.fold_in(key, k), chains), state)
        if k >= warm:
            yield np.asarray(centre + state.position @ root.T), info


def main():
    """A short run, and what it says about a long one."""
    parser = argparse.ArgumentParser(description="Effective samples an hour.")
    parser.add_argument("times")
    parser.add_argument("elements")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--warm", type=int, default=5)
    parser.add_argument("--chains", type=int, default=16)
    parser.add_argument("--step", type=float, default=0.4)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    elements = trappist1.published(options.elements)
    timings = trappist1.observations(options.times, elements)
    transforms = {**dict.fromkeys(elements), "mass": lagjax.positive}
    fit = lagjax.fit(trappist1.SCENE, timings, elements, transforms=transforms, noise=lagjax.StudentT())
    density = fit.log_density()
    found, steps, accepted, began = [], [], [], (time.process_time(), time.perf_counter())
    for x, info in draws_of(density, options.chains, options.draws, options.warm, options.step, 0):
        found.append(x)
        steps.append(np.asarray(info.num_integration_steps))
        accepted.append(float(info.acceptance_rate.mean()))
        if len(found) in (1, 2, 5) or len(found) % 10 == 0:
            tell(fit, density, elements, np.stack(found), np.array(steps), accepted, began)


def tell(fit, density, elements, x, steps, accepted, began):
    """A table of the masses, and the hours for `ENOUGH` effective samples."""
    spent = time.process_time() - began[0], time.perf_counter() - began[1]
    print(f"\n{len(x)} draws of {x.shape[1]} chains, {steps.mean():.1f} steps each, acceptance {np.mean(accepted):.2f}")
    print(f"{spent[0]:.0f} s of processors, {spent[1]:.0f} s")
    if len(x) < 10:
        return
    effective = np.array([float(blackjax.ess(x[..., k], chain_axis=1, sample_axis=0)) for k in range(x.shape[-1])])
    hour = effective.min() / spent[0] * 7200
    print(f"effective samples {effective.min():.0f} … {np.median(effective):.0f} (least, median) of {x[..., 0].size}; "
          f"{hour:.0f} an hour of two processors: {ENOUGH / hour:.1f} h for {ENOUGH}")  # fmt: skip
    masses = jax.vmap(lambda one: density.params(one[: len(fit.u)])["mass"])(x.reshape(-1, x.shape[-1]))
    deviation = np.sqrt(np.diag(fit.covariance.matrix))
    places = [k for k, name in enumerate(fit.covariance.names) if "mass" in name]
    print("planet    median  published  (median − published)/width   width/width of least squares")
    for k, place in enumerate(places):
        low, middle, high = np.quantile(np.asarray(masses)[:, k], [0.1587, 0.5, 0.8413])
        width, was = 0.5 * (high - low), elements["mass"][k]
        off, ratio = (middle - was) / width, width / deviation[place]
        print(f"{trappist1.PLANETS[k]:<6} {middle:>9.3e}  {was:>9.3e} {off:>20.2f} {ratio:>25.2f}")


if __name__ == "__main__":
    main()
