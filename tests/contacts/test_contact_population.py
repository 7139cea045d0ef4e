"""Random scenes with gaps, friction and joints: a few of every family by default, all of a benchmark when slow."""

import sys
from pathlib import Path

import jax
import pytest

pytest.importorskip("scipy", reason="the references are computed with it")
sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import contact_columns, contact_population


@pytest.fixture(autouse=True)
def double_precision():
    yield
    jax.config.update("jax_enable_x64", True)


def assert_none_wrong(*arguments):
    counts = contact_population.main(list(arguments))
    assert counts["wrong"] == counts["wrong derivative"] == 0 and counts["right"] > 0, dict(counts)


@pytest.mark.slow
def test_none_of_a_few_is_wrong():
    assert_none_wrong("--scenes", "4", "--families", "disc", "--first", "100")


@pytest.mark.slow
@pytest.mark.parametrize("family", ["blocks", "arms"])
def test_none_of_a_family_is_wrong(family):
    assert_none_wrong("--scenes", "4", "--families", family)


@pytest.mark.slow
def test_none_of_a_box_is_wrong_in_single_precision():
    assert_none_wrong("--scenes", "4", "--families", "box", "--float32")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [317, 341])
def test_arms_that_align_slide_on(seed):
    """Where both rods are in line, what slips is held by the gap itself: it passes through zero and turns."""
    counts = contact_population.main(["--scenes", "1", "--families", "arms", "--first", str(seed)])
    assert counts == {"right": 1}, dict(counts)


@pytest.mark.slow
def test_columns_are_decided():
    counts = contact_columns.main(["--sizes", "3", "12", "--restitutions", "0", "0.3"])
    assert counts == {"right": 4}, dict(counts)
