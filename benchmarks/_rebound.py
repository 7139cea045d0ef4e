"""REBOUND's integrator for many bodies, IAS15: order fifteen, adaptive, in C. It is for one cluster after the other.

Rein & Spiegel, *IAS15: a fast, adaptive, high-order integrator for gravitational dynamics, accurate to machine
precision over a billion orbits*, MNRAS 446 (2015) 1424-1437.
"""

import numpy as np

from benchmarks._cases import Case
from benchmarks._large import SOFTENING


def why_not(case: Case) -> str | None:
    return None if case.name.startswith("bodies_") else "not a cluster of bodies"


def prepare(case: Case):
    import rebound

    masses = case.scene.params["m"]

    def one(state: np.ndarray, tol: float) -> tuple[np.ndarray, int]:
        x, v = state.reshape(2, -1, 3)
        cluster = rebound.Simulation()
        cluster.integrator, cluster.softening = "ias15", SOFTENING
        for mass, place, speed in zip(masses, x, v, strict=True):
            cluster.add(m=mass, x=place[0], y=place[1], z=place[2], vx=speed[0], vy=speed[1], vz=speed[2])
        cluster.ri_ias15.epsilon = tol
        cluster.integrate(case.duration)
        places, speeds = np.empty_like(x), np.empty_like(v)
        cluster.serialize_particle_data(xyz=places, vxvyvz=speeds)
        return np.concatenate([places.ravel(), speeds.ravel()]), cluster.steps_done

    def solve(tol):
        final, steps = zip(*(one(state, tol) for state in case.states), strict=True)
        return np.stack(final), np.array(steps)

    return solve
