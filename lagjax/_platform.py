"""Which kind of device JAX computes on, as far as a program that is being traced can know."""

import jax


def default_platform() -> str:
    """`"cpu"`, `"gpu"` or another one: that of `jax.default_device` if there is one, else of JAX's default backend."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]  # also a platform's name
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform
