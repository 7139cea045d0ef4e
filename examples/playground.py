"""A double pendulum to play with: sliders for lengths, masses, friction and the start, and the motion at once.

Every change runs forty pendulums in machine code, all but one a billionth of a radian off, and compiles nothing.

marimo run examples/playground.py             (pip install "lagjax[playground]")
"""

import marimo

app = marimo.App(width="full", app_title="A double pendulum to play with")


@app.cell
def _():
    import json
    import time

    import jax
    import jax.numpy as jnp
    import marimo as mo
    import matplotlib.pyplot as plt
    import numpy as np

    import lagjax

    jax.config.update("jax_enable_x64", True)
    return jax, jnp, json, lagjax, mo, np, plt, time


@app.cell
def _(jnp, lagjax, np):
    G, DURATION, OFF, COMPANY = 9.81, 20.0, 1e-9, 40

    def L(q, qdot, params):
        (a, b), (da, db) = q, qdot
        l1, l2, m1, m2 = (params[name] for name in ("l1", "l2", "m1", "m2"))
        kinetic = 0.5 * (m1 + m2) * (l1 * da) ** 2 + 0.5 * m2 * (l2 * db) ** 2
        kinetic += m2 * l1 * l2 * da * db * jnp.cos(a - b)
        return kinetic + (m1 + m2) * G * l1 * jnp.cos(a) + m2 * G * l2 * jnp.cos(b)

    def D(q, qdot, params):
        return 0.5 * params["friction"] * (qdot[0] ** 2 + (qdot[1] - qdot[0]) ** 2)

    pendulum = lagjax.System(L, dissipation=D)
    ts = jnp.linspace(0.0, DURATION, 1001)

    def motion(params, start):
        """The trajectory of forty pendulums from rest, the first of them from `start`, the others around it."""
        around = 2 * np.pi * np.arange(COMPANY) / (COMPANY - 1)
        off = OFF * np.stack([np.cos(around), np.sin(around)], axis=1)
        off[0] = 0.0
        numbers = {name: float(value) for name, value in params.items()}
        return lagjax.simulate_batch(pendulum, np.asarray(start) + off, np.zeros((COMPANY, 2)), ts, numbers)

    def first_flip(q):
        """When one of the arms first goes over the top, or None."""
        over = np.flatnonzero(np.abs(q).max(axis=1) > np.pi)
        return float(ts[over[0]]) if len(over) else None

    def divergence(q):
        """The largest distance of the company from the first pendulum (T,), and its rate of growth per second.

        The rate is the slope of its logarithm between 1e-8 and 1e-2, where it grows as the linear equations say.
        """
        distance = np.linalg.norm(q[1:] - q[:1], axis=2).max(axis=0)
        linear = np.flatnonzero((distance > 1e-8) & (distance < 1e-2))
        if len(linear) < 10 or distance.max() < 1e-6:
            return distance, None
        return distance, float(np.polyfit(np.asarray(ts)[linear], np.log(distance[linear]), 1)[0])

    return COMPANY, DURATION, G, OFF, divergence, first_flip, motion, ts


@app.cell
def _(mo):
    def slider(start, stop, step, value, label):
        return mo.ui.slider(start, stop, step, value, label=label, show_value=True)

    sliders = mo.ui.dictionary(
        {
            "l1": slider(0.2, 2.0, 0.05, 1.0, "length 1 [m]"),
            "l2": slider(0.2, 2.0, 0.05, 0.8, "length 2 [m]"),
            "m1": slider(0.1, 5.0, 0.1, 1.0, "mass 1 [kg]"),
            "m2": slider(0.1, 5.0, 0.1, 1.0, "mass 2 [kg]"),
            "friction": slider(0.0, 0.5, 0.01, 0.0, "friction [N m s]"),
            "angle1": slider(-180, 180, 1, 120, "start angle 1 [°]"),
            "angle2": slider(-180, 180, 1, 150, "start angle 2 [°]"),
        }
    )
    return (sliders,)


@app.cell
def _(divergence, first_flip, jax, motion, np, sliders, time):
    values = sliders.value
    params = {name: values[name] for name in ("l1", "l2", "m1", "m2", "friction")}
    start = np.radians([values["angle1"], values["angle2"]])
    began = time.perf_counter()
    trajectory = motion(params, start)
    q = np.asarray(jax.block_until_ready(trajectory.q))
    spent = time.perf_counter() - began
    energy = np.asarray(trajectory.energy())[0]
    distance, growth = divergence(q)
    flip = first_flip(q[0])
    return distance, energy, flip, growth, params, q, spent, trajectory


