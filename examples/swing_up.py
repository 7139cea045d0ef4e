"""The least effort that swings a pole up: multiple shooting whose intervals are the lanes of one batch.

A cart of 1 kg carries a hanging pole of 0.3 kg. Fifty forces, each held for 40 ms, bring it to a stand one metre to the
side in 2 s, with |u| ≤ 20 N and the least ∫u² dt (Kelly, *An introduction to trajectory optimization*, SIAM Review 59
(2017) 849, §6). Unknown are the forces uₖ and the states zₖ between intervals; the motions of all intervals, with first
and second derivatives by (zₖ, uₖ), are one call. Newton's method solves the conditions of an optimum, a banded system
of nine numbers an interval, (uₖ, λₖ, zₖ₊₁), with the bounds as a barrier (interior point: Nocedal & Wright, *Numerical
Optimization*, chapter 19). Where its step does not come closer to them, one by Gauss and Newton is taken.

python examples/swing_up.py out/
"""

import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_banded

import lagjax

jax.config.update("jax_enable_x64", True)

CART, POLE, LENGTH, GRAVITY = 1.0, 0.3, 0.5, 9.81
DURATION, START, GOAL = 2.0, np.zeros(4), np.array([1.0, np.pi, 0.0, 0.0])  # place, angle from below, and their rates
BAND = 8  # diagonals on either side of the main one in the conditions of an optimum
SIDES = np.array([[1.0], [-1.0]])  # of the two bounds


def lagrangian(q, v):
    (_, angle), (speed, rate) = q, v
    kinetic = (CART + POLE) / 2 * speed**2 + POLE * LENGTH * (speed * rate * jnp.cos(angle) + LENGTH / 2 * rate**2)
    return kinetic + POLE * GRAVITY * LENGTH * jnp.cos(angle)


cart = lagjax.System(lagrangian, forces=lambda q, v, params: jnp.stack([params, 0.0 * params]))


@jax.jit
def expand(x, λ, dt):
    """Ends (N, 4) of intervals from x = (z, u), (N, 5), their Jacobians (N, 4, 5), Hessians (N, 5, 5) of λ · end."""

    def end(x):
        end = lagjax.simulate(cart, x[:2], x[2:4], jnp.stack([0.0 * dt, dt]), x[4], throw=False).end
        return jnp.concatenate([end.q, end.qdot])

    def lane(x, λ):
        return end(x), jax.jacfwd(end)(x), jax.hessian(lambda x: λ @ end(x))(x)

    return jax.vmap(lane)(x, λ)


class Point(NamedTuple):
    """The states z (N + 1, 4), forces u (N,) and multipliers λ (N, 4), and what `expand` says of them."""

    z: np.ndarray
    u: np.ndarray
    λ: np.ndarray
    ends: np.ndarray
    slopes: np.ndarray
    hessians: np.ndarray

    @property
    def defects(self):
        """The jumps of the state from an interval to the next, (N, 4)."""
        return self.ends - self.z[1:]

    def merit(self, room, barrier, weight):
        """The cost, the barrier, and the defects with this weight."""
        barriers = barrier * np.log(room(self.u)).sum()
        return DURATION / len(self.u) / 2 * self.u @ self.u - barriers + weight * np.abs(self.defects).sum()

    def gradient(self, room, barrier):
        """The slopes of the cost and the barrier by the forces, (N,)."""
        return DURATION / len(self.u) * self.u - (SIDES * barrier / room(self.u)).sum(axis=0)

    def residual(self, room, barrier):
        """The norm of what the conditions of an optimum leave."""
        pulled = np.einsum("kij,ki->kj", self.slopes, self.λ)
        balance = self.gradient(room, barrier) + pulled[:, 4], pulled[1:, :4] - self.λ[:-1]
        return np.linalg.norm(np.concatenate([x.ravel() for x in (*balance, self.defects)]))


def evaluate(z, u, λ):
    return Point(z, u, λ, *map(np.asarray, expand(np.column_stack([z[:-1], u]), λ, DURATION / len(u))))


def solve_conditions(point, hessian, gradient):
    """The step (dz, du) and λ of the linear conditions, with Hessians (N, 5, 5) by (zₖ, uₖ); both ends are fixed."""
    N = len(hessian)
    within, before = np.zeros((2, N, 9, 9))  # by (uₖ, λₖ, zₖ₊₁) of an interval itself, and of the one before it
    within[:, 0, 0], before[:, 0, 5:] = hessian[:, 4, 4], hessian[:, 4, :4]
    within[:, 1:5, 0] = within[:, 0, 1:5] = point.slopes[:, :, 4]
    within[:, 1:5, 5:] = within[:, 5:, 1:5] = -np.eye(4)
    within[:-1, 5:, 5:], within[-1, 5:] = hessian[1:, :4, :4], np.eye(9)[5:]
    before[:, 1:5, 5:] = point.slopes[:, :, :4]
    bands, (i, j), (above, right) = np.zeros((2 * BAND + 1, N, 9)), np.indices((9, 9)), np.triu_indices(9, 1)
    bands[BAND + i - j, :, j] = within.transpose(1, 2, 0)
    bands[BAND + 9 + above - right, :-1, right] = bands[BAND - 9 - above + right, 1:, above] = before[
        1:, above, right
    ].T
    sides = np.column_stack([-gradient, -point.defects, np.zeros((N, 4))])
    step = solve_banded((BAND, BAND), bands.reshape(2 * BAND + 1, 9 * N), sides.ravel()).reshape(N, 9)
    return np.concatenate([np.zeros((1, 4)), step[:, 5:]]), step[:, 0], step[:, 1:5]


