"""How many effective samples an hour: the posterior of 447 transit times of TRAPPIST-1, 37 unknowns.

`Fit.sample` walks along the second-order expansion of the residuals, and one motion accepts or refuses each draw. What
is counted is the time of all processors for everything after the fit: the expansion, warming, and the draws. The least
effective number among all unknowns counts (rank-normalised, bulk and tail).

Two priors: flat in masses, periods, times and (e cos ω, e sin ω); and flat in e in place of the last, 1/e, which is
what the published run had. Masses stand beside those of that run: Agol, Dorn, Grimm et al., Planet. Sci. J. 2 (2021) 1,
table of mass ratios, mean and standard deviation.

    python -m benchmarks.trappist1_posterior trappist1_transit_times.csv trappist1_elements_agol2021.csv

The record goes to `benchmarks/results/trappist1_posterior.json`, with commit, versions and machine.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import arviz
import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))
import trappist1  # pyright: ignore[reportMissingImports]

ENOUGH = 6400  # effective samples of the published run, which took 112 cores nine days
UNIT = 3.0034896e-6 / 0.09  # an Earth over 0.09 suns, the published unit
PUBLISHED = UNIT * np.array(
    [(1.3771, 0.0593), (1.3105, 0.0453), (0.3885, 0.0074), (0.6932, 0.0128), (1.0411, 0.0155), (1.3238, 0.0171),
     (0.3261, 0.0186)]
)  # fmt: skip
PRIORS = {
    "flat in e cos ω, e sin ω": None,
    "flat in e and ω": lambda params: -jnp.sum(jnp.log(jnp.hypot(params["ecosw"], params["esinw"]))),
}


def longest_stay(x) -> int:
    """The largest number of draws (C, K) that a chain stays in one place."""
    longest = 1
    for chain in x:
        changes = np.flatnonzero(np.append(np.diff(chain) != 0, True))
        longest = max(longest, int(np.diff(changes, prepend=-1).max()))
    return longest


def posterior(fit, name: str, draws: int, chains: int, seed: int) -> dict:
    """One run: what it cost, and what a long one would."""
    began = time.process_time(), time.perf_counter()
    drawn = fit.sample(draws, seed=seed, chains=chains, prior=PRIORS[name])
    spent = time.process_time() - began[0], time.perf_counter() - began[1]
    fields: list[Any] = [arviz.ess(drawn, method=method) for method in ("bulk", "tail")]
    effective = np.array([np.concatenate([np.ravel(x) for x in each.data_vars.values()]) for each in fields])
    spread: Any = arviz.rhat(drawn)
    agreement = max(float(x.max()) for x in spread.data_vars.values())
    hour = effective.min() / spent[0] * 7200
    masses = drawn.posterior["params['mass']"].values.reshape(-1, len(trappist1.PLANETS))
    row = {
        "prior": name, "chains": chains, "draws of each": draws, "processor s": spent[0], "wall s": spent[1],
        "effective least": float(effective.min()), "effective median": float(np.median(effective)),
        "effective per hour of two processors": hour, f"hours for {ENOUGH}": ENOUGH / hour, "largest R-hat": agreement,
        "accepted": float(drawn.sample_stats.acceptance_rate.mean()),
        "longest stay": longest_stay(drawn.sample_stats.lp.values), "sampler": drawn.attrs["sampler"],
        "mass": {
            planet: {"median": float(np.median(m)), "mean": float(m.mean()), "deviation": float(m.std()),
                     "quantiles 16 84": np.quantile(m, [0.1587, 0.8413]).tolist()}
            for planet, m in zip(trappist1.PLANETS, masses.T, strict=True)
        },
    }  # fmt: skip
    return row


def tell(row: dict) -> None:
    """One run in words and a table."""
    print(f"\nprior {row['prior']}: {row['draws of each']} draws of {row['chains']} chains in "
          f"{row['processor s']:.0f} s of processors, {row['wall s']:.0f} s\n{row['sampler']}")  # fmt: skip
    hours = row[f"hours for {ENOUGH}"]
    print(f"effective {row['effective least']:.0f} (least), {row['effective median']:.0f} (median); R-hat up to "
          f"{row['largest R-hat']:.3f}, longest stay {row['longest stay']} draws\n"
          f"{row['effective per hour of two processors']:.0f} an hour of two processors: "
          f"{hours:.2f} h for {ENOUGH}")  # fmt: skip
    print("planet     median  published  (median − published)/σ  (mean − published)/σ  width/σ")
    for (planet, m), (value, sigma) in zip(row["mass"].items(), PUBLISHED, strict=True):
        low, high = m["quantiles 16 84"]
        print(f"{planet:<6} {m['median']:>10.3e} {value:>10.3e} {(m['median'] - value) / sigma:>23.2f} "
              f"{(m['mean'] - value) / sigma:>21.2f} {0.5 * (high - low) / sigma:>8.2f}")  # fmt: skip


def main():
    """Both priors, and the record."""
    parser = argparse.ArgumentParser(description="Effective samples an hour.")
    parser.add_argument("times")
    parser.add_argument("elements")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--chains", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--prior", choices=list(PRIORS), help="that one only")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results", help="folder for the record")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    record: dict = {"circumstances": _report.circumstances()}
    elements = trappist1.published(options.elements)
    timings = trappist1.observations(options.times, elements)
    transforms = {**dict.fromkeys(elements), "mass": lagjax.positive}
    fit = lagjax.fit(trappist1.SCENE, timings, elements, transforms=transforms, noise=lagjax.StudentT())
    record["runs"] = []
    for name in [options.prior] if options.prior else PRIORS:
        record["runs"].append(posterior(fit, name, options.draws, options.chains, options.seed))
        _report.write_json(options.output / "trappist1_posterior.json", record)  # a long run may be interrupted
        tell(record["runs"][-1])


if __name__ == "__main__":
    main()
