"""`Origins`: the starts of records that follow from the parameters, with derivatives."""

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit._parameters import Parameters
from lagjax._fit._records import started
from lagjax._layout import Layout


class Origins:
    """Of each piece whose start is a function of the parameters: which one it is, and that function, compiled once."""

    def __init__(self, starts: list, layout: Layout, parameters: Parameters):
        """`starts` is what the record of each piece says of its start; None where the piece begins later."""

        def of(function):
            def state(numbers):
                q, qdot = started(function, parameters.restore(numbers))
                return jnp.concatenate([layout.flatten(q), layout.flatten(qdot)])

            return jax.jit(lambda numbers: (state(numbers), jax.jacfwd(state)(numbers)))

        functions = {start: of(start) for start in starts if callable(start)}
        self.functions = {k: functions[start] for k, start in enumerate(starts) if callable(start)}
        self.dtype = layout.dtype

    def move(self, starts: np.ndarray, numbers: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The starts (N, 2n) at the parameters `numbers` (P,), and how they move along `directions` (F, P) of these,
        (N, F, 2n): not at all where they are no function of them."""
        starts, moved = starts.copy(), np.zeros((len(starts), len(directions), starts.shape[1]))
        made: dict = {}
        for k, function in self.functions.items():
            if function not in made:
                made[function] = [np.asarray(x, float) for x in function(numbers.astype(self.dtype))]
            starts[k], slopes = made[function]
            moved[k] = directions @ slopes.T
        return starts, moved
