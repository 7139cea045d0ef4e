"""Derivatives through borders: first and second ones, in every mode, against closed forms of motions in pieces.

One scene has a particle of unit mass for each kind of border, so that all of them share their machine code.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import RELAY, in_potential, particles, weight_on

import lagjax

T = 3.0
# A region is entered, V = |q|, a one-sided spring, a border that moves, friction that comes to rest.
START, VELOCITY = jnp.array([0.0, 1.0, 1.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0, 1.0, 0.0])
# Where the first starts; its velocity; where the second starts; the stiffness; when a force on the third is switched
# off; how fast the border moves; the coefficient of friction; where the last one starts.
X = np.array([0.0, 1.1, 1.0, 40.0, 0.2, 0.7, 1.0, 0.4])


def forces(q, v, t, params):
    region = jnp.where(q[0] > 1.0, -0.3, 0.0)
    corner = -jnp.sign(q[1])
    spring = -9.81 + jnp.where(t > params[4], 0.0, 1.0) - params[3] * jnp.minimum(q[2], 0.0)
    moving = jnp.where(q[3] > params[5] * t, -1.0, 0.2)
    friction = -params[6] * jnp.sign(v[4]) - 4 * q[4]
    return jnp.array([region, corner, spring, moving, friction])


SCENE = lagjax.System(lambda q, v, params: 0.5 * v @ v, forces=forces)
WEIGHTS = np.array([1.0, 0.7, 0.3, 1.3, 2.0])


def value(x, **options):
    start, velocity = START.at[0].set(x[0]).at[1].set(x[2]).at[4].set(x[7]), VELOCITY.at[0].set(x[1])
    run = lagjax.simulate(SCENE, start, velocity, jnp.array([0.0, T]), x, rtol=1e-11, **options)
    return jnp.sum(WEIGHTS * run.q[-1] ** 2)


def exact(x):
    """The same in closed form."""
    t = (1.0 - x[0]) / x[1]
    region = 1.0 + x[1] * (T - t) - 0.15 * (T - t) ** 2
    quarter = jnp.sqrt(2 * x[2])
    s = T + quarter - 2 * quarter
    corner = -(quarter * s - s**2 / 2)
    # Falling with 8.81, then 9.81 until q = 0, and in contact.
    g, w = 9.81, jnp.sqrt(x[3])
    h, u = 1.0 - 4.405 * x[4] ** 2, -8.81 * x[4]
    down = jnp.sqrt(u * u + 2 * g * h)
    contact = 2 * (jnp.pi / 2 + jnp.arctan(g / (down * w))) / w
    flight = 2 * down / g
    s = T - x[4] - (down + u) / g - 2 * contact - flight  # after the second contact
    spring = down * s - g * s**2 / 2
    t = 2 * (1 - x[5])
    moving = x[5] * t + (1 - t) * (T - t) + 0.1 * (T - t) ** 2
    # Half a swing, of time π/2, to the other side, 2 μ/4 short of it; there it stays, as 4 |q| < μ.
    friction = x[6] / 2 - x[7]
    return jnp.sum(WEIGHTS * jnp.array([region, corner, spring, moving, friction]) ** 2)


@pytest.mark.slow
def test_first_derivatives():
    np.testing.assert_allclose(value(X), exact(X), rtol=1e-10)
    expected = jax.jit(jax.grad(exact))(X)
    np.testing.assert_allclose(jax.grad(value)(X), expected, atol=1e-8)
    np.testing.assert_allclose(jax.jacfwd(value)(X), expected, atol=1e-8)


@pytest.mark.slow
def test_products_with_the_hessian():
    along = np.linspace(1.0, -1.0, X.size)
    product = jax.jit(lambda x: jax.jvp(jax.grad(value), (x,), (along,))[1])(X)
    np.testing.assert_allclose(product, jax.jit(jax.hessian(exact))(X) @ along, atol=2e-7)


@pytest.mark.slow
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_in_every_mode(inner, outer):
    np.testing.assert_allclose(jax.jit(outer(inner(value)))(X), jax.jit(jax.hessian(exact))(X), atol=2e-7)


@pytest.mark.slow
def test_hessians_of_many_members_at_once():
    members = X + np.linspace(-0.01, 0.01, 64)[:, None]
    np.testing.assert_allclose(
        jax.jit(jax.vmap(jax.hessian(value)))(members), jax.jit(jax.vmap(jax.hessian(exact)))(members), atol=2e-7
    )


# ---- grazing, and what health says of borders ------------------------------------------------------------------------

# Thrown up with g = 1, it comes to v²/2; beyond 1 a force pulls it back, or a spring does.
THROWN = lagjax.System(
    lambda q, v: 0.5 * v * v - q,
    forces=lambda q, v, params: -params[0] * jnp.where(q > 1.0, 1.0, 0.0) - params[1] * jnp.maximum(q - 1.0, 0.0),
)
BLOCK = lagjax.System(lambda q, v: 0.5 * (v * v - q * q), forces=lambda q, v: -0.3 * jnp.sign(v))
BELT = lagjax.System(
    lambda q, v: 0.5 * (v * v - q * q),
    forces=lambda q, v, params: -params[0] * jnp.sign(v - params[1]) / (1 + jnp.abs(v - params[1])),
)
PULLED, SPRUNG = np.array([0.7, 0.0]), np.array([0.0, 0.7])


GRAZING = jnp.sqrt(2.0) + 3e-10  # by 4e-10: less than the tolerance, and more than rounding


def falls_to(v, params, **options):
    return lagjax.simulate(THROWN, 0.0, v, jnp.array([0.0, 2.5]), params, **options).q[-1]


@pytest.mark.slow
def test_where_a_border_is_grazed_there_is_no_derivative():
    slopes = jax.vmap(jax.grad(falls_to), (0, None))
    v = GRAZING + jnp.array([0.0, 1e-2, -1e-2])
    jumps, bends = slopes(v, PULLED), slopes(v, SPRUNG)
    assert np.isnan(jumps[0]) and np.isnan(jax.jvp(lambda v: falls_to(v, PULLED), (GRAZING,), (1.0,))[1])
    h = 1e-5
    difference = (falls_to(v[1] + h, PULLED, rtol=1e-12) - falls_to(v[1] - h, PULLED, rtol=1e-12)) / (2 * h)
    np.testing.assert_allclose(jumps[1:], [difference, 2.5], rtol=1e-4)
    np.testing.assert_allclose(bends[0], 2.5, atol=1e-3)  # the force is continuous


@pytest.mark.slow
def test_where_a_border_is_grazed_there_is_no_second_derivative():
    for params in (PULLED, SPRUNG):
        for second in (jax.jacfwd(jax.jacfwd(falls_to)), jax.jacfwd(jax.grad(falls_to)), jax.hessian(falls_to)):
            second = jax.jit(second)
            assert np.isnan(second(GRAZING, params)) and second(GRAZING - 1e-3, params) == 0.0


def test_health_counts_borders():
    v = GRAZING + jnp.array([-0.1, 0.0, 0.1])
    run = lagjax.simulate_batch(THROWN, np.zeros(3), v, np.linspace(0.0, 2.5, 5), PULLED)
    health = run.health()
    assert health.borders.crossed.tolist()[::2] == [0, 2] and health.borders.grazed.tolist()[::2] == [0, 0]
    assert health.borders.grazed[1] > 0 and health.suspicious.tolist() == [False, True, False]
    np.testing.assert_allclose(health.borders.t[1], np.sqrt(2.0), atol=1e-4)
    assert "grazed in 1 of 3 members" in str(health)


@pytest.mark.slow
def test_health_says_where_borders_are_not_located():
    run = lagjax.simulate(
        THROWN, 0.0, 1.5, np.linspace(0.0, 2.5, 5), PULLED, solver=diffrax.Tsit5(), rtol=1e-4, throw=False
    )
    health = run.health()
    assert not health.borders_located and health.borders is None and "does not locate them" in str(health)


def test_health_counts_where_a_motion_comes_to_rest():
    health = lagjax.simulate(BLOCK, 2.0, 0.0, np.linspace(0.0, 20.0, 5)).health()
    assert (health.borders.crossed, health.borders.slid, health.borders.grazed) == (2, 1, 0)
    assert "2 crossed; 1 slid along" in str(health) and not health.suspicious


@pytest.mark.slow
def test_output_times_of_a_motion_that_slides():
    # A relay: from q + v = 0 on v falls like −e⁻ᵗ, which the program alone, ±1 beside the border, does not say.
    relay = RELAY

    def speed(t):
        return lagjax.simulate(relay, 1.0, 0.0, jnp.array([0.0, t]), rtol=1e-11).qdot[-1]

    v = float(speed(2.0))
    np.testing.assert_allclose(v, -(np.sqrt(3) - 1) * np.exp(-(2.0 - np.sqrt(3) + 1)), rtol=1e-9)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(speed)(2.0), -v, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(jax.grad(speed))(2.0), v, rtol=1e-9)


@pytest.mark.slow
def test_a_fit_through_stick_and_slip():
    # A block on a belt, held by a spring: the coefficient of friction and the speed of the belt, from where it was.
    ts = np.linspace(0.0, 12.0, 25)

    def places(params):
        return lagjax.simulate(BELT, 0.5, 0.0, ts, params).q

    truth, params = jnp.array([1.1, 0.2]), jnp.array([0.9, 0.26])
    observed = places(truth)
    assert lagjax.simulate(BELT, 0.5, 0.0, ts, truth).health().borders.slid > 1

    @jax.jit
    def loss_and_slope(params):
        return jax.value_and_grad(lambda params: jnp.mean((places(params) - observed) ** 2))(params)

    rate, (value, slope) = 0.05, loss_and_slope(params)
    for _ in range(200):  # downhill, by steps that shrink where they lead up
        trial = params - rate * slope
        new, of_new = loss_and_slope(trial)
        rate = rate * 1.5 if new < value else rate / 3
        params, value, slope = (trial, new, of_new) if new < value else (params, value, slope)
    np.testing.assert_allclose(params, truth, atol=1e-4)

    # And by Newton's method, with second derivatives through the same borders.
    params = truth + jnp.array([-0.02, 0.01])
    for _ in range(4):
        _, slope = loss_and_slope(params)
        bend = jax.hessian(lambda params: jnp.mean((places(params) - observed) ** 2))(params)
        params = params - jnp.linalg.solve(bend, slope)
    np.testing.assert_allclose(params, truth, atol=1e-8)


# ---- jumps beside functions whose slopes may be infinite -------------------------------------------------------------

ENTRIES = jnp.array([0.3, -0.2, 0.1, 0.4])
JUMPS = {
    "sign": lambda q, v: 0.3 * jnp.sign(v),
    "where": lambda q, v: jnp.where(q > 0.3, 0.4, 0.0),
    "clip": lambda q, v: jnp.clip(3 * q, -0.5, 0.7),
    "floor": lambda q, v: 0.2 * jnp.floor(2 * q + 0.3),
    "table": lambda q, v: ENTRIES[jnp.clip(jnp.floor(2 * q + 2.1), 0, 3).astype(int)],
    "knots": lambda q, v: jnp.interp(q, jnp.array([-2.0, 0.1, 0.4, 2.0]), jnp.array([0.0, 0.3, -0.2, 0.5])),
    "mod": lambda q, v: 0.3 * jnp.mod(2 * q + 0.2, 1.0),
    "switch": lambda q, v: jax.lax.switch((q > 0.1).astype(int) + (q > 0.4), [lambda x=x: x for x in (0.1, -0.3, 0.2)]),
}
OPERATIONS = (
    lambda q, v, p: jnp.sqrt(p) * v, lambda q, v, p: jnp.sqrt(q * q + p), lambda q, v, p: jnp.cbrt(p) * q,
    lambda q, v, p: jnp.cbrt(2 + q + p), lambda q, v, p: (2 + q) ** 1.3 * p**0.7, lambda q, v, p: 2.0**p * q,
    lambda q, v, p: (3 + q) ** p, lambda q, v, p: jnp.arctan2(q, p), lambda q, v, p: jnp.hypot(q, p),
    lambda q, v, p: jnp.hypot(v, p), lambda q, v, p: jnp.arcsin(0.3 * q * p), lambda q, v, p: jnp.arccosh(3 + p * q),
    lambda q, v, p: jnp.exp(-p * q), lambda q, v, p: jnp.log(3 + q * p), lambda q, v, p: jax.lax.rsqrt(1 + q * q * p),
    # On the flat side of these the slope of the root is infinite, and that of the function zero.
    lambda q, v, p: p * jnp.maximum(q, 0.0) ** 2.5, lambda q, v, p: p * jnp.sqrt(jnp.maximum(q - 5.0, 0.0)),
    lambda q, v, p: p * jnp.cbrt(jnp.maximum(q, 0.0)) * q * q,
)  # fmt: skip


@pytest.mark.parametrize(
    ("jump", "operations"),
    [
        ("sign", OPERATIONS[-3:]),
        # Every jump beside a third of the operations, every operation beside two jumps: what compiles them counts.
        *(pytest.param(name, OPERATIONS[k % 3 :: 3], marks=pytest.mark.slow) for k, name in enumerate(JUMPS)),
    ],
)
def test_derivatives_of_a_jump_beside_every_operation(jump, operations):
    """Every coordinate is a pair of a jump and an operation, none of which knows of another."""
    count = len(operations)

    def forces(q, v, params):
        smooth = jnp.stack([f(q[k], v[k], params[k]) for k, f in enumerate(operations)])
        return -2 * q - jnp.stack([JUMPS[jump](q[k], v[k]) for k in range(count)]) - 0.3 * smooth

    scene = particles(forces)

    def end(q, params):
        return lagjax.simulate(scene, q, np.zeros(count), np.array([0.0, 4.0]), params, rtol=1e-11).q[-1]

    x, h = (np.linspace(0.713, 0.883, count), np.linspace(0.41, 0.59, count)), 1e-5
    reverse = jax.jit(jax.grad(lambda x: end(*x).sum()))(x)
    along = jax.jit(lambda moved: jax.jvp(end, x, moved)[1])
    for k in range(2):
        moved = tuple(np.full(count, float(i == k)) for i in range(2))
        forward = along(moved)
        ahead, back = (end(*(a + d * step for a, d in zip(x, moved, strict=True))) for step in (h, -h))
        np.testing.assert_allclose(forward, (ahead - back) / (2 * h), atol=1e-7)
        np.testing.assert_allclose(reverse[k], forward, atol=1e-7)


def force_by_roots_and_angles(q, v, params):
    inside = jnp.where(jnp.linalg.norm(q) > 1.3, 1.0, -1.0) + jnp.where(jnp.arctan2(q[1], q[0]) > 0.5, 0.4, 0.0)
    return params * inside * jnp.array([-q[1], q[0]]) - 0.1 * v


ROOTS_AND_ANGLES = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q @ q, forces=force_by_roots_and_angles)


def test_borders_by_roots_and_angles_in_every_mode():
    # A number by which a force is pieced together may have an infinite slope elsewhere, as a distance has at zero.

    def end(x):
        run = lagjax.simulate(ROOTS_AND_ANGLES, np.array([1.0, 0.3]), x[1:], np.array([0.0, 6.0]), x[0])
        return run.q[-1, 0]

    x, step = np.array([0.5, -1.2, 2.3]), 1e-6 * np.eye(3)
    slopes = [(end(x + d) - end(x - d)) / 2e-6 for d in step]
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(mode(end))(x), slopes, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_jump_beside_a_root_that_is_singular_elsewhere(slow):
    """sqrt(q) has no series at q = 0, and a jump at q = 1.3 is a border all the same."""
    roots = (jnp.sqrt, jnp.log, lambda q: q**0.3, jnp.cbrt) if slow else (jnp.sqrt,)
    for root in roots:
        scene = in_potential(
            lambda q: 0.5 * (q - 1.5) ** 2,
            forces=lambda q, v, params, root=root: -params * jnp.where(q > 1.3, 1.0, 0.2) - 0.1 * root(q),
        )

        def end(x, scene=scene):
            return lagjax.simulate(scene, 2.0, x[1], np.array([0.0, 2.5]), x[0], rtol=1e-11).q[-1]

        x, step = np.array([0.4, 0.8]), 1e-5 * np.eye(2)
        differences = [(end(x + d) - end(x - d)) / 2e-5 for d in step]
        for mode in (jax.grad, jax.jacfwd):
            np.testing.assert_allclose(jax.jit(mode(end))(x), differences, rtol=1e-7, atol=1e-7)


def height_of_wire(x):
    return jnp.where(x < 0.3, 0.0, (x - 0.3) ** 2)


def slope_of_wire(x):
    return jnp.where(x < 0.3, 0.0, 2 * (x - 0.3))


BEAD_ALONE = lagjax.System(lambda x, v: 0.5 * (1 + slope_of_wire(x) ** 2) * v**2 - 9.81 * height_of_wire(x))


@pytest.mark.parametrize(
    ("kind", "derivative"),
    [
        pytest.param("constraints", jax.jacrev, marks=pytest.mark.slow),
        ("contacts", jax.jacfwd),
        pytest.param("constraints", jax.jacfwd, marks=pytest.mark.slow),
        pytest.param("contacts", jax.jacrev, marks=pytest.mark.slow),
        pytest.param("constraints", jax.hessian, marks=pytest.mark.slow),
    ],
)
def test_a_bead_passes_where_the_curvature_of_its_wire_jumps(kind, derivative):
    """As in its one coordinate, where no projection decides by rounding on which side of the border it is."""
    wire = weight_on(**{kind: lambda q: q[1] - height_of_wire(q[0])})

    def ends(speed, duration):
        ts, still = jnp.stack([0.0 * duration, duration]), 0.0 * speed
        bead = lagjax.simulate(wire, jnp.array([0.24, 0.0]), jnp.stack([speed, still]), ts, rtol=1e-13)
        return jnp.stack([bead.q[-1, 0], lagjax.simulate(BEAD_ALONE, 0.24, speed, ts, rtol=1e-13).q[-1]])

    durations = np.array([0.205, 0.21, 0.22, 0.24, 0.25, 0.28, 0.3])
    along = jax.jit(jax.vmap(derivative(ends), (None, 0)))(0.3, durations)
    np.testing.assert_allclose(along[:, 0], along[:, 1], rtol=0, atol=1e-10)
