"""Motions of large scenes by the patterns of their matrices, against the same scenes as scalar programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweeps import sweep

import lagjax
from lagjax._equations import Band, Blocks, Diagonal, MatrixFree, Sparse, derivation_of, jacobian_pattern
from lagjax._interface import Layout

N = 100  # coordinates from which arrays know their patterns


def bonds(q):
    return jnp.sum(0.5 * jnp.diff(q) ** 2 + 0.1 * jnp.diff(q) ** 4) + jnp.sum(1 - jnp.cos(q))


def chain(q, qdot, t, params):
    """Masses in a row that grow with time and place."""
    m = params["m"] * (1 + 0.1 * jnp.sin(t) + 0.2 * jnp.cos(q))
    return 0.5 * jnp.sum(m * qdot**2) - bonds(q)


def blocks(q, qdot, t, params):
    """Double pendulums beside single ones, and three coordinates that are coupled in all ways."""
    a, b, c, d = q[:60:2], q[1:60:2], qdot[:60:2], qdot[1:60:2]
    pairs = jnp.sum(c**2 + 0.5 * d**2 + c * d * jnp.cos(a - b))
    body = qdot[60:63] @ (jnp.eye(3) * 2 + jnp.outer(jnp.sin(q[60:63]), jnp.sin(q[60:63]))) @ qdot[60:63]
    return pairs + 0.5 * body + 0.5 * params["m"] * jnp.sum(qdot[63:] ** 2) - bonds(q)


def elements(q, qdot, t, params):
    """A consistent mass that depends on the place."""
    v, w = qdot[1:], qdot[:-1]
    return params["m"] * jnp.sum((v**2 + v * w + w**2) * (1 + 0.1 * jnp.cos(q[1:] - q[:-1]))) / 6 - bonds(q)


def plate(q, qdot, t, params):
    """A consistent mass in two dimensions."""
    v = qdot.reshape(10, 10)
    a, b, c, d = v[1:, 1:], v[:-1, :-1], v[1:, :-1], v[:-1, 1:]
    return params["m"] * jnp.sum(a**2 + b**2 + c**2 + d**2 + (a + b) * c) - bonds(q)


def rods(q):
    """Lengths of links between points in the plane, the first of which is held."""
    p = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)])
    return {"rods": 0.5 * (jnp.sum(jnp.diff(p, axis=0) ** 2, axis=1) - 1)}


def free(q, qdot, t, params):
    return 0.5 * params["m"] * jnp.sum((1 + 0.1 * jnp.sin(q)) * qdot**2) - jnp.sum(q[1::2])


def skates(q, qdot):
    """Pairs of coordinates that move in one direction."""
    return qdot[::2] * jnp.sin(0.3 * q[::2]) - qdot[1::2] * jnp.cos(0.3 * q[1::2])


SCENES = {
    "diagonal": (chain, Diagonal, {}),
    "blocks": (blocks, Blocks, {}),
    "band": (elements, Band, {}),
    "sparse": (plate, Sparse, {}),
    "rods": (free, Diagonal, {"constraints": rods}),
    "skates": (free, Diagonal, {"velocity_constraints": skates}),
    "both": (free, Diagonal, {"constraints": lambda q: rods(q[:60]), "velocity_constraints": lambda q, v: v[80:90]}),
}


def start(name: str):
    rng = np.random.default_rng(1)
    q, v = 0.4 * rng.normal(size=N), 0.4 * rng.normal(size=N)
    if name in ("rods", "both"):
        angles = rng.uniform(-1, 1, N // 2)
        q = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0).ravel()
    return q, v


def both_forms(name: str):
    lagrangian, _, more = SCENES[name]
    if name == "diagonal":
        more = {"forces": lambda q, v, t: jnp.sin(t) - 0.1 * v, "dissipation": lambda q, v: jnp.sum(jnp.diff(v) ** 2)}
    return (lagjax.System(lagrangian, path=path, **more) for path in ("array", "scalar"))


@pytest.mark.parametrize("name", sweep(SCENES, kept=("diagonal", "blocks", "sparse")))
def test_both_forms_give_the_same_accelerations(name):
    sparse, scalar = both_forms(name)
    (q, v), params = start(name), {"m": 1.3}
    structure = derivation_of(sparse, Layout.from_state(q, v), params).form.structure
    assert structure is not None and isinstance(structure.mass, SCENES[name][1])
    exact = scalar.acceleration(q, v, 0.7, params)
    scale = np.abs(exact).max()
    np.testing.assert_allclose(sparse.acceleration(q, v, 0.7, params), exact, rtol=0, atol=1e-12 * scale)
    if structure.schur is not None:
        force = scalar.constraint_force(q, v, 0.7, params)
        np.testing.assert_allclose(sparse.constraint_force(q, v, 0.7, params), force, atol=1e-11 * np.abs(force).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["band", "rods"])
def test_accelerations_have_derivatives_in_both_modes(name):
    sparse, scalar = both_forms(name)
    q, v = start(name)
    d = np.random.default_rng(2).normal(size=N)

    def of(system):
        def f(s, m):
            return jnp.vdot(d, system.acceleration(q + s * d, v, 0.0, {"m": m}))

        forward = jax.jvp(jax.grad(f, argnums=(0, 1)), (0.0, 1.3), (1.0, 0.5))
        return jnp.array(jax.tree.leaves(forward))  # first by reverse mode, second by forward over reverse

    exact = of(scalar)
    np.testing.assert_allclose(jax.jit(lambda: of(sparse))(), exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


def test_the_nearest_consistent_state_is_stationary_on_the_constraints():
    """f(q̂) = 0 and M (q̂ − q) is a combination of gradients; the same for velocities, with M and G at q̂."""
    system, _ = both_forms("rods")
    q0, v0 = start("rods")
    q0 = q0 + 0.02 * np.random.default_rng(3).normal(size=N)
    q, v = system.project(q0, v0, 0.0, {"m": 1.3})
    np.testing.assert_allclose(jax.jit(rods)(q)["rods"], 0, atol=1e-14)
    jacobian = np.asarray(jax.jit(jax.jacfwd(lambda q: rods(q)["rods"]))(q))
    np.testing.assert_allclose(jacobian @ v, 0, atol=1e-13)
    for place, moved in ((q0, q - q0), (q, v - v0)):
        push = 1.3 * (1 + 0.1 * np.sin(place)) * moved
        rest = push - jacobian.T @ np.linalg.lstsq(jacobian.T, push)[0]
        np.testing.assert_allclose(rest, 0, atol=1e-12)


def ring(n: int) -> lagjax.System:
    m = np.ones(n)
    m[n // 3] = 5.0

    def lagrangian(q, qdot):
        return 0.5 * jnp.sum(m * qdot**2) - jnp.sum(0.5 * (q - jnp.roll(q, 1)) ** 2 + 0.25 * (q**2 - 1) ** 2)

    return lagjax.System(lagrangian)


@pytest.mark.slow
def test_a_large_ring_runs_on_arrays_as_in_machine_code():
    rng, n = np.random.default_rng(1), 600
    q, v, ts = 0.3 * rng.normal(size=n), 0.3 * rng.normal(size=n), np.array([0.0, 1.0])
    system = ring(n)
    by_arrays = lagjax.simulate(system, q, v, ts)
    in_machine_code = lagjax.simulate(system, q, v, ts, solver=lagjax.MachineCode())
    assert (by_arrays.engine, in_machine_code.engine) == ("Diffrax", "MachineCode")
    np.testing.assert_allclose(by_arrays.q, in_machine_code.q, rtol=0, atol=1e-8)
    members = lagjax.simulate_batch(system, np.stack([q, 2 * q]), np.stack([v, v]), ts)
    np.testing.assert_array_equal(members.q[0], by_arrays.q)  # one after the other, not in lockstep
    assert "600" in str(system.explain(q, v)) and "diagonal" in str(system.explain(q, v))


@pytest.mark.slow
def test_gradients_of_a_large_ring():
    rng, n = np.random.default_rng(1), 600
    q, v, d = (0.3 * rng.normal(size=n) for _ in range(3))
    system = ring(n)

    def end(q, rtol=1e-11):
        return jnp.sum(lagjax.simulate(system, q, v, np.array([0.0, 1.0]), rtol=rtol).q[-1] ** 2)

    by_differences = (end(q + 1e-5 * d) - end(q - 1e-5 * d)) / 2e-5
    np.testing.assert_allclose(jax.grad(end)(q) @ d, by_differences, rtol=1e-7)


def test_a_large_scene_is_lowered_for_gpus_without_the_host_and_without_a_matrix():
    n = 600
    system, v, ts = ring(n), jnp.zeros(n), jnp.array([0.0, 1.0])
    run = jax.jit(lambda q: lagjax.simulate(system, q, v, ts, throw=False).q)
    text = run.trace(jnp.ones(n)).lower(lowering_platforms=("cuda",)).as_text()
    assert "callback" not in text and f"{n}x{n}x" not in text


def test_patterns_are_those_of_every_state():
    """What is zero at q = 0 alone, or where a branch is not taken, is no zero of the pattern."""

    def lagrangian(q, qdot):
        coupled = jnp.sum(q[:-1] * qdot[:-1] * qdot[1:])
        return 0.5 * jnp.sum(qdot**2) + 0.1 * coupled + 0.1 * jnp.where(q[0] > 5, qdot[0] * qdot[-1], 0.0)

    q = np.zeros(N)
    structure = derivation_of(lagjax.System(lagrangian, path="array"), Layout.from_state(q, q), None).form.structure
    rows, columns = structure.mass.rows, structure.mass.columns
    assert ((rows == 0) & (columns == N - 1)).any() and ((rows == 3) & (columns == 4)).any()


def test_a_dense_mass_of_many_coordinates_is_solved_by_products():
    rng, n = np.random.default_rng(4), 600
    u = rng.normal(size=n) / np.sqrt(n)

    def lagrangian(q, qdot):
        return 0.5 * jnp.sum(qdot**2) + 0.5 * (u @ qdot) ** 2 - jnp.sum(jnp.cos(q))

    system, q = lagjax.System(lagrangian, path="array"), 0.3 * rng.normal(size=n)
    structure = derivation_of(system, Layout.from_state(q, q), None).form.structure
    assert isinstance(structure.mass, MatrixFree)
    force = np.sin(q)
    np.testing.assert_allclose(system.acceleration(q, 0 * q), force - u * (u @ force) / (1 + u @ u), rtol=0, atol=1e-14)


def test_a_coordinate_without_any_energy_makes_a_sparse_mass_singular():
    """Conjugate gradients would leave it at rest: its force is zero as well."""
    counts = np.ones(N)
    counts[34] = 0

    def lagrangian(q, qdot):
        return plate(counts * q, counts * qdot, 0.0, {"m": 1.0})

    system, (q, v) = lagjax.System(lagrangian, path="array"), start("sparse")
    structure = derivation_of(system, Layout.from_state(q, v), None).form.structure
    assert isinstance(structure.mass, Sparse)
    assert np.isnan(system.acceleration(q, v)).all()


# ---- patterns that must not be believed ------------------------------------------------------------------------------


@jax.jit
def pick(x, index):
    return x[index]


def known_and_given(q, v, params):  # two calls of one compiled function share the variables of its operations
    return pick(v, np.roll(np.arange(N), 1)) * v + 2 * pick(v, params) * v


def in_rounds(q, v, params):
    def body(y, k):
        return y + 0.1 * pick(y, np.arange(4)).sum() + 0.1 * pick(y, params[:4] + 0 * k).sum(), None

    return jax.lax.scan(body, v, jnp.arange(2))[0] * v


COUPLINGS = {
    "two calls": known_and_given,
    "in a loop": in_rounds,
    "whole quotients": lambda q, v, params: v[2 * jax.lax.div(jnp.arange(N), 2)] * v,
    "whole remainders": lambda q, v, params: v[50 + jax.lax.rem(jnp.arange(N) - 50, 10)] * v,
    "by the order of q": lambda q, v, params: jnp.take(v, jnp.arange(N) // 2) * v + jnp.take(v, jnp.argsort(q)) * v,
    "sorted": lambda q, v, params: jnp.sort(v.reshape(-1, 4), axis=1)[:, 0] ** 2,
    "convolved with itself": lambda q, v, params: jnp.convolve(v, v[:3], mode="same"),
}


@pytest.mark.parametrize("name", ["two calls", "whole quotients"])
def test_the_pattern_of_a_coupling_holds_all_of_its_entries(name):
    """By `jax.hessian`; nothing of the scene is compiled but its pattern and two products."""
    q, v, params = np.cos(np.arange(1.0, N + 1)), np.sin(np.arange(N) * 0.7), np.roll(np.arange(N), 5)

    def kinetic(q, v, t, params):
        return 2.0 * jnp.sum(v**2) + 0.1 * jnp.sum(COUPLINGS[name](q, v, params))

    pattern = jacobian_pattern(jax.grad(kinetic, argnums=1), (q, v, np.zeros(()), params), by=1)
    matrix = np.asarray(jax.jit(jax.hessian(kinetic, argnums=1))(q, v, 0.0, params))
    assert ((matrix == 0) | pattern.toarray()).all()
    assert pattern.nnz == (N * N if name == "two calls" else 2 * N)


@pytest.mark.slow
@pytest.mark.parametrize("name", COUPLINGS)
def test_accelerations_of_couplings_solve_the_equations_of_motion(name):
    q, v, params = jnp.cos(jnp.arange(1.0, N + 1)), jnp.sin(jnp.arange(N) * 0.7), jnp.roll(jnp.arange(N), 5)

    def lagrangian(q, v, params):
        return 2.0 * jnp.sum(v**2) + 0.1 * jnp.sum(COUPLINGS[name](q, v, params)) - 0.5 * jnp.sum(q**2)

    acceleration = lagjax.System(lagrangian, path="array").acceleration(q, v, params=params)
    matrix = jax.hessian(lagrangian, argnums=1)(q, v, params)
    np.testing.assert_allclose(matrix @ acceleration, -q, atol=1e-10 * float(np.abs(matrix).max()))


def test_a_pattern_that_lacks_entries_is_not_believed(monkeypatch):
    import asdex

    found = asdex.jacobian_sparsity

    def lacking(*arguments, **options):
        whole = found(*arguments, **options)
        kept = np.asarray(whole.rows) == np.asarray(whole.cols)
        return asdex.SparsityPattern.from_coo(whole.rows[kept], whole.cols[kept], whole.shape)

    def momentum(v):
        return v * (2 + v) + 0.1 * jnp.roll(v, 1)

    assert jacobian_pattern(momentum, (np.ones(N),), by=0).nnz == 2 * N
    monkeypatch.setattr(asdex, "jacobian_sparsity", lacking)
    assert jacobian_pattern(momentum, (np.ones(N),), by=0) is None
