"""Every test runs in double precision unless it says otherwise, with one store of compiled programs for all runs."""

import gc
import hashlib
import itertools
import os
import sys
import threading
from importlib.metadata import version
from pathlib import Path

# XLA counts two of its own preferences among the features of a CPU and logs, of each program it reads back, that this
# CPU lacks them. It reads its level of logging when it is imported.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

# Machine code is what most tests are of, and it runs on CPUs. What is of GPUs asks for them itself (`test_gpu.py`).
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# XLA compiles the suite's programs, small ones that run for milliseconds, three to four times as fast by its older
# emitters, unoptimised and in one piece. Set XLA_FLAGS to an empty string to run the tests as XLA is by default. An
# unknown flag ends a process, hence the version.
if version("jaxlib").startswith("0.10."):
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
        " --xla_cpu_parallel_codegen_split_count=1",
    )

import jax
import llvmlite.binding
import pytest

from lagjax._native.code import _ir

jax.config.update("jax_enable_x64", True)

# Tracing leaves many objects that live on, and Python's default looks through all of them so often that it took a tenth
# of the time. What is imported before the first test is never garbage, and is looked through no more.
gc.set_threshold(500_000, 10, 50)


def pytest_collection_finish():
    gc.collect()
    gc.freeze()


# Most of the suite's time is XLA at work, so what it compiles is kept: for the other workers of a run, and for the next
# run. A compiled program is for one kind of CPU, which JAX does not ask about when it reads one back.
CPU = llvmlite.binding.get_host_cpu_name() + llvmlite.binding.get_host_cpu_features().flatten()
COMPILED = Path(__file__).parent.parent / ".cache" / "jax" / hashlib.sha256(CPU.encode()).hexdigest()[:16]
jax.config.update("jax_compilation_cache_dir", str(COMPILED))
os.environ["LAGJAX_CACHE"] = str(COMPILED.parent.parent / "objects")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


# For every program JAX makes a context of MLIR, with all dialects in it, and keeps it: of the 18 ms and the 1.3 MB that
# one of a single operation takes, 7 ms and 1.2 MB. Here each thread has one for all of its programs; but a program that
# is lowered while another one is (an implicit solver's) has its own, or MLIR would put its clone into the outer one.
if version("jax").startswith("0.10."):
    from jax._src.interpreters import mlir
    from jaxlib.mlir import ir

    _make_context, _kept = mlir.make_ir_context, threading.local()

    def _context_of_thread():
        try:
            _ = ir.Context.current
        except ValueError:  # no program is being lowered
            if not hasattr(_kept, "context"):
                _kept.context = _make_context()
            return _kept.context
        return _make_context()

    mlir.make_ir_context = _context_of_thread


# Machine code is made fast instead of well, too. What selects instructions is what does at other levels, since LLVM's
# fast one leaves sums of products uncontracted in the code of a single member: the bits stay, as sweeps in other
# processes are compared with, and members of a batch with those members alone.
_ir.LEVELS[:] = [0, 0]
llvmlite.binding.set_option("", "-fast-isel=false")


# Every program of XLA takes some entries of the table of memory that a process has, 65 530 by Linux's default. Without
# one it ends in a segmentation fault, as a worker did after hundreds of slow tests. Kept programs come back fast.
_MAPS, _MOST_MAPS, _BETWEEN = Path("/proc/self/maps"), 25_000, 20
_tests_run = itertools.count(1)


@pytest.fixture(autouse=True)
def _own_style():
    """Examples set the style of figures where they are imported; the next test has Matplotlib's own."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib"].rcdefaults()  # but for the backend


@pytest.fixture(autouse=True)
def _room_for_programs():
    yield
    if next(_tests_run) % _BETWEEN == 0 and _MAPS.exists():
        with _MAPS.open("rb") as maps:
            crowded = sum(1 for _ in maps) > _MOST_MAPS
        if crowded:
            jax.clear_caches()
            gc.collect()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """The number of workers for `-n auto`: one a core for folders of tests, none for a file or a test that is named."""
    named = [part for part in config.args if not Path(part).is_dir()]
    return 0 if named or config.getoption("keyword") else os.cpu_count()
