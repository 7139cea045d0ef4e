"""Linear algebra of NumPy on one thread.

The threads of OpenBLAS, which comes with NumPy, wait for each other in a loop. Where other work shares the cores, they
wait long: 482 rows of 289 columns, which one thread factorises in 2 ms, take two threads 25 to 40.
"""

import contextlib
import ctypes
import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

_NAME = "scipy_openblas_{}_num_threads{}"


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """OpenBLAS works on one thread in this context, if it is NumPy's; it then has as many as before."""
    if (pair := _thread_counts()) is None:
        yield
        return
    get, put = pair
    before = get()
    put(1)
    try:
        yield
    finally:
        put(before)


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
