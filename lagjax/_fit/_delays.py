"""`Delayed`: sensors that show at a time t what was at t − τ, and how that moves with the delay τ.

The motion is followed at the times t − τ themselves, so that nothing is interpolated, and with ẏ its rate there

    δy(t − τ) = δy − ẏ δτ

Before a record begins nothing is known: the samples of its first `longest` units of time are left out, whatever the
delay of a trial is, so that the sum of squares does not jump where a delay passes a sample.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Record

PyTree = Any


@dataclass(frozen=True)
class Delayed:
    """Sensors with a delay: `fit(..., observe=lagjax.Delayed(lambda params: params["tau"], longest=0.1))`.

    - `delay`: a function of the parameters that returns the delay of all signals, or a prefix of the structure of a
      record's `values` with one for each. It is fitted like any parameter, with exact derivatives.
    - `longest`: the largest possible delay. The samples in the first `longest` of every record are left out, because
      they may show the motion before its start. A trial whose delay is negative or larger than `longest` counts as
      failed; the transform `lagjax.between(0.0, longest)` keeps the delay inside.
    - `observe`: what the sensors show, as for `fit`; by default q. It gets the state, the time and the inputs at the
      delayed time.

    **Raises** `TypeError` or `ValueError` for a `longest` that is no positive number.

    ```python
    import lagjax

    sensors = lagjax.Delayed(lambda params: params["delay"], longest=0.1, observe=lambda q, qdot: q)
    transforms = {"delay": lagjax.between(0.0, 0.1), "mass": lagjax.positive}
    # lagjax.fit(..., observe=sensors, transforms=transforms)
    ```
    """

    delay: Callable
    longest: float
    observe: Callable | None = None

    def __post_init__(self):
        if not callable(self.delay):
            raise TypeError(f"delay must be a function of the parameters; got {self.delay!r}.")
        if not (eqx.is_array_like(self.longest) and np.ndim(self.longest) == 0 and 0 < self.longest < np.inf):
            raise ValueError(f"longest must be a positive number, the largest possible delay; got {self.longest!r}.")


class Delay(NamedTuple):
    """One of the delays: the `signals` that have it, its value, and its derivatives by all parameters (P,)."""

    signals: np.ndarray
    value: float
    slopes: np.ndarray


class Delays:
    """The delays of the signals of records, as functions of the parameters."""

    def __init__(self, delayed: Delayed, parameters: Parameters, record: Record):
        leaves, tree = jax.tree.flatten(record.values)
        places = np.split(np.arange(record.matrix.shape[1]), np.cumsum([x[0].size for x in leaves])[:-1])
        self.longest = float(delayed.longest)

        def of(numbers):
            given = delayed.delay(parameters.restore(numbers))
            try:
                spread = tree.flatten_up_to(jax.tree.broadcast(given, record.values))
            except ValueError:
                raise ValueError("delay must return one number, or a prefix of the structure of values.") from None
            if any(jnp.shape(one) != () for one in spread):
                raise ValueError("delay must return numbers, one for all signals or one for each leaf of values.")
            return jnp.stack([jnp.asarray(one, numbers.dtype) for one in spread])

        self._at = jax.jit(lambda numbers: (of(numbers), jax.jacfwd(of)(numbers)))
        self.places = places
        # Leaves that share one number share one motion.
        jax.eval_shape(of, jax.ShapeDtypeStruct(parameters.first.shape, parameters.first.dtype))

    def at(self, numbers: np.ndarray) -> list[Delay]:
        """The different delays at the parameters `numbers` (P,)."""
        values, slopes = (np.asarray(x, float) for x in self._at(numbers))
        rows, which = np.unique(np.concatenate([values[:, None], slopes], axis=1), axis=0, return_inverse=True)
        which = which.ravel()
        return [
            Delay(np.concatenate([self.places[i] for i in np.flatnonzero(which == k)]), float(row[0]), row[1:])
            for k, row in enumerate(rows)
        ]

    def refuses(self, delays: list[Delay]) -> str | None:
        """Why a trial with these delays is none, as a sentence."""
        for one in delays:
            if not 0.0 <= one.value <= self.longest:
                return f"A delay is {one.value:.4g}, but must lie between 0 and the longest one, {self.longest:g}."
        return None
