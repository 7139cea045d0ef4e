"""Ready Lagrangians with what is known about their motion: closed solutions, constants, published numbers.

    import lagjax.scenes

    scene = lagjax.scenes.kepler(eccentricity=0.6)
    ts = jnp.linspace(0.0, scene.duration, 101)
    trajectory = lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params)

Every function in `ALL` can be called without arguments, and returns a `Scene`.
"""

from lagjax.scenes import _charges, _constrained, _coordinate_systems, _gravity, _mechanisms, _particles
from lagjax.scenes import _de421 as de421
from lagjax.scenes._charges import *
from lagjax.scenes._constrained import *
from lagjax.scenes._coordinate_systems import *
from lagjax.scenes._gravity import *
from lagjax.scenes._mechanisms import *
from lagjax.scenes._particles import *
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

__all__ = ["ALL", "Scene", "de421"]
__all__ += _charges.__all__
__all__ += _constrained.__all__
__all__ += _coordinate_systems.__all__
__all__ += _gravity.__all__
__all__ += _mechanisms.__all__
__all__ += _particles.__all__
