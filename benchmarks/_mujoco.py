"""MuJoCo on a chain of pendulums: the rigid-body engine of robotics, its trajectories by `mujoco.rollout` in threads.

MuJoCo knows neither Lagrangians nor tolerances, so two things are not alike:

- *the model*: a body must have an inertia. Each link is a point mass at its end with a moment of inertia of 10⁻¹⁴ about
  it (its m l² is 1). That model error was measured: twice the inertia in the final angles after T = 2, more later;
- *the steps*: RK4 is the most accurate of its integrators, with steps of one size. A tolerance `tol` is taken to mean
  steps of 0.3 tol^¼ (its error goes with the fourth power), and what error that gives is measured as for all.

Its coordinates are the angles between neighbouring links; ours are those from the vertical.
"""

import math

import numpy as np

from benchmarks._cases import GRAVITY, Case
from lagjax._native import cores

CHUNK = 1000  # steps: `rollout` stores the state after every one


def why_not(case: Case) -> str | None:
    """MuJoCo models mechanisms; of the scenes here, those that are chains of unit links."""
    chain = case.name.startswith("chain_") or case.name == "double_pendulum"
    return None if chain else "this scene is not a mechanism of rigid bodies"


def prepare(case: Case):
    from mujoco import rollout

    pool = rollout.Rollout(nthread=cores())
    relative = [np.concatenate([rows[:, :1], np.diff(rows, axis=1)], axis=1) for rows in (case.q0, case.qdot0)]
    start = np.concatenate([np.zeros((case.batch, 1)), *relative], axis=1)  # time, positions, velocities
    models = {}

    def solve(tol):
        steps = math.ceil(case.duration / (0.3 * tol**0.25))
        if tol not in models:
            models[tol] = _model(case.coordinates, case.duration / steps)
        model, data = models[tol]
        state, left = start, steps
        while left > 0:
            path, _ = pool.rollout(model, data, state, nstep=min(left, CHUNK))
            state, left = path[:, -1], left - CHUNK
        angles, rates = np.split(state[:, 1:], 2, axis=1)
        return np.concatenate([angles.cumsum(axis=1), rates.cumsum(axis=1)], axis=1), np.array([steps])

    return solve


def _model(links: int, step: float):
    """The compiled chain, and a work space for each thread."""
    import mujoco

    opening = "".join(
        f'<body pos="0 0 {-1 if i else 0}"><joint type="hinge" axis="0 1 0"/>'
        '<inertial pos="0 0 -1" mass="1" diaginertia="1e-14 1e-14 1e-14"/>'
        for i in range(links)
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option integrator="RK4" timestep="{step!r}" gravity="0 0 {-GRAVITY}">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{opening}{'</body>' * links}</worldbody></mujoco>"
    )
    return model, [mujoco.MjData(model) for _ in range(cores())]
