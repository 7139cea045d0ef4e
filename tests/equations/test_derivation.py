"""What is derived from a scene once: programs evaluated without a compiler, and `explain` against what runs."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scenes import SADDLE, in_potential, weight_on

import lagjax
from lagjax import scenes
from lagjax._engine import diffrax as _diffrax
from lagjax._engine import taylor as _machine_code
from lagjax._equations import _form
from lagjax._equations import _many_states as many_states
from lagjax._equations._derivation import Derivation, columns_of, derivation_of, numbers_of
from lagjax._interface import Layout
from lagjax._program import OPERATIONS, Unlowerable, pullback
from lagjax._program._line import CHUNK
from lagjax._tracing import lower
from lagjax._trust.checks import _scene_at_start as of_check
from lagjax._trust.health import _measurements as of_health

# ---- evaluation in NumPy ---------------------------------------------------------------------------------------------

SHIFTED = {  # at arguments between 0.1 and 0.9
    "acosh": lambda x: lax.acosh(1 + x), "abs": lambda x: jnp.abs(x - 0.5), "sign": lambda x: x * jnp.sign(x - 0.5),
    "floor": lambda x: x * jnp.floor(3 * x), "ceil": lambda x: x * jnp.ceil(3 * x),
    "round": lambda x: x * jnp.round(3 * x), "convert": lambda x: x * (3 * x).astype(int),
    "is_finite": lambda x: jnp.where(jnp.isfinite(1 / x), x, 0.0),
    "not": lambda x: jnp.where(~(x > 0.3), x, 1.0),
    "rem": lambda x, y: lax.rem(5 * x, y), "select": lambda x, y: jnp.where((x > y) & (x > 0.3), x * y, y),
}  # fmt: skip
EVERY = {
    name: SHIFTED.get(name) or getattr(lax, row.lax or name, None) or getattr(jnp, name)
    for name, row in OPERATIONS.items() if name in SHIFTED or not row.is_step
}  # fmt: skip
HYPERBOLA = lagjax.System(lambda q, v: 0.5 * v @ v, constraints=lambda q: (0.5 * (q[0] * q[1])) ** 2 - 1.0)
ZERO_ANGLE = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q @ q + 0.0 * jnp.arctan2(q[1], q[0]))


def test_every_operation_for_many_states_at_once_and_its_transpose():
    x = np.random.default_rng(0).uniform(0.1, 0.9, (2, CHUNK + 7))

    def everything(x, y):
        return jnp.stack([f(x) if OPERATIONS[name].arity == 1 else f(x, y) for name, f in EVERY.items()])

    program = lower(everything, 1.0, 1.0)
    values = program.evaluate_many(x)
    assert values.shape == (len(EVERY), CHUNK + 7)
    np.testing.assert_array_equal(values[:, 5], program.evaluate(*x[:, 5]))
    np.testing.assert_allclose(values, jax.jit(everything)(*x).reshape(values.shape), rtol=1e-13)
    # A number that all states share is as good as a column of it.
    np.testing.assert_array_equal(
        program.evaluate_many([x[0], 0.4]), program.evaluate_many([x[0], np.full_like(x[0], 0.4)])
    )

    weights = np.linspace(-1.0, 1.0, len(values))
    pulled = program.line.vjp(x, weights)
    exact = jax.jit(jax.vmap(jax.grad(lambda x, y: weights @ everything(x, y), argnums=(0, 1))))(*x)
    np.testing.assert_allclose(pulled, exact, rtol=1e-12, atol=1e-13)
    # As a straight line of its own.
    transposed = pullback(program.line, program.dtypes, [0, 1], range(len(weights)))
    np.testing.assert_allclose(transposed.evaluate([*x, *weights]), exact, rtol=1e-12, atol=1e-13)
    # Of many outputs at one state: cotangents side by side.
    rows = program.line.vjp(x[:, 3], np.eye(len(weights)))
    np.testing.assert_allclose(np.stack(rows) @ weights, [column[3] for column in pulled], rtol=1e-12, atol=1e-13)


def test_round_off_is_bounded_and_seen_where_terms_cancel():
    def function(x, y):
        return jnp.stack([(x + y) ** 2 - x**2 - 2 * x * y - y**2, jnp.sin(x * y) / (x - y), jnp.sqrt(x) * y])

    program, x = lower(function, 1.0, 1.0), np.random.default_rng(1).uniform(1.0, 2.0, (2, 500)).astype(np.float32)
    single, double = program.evaluate_many(x), program.evaluate_many(x.astype(float))
    bound = np.finfo(np.float32).eps * program.rounding_of(range(3), 0).evaluate_many(x)
    assert single.dtype == np.float32 and (np.abs(single - double) <= bound).all()
    # One unit in the last place for every operation, and not many times more.
    assert (bound[2] < 4 * np.finfo(np.float32).eps * np.abs(double[2])).all() and (bound[0] > 1e-7).all()


# ---- one derivation --------------------------------------------------------------------------------------------------


def of(system, q, qdot, params=None):
    return derivation_of(system, Layout.from_state(q, qdot), params)


def pendulum(q, qdot, params):
    return 0.5 * qdot**2 + params["g"] * jnp.cos(q)


def test_a_scene_is_derived_once_for_all_values():
    first = of(lagjax.System(pendulum), 0.1, 0.2, {"g": 9.81})
    assert of(lagjax.System(pendulum), jnp.array(0.3), jnp.array(0.4), {"g": jnp.array(1.62)}) is first
    assert first.accelerations.program is first.accelerations.program
    assert first.program("force") is first.program("force")
    assert of(lagjax.System(pendulum), jnp.float32(0.1), jnp.float32(0.2), {"g": 9.81}) is not first
    assert of(lagjax.System(lambda q, qdot, params: pendulum(q, qdot, params)), 0.1, 0.2, {"g": 9.81}) is not first


@jax.custom_jvp
def _cubic(x):
    return x**3


_cubic.defjvp(lambda x, dx: (_cubic(*x), 7.0 * x[0] * dx[0]))  # not its derivative: whose rule it is must show


def test_derivatives_that_a_lagrangian_defines_itself():
    scene = in_potential(lambda q: jnp.sum(jax.vmap(_cubic)(q)) + q[0] * jax.lax.stop_gradient(q[1]))
    q, v = np.array([[0.3, 0.7]]), np.zeros((1, 2))
    derivation = of(scene, q[0], v[0])
    force = derivation.evaluate(["force"], columns_of(q, v, 0.0, []))["force"][0]
    np.testing.assert_allclose(force, [-7 * 0.3 - 0.7, -7 * 0.7], rtol=1e-15)
    assert derivation.form_in_xla.kind == "arrays"  # a program keeps the rules of two derivatives alone


def test_powers_have_derivatives_where_their_products_and_roots_have_none():
    # x¹·⁵ is x √x, whose factors have no derivative at zero.
    scene = in_potential(
        lambda q: jnp.sum(jnp.maximum(q, 0.0) ** 2.5 + jnp.abs(q) ** 1.5 + q**20),
        constraints=lambda q: q[0] ** 2 + q[1] ** 1.5 - 0.125,
    )
    q, v = np.array([[0.0, 0.25]]), np.array([[0.3, 0.4]])
    derivation = of(scene, q[0], v[0])
    values = derivation.evaluate(["force", "jacobian", "gamma"], columns_of(q, v, 0.0, []))
    np.testing.assert_allclose(values["force"], [[0.0, -2.5 * 0.125 - 0.75 - 20 * 0.25**19]], rtol=1e-14)
    np.testing.assert_allclose(values["jacobian"], [[[0.0, 0.75]]], rtol=1e-14)
    np.testing.assert_allclose(values["gamma"], [[-2 * 0.09 - 1.5 * 0.16]], rtol=1e-14)


def test_derivatives_of_powers_of_multiples():
    # (c u)² is known as c² u², in which c u no longer appears; its derivative is that of the power.
    q, v = np.array([[1.0, 2.0]]), np.array([[0.3, -0.6]])
    values = of(HYPERBOLA, q[0], v[0])
    values = values.evaluate(["jacobian", "rates", "gamma"], columns_of(q, v, 0.0, []))
    np.testing.assert_allclose(values["jacobian"], [[[2.0, 1.0]]], rtol=1e-15)
    np.testing.assert_allclose(values["rates"], [[0.0]], atol=1e-15)
    np.testing.assert_allclose(values["gamma"], [[0.36]], rtol=1e-14)  # f = u²/4 − 1: −u̇²/2 − u q̇₁ q̇₂, u = 2, u̇ = 0


@pytest.mark.parametrize("make", [scenes.double_pendulum, scenes.chaplygin_sleigh])
def test_quantities_are_those_of_the_motion(make):
    scene = make()
    derivation = of(scene.system, scene.q0, scene.qdot0, scene.params)
    layout, motion, params = derivation.layout, derivation.motion, jax.tree.map(jnp.asarray, scene.params)
    rng = np.random.default_rng(0)
    q, qdot = (np.asarray(layout.flatten(x)) + 0.1 * rng.uniform(-1, 1, layout.size) for x in (scene.q0, scene.qdot0))
    state = q, qdot, np.asarray(0.3), params
    exact = jax.jit(motion.quantities)(*state)  # on arrays
    values = derivation.evaluate(sorted(exact), columns_of(q[None], qdot[None], 0.3, numbers_of(params)))
    for name, value in exact.items():
        scale = np.abs(value).max(initial=1e-300)
        np.testing.assert_allclose(values[name][0], value, rtol=1e-12, atol=1e-13 * scale, err_msg=name)
    np.testing.assert_allclose(exact["mass_matrix"], jax.jit(motion.mass_matrix)(*state), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(exact["force"], jax.jit(motion.mass_matrix_and_force)(*state)[1], rtol=1e-12, atol=1e-12)
    scalars = [*q, *qdot, 0.3, *numbers_of(params)]
    singular = bool(derivation.accelerations.program.evaluate(*scalars)[-1])
    program = derivation.accelerations.program.complete if singular else derivation.accelerations.program
    expected = jax.jit(motion.acceleration)(*state)
    np.testing.assert_allclose(program.evaluate(*scalars)[:-1], expected, rtol=1e-10, atol=1e-11)


def test_a_mass_matrix_in_blocks_costs_what_its_blocks_cost():
    def lagrangian(q, v):
        x, u = q.reshape(-1, 3), v.reshape(-1, 3)
        return 0.5 * jnp.sum(u**2) + jnp.sum(u[:, 0] * u[:, 1] * jnp.cos(x[:, 0] - x[:, 1])) / 4 - jnp.sum(x[:, 2] ** 2)

    one, many = (of(lagjax.System(lagrangian), *np.ones((2, n))).accelerations.program.operations for n in (3, 90))
    assert many <= 30 * one + 29  # disjunctions: whether any block is singular


def test_what_does_not_fit_in_memory_is_refused_before_it_is_tried(monkeypatch):
    def lagrangian(q, v):
        return 20 * v @ v + jnp.sum(jnp.outer(v, v) * jnp.cos(q[:, None] - q))

    small = of(lagjax.System(lagrangian), np.ones(16), np.ones(16))
    large = Derivation(small.motion, small.layout, None)
    assert large.program("force").operations > 0
    monkeypatch.setattr(_form, "OPERATION_BUDGET", 1000)
    with pytest.raises(Unlowerable, match=r"some \d+ operations, more than the 1000 that are expected to fit"):
        large.accelerations.program  # noqa: B018


def test_check_and_health_compile_nothing_where_there_are_programs(monkeypatch):
    def compiled(*_):
        raise AssertionError("compiled by XLA")

    monkeypatch.setattr(many_states, "_evaluate_compiled", compiled)
    monkeypatch.setattr(of_check, "_acceleration_slopes", compiled)
    monkeypatch.setattr(of_health, "_measure_traced", compiled)
    for make in (scenes.rolling_cylinder, scenes.damped_driven_oscillator):
        scene = make()
        assert lagjax.check(scene.system, scene.q0, scene.qdot0, 0.0, scene.params).ok
        run = lagjax.simulate(scene.system, scene.q0, scene.qdot0, np.linspace(0.0, 1.0, 5), scene.params)
        assert not run.health().suspicious
    # Arrays that a function holds could change: such a scene is compiled.
    with pytest.raises(AssertionError, match="compiled by XLA"):
        lagjax.check(lagjax.System(Learned(np.array([0.5]))), 0.3, 0.4)


def test_a_state_without_a_compiler_is_the_compiled_one():
    scene = scenes.cartesian_pendulum()
    state = scene.q0, scene.qdot0, 0.0, scene.params
    for name in ("acceleration", "energy", "constraint_force"):
        eager = getattr(scene.system, name)(*state)
        traced = jax.jit(getattr(scene.system, name))(*state)
        for a, b in zip(jax.tree.leaves(eager), jax.tree.leaves(traced), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)
    # Redundant constraints: the shortest multipliers in both.
    rod = lambda q: jnp.array([q @ q - 1.0, 3 * (q @ q) - 3.0])
    twice = weight_on(constraints=rod)
    q, v = jnp.array([0.6, -0.8]), jnp.array([0.4, 0.3])
    np.testing.assert_allclose(twice.multipliers(q, v), jax.jit(twice.multipliers)(q, v), rtol=1e-9)


def test_what_is_zero_is_folded_away_for_the_acceleration_too():
    # The angle has no derivative at the origin, and 0 times it does not need one: as in the motion.
    q, v = jnp.zeros(2), jnp.array([1.0, 0.5])
    assert lagjax.simulate(ZERO_ANGLE, q, v, np.array([0.0, 1.0])).ok
    for acceleration in (ZERO_ANGLE.acceleration, jax.jit(ZERO_ANGLE.acceleration)):
        np.testing.assert_array_equal(acceleration(q, v), np.zeros(2))
    np.testing.assert_array_equal(jax.vmap(ZERO_ANGLE.acceleration)(q[None], v[None]), np.zeros((1, 2)))
    np.testing.assert_allclose(jax.jacfwd(ZERO_ANGLE.acceleration)(q, v), -np.eye(2))


# ---- explain says what runs ------------------------------------------------------------------------------------------


class Learned(eqx.Module):
    weights: jax.Array

    def __call__(self, q, qdot):
        return 0.5 * jnp.sum(qdot**2) - self.weights[0] * jnp.sum(q**2)


class Unhashable:
    __hash__ = None

    def __call__(self, q, qdot):
        return 0.5 * jnp.sum(qdot**2) - jnp.sum(q**2)


def free(q, v):
    return 0.5 * jnp.sum(v**2) - 0.5 * jnp.sum(q**2)


def pairs(count):
    i, j = np.triu_indices(count, 1)
    return lambda q, v: 0.5 * jnp.sum(v**2) - jnp.sum(jnp.cos(q[i] * q[j]))


SCENES = {
    # name: scene, q, engine, words of explain
    "free": (lagjax.System(free), np.ones(2), "machine code", ""),
    "scalar path asked for": (lagjax.System(free, path="scalar"), np.ones(2), "machine code", ""),
    "array path asked for": (lagjax.System(free, path="array"), np.ones(2), "diffrax", "asked for"),
    "holds arrays": (lagjax.System(Learned(jnp.ones(1))), np.ones(2), "diffrax", "hold arrays of their own"),
    "float32": (lagjax.System(free), np.ones(2, np.float32), "machine code", ""),
    "many coordinates": (lagjax.System(free), np.ones(80), "machine code", ""),
    "many operations": (lagjax.System(pairs(10)), np.ones(10), "diffrax", "operations, more than"),
    "too many for XLA": (lagjax.System(pairs(5)), np.ones(5), "machine code", ""),
    "no scalar form": (lagjax.System(lambda q, v: free(q, v) - jax.scipy.special.betainc(2.0, 3.0, q[0])), np.ones(2),
                       "diffrax", "regularized_incomplete_beta"),
    "pivoting": (
        lagjax.System(lambda q, v: v[:-1] @ v[1:] + 0.5 * v[2] ** 2 - q @ q), np.ones(17), "diffrax", "pivoting",
    ),
    "indefinite, three coordinates": (
        lagjax.System(lambda q, v: v[0] * v[1] + v[2] * v[0] + 0.5 * v[2] ** 2 - q @ q), np.ones(3), "machine code", "",
    ),
    "indefinite, two coordinates": (SADDLE, np.ones(2),
                                    "machine code", ""),
    "constrained": (lagjax.System(free, constraints=lambda q: q @ q - 2.0), np.ones(2), "machine code", ""),
    "singular M that a constraint holds": (
        lagjax.System(lambda q, v: 0.5 * v[0] ** 2 * (1 + q[0] ** 2) - q[0], constraints=lambda q: q[1] - 1.0),
        np.ones(2), "machine code", "",
    ),
    "a function that cannot be hashed": (lagjax.System(Unhashable()), np.ones(2), "machine code", ""),
}  # fmt: skip
SINGULAR_AT_A_TIE = lagjax.System(lambda q, v: v[0] * v[1] + (q[0] - q[1]) * v[2] ** 2 - v[2] * v[1] * 0.0 - q @ q)


@pytest.mark.parametrize("name", SCENES)
def test_explain_names_the_engine_that_runs(name, monkeypatch):
    system, q, engine, words = SCENES[name]
    # Scenes of some thousands of operations take seconds to derive: smaller ones stand for them.
    monkeypatch.setattr(_form, "LARGEST_PROGRAM", 150)
    monkeypatch.setattr(_form, "LARGEST_XLA_PROGRAM", 30)
    facts = system.explain(q, np.zeros_like(q))

    class Ran(Exception):
        pass

    def stop(which):
        def solve(*_):
            raise Ran(which)

        return solve

    monkeypatch.setattr(_machine_code.MachineCode, "solve", stop("machine code"))
    monkeypatch.setattr(_diffrax.Diffrax, "solve", stop("diffrax"))
    with pytest.raises(Ran, match=engine):
        lagjax.simulate(system, q, np.zeros_like(q), np.array([0.0, 0.1]))
    assert facts.solver.startswith("Taylor series in machine code" if engine == "machine code" else "diffrax.Dopri8")
    assert words in facts.solver and (not words or "because" in facts.solver)
    assert facts.path == "scalar" or facts.reason
    if engine == "machine code":
        assert facts.path == "scalar" and facts.operations > 0


PRODUCTS = lagjax.System(lambda q, v: v[1:] @ v[:-1])


def test_a_mass_matrix_that_is_a_series_in_weak_forces_is_positive_definite():
    # Relativity adds G m/(c² r) to masses: with all numbers of order one M is indefinite, and nothing like the scene.
    scene = scenes.solar_system()
    derivation = of(scene.system, scene.q0, scene.qdot0, scene.params)
    state = columns_of(scene.q0.reshape(1, -1), scene.qdot0.reshape(1, -1), 0.0, numbers_of(scene.params))
    *found, singular = derivation.accelerations.program.evaluate_many(state)[:, 0]
    values = derivation.evaluate(["mass_matrix", "force"], state)
    assert not singular
    np.testing.assert_allclose(found, np.linalg.solve(values["mass_matrix"][0], values["force"][0]), rtol=1e-10)
    # One that is indefinite by construction, in units of any size, and singular where two of its coordinates are equal.
    signs, units = np.array([1.0, -1.0, 1.0]), np.array([1e-9, 1.0, 1e6])

    def indefinite(q, v):
        v = units * v
        return jnp.sum(signs * v**2) + v[0] * v[1] * jnp.cos(q[0] - q[1]) + v[1] * v[2] - q @ q

    derivation = of(lagjax.System(indefinite), np.ones(3), np.ones(3))
    state = list(np.random.default_rng(0).uniform(-1.0, 1.0, (6, 4))) + [0.0]
    *found, singular = derivation.accelerations.program.evaluate_many(state)
    values, scales = derivation.evaluate(["mass_matrix", "force"], state), units[:, None] * units
    exact = np.linalg.solve(values["mass_matrix"] / scales, (values["force"] / units)[..., None])[..., 0] / units
    np.testing.assert_allclose(np.array(found).T, exact, rtol=1e-13)
    assert not singular.any()
    with pytest.raises(Unlowerable, match="not positive definite"):
        of(PRODUCTS, np.ones(17), np.ones(17)).accelerations.program  # noqa: B018


def test_an_indefinite_mass_matrix_that_is_singular_is_found():
    *found, singular = of(SINGULAR_AT_A_TIE, np.ones(3), np.ones(3)).accelerations.program.evaluate(
        0.4, 0.4, 0.1, *[0.2] * 3, 0.0
    )
    assert singular and np.isnan(found).any()


def test_forces_between_bodies_take_what_one_would_write_by_hand():
    # A pair: 3 differences, 3 squares, 2 sums and 1 of the softening, a root, 2 quotients, a product of masses,
    # 3 products, 6 sums into the forces; no coordinate more than a quotient by its mass, and whether that is zero.
    count = 12
    first, second = np.triu_indices(count, 1)

    def lagrangian(q, v, params):
        m = params["m"]
        squared = jnp.sum((q[first] - q[second]) ** 2, axis=1) + 0.01
        return 0.5 * jnp.sum(m[:, None] * v**2) + jnp.sum(m[first] * m[second] / jnp.sqrt(squared))

    x = np.random.default_rng(0).normal(size=(count, 3))
    derivation = of(lagjax.System(lagrangian), x, x, {"m": np.ones(count)})
    assert derivation.accelerations.program.operations <= 22 * len(first) + 9 * count


@pytest.mark.parametrize("constraints", [None, lambda q: q @ q - 1.0])
def test_a_sample_without_programs_is_the_one_with_them(constraints, monkeypatch):
    # Seven states in chunks of three, of which the last is not full.
    monkeypatch.setattr(many_states, "_AT_ONCE", 27)
    lagrangian = lambda q, v: 0.5 * v @ v * (1.0 + q[0] ** 2) - jnp.cos(q).sum()
    random = np.random.default_rng(0)
    q, qdot, t = random.standard_normal((7, 3)), random.standard_normal((7, 3)), np.linspace(0.0, 1.0, 7)
    layout = Layout.from_state(np.ones(3), np.ones(3))
    names = "force", "mass_matrix", "dissipation", "residual", "lagrangian"
    lowered, compiled = (
        many_states.Sample.from_scene(scene, layout, q, qdot, t, None).quantities(*names)
        for scene in (
            lagjax.System(lagrangian, constraints=constraints),
            lagjax.System(HeldMotion(lagrangian, jnp.ones(())), constraints=constraints),
        )
    )
    for name in names:
        np.testing.assert_allclose(compiled[name], lowered[name], rtol=1e-13, atol=1e-13)


class HeldMotion(eqx.Module):
    """A Lagrangian that holds an array of its own, so that its scene has no programs."""

    function: Callable
    one: jax.Array

    def __call__(self, q, v):
        """`function`, times one."""
        return self.one * self.function(q, v)
