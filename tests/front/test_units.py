"""The law of units: lengths, times and masses in other units change no verdict and no digit."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from benchmarks.units import FUNCTIONS, SYSTEMS, Units, applies, compare, simulate, with_units

# ---- what was met in metres and seconds ------------------------------------------------------------------------------

SUN = lagjax.System(lambda q, v: 0.5 * v @ v + 1.327e20 / jnp.sqrt(q @ q))


def test_a_planet_in_metres_conserves_its_angular_momentum():
    found = lagjax.conserved_quantities(SUN, np.array([1.5e11, 1e9]), np.array([1e2, 3e4]))
    assert [one.name for one in found] == ["energy", "angular momentum in the plane 01"] and found.notes == ()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_other_random_states_find_the_same(seed):
    found = lagjax.conserved_quantities(SUN, np.array([1.5e11, 1e9, 0.0]), np.array([1e2, 3e4, 10.0]), seed=seed)
    planes = [f"angular momentum in the plane {ij}" for ij in ("01", "02", "12")]
    assert [one.name for one in found] == ["energy", *planes] and found.notes == ()


MOLECULE = lagjax.System(lambda q, v: 0.5e-26 * v**2 - 7e-19 * (1 - jnp.exp(-2e10 * (q - 1.2e-10))) ** 2)


@pytest.mark.slow
def test_a_molecule_in_metres_rests_at_its_bond_length():
    rest = lagjax.equilibrium(MOLECULE, 1.5e-10)
    np.testing.assert_allclose(rest.q, 1.2e-10, rtol=1e-14)
    frequency = 2e10 * np.sqrt(2 * 7e-19 / 1e-26)
    np.testing.assert_allclose(lagjax.normal_modes(MOLECULE, rest.q).frequencies, [frequency], rtol=1e-12)
    with pytest.raises(ValueError, match="No equilibrium was found"):
        lagjax.equilibrium(MOLECULE, 2e-10)  # beyond the largest force, as without units
    with pytest.raises(ValueError, match=r"not an equilibrium: .* that a deviation of 0\.11 of q's size"):
        lagjax.normal_modes(MOLECULE, 1.3e-10)


def turning(q, v, params):
    return 0.5 * v @ v + params * (q[0] * v[1] - q[1] * v[0]) - 2 * params**2 * (q @ q)


TURNING = lagjax.System(turning)


@pytest.mark.parametrize("rate", [1e-13, 1e13])
def test_modes_that_turn_slowly_and_fast(rate):
    modes = lagjax.normal_modes(TURNING, np.zeros(2), rate)
    np.testing.assert_allclose(modes.frequencies / rate, np.sqrt(5) + np.array([-1.0, 1.0]), rtol=1e-13)


def test_a_circle_with_an_energy_in_metres():
    mu, a, e = 1.327e20, 1.5e11, 0.2
    q, v = np.array([a * (1 - e), 0.0]), np.array([0.0, np.sqrt(mu / a * (1 + e) / (1 - e))])
    period = 2 * np.pi * np.sqrt(a**3 / mu)
    orbit = lagjax.periodic_orbit(SUN, q, v, 1.022 * period, energy=-mu / (2 * a))
    np.testing.assert_allclose(orbit.period, period, rtol=1e-13)
    assert orbit.closure < 1e-13 and orbit.stable


def test_a_motion_of_an_angstrom_keeps_its_digits():
    # Morse's oscillator in closed form is in the scenes: here it is 1e-10 metres, and its period some 1e-12 seconds.
    case = with_units(lagjax.scenes.morse_oscillator(), "morse_oscillator")
    (_, here), (_, there) = (simulate(case, Units(*SYSTEMS[name])) for name in ("1", "atoms"))
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8 * np.abs(a).max())
    # An atol of the user is taken as it is.
    q, qdot, params = case.in_units(Units(*SYSTEMS["short"]))
    ts = np.linspace(0.0, case.duration, 11)
    coarse = lagjax.simulate(case.system, q, qdot, ts, params, atol=1e-12)
    assert np.abs(np.asarray(coarse.q) * 2**40 - here[0]).max() > 1e-4 and coarse.health().findings()


# ---- what nearly holds -----------------------------------------------------------------------------------------------


def well(q, v, params):
    return 0.5 * v @ v - 0.5 * (q[0] ** 2 + (1 + params) * q[1] ** 2) - (q @ q) ** 2


WELL = lagjax.System(well)


def test_a_symmetry_that_nearly_holds_is_named_as_such():
    state = WELL, np.array([1.0, 0.3]), np.array([0.3, 0.5])
    found = lagjax.conserved_quantities(*state, 1e-9)
    assert [one.name for one in found] == ["energy"]
    assert len(found.notes) == 1 and found.notes[0].startswith("nearly conserved: angular momentum in the plane 01")
    assert found.threshold < 1e-12 and "would not be seen" in str(found)
    exact = lagjax.conserved_quantities(*state, 0.0)
    assert [one.name for one in exact] == ["energy", "angular momentum in the plane 01"] and exact.notes == ()


def spring(stiffness):
    return lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * stiffness * q**2)


@pytest.mark.parametrize("part, same", [(1e-10, False), (1e-12, False), (1e-15, True), (0.0, True)])
def test_stiffnesses_that_hardly_differ(part, same):
    found = lagjax.same_motion(spring(1.0), spring(1 + part), 1.0, 0.3)
    assert found.same is same and found.threshold < 1e-12


# ---- the law ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kepler", "cartesian_pendulum"])
def test_units_change_nothing(name):  # the benchmark has all scenes
    case = with_units(getattr(lagjax.scenes, name)(), name)
    some = [one for one in SYSTEMS if one != "1"] if name == "kepler" else ["heavy", "atoms"]
    assert [found for f in FUNCTIONS if applies(f, case) for found in compare(f, case, some)] == []


@pytest.mark.parametrize("function", ["simulate", "check", "equilibrium"])
def test_units_change_nothing_for_a_pendulum(function):
    case = with_units(lagjax.scenes.pendulum(), "pendulum")
    assert compare(next(f for f in FUNCTIONS if f.__name__ == function), case, ["short", "slow", "atoms"]) == []
