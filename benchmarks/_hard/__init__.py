"""The hard cases, by kind: `_case` says what one is, and how lagjax and its peers are put to it."""

from benchmarks._hard import _borders, _chaos, _constrained, _failures, _fields, _gravity, _integrable, _rotation
from benchmarks._hard._case import Case, Experiment, Found

__all__ = ["CASES", "Case", "Experiment", "Found"]

CASES = (
    *_constrained.CASES,
    *_gravity.CASES,
    *_rotation.CASES,
    *_fields.CASES,
    *_integrable.CASES,
    *_chaos.CASES,
    *_borders.CASES,
    *_failures.CASES,
)
