"""Ready Lagrangians with what is known about their motion: closed solutions, constants, published numbers.

    import lagjax.scenes

    scene = lagjax.scenes.kepler(eccentricity=0.6)
    ts = jnp.linspace(0.0, scene.duration, 101)
    trajectory = lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params)

Every function in `ALL` can be called without arguments, and returns a `Scene`.
"""

from lagjax.scenes import _de421 as de421
from lagjax.scenes._charges import (
    charge_in_fields,
    charge_in_uniform_fields,
    gyration,
    relativistic_charge_in_electric_field,
    relativistic_charge_in_magnetic_field,
)
from lagjax.scenes._constrained import (
    Blade,
    Disc,
    Rolling,
    SliderCrank,
    Squeezer,
    andrews_squeezer,
    bead_on_wire,
    cartesian_chain,
    cartesian_double_pendulum,
    cartesian_of_angles,
    cartesian_pendulum,
    chaplygin_sleigh,
    knife_edge,
    particle_on_sphere,
    rolling_cylinder,
    rolling_cylinder_multipliers,
    rolling_disc,
    slider_crank,
    wire_multiplier,
)
from lagjax.scenes._coordinate_systems import Cartesian, Cylindrical, Polar, Spherical, convert
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
    free_particle, uniform_gravity, one_dimension, morse_oscillator, harmonic_oscillator, particle_in_potential,
    central_force, particles, bead_on_rotating_hoop, wedge, pendulum, double_pendulum, chain, spherical_pendulum,
    driven_pendulum, driven_oscillator, damped_driven_oscillator, swinging_atwood, fermi_pasta_ulam,
    rolling_cylinder, cartesian_pendulum, cartesian_double_pendulum, cartesian_chain, bead_on_wire,
    particle_on_sphere, rolling_disc, knife_edge, chaplygin_sleigh, slider_crank, andrews_squeezer,
    charge_in_fields, charge_in_uniform_fields, gyration, relativistic_charge_in_electric_field,
    relativistic_charge_in_magnetic_field, kepler, restricted_three_body, figure_eight, newtonian_solar_system,
    solar_system,
)  # fmt: skip

__all__ = [
    "ALL", "Blade", "Cartesian", "Cylindrical", "Direction", "Disc", "Polar", "Rolling", "Scene", "SliderCrank",
    "SlowAndFast", "Spherical", "Squeezer", "Swing", "WedgeAndMass", "andrews_squeezer", "bead_on_rotating_hoop",
    "bead_on_wire", "cartesian_chain", "cartesian_double_pendulum", "cartesian_of_angles", "cartesian_pendulum",
    "central_force", "chain", "chaplygin_sleigh", "charge_in_fields", "charge_in_uniform_fields", "convert",
    "damped_driven_oscillator", "de421", "double_pendulum", "double_pendulum_frequencies", "driven_oscillator",
    "driven_pendulum", "eccentric_anomaly", "fermi_pasta_ulam", "figure_eight", "free_particle", "gyration",
    "harmonic_oscillator", "kepler", "knife_edge", "morse_oscillator", "n_body", "newtonian_solar_system",
    "one_dimension", "oscillatory_energies", "particle_in_potential", "particle_on_sphere", "particles", "pendulum",
    "relativistic_charge_in_electric_field", "relativistic_charge_in_magnetic_field", "restricted_three_body",
    "rolling_cylinder", "rolling_cylinder_multipliers", "rolling_disc", "slider_crank", "solar_system",
    "spherical_pendulum", "swinging_atwood", "uniform_gravity", "wedge", "wedge_accelerations", "wire_multiplier",
]  # fmt: skip
