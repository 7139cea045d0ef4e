"""Benchmarks: what a digit of accuracy costs, in lagjax and in its peers, side by side.

    python -m benchmarks                                   # everything
    python -m benchmarks --only errors --cases double_pendulum chain_4 --batch 256
    taskset -c 0 python -m benchmarks                      # all programs on one core

A speed without its error is not a result, so the main comparison sweeps the tolerance of every program, measures the
error of each run against an independent reference, and compares times *at equal error*. The parts:

- `_cases`: the scenes, each with a batch of initial states and its Lagrangian in a form that every peer can read;
- `_contenders`: lagjax and its peers, each as `prepare(case) -> solve(tol) -> final states`;
- `_measure`: warm-up, interleaved repeats, medians, errors;
- `_comparisons`: questions other than error against time (right-hand side, derivation, latency, gradients, scaling);
- `_report`: tables, figures, and a JSON file that says on what machine and with which versions.
"""
