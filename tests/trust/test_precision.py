"""`work_precision`: its errors are the true ones where those are known, and bad arguments are answered at once."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import oscillator
from scenes import OSCILLATOR, RADIAL_FALL

import lagjax

TS = np.linspace(0.0, 10.0, 21)
TOLERANCES = (1e-4, 1e-7, 1e-10)
DEFAULT = "default: Taylor (machine code)"
SOLVERS = {DEFAULT: None, "Dopri8": lagjax.FineOutput(diffrax.Dopri8()), "Tsit5": diffrax.Tsit5()}
BY_ARRAYS = lagjax.System(oscillator, path="array")
POINT_AND_SPRING = lagjax.System(lambda q, qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2) - 0.5 * q["y"] ** 2)


@pytest.fixture(scope="module")
def single():
    return lagjax.work_precision(OSCILLATOR, 1.0, 0.0, TS, tolerances=TOLERANCES)


@pytest.fixture(scope="module")
def batch():
    q0 = jnp.linspace(0.5, 2.0, 6).at[4].set(jnp.nan)
    solvers = {"fifth order": diffrax.Tsit5()}
    return lagjax.work_precision(
        OSCILLATOR, q0, jnp.zeros(6), TS, solvers=solvers, tolerances=TOLERANCES, batch_axes=(0, 0, None), repeats=1
    )


def test_errors_are_those_of_the_exact_solution(single):
    assert [(row.solver, row.rtol) for row in single] == [(s, r) for s in SOLVERS for r in TOLERANCES]
    for row in single:
        trajectory = lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, solver=SOLVERS[row.solver], rtol=row.rtol)
        exact = np.abs(trajectory.q - jnp.cos(TS)).max()
        assert row.error == row.worst_error
        assert abs(row.error - exact) <= single.reference_error
        assert row.accepted_steps == trajectory.stats["num_accepted_steps"]
        assert row.rejected_steps == trajectory.stats["num_rejected_steps"]


def test_errors_fall_and_steps_rise_with_the_tolerance(single):
    for name in SOLVERS:
        rows = [row for row in single if row.solver == name]
        assert rows[0].error > 30 * rows[1].error > 900 * rows[2].error > 0
        if name != DEFAULT:  # the order of a Taylor series rises with the digits instead
            assert rows[0].accepted_steps < rows[1].accepted_steps < rows[2].accepted_steps
    assert single.reference_error < 1e-10 and single.members == 1 and len(single) == 9
    assert all(row.seconds == row.seconds_per_trajectory > 0 and row.ok == 1 and row.wasted == 0 for row in single)


@pytest.mark.slow
def test_a_batch_gives_median_and_worst_over_the_members_that_arrive(batch):
    amplitudes = np.array([0.5, 0.8, 1.1, 1.4, 2.0])
    for row in batch:
        trajectory = lagjax.simulate_batch(
            OSCILLATOR, amplitudes, np.zeros(5), TS, solver=diffrax.Tsit5(), rtol=row.rtol
        )
        exact = np.abs(trajectory.q - amplitudes[:, None] * np.cos(TS)).max(axis=1)
        assert abs(row.error - np.median(exact)) <= batch.worst_reference_error
        assert abs(row.worst_error - exact.max()) <= batch.worst_reference_error
        assert row.ok == pytest.approx(5 / 6)
        assert row.seconds_per_trajectory == pytest.approx(row.seconds / 6)
        steps = np.append(trajectory.stats["num_steps"], 0)  # the member without a start takes none
        assert row.wasted == pytest.approx(steps.max() * 6 / steps.sum() - 1)


def test_the_engine_that_runs_by_default_is_taken_by_name_or_by_insisting():
    starts, both = (np.linspace(0.5, 1.0, 40), np.zeros(40)), {"mine": None, "insists": lagjax.MachineCode()}
    result = lagjax.work_precision(
        OSCILLATOR, *starts, TS, solvers=both, tolerances=[1e-16], batch_axes=(0, 0, None), repeats=1
    )
    assert [row.solver for row in result] == list(both) and result.rows[0].error == result.rows[1].error
    trajectory = lagjax.simulate_batch(OSCILLATOR, *starts, TS, rtol=1e-16)
    steps = trajectory.stats["num_steps"]
    assert result.rows[0].accepted_steps == steps.mean()
    # Lanes do not wait for the slowest member: at most the last round of each stands empty.
    assert result.rows[0].wasted < 0.5


def test_where_diffrax_runs_by_default_it_is_named_so_and_measured_once():
    result = lagjax.work_precision(BY_ARRAYS, 1.0, 0.0, TS, tolerances=[1e-4], repeats=1)
    assert [row.solver for row in result] == ["default: Dopri8", "Tsit5"]


@pytest.mark.slow
def test_where_machine_code_runs_by_default_it_is_named_so():
    result = lagjax.work_precision(OSCILLATOR, 1.0, 0.0, TS, tolerances=[1e-4], repeats=1)
    assert [row.solver for row in result] == ["default: Taylor (machine code)", "Dopri8", "Tsit5"]


@pytest.mark.slow
def test_single_precision_is_measured_against_double():
    start, solver = (jnp.float32(1.0), jnp.float32(0.0)), diffrax.Tsit5()
    result = lagjax.work_precision(OSCILLATOR, *start, TS, solvers={"5": solver}, tolerances=[1e-5], repeats=1)
    exact = np.abs(lagjax.simulate(OSCILLATOR, *start, TS, solver=solver, rtol=1e-5).q - np.cos(TS)).max()
    assert result.rows[0].error == pytest.approx(exact, rel=1e-2) and result.reference_error < 1e-9


@pytest.mark.slow
def test_tolerances_never_recompile():
    traced = []

    def counted(q, qdot):
        traced.append(None)
        return 0.5 * qdot**2 - 0.5 * q**2

    scene, only = lagjax.System(counted), {"Tsit5": diffrax.Tsit5()}
    lagjax.work_precision(scene, 1.0, 0.0, TS, solvers=only, tolerances=[1e-5], repeats=1)
    once = len(traced)
    lagjax.work_precision(scene, 1.0, 0.0, TS, solvers=only, tolerances=[1e-6, 3e-7, 1e-8], repeats=1)
    assert len(traced) == once


def test_the_table_is_aligned_and_complete(single):
    lines = str(single).splitlines()
    assert len({len(line) for line in lines[:-1]}) == 1
    assert lines[0].split()[:3] == ["solver", "rtol", "error"]
    assert [line.split("  ")[0] for line in lines[2:-1]] == [name for name in SOLVERS for _ in TOLERANCES]
    assert f"1 member; the reference is good to {single.reference_error:.1e}" in lines[-1]


@pytest.mark.slow
def test_the_table_counts_the_members_of_a_batch(batch):
    assert "6 members" in str(batch) and "83%" in str(batch)


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        ({"solvers": {}}, ValueError, "solvers is empty"),
        ({"solvers": diffrax.Tsit5()}, TypeError, "must be a dict"),
        ({"solvers": {"mine": diffrax.Tsit5}}, TypeError, r"solvers\['mine'\] must be an instance"),
        ({"solvers": {"mine": lagjax.MachineCode}}, TypeError, r"lagjax.MachineCode\(\) or None; got"),
        ({"solvers": {"mine": diffrax.Euler()}}, ValueError, "Euler, which has no error estimate"),
        ({"tolerances": []}, ValueError, "at least one value of rtol"),
        ({"tolerances": 1e-6}, ValueError, "at least one value of rtol"),
        ({"tolerances": [1e-6, -1e-8]}, ValueError, "Every tolerance must be .*got -1e-08"),
        ({"tolerances": [1e-16]}, ValueError, "at least 2.2e-15 in float64"),
        ({"tolerances": [1e-17], "solvers": {"default": None}}, ValueError, "at least 5.6e-17 in float64"),
        ({"tolerances": [float("nan")]}, ValueError, "got nan"),
        ({"repeats": 0}, ValueError, "repeats must be a positive integer"),
        ({"batch_axes": (0, None)}, ValueError, "batch_axes must be a tuple of three"),
    ],
)
def test_bad_arguments_are_answered_with_a_sentence(arguments, error, sentence):
    with pytest.raises(error, match=sentence):
        lagjax.work_precision(OSCILLATOR, 1.0, 0.0, TS, **arguments)


def test_a_reference_that_does_not_arrive_is_an_error():
    falling = RADIAL_FALL
    ts = np.linspace(0.0, 2.0, 3)
    with pytest.raises(lagjax.SimulationError, match="could not be followed"):
        lagjax.work_precision(falling, 1.0, 0.0, ts)
    with pytest.raises(ValueError, match="none of the members"):
        lagjax.work_precision(falling, np.ones(2), np.zeros(2), ts, batch_axes=(0, 0, None))


@pytest.mark.slow
def test_the_error_is_over_all_coordinates_of_any_pytree():
    q0, qdot0 = {"x": 0.0, "y": 1.0}, {"x": 1.0, "y": 0.0}  # free along x: all the error is along y
    only = {"Tsit5": diffrax.Tsit5()}
    result = lagjax.work_precision(POINT_AND_SPRING, q0, qdot0, TS, solvers=only, tolerances=[1e-6], repeats=1)
    trajectory = lagjax.simulate(POINT_AND_SPRING, q0, qdot0, TS, solver=diffrax.Tsit5(), rtol=1e-6)
    exact = np.abs(trajectory.q["y"] - np.cos(TS)).max()
    assert abs(result.rows[0].error - exact) <= result.reference_error < exact
