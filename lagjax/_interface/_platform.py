"""The device that JAX computes on: its kind, options of XLA's compilation, and reading numbers from arrays."""

import functools
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental.xla_metadata import set_xla_metadata
from jax.interpreters.ad import JVPTracer


def default_platform() -> str:
    """`"cpu"`, `"gpu"` or another one: that of `jax.default_device` if there is one, else of JAX's default backend."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]  # also a platform's name
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


def has_nvidia_gpu() -> bool:
    """True if the default device is a GPU that JAX runs by CUDA."""
    if default_platform() != "gpu":
        return False
    try:
        return bool(jax.devices("cuda"))
    except RuntimeError:
        return False


@functools.cache
def _unoptimised_options() -> dict[str, Any]:
    """Return compiler options that switch XLA's optimisation off, as far as this version of XLA accepts them."""
    # Compilation of the algebra around a few matrices takes half of the time so, and runs as fast to a millisecond.
    options = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0.0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        options.pop("xla_cpu_use_fusion_emitters")
    return options


def compile_for_one_call(function: Callable) -> Callable:
    """Wrap a function that runs rarely: called with numbers, it is compiled without optimisation, which is faster."""
    # Within what is traced already, which may run often, it is optimised as all else there. `jax.jvp` and `jax.jacfwd`
    # call it with numbers; reverse mode traces what it pulls back, which takes no options.
    optimised = eqx.filter_jit(function)

    @functools.cache
    def as_written() -> Callable:
        return eqx.filter_jit(function, compiler_options=_unoptimised_options())  # pyright: ignore[reportCallIssue]

    @functools.wraps(function)
    def call(*arguments):
        leaves = jnp.zeros(()), *jax.tree.leaves(arguments)  # what is made while something is traced is a tracer
        return (optimised if any(isinstance(_primal_of(x), Tracer) for x in leaves) else as_written())(*arguments)

    return call


def _primal_of(x: Any) -> Any:
    while isinstance(x, JVPTracer):
        x = x.primal
    return x


def compiled_once(function: Callable) -> Callable:
    """Jit a function such that XLA on a CPU compiles it once and calls it, instead of inlining it at every call."""
    # On a GPU a call of its own costs as much as the arithmetic of a step, and compiling ten of them is quick.

    @jax.jit
    def body(*arguments):
        with set_xla_metadata(inlineable="true"):  # a call within, of `jnp.where` for one, would inherit "false"
            return function(*arguments)

    def call(*arguments):
        with set_xla_metadata(inlineable="false") if default_platform() == "cpu" else nullcontext():
            return body(*arguments)

    return call


def is_known(x: Any) -> bool:
    """True if the values of an array can be read now: it is no tracer, no `ShapeDtypeStruct`, and not deleted."""
    if isinstance(x, Tracer):
        return False
    if isinstance(x, jax.Array):
        return x.is_fully_addressable and not x.is_deleted()
    return isinstance(x, np.ndarray | np.generic)


def numbers_at(array, place: tuple) -> np.ndarray:
    """Return `array[place]` in NumPy; from another device only this part is copied."""
    elsewhere = isinstance(array, jax.Array) and any(device.platform != "cpu" for device in array.devices())
    return np.asarray(array[place] if elsewhere else np.asarray(array)[place])
