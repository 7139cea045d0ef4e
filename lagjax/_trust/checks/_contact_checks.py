"""Contacts: whether the motion starts inside one, moves into one that is closed, and whether each has a direction."""

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import ROUNDINGS
from lagjax._scene import Flat
from lagjax._trust.checks._findings import Finding
from lagjax._trust.checks._scene_at_start import CheckedScene


def findings(scene: CheckedScene) -> list[Finding]:
    if scene.system.contacts is None:
        return []
    (q, qdot, t, numbers), layout = scene.state, scene.layout
    flat = Flat.from_system(scene.system, layout, scene.arguments[3])
    gaps, rates = jax.jvp(lambda q, t: flat.gaps(q, t, numbers), (q, t), (qdot, jnp.ones_like(t)))
    slopes = jax.jacfwd(lambda q: flat.gaps(q, t, numbers))(q)
    gaps, rates, slopes = (np.asarray(x) for x in (gaps, rates, slopes))
    closed, reported = ROUNDINGS * np.finfo(layout.dtype).eps, []
    near_zero = closed * (np.abs(slopes) @ np.abs(np.asarray(q)) + np.abs(gaps))
    at_rest = closed * (np.abs(slopes) @ np.abs(np.asarray(qdot)))
    measured = zip(flat.shapes.names, gaps, rates, slopes, near_zero, at_rest, strict=False)
    for name, gap, rate, slope, near, slow in measured:
        if not slope.any():
            message = (
                f"The gradient of the gap {name} is zero here: where it closes it has no direction to push in. Write "
                "it as a distance, not as a square or a product."
            )
            level = "error" if abs(gap) <= near else "warning"
            reported.append(Finding("contact_zero_gradient", level, (name,), message))
        elif gap < -near:
            message = f"The gap {name} is {gap:.6g}: the motion starts inside. Gaps stay >= 0."
            reported.append(Finding("contact_inside", "error", (name,), message))
        elif abs(gap) <= near and rate < -slow:
            message = (
                f"The gap {name} is closed and changes by {rate:.6g} per unit of time: the motion begins with an "
                "impact at once. Start it with a velocity along the contact if that is not meant."
            )
            reported.append(Finding("contact_inwards", "advice", (name,), message))
    return reported
