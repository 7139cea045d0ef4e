"""Worked problems of `benchmarks/_contact_problems.py`: their errors stay below their bounds."""

import sys
from pathlib import Path

import pytest

pytest.importorskip("scipy", reason="the references are computed with it")
pytest.importorskip("mpmath", reason="the maps of billiards are computed with it")
sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks._contact_problems import PROBLEMS

KEPT = ("Housner", "stadium", "Sinai", "woodpecker", "stone")  # the others take long, and are the benchmark's


@pytest.mark.slow
@pytest.mark.parametrize("problem", [p for p in PROBLEMS.values() if p.name.startswith(KEPT)], ids=lambda p: p.name)
def test_errors_of_a_problem(problem):
    figures = problem.solve()
    assert {
        name: value for name, value in figures.items() if name in problem.bounds and not value <= problem.bounds[name]
    } == {}
