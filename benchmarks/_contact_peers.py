"""Three scenes of contacts in differentiable engines: MuJoCo's MJX and Brax (positional and spring), double precision.

    pip install mujoco-mjx brax     # in an environment of their own
    python _contact_peers.py [step]     # of time, 1e-3

It prints one row a scene and engine, as JSON: values and slopes of it, and those of the closed form.
"""

import importlib.metadata
import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
STEP = float(sys.argv[1]) if len(sys.argv) > 1 else 1e-3
GRAVITY = 9.81
# An elastic spring in the contact; half a period of it is 31 steps, over which MuJoCo's integrators keep the energy.
ELASTIC = 'solref="-10000 0" solimp="0.9999 0.9999 0.001 0.5 2"'
# A damper beside it, so that e = 0.5 where the force, which only pushes, has fallen to zero.
HALF = 'solref="-10000 -51.05512753176456" solimp="0.9999 0.9999 0.001 0.5 2"'


def scene(bodies: str, contact: str, elasticity: float, gravity: float = 0.0) -> str:
    """An MJCF file of balls of radius 0.1 that slide along an axis."""
    return f"""<mujoco><option timestep="{STEP}" gravity="0 0 -{gravity}" iterations="20" ls_iterations="20">
      <flag eulerdamp="disable"/></option>
      <custom><numeric name="elasticity" data="{elasticity}"/><numeric name="spring_mass_scale" data="0"/>
      <numeric name="vel_damping" data="0"/><numeric name="ang_damping" data="0"/></custom>
      <default><geom size="0.1" mass="1" condim="1" friction="0" {contact}/></default>
      <worldbody>{bodies}</worldbody></mujoco>"""


def ball(axis: str) -> str:
    """A ball that slides along an axis; its position is the joint's coordinate."""
    return f'<body><joint type="slide" axis="{axis}"/><geom type="sphere"/></body>'


FLOOR = '<geom type="plane" size="10 10 1"/>'
BALLS = ball("1 0 0") * 2


def mjx_end(text: str):
    """The end of a motion by MJX, a function of q0, v0 and the number of steps."""
    import mujoco
    from mujoco import mjx

    model = mjx.put_model(mujoco.MjModel.from_xml_string(text))
    data = mjx.make_data(model)

    def end(q, v, steps):
        def step(d, _):
            d = mjx.step(model, d)
            return d, None

        d, _ = jax.lax.scan(step, data.replace(qpos=q, qvel=v), None, steps)
        return jnp.concatenate([d.qpos, d.qvel])

    return end


def brax_end(pipeline: str):
    """The same by one of Brax's pipelines."""

    def of(text: str):
        from importlib import import_module

        from brax.io import mjcf

        run, system = import_module(f"brax.{pipeline}.pipeline"), mjcf.loads(text)

        def end(q, v, steps):
            state, _ = jax.lax.scan(
                lambda s, _: (run.step(system, s, jnp.zeros(system.act_size())), None),
                run.init(system, q, v), None, steps,
            )  # fmt: skip
            return jnp.concatenate([state.q, state.qd])

        return end

    return of


ENGINES = {"MJX": mjx_end, "Brax positional": brax_end("positional"), "Brax spring": brax_end("spring")}


def two_balls(engine) -> dict:
    """Two equal balls, e = 1, that meet at 0.4: x2 at 1 and its slopes by x1, x2, v1, v2."""
    end = engine(scene(BALLS, ELASTIC, 1.0))
    x2 = jax.jit(lambda x: end(x[:2], x[2:], round(1 / STEP))[1])
    x = jnp.array([0.0, 0.6, 1.0, 0.0])
    return {"value": float(x2(x)), "slopes": np.asarray(jax.jacfwd(x2)(x)).tolist(), "exact": [1.2, 1.0, 0.0, 1.0, 0.0]}


def drop(engine) -> dict:
    """Brax 317: a ball at -5 without gravity from 2.9 to 3 above a floor, e = 1: the height after 1, 101 of them."""
    end = engine(scene(FLOOR + ball("0 0 1"), ELASTIC, 1.0))
    h = jnp.linspace(2.9, 3.0, 101)
    final = jax.jit(jax.vmap(jax.value_and_grad(lambda h: end(h[None], jnp.full(1, -5.0), round(1 / STEP))[0])))
    try:
        values, slopes = final(h)
    except Exception:  # a loop of unknown length has no reverse mode

        def f(h):
            return end(h[None], jnp.full(1, -5.0), round(1 / STEP))[0]

        values, slopes = jax.jit(jax.vmap(lambda h: jax.jvp(f, (h,), (1.0,))))(h)
    values, slopes = np.asarray(values), np.asarray(slopes)
    exact = 5.0 - h + 0.2
    return {
        "largest error": float(abs(values - exact).max()), "largest jump": float(abs(np.diff(values) + 1e-3).max()),
        "slopes from": float(slopes.min()), "slopes to": float(slopes.max()), "exact": -1.0,
    }  # fmt: skip


def bounce(engine) -> dict:
    """A ball of e = 0.5 that falls 1: the height at 1, after two bounces, by its first height and velocity."""
    end = engine(scene(FLOOR + ball("0 0 1"), HALF, 0.5, GRAVITY))
    f = jax.jit(lambda x: end(x[:1], x[1:], round(1 / STEP)))
    x = jnp.array([1.1, 0.0])

    def exact(x):
        h, v = x[0] - 0.1, x[1]
        u = jnp.sqrt(v * v + 2 * GRAVITY * h)
        t = (v + u) / GRAVITY + 2 * 0.5 * u / GRAVITY
        w = 0.25 * u
        return 0.1 + w * (1 - t) - GRAVITY * (1 - t) ** 2 / 2

    return {
        "value": float(f(x)[0]), "slopes": np.asarray(jax.jacfwd(f)(x))[0].tolist(),
        "exact": [float(exact(x)), *np.asarray(jax.grad(exact)(x)).tolist()],
    }  # fmt: skip


def main() -> None:
    """All scenes in all engines."""
    rows = []
    for name, engine in ENGINES.items():
        for call in (two_balls, drop, bounce):
            start = time.perf_counter()
            try:
                row = call(engine)
            except Exception as error:
                row = {"failed": f"{type(error).__name__}: {str(error).strip().splitlines()[0][:160]}"}
            rows.append({"scene": call.__name__, "engine": name, "first s": time.perf_counter() - start} | row)
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    versions = {x: importlib.metadata.version(x) for x in ("mujoco", "mujoco-mjx", "brax", "jax")}
    print(json.dumps({"versions": versions, "step": STEP, "rows": rows}))


if __name__ == "__main__":
    main()
