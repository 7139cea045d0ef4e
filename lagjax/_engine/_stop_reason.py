"""Why a motion stopped where it did, from the accelerations about its last state.

A step that shrinks to nothing, or a budget of steps that is spent, is what an integrator sees. What the author of a
scene wants to know is what it ran into, and both engines ask the same two questions of the acceleration a(s) along the
tangent of the motion, at the time t + s and the state y + s ẏ:

- Is a(s) finite just ahead, within the smallest steps? If not, it is the acceleration that ends there.
- Does a(s) jump, within a step or two? The interval −τ … τ is halved, always to the half over which a varies more. A
  smooth function varies less by the factor of the interval, 2⁻⁵⁰ after fifty halvings; one with a vertical tangent, as
  a square root, by 2⁻²⁵. What is left of a jump is all of it: `JUMP` lies between.

The functions are for arrays of NumPy with any number of members in front, and for JAX, one member at a time.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# Of the smallest step: the last one that was tried is one to five of them long (Dopri8 shrinks by 0.2 at most).
AHEAD = (2.0, 16.0, 128.0)
HALVINGS = 50
# The smallest jump, and the largest, in sizes of the acceleration on both sides: a square root leaves 3e-8, a cube root
# 1e-5, and a pole 1e12 or so.
JUMP, POLE = 1e-3, 8.0
# Where steps are rejected again and again the jump is as far away as a step is long; where hardly any is, the steps
# have long become shorter than those that the motion began with, of which the mean step consists.
FIGHTING, FAR, NEAR = 0.25, 2.0, 1 / 64
NARROW = 64.0  # smallest steps, about a state from which no step leads on


class End(NamedTuple):
    """The ends of motions, with any batch axes first: `y` has a last axis of 2n, (q, q̇)."""

    t: jax.Array
    y: jax.Array
    begin: jax.Array  # ts[0]
    end: jax.Array  # ts[-1]
    accepted: jax.Array
    rejected: jax.Array


@np.errstate(all="ignore")
def find_stop_flags(acceleration: Callable, at: End, shrank, spent) -> tuple[jax.Array, jax.Array]:
    """Two flags per member: the acceleration is not finite just ahead; it jumps there.

    `acceleration(t, y)` gives q̈, with a last axis of n. `shrank` flags the members whose step became too small,
    `spent` those whose budget of steps is used up; others are not examined.
    """
    on_host = isinstance(at.y, np.ndarray)
    library, loop, evaluate_each = (
        (np, _loop_in_python, map)
        if on_host
        else (jnp, jax.lax.while_loop, lambda f, xs: jax.lax.map(f, jnp.stack(xs)))
    )
    n = at.y.shape[-1] // 2
    smallest = 4 * np.finfo(at.y.dtype).eps * library.maximum(abs(at.begin), abs(at.end))
    forward = library.where(at.end > at.begin, 1.0, -1.0) * smallest
    rate = library.concatenate([at.y[..., n:], acceleration(at.t, at.y)], axis=-1)

    def acceleration_after(s):
        return acceleration(at.t + s, at.y + s[..., None] * rate)

    half = _jump_window(library, at, smallest, shrank)
    *ahead, low, high = evaluate_each(acceleration_after, [*(steps * forward for steps in AHEAD), -half, half])
    defined = shrank
    for value in ahead:
        defined = defined & library.isfinite(value).all(axis=-1)
    size = library.abs(low) + library.abs(high)

    def variation(a, b):
        return (library.abs(b - a) / library.where(size > 0, size, 1.0)).max(axis=-1)

    looked_at = (shrank & defined) | spent

    def goes_on(bracket):
        count, _, _, low, high = bracket
        return (count < HALVINGS) & (looked_at & (variation(low, high) > JUMP)).any()

    def halve(bracket):
        count, start, width, low, high = bracket
        width = 0.5 * width
        middle = acceleration_after(start + width)
        first = variation(low, middle) > variation(middle, high)
        start = library.where(first, start, start + width)
        low = library.where(first[..., None], low, middle)
        high = library.where(first[..., None], middle, high)
        return count + 1, start, width, low, high

    *_, low, high = loop(goes_on, halve, (0, -half, 2.0 * half, low, high))
    left = variation(low, high)
    return shrank & ~defined, looked_at & (left > JUMP) & (left < POLE)


def _jump_window(library, at: End, smallest, shrank):
    """The length of time at the end of a motion in which a jump of q̈ is searched for."""
    mean = abs(at.t - at.begin) / library.maximum(at.accepted, 1)
    fighting = at.rejected > FIGHTING * (at.accepted + at.rejected)
    wide = mean * library.where(fighting, FAR, NEAR)
    return library.where(shrank, NARROW * smallest, library.maximum(wide, NARROW * smallest))


def _loop_in_python(goes_on: Callable, body: Callable, carry):
    while goes_on(carry):
        carry = body(carry)
    return carry
