"""Look-ups of the state in tables that are parameters, knots and values: exact motions, with derivatives by both."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import free_particles
from scenes import particle, particles

import lagjax

RNG = np.random.default_rng(5)
MACHINE = lagjax.MachineCode()
END = np.array([0.0, 1.2])
KNOTS = np.array([-1.0, -0.63, -0.34, 0.07, 0.41, 0.72, 1.13, 1.5])
VALUES = np.array([0.5, -0.3, 0.4, 0.1, 0.6, 0.2, 0.7, 0.3])


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def valley(q, qdot, params):
    return 0.5 * qdot**2 - jnp.interp(q, params["x"], params["u"])


VALLEY = lagjax.System(valley)


def end_of(scene, params, **options):
    return lagjax.simulate(scene, -0.9, 1.6, END, params, **options).q[-1]


def exact_end(params):
    """The same in closed form, of a motion to the right: between two knots the acceleration is constant."""
    x, u = params["x"], params["u"]
    k = jnp.searchsorted(x, -0.9, side="right") - 1
    slopes = (u[1:] - u[:-1]) / (x[1:] - x[:-1])
    energy = 0.5 * 1.6**2 + u[k] + slopes[k] * (-0.9 - x[k])

    def over(state, piece):
        q, v, left = state
        i, knot, potential, slope = piece
        ahead = jnp.sqrt(2 * (energy - potential))
        time = 2 * (knot - q) / (v + ahead)
        ends = (i >= k) & (left > 0) & (time >= left)
        passes = (i >= k) & (left > 0) & (time < left)
        stop = q + v * left - 0.5 * slope * left**2
        q = jnp.where(passes, knot, jnp.where(ends, stop, q))
        return (q, jnp.where(passes, ahead, v), jnp.where(passes, left - time, jnp.where(ends, 0.0, left))), None

    start = jnp.array(-0.9), jnp.array(1.6), END[-1]
    return jax.lax.scan(over, start, (jnp.arange(len(slopes)), x[1:], u[1:], slopes))[0][0]


def table(count):
    """Knots and values, so many of them on the same stretch."""
    if count == len(KNOTS):
        return {"x": jnp.asarray(KNOTS), "u": jnp.asarray(VALUES)}
    x = np.interp(np.linspace(0, 1, count) + 0.3 / count * RNG.uniform(-1, 1, count), [0, 1], [-1.0, 1.5])
    return {"x": jnp.asarray(x), "u": jnp.asarray(0.3 * np.sin(4 * x) + 0.01 * RNG.normal(size=count))}


@pytest.mark.parametrize("count", [8, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_potential_by_a_table_of_parameters(count):
    # The local error is rtol = 1e-9 a step or below rounding of one, here of constant accelerations; over a thousand
    # borders the slopes by entries, of pieces a thousandth long, lose three digits of sixteen.
    scene, params = VALLEY, table(count)
    np.testing.assert_allclose(end_of(scene, params, solver=MACHINE), exact_end(params), atol=1e-11)
    slopes, closed = (jax.jit(jax.grad(f))(params) for f in (lambda p: end_of(scene, p), exact_end))
    for name in "xu":
        assert np.abs(closed[name]).max() > 0.1 / count
        np.testing.assert_allclose(slopes[name], closed[name], atol=1e-10)
    along = {name: np.cos(np.arange(count)) for name in "xu"}
    forward = jax.jit(lambda p: jax.jvp(lambda p: end_of(scene, p), (p,), (along,))[1])(params)
    np.testing.assert_allclose(forward, sum(np.vdot(closed[name], along[name]) for name in "xu"), atol=1e-9)


def test_members_with_tables_of_their_own():
    scene, base = VALLEY, table(8)
    params = {
        "x": jnp.stack([base["x"], base["x"] + 0.05, 1.02 * base["x"]]),
        "u": base["u"] * jnp.array([[1], [0.9], [1.1]]),
    }
    members = [jax.tree.map(lambda leaf, i=i: leaf[i], params) for i in range(3)]
    found = jax.jit(jax.vmap(jax.value_and_grad(lambda p: end_of(scene, p))))(params)
    for i, member in enumerate(members):
        np.testing.assert_allclose(found[0][i], exact_end(member), atol=1e-11)
        np.testing.assert_allclose(found[1]["x"][i], jax.jit(jax.grad(exact_end))(member)["x"], atol=1e-10)


def test_knots_that_do_not_increase_are_said():
    scene, params = VALLEY, table(8)
    with pytest.raises(ValueError, match=r"0\.34 comes after .* 0\.41.*Sort them"):
        end_of(scene, params | {"x": params["x"].at[5].set(0.34)})
    with pytest.raises(ValueError, match=r"params\['x'\]\[5\] is nan"):
        end_of(scene, params | {"x": params["x"].at[5].set(jnp.nan)})
    run = jax.jit(lambda x: end_of(scene, params | {"x": x}, throw=False))
    assert np.isnan(run(params["x"].at[5].set(0.34))) and np.isfinite(run(params["x"]))
    with pytest.raises(lagjax.SimulationError, match="knots of a look-up that do not increase"):
        jax.vmap(lambda x: end_of(scene, params | {"x": x}))(params["x"].at[5].set(0.34)[None])


@pytest.mark.slow
def test_second_derivatives_by_knots_of_a_force():
    """The force is continuous at its knots: second derivatives exist, and are those of differences."""
    force = lambda q, qdot, params: -2 * q - jnp.interp(q, params["x"], params["u"])
    scene, params = particle(force), table(8)
    slope = jax.grad(lambda p: end_of(scene, p, solver=MACHINE))
    along = {"x": jnp.cos(jnp.arange(8.0)), "u": jnp.sin(jnp.arange(8.0))}
    curved = jax.jvp(slope, (params,), (along,))[1]
    ahead, behind = (slope(jax.tree.map(lambda p, d, s=s: p + s * d, params, along)) for s in (1e-6, -1e-6))
    for name in "xu":  # differences of slopes that are right to 1e-13: half of them from rounding
        np.testing.assert_allclose(curved[name], (ahead[name] - behind[name]) / 2e-6, atol=2e-6)


@pytest.mark.slow
def test_second_and_third_derivatives_by_knots_of_a_potential():
    """The force jumps at every knot, which the motion passes at another time: derivatives are those of the closed form.

    Compiles the tangent flows along one and two directions, and the transposes of the motion and of these.
    """
    scene, params = VALLEY, table(8)
    end = lambda p: end_of(scene, p, solver=MACHINE)
    along = {"x": jnp.cos(jnp.arange(8.0)), "u": jnp.sin(jnp.arange(8.0))}

    def moved(transform):
        return lambda p: jax.jvp(transform, (p,), (along,))[1]

    # Local errors are of rtol = 1e-9 or below rounding, here of constant accelerations, and derivatives of these up to
    # a hundred times as large: of each order as of the others.
    for transform in (
        lambda f: moved(jax.grad(f)), lambda f: moved(moved(f)), lambda f: moved(moved(jax.grad(f))),
        lambda f: jax.grad(lambda p: sum(jnp.vdot(along[name], jax.grad(f)(p)[name]) for name in "xu")),
        lambda f: lambda p: jax.jit(jax.vmap(moved(jax.grad(f))))(jax.tree.map(lambda x: jnp.stack([x, 1.01 * x]), p)),
    ):  # fmt: skip
        found, closed = transform(end)(params), jax.jit(transform(exact_end))(params)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found, closed)


@pytest.mark.slow
def test_where_a_knot_is_grazed_there_are_no_derivatives():
    """A motion that turns where its force changes: whether it comes there, a change within the tolerance decides."""
    force = lambda q, qdot, params: jnp.where(jnp.searchsorted(params["x"], q, side="right") > 1, -2.0, -1.0)
    scene, ts = particle(force), np.array([0.0, 3.0])
    end = lambda x: lagjax.simulate(scene, 0.0, 1.0, ts, {"x": x}, solver=MACHINE).q[-1]
    touched, passed = (np.array([-10.0, x, 10.0]) for x in (0.5 - 1e-12, 0.4))
    # It passes x after 1 − v with v = √(1 − 2x), comes back after v more, and has two seconds left.
    closed = lambda x: x - 2 * jnp.sqrt(1 - 2 * x) - 2
    for order in (jax.grad, lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (jnp.array([0.0, 1.0, 0.0]),))[1]):
        of_closed = jax.grad(closed) if order is jax.grad else jax.grad(jax.grad(closed))
        np.testing.assert_allclose(order(end)(passed)[1], of_closed(0.4), atol=1e-8)
        assert np.isnan(order(end)(touched)[1])


STEEP = np.array([0.5, -0.3, 0.0, 1.0, 0.6, 0.2, 0.7, 0.3])
# The knots and the values that a scene computes of its parameters.
COMPUTED = {
    "values times a number": lambda p: (p["x"], p["a"] * p["u"]),
    "a known table times a number": lambda p: (p["x"], p["a"] * STEEP - p["u"][0]),
    "a function of every value": lambda p: (p["x"], jnp.exp(p["a"] * STEEP) * p["u"][1]),
    "a cumulative sum of values": lambda p: (p["x"], jnp.cumsum(p["u"])),
    "knots times a number": lambda p: (p["a"] * p["x"] + 0.3, p["u"]),
    "a cumulative sum of knots": lambda p: (jnp.cumsum(0.3 + 0.1 * jnp.abs(p["u"])) - 1.3, p["u"]),
    "joined": lambda p: (jnp.concatenate([p["x"], p["a"][None] + 2]), jnp.concatenate([p["u"], p["a"][None]])),
    "in reverse": lambda p: (-p["x"][::-1] - 0.1, p["u"][::-1]),
}


@pytest.mark.parametrize(
    "name", [name if i == 5 else pytest.param(name, marks=pytest.mark.slow) for i, name in enumerate(COMPUTED)]
)
def test_tables_that_are_computed(name):
    """Knots and values that L computes give the motion, and the slopes, of those that are parameters themselves."""
    tables = COMPUTED[name]

    def computed(q, qdot, params):
        return 0.5 * qdot**2 - jnp.interp(q, *tables(params))

    scene, direct, params = lagjax.System(computed), VALLEY, table(8) | {"a": jnp.array(0.8)}
    given = lambda p: end_of(direct, dict(zip("xu", tables(p), strict=True)))
    np.testing.assert_allclose(end_of(scene, params, solver=MACHINE), given(params), atol=1e-10)
    slopes, chained = jax.jit(lambda p: (jax.grad(lambda p: end_of(scene, p))(p), jax.grad(given)(p)))(params)
    for of in params:
        np.testing.assert_allclose(slopes[of], chained[of], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("right", [False, True])
def test_a_step_by_digitize(right):
    """A force that is another one between any two edges, to the right; the closed form is that of the potential."""
    force = lambda q, qdot, params: -params["f"][jnp.digitize(q, params["x"], right=right) - 1]
    scene, params = particle(force), table(8)
    slopes = (params["u"][1:] - params["u"][:-1]) / (params["x"][1:] - params["x"][:-1])

    def closed(f, x):
        return exact_end({"x": x, "u": jnp.append(0.0, jnp.cumsum(f * (x[1:] - x[:-1])))})

    def end(f, x):
        return end_of(scene, {"f": f, "x": x}, solver=MACHINE)

    for k in range(2):
        found, known = (jax.value_and_grad(g, k)(slopes, params["x"]) for g in (end, closed))
        np.testing.assert_allclose(found[0], known[0], atol=1e-11)
        np.testing.assert_allclose(found[1], known[1], atol=1e-10)


def force_of_field(q, qdot, params):
    return -q - jnp.stack([height_of_field(params["x"], params["y"], g, *q) for g in (params["g"], params["g"].T)])


def height_of_field(x, y, g, a, b):
    i, j = (jnp.clip(jnp.searchsorted(k, z, side="right") - 1, 0, len(k) - 2) for k, z in ((x, a), (y, b)))
    s, t = (a - x[i]) / (x[i + 1] - x[i]), (b - y[j]) / (y[j + 1] - y[j])
    low, high = (1 - t) * g[i, j] + t * g[i, j + 1], (1 - t) * g[i + 1, j] + t * g[i + 1, j + 1]
    return (1 - s) * low + s * high


ON_A_GRID = lagjax.System(free_particles, forces=force_of_field)


@pytest.mark.slow
def test_a_field_on_a_grid():
    """Bilinear between knots of two axes; axes and heights that are not separable, by differences."""
    params = {"x": jnp.asarray(KNOTS), "y": jnp.asarray(KNOTS + 0.03), "g": jnp.outer(VALUES, VALUES**2)}

    def end(p):
        ts = jnp.array([0.0, 2.0])
        return lagjax.simulate(ON_A_GRID, jnp.array([-0.3, 0.2]), jnp.array([0.8, 0.5]), ts, p, solver=MACHINE).q[-1, 0]

    slopes = jax.grad(end)(params)
    for name in params:
        along = jnp.asarray(RNG.normal(size=params[name].shape))
        ahead, behind = (end(params | {name: params[name] + s * along}) for s in (1e-5, -1e-5))
        np.testing.assert_allclose(np.vdot(slopes[name], along), (ahead - behind) / 2e-5, atol=1e-8)


@pytest.mark.parametrize("where", ["a closure", pytest.param("params", marks=pytest.mark.slow)])
def test_a_table_of_any_length_is_looked_up(where):
    # A tenth of a second with 200 000 knots: none of them is an operation. A straight line needs one piece, so that the
    # motion q̈ = t is exact.
    knots = np.linspace(0.0, 2.0, 200_001)
    table = {"t": knots, "u": knots}
    if where == "params":
        force, params = lambda q, qdot, t, params: jnp.interp(t, params["t"], params["u"]), table
    else:
        force, params = lambda q, qdot, t: jnp.interp(t, table["t"], table["u"]), None
    scene = particle(force)
    run = lagjax.simulate(scene, 0.0, 0.0, END, params, solver=MACHINE)
    np.testing.assert_allclose(run.q[-1], 1.2**3 / 6, rtol=1e-12)


def chosen_coordinate(q, qdot, params):
    chosen = q[params["i"]]
    return 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(chosen**2) - 0.2 * jnp.sum(chosen * q[params["j"]])


CHOSEN_COORDINATE = lagjax.System(chosen_coordinate)


@pytest.mark.parametrize("place", [0, 2])
def test_a_coordinate_that_params_choose_is_differentiated_by(place):
    """Σ q[i]² and a product of two such entries: a look-up into the state itself has a slope by what it reads."""
    i, j, q = np.array([place, 1]), np.array([4, 3]), np.array([0.3, -0.7, 1.1, 0.4, -0.2])

    stiffness = np.zeros((5, 5))
    np.add.at(stiffness, (i, i), 1.0)
    np.add.at(stiffness, (i, j), 0.2)
    np.add.at(stiffness, (j, i), 0.2)
    scene, params = CHOSEN_COORDINATE, {"i": i, "j": j}
    np.testing.assert_allclose(scene.acceleration(q, 0 * q, 0.0, params), -stiffness @ q, rtol=0, atol=1e-15)
    run = lagjax.simulate(scene, q, 0 * q, END, params, solver=MACHINE)
    values, modes = np.linalg.eigh(stiffness)
    end = modes @ (np.cos(np.sqrt(values + 0j) * END[-1]).real * (modes.T @ q))
    np.testing.assert_allclose(run.q[-1], end, rtol=0, atol=1e-9)


INTEGERS = np.array([3, 1, 4, 7, 5])
MASK = np.array([True, False, True, True, False])


def cell(x):
    return jnp.floor(2 * x).astype(int) + 2


def integer_entries(a, b, table, mask):
    """Numbers made of the entries a and b, by every kind of look-up and of arithmetic that floats would do wrong."""
    i, j = table[cell(a)], jax.lax.dynamic_index_in_dim(table - 4, cell(b), keepdims=False)
    grid, window = jnp.stack([table, table[::-1]]), jax.lax.dynamic_slice(mask, (cell(b),), (2,))
    small, words = table.astype(jnp.int8) * jnp.int8(31), (table - 4).astype(jnp.int32) * jnp.int32(2**29)
    missing = table.at[cell(3 * a)].get(mode="fill", fill_value=7)
    return jnp.stack(
        [
            *(i // 2, grid[cell(b) % 2, cell(a)] // 2, jnp.cumsum(table)[cell(a)] // 2, i * i // 2, *jnp.divmod(j, 2)),
            *(jax.lax.div(j, 2), jax.lax.rem(j, 3), jax.lax.div(j, j - j), jnp.sort(jnp.stack([i, j]))[0] // 2),
            *(
                missing // 2,
                table.astype(jnp.int32).at[cell(3 * b)].get(mode="fill") % 10,
                (small * table.astype(jnp.int8))[cell(a)],
            ),
            *(small[cell(a)] + small[cell(b)], -small[cell(b)], words[cell(a)] * words[cell(b)] + words[cell(a)]),
            *((words[cell(b)] // 3 * (words[cell(a)] // 5)), -table.astype(jnp.uint8)[cell(a)], i // (i - i)),
            *(~mask[cell(a)], mask[cell(a)] & (b > 0.2), mask[cell(a)] | mask[cell(b)], mask[cell(a)] ^ (b > 0.2)),
            *(mask[cell(a)] != mask[cell(b)], mask[cell(a)] + mask[cell(b)], jnp.any(window), jnp.all(window)),
            *(jnp.maximum(a > 0, b > 0), jnp.min(jnp.stack([a > 0, b > 0])), *jnp.sort(jnp.stack([a > b, b > 0]))),
            *(mask.at[cell(3 * a)].get(mode="fill"), jnp.stack([mask, ~mask])[cell(b) % 2, cell(a)]),
        ]
    ).astype(float)


@pytest.mark.parametrize("where", ["a closure", "params"])
def test_entries_of_integers_and_masks_are_computed_with_as_such(where):
    n, closed = 33, (jnp.asarray(INTEGERS), jnp.asarray(MASK))
    forces = lambda q, qdot, params: integer_entries(q[0], q[1], *(closed if where == "a closure" else params))
    scene, instant = particles(forces), 1e-9
    for a, b in [(-0.9, 0.3), (0.3, -0.7), (1.2, 0.7)]:
        q = jnp.zeros(n).at[:2].set(jnp.array([a, b]))
        exact = jax.jit(integer_entries)(a, b, *closed)
        np.testing.assert_array_equal(scene.acceleration(q, 0 * q, 0.0, closed), exact)
        run = lagjax.simulate(scene, q, 0 * q, jnp.array([0.0, instant]), closed, solver=MACHINE)
        np.testing.assert_allclose(run.qdot[-1] / instant, exact, rtol=1e-12)


@pytest.mark.parametrize("what", ["force", "mass"])
def test_a_force_and_a_mass_by_integers_of_a_table(what):
    """q̈ = T // 2, and ½ (1 + T // 2) q̇², along which √m q̇ is constant: in closed form from cell to cell of ½."""
    table, halves = jnp.asarray(INTEGERS), INTEGERS // 2

    def exact_end(q, v=1.0, left=0.9):
        for k, edge in enumerate([-0.5, 0.0]):
            ahead = jnp.sqrt(v**2 + 2 * halves[k] * (edge - q)) if what == "force" else v
            left = left - 2 * (edge - q) / (v + ahead)
            v = ahead if what == "force" else v * jnp.sqrt((1 + halves[k]) / (1 + halves[k + 1]))
            q = edge
        return q + v * left + (what == "force") * halves[2] * left**2 / 2

    half = lambda q: table[cell(q)] // 2
    push = particle(lambda q, qdot: 1.0 * half(q))
    heavy = lagjax.System(lambda q, qdot: 0.5 * (1 + half(q)) * qdot**2)
    scene = push if what == "force" else heavy
    end = lambda q: lagjax.simulate(scene, q, 1.0, jnp.array([0.0, 0.9]), solver=MACHINE).q[-1]
    for found, exact in zip(jax.value_and_grad(end)(-0.9), jax.jit(jax.value_and_grad(exact_end))(-0.9), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-11)
    assert float(heavy.energy(-0.9, 1.0)) == 1.0
