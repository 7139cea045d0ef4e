"""Periodic orbits and their families: closed forms, published digits, pairs of multipliers, what cannot be found."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OSCILLATORS, PENDULUM, PENDULUM_IN_GRAVITY
from scipy.special import ellipk

import lagjax
from lagjax._analysis.orbits import _floquet, _orbit


def _henon_heiles(q, v):
    return 0.5 * v @ v - 0.5 * q @ q - q[0] ** 2 * q[1] + q[1] ** 3 / 3


HENON_HEILES = lagjax.System(_henon_heiles)


def _bodies(q, v):
    a, b, c = q
    distances = [jnp.sqrt(jnp.sum((x - y) ** 2)) for x, y in ((a, b), (a, c), (b, c))]
    return 0.5 * jnp.sum(v**2) + sum(1 / d for d in distances)


BODIES = lagjax.System(_bodies)
HOLE = lagjax.System(lambda q, v: 0.5 * v @ v + 1 / (jnp.sqrt(q @ q) - 2))


def eight():
    v = np.array([0.3471168881, 0.5327249454])  # ten published digits
    return np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), np.stack([v, v, -2 * v]), 6.3259139829


def test_the_period_of_a_pendulum():
    orbit = lagjax.periodic_orbit(PENDULUM, 1.0, 0.0, 6.5)
    modulus = (PENDULUM.energy(orbit.q0, orbit.qdot0) + 1) / 2  # sin² of half the amplitude
    assert orbit.ok and orbit.stable and orbit.closure < 1e-14
    np.testing.assert_allclose(orbit.period, 4 * ellipk(modulus), rtol=1e-14)
    np.testing.assert_array_equal(orbit.multipliers, 1.0)  # one degree of freedom: all are known


@pytest.mark.slow
def test_a_batch_at_an_energy_and_its_failures():
    q0, qdot0 = np.array([1.0, 0.1, 2.0]), np.array([0.0, 0.0, 0.0])
    orbits = lagjax.periodic_orbit(PENDULUM, q0, qdot0, np.array([6.5, 2.0, 7.0]), energy=-0.5)
    # By energy the middle one becomes as large as the others, or says that it does not.
    assert orbits.ok[0] and orbits.ok[2] and orbits.q0.shape == (3,)
    np.testing.assert_allclose(np.asarray(orbits.period)[np.asarray(orbits.ok)], 4 * ellipk(0.25), rtol=1e-13)
    assert all((text == "") == bool(ok) for text, ok in zip(orbits.message, orbits.ok, strict=True))


def test_multipliers_that_rounding_has_spoilt_are_not_judged(monkeypatch):
    monkeypatch.setattr(_orbit, "multipliers_of", lambda *_: np.array([1.0, 0.9]))
    orbit = lagjax.periodic_orbit(PENDULUM, 1.0, 0.0, 6.5)
    assert orbit.ok and not orbit.stable and "miss it by 0.1" in orbit.message


def test_up_to_an_image():
    # Once around: the angle returns one turn ahead.
    orbit = lagjax.periodic_orbit(PENDULUM, 0.0, 3.0, 2.5, image=lambda q, v: (q + 2 * jnp.pi, v), energy=3.5)
    modulus = 2 / (3.5 + 1)
    np.testing.assert_allclose(orbit.period, 2 * np.sqrt(modulus) * ellipk(modulus), rtol=1e-13)


def test_an_equilibrium_is_no_orbit():
    with pytest.raises(lagjax.SimulationError, match="ended at an equilibrium"):
        lagjax.periodic_orbit(PENDULUM, 0.1, 0.0, 3.5)


def test_what_cannot_be_asked():
    with pytest.raises(ValueError, match="period must be positive"):
        lagjax.periodic_orbit(PENDULUM, 0.1, 0.0, -1.0)
    with pytest.raises(ValueError, match="members as its first axis"):
        lagjax.periodic_orbit(PENDULUM, 0.1, 0.0, np.ones(3))
    with pytest.raises(ValueError, match="must be affine"):
        lagjax.periodic_orbit(PENDULUM, 0.1, 0.0, 6.0, image=lambda q, v: (q**2, v))


def test_a_search_is_not_traced():
    with pytest.raises(TypeError, match="search outside of jit"):
        jax.jit(lambda a: lagjax.periodic_orbit(PENDULUM, a, 0.0, 6.5).period)(1.0)
    with pytest.raises(TypeError, match=r"instead of jax\.vmap"):
        jax.vmap(lambda a: lagjax.periodic_orbit(PENDULUM, a, 0.0, 6.5).period)(np.ones(2))


def test_an_orbit_in_three_lines():
    orbit = lagjax.periodic_orbit(PENDULUM, 1.0, 0.0, 6.5)
    assert len(repr(orbit).splitlines()) == 3 and "stable" in repr(orbit) and type(orbit.message) is str
    batch = lagjax.periodic_orbit(PENDULUM, np.array([1.0, 0.1]), np.zeros(2), np.array([6.5, 3.5]))
    assert "1 of 2 close" in repr(batch) and "member 1" in repr(batch)
    assert repr(jax.tree.map(lambda leaf: None, batch)).startswith("Orbit")  # of axes, say


def test_multipliers_of_many_arcs():
    # Arcs that turn and stretch, of a matrix with multipliers 1e9 … 1e-9: few products, and all digits of the small.
    rng = np.random.default_rng(0)
    bases = np.linalg.qr(rng.normal(size=(64, 4, 4)))[0]
    stretch = np.exp(np.array([1.0, 0.02, -0.02, -1.0]) * np.log(1e9) / 64)
    arcs = np.stack([bases[(k + 1) % 64] @ np.diag(stretch) @ bases[k].T for k in range(64)])
    values = np.sort(np.abs(_floquet.multipliers_of(_floquet.ReducedArcs(arcs, 0), True)))
    np.testing.assert_allclose(values, stretch[::-1] ** 64, rtol=1e-10)
    assert len(_floquet._merge_factors(arcs)) < 8


def test_multipliers_of_henon_heiles():
    # By symmetry x = 0 is a plane of motions; their multipliers are those of Hill's equation ẍ = −(1 + 2y) x.
    orbit = lagjax.periodic_orbit(HENON_HEILES, np.array([0.0, 0.3]), np.zeros(2), 6.6)
    first, second, *known = np.asarray(orbit.multipliers)
    assert orbit.ok and known == [1.0, 1.0] and abs(orbit.q0[0]) < 1e-15
    ts = np.array([0.0, float(orbit.period)])
    step = 1e-6  # a difference in x, whose square the motion feels
    shift = np.array([step, 0.0])
    displaced = lagjax.simulate(HENON_HEILES, orbit.q0 + shift, orbit.qdot0, ts, rtol=1e-14)
    pushed = lagjax.simulate(HENON_HEILES, orbit.q0, orbit.qdot0 + shift, ts, rtol=1e-14)
    trace = (displaced.q[-1, 0] + pushed.qdot[-1, 0]) / step
    assert abs(first * second - 1) < 1e-12
    np.testing.assert_allclose((first + second).real, trace, atol=1e-8)


@pytest.mark.slow
def test_the_figure_of_eight():
    q0, qdot0, period = eight()
    orbit = lagjax.periodic_orbit(BODIES, q0, qdot0, period)
    # Simó, Contemporary Mathematics 292 (2002) 209: exp(±2πi·0.00842272), exp(±2πi·0.29809253).
    turns = np.sort(np.abs(np.angle(np.asarray(orbit.multipliers)[:4])) / (2 * np.pi))
    np.testing.assert_allclose(turns, [0.00842272, 0.00842272, 0.29809253, 0.29809253], atol=1e-8)
    assert orbit.stable and orbit.closure < 1e-13
    np.testing.assert_array_equal(orbit.multipliers[4:], 1.0)  # of time, two shifts with their boosts, and turns


def test_the_innermost_stable_circle():
    # About V = −1/(r − 2) circles have E = −1/(r − 2) + r/(2 (r − 2)²), least at r = 6, within which none is stable.
    radius, speed = 6.1, np.sqrt(6.1) / 4.1
    circle = lagjax.periodic_orbit(HOLE, np.array([radius, 0.0]), np.array([0.0, speed]), 2 * np.pi * radius / speed)
    circles = lagjax.family(HOLE, circle, until=-0.1, step=2.0, count=8)
    r = np.linalg.norm(circles.q0, axis=1)
    np.testing.assert_allclose(circles.energy, -1 / (r - 2) + r / (2 * (r - 2) ** 2), atol=1e-12)
    assert np.min(circles.energy) > -1 / 16 - 1e-12
    (fold,) = np.flatnonzero(circles.fold)
    # E − E0 is 1e-16 within 3e-7 of r = 6; its slope, whose zero is located, is so within 1e-14.
    np.testing.assert_allclose(r[fold], 6.0, rtol=1e-9)
    away = np.arange(len(r)) != fold
    np.testing.assert_array_equal(circles.stable[away], r[away] > 6)


@pytest.mark.slow
def test_the_figure_of_eight_in_32_digits():
    pytest.importorskip("numba", reason="the benchmark's double-doubles are compiled by numba")
    from benchmarks._orbits_extended import ends
    from benchmarks._orbits_multipliers import multipliers
    from benchmarks._orbits_refined import refined

    v, place, shape = np.array([[0.3471168881, 0.5327249454]]), np.array([[-1.0, 0, 1, 0]]), np.tile(np.eye(2), (2, 1))
    orbit = refined(place, shape[None], v, np.array([6.3259139829]), np.ones(1))
    assert orbit.closure[0] < 1e-22 and orbit.step[0] < 1e-17
    # And backwards: (place, 3 v, 3 v) relative to the body in the middle.
    start = np.zeros((1, 2, 8))
    start[0, 0, :4], start[0, :, 4:] = place[0], np.tile(orbit.w[0], 2)
    there = ends(start, orbit.period / 2, np.ones(1))
    there[..., 4:] *= -1
    back = ends(there, orbit.period / 2, np.ones(1))
    back[..., 4:] *= -1
    np.testing.assert_allclose((back - start).sum(axis=1), 0.0, atol=1e-24)
    # Simó's multipliers, as above, from differences of such motions: of these the digits are known to twelve.
    fine = multipliers(start, orbit.period, np.ones(1), np.array([2]))
    turns = np.sort(np.abs(np.angle(fine.values[0]))) / (2 * np.pi)
    np.testing.assert_allclose(turns, [0.00842272, 0.00842272, 0.29809253, 0.29809253], atol=1e-8)
    assert fine.error[0] < 1e-12 and fine.known[0] and not fine.unstable[0]
    np.testing.assert_allclose(np.abs(fine.values), 1.0, rtol=1e-15)


def test_a_family_of_swings():
    # Every swing of a pendulum up to the separatrix at E = 1, each with its period in closed form.
    begin = lagjax.periodic_orbit(PENDULUM, 0.5, 0.0, 6.4)
    swings = lagjax.family(PENDULUM, begin, until=0.9, step=0.3)
    assert "until" in swings.message and abs(swings.energy[-1] - 0.9) < 1e-12 and not swings.fold.any()
    np.testing.assert_allclose(swings.period, 4 * ellipk((np.asarray(swings.energy) + 1) / 2), rtol=1e-10)


@pytest.mark.slow
def test_nonlinear_normal_modes_of_a_double_pendulum():
    scene = lagjax.scenes.double_pendulum()
    for sign, frequency in zip((1, -1), lagjax.scenes.double_pendulum_frequencies(scene.params), strict=True):
        shape = np.array([1.0, sign * np.sqrt(2.0)])
        at_rest, period = np.zeros(2), float(2 * np.pi / frequency)
        begin = lagjax.periodic_orbit(scene.system, 0.02 * shape, at_rest, period, scene.params)
        mode = lagjax.family(scene.system, begin, scene.params, until=-25.0, step=0.1)
        assert "until" in mode.message and np.asarray(mode.closure).max() < 1e-11
        first = 2 * np.pi / np.asarray(mode.period)[0]
        np.testing.assert_allclose(first, frequency, rtol=2e-3)  # the amplitude squared
        pairs = np.asarray(mode.multipliers)
        np.testing.assert_allclose(pairs[:, 0] * pairs[:, 1], 1.0, atol=1e-8)


@pytest.mark.slow
def test_a_family_by_a_parameter():
    swing = PENDULUM_IN_GRAVITY
    begin = lagjax.periodic_orbit(swing, 1.0, 0.0, 6.5, {"g": 1.0})
    swings = lagjax.family(swing, begin, {"g": 1.0}, by="g", until=1.3, step=0.1)
    np.testing.assert_allclose(swings.period, begin.period)
    modulus = (np.asarray(swings.energy) / np.asarray(swings.value) + 1) / 2
    np.testing.assert_allclose(4 * ellipk(modulus) / np.sqrt(swings.value), begin.period, rtol=1e-9)
    with pytest.raises(ValueError, match="by must be 'energy' or one of"):
        lagjax.family(swing, begin, {"g": 1.0}, by="length")


@pytest.mark.slow
def test_a_family_that_ends_says_where():
    # At E = 1 is the separatrix, whose period is infinite.
    begin = lagjax.periodic_orbit(PENDULUM, 2.0, 0.0, 8.0)
    swings = lagjax.family(PENDULUM, begin, until=2.0, step=1.0, count=60)
    assert swings.energy[-1] < 1.0 and swings.energy[-1] > 0.9
    assert "could not be followed beyond" in swings.message or "raise count" in swings.message
    with pytest.raises(ValueError, match="must be one periodic orbit that is ok"):
        lagjax.family(PENDULUM, begin._replace(ok=np.asarray(False)))


def _probe(r, v, params):
    """The restricted three-body problem in axes that turn along."""
    (x, y, z), mu = r, params
    first, second = jnp.sqrt((x + mu) ** 2 + y**2 + z**2), jnp.sqrt((x - 1 + mu) ** 2 + y**2 + z**2)
    return 0.5 * ((v[0] - y) ** 2 + (v[1] + x) ** 2 + v[2] ** 2) + (1 - mu) / first + mu / second


PROBE, EARTH_MOON = lagjax.System(_probe), 0.01215


def _lyapunov_orbits(step, until):
    """The planar orbits about Earth and Moon's L1, whose multipliers are 2600 and its reciprocal."""
    point = lagjax.equilibrium(PROBE, jnp.array([0.8, 0.0, 0.0]), EARTH_MOON).q
    modes = lagjax.normal_modes(PROBE, point, EARTH_MOON)
    k = int(jnp.argmax(jnp.where(jnp.abs(modes.shapes[:, 0]) > 1e-3, modes.frequencies, 0)))
    omega, shape = modes.frequencies[k], modes.shapes[k] / modes.shapes[k, 0]
    q0, qdot0 = point + 0.01 * shape.real, 0.01 * (1j * omega * shape).real
    small = lagjax.periodic_orbit(PROBE, q0, qdot0, 2 * jnp.pi / omega, EARTH_MOON)
    return lagjax.family(PROBE, small, EARTH_MOON, until=until, step=step)


