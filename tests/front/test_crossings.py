"""Crossings of a section: every one of them, where and when it is in closed form, and how it varies."""

import functools

import jax
import jax.numpy as jnp
import lagrangians
import numpy as np
import pytest
from scenes import EDGE, FREE, FREE_POINTS, HENON_HEILES, KEPLER, PENDULUM, SPRING_K, VALLEY, in_potential
from scipy.special import ellipk

import lagjax


def position(q, v):
    return q


def height(q, v, params):
    return q - 0.3


def of_free(section, end=1.0, **options):
    """Those of q = t."""
    return lagjax.crossings(FREE, section, 0.0, 1.0, jnp.array([0.0, end]), **options)


def times(found):
    return np.asarray(found.t[: int(found.count)])


# ---- where and when --------------------------------------------------------------------------------------------------


def test_the_period_of_a_pendulum():
    # From rest at 2: it passes the bottom after odd quarters of 4 K(sin 1).
    period = 4 * ellipk(np.sin(1.0) ** 2)
    found = lagjax.crossings(PENDULUM, position, 2.0, 0.0, jnp.array([0.0, 20.2 * period]), rtol=1e-15)
    expected = (np.arange(40) + 0.5) * period / 2
    assert found.ok and found.count == 40 and found.t.shape == (64,) and np.isnan(found.t[40:]).all()
    # Half a unit in the last place a step, carried along with the phase.
    np.testing.assert_allclose(found.t[:40], expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(found.qdot[:40], -2 * np.sin(1.0) * (-1.0) ** np.arange(40), rtol=1e-12)
    assert abs(found.q[:40]).max() < 1e-15


@pytest.mark.slow
def test_apses_of_an_orbit():
    # Where r r' changes sign: at the pericentre it rises, at the apocentre it falls. Back in time the other way round.
    kepler = KEPLER
    e = 0.6
    start = np.array([1 - e, 0.0]), np.array([0.0, np.sqrt((1 + e) / (1 - e))])
    sections = {"near": lambda q, v: q @ v, "far": lambda q, v: q @ v}
    ts = jnp.array([0.0, 20.0])
    found = lagjax.crossings(kepler, sections, *start, ts, direction={"near": 1, "far": -1}, rtol=1e-14)
    np.testing.assert_allclose(times(found["near"]), 2 * np.pi * np.arange(1, 4), rtol=1e-12)
    np.testing.assert_allclose(times(found["far"]), np.pi * np.arange(1, 7, 2), rtol=1e-12)
    np.testing.assert_allclose(found["far"].q[:3], np.outer(np.ones(3), [-1 - e, 0.0]), atol=1e-11)
    back = lagjax.crossings(kepler, sections["far"], *start, -ts, direction=1, rtol=1e-14)
    np.testing.assert_allclose(times(back), -np.pi * np.arange(1, 7, 2), rtol=1e-12)


def test_two_crossings_within_one_step():
    # Free steps grow to the whole time; the section is a dip of width w, of which no sample knew.
    for w in (1e-2, 1e-4, 1e-6):
        ts = jnp.array([0.0, 20.0])
        found = lagjax.crossings(FREE, lambda q, v, params: 0.5 - 1 / (1 + ((q - 7.3) / params) ** 2), 0.0, 1.0, ts, w)
        np.testing.assert_allclose(times(found), 7.3 + w * np.array([-1.0, 1.0]), rtol=1e-12)
    found = of_free(lambda q, v: (q - 0.47) ** 2 - 1e-6**2)
    np.testing.assert_allclose(times(found), 0.47 + 1e-6 * np.array([-1.0, 1.0]), rtol=1e-14)


@pytest.mark.parametrize("apart", [1e-6, 1e-9])
def test_a_pair_of_crossings_far_nearer_than_the_rounding_of_a_long_step(apart):
    """In one step of a free flight the section is known to 1e-13 of its size; between the two it is −apart²/4."""
    free = FREE
    found = lagjax.crossings(
        free, lambda q, qdot, params: (q - 2.5) * (q - 2.5 - params), -1.0, 1.0, jnp.array([0.0, 10.0]), apart
    )
    assert found.count == 2
    np.testing.assert_allclose(found.t[:2], [3.5, 3.5 + apart], atol=1e-15 + 0.1 * apart)


def test_many_crossings_within_one_step():
    roots = np.array([0.2, 0.2 + 1e-5, 0.5, 0.61, 0.6100001, 0.9])
    found = of_free(lambda q, v: jnp.prod(q - roots), rtol=1e-12)
    np.testing.assert_allclose(times(found), roots, rtol=1e-8)
    down = of_free(lambda q, v: jnp.prod(q - roots), direction=-1)
    np.testing.assert_allclose(times(down), roots[::2], rtol=1e-8)
    wave = of_free(lambda q, v, t: jnp.sin(200 * np.pi * t + 1.0), count=300)
    np.testing.assert_allclose(times(wave), (np.arange(1, 201) - 1 / np.pi) / 200, rtol=1e-13)


def test_touching_is_not_crossing():
    sections = {
        "from above": lambda q, v: (q - 0.47) ** 2,
        "from below": lambda q, v: -((q - 0.5) ** 2),
        "nearly": lambda q, v: 1e-9 + (q - 0.47) ** 2,
        "a wave": lambda q, v, t: 1 + jnp.cos(3 * jnp.pi * t),
        "flatly": lambda q, v: (q - 0.3) ** 4,
        "with a corner": lambda q, v: abs(q - 0.47),
        "and staying": lambda q, v: jnp.maximum(0.6 - q, 0.0),
        "from a rest on it": lambda q, v: jnp.maximum(q - 0.6, 0.0),
        "all along": lambda q, v, t: q - t,
        "not at all": lambda q, v: v - 1.0 + 0.0 * q,
    }
    found = of_free(sections)
    assert {name: int(crossed.count) for name, crossed in found.items()} == dict.fromkeys(sections, 0)


def test_a_section_in_pieces():
    sections = {
        "a band": lambda q, v: abs(q - 0.5) - 0.2,
        "two slopes": lambda q, v: jnp.where(q < 0.5, 3.0, 0.5) * (q - 0.5),
        "a jump": lambda q, v: jnp.where(q < 0.4, 1.0, -2.0),
        "a stair": lambda q, v: jnp.floor(5 * q) - 1.5,
        "a saw": lambda q, v, t: jnp.mod(t, 0.25) - 0.1,
        "the larger": lambda q, v: jnp.maximum(q - 0.8, 0.1 - q),
    }
    found = of_free(sections)
    expected = {
        "a band": [0.3, 0.7], "two slopes": [0.5], "a jump": [0.4], "a stair": [0.4],
        "a saw": [0.1, 0.25, 0.35, 0.5, 0.6, 0.75, 0.85], "the larger": [0.1, 0.8],
    }  # fmt: skip
    for name, ts in expected.items():
        np.testing.assert_allclose(times(found[name])[: len(ts)], ts, rtol=1e-14, err_msg=name)
        assert found[name].count <= len(ts) + (name == "a saw")  # and at the very end, to rounding


# On a circle from the angle −1 the cut is at 1 + π, and so on; q = t passes the pole of arctan(1/(q − 0.4)) at 0.4.
POLAR_ORBIT = lagjax.System(lambda q, v: 0.5 * v @ v + 1 / jnp.linalg.norm(q))


def test_angles_as_sections():
    sections = {
        "arctan2": lambda q, v: jnp.arctan2(q[1], q[0]),
        "wrapped": lambda q, v: jnp.mod(jnp.arctan2(q[1], q[0]) + jnp.pi, 2 * jnp.pi) - jnp.pi,
        "arctan": lambda q, v: jnp.arctan(q[1] / q[0]) - 1,
    }
    start, ts = jnp.array([np.cos(1), -np.sin(1)]), jnp.array([0.0, 8.0])
    found = lagjax.crossings(POLAR_ORBIT, sections, start, jnp.array([np.sin(1), np.cos(1)]), ts)
    expected = {"arctan2": [1, 1 + np.pi, 1 + 2 * np.pi], "arctan": [2, 1 + np.pi / 2, 2 + np.pi, 1 + 3 * np.pi / 2]}
    for name, where in (*expected.items(), ("wrapped", expected["arctan2"])):
        np.testing.assert_allclose(times(found[name])[: len(where)], np.sort(where)[: len(where)], rtol=1e-8)


@pytest.mark.parametrize("mode", [jax.jacrev, pytest.param(jax.jacfwd, marks=pytest.mark.slow)])
def test_a_jump_varies_as_its_border(mode):
    # x = t passes √p, where the section jumps through zero whatever its own slopes are: dt/dp = 1/(2 √p).
    scene = FREE_POINTS
    section = lambda q, v, params: jnp.where(q[0] ** 2 > params, 1.0 + q[1], q[1] - 1.0)

    def first(p):
        start = np.array([0.0, 0.1]), np.array([1.0, 0.05])
        return lagjax.crossings(scene, section, *start, np.array([0.0, 3.0]), p).t[0]

    slopes = first(2.0), *jax.jit(lambda p: (mode(first)(p), jax.grad(mode(first))(p)))(2.0)
    np.testing.assert_allclose(slopes, [np.sqrt(2), 0.5 / np.sqrt(2), -0.25 * 2**-1.5], rtol=1e-9)


def test_a_section_on_a_border_of_the_force():
    # V = |q| from rest at 1/2: at the corner after odd seconds, with speeds ±1; and so for another section there.
    corner = VALLEY
    sections = {"q": position, "sine": lambda q, v: jnp.sin(q), "size": lambda q, v: abs(q)}
    found = lagjax.crossings(corner, sections, 0.5, 0.0, jnp.array([0.0, 10.5]))
    for name in ("q", "sine"):
        np.testing.assert_allclose(times(found[name]), np.arange(1.0, 11.0, 2.0), rtol=1e-13)
        np.testing.assert_allclose(found[name].qdot[:5], -((-1.0) ** np.arange(5)), rtol=1e-13)
    assert found["size"].count == 0


def test_borders_of_the_force_and_of_the_section_at_one_place():
    # V = |q| from rest at a: q falls through 0 at √(2a) and rises at 3 √(2a). The section jumps there, and beyond.
    corner = VALLEY
    run = lambda a: lagjax.crossings(corner, lambda q, v: jnp.mod(q, 1.0) - 0.25, a, 0.0, jnp.array([0.0, 2.8]))
    starts = np.linspace(0.3, 0.9, 13)
    found = jax.vmap(run)(starts)
    for k, level in enumerate((0.25, 0.0)):  # to 1/4, and to 0, where it jumps from −1/4 to 3/4
        np.testing.assert_allclose(found.t[:, k], np.sqrt(2 * (starts - level)), rtol=1e-12)
    assert found.ok.all()


@pytest.mark.slow
def test_a_start_on_the_section():
    run = lambda q, v: lagjax.crossings(SPRING_K, lambda q, v: q - 0.1, q, v, jnp.array([0.0, 6.2]), 1.0)
    found = jax.vmap(run)(jnp.array([0.1, 0.1, 0.1 + 1e-17, 0.1]), jnp.array([1.0, -1.0, -1.0, 0.0]))
    # q = A sin(t + φ): again where t + φ = π − φ, or at the other end.
    phase = np.arctan2(0.1, 1.0)
    np.testing.assert_allclose(found.t[:3, 0], [np.pi - 2 * phase, np.pi + 2 * phase, np.pi + 2 * phase], rtol=1e-9)
    assert found.count.tolist() == [1, 1, 1, 0]


# The speed has no series at rest: it is looked at a little later. It is t, and crosses 0.3 then.
FALL = lagjax.System(lambda q, v: 0.5 * v @ v + q[0])


@pytest.mark.slow
def test_a_root_at_the_start():
    speed = lambda q, v: jnp.sqrt(v @ v) - 0.3
    found = lagjax.crossings(FALL, speed, jnp.zeros(2), jnp.zeros(2), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(times(found), [0.3], rtol=1e-13)


# A pendulum of length 1 in Cartesian coordinates, and its angle.
ROD = lagjax.System(lambda q, v: 0.5 * v @ v - q[1], constraints=lambda q: q @ q - 1.0)


@pytest.mark.slow
def test_a_constrained_motion():
    start = np.array([np.sin(2.0), -np.cos(2.0)])
    found = lagjax.crossings(ROD, lambda q, v: q[0], start, jnp.zeros(2), jnp.array([0.0, 12.0]), rtol=1e-12)
    quarter = ellipk(np.sin(1.0) ** 2)
    np.testing.assert_allclose(times(found), quarter * np.array([1.0, 3.0, 5.0]), rtol=1e-10)
    np.testing.assert_allclose(found.q[:3], np.outer(np.ones(3), [0.0, -1.0]), atol=1e-12)


# ---- transformations -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_how_crossings_vary():
    # q = cos(w t), w = √k, at 0.3: t = (2πn ± acos 0.3)/w, by k −t/2k; and by q⁰, where cos(w t) = 0.3/q⁰.
    def found(x):
        one = lagjax.crossings(SPRING_K, height, x[0], 0.0, jnp.array([0.0, 7.0]), x[1], count=3, rtol=1e-12)
        return jnp.concatenate([one.t[:2], one.q[:2], one.qdot[:2]])

    def closed(x):
        w, angle = jnp.sqrt(x[1]), jnp.arccos(0.3 / x[0])
        t = jnp.stack([angle, 2 * jnp.pi - angle]) / w
        return jnp.concatenate([t, jnp.full(2, 0.3), -x[0] * w * jnp.sin(w * t)])

    x = np.array([[1.0, 1.0], [1.2, 0.9], [0.8, 1.1]])
    np.testing.assert_allclose(jax.vmap(found)(x), jax.jit(jax.vmap(closed))(x), atol=1e-10)
    expected = jax.jit(jax.vmap(jax.jacfwd(closed)))(x)
    for mode in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(jax.vmap(mode(found)))(x), expected, atol=1e-9)
    second = jax.jit(jax.jacfwd(jax.jacrev(found)))(x[1])
    np.testing.assert_allclose(second, jax.jit(jax.jacfwd(jax.jacfwd(closed)))(x[1]), atol=1e-7)


@pytest.mark.slow
def test_derivatives_by_the_times_and_of_what_is_not_there():
    def first(ts):
        return lagjax.crossings(SPRING_K, height, 1.0, 0.0, ts, 1.0, count=2).t

    ts = jnp.array([0.5, 3.0])
    np.testing.assert_allclose(jax.jacrev(first)(ts)[0], [1.0, 0.0], atol=1e-8)
    assert np.isnan(jax.jacrev(first)(ts)[1]).all() and np.isnan(first(ts)[1])


# The force is 2 left of 0 and 0 right of it: from −1 at rest, t = 1 and v = 2 at 0; by the start −1/2 and −1.
PUSHED_BEYOND_ZERO = lagjax.System(lagrangians.free_particle, forces=lambda q, v: jnp.where(q < 0, 2.0, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_at_a_border_derivatives_are_those_before_it_on_both_sides(mode):
    def at(q0):
        found = lagjax.crossings(PUSHED_BEYOND_ZERO, position, q0, 0.0, jnp.array([0.0, 3.0]), count=1)
        return jnp.stack([found.t[0], found.qdot[0], found.q[0]])

    np.testing.assert_allclose(at(-1.0), [1.0, 2.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(mode(at)(-1.0), [-0.5, -1.0, 0.0], atol=1e-12)


TWO_SPRINGS = lagjax.System(lambda q, v: 0.5 * (v["x"] @ v["x"] + v["y"] ** 2) - 0.5 * (q["x"] @ q["x"] + q["y"] ** 2))


@pytest.mark.slow
def test_a_pytree_of_coordinates_and_one_batch():
    run = lambda a: lagjax.crossings(
        TWO_SPRINGS, lambda q, v: q["y"], {"x": a * jnp.ones(2), "y": a}, {"x": jnp.zeros(2), "y": 0.0},
        jnp.array([0.0, 5.0]), count=4,
    )  # fmt: skip
    found = jax.jit(jax.vmap(run))(jnp.linspace(0.5, 1.5, 20))
    assert found.q["x"].shape == (20, 4, 2) and found.qdot["y"].shape == (20, 4) and found.count.tolist() == [2] * 20
    np.testing.assert_allclose(found.t[:, :2], np.outer(np.ones(20), np.pi * np.array([0.5, 1.5])), rtol=1e-9)
    np.testing.assert_array_equal(found.t[3], run(np.linspace(0.5, 1.5, 20)[3]).t)


@pytest.mark.slow
def test_ten_times_the_size():
    # 64 oscillators of frequencies 1 … 2, a thousand members of different phase; ten sections.
    w = np.linspace(1.0, 2.0, 64)
    scene = in_potential(lambda q: 0.5 * (w * q) @ (w * q))
    sections = {str(i): functools.partial(lambda q, v, i: q[i], i=i) for i in range(0, 60, 6)}
    run = lambda a: lagjax.crossings(
        scene, sections, jnp.cos(w * a), -w * jnp.sin(w * a), jnp.array([0.0, 20.0]), count=13, rtol=1e-11
    )  # fmt: skip
    phases = np.linspace(0.01, 0.5, 1000)
    found = jax.vmap(run)(phases)
    for name in sections:
        k = np.pi * (np.arange(40) + 0.5) / w[int(name)] - np.asarray(phases)[:, None]
        k = np.where((k > 0) & (k < 20), k, np.nan)
        np.testing.assert_array_equal(found[name].count, np.isfinite(k).sum(axis=1))
        np.testing.assert_allclose(np.sort(found[name].t), np.sort(k)[:, :13], atol=1e-8)


@pytest.mark.slow
def test_a_poincare_section_against_a_tight_run():
    scene = HENON_HEILES
    q0, v0, ts = jnp.array([0.0, 0.1]), jnp.array([0.4, 0.05]), jnp.linspace(0.0, 100.0, 5001)
    found = lagjax.crossings(scene, lambda q, v: q[0], q0, v0, ts, direction=1, rtol=1e-13)
    dense = lagjax.simulate(scene, q0, v0, ts, rtol=1e-15)
    x = np.asarray(dense.q[:, 0])
    places = np.flatnonzero((x[1:-1] < 0) & (x[2:] >= 0)) + 1
    assert found.count == len(places)
    for k, t in enumerate(times(found)):
        assert ts[places[k]] <= t <= ts[places[k] + 1]
    again = lagjax.simulate(scene, q0, v0, np.concatenate([ts[:1], times(found)]), rtol=1e-15)
    np.testing.assert_allclose(again.q[1:], found.q[: len(places)], atol=1e-9)  # chaos takes some digits
    assert abs(found.q[: len(places), 0]).max() < 1e-15


# ---- what can be wrong -----------------------------------------------------------------------------------------------


def test_more_crossings_than_room():
    ts = jnp.array([0.0, 20.0])
    with pytest.raises(lagjax.SimulationError, match=r"more crossings.*Raise `count`") as raised:
        lagjax.crossings(SPRING_K, lambda q, v: q - 0.25, 1.0, 0.0, ts, 1.0, count=3)
    assert "The last state was q = 0.25;" in str(raised.value)  # that of the last crossing with room
    found = lagjax.crossings(SPRING_K, height, 1.0, 0.0, ts, 1.0, count=3, throw=False)
    assert not found.ok and found.count == 6 and np.isfinite(found.t).all() and found.t.shape == (3,)
    with pytest.raises(Exception, match="more crossings"):
        jax.block_until_ready(jax.jit(lambda k: lagjax.crossings(SPRING_K, height, 1.0, 0.0, ts, k, count=3).t)(1.0))


def test_thirty_sections_in_one_run():
    """More than a whole number has bits: a mass that moves by cos t comes to each height at its arc cosine."""
    heights = np.linspace(-0.9, 0.9, 30)
    sections = {f"{k:02d}": lambda q, v, height=height: q - height for k, height in enumerate(heights)}
    found = lagjax.crossings(SPRING_K, sections, 1.0, 0.0, jnp.array([0.0, 3.0]), 1.0, count=1)
    times = [float(found[name].t[0]) for name in sorted(sections)]
    np.testing.assert_allclose(times, np.arccos(heights), atol=1e-11)


def test_a_motion_that_fails():
    wall = EDGE
    with pytest.raises(lagjax.SimulationError, match="NaN or infinite"):
        lagjax.crossings(wall, lambda q, v: q - 0.5, 1.0, -1.0, np.array([0.0, 9.0]))
    found = lagjax.crossings(wall, lambda q, v: q - 0.5, 1.0, -1.0, jnp.array([0.0, 9.0]), throw=False)
    assert not found.ok and found.count == 1 and found.t[0] > 0
    with pytest.raises(lagjax.SimulationError, match="NaN or infinite"):  # of the section, amid the motion
        of_free(lambda q, v: jnp.sqrt(0.4 - q) * jnp.cos(30 * q) + 2.0)


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        ({"section": lambda q: q}, TypeError, "section must have the form"),
        ({"section": lambda q, v, mass: q}, TypeError, "section asks for `mass`"),
        ({"section": lambda q, v: q > 0}, TypeError, "one real number; got shape .* bool"),
        ({"section": lambda q, v: 1}, TypeError, "one real number; got shape .* int"),
        ({"section": lambda q, v: jnp.stack([q, v])}, TypeError, "one real number; got shape .2,."),
        ({"section": lambda q, v: (q, v)}, TypeError, "one real number; got tuple"),
        ({"section": lambda q, v, params: params}, ValueError, "neither the state nor the time"),
        ({"section": {"a": position, "b": lambda q, v: 0.5}}, ValueError, r"section\['b'\] depends on neither"),
        ({"section": {}}, ValueError, "empty dict"),
        ({"section": None}, TypeError, "section must be a function"),
        ({"direction": 2}, ValueError, "direction must be -1"),
        ({"direction": {"a": 1}}, ValueError, "the same names"),
        ({"count": 0}, ValueError, "count must be a positive integer"),
        ({"ts": np.array([0.0])}, ValueError, "at least two"),
        ({"throw": 1}, TypeError, "throw must be True or False"),
        ({"q0": np.nan}, ValueError, "q0 is nan"),
        ({"system": FREE.__class__}, TypeError, "System"),
    ],
)
def test_bad_input_gets_a_sentence(changes, error, sentence):
    given = dict(system=SPRING_K, section=position, q0=1.0, qdot0=0.0, ts=np.array([0.0, 1.0]), params=1.0)
    with pytest.raises(error, match=sentence):
        lagjax.crossings(**(given | changes))
