"""Pieces by whole numbers, Booleans, counting and sorting: the motion of the same pieces written one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

EDGES = jnp.array([-0.2, 0.1, 0.5])
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


FAST = ("odd and even", "the index of the largest", "the middle of three", "floor_divide")


@pytest.mark.parametrize("name", [pytest.param(x, marks=() if x in FAST else pytest.mark.slow) for x in PAIRS])
def test_pieces_by_whole_numbers(name):
    ends = []
    for force in PAIRS[name]:
        scene = lagjax.System(lambda q, v: 0.5 * v * v, forces=force)
        run = lagjax.simulate(scene, 0.83, -0.4, np.array([0.0, 4.0]), solver=lagjax.MachineCode())
        ends.append([float(run.q[-1]), float(run.qdot[-1]), float(run.stats["num_rejected_steps"])])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def test_a_whole_number_beyond_its_type_is_no_number():
    # 100000² does not fit into 32 bits: JAX wraps it around, which is not what anybody means.
    scene = lagjax.System(
        lambda q, v: 0.5 * v * v, forces=lambda q, v: 1e-9 * (jnp.floor(q).astype(jnp.int32) ** 2).astype(float)
    )
    run = lagjax.simulate(scene, 100_000.5, 0.0, np.array([0.0, 1.0]), throw=False, solver=lagjax.MachineCode())
    assert run.result == lagjax.RESULTS.nonfinite_state
