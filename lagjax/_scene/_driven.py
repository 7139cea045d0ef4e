"""A scene whose functions ask for `inputs`, as one whose functions ask for `t` and `params` alone.

Its parameters are `Driven`: those of the user, and beside them numbers in which a function finds the inputs at the time
t. `fit` keeps a table of samples there, `linearize` the inputs themselves.
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


class Driven(NamedTuple):
    """The parameters of a scene with inputs: those of the user, and what the inputs are found in."""

    params: PyTree
    inputs: PyTree


class _FunctionOfInputs(eqx.Module):
    """A function of the user, for parameters that are `Driven`; `find_inputs(held, t)` are its inputs."""

    function: Function
    find_inputs: Callable = eqx.field(static=True)

    @property
    def __name__(self) -> str:
        return self.function.name

    def __call__(self, *roles, params: Driven, t=0.0, **more):
        extras = {"t": t, "params": params.params, **more}
        if "inputs" in self.function.extras:
            extras["inputs"] = self.find_inputs(params.inputs, t)
        return self.function(*roles, **extras)


def drive_scene(system: System, find_inputs: Callable, extras: tuple[str, ...] = ("params",)) -> System:
    """The scene for parameters that are `Driven`; `extras` are what finding the inputs takes, "params" or "t" too."""
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
    """A function of a scene for parameters that are `Driven`, as `drive_scene` makes it of all."""
    arrays, code = eqx.partition(_FunctionOfInputs(function, find_inputs), eqx.is_array)
    finding = extras if "inputs" in function.extras else ("params",)  # laws of contacts take nothing else
    asked = tuple(x for x in dict.fromkeys((*finding, *function.extras)) if x != "inputs")
    return Function(arrays, Edition.from_function(code), asked)


def held_inputs(held: PyTree, t: Any) -> PyTree:
    """The inputs of a scene in which they are held."""
    return held


def push_by_inputs(system: System) -> System:
    """The scene with further generalised forces: its `inputs`, in the structure of q."""
    own = system.forces

    def forces(q, qdot, t, params, inputs, **more):
        if own is None:
            return inputs
        return jax.tree.map(jnp.add, own(q, qdot, t=t, params=params, **more), inputs)

    extras = {"inputs", *(() if own is None else own.extras)}
    pushed = accept(restrict_signature(forces, extras), "forces", extras=("t", "params", "inputs", "multipliers"))
    return replace_functions(system, {"forces": pushed})


def asking_for_inputs(system: System) -> list[str]:
    """The roles of functions of the scene that ask for `inputs`."""
    functions = ((role, getattr(system, role)) for role in ROLES)
    return [role for role, function in functions if function is not None and "inputs" in function.extras]
