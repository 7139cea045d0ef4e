"""Large scenes that meet walls: a long chain against SciPy, and against a short one, which its far end cannot tell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("scipy", reason="the references are computed with it")

from scipy.integrate import solve_ivp

import lagjax

K, WALL, E, MU = 20.0, 0.5, 0.8, 0.3
PARAMS = {"k": K, "wall": WALL, "e": E, "mu": MU}
TS = np.linspace(0.0, 1.2, 7)
FAR, NEAR = 1000, 60  # what happens at the last mass by 1.2 comes from the last 30, to 1e-16


def springs(q, v, params):
    return 0.5 * jnp.sum(v**2) - 0.5 * params["k"] * jnp.sum(jnp.diff(q, axis=0) ** 2)


def chain(contacts=lambda q, params: params["wall"] - q[-1], **options):
    restitution = 0.0 if contacts is None else lambda params: params["e"]
    return lagjax.System(springs, contacts=contacts, restitution=restitution, **options)


def start(count, q=0.0):
    """Counted from the end, the same for each chain."""
    return np.full(count, q), 1.0 + 0.3 * np.sin(np.arange(count)[::-1])


def reference(k, wall, e, v, until):
    """The instants of impacts and the state of the chain by SciPy, from q = 0."""
    n, y, t, times = len(v), np.append(np.zeros(len(v)), v), 0.0, []

    def rate(t, y):
        pull = k * np.diff(y[:n], prepend=y[0], append=y[n - 1])
        return np.append(y[n:], np.diff(pull))

    def hit(t, y):
        return wall - y[n - 1]

    hit.terminal, hit.direction = True, -1
    while t < until:
        run = solve_ivp(rate, (t, until), y, method="DOP853", rtol=1e-12, atol=1e-13, events=hit)
        t, y = run.t[-1], run.y[:, -1].copy()
        if run.status == 1:
            times.append(t)
            y[-1], y[n - 1] = -e * y[-1], wall - 1e-15
    return np.array(times), y


def test_a_thousand_springs_meet_a_wall():
    q0, v0 = start(FAR)
    trajectory = lagjax.simulate(chain(), q0, v0, TS, PARAMS, rtol=1e-12)
    times, y = reference(K, WALL, E, v0, TS[-1])
    impacts, v = trajectory.impacts, trajectory.qdot[-1]
    assert int(impacts.count) == len(times) > 1
    np.testing.assert_allclose(impacts.t[: len(times)], times, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.append(trajectory.q[-1], v), y, rtol=0, atol=1e-9)

    def energy(q, v):
        return 0.5 * np.sum(np.square(v)) + 0.5 * K * np.sum(np.diff(q) ** 2)

    np.testing.assert_allclose(np.nansum(impacts.impulse), v0.sum() - v.sum(), rtol=1e-10)
    lost = energy(q0, v0) - energy(trajectory.q[-1], v)
    np.testing.assert_allclose(np.nansum(impacts.energy_lost), lost, rtol=1e-10)


@pytest.mark.slow
def test_derivatives_of_a_thousand_springs_that_meet_a_wall():
    """Of the end and of the second instant, by k, the wall, e and the start, against differences of SciPy's."""
    q0, v0 = start(FAR)
    weights, along = np.cos(np.arange(FAR)), np.sin(0.7 * np.arange(FAR))
    weights[:-20] = 0.0

    def value(params, v):
        trajectory = lagjax.simulate(chain(), q0, v, TS, params, rtol=1e-12)
        return weights @ trajectory.q[-1] + trajectory.impacts.t[1]

    def differ(by, step):
        ends = []
        for sign in (1.0, -1.0):
            k, wall, e, v = (x + sign * step * change for x, change in zip((K, WALL, E, v0), by, strict=True))
            times, y = reference(k, wall, e, v, TS[-1])
            ends.append(weights @ y[:FAR] + times[1])
        return (ends[0] - ends[1]) / (2 * step)

    of_params, of_start = jax.grad(value, (0, 1))({"k": K, "wall": WALL, "e": E}, jnp.asarray(v0))
    found = [*(of_params[name] for name in ("k", "wall", "e")), of_start @ along]
    expected = [differ(row, 1e-5) for row in (*np.eye(4)[:3], (0, 0, 0, along))]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)  # 1e-12 of the reference, over 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    "contacts",
    [
        pytest.param(lambda q, params: params["wall"] - q[-3:], id="three masses"),
        pytest.param(lambda q, t, params: params["wall"] - 0.1 * jnp.sin(3.0 * t) - q[-1], id="moving"),
    ],
)
def test_a_long_chain_meets_walls_as_a_short_one_does(contacts):
    runs = [lagjax.simulate(chain(contacts), *start(count), TS, PARAMS, rtol=1e-12) for count in (FAR, NEAR)]
    count = int(runs[0].impacts.count)
    assert count == int(runs[1].impacts.count) > 1
    np.testing.assert_allclose(*(run.impacts.t[:count] for run in runs), rtol=0, atol=1e-10)
    np.testing.assert_allclose(*(run.qdot[:, -5:] for run in runs), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_long_chain_that_touches_at_the_start():
    runs = [lagjax.simulate(chain(), *start(count, q=WALL), TS, PARAMS, rtol=1e-12) for count in (FAR, NEAR)]
    assert runs[0].impacts.t[0] == 0
    np.testing.assert_allclose(*(run.qdot[:, -5:] for run in runs), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_mass_of_a_long_chain_rubs_along_a_wall():
    scene = chain(
        lambda q, params: params["wall"] - q[-1, 0], slip=lambda q, v: v[-1, 1], friction=lambda params: params["mu"]
    )
    runs = []
    for count in (FAR // 2, NEAR):
        q, v = start(count)
        state = np.stack([q, q], axis=1), np.stack([v, 0.5 * np.ones(count)], axis=1)
        runs.append(lagjax.simulate(scene, *state, TS, PARAMS, rtol=1e-12))
    np.testing.assert_allclose(*(run.qdot[:, -5:] for run in runs), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_ten_walls_in_a_long_chain_are_met_as_one_is():
    """Walls so far apart that none feels the others: each mass that meets one moves alike."""
    places = np.arange(50, FAR, 100)
    scene = chain(lambda q, params: params["wall"] - q[places])
    trajectory = lagjax.simulate(scene, np.zeros(FAR), 1.0 + 0.3 * np.sin(0.02 * np.pi * np.arange(FAR)), TS, PARAMS)
    met = np.asarray(trajectory.qdot)[:, places[2:-2]]
    assert int(trajectory.impacts.count) > 1
    np.testing.assert_allclose(met, met[:, :1] * np.ones(6), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_members_of_a_long_chain_under_vmap_and_jit_and_in_single_precision():
    walls, state = WALL + 0.01 * np.arange(8), start(FAR)

    def instant(wall):
        return lagjax.simulate(chain(), *state, TS, PARAMS | {"wall": wall}).impacts.t[0]

    single = [instant(wall) for wall in walls]
    np.testing.assert_allclose(jax.vmap(instant)(walls), single, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(instant)(walls[0]), single[0], rtol=1e-12)
    state = tuple(x.astype(np.float32) for x in state)
    assert abs(instant(walls[0]) - single[0]) < 1e-6


def test_who_explains_a_large_scene_with_contacts_names_the_solver_it_has():
    many = 2000
    facts = chain().explain(np.zeros(many), np.ones(many), params=PARAMS)
    assert facts.path == "scalar" and "machine code" in facts.solver and "None" not in str(facts)
    assert chain(None, path="array").explain(np.zeros(many), np.ones(many), params=PARAMS).path == "array"


FREE_BEFORE_A_WALL = lagjax.System(lambda q, v: 0.5 * v @ v, contacts=lambda q: 0.5 - q[-1])


def test_a_scene_that_does_not_fit_is_refused_in_a_sentence():
    with pytest.raises(ValueError, match=r"its mass matrix would take some .* GiB of memory"):
        lagjax.simulate(FREE_BEFORE_A_WALL, np.zeros(10**6), np.ones(10**6), TS)
