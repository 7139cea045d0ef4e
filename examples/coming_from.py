# %% [markdown]
r"""
# Coming from elsewhere

The same motion in the tool you know and in lagjax, ten lines each, with what maps to what and when to stay where you
are. Every pair runs in the tests and agrees to the digits it states. What the other sides need comes with
`pip install -e ".[benchmarks]"`.

All but one are the double pendulum with rods of one metre, released from rest at angles of 1 and 1.5:
"""

# %%
# ruff: noqa: E402  (every cell imports what it shows)
import jax
import jax.numpy as jnp
import numpy as np

import lagjax

jax.config.update("jax_enable_x64", True)
ts = jnp.linspace(0.0, 5.0, 51)
q0, qdot0 = np.array([1.0, 1.5]), np.zeros(2)


def L(q, qdot, params):
    (a, b), (da, db), (m1, m2) = q, qdot, params
    kinetic = 0.5 * (m1 + m2) * da**2 + 0.5 * m2 * db**2 + m2 * da * db * jnp.cos(a - b)
    return kinetic + 9.81 * ((m1 + m2) * jnp.cos(a) + m2 * jnp.cos(b))


double_pendulum, masses = lagjax.System(L), (1.0, 0.8)
ours = lagjax.simulate(double_pendulum, q0, qdot0, ts, masses).q

# %% [markdown]
"""
## diffrax

| there | here |
|---|---|
| `ODETerm(f)` | `System(L)`; f follows from L |
| `diffeqsolve(term, solver, t0, t1, dt0, y0, args)` | `simulate(system, q0, qdot0, ts, params)` |
| `SaveAt(ts=ts)`, `PIDController(rtol, atol)` | `ts`, `rtol=`, `atol=` |
| `solver`, `adjoint=`, `Event` | the same objects: `simulate(..., solver=, adjoint=, event=)` |
| `jax.vmap` around it | the same, or `simulate_batch` |
| `solution.result`, `throw=` | `trajectory.result`, `ok`, `throw=` |

**Stay** if you have a right-hand side and no Lagrangian, or an equation that is stochastic or controlled, or stiff.
lagjax itself integrates by diffrax on GPUs.

A loop of small operations, which the solution of an ODE is, costs more through XLA on CPUs since jaxlib 0.4.32 (issues
26145 and 40150 of jax, 615 of diffrax), and some projects stay below that version. The motion below this text, over ten
seconds at 1e-9, takes twice the CPU time under jax 0.10.1 that it took under 0.4.31, and its gradient by both masses 22
times; a `lax.scan` over Runge–Kutta steps 1.2 and 30 times. On jax 0.6.2, the last that can go back to the old runtime
(`XLA_FLAGS=--xla_cpu_use_thunk_runtime=false`), that does it: 1.1 instead of 10 ms. Machine code is called by XLA once
a motion, and is not touched: on jax 0.10.1 the gradient takes lagjax 0.6 ms and diffrax 22, which needed 1.0 on 0.4.31
(`python benchmarks/small_kernels.py --beside OTHER/bin/python`: CPU times, two interpreters in turns).
"""

# %%
import diffrax


def rates(t, y, masses):  # derived by hand
    (a, b, da, db), (m1, m2) = y, masses
    m, c, s = m1 + m2, m2 * jnp.cos(a - b), m2 * jnp.sin(a - b)
    f1, f2 = -s * db**2 - 9.81 * m * jnp.sin(a), s * da**2 - 9.81 * m2 * jnp.sin(b)
    return jnp.stack([da, db, (m2 * f1 - c * f2) / (m * m2 - c**2), (m * f2 - c * f1) / (m * m2 - c**2)])


controller, save = diffrax.PIDController(rtol=1e-10, atol=1e-12), diffrax.SaveAt(ts=ts)
y0 = jnp.concatenate([q0, qdot0])
solution = diffrax.diffeqsolve(
    diffrax.ODETerm(rates), diffrax.Dopri8(), 0.0, 5.0, None, y0, masses, saveat=save, stepsize_controller=controller
)
print(f"diffrax and lagjax differ by {abs(solution.ys[:, :2] - ours).max():.0e}")  # below 1e-8

# %% [markdown]
"""
## heyoka

| there | here |
|---|---|
| `make_vars`, expressions | arguments of a JAX function |
| `hy.lagrangian(L, q, v)` | `System(L)` |
| `taylor_adaptive(sys, state, tol=)` | `simulate(..., rtol=)`: Taylor series by LLVM, too |
| `propagate_grid(ts)` | `ts` |
| `hy.par[i]` | `params`, any pytree |
| `taylor_adaptive_batch`, `ensemble_propagate_grid` | `simulate_batch` |
| `t_event`, `nt_event` | `event=`, or modes; `crossings` |
| `var_ode_sys` | `jax.grad`, `jax.jacobian`, of any order |

**Stay** for extended and quadruple precision, C++, one short trajectory after the other outside of `jit`, or a state
that is no mechanics.
"""

# %%
import heyoka as hy

names = hy.make_vars("a", "b", "da", "db")
a, b, da, db = names
m1, m2 = masses
kinetic = 0.5 * (m1 + m2) * da**2 + 0.5 * m2 * db**2 + m2 * da * db * hy.cos(a - b)
symbolic = kinetic + 9.81 * ((m1 + m2) * hy.cos(a) + m2 * hy.cos(b))
integrator = hy.taylor_adaptive(hy.lagrangian(symbolic, [a, b], [da, db]), [*q0, *qdot0], tol=1e-15)
grid = integrator.propagate_grid(np.array(ts))[-1]
print(f"heyoka and lagjax differ by {abs(grid[:, :2] - ours).max():.0e}")  # below 1e-8

