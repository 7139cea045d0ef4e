"""Sweeps over alike cases: a few, of every kind, by default; all of them with the marker `slow`."""

import pytest

from lagjax import scenes

# One scene of every kind: the rest of `scenes.ALL` takes minutes to compile.
KINDS = (
    scenes.uniform_gravity, scenes.central_force, scenes.double_pendulum, scenes.damped_driven_oscillator,
    scenes.cartesian_pendulum, scenes.chaplygin_sleigh, scenes.charge_in_fields, scenes.kepler,
)  # fmt: skip


def sweep(cases, kept):
    """The cases as parameters, a tuple as several; those not in `kept`, or for which `kept` is false, are slow."""
    chosen = kept if callable(kept) else lambda case: case in kept
    several = [case if isinstance(case, tuple) else (case,) for case in cases]
    marks = [() if chosen(case) else pytest.mark.slow for case in cases]
    return [pytest.param(*values, marks=mark) for values, mark in zip(several, marks, strict=True)]
