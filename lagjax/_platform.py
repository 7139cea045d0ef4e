"""The device: its kind, as far as a traced program can know it, and the numbers of the arrays that it holds."""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer


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


def is_known(x: Any) -> bool:
    """True if the values of an array can be read here: it is neither traced, nor a shape alone, nor deleted."""
    if isinstance(x, Tracer):
        return False
    if isinstance(x, jax.Array):
        return x.is_fully_addressable and not x.is_deleted()
    return isinstance(x, np.ndarray | np.generic)


def numbers_at(array, place: tuple) -> np.ndarray:
    """`array[place]` in NumPy; of an array on another device only that much is copied from there."""
    elsewhere = isinstance(array, jax.Array) and any(device.platform != "cpu" for device in array.devices())
    return np.asarray(array[place] if elsewhere else np.asarray(array)[place])
