"""Linear algebra of NumPy on one thread.

The threads of OpenBLAS, which comes with NumPy, wait for each other in a loop. Where other work shares the cores, they
wait long: 482 rows of 289 columns, which one thread factorises in 2 ms, take two threads 25 to 40.
"""

import contextlib
import ctypes
import functools
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np

# The number of threads is that of the whole process. What those that are inside found when they entered: the last of
# all that leaves takes what the first one found, whatever the order in which they leave.
_lock, _found = threading.Lock(), []
_NAME = "scipy_openblas_{}_num_threads{}"


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """OpenBLAS works on one thread in this context, if it is NumPy's; it then has as many as before."""
    if (pair := _thread_counts()) is None:
        yield
        return
    get, put = pair
    with _lock:
        _found.append(get())
        put(1)
    try:
        yield
    finally:
        with _lock:
            count = _found.pop()
            if not _found:
                put(count)


@functools.cache
def _thread_counts() -> tuple | None:
    """The functions of NumPy's OpenBLAS that get and set its number of threads; None without it."""
    root = Path(np.__file__).parent
    for file in [*root.parent.glob("numpy.libs/*openblas*"), *root.glob(".dylibs/*openblas*")]:
        library = ctypes.CDLL(str(file))  # it is loaded already
        for ending in ("64_", ""):
            with contextlib.suppress(AttributeError):
                return library[_NAME.format("get", ending)], library[_NAME.format("set", ending)]
    return None
