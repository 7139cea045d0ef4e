"""`System.to_c`, compiled by this machine's C compiler: accelerations to the last bit, steps, and what is refused."""

import ctypes
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PENDULUM, PENDULUM_IN_GRAVITY, RELAY, SADDLE, WEIGHT_ON_A_SLIDE
from sweeps import sweep

import lagjax
from lagjax import scenes
from lagjax._interface import Layout

COMPILER = shutil.which("cc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
STATES = 1000


@pytest.fixture
def built(tmp_path):
    """Functions of a scene in C, of arrays: `function(name, size)(q, qdot, t, *numbers)` gives `size` numbers."""

    def build(text, kind=np.float64):
        source, library = (
            tmp_path / f"{len(list(tmp_path.iterdir()))}.c",
            tmp_path / f"{len(list(tmp_path.iterdir()))}.so",
        )
        source.write_text(text)
        level = "-O2" if len(text) < 500_000 else "-O0"  # a megabyte, of the solar system, takes eight times as long
        flags = ["-std=c99", level, "-ffp-contract=off", "-Wall", "-Werror", "-shared", "-fPIC"]
        subprocess.run([COMPILER, *flags, str(source), "-o", str(library), "-lm"], check=True)
        loaded, scalar = ctypes.CDLL(str(library)), {np.float64: ctypes.c_double, np.float32: ctypes.c_float}[kind]

        def function(name, size):
            def call(q, qdot, t, *numbers):
                given = [np.ascontiguousarray(x, kind) for x in (q, qdot, *numbers)]
                places = [ctypes.c_void_p(x.ctypes.data) for x in given]
                out = np.empty(size, kind)
                getattr(loaded, name)(*places[:2], scalar(t), *places[2:], ctypes.c_void_p(out.ctypes.data))
                return out

            return call

        def step(name, q, qdot, t, dt, steps, *numbers):
            q, qdot, *given = (np.array(x, kind, order="C") for x in (q, qdot, *numbers))
            places = [ctypes.c_void_p(x.ctypes.data) for x in (q, qdot, *given)]
            getattr(loaded, name)(*places[:2], scalar(t), *places[2:], scalar(dt), ctypes.c_long(steps))
            return q, qdot

        return function, step

    return build


def numbers_of(params):
    leaves = [np.ravel(np.asarray(x, float)) for x in jax.tree.leaves(params)]
    return [np.concatenate(leaves)] if leaves else []


def states_about(q, qdot, spread, count=STATES):
    layout, rng = Layout.from_state(q, qdot), np.random.default_rng(0)
    rows = np.array([np.ravel(layout.flatten(x)) for x in (q, qdot)])[:, None]
    return layout, *(rows + spread * rng.normal(size=(2, count, layout.size)))


def require_bits(built, system, q, qdot, params=None, t=0.3, spread=0.3):
    layout, positions, rates = states_about(q, qdot, spread)

    @jax.jit
    @jax.vmap
    def exact(q, qdot):
        of = layout.restore(q), layout.restore(qdot), t, params
        return layout.flatten(system.acceleration(*of)), system.mass_matrix(*of), system.energy(*of)

    accelerations, matrices, energies = map(np.asarray, exact(positions, rates))
    function, _ = built(system.to_c(q, qdot, params=params))
    n = layout.size
    of = {"acceleration": n, "mass_matrix": n * n, "energy": 1}
    given = numbers_of(params)
    for (name, size), wanted in zip(of.items(), (accelerations, matrices.reshape(-1, n * n), energies), strict=True):
        call = function(f"scene_{name}", size)
        found = np.array([call(x, v, t, *given) for x, v in zip(positions, rates, strict=True)])
        if name == "energy":  # whose last sum is XLA's
            np.testing.assert_allclose(found[:, 0], wanted, rtol=1e-13, atol=1e-13 * np.abs(wanted).max())
        else:
            np.testing.assert_array_equal(found, wanted)


READY = [scenes.double_pendulum, scenes.damped_driven_oscillator, scenes.chaplygin_sleigh, scenes.slider_crank,
         scenes.kepler, scenes.spherical_pendulum, scenes.driven_pendulum, scenes.rolling_disc,
         scenes.cartesian_double_pendulum, scenes.morse_oscillator, scenes.figure_eight,
         scenes.relativistic_charge_in_magnetic_field, scenes.chain]  # fmt: skip


@pytest.mark.parametrize("make", sweep(READY, kept=READY[:5]), ids=lambda make: make.__name__)
def test_accelerations_in_c_have_the_same_bits(built, make):
    scene = make()
    require_bits(built, scene.system, scene.q0, scene.qdot0, scene.params, spread=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("make", [make for make in scenes.ALL if make not in READY], ids=lambda make: make.__name__)
def test_accelerations_of_all_scenes_in_c_have_the_same_bits(built, make):
    scene = make()
    require_bits(built, scene.system, scene.q0, scene.qdot0, scene.params, spread=0.1)


def pieces_and_functions(q, v):
    smooth = jnp.tanh(q[0]) + jnp.exp(-(q[1] ** 2)) + jnp.cbrt(q[2]) + jnp.arctan2(q[0], q[1]) + jnp.log1p(q[2] ** 2)
    pieces = jnp.abs(q[0]) + jnp.maximum(q[1], q[2]) + jnp.where(q[0] > q[1], jnp.sinh(q[2]), q[2] ** 3)
    smooth += jnp.logaddexp(q[0], q[2]) + jax.nn.softplus(9 * q[1])
    return 0.5 * jnp.sum((1.5 + jnp.sin(q)) * v**2) - smooth - pieces - jnp.abs(q[1]) ** 2.5


def jumping_forces(q, v):
    return jnp.sign(v) + jnp.floor(q) - jnp.round(q) + q % 1.3 + jnp.minimum(v, 0.2)


PIECES = lagjax.System(pieces_and_functions, forces=jumping_forces)
SINGULAR = lagjax.System(lambda q, v: 0.5 * q**2 * v**2)
BOUNCING = lagjax.System(lambda q, v: 0.5 * v**2 - q, contacts=lambda q: q)
REFUSED = lagjax.System(lambda q, v: 0.5 * v @ v - jnp.linalg.svd(jnp.outer(q, q))[1][0])


def test_branches_functions_and_large_angles_have_the_same_bits(built):
    require_bits(built, PIECES, np.array([0.2, -0.3, 0.4]), np.zeros(3), spread=2.0)
    require_bits(built, PENDULUM, 0.0, 0.0, spread=1e6)  # on both sides of what our own sine takes
    require_bits(built, SADDLE, np.zeros(2), np.zeros(2))  # M is not definite


def test_zero_rest_and_what_is_not_finite(built):
    function, _ = built(PENDULUM_IN_GRAVITY.to_c(0.0, 0.0, params={"g": 9.81}))
    call = function("scene_acceleration", 1)
    for q in (0.0, -0.0, np.inf, np.nan, 1e300):
        exact = jax.jit(PENDULUM_IN_GRAVITY.acceleration)(q, 0.0, 0.0, {"g": 9.81})
        found = call([q], [0.0], 0.0, [9.81])[0]
        assert np.array_equal(found, exact, equal_nan=True) and (
            np.isnan(found) or np.signbit(found) == np.signbit(exact)
        )
    assert np.isnan(built(SINGULAR.to_c(1.0, 0.0))[0]("scene_acceleration", 1)([0.0], [0.0], 0.0))


KNOTS, VALUES = np.linspace(0.0, 2.0, 9), np.sin(3 * np.linspace(0.0, 2.0, 9))


def sampled(q, v, t, params):
    force = lagjax.samples(KNOTS, VALUES)(t) + lagjax.samples(KNOTS, params["of"], hold="cubic")(t)
    return 0.5 * v**2 + force * q + params["c"] ** params["n"] * q**2


def counted(q, v, params):
    return jnp.asarray(jnp.floor(4 * q), int) // 3 + (params["n"] * 2) % 3


SAMPLED = lagjax.System(sampled, forces=counted)


def test_whole_numbers_and_tables(built):
    params = {"of": VALUES + 1.0, "c": 0.7, "n": 3}
    function, _ = built(SAMPLED.to_c(0.1, 0.2, params=params))
    call = function("scene_acceleration", 1)
    for t in (-0.1, 0.0, 0.3, 0.25, 1.99, 2.0, 2.5):
        exact = SAMPLED.acceleration(0.1, 0.2, t, params)
        np.testing.assert_allclose(call([0.1], [0.2], t, *numbers_of(params))[0], exact, rtol=1e-13)


def test_steps_are_those_of_runge_and_kutta(built):
    scene = scenes.damped_driven_oscillator()
    system, params = scene.system, scene.params
    layout = Layout.from_state(scene.q0, scene.qdot0)

    def rate(y, t):
        q, v = np.split(y, 2)
        a = system.acceleration(layout.restore(q), layout.restore(v), t, params)
        return np.concatenate([v, np.ravel(a)])

    y, t, dt = np.concatenate([np.ravel(scene.q0), np.ravel(scene.qdot0)]), 0.2, 0.05
    _, step = built(system.to_c(scene.q0, scene.qdot0, params=params))
    found = step("scene_step", scene.q0, scene.qdot0, t, dt, 3, *numbers_of(params))
    for k in range(3):
        s = t + k * dt
        a = rate(y, s)
        b = rate(y + dt / 2 * a, s + dt / 2)
        c = rate(y + dt / 2 * b, s + dt / 2)
        d = rate(y + dt * c, s + dt)
        y = y + dt / 6 * (a + 2 * b + 2 * c + d)
    np.testing.assert_allclose(np.concatenate([np.ravel(x) for x in found]), y, rtol=1e-13)


def test_steps_stay_on_constraints_and_converge(built):
    scene = scenes.cartesian_double_pendulum()
    _, step = built(scene.system.to_c(scene.q0, scene.qdot0, params=scene.params))
    end = lagjax.simulate(scene.system, scene.q0, scene.qdot0, np.array([0.0, 0.5]), scene.params, rtol=1e-12)
    errors = []
    for steps in (50, 100):
        q, v = step("scene_step", scene.q0, scene.qdot0, 0.0, 0.5 / steps, steps, *numbers_of(scene.params))
        residual = scene.system.constraint_residual(q, v, 0.0, scene.params)
        assert max(np.abs(x).max() for x in jax.tree.leaves(residual)) < 1e-12
        errors.append(np.abs(q - end.q[-1]).max())
    assert errors[1] < errors[0] / 10  # 16 by the order
    assert "scene_project" in WEIGHT_ON_A_SLIDE.to_c(np.ones(2), np.ones(2))


def test_single_precision(built):
    scene = scenes.double_pendulum()
    text = scene.system.to_c(scene.q0, scene.qdot0, params=scene.params, dtype="float32", name="arm")
    assert "double" not in text.split("*/", 1)[1]
    function, step = built(text, np.float32)
    exact = scene.system.acceleration(scene.q0, scene.qdot0, 0.0, scene.params)
    numbers = numbers_of(scene.params)
    found = function("arm_acceleration", 2)(scene.q0, scene.qdot0, 0.0, *numbers)
    np.testing.assert_allclose(found, exact, rtol=2e-5)
    end = lagjax.simulate(scene.system, scene.q0, scene.qdot0, np.array([0.0, 0.1]), scene.params)
    np.testing.assert_allclose(
        step("arm_step", scene.q0, scene.qdot0, 0.0, 0.01, 10, *numbers)[0], end.q[-1], rtol=1e-4
    )


def test_long_lines_are_several_functions(built, monkeypatch):
    monkeypatch.setattr("lagjax._native.motions._c_lines.LONGEST_IN_C", 20)
    scene = scenes.slider_crank()
    text = scene.system.to_c(scene.q0, scene.qdot0, params=scene.params)
    assert "void scene_acceleration_3(" in text
    require_bits(built, scene.system, scene.q0, scene.qdot0, scene.params, spread=0.05)


def test_what_c_cannot_follow_is_said():
    assert "No scene_step" in RELAY.to_c(0.1, 0.2) and "scene_acceleration" in RELAY.to_c(0.1, 0.2)
    with pytest.raises(TypeError, match="contacts"):
        BOUNCING.to_c(1.0, 0.0)
    with pytest.raises(ValueError, match="dtype"):
        RELAY.to_c(0.1, 0.2, dtype="float16")
    with pytest.raises(ValueError, match="identifier"):
        RELAY.to_c(0.1, 0.2, name="my scene")
    with pytest.raises(ValueError, match="must agree"):
        RELAY.to_c(0.1, np.ones(2))
    with pytest.raises(ValueError, match="no scalar program, and therefore no C"):
        REFUSED.to_c(np.ones(40), np.ones(40))


PUSHED = lagjax.System(
    lambda q, v, params: 0.5 * params["m"] * v**2, forces=lambda q, v, t, inputs: inputs["u"] * jnp.cos(t)
)


def test_inputs_are_an_array_of_their_own(built):
    given = {"q": 0.1, "qdot": 0.2, "params": {"m": 2.0}, "inputs": {"u": 3.0}}
    function, step = built(PUSHED.to_c(**given))
    assert function("scene_acceleration", 1)([0.1], [0.2], 0.0, [2.0], [3.0]) == 1.5
    _, v = step("scene_step", [0.1], [0.2], 0.0, 0.1, 10, [2.0], [3.0])
    np.testing.assert_allclose(v, 0.2 + 1.5 * np.sin(1.0), rtol=1e-6)
    assert PUSHED.equations(**given).force == {"q": "u*cos(t)"}
    with pytest.raises(TypeError, match="asks for `inputs`"):
        PUSHED.to_c(0.1, 0.2, params={"m": 2.0})


def test_a_state_in_single_precision_is_exported_too(built):
    text = PENDULUM_IN_GRAVITY.to_c(np.float32(0.1), np.float32(0.2), params={"g": np.float32(9.81)})
    found = built(text)[0]("scene_acceleration", 1)([0.1], [0.2], 0.0, [9.81])
    np.testing.assert_allclose(found, -9.81 * np.sin(0.1), rtol=1e-15)
