"""The benchmark bicycle: a full Lagrangian with two wheels that roll, its steady motions, and how stable they are.

Four rigid bodies, x forward, y to the right, z down; the 25 parameters and the published eigenvalues are those of
Meijaard, Papadopoulos, Ruina & Schwab, *Linearized dynamics equations for the balance and steer of a bicycle: a
benchmark and review*, Proc. R. Soc. A 463 (2007) 1955, Tables 1 and 2. Nothing is linearised by hand. Run it with
`python examples/bicycle.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

jax.config.update("jax_enable_x64", True)

WHEELBASE, TRAIL, TILT, GRAVITY = 1.02, 0.08, np.pi / 10, 9.81
REAR, FRONT = 0.3, 0.35  # radii of the wheels
MASSES = np.array([2.0, 85.0, 4.0, 3.0])  # rear wheel, rear frame with rider, handlebar and fork, front wheel
CENTRES = np.array([[0.0, 0.0, -REAR], [0.3, 0.0, -0.9], [0.9, 0.0, -0.7], [WHEELBASE, 0.0, -FRONT]])
INERTIAS = np.array(
    [
        np.diag([0.0603, 0.12, 0.0603]),
        [[9.2, 0.0, 2.4], [0.0, 11.0, 0.0], [2.4, 0.0, 2.8]],
        [[0.05892, 0.0, -0.00756], [0.0, 0.06, 0.0], [-0.00756, 0.0, 0.00708]],
        np.diag([0.1405, 0.28, 0.1405]),
    ]
)
PIVOT, AXIS = np.array([WHEELBASE + TRAIL, 0.0, 0.0]), np.array([np.sin(TILT), 0.0, np.cos(TILT)])  # of the steering
X, Y, Z = np.eye(3)


def rotation(axis, angle):
    """Rodrigues' matrix of a turn by an angle about an axis of unit length."""
    cross = np.cross(np.eye(3), -axis)
    return jnp.eye(3) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * cross @ cross


def pose(q):
    """The centres of the four bodies, the matrices of the rear and the front frame, and of the rear wheel's plane."""
    plane = rotation(Z, q["yaw"]) @ rotation(X, q["lean"])
    rear = plane @ rotation(Y, q["pitch"])
    front = rear @ rotation(AXIS, q["steer"])
    hub = jnp.array([q["x"], q["y"], 0.0]) - REAR * plane @ Z  # x, y is where the rear wheel touches the ground
    pivot = hub + rear @ (PIVOT - CENTRES[0])
    centres = [hub, hub + rear @ (CENTRES[1] - CENTRES[0]), *(pivot + front @ (c - PIVOT) for c in CENTRES[2:])]
    return jnp.stack(centres), rear, front, plane


def motion(q, v):
    """Velocities of the centres, and angular velocities of the four bodies, in the axes of their frames."""
    (_, rear, front, _), (velocities, *rates) = jax.jvp(pose, (q,), (v,))
    turns = [a.T @ b for a, b in zip((rear, front), rates, strict=False)]
    of_rear, of_front = (jnp.array([w[2, 1], w[0, 2], w[1, 0]]) for w in turns)
    return velocities, jnp.stack([of_rear + v["rear"] * Y, of_rear, of_front, of_front + v["front"] * Y])


def lagrangian(q, v):
    velocities, turning = motion(q, v)
    kinetic = MASSES @ jnp.sum(velocities**2, axis=1) + jnp.einsum("bi,bij,bj", turning, INERTIAS, turning)
    return 0.5 * kinetic + GRAVITY * MASSES @ pose(q)[0][:, 2]


def spokes(q):
    """From the hubs to where the wheels are lowest."""
    *_, front, plane = pose(q)
    axle = front @ Y
    down = Z - axle[2] * axle
    return REAR * plane @ Z, FRONT * down / jnp.sqrt(down @ down)


def front_height(q):
    return pose(q)[0][3, 2] + spokes(q)[1][2]


def slip(q, v):
    """Velocities over the ground of the material points of both wheels that touch it."""
    _, rear, front, _ = pose(q)
    velocities, turning = motion(q, v)
    of_rear, of_front = spokes(q)
    return (velocities[0] + jnp.cross(rear @ turning[0], of_rear))[:2], (
        velocities[3] + jnp.cross(front @ turning[3], of_front)
    )[:2]


BICYCLE = lagjax.System(lagrangian, constraints=front_height, velocity_constraints=slip)
NAMES = ("x", "y", "yaw", "lean", "steer", "pitch", "rear", "front")
UPRIGHT = dict.fromkeys(NAMES, 0.0)


def straight(speed):
    """The velocities of the bicycle that goes straight on."""
    return UPRIGHT | {"x": speed, "rear": -speed / REAR, "front": -speed / FRONT}


def exponents(speed):
    """The eigenvalues of the small motions about straight rolling, without the zero of another speed."""
    steady = lagjax.steady_motion(BICYCLE, UPRIGHT, straight(speed), hold=("qdot['rear']", "q['lean']"))
    reduced = lagjax.linearize(BICYCLE, steady.q, steady.qdot).reduced(steady)
    values = np.linalg.eigvals(reduced.A)
    return np.sort_complex(np.delete(values, np.argmin(np.abs(values))))


if __name__ == "__main__":
    for speed in (0.0, 3.0, 5.0, 8.0):
        print(f"{speed:g} m/s: " + ", ".join(f"{value:.10f}" for value in exponents(speed)))
