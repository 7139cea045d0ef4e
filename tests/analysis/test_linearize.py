"""`linearize` as engineers use it: A, B, C, D and Φ, Γ against SciPy, hand calculation, and the motion itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import lagjax

G, L = 9.81, 0.7


def cart(q, v, params):
    """A pendulum of mass 1 upside down on a cart of mass M: x, and the angle a from above."""
    kinetic = 0.5 * (params["M"] + 1) * v["x"] ** 2 + v["x"] * v["a"] * L * jnp.cos(q["a"]) + 0.5 * (L * v["a"]) ** 2
    return kinetic - G * L * jnp.cos(q["a"])


def push(q, v, inputs):
    return {"x": inputs["f"], "a": -0.1 * v["a"]}


def tip(q, v):
    return {"tip": q["x"] + L * jnp.sin(q["a"])}


CART, PUSHED = lagjax.System(cart, forces=push), {"f": 0.0}
TOP, M = {"a": 0.0, "x": 0.0}, {"M": 2.0}
FREE = lagjax.System(lambda q, v: 0.5 * v**2)
PLAIN = lagjax.System(cart, dissipation=lambda q, v: 0.05 * v["a"] ** 2)
ROD_OF_LENGTH = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1], constraints=lambda q, params: q @ q - params**2)
ROD = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1], constraints=lambda q: q @ q - L**2)
SKATE = lagjax.System(
    lambda q, v: 0.5 * v @ v, velocity_constraints=lambda q, v: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2])
)


def test_inputs_and_outputs_by_hand():
    linear = lagjax.linearize(CART, TOP, params=M, inputs=PUSHED, outputs=tip)
    # M x'' + L a'' + x'' = f,  L x'' + L² a'' = G L a − 0.1 a'
    mass = np.array([[L**2, L], [L, 3.0]])
    right = np.array([[G * L, 0.0, -0.1, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
    expected = np.linalg.solve(mass, right)
    np.testing.assert_allclose(np.hstack([linear.A, linear.B])[2:], expected, atol=1e-13)
    np.testing.assert_allclose(linear.C, [[L, 1.0, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_array_equal(linear.D, [[0.0]])
    names = linear.names
    assert names == ("q['a']", "q['x']") and names.inputs == ("u['f']",) and names.outputs == ("y['tip']",)
    assert str(linear).splitlines()[2] == "δy['tip'] = 0.7 δq['a'] +1 δq['x']" and "+0.5 u['f']" in str(linear)


@pytest.mark.parametrize(("system", "inputs"), [(CART, PUSHED), (PLAIN, None)])
def test_samples_at_an_equilibrium_are_those_of_scipy(system, inputs):
    linear = lagjax.linearize(system, TOP, params=M, inputs=inputs, outputs=tip, dt=0.05)
    continuous = tuple(map(np.asarray, (linear.A, linear.B, linear.C, linear.D)))
    phi, gamma, *_ = scipy.signal.cont2discrete(continuous, 0.05)
    np.testing.assert_allclose(linear.Phi, phi, atol=1e-12)
    np.testing.assert_allclose(linear.Gamma, gamma, atol=1e-12)
    np.testing.assert_allclose(linear.Phi, scipy.linalg.expm(0.05 * continuous[0]), atol=1e-12)


@pytest.mark.slow
def test_samples_along_a_motion_are_those_of_the_motion():
    q, v, force = {"a": 1.2, "x": 0.0}, {"a": -0.5, "x": 2.0}, {"f": 3.0}
    linear = lagjax.linearize(CART, q, v, M, inputs=force, dt=0.4)
    knots = np.array([0.0, 1.0])

    def end(y, f):
        def held(q, v, t):
            return push(q, v, {"f": lagjax.samples(knots, jnp.stack([f, f]))(t)})

        (a, x, da, dx), system = y, lagjax.System(cart, forces=held)
        run = lagjax.simulate(system, {"a": a, "x": x}, {"a": da, "x": dx}, np.array([0.0, 0.4]), M, rtol=1e-12).end
        return np.array([run.q["a"], run.q["x"], run.qdot["a"], run.qdot["x"]])

    y, h = np.array([1.2, 0.0, -0.5, 2.0]), 1e-4
    for k, unit in enumerate(np.eye(4)):
        np.testing.assert_allclose(
            linear.Phi[:, k], (end(y + h * unit, 3.0) - end(y - h * unit, 3.0)) / (2 * h), atol=1e-6
        )
    np.testing.assert_allclose(linear.Gamma[:, 0], (end(y, 3.0 + h) - end(y, 3.0 - h)) / (2 * h), atol=1e-6)


def test_outputs_may_read_inputs_and_params():
    linear = lagjax.linearize(
        CART, TOP, params=M, inputs={"f": 2.0}, outputs=lambda q, v, inputs, params: params["M"] * inputs["f"] ** 2
    )
    np.testing.assert_allclose(linear.D, [[8.0]])
    np.testing.assert_array_equal(linear.C, np.zeros((1, 4)))
    whole = lagjax.linearize(CART, TOP, params=M, inputs=PUSHED)
    np.testing.assert_array_equal(whole.C, np.eye(4))
    assert whole.names.outputs == whole.names.states and whole.D.shape == (4, 1)


@pytest.mark.slow
def test_a_regulator_for_every_member_of_a_batch():
    def gain(a):
        linear = lagjax.linearize(CART, {"a": a, "x": 0.0}, params=M, inputs=PUSHED, dt=0.02)
        phi, gamma = linear.Phi, linear.Gamma

        def iterate(p, _):
            gain = gamma.T @ p / (1 + gamma.T @ p @ gamma)
            return jnp.eye(4) + phi.T @ (p - p @ gamma @ gain) @ phi, None

        p = jax.lax.scan(iterate, jnp.eye(4), None, 4000)[0]
        return linear.Phi, linear.Gamma, p

    phi, gamma, p = jax.jit(jax.vmap(gain))(np.linspace(-0.4, 0.4, 64))
    for k in (0, 20, 63):
        right = scipy.linalg.solve_discrete_are(np.asarray(phi[k]), np.asarray(gamma[k]), np.eye(4), np.eye(1))
        np.testing.assert_allclose(p[k], right, rtol=1e-7)


def test_reduced_equations_have_the_fewest_states():
    low = np.array([0.0, -L])
    reduced = lagjax.linearize(ROD, low, dt=0.1).reduced()
    assert reduced.A.shape == (2, 2) and reduced.basis.shape == (4, 2)
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(reduced.A).imag), np.array([-1, 1]) * (G / L) ** 0.5, rtol=1e-12
    )
    np.testing.assert_allclose(reduced.Phi, scipy.linalg.expm(0.1 * np.asarray(reduced.A)), atol=1e-11)
    regulator = scipy.linalg.solve_continuous_are(
        np.asarray(reduced.A), np.asarray(reduced.B)[:, :1], np.eye(2), np.eye(1)
    )
    closed = reduced.A - reduced.B[:, :1] @ reduced.B[:, :1].T @ regulator
    assert np.linalg.eigvals(closed).real.max() < 0


@pytest.mark.slow
def test_a_blade_turns_with_its_skate():
    """x' sin φ − y' cos φ keeps (δφ, δx', δy') in a plane."""
    sliding = lagjax.linearize(SKATE, np.zeros(3), np.array([2.0, 0.0, 0.0])).reduced()
    assert sliding.A.shape == (5, 5)
    np.testing.assert_allclose(2.0 * sliding.basis[2] - sliding.basis[4], 0.0, atol=1e-14)


@pytest.mark.slow
def test_transformations():
    def sample(m):
        linear = lagjax.linearize(CART, TOP, params={"M": m}, inputs=PUSHED, outputs=tip, dt=0.05)
        return jnp.concatenate([x.ravel() for x in (linear.A, linear.B, linear.C, linear.Phi, linear.Gamma)])

    h = 1e-4
    by_m = (sample(2.0 + h) - sample(2.0 - h)) / (2 * h)
    np.testing.assert_allclose(jax.jacfwd(sample)(2.0), by_m, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacrev(sample)))(jnp.array([1.0, 2.0]))[1], by_m, atol=1e-7)
    twice = (sample(2.0 + h) - 2 * sample(2.0) + sample(2.0 - h)) / h**2
    np.testing.assert_allclose(jax.jacfwd(jax.jacrev(sample))(2.0), twice, atol=1e-5)
    eigenvalue = jax.jacfwd(lambda r: jnp.trace(jnp.linalg.matrix_power(lagjax.linearize(
        ROD_OF_LENGTH, jnp.stack([0.0, -r]), params=r).reduced().A, 2)))  # fmt: skip
    np.testing.assert_allclose(eigenvalue(L), 2 * G / L**2, rtol=1e-10)  # of −2 G/L
    single = lagjax.linearize(CART, {"a": np.float32(0), "x": np.float32(0)}, params=M, inputs=PUSHED, dt=0.05)
    assert single.A.dtype == single.Phi.dtype == np.float32
    np.testing.assert_allclose(single.Gamma, sample(2.0)[-4:, None], rtol=1e-5)


def test_outputs_at_a_kink_or_a_jump():
    for outputs, words in ((lambda q, v: jnp.abs(q), "another slope"), (lambda q, v: (9.0 * q, jnp.sign(v)), "jump")):
        with pytest.raises(ValueError, match=rf"outputs does not exist .*{words}.* at .*test_linearize\.py"):
            lagjax.linearize(FREE, 0.0, outputs=outputs)
        found = jax.jit(lambda q, v, of=outputs: lagjax.linearize(FREE, q, v, outputs=of).C)
        assert np.isnan(found(0.0, 0.0)).all() and np.isfinite(found(0.1, 0.1)).all()
    np.testing.assert_array_equal(lagjax.linearize(FREE, 0.0, outputs=lambda q, v: jnp.maximum(q, 0) ** 2).C, 0)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"inputs": {"f": np.nan}}, "inputs['f'] is nan"),
        ({"inputs": {"f": "a"}}, "inputs['f'] must be a real number"),
        ({"inputs": PUSHED, "dt": 0.0}, "dt is the sample time, a positive number"),
        ({"inputs": PUSHED, "outputs": lambda q, v: ()}, "outputs must return at least one number"),
        ({"inputs": PUSHED, "outputs": lambda q, v: 1}, "outputs must hold real floating-point numbers"),
        ({}, "push asks for `inputs`"),
    ],
)
def test_wrong_arguments(arguments, sentence):
    with pytest.raises((TypeError, ValueError)) as error:
        lagjax.linearize(CART, TOP, params=M, **arguments)
    assert sentence in str(error.value)


@pytest.mark.parametrize("inputs", [0.0, {"g": 0.0}])
def test_inputs_of_another_structure_are_told_with_what_reads_them(inputs):
    with pytest.raises((TypeError, KeyError)) as error:
        lagjax.linearize(CART, TOP, params=M, inputs=inputs)
    assert "push" in error.value.__notes__[0] and "inputs" in error.value.__notes__[0]


MOVED = lagjax.System(lambda q, v: 0.5 * v @ v, constraints=lambda q, inputs: q[0] - inputs)


def test_inputs_that_nothing_or_a_constraint_reads():
    with pytest.raises(ValueError, match="no function of the scene asks for `inputs`"):
        lagjax.linearize(PLAIN, TOP, params=M, inputs=1.0)
    with pytest.raises(ValueError, match="constraints asks for `inputs`"):
        lagjax.linearize(MOVED, np.zeros(2), inputs=0.0)
    with pytest.raises(AttributeError, match="call linearize"):
        _ = lagjax.linearize(ROD, np.array([0.0, -L])).Phi
