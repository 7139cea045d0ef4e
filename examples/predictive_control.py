"""Model predictive control of a cart with a pole: bounds on the force are part of the plan, not a clipping after it.

Every 50 ms the motion of the next 1.5 s is linearised about the last plan, all intervals as lanes of one batch, and the
forces within |u| ≤ 8 N that are best by this linear model solve a bounded least-squares problem. The first one is held,
and all begins again (the real-time iteration of Diehl, Bock & Schlöder, SIAM J. Control Optim. 43 (2005) 1714). The
cost is that of a linear quadratic regulator, which ends in the solution of Riccati's equation for the time beyond the
horizon (Rawlings, Mayne & Diehl, *Model Predictive Control*, §2.5). From 25° the plan holds the pole, and the
regulator, clipped, lets it fall; from below the plan swings it up.

python examples/predictive_control.py out/
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cholesky, solve_discrete_are
from scipy.optimize import lsq_linear

import lagjax

jax.config.update("jax_enable_x64", True)

STEP, HORIZON, STRONGEST, DURATION = 0.05, 30, 8.0, 6.0
WEIGHTS, EFFORT = np.diag([10.0, 10.0, 1.0, 1.0]), 0.1  # of place, angle from above and rates; of the force


def lagrangian(q, v):
    (_, angle), (speed, rate) = q, v
    return 0.65 * speed**2 + 0.15 * speed * rate * jnp.cos(angle) + 0.0375 * rate**2 - 1.4715 * jnp.cos(angle)


cart = lagjax.System(lagrangian, forces=lambda q, v, params: jnp.stack([params, 0.0 * params]))


@jax.jit
def advance(z, force):
    """The state (4,) after a step under a held force."""
    end = lagjax.simulate(cart, z[:2], z[2:], jnp.array([0.0, STEP]), force, throw=False).end
    return jnp.concatenate([end.q, end.qdot])


@jax.jit
def linearise(z, forces):
    """The states (N + 1, 4) from z under forces (N,); the slopes of steps by state (N, 4, 4) and force (N, 4)."""

    def step(z, force):
        return advance(z, force), z

    last, states = jax.lax.scan(step, z, forces)
    return jnp.concatenate([states, last[None]]), *jax.vmap(jax.jacfwd(advance, (0, 1)))(states, forces)


upright = lagjax.linearize(cart, np.zeros(2), params=0.0, dt=STEP)
Φ, Γ = np.asarray(upright.Phi), np.asarray(upright.Gamma)[:, :1]
BEYOND = solve_discrete_are(Φ, Γ, WEIGHTS, [[EFFORT]])
GAIN = np.linalg.solve(EFFORT + Γ.T @ BEYOND @ Γ, Γ.T @ BEYOND @ Φ)[0]


def plan(z, forces):
    """Better forces (N,) for the motion from z, within the bounds, by the linear model about the present ones."""
    N, (states, Φ, Γ) = len(forces), map(np.asarray, linearise(z, forces))
    roots, by_force, rows = [cholesky(WEIGHTS)] * (N - 1) + [cholesky(BEYOND)], np.zeros((4, N)), []
    for k in range(N):
        by_force = Φ[k] @ by_force
        by_force[:, k] = Γ[k]
        rows.append(roots[k] @ by_force)
    rows, present = np.concatenate(rows), np.concatenate([root @ x for root, x in zip(roots, states[1:], strict=True)])
    matrix, target = np.concatenate([rows, EFFORT**0.5 * np.eye(N)]), np.append(rows @ forces - present, np.zeros(N))
    return lsq_linear(matrix, target, (-STRONGEST, STRONGEST), method="bvls").x


def controlled(start, predictive=True):
    """The states (T + 1, 4) and the forces (T,) of the closed loop, by plans or by the clipped regulator."""
    states, applied, forces = [np.asarray(start)], [], np.zeros(HORIZON)
    for _ in range(round(DURATION / STEP)):
        forces = plan(states[-1], np.append(forces[1:], 0.0)) if predictive else [-GAIN @ states[-1]]
        applied.append(np.clip(forces[0], -STRONGEST, STRONGEST))
        states.append(np.asarray(advance(states[-1], applied[-1])))
    return np.stack(states), np.array(applied)


def picture(loops, file):
    """The angle and the force against time, of several closed loops by name."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.0, 5.0), layout="constrained")
    t = STEP * np.arange(1 + round(DURATION / STEP))
    for (name, (states, forces)), color in zip(loops.items(), ("#0072B2", "#D55E00", "#009E73"), strict=False):
        axes[0].plot(t, np.degrees(states[:, 1]), color=color, label=name)
        axes[1].step(t[:-1], forces, where="post", color=color)
    axes[0].set(ylabel="angle from above [°]", ylim=(-90, 270), title=f"A pole on a cart, |u| ≤ {STRONGEST:g} N")
    axes[0].legend(frameon=False)
    axes[1].set(xlabel="t [s]", ylabel="force [N]")
    figure.savefig(file, dpi=110)


def main(argv=None):
    tilted, below = np.array([0.0, np.radians(25.0), 0.0, 0.0]), np.array([0.0, np.pi, 0.0, 0.0])
    names = "plan, from 25°", "regulator, from 25°", "plan, from below"
    loops = controlled(tilted), controlled(tilted, predictive=False), controlled(below)
    off = [f"{name}: {np.degrees(states[-1, 1]):.2g}°" for name, (states, _) in zip(names, loops, strict=True)]
    print(f"the angle after {DURATION:g} s: {'; '.join(off)}")
    for folder in sys.argv[1:] if argv is None else argv:
        Path(folder).mkdir(parents=True, exist_ok=True)
        picture(dict(zip(names, loops, strict=True)), Path(folder) / "predictive_control.png")
    return loops


if __name__ == "__main__":
    main()
