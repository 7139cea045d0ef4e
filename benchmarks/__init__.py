"""Benchmarks: what a digit of accuracy costs, in lagjax and in its peers, side by side.

    python -m benchmarks                                   # everything: hours
    python -m benchmarks --only errors --cases double_pendulum chain_4 --batch 256
    taskset -c 0 python -m benchmarks                      # all programs on one core

A speed without its error is not a result, so the main comparison sweeps the tolerance of every program, measures the
error of each run against an independent reference, and compares times *at equal error*. The parts:

- `_cases`: the scenes, each with a batch of initial states and its Lagrangian in a form that every peer can read;
  `_large`: machines and many bodies;
- `_contenders`: lagjax and its peers, each as `prepare(case) -> solve(tol) -> final states`; `_mujoco`, `_numba`,
  `_rebound`: three of them;
- `_measure`: warm-up, interleaved repeats, medians, errors;
- `_comparisons`: right-hand sides, sizes of batches, cores; `_sizes`: many coordinates, first results; `_latency`: one
  call; `_derivation`: the time to the first result beside peers; `_gradient`: derivatives; `_mixed`: batches whose
  members need different numbers of steps; `_constraints`: what they cost;
- `hard_cases` and `_hard/`: errors against references from elsewhere, a command of its own;
- `_report`: tables, and a JSON file that says on what machine and with which versions; `_figures`: a figure of each.
"""
