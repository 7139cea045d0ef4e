"""What a user may hand to `fit` by mistake, or in another form than floats: a sentence, or the right numbers."""

import jax
import numpy as np
import pytest
from scenes import SPRING

import lagjax

TS = np.linspace(0.0, 3.0, 61)
Q = np.cos(2.0 * TS)
DATES = np.datetime64("2020-01-01") + np.arange(61) * np.timedelta64(50, "ms")


def fit(record, **options):
    return lagjax.fit(SPRING, record, {"k": 3.5}, method="whole", **options)


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (lambda: lagjax.Record(DATES, Q), "ts holds dates or durations"),
        (lambda: lagjax.Record(TS, DATES - DATES[0]), "values holds dates or durations"),
        (lambda: lagjax.Record(TS, Q + 0j), "values must be an array of real numbers; got ndarray of complex128"),
        (lambda: lagjax.Record(TS + 0j, Q), "ts must be an array of times"),
        (lambda: lagjax.Record(TS, Q, np.array(["on"] * 61)), "inputs must be an array of real numbers; got .* <U2"),
        (lambda: lagjax.Record(TS, Q, weights=1j), "weights must be real numbers"),
        (lambda: lagjax.Timings(lambda q, v: q, 1j * TS, -1.0, (0.0, 1.0)), "times must be real numbers"),
        (lambda: fit(None), "records must be a lagjax.Record, or a list of them; got NoneType"),
        (lambda: fit(lagjax.Record(TS, Q, start=("one", 0.0))), "A start must hold real numbers; got 'one'"),
        (lambda: fit(lagjax.Record(TS, Q, start=lambda p: (1j, 0.0))), "A start must hold real numbers; got 1j"),
    ],
)
def test_what_is_no_array_of_real_numbers_is_a_type_error(record, sentence):
    with pytest.raises(TypeError, match=sentence):
        record()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"seed": -1}, "seed must be a whole number, 0 or larger; got -1"),
        ({"seed": "a"}, "seed must be a whole number"),
        ({"observe": lambda q, qdot: q + 1j * qdot}, "observe returns complex numbers"),
    ],
)
def test_options_that_cannot_be_are_a_sentence(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        fit(lagjax.Record(TS, Q), **options)


def test_a_start_of_another_structure_than_the_scene_s_is_named_with_its_record():
    records = [lagjax.Record(TS, Q), lagjax.Record(TS, Q, start=(np.zeros(2), np.zeros(2)))]
    with pytest.raises(ValueError, match=r"cannot be called with the start of records\[1\]"):
        fit(records)


def test_a_delay_s_bound_that_is_no_number_is_a_sentence():
    with pytest.raises(ValueError, match="longest must be a positive number"):
        lagjax.Delayed(lambda params: 0.1, "0.2")


def test_a_masked_sample_is_missing():
    hidden = np.ma.masked_array(np.where(TS < 1.0, 50.0, Q), mask=TS < 1.0)
    record = lagjax.Record(TS, hidden)
    np.testing.assert_array_equal(record.values, np.where(TS < 1.0, np.nan, Q))


def test_whole_numbers_in_a_start_are_real_ones():
    assert fit(lagjax.Record(TS, Q, start=(1, 0))).params["k"] == pytest.approx(4.0, rel=1e-8)


@pytest.mark.parametrize(
    ("traced", "sentence"),
    [
        (lambda k: lagjax.fit(SPRING, lagjax.Record(TS, Q), {"k": k}), "params0 is being traced"),
        (lambda k: lagjax.Record(TS, k * Q), "values is being traced"),
    ],
)
@pytest.mark.parametrize("transform", [jax.jit, jax.grad])
def test_a_fit_within_a_transformation_is_a_sentence(traced, sentence, transform):
    with pytest.raises(TypeError, match=sentence):
        transform(traced)(3.5)
