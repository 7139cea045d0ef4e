"""Long runs that something stops: Ctrl-C, a failing thread, a fork, the end of the interpreter; in new processes.

Nothing may hang or crash, no thread may go on, and the next run must give what it always gives.
"""

import _thread
import os
import random
import signal
import subprocess
import sys
import threading
import time

import jax
import numpy as np
import pytest

import lagjax
from lagjax._native.motions import _threads

SHORT, LONG, LIMIT = np.linspace(0, 1, 3), np.linspace(0, 1e9, 3), 10**9
SCENE = lagjax.scenes.pendulum()
START = np.linspace(0.5, 2.5, 400)


def batch(ts=LONG):
    run = lagjax.simulate_batch(SCENE.system, START, 0 * START, ts, SCENE.params, max_steps=LIMIT)
    return np.asarray(run.q)


def single(ts=LONG):
    return np.asarray(lagjax.simulate(SCENE.system, 1.0, 0.0, ts, SCENE.params, max_steps=LIMIT).q)


def interrupted(run, count):
    """Ctrl-C at `count` random moments of a long run; the next run is complete, and on no thread of the one before."""
    # A shell's background jobs inherit a Ctrl-C that is ignored, and Python then leaves it so.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    draw, expected, threads = random.Random(0), batch(SHORT), _thread._count()
    for _ in range(count):
        delay, caught = draw.choice([0.003, 0.03, 0.3]) * draw.random(), threading.Event()

        def press(delay=delay, caught=caught):
            time.sleep(delay)
            os.kill(os.getpid(), signal.SIGINT)
            while not caught.wait(5.0):  # an interrupt within JAX's hook for the garbage collector is lost
                os.kill(os.getpid(), signal.SIGINT)

        try:
            _thread.start_new_thread(press, ())
            run()
            raise AssertionError("a run of hours has ended")
        except KeyboardInterrupt:
            caught.set()
        patience = time.monotonic() + 5.0
        while _thread._count() > threads and time.monotonic() < patience:
            time.sleep(0.001)
        assert _thread._count() <= threads
        np.testing.assert_array_equal(batch(SHORT), expected)


def interrupt_a_batch(count=10):
    interrupted(batch, count)


def interrupt_a_single_member(count=10):
    interrupted(single, count)


def interrupt_a_compiled_function(count=3):
    """XLA turns the interrupt into an error of its own, which says so. While JAX traces, it may not survive one."""
    function = jax.jit(lambda q: lagjax.simulate(SCENE.system, q, 0.0, LONG, SCENE.params, max_steps=LIMIT).q)
    compiled = function.lower(1.0).compile()

    def run():
        try:
            jax.block_until_ready(compiled(1.0))
        except jax.errors.JaxRuntimeError as error:
            if "KeyboardInterrupt" not in str(error):
                raise
            raise KeyboardInterrupt from error

    interrupted(run, count)


def fork_during_a_batch(count=3):
    expected = batch(SHORT)
    threading.Thread(target=batch, daemon=True).start()
    time.sleep(0.1)
    for _ in range(count):
        child = os.fork()
        if child == 0:
            signal.alarm(30)
            os._exit(0 if np.array_equal(batch(SHORT), expected) else 1)
        assert os.waitpid(child, 0)[1] == 0


def leave_during_a_batch():
    batch(SHORT)  # Python ends a daemon thread in the midst of a compiler's code by an abort of the process
    threading.Thread(target=batch, daemon=True).start()
    time.sleep(0.2)


def run_on_many_threads():
    expected, found = batch(SHORT), []
    threads = [threading.Thread(target=lambda: found.append(batch(SHORT))) for _ in range(8)]
    for step in (threading.Thread.start, threading.Thread.join):
        for thread in threads:
            step(thread)
    assert len(found) == 8
    for path in found:
        np.testing.assert_array_equal(path, expected)


def in_a_process(call: str):
    """Run it in a new interpreter, which must come to its end in time."""
    start = "import jax; jax.config.update('jax_enable_x64', True); import test_interrupts as t; "
    command = [sys.executable, "-W", "ignore", "-c", start + call]
    done = subprocess.run(command, cwd=os.path.dirname(__file__), timeout=200, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_nothing_hangs_or_crashes():
    in_a_process(
        "t.interrupt_a_batch(4); t.interrupt_a_single_member(4); t.run_on_many_threads(); t.fork_during_a_batch(1); "
        "t.leave_during_a_batch()"
    )


@pytest.mark.slow
def test_many_interrupts():
    in_a_process("t.interrupt_a_batch(40); t.interrupt_a_single_member(40); t.interrupt_a_compiled_function(20)")


def test_a_thread_that_fails_stops_the_others():
    begun = threading.Barrier(3)

    def work(stopped):
        begun.wait()
        if threading.current_thread() is not threading.main_thread() and failing.acquire(blocking=False):
            raise ValueError("of this thread")
        while not stopped():
            time.sleep(0.001)
        ended.append(1)
        return 1

    failing, ended = threading.Lock(), []
    with pytest.raises(ValueError, match="of this thread"):
        _threads.run_on_threads(work, 3)
    assert len(ended) == 2
