"""Ready Lagrangians with what is known about their motion: closed solutions, constants, published numbers.

    import lagjax.scenes

    scene = lagjax.scenes.kepler(eccentricity=0.6)
    ts = jnp.linspace(0.0, scene.duration, 101)
    trajectory = lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params)

Every function in `ALL` takes no argument that it must be given, and returns a `Scene`.
"""

from lagjax.scenes import _de421 as de421
from lagjax.scenes._coordinates import Cartesian, Cylindrical, Polar, Spherical, convert
from lagjax.scenes._fields import (
    charge_in_fields,
    charge_in_uniform_fields,
    gyration,
    relativistic_charge_in_electric_field,
    relativistic_charge_in_magnetic_field,
)
from lagjax.scenes._gravity import (
    eccentric_anomaly,
    figure_eight,
    kepler,
    n_body,
    newtonian_solar_system,
    restricted_three_body,
    solar_system,
)
from lagjax.scenes._mechanisms import (
    Direction,
    SlowAndFast,
    Swing,
    WedgeAndMass,
    chain,
    damped_driven_oscillator,
    double_pendulum,
    double_pendulum_frequencies,
    driven_oscillator,
    driven_pendulum,
    fermi_pasta_ulam,
    oscillatory_energies,
    pendulum,
    spherical_pendulum,
    swinging_atwood,
    wedge,
    wedge_accelerations,
)
from lagjax.scenes._particles import (
    bead_on_rotating_hoop,
    central_force,
    free_particle,
    harmonic_oscillator,
    morse_oscillator,
    one_dimension,
    particle_in_potential,
    particles,
    uniform_gravity,
)
from lagjax.scenes._scene import Scene

ALL = (
    free_particle,
    uniform_gravity,
    one_dimension,
    morse_oscillator,
    harmonic_oscillator,
    particle_in_potential,
    central_force,
    particles,
    bead_on_rotating_hoop,
    wedge,
    pendulum,
    double_pendulum,
    chain,
    spherical_pendulum,
    driven_pendulum,
    driven_oscillator,
    damped_driven_oscillator,
    swinging_atwood,
    fermi_pasta_ulam,
    charge_in_fields,
    charge_in_uniform_fields,
    gyration,
    relativistic_charge_in_electric_field,
    relativistic_charge_in_magnetic_field,
    kepler,
    restricted_three_body,
    figure_eight,
    newtonian_solar_system,
    solar_system,
)

__all__ = [
    "ALL",
    "Cartesian",
    "Cylindrical",
    "Direction",
    "Polar",
    "Scene",
    "SlowAndFast",
    "Spherical",
    "Swing",
    "WedgeAndMass",
    "bead_on_rotating_hoop",
    "central_force",
    "chain",
    "charge_in_fields",
    "charge_in_uniform_fields",
    "convert",
    "damped_driven_oscillator",
    "de421",
    "double_pendulum",
    "double_pendulum_frequencies",
    "driven_oscillator",
    "driven_pendulum",
    "eccentric_anomaly",
    "fermi_pasta_ulam",
    "figure_eight",
    "free_particle",
    "gyration",
    "harmonic_oscillator",
    "kepler",
    "morse_oscillator",
    "n_body",
    "newtonian_solar_system",
    "one_dimension",
    "oscillatory_energies",
    "particle_in_potential",
    "particles",
    "pendulum",
    "relativistic_charge_in_electric_field",
    "relativistic_charge_in_magnetic_field",
    "restricted_three_body",
    "solar_system",
    "spherical_pendulum",
    "swinging_atwood",
    "uniform_gravity",
    "wedge",
    "wedge_accelerations",
]