@app.cell
def _(DURATION, json, mo, np, params, q):
    PAGE = """<!doctype html><body style="margin:0;background:#fff"><canvas id="c" width="520" height="520"
    style="width:100%;max-width:520px"></canvas><script>
    const P = DATA, c = document.getElementById("c"), g = c.getContext("2d"), s = 240 / P.reach, n = P.x.length;
    const at = (p, k) => [260 + s * p[k][0], 260 - s * p[k][1]];
    function draw(k) {
      g.clearRect(0, 0, 520, 520);
      g.lineWidth = 2;
      for (let i = Math.max(1, k - 260); i <= k; i++) {
        g.strokeStyle = `rgba(213,94,0,${0.9 * (1 - (k - i) / 260)})`;
        g.beginPath(); g.moveTo(...at(P.y, i - 1)); g.lineTo(...at(P.y, i)); g.stroke();
      }
      g.strokeStyle = "rgba(86,180,233,0.35)"; g.lineWidth = 1.5;
      for (const f of P.company) { g.beginPath(); g.moveTo(...at(P.x, k)); g.lineTo(...at(f, k)); g.stroke(); }
      g.strokeStyle = "#222"; g.lineWidth = 4; g.lineCap = "round";
      g.beginPath(); g.moveTo(260, 260); g.lineTo(...at(P.x, k)); g.lineTo(...at(P.y, k)); g.stroke();
      g.fillStyle = "#222"; g.beginPath(); g.arc(260, 260, 5, 0, 7); g.fill();
      for (const [p, r] of [[P.x, P.r1], [P.y, P.r2]]) {
        g.fillStyle = "#0072B2"; g.beginPath(); g.arc(...at(p, k), r, 0, 7); g.fill();
      }
      g.fillStyle = "#555"; g.font = "16px sans-serif";
      g.fillText((P.duration * k / (n - 1)).toFixed(1) + " s", 12, 24);
    }
    let began = null;
    function frame(now) {
      began = began ?? now;
      const t = ((now - began) / 1000) % (P.duration + 1.5);
      draw(Math.min(n - 1, Math.round(t / P.duration * (n - 1))));
      requestAnimationFrame(frame);
    }
    draw(Math.min(n - 1, 200)); requestAnimationFrame(frame);
    </script></body>"""

    def bobs(q):
        first = params["l1"] * np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], axis=1)
        return first, first + params["l2"] * np.stack([np.sin(q[:, 1]), -np.cos(q[:, 1])], axis=1)

    first, second = bobs(q[0])
    drawn = {
        "x": np.round(first, 4).tolist(),
        "y": np.round(second, 4).tolist(),
        "company": [np.round(bobs(other)[1], 3).tolist() for other in q[1::8]],
        "reach": params["l1"] + params["l2"],
        "r1": 7 + 5 * params["m1"] ** (1 / 3),
        "r2": 7 + 5 * params["m2"] ** (1 / 3),
        "duration": DURATION,
    }
    animation = mo.iframe(PAGE.replace("DATA", json.dumps(drawn)), width="530px", height="530px")
    return (animation,)


@app.cell
def _(OFF, distance, energy, flip, growth, np, plt, q, ts):
    plt.close("all")
    figure, (angles, spread, stored) = plt.subplots(3, 1, figsize=(6.4, 6.2), sharex=True, layout="constrained")
    angles.plot(ts, q[0, :, 0] / (2 * np.pi), color="#0072B2", label="first arm")
    angles.plot(ts, q[0, :, 1] / (2 * np.pi), color="#D55E00", label="second arm")
    angles.set(ylabel="turns")
    angles.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    if flip is not None:
        angles.axvline(flip, color="0.5", linestyle=":")
        angles.annotate(" over the top", (flip, 1.03), xycoords=("data", "axes fraction"), color="0.35")
    spread.semilogy(ts, distance, color="#009E73")
    if growth is not None:
        spread.semilogy(ts, np.minimum(OFF * np.exp(growth * np.asarray(ts)), 10), "--", color="0.5")
    spread.set(ylabel="distance of the\nfarthest neighbour", ylim=(1e-10, 1e2))
    stored.plot(ts, energy, color="#CC79A7")
    middle = 0.5 * (energy.max() + energy.min())
    half = max(0.55 * np.ptp(energy), 0.5)
    stored.set(xlabel="t [s]", ylabel="energy [J]", ylim=(middle - half, middle + half), xlim=(0, float(ts[-1])))
    for _ax in (angles, spread, stored):
        _ax.spines[["top", "right"]].set_visible(False)
        _ax.grid(color="0.93")
    return (figure,)


@app.cell
def _(COMPANY, animation, energy, figure, flip, growth, mo, np, sliders, spent, trajectory):
    _kept = (
        f"{np.ptp(energy):.0e} J" if sliders.value["friction"] == 0 else f"from {energy[0]:.1f} to {energy[-1]:.1f} J"
    )
    _numbers = mo.hstack(
        [
            mo.stat(f"{1e3 * spent:.0f} ms", label=f"{COMPANY} motions", caption="of 20 s, at 1e-9"),
            mo.stat("none" if flip is None else f"{flip:.1f} s", label="first flip", caption="an arm over the top"),
            mo.stat(
                "no" if growth is None else f"{growth:.1f} /s",
                label="chaos",
                caption="growth of 1e-9 rad" if growth is None else f"tenfold every {np.log(10) / growth:.1f} s",
            ),
            mo.stat(_kept, label="energy", caption="varies" if sliders.value["friction"] == 0 else "friction takes it"),
        ],
        widths="equal",
        gap=1,
    )
    _said = mo.md("") if bool(trajectory.ok.all()) else mo.callout("Some members did not reach the end.", kind="warn")
    mo.vstack(
        [
            mo.md("# A double pendulum to play with"),
            _numbers,
            _said,
            mo.hstack([sliders.vstack(), animation, figure], widths=[0.9, 1.2, 1.4], gap=1, align="start"),
        ]
    )
    return


if __name__ == "__main__":
    app.run()
