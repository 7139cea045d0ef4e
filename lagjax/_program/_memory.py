"""The memory of this machine, and how much of it graphs of millions of nodes may take."""

import os
from pathlib import Path

SHARE = 0.5  # of the machine's memory, that one scene may take; JAX, other scenes and results have the rest
_UNKNOWN = 8 * 2**30  # bytes of a machine that does not say how many it has
_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of a container


def machine_memory() -> int:
    """The bytes of memory of this machine, or of the container in which this process runs."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        memory = _UNKNOWN
    try:
        return min(memory, int(_LIMIT.read_text()))
    except (ValueError, OSError):  # "max", or no such file
        return memory


def operations_that_fit(bytes_each: int) -> int:
    """The number of operations, of `bytes_each`, that fit into the fraction `SHARE` of the memory."""
    return int(SHARE * machine_memory() / bytes_each)


def lack_of_memory(needed: float) -> str | None:
    """The end of an error sentence if `needed` bytes exceed the fraction `SHARE` of the memory, else None."""
    there = machine_memory()
    if needed <= SHARE * there:
        return None
    return f"would take some {needed / 2**30:.3g} GiB of memory at once, and this machine has {there / 2**30:.3g}"