@pytest.mark.slow
def test_halo_orbits_branch_off_the_planar_ones():
    planar, other = _lyapunov_orbits(0.05, -1.51), _lyapunov_orbits(3.0, -1.51)
    assert len(planar.value) < 60 and planar.value[-1] == pytest.approx(-1.51, abs=1e-12)
    first, _ = np.flatnonzero(planar.branch)
    # However long the first step: the same two points, where halo orbits (published: C = 3.1743) and axial ones begin.
    np.testing.assert_allclose(planar.value[planar.branch], other.value[other.branch], atol=1e-10)
    np.testing.assert_allclose(-2 * planar.value[first], 3.1743, atol=1e-4)
    # There small deviations in z return after one period: their own monodromy matrix has the eigenvalue 1 twice.
    start, ts = [x[first] for x in (planar.q0, planar.qdot0)], jnp.array([0.0, 1.0]) * planar.period[first]

    def lift(q, v):
        end = lagjax.simulate(PROBE, start[0].at[2].set(q), start[1].at[2].set(v), ts, EARTH_MOON, rtol=1e-14)
        return jnp.stack([end.q[-1, 2], end.qdot[-1, 2]])

    lifted = np.stack([(lift(*x) - lift(*-x)) / 2e-6 for x in 1e-6 * np.eye(2)])
    np.testing.assert_allclose(np.trace(lifted), 2.0, atol=1e-6)  # of the differences: 1e-12 · 2600²

    halo = lagjax.branch_off(PROBE, planar, int(first), EARTH_MOON)
    assert halo.ok and abs(halo.q0[2]) > 1e-3
    halos = lagjax.family(PROBE, halo, EARTH_MOON, count=60)
    jacobi, highest = -2 * np.asarray(halos.value), np.abs(np.asarray(halos.q0)[:, 2])
    assert highest.max() > 0.03 and np.asarray(halos.closure).max() < 1e-10
    # Beyond the fold at 2.998 near-rectilinear ones are stable, until they double their period or fold again.
    assert np.asarray(halos.fold).any() and np.asarray(halos.stable).any()
    np.testing.assert_allclose(jacobi[np.asarray(halos.stable)], 3.0, atol=0.01)


