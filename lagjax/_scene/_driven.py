"""Replace the argument `inputs` of a scene's functions by parameters, so that they take `t` and `params` alone.

The parameters become `DrivenParams`: the user's, and data from which `find_inputs(data, t)` computes the inputs at the
time t. In `fit` the data are a table of samples, in `linearize` the inputs themselves.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from lagjax._interface import Function, accept, restrict_signature
from lagjax._interface.reads import Edition
from lagjax._scene._system import ROLES, System, replace_functions


class DrivenParams(NamedTuple):
    """Parameters (params of the user, inputs): of a scene with inputs, with data that the inputs are computed from."""

    params: PyTree
    inputs: PyTree


class _FunctionOfInputs(eqx.Module):
    """A user's function that takes `DrivenParams`, and calls it with `find_inputs(params.inputs, t)` as inputs."""

    function: Function
    find_inputs: Callable = eqx.field(static=True)

    @property
    def __name__(self) -> str:
        return self.function.name

    def __call__(self, *roles, params: DrivenParams, t=0.0, **more):
        extras = {"t": t, "params": params.params, **more}
        if "inputs" in self.function.extras:
            extras["inputs"] = self.find_inputs(params.inputs, t)
        return self.function(*roles, **extras)


def drive_scene(system: System, find_inputs: Callable, extras: tuple[str, ...] = ("params",)) -> System:
    """Return the scene for `DrivenParams`; `extras` names what `find_inputs` depends on: "params", or "t" too."""
    arrays, scene = jax.tree.flatten(system)
    return _drive_system(system, find_inputs, extras) if arrays else _driven_from_tree(scene, find_inputs, extras)


@functools.lru_cache(maxsize=64)
def _driven_from_tree(scene: Any, find_inputs: Callable, extras: tuple[str, ...]) -> System:
    return _drive_system(jax.tree.unflatten(scene, []), find_inputs, extras)


def _drive_system(system: System, find_inputs: Callable, extras: tuple[str, ...]) -> System:
    functions = {role: getattr(system, role) for role in ROLES}
    return replace_functions(
        system, {role: f and drive_function(f, find_inputs, extras) for role, f in functions.items()}
    )


def drive_function(function: Function, find_inputs: Callable, extras: tuple[str, ...]) -> Function:
    """Return one function of a scene for `DrivenParams`; `drive_scene` does this for all."""
    arrays, code = eqx.partition(_FunctionOfInputs(function, find_inputs), eqx.is_array)
    finding = extras if "inputs" in function.extras else ("params",)  # laws of contacts take nothing else
    asked = tuple(x for x in dict.fromkeys((*finding, *function.extras)) if x != "inputs")
    return Function(arrays, Edition.from_function(code), asked)


def constant_inputs(held: PyTree, t: Any) -> PyTree:
    """A `find_inputs` for inputs that are constant in time: returns them."""
    return held


def add_input_forces(system: System) -> System:
    """Return the scene with its `inputs`, in the structure of q, added to the generalised forces."""
    own = system.forces

    def forces(q, qdot, t, params, inputs, **more):
        if own is None:
            return inputs
        return jax.tree.map(jnp.add, own(q, qdot, t=t, params=params, **more), inputs)

    extras = {"inputs", *(() if own is None else own.extras)}
    pushed = accept(restrict_signature(forces, extras), "forces", extras=("t", "params", "inputs", "multipliers"))
    return replace_functions(system, {"forces": pushed})


def roles_with_inputs(system: System) -> list[str]:
    """Return the roles of the scene's functions that take `inputs`."""
    functions = ((role, getattr(system, role)) for role in ROLES)
    return [role for role, function in functions if function is not None and "inputs" in function.extras]
