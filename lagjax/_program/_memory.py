"""Python's memory while graphs of millions of nodes grow."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def without_collections() -> Iterator[None]:
    """Inside, Python does not look for cycles of references.

    A graph consists of tuples, none of which is part of a cycle. To walk over all of them again and again while they
    become more takes a third of the time of a lowering. Whoever stopped it lets it go on, also among several threads.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
