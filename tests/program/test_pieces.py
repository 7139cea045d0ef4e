"""Pieces by whole numbers, Booleans, counting and sorting: the motion of the same pieces written one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import in_potential, particle

import lagjax

EDGES = np.array([-0.2, 0.1, 0.5])
# A force, and the same one as comparisons with `where`.
PAIRS = {
    "a Boolean times a number": (lambda q, v: 2 * (q < 0) - 0.5 - q, lambda q, v: jnp.where(q < 0, 2.0, 0.0) - 0.5 - q),
    "arithmetic of whole numbers": (
        lambda q, v: -0.8 * ((q > 0.1).astype(int) * 2 - 1), lambda q, v: jnp.where(q > 0.1, -0.8, 0.8),
    ),
    "odd and even": (
        lambda q, v: jnp.where(jnp.floor(5 * q).astype(int) % 2 == 0, -1.0, 0.5),
        lambda q, v: jnp.where(5 * q - 2 * jnp.floor(2.5 * q) < 1, -1.0, 0.5),
    ),
    "a quotient of whole numbers": (
        lambda q, v: -0.5 * (jnp.floor(8 * q).astype(int) // 3) - 0.2, lambda q, v: -0.5 * jnp.floor(8 / 3 * q) - 0.2,
    ),
    "bits of whole numbers": (  # two borders side by side
        lambda q, v: 0.4 * ((jnp.floor(4 * q).astype(int) ^ jnp.floor(4 * q - 0.02).astype(int)) & 3) - 0.2,
        lambda q, v: 0.4 * jnp.where(jnp.abs(4 * q % 1 - 0.01) > 0.01, 0.0, jnp.where(4 * q % 2 < 1, 3.0, 1.0)) - 0.2,
    ),
    "the index of the largest": (
        lambda q, v: 0.3 - jnp.argmax(jnp.stack([0.2 - q, 0.1 + 0 * q, q - 0.3])),
        lambda q, v: 0.3 - jnp.where(q > 0.4, 2.0, jnp.where(q < 0.1, 0.0, 1.0)),
    ),
    "a count": (
        lambda q, v: 0.4 - 0.5 * jnp.count_nonzero(q > EDGES),
        lambda q, v: 0.4 - 0.5 * sum(jnp.where(q > edge, 1.0, 0.0) for edge in (-0.2, 0.1, 0.5)),
    ),
    "the middle of three": (
        lambda q, v: 0.1 - 2 * jnp.sort(jnp.stack([q, 0.3 - q, 0.2 + 0 * q]))[1],
        lambda q, v: 0.1 - 2 * jnp.clip(q, jnp.minimum(0.3 - q, 0.2), jnp.maximum(0.3 - q, 0.2)),
    ),
    "floor_divide": (lambda q, v: -0.5 * (q // 0.3) - 0.2, lambda q, v: -0.5 * jnp.floor(q / 0.3) - 0.2),
    "divmod": (lambda q, v: -0.5 * jnp.divmod(q, 0.4)[0] - 0.3, lambda q, v: -0.5 * jnp.floor(q / 0.4) - 0.3),
    "a switch": (
        lambda q, v: jax.lax.switch(
            jnp.clip(jnp.floor(2 * q).astype(int) + 1, 0, 2), [lambda q: 0.7, lambda q: 0.1 * q, lambda q: -q], q
        ),
        lambda q, v: jnp.where(q >= 0.5, -q, jnp.where(q >= 0.0, 0.1 * q, 0.7)),
    ),
}  # fmt: skip


FAST = ("bits of whole numbers", "odd and even", "the index of the largest", "the middle of three", "floor_divide")


@pytest.mark.parametrize("name", [pytest.param(x, marks=() if x in FAST else pytest.mark.slow) for x in PAIRS])
def test_pieces_by_whole_numbers(name):
    ends = []
    for force in PAIRS[name]:
        scene = particle(force)
        run = lagjax.simulate(scene, 0.83, -0.4, np.array([0.0, 4.0]), solver=lagjax.MachineCode())
        ends.append([float(run.q[-1]), float(run.qdot[-1]), float(run.stats["num_rejected_steps"])])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


@pytest.mark.parametrize("kind, power", [(jnp.int32, 2), (jnp.int64, 4)])
def test_a_whole_number_beyond_its_type(kind, power):
    """100000² wraps around in 32 bits, as in JAX; its square is more than 53 bits hold, and no other number."""
    force = lambda q, v: 1e-9 * (jnp.floor(q).astype(kind) ** power).astype(float)
    scene = particle(force)
    run = lagjax.simulate(scene, 100_000.5, 0.0, np.array([0.0, 0.1]), throw=False, solver=lagjax.MachineCode())
    if power == 2:
        np.testing.assert_allclose(run.qdot[-1], 0.1e-9 * (100_000**2 % 2**32), rtol=1e-9)
    else:
        assert run.result == lagjax.RESULTS.nonfinite_state


# Angles and signs that jump, in spellings of their own, and the same by `mod` and `where`.
WRAPPED, BEYOND = (lambda u: jnp.mod(u + jnp.pi, 2 * jnp.pi) - jnp.pi), (lambda u: jnp.where(u < 0, -1.0, 1.0))
JUMPS = {
    "arctan2": (lambda u: jnp.arctan2(jnp.sin(u), jnp.cos(u)), WRAPPED),
    "arctan2 of other lengths": (
        lambda u: jnp.arctan2((2 + jnp.sin(u)) * jnp.sin(u), (2 + jnp.sin(u)) * jnp.cos(u)), WRAPPED),
    "the angle of a complex number": (lambda u: jnp.angle(jnp.exp((0.2 + 1j) * u)), WRAPPED),
    "a complex root": (lambda u: jnp.sqrt(jnp.exp(1j * u)).imag, lambda u: jnp.sin(WRAPPED(u) / 2)),
    "a complex power": (lambda u: (jnp.exp(1j * u) ** 0.3).imag, lambda u: jnp.sin(0.3 * WRAPPED(u))),
    "half an angle": (lambda u: 2 * jnp.arctan(jnp.tan(u / 2)), WRAPPED),
    "arctan of a quotient": (lambda u: 2 * jnp.arctan(jnp.sin(u / 2) / jnp.cos(u / 2)), WRAPPED),
    "arctan at a pole": (lambda u: jnp.arctan(1 / u), lambda u: BEYOND(u) * jnp.pi / 2 - jnp.arctan(u)),
    "arctan of a sum with a pole": (
        lambda u: jnp.arctan(1 + u**-1.0), lambda u: jnp.arctan2(BEYOND(u) * (u + 1), jnp.abs(u))),
    "arctan2 along an axis": (lambda u: jnp.arctan2(0.0, u), lambda u: jnp.where(u < 0, jnp.pi, 0.0)),
    "mod of an angle": (
        lambda u: jnp.mod(jnp.arctan2(jnp.sin(u), jnp.cos(u)) + 1, 4.0), lambda u: jnp.mod(WRAPPED(u) + 1, 4.0)),
    "copysign": (lambda u: jnp.copysign(1.0, u), BEYOND),
    "signbit": (lambda u: jnp.where(jnp.signbit(u), -1.0, 1.0), BEYOND),
    "a direction": (lambda u: u / jnp.sqrt(u**2), BEYOND),
    "arcsin of a sine": (
        lambda u: jnp.arcsin(jnp.sin(u)),
        lambda u: jnp.pi / 2 - jnp.abs(jnp.mod(u + jnp.pi / 2, 2 * jnp.pi) - jnp.pi)),
    "arccos of a cosine": (lambda u: jnp.arccos(jnp.cos(u)), lambda u: jnp.abs(WRAPPED(u))),
}  # fmt: skip
FAST_JUMPS = ("arctan2 of other lengths", "copysign")
REMOVABLE_POLE = lagjax.System(lambda q, v: 0.5 * v * v, forces=lambda q, v: jnp.arctan(jnp.sin(q) / q))


@pytest.mark.parametrize("name", [pytest.param(x, marks=() if x in FAST_JUMPS else pytest.mark.slow) for x in JUMPS])
def test_jumps(name):
    # Both run on their own borders; ends and gradients agree to the tolerance of the runs.
    ends, ts = [], np.array([0.0, 4.0])
    for jump in JUMPS[name]:
        push = lambda q, v, params, jump=jump: -params * jump(2 * q + 0.4)
        scene = in_potential(lambda q: 0.5 * q * q, forces=push)
        end = lambda k, scene=scene: lagjax.simulate(scene, 2.0, 0.4, ts, k, solver=lagjax.MachineCode()).q[-1]
        ends.append(jax.jit(jax.value_and_grad(end))(0.3))
    np.testing.assert_allclose(*ends, rtol=1e-7, atol=1e-7)


def test_a_removable_pole_is_named():
    # 0/0 is no angle: the value is NaN where the user's is.
    run = lagjax.simulate(REMOVABLE_POLE, 0.0, 1.0, np.array([0.0, 1.0]), throw=False, solver=lagjax.MachineCode())
    assert run.result == lagjax.RESULTS.nonfinite_state


def fall_in_order(q, v, forces, end):
    """Free particles of unit mass, of which the one in place k has the force −forces[k]: from meeting to meeting."""
    t, order = 0.0, np.argsort(q + 1e-9 * v)
    while True:
        a = np.empty_like(q)
        a[order] = -forces
        d, u, b = (np.diff(x[order]) for x in (q, v, a))  # of neighbours; b < 0
        meetings = (-u - np.sqrt(u * u - 2 * b * np.abs(d))) / b
        k = np.argmin(meetings)
        h = min(meetings[k], end - t)
        q, v, t = q + h * v + h * h / 2 * a, v + h * a, t + h
        if t >= end:
            return q
        order[k : k + 2] = order[k : k + 2][::-1]


@pytest.mark.parametrize("tied", [False, True])
def test_sorted_numbers_that_pass_each_other(tied):
    forces, v = np.array([0.3, 1.2, 2.7, 4.8]), np.array([0.5, -0.5, 1.3, 0.9])
    q = np.full(4, 0.3) if tied else np.array([0.1, -0.1, 0.6, 0.1])
    row = in_potential(lambda q: jnp.sort(q) @ forces)
    run = lagjax.simulate(row, q, v, np.array([0.0, 1.5]))
    np.testing.assert_allclose(run.q[-1], fall_in_order(q, v, forces, 1.5), atol=1e-8)
