"""Every test runs in double precision unless it says otherwise."""

import jax

jax.config.update("jax_enable_x64", True)