@pytest.mark.slow
def test_a_family_does_not_jump_at_a_crossing():
    # About the branch point of the second mode Newton's method finds orbits of either family: none of the other ones
    # may stand in this one, where the energy rises all the way and the multipliers change steadily.
    scene = lagjax.scenes.double_pendulum()
    frequency = lagjax.scenes.double_pendulum_frequencies(scene.params)[1]
    start = 0.02 * np.array([1.0, -np.sqrt(2.0)])
    begin = lagjax.periodic_orbit(scene.system, start, np.zeros(2), float(2 * np.pi / frequency), scene.params)
    places = []
    for step in (0.03, 0.3, 3.0):
        mode = lagjax.family(scene.system, begin, scene.params, until=0.0, step=step)
        assert (np.diff(mode.value) > 0).all() and not np.asarray(mode.fold).any()
        (place,) = np.flatnonzero(mode.branch)
        np.testing.assert_allclose(np.asarray(mode.multipliers)[place], 1.0, atol=1e-4)
        places.append(mode.value[place])
    np.testing.assert_allclose(places, places[0], rtol=1e-10)


@pytest.mark.slow
def test_an_orbit_of_twice_the_period_branches_off():
    begin = lagjax.periodic_orbit(HENON_HEILES, np.array([0.0, 0.1]), np.zeros(2), 6.3)
    along = lagjax.family(HENON_HEILES, begin, until=0.14)
    (place,) = np.flatnonzero(along.doubling)
    np.testing.assert_allclose(np.asarray(along.multipliers)[place, :2], -1.0, atol=1e-4)
    twice = lagjax.branch_off(HENON_HEILES, along, int(place))
    assert twice.ok and abs(twice.period / along.period[place] - 2) < 1e-2
    halfway = lagjax.simulate(HENON_HEILES, twice.q0, twice.qdot0, np.linspace(0, twice.period, 3), rtol=1e-13)
    np.testing.assert_allclose(halfway.q[-1], twice.q0, atol=1e-11)
    assert np.abs(halfway.q[1] - twice.q0).max() > 1e-3
    with pytest.raises(ValueError, match="No family crosses at orbit 0"):
        lagjax.branch_off(HENON_HEILES, along, 0)


@pytest.mark.slow
def test_all_orbits_have_one_period():
    # Nothing but the energy tells the orbits of an oscillator apart: the family rises in it, and nothing branches.
    oscillator = OSCILLATORS
    begin = lagjax.periodic_orbit(oscillator, np.array([0.3, 0.1]), np.zeros(2), 6.3)
    orbits = lagjax.family(oscillator, begin, until=2.0)
    np.testing.assert_allclose(orbits.period, 2 * np.pi, rtol=1e-12)
    assert (np.diff(orbits.energy) > 0).all() and not (orbits.branch | orbits.fold | orbits.doubling).any()
