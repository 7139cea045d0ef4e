"""Functions of rooms above that rooms below call: a trajectory shows itself, a failure is explained.

No room imports from above. `lagjax/__init__` says here where these functions are, and a call imports them.
"""

import importlib
from typing import Any

PLACES: dict[str, str] = {}  # module of each function by its name


def import_registered(name: str) -> Any:
    return getattr(importlib.import_module(PLACES[name]), name)
