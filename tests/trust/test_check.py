"""`check`: silent about every ready scene, and right about each thing that can be wrong, by kind and by name."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import in_potential
from sweeps import KINDS, sweep

import lagjax
from lagjax._trust.checks._differences import Slopes, slopes, slopes_differ, step_ladder


class Polar(NamedTuple):
    rho: jax.Array
    phi: jax.Array


def kinds(lagrangian, q, qdot, params=None, t=0.0, **roles) -> set[str]:
    return set(lagjax.check(lagjax.System(lagrangian, **roles), q, qdot, t, params).kinds)


def only(findings: lagjax.Findings) -> lagjax.Finding:
    (finding,) = findings
    return finding


# ---- no false alarm --------------------------------------------------------------------------------------------------

# What is true of a scene and no fault of it.
KNOWN_ADVICE = {"explicit_time", "dependent_constraints", "ill_conditioned", "stiff"}


@pytest.mark.parametrize("make", sweep(lagjax.scenes.ALL, KINDS), ids=lambda make: make.__name__)
def test_no_false_alarm(make):
    scene = make()
    findings = lagjax.check(scene.system, scene.q0, scene.qdot0, 0.0, scene.params)
    assert findings.ok and findings.kinds <= KNOWN_ADVICE, str(findings)
    assert all(finding.level == "advice" for finding in findings)
    roles = ("lagrangian", "forces", "dissipation", "constraints", "velocity_constraints")
    given = [getattr(scene.system, role) for role in roles]
    assert ("explicit_time" in findings.kinds) == any(f is not None and "t" in f.extras for f in given)


def test_no_false_alarm_in_single_precision_or_in_other_units():
    q, qdot = jnp.float32([0.3, 1.2]), jnp.float32([0.0, -0.7])
    double = lagjax.scenes.double_pendulum()
    params = jax.tree.map(jnp.float32, double.params)
    start = jax.tree.map(jnp.float32, (double.q0, double.qdot0))
    assert lagjax.check(double.system, *start, 0.0, params).kinds == {"single_precision"}

    def planet(q, v, params):  # metres, seconds
        return 0.5 * jnp.sum(v**2) + params / jnp.sqrt(jnp.sum(q**2))

    assert kinds(planet, jnp.array([1.496e11, 0.0]), jnp.array([0.0, 2.98e4]), 1.327e20) == set()
    assert kinds(lambda q, v: 0.5 * jnp.sum(v**2) - jnp.sum(jnp.cos(q)), q, qdot) == {"single_precision"}

    def orbit(q, v):  # dp/dt is a small difference of large terms
        return 5e24 * (0.5 * (v["r"] ** 2 + q["r"] ** 2 * v["phi"] ** 2) + 1.327e20 / q["r"])

    assert kinds(orbit, {"r": 1.5e11, "phi": 0.0}, {"r": 0.0, "phi": 2e-7}) == set()
    # After very many turns every large step sees a slope of zero.
    assert kinds(lambda q, v: 0.5 * v**2 + jnp.cos(q), 1e6, 3.0) == set()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_differences_know_their_error(dtype):
    # Slopes of functions on very different scales, at a point of size 1; errors as good as the dtype can give them.
    functions = [np.sin, lambda x: np.cos(100 * x) / 100, lambda x: 1e8 + np.exp(x), lambda x: 1 / (x - 0.89), np.sqrt]
    exact = [np.cos(1.0), -np.sin(100.0), np.e, -1 / 0.11**2, 0.5]
    steps = step_ladder(np.ones(1), dtype)
    x, eps = dtype(0.9) + dtype(0.1), float(np.finfo(dtype).eps)
    for function, slope in zip(functions, exact, strict=True):
        back, here, ahead = (np.asarray(function(x + s * steps[:, 0]), dtype) for s in (-1, 0, 1))
        found = slopes(back[None, :, None], here[:1], ahead[None, :, None], steps, np.ones(1), eps)
        for one in found:
            assert abs(one.value[0, 0] - slope) <= 8 * one.error[0, 0] + 2 * eps * abs(slope) / eps ** (1 / 3)
        assert not slopes_differ(found[1], found[2], dtype).any()
        assert slopes_differ(found[0], Slopes(np.array([[-slope]]), np.zeros((1, 1))), dtype).all() == (
            found[0].error[0, 0] < 0.1 * abs(slope)
        )


# ---- derivatives -----------------------------------------------------------------------------------------------------


def free(q, v):
    return 0.5 * jnp.sum(v**2)


FREE = lagjax.System(free)


def at_rest(q, v):
    return 0.5 * jnp.linalg.norm(v) * jnp.linalg.norm(v) - 0.5 * jnp.sum(q**2)


@jax.custom_jvp
def spring(x):
    return 0.5 * x**2


@spring.defjvp
def _spring_jvp(primals, tangents):
    return spring(*primals), -primals[0] * tangents[0]


BROKEN = {
    # name: L, q, q̇, kind, where, words of the message
    "norm of the velocity at rest": (at_rest, jnp.ones(2), jnp.zeros(2), "derivative_not_finite", "dq[0]", "sqrt(0)"),
    "norm of the position at zero": (
        lambda q, v: 0.5 * jnp.sum(v**2) - jnp.linalg.norm(q),
        jnp.zeros(2), jnp.ones(2), "derivative_not_finite", "q[0]", "norm at zero",
    ),
    "branch of where that is not taken": (
        lambda q, v: 0.5 * v**2 - jnp.where(q > 0, jnp.sqrt(q) ** 3, 0.0),
        -1.0, 0.0, "derivative_not_finite", "q", "sqrt(-1)",
    ),
    "arctan2 at the origin": (
        lambda q, v: 0.5 * jnp.sum(v**2) - jnp.arctan2(q[1], q[0]) ** 2,
        jnp.zeros(2), jnp.ones(2), "derivative_not_finite", "q[0]", "atan2(0, 0)",
    ),
    "power with a singular second derivative": (
        lambda q, v: 0.5 * jnp.sum(v**2) + jnp.sum(jnp.abs(v) ** 1.5),
        jnp.ones(2), jnp.array([0.0, 1.0]), "derivative_not_finite", "dq[0]", "pow",
    ),
    "division by zero": (lambda q, v: v**2 + 1 / q, 0.0, 1.0, "value_not_finite", None, "div(1, 0)"),
    "root of a negative number": (
        lambda q, v: -jnp.sqrt(1 - v**2), 0.0, 2.0, "value_not_finite", None, "sqrt(-3)",
    ),
    "momentum at a tie": (lambda q, v: v**2 + jnp.maximum(v, 2 * v), 0.0, 0.0, "kink", "dq", "max"),
    "custom derivative of the wrong sign": (
        lambda q, v: 0.5 * v**2 - spring(q), 0.7, 1.0, "wrong_derivative", "q", "custom derivative",
    ),
    "stop_gradient": (
        lambda q, v: 0.5 * v**2 - q * jax.lax.stop_gradient(q), 0.7, 1.0, "wrong_derivative", "q", "stop_gradient",
    ),
    "round": (lambda q, v: 0.5 * v**2 * (1 + jax.lax.stop_gradient(v)), 0.7, 1.3, "wrong_derivative", "dq", "p = dL"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_derivatives(name):
    lagrangian, q, qdot, kind, where, words = BROKEN[name]
    findings = lagjax.check(lagjax.System(lagrangian), q, qdot)
    chosen = [finding for finding in findings if finding.kind == kind]
    assert chosen and not findings.ok, str(findings)
    assert words in " ".join(finding.message for finding in chosen)
    assert where is None or any(where in finding.where for finding in chosen)


AT_REST = lagjax.System(at_rest)
JITTED_AT_REST = lagjax.System(jax.jit(at_rest))


def test_the_line_is_named():
    line = at_rest.__code__.co_firstlineno + 1
    message = only(lagjax.check(AT_REST, np.ones(2), np.zeros(2))).message
    assert f"test_check.py:{line}" in message and "at_rest" in message
    # Also from inside a function that is compiled on its own.
    message = only(lagjax.check(JITTED_AT_REST, np.ones(2), np.zeros(2))).message
    assert f"test_check.py:{line}" in message


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_kinks_and_what_only_looks_like_one(dtype):
    def border(q, v, params):
        return 0.5 * v**2 - params * jnp.abs(q - 1)

    def contact(q, v, params):  # continuous force: no kink
        return 0.5 * v**2 - 0.5 * params * jnp.maximum(0.0, -q) ** 2

    def guarded(q, v):  # finite everywhere, and still wrong
        r2 = jnp.sum(v**2)
        return 0.5 * jnp.where(r2 > 0, jnp.sqrt(jnp.where(r2 > 0, r2, 1.0)) ** 2, 0.0) + jnp.sum(v**2)

    found = kinds(border, dtype(1), dtype(0.5), 3.0)
    assert "kink" in found
    assert "kink" not in kinds(border, dtype(1.01), dtype(0.5), 3.0)
    assert not {"kink", "wrong_derivative"} & kinds(contact, dtype(0), dtype(0.5), 100.0)
    # At rest the other branch is taken, which has no kinetic energy: M is not the derivative of p.
    assert "wrong_derivative" in kinds(guarded, jnp.ones(2, dtype), jnp.zeros(2, dtype))


# ---- the mass matrix -------------------------------------------------------------------------------------------------


def polar(q, v):
    return 0.5 * (v.rho**2 + q.rho**2 * v.phi**2)


def euler(q, v):  # a symmetric top: θ, φ, ψ
    return 0.5 * (v[0] ** 2 + jnp.sin(q[0]) ** 2 * v[1] ** 2) + 0.1 * (v[2] + v[1] * jnp.cos(q[0])) ** 2


def length(q, v):
    return jnp.sqrt(jnp.sum(v**2)) * (1 + jnp.sum(q**2))


SINGULAR = {
    "unused": (lambda q, v: 0.5 * v[0] ** 2 - q[1] ** 2, jnp.ones(2), jnp.ones(2), "velocity_unused", {"q[1]"}),
    "linear": (lambda q, v: 0.5 * v[0] ** 2 + q[0] * v[1], jnp.ones(2), jnp.ones(2), "linear_in_velocity", {"q[1]"}),
    "combination": (
        lambda q, v: 0.5 * (v[0] + 0.3 * v[1]) ** 2 - q[0], jnp.ones(2), jnp.ones(2), "velocity_combination",
        {"q[0]", "q[1]"},
    ),
    "polar coordinates at the origin": (polar, Polar(0.0, 0.3), Polar(1.0, 1.0), "coordinate_singularity", {"q.phi"}),
    "gimbal": (
        euler, jnp.zeros(3), jnp.array([0.1, 0.2, 0.3]), "coordinate_singularity", {"q[1]", "q[2]"},
    ),
    "next to the gimbal": (
        euler, jnp.array([1e-6, 0.2, 0.3]), jnp.array([0.1, 0.2, 0.3]), "near_coordinate_singularity", {"q[1]", "q[2]"},
    ),
    "length of a path": (length, jnp.ones(3), jnp.array([0.3, 0.2, 0.7]), "gauge", {"q[0]", "q[1]", "q[2]"}),
    "rope around a circle": (
        lambda q, v: 0.5 * (q[0] * v[0] + q[1] * v[1]) ** 2 - q[0], jnp.array([1.0, 2.0]), jnp.ones(2), "gauge",
        {"q[0]", "q[1]"},
    ),
    "fourth powers at rest": (lambda q, v: v**4 - q**2, 1.0, 0.0, "singular_at_velocity", {"q"}),
}  # fmt: skip
COUPLED = lagjax.System(lambda q, v: 0.5 * (v[0] + v[1]) ** 2 + 1e-9 * v[1] ** 2 - jnp.sum(q**2))
STEP = lagjax.System(lambda q, v: 0.5 * v**2 - jnp.where(q > 1.25, 1.0, 0.0))
SMOOTH = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * jnp.maximum(q - 1.25, 0.0) ** 2)
TWO_COORDINATES = lagjax.System(lambda q, v: 0.5 * v["x"] ** 2 + 0.5 * v["angle"] ** 2)
MANY_MISTAKES = lagjax.System(lambda q, v, t: -0.5 * v[0] ** 2, dissipation=lambda q, v: -(v[0] ** 2))


@pytest.mark.parametrize("name", SINGULAR)
def test_singular_mass_matrices(name):
    lagrangian, q, qdot, kind, where = SINGULAR[name]
    findings = lagjax.check(lagjax.System(lagrangian), q, qdot)
    (finding,) = [finding for finding in findings if finding.kind == kind]
    assert set(finding.where) == where
    assert findings.ok == (kind == "near_coordinate_singularity")


TWO_MISSING = lagjax.System(lambda q, v: 0.5 * (v["a"] - v["b"]) ** 2 + v["c"] * q["d"])


def test_several_missing_velocities_are_told_apart():
    findings = lagjax.check(
        TWO_MISSING,
        {"a": 0.1, "b": 0.2, "c": 0.3, "d": 0.4},
        {"a": 1.0, "b": 2.0, "c": 3.0, "d": 4.0},
    )
    assert {(finding.kind, finding.where) for finding in findings} == {
        ("linear_in_velocity", ("q['c']",)),
        ("velocity_unused", ("q['d']",)),
        ("velocity_combination", ("q['a']", "q['b']")),
    }
    assert "+1 dq['a'] +1 dq['b']" in str(findings)


NEGATIVE = lagjax.System(lambda q, v: -0.5 * v**2 + 0.5 * q**2)


def test_signs_and_condition_of_the_mass_matrix():
    assert kinds(lambda q, v: v[0] * v[1] - q[0] * q[1], np.ones(2), np.ones(2)) == {"indefinite_mass_matrix"}
    wrong = lagjax.check(NEGATIVE, 1.0, 0.0)
    assert only(wrong).kind == "indefinite_mass_matrix" and "negative definite" in only(wrong).message and wrong.ok
    # Masses far apart are scaled away, coupled ones are not.
    assert kinds(lambda q, v: 1e9 * v[0] ** 2 + 1e-9 * v[1] ** 2 - q[0] ** 2, np.ones(2), np.ones(2)) == set()
    finding = next(f for f in lagjax.check(COUPLED, np.ones(2), np.ones(2)) if f.kind == "ill_conditioned")
    assert finding.where == ("q[0]", "q[1]")


# ---- forces, time scales, borders ------------------------------------------------------------------------------------


GAINING = lagjax.System(free, dissipation=lambda q, v: 0.1 * v)


def test_dissipation_of_the_wrong_sign():
    assert kinds(free, 0.3, 0.0, dissipation=lambda q, v: -0.1 * v**2) == {"creates_energy"}
    assert kinds(free, 0.3, 0.0, dissipation=lambda q, v: 0.1 * v**2) == set()
    both = lagjax.check(GAINING, 0.3, 0.0)
    assert "takes it out at others" in only(both).message


def test_time_scales():
    damped = {"dissipation": lambda q, v: 0.5e6 * v[0] ** 2}
    lagrangian = lambda q, v: 0.5 * jnp.sum(v**2) - 0.5 * jnp.sum(q**2)
    finding = only(lagjax.check(lagjax.System(lagrangian, **damped), np.ones(2), np.zeros(2)))
    assert finding.kind == "stiff" and "Kvaerno5" in finding.message
    spring = lambda q, v: 0.5 * jnp.sum(v**2) - 0.5 * q[0] ** 2 - 0.5e10 * (q[1] - q[0]) ** 2
    finding = only(lagjax.check(lagjax.System(spring), np.ones(2), np.zeros(2)))
    assert finding.kind == "stiff" and "constraint" in finding.message
    # Free motion beside a fast one: a defective zero is no time scale.
    pair = lambda q, v: 0.5 * jnp.sum(v**2) - 0.5e10 * (q[1] - q[0]) ** 2
    assert kinds(pair, np.ones(2), np.zeros(2)) == set()


DRY = lagjax.System(free, dissipation=lambda q, v: 0.1 * jnp.abs(v))


@pytest.mark.parametrize("potential, words", [(jnp.abs, "abs at"), (lambda q: jnp.maximum(q, 2 * q), "max at")])
def test_a_kink_of_the_potential_is_no_error(potential, words):
    """The motion across it is right (`test_borders`); what is computed at this very state is that of one side."""
    system = in_potential(potential)
    finding = only(lagjax.check(system, 0.0, 1.0))
    assert finding.kind == "kink" and finding.level == "advice" and finding.where == ("q",)
    assert words in finding.message and "A motion across it is right" in finding.message
    only(lagjax.check(DRY, 0.0, 0.0))


def friction_at_a_speed(q, v):
    return -0.3 * jnp.sign(v)


RUBBED = lagjax.System(free, forces=friction_at_a_speed)


def test_discontinuities_are_found_where_they_are():
    here = only(lagjax.check(RUBBED, 0.3, 0.0))
    assert here.kind == "discontinuity" and here.level == "advice" and "sign" in here.message
    assert "at this state" in here.message
    near = only(lagjax.check(RUBBED, 0.3, 0.4))
    assert near.level == "advice" and near.where == ("dq",)
    finding = only(lagjax.check(STEP, 1.0, 0.5))
    assert finding.level == "advice" and "0.25 away along q" in finding.message and "where" not in finding.where
    assert "the motion is reflected" in finding.message
    assert not lagjax.check(SMOOTH, 1.0, 0.5).found


# ---- constraints -----------------------------------------------------------------------------------------------------


def falling(q, v):
    return 0.5 * jnp.sum(v**2) - 9.81 * q[1]


START = np.array([0.6, -0.8]), np.zeros(2)


def held(f, q=START[0], qdot=START[1], lagrangian=falling, **more):
    return lagjax.check(lagjax.System(lagrangian, constraints=f, **more), q, qdot)


def test_constraints_that_hold():
    assert not held(lambda q: {"rod": jnp.sum(q**2) - 1.0}).found
    # A mass matrix that is singular, and a saddle point that is not.
    assert not held(lambda q: {"rail": q[1] + 0.8}, lagrangian=lambda q, v: 0.5 * v[0] ** 2 - q[0]).found
    twice = held(lambda q: {"rod": jnp.sum(q**2) - 1.0, "again": 3 * jnp.sum(q**2) - 3.0})
    assert only(twice).kind == "dependent_constraints" and twice.ok
    assert set(only(twice).where) == {"constraints['rod']", "constraints['again']"}


CONSTRAINTS = {
    "square": (lambda q: {"rod": (jnp.sum(q**2) - 1.0) ** 2}, "constraint_zero_gradient", "not nearby"),
    "slack": (lambda q: {"rope": jnp.maximum(0.0, jnp.sum(q**2) - 4.0)}, "constraint_zero_gradient", "slack"),
    "no q": (lambda q: {"one": 0.0 * q[0] + 1.0}, "constraint_zero_gradient", "does not contain q"),
    "norm": (lambda q: {"rod": jnp.linalg.norm(q - START[0])}, "constraint_not_finite", "norm at zero"),
    "nan": (lambda q: {"rod": jnp.log(-q[0])}, "constraint_not_finite", "is nan"),
    "off": (lambda q: {"rod": jnp.sum(q**2) - 2.0}, "inconsistent_start", "system.project"),
}


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_constraints_that_do_not_hold(name):
    f, kind, words = CONSTRAINTS[name]
    findings = held(f)
    (finding,) = [finding for finding in findings if finding.kind == kind]
    assert not findings.ok and words in finding.message and finding.where[0].startswith("constraints['")


def test_terms_that_cancel_to_rounding_are_no_wrong_derivative():
    # A parallelogram of bars at rest, upright: the height of a crank has the derivative cos(π/2) = 6e-17 and no other.
    lengths, q = np.array([1.0, 2.0, 1.0]), np.array([np.pi / 2, 0.0, -np.pi / 2])

    def loop(q):
        return {"x": jnp.sum(lengths * jnp.cos(q)) - 2.0, "y": jnp.sum(lengths * jnp.sin(q))}

    bars = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) - 9.81 * jnp.sin(q[0]), constraints=loop)
    assert not lagjax.check(bars, q, np.zeros(3)).found
    # In what is very small nothing is left of L: that is not a wrong derivative either.
    assert kinds(lambda q, v: 0.5 * v**2 - 0.5 * q**2, 1e-200, 0.0) == set()


def test_a_saddle_point_that_is_singular():
    findings = held(lambda q: {"wall": q[0] - 0.6}, lagrangian=lambda q, v: 0.5 * v[0] ** 2 - q[1])
    assert only(findings).kind == "velocity_unused" and only(findings).where == ("q[1]",)
    combination = held(
        lambda q: {"wall": q[0] - q[1] + q[2]},
        np.array([1.0, 2.0, 1.0]), np.zeros(3), lambda q, v: 0.5 * (v[0] - v[1] + v[2]) ** 2 + v[0] ** 2 - q[0],
    )  # fmt: skip
    assert only(combination).kind == "singular_saddle_point" and set(only(combination).where) == {"q[1]", "q[2]"}


def test_constraints_on_velocities():
    def velocities(a):
        system = lagjax.System(free, velocity_constraints=lambda q, v: {"a": a(q, v)})
        return lagjax.check(system, jnp.array([0.3, 0.4]), jnp.array([0.0, 1.0]))

    assert not velocities(lambda q, v: v[0] * jnp.cos(q[1]) - 0.0 * v[1]).found
    assert only(velocities(lambda q, v: jnp.sum(v**2) - 1.0)).kind == "velocity_constraint_not_affine"
    assert only(velocities(lambda q, v: q[0] - 0.3)).kind == "constraint_zero_gradient"
    assert only(velocities(lambda q, v: v[0] - 0.5)).kind == "inconsistent_start"


# ---- what is given, and what comes back ------------------------------------------------------------------------------


MASS_BY_NAME = lagjax.System(lambda q, v, params: params["m"] * v**2)
MASS_BY_NUMBER = lagjax.System(lambda q, v, params: params * v**2)


def test_numbers_that_are_given():
    params = {"m": jnp.nan, "list": [1.0, -jnp.inf]}
    findings = lagjax.check(MASS_BY_NAME, jnp.inf, 0.0, params=params)
    assert findings.kinds == {"not_finite"}
    assert {finding.where[0] for finding in findings} == {"q", "params['m']", "params['list'][1]"}
    whole = lagjax.check(MASS_BY_NUMBER, 1.0, 0.0, params=2)
    assert only(whole).kind == "integer_parameter"
    assert not lagjax.check(FREE, 1e-9, 0.0).found  # the default atol is as small
    small = only(lagjax.check(TWO_COORDINATES, {"x": 1e-9, "angle": 1.0}, {"x": 0.0, "angle": 0.0}))
    assert small.where == ("q['x']",) and "pass atol=1e-21" in small.message
    assert not lagjax.check(
        TWO_COORDINATES, {"x": 1e-17, "angle": 1.0}, {"x": 0.0, "angle": 0.0}
    ).found  # rounding, of zero
    assert kinds(free, np.float32(1.0), np.float32(0.0)) == {"single_precision"}


FREE_MASS = lagjax.System(lambda q, v: 0.5 * v**2)


def test_without_x64(monkeypatch):
    with jax.enable_x64(False):
        finding = only(lagjax.check(FREE_MASS, np.float64(1.0), np.float64(0.0)))
    assert finding.kind == "single_precision"
    assert "float64 was given" in finding.message and "jax_enable_x64" in finding.message


SCALAR_FORCE = lagjax.System(free, forces=lambda q, v: 1.0)


def test_refused():
    scene = FREE
    with pytest.raises(TypeError, match=r"write 1\.0 instead of 1"):
        lagjax.check(scene, 1, 0)
    with pytest.raises(ValueError, match="one number; got shape"):
        lagjax.check(scene, 1.0, 0.0, np.zeros(2))
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda q: lagjax.check(scene, q, 0.0).ok)(1.0)
    with pytest.raises(TypeError, match="forces must return the structure of q"):
        lagjax.check(SCALAR_FORCE, np.ones(2), np.ones(2))


def test_findings_are_frozen_sorted_and_fit_a_screen():
    findings = lagjax.check(MANY_MISTAKES, np.ones(40), np.ones(40))
    levels = [finding.level for finding in findings]
    assert levels == sorted(levels, key=["error", "warning", "advice"].index) and len(set(levels)) == 3
    text = str(findings)
    assert len(text.splitlines()) <= 48 and max(map(len, text.splitlines())) <= 110 and "more" in text
    assert str(lagjax.check(FREE, 1.0, 0.0)) == "Nothing found."
    with pytest.raises(AttributeError):
        findings.found = ()


@pytest.mark.slow
def test_many_coordinates_are_compared_along_random_directions_first():
    n = 100
    q, v = np.linspace(0.2, 1.0, n), np.linspace(1.0, 0.3, n)

    def pairs(q):
        return jnp.sum(jnp.sqrt(1.0 + jnp.diff(q) ** 2))

    assert kinds(lambda q, v: 0.5 * v @ v - pairs(q), q, v) == set()
    hidden = lagjax.check(lagjax.System(lambda q, v: 0.5 * v @ v - pairs(q) - q[7] * jax.lax.stop_gradient(q[7])), q, v)
    assert [(finding.kind, finding.where) for finding in hidden] == [("wrong_derivative", ("q[7]",))]
    q[40] = 0.0
    bent = lagjax.check(lagjax.System(lambda q, v: 0.5 * v @ v - pairs(q) - jnp.abs(q[40])), q, v)
    assert [finding.where for finding in bent if finding.kind == "kink"] == [("q[40]",)]
    # Oscillators beside each other, one of them stiff.
    stiff = np.where(np.arange(n) == 3, 1e10, 1.0)
    masses = np.linspace(1.0, 2.0, n)
    assert kinds(lambda q, v: 0.5 * masses @ v**2 - 0.5 * stiff @ q**2, q, v) == {"stiff"}