def lower_merit(point, step, full, room, barrier, weight):
    """The first point at full step, half of it, … whose merit is lower by what the slope of it lets expect."""
    gradient, (dz, du, λ) = point.gradient(room, barrier), step
    expected = gradient @ du - weight * np.abs(point.defects).sum()
    for scale in full * 0.5 ** np.arange(30):
        new = evaluate(point.z + scale * dz, point.u + scale * du, point.λ + scale * (λ - point.λ))
        if new.merit(room, barrier, weight) <= point.merit(room, barrier, weight) + 1e-4 * scale * expected + 1e-10:
            return new
    raise ValueError("No step lowers the merit: take more intervals, a longer time, or stronger forces.")


def swing_up(strongest=20.0, intervals=50, tolerance=1e-8, most=100):
    """The optimum as a `Point`, and how many steps it took."""
    point = evaluate(np.linspace(START, GOAL, intervals + 1), np.zeros(intervals), np.zeros((intervals, 4)))
    forces, barrier, weight = np.ones((2, intervals)), 0.1, 10.0  # `forces` of the bounds

    def room(u):
        return strongest + SIDES * u

    for count in range(1, most + 1):
        here, gradient, plain = room(point.u), point.gradient(room, barrier), np.zeros((intervals, 5, 5))
        plain[:, 4, 4] = DURATION / intervals + (forces / here).sum(axis=0)
        for hessian in (plain + point.hessians, plain):
            dz, du, λ = step = solve_conditions(point, hessian, gradient)
            full = min(1.0, 0.995 / max(1e-9, (-SIDES * du / here).max()))  # some room to the bounds is left
            if hessian is plain:
                weight = max(weight, 2 * np.abs(λ).max())
                new = lower_merit(point, step, full, room, barrier, weight)
                break
            new = evaluate(point.z + full * dz, point.u + full * du, point.λ + full * (λ - point.λ))
            if new.residual(room, barrier) < point.residual(room, barrier):
                break
        rise = barrier / here - forces - forces * SIDES * du / here
        forces = forces + min(1.0, 0.995 / max(1e-9, (-rise / forces).max())) * rise
        point, error = new, max(np.abs(du).max(), np.abs(new.defects).max())
        if error < tolerance and barrier <= tolerance:
            return point, count
        if error < 10 * barrier:
            barrier = max(tolerance, min(barrier / 5, barrier**1.5))
    raise ValueError(f"{most} steps did not suffice: take more intervals, a longer time, or stronger forces.")


def replay(u):
    """The end (4,) of one motion under these held forces, by steps that are tighter than those of the search."""
    knots = DURATION / len(u) * np.arange(len(u))

    def held(q, v, t, params):
        return jnp.stack([lagjax.samples(knots, params)(t), 0.0 * t])

    motion = lagjax.System(lagrangian, forces=held)
    end = lagjax.simulate(motion, START[:2], START[2:], np.array([0.0, DURATION]), u, rtol=1e-13).end
    return np.concatenate([end.q, end.qdot])


def picture(point, file):
    """The pole at the ends of intervals, and the forces."""
    import matplotlib.pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, figsize=(7.0, 5.6), layout="constrained", height_ratios=[2, 1])
    place, angle, *_ = point.z.T
    colors = plt.colormaps["viridis"](np.linspace(0.0, 0.9, len(place)))
    for x, a, color in zip(place, angle, colors, strict=True):
        above.plot([x, x + LENGTH * np.sin(a)], [0.0, -LENGTH * np.cos(a)], "-o", color=color, markevery=[1])
    above.plot(place, 0.0 * place, "s", color="0.3", markersize=4)
    above.set(aspect="equal", xlabel="place [m]", title="A pole swings up with the least effort")
    below.stairs(point.u, np.linspace(0.0, DURATION, len(point.u) + 1), baseline=None, color="#0072B2")
    below.set(xlabel="t [s]", ylabel="force [N]")
    figure.savefig(file, dpi=110)


def main(argv=None):
    point, count = swing_up()
    missed, cost = np.abs(replay(point.u) - GOAL).max(), DURATION / len(point.u) * point.u @ point.u
    print(
        f"∫u² dt = {cost:.6f} after {count} steps; |u| ≤ {np.abs(point.u).max():.3f}; the replay misses by {missed:.1e}"
    )
    for folder in sys.argv[1:] if argv is None else argv:
        Path(folder).mkdir(parents=True, exist_ok=True)
        picture(point, Path(folder) / "swing_up.png")
    return point, missed


if __name__ == "__main__":
    main()