# %% [markdown]
"""
## SymPy mechanics, and SciPy

| there | here |
|---|---|
| `dynamicsymbols`, `LagrangesMethod(L, q)` | `System(L)`; no symbols, no formulas to print |
| `hol_coneqs`, `nonhol_coneqs` | `constraints=`, `velocity_constraints=` |
| `forcelist` | `forces=` |
| `mass_matrix`, `forcing`, `lambdify` | `system.mass_matrix(q, qdot)`, `system.acceleration(q, qdot)` |
| `linearize` | `linearize`, `normal_modes` |
| `solve_ivp(f, span, y0, "DOP853", t_eval, rtol=, atol=)` | `simulate(system, q0, qdot0, ts, params, rtol=, atol=)` |
| `events` | `event=`, `crossings` |
| `least_squares` around it | `fit` |

**Stay** with SymPy if you want the formulas; with SciPy if one motion of a known right-hand side is all you need, or if
it is stiff (Radau, BDF).
"""

# %%
import sympy
from scipy.integrate import solve_ivp
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

q, v = dynamicsymbols("a b"), dynamicsymbols("a b", 1)
m1, m2 = masses
kinetic = 0.5 * (m1 + m2) * v[0] ** 2 + 0.5 * m2 * v[1] ** 2 + m2 * v[0] * v[1] * sympy.cos(q[0] - q[1])
method = LagrangesMethod(kinetic + 9.81 * ((m1 + m2) * sympy.cos(q[0]) + m2 * sympy.cos(q[1])), q)
method.form_lagranges_equations()
parts = sympy.lambdify([[*q, *v]], [method.mass_matrix, method.forcing])


def field(t, y):
    mass, force = parts(y)
    return np.append(y[2:], np.linalg.solve(mass, force))


run = solve_ivp(field, (0.0, 5.0), np.append(q0, qdot0), "DOP853", t_eval=np.array(ts), rtol=1e-11, atol=1e-11)
print(f"SciPy and lagjax differ by {abs(run.y[:2].T - ours).max():.0e}")  # below 1e-8

# %% [markdown]
"""
## MuJoCo and MJX

| there | here |
|---|---|
| a model in MJCF or URDF | a function L(q, qdot); `examples/robot.py` makes one from URDF |
| `data.qpos`, `data.qvel` | `q`, `qdot` |
| `mj_step` with a fixed `timestep` | `simulate`, adaptive; `dt=` for fixed steps |
| `equality`, `tendon` | `constraints=` |
| `mj_fullM`, `qfrc_bias` | `system.mass_matrix`, and `∂L/∂q` by `jax.grad` |
| contacts of shapes | `System(contacts=…)`: gaps that you write down, rigid, with their impacts and friction |
| `mjx.step` under `vmap` on a GPU | `simulate_batch`, on CPUs in machine code |

**Stay** if meshes collide, if hundreds of contacts hold at once, if control at coarse fixed steps is the task, or for
its viewer. Come for digits, for forces that no model file has, and for derivatives that are those of the motion and not
of its steps.
"""

# %%
import mujoco

model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.0005" integrator="RK4" gravity="0 0 -9.81"/>
<compiler angle="radian"/><worldbody><body><joint axis="0 -1 0"/>
<inertial pos="0 0 -1" mass="1.0" diaginertia="1e-9 1e-9 1e-9"/><body pos="0 0 -1"><joint axis="0 -1 0"/>
<inertial pos="0 0 -1" mass="0.8" diaginertia="1e-9 1e-9 1e-9"/></body></body></worldbody></mujoco>""")
data = mujoco.MjData(model)
data.qpos = [q0[0], q0[1] - q0[0]]  # the second angle is measured from the first rod
mujoco.mj_step(model, data, 2000)  # one second
print(
    f"MuJoCo and lagjax differ by {abs(np.cumsum(data.qpos) - ours[10]).max():.0e}"
)  # below 1e-7: its bodies have a size

# %% [markdown]
"""
## REBOUND

| there | here |
|---|---|
| `sim.add(m=, a=, e=)` | `q0`, `qdot0`; `scenes.n_body`, `scenes.kepler`, `scenes.solar_system` |
| `sim.integrate(t)` with IAS15 | `simulate(..., rtol=1e-12)` |
| WHFast, MERCURIUS, TRACE | none: no symplectic integrator of planetary systems |
| `reboundx` forces, post-Newtonian terms | terms of L: `scenes.solar_system` has them |
| variational particles, MEGNO | `jax.jacobian`; `lyapunov_exponent` |
| transit times by bisection | `crossings`, `Timings`, with derivatives |

**Stay** for millions of orbits at modest accuracy, collisions, tides and discs.
"""

# %%
import rebound

sim = rebound.Simulation()
sim.add(m=1.0)
sim.add(m=1e-3, a=1.0, e=0.3)
sim.add(m=2e-3, a=1.9, e=0.1, f=2.0)
sim.move_to_com()
masses3 = np.array([p.m for p in sim.particles])
x0, v0 = (np.array([getattr(p, kind) for p in sim.particles])[:, :2] for kind in ("xyz", "vxyz"))


def planets(x, v, params):
    pairs = [(0, 1), (0, 2), (1, 2)]
    potential = -sum(params[i] * params[j] / jnp.linalg.norm(x[i] - x[j]) for i, j in pairs)
    return 0.5 * params @ jnp.sum(v**2, axis=1) - potential


sim.integrate(100.0)
end = lagjax.simulate(lagjax.System(planets), x0, v0, jnp.array([0.0, 100.0]), masses3, rtol=1e-13).q[-1]
theirs = np.array([p.xyz for p in sim.particles])[:, :2]
print(f"REBOUND and lagjax differ by {abs(theirs - end).max():.0e}")  # below 1e-10
