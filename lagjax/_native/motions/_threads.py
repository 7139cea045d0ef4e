"""Machine code on several threads, which an interrupt can stop.

Python handles signals, and raises `KeyboardInterrupt`, on the main thread and between its own instructions only; code
that runs for a minute would delay it by a minute. So machine code runs in slices of a few hundredths of a second, on
the calling thread as on the others; an exception between two slices ends the work of all.

Threads are started for each run, which costs less than a member does, and end with it: there is nothing that a fork
could lose or for which the end of the interpreter would wait.
"""

import _thread
import queue
import threading
import time
from collections.abc import Callable

SLICE = 0.03  # seconds, more or less: a tenth of what a hand at the keyboard notices, a thousand times what it costs


def run_in_slices(run: Callable[[int], int], stopped: Callable[[], bool], rounds: int) -> None:
    """Call `run(rounds)` until it returns 0 or `stopped()`; `rounds` is adapted so that a call takes a `SLICE`."""
    while not stopped():
        begin = time.perf_counter()
        if not run(rounds):
            return
        took = time.perf_counter() - begin
        if took < 0.5 * SLICE:
            rounds *= 2
        elif took > 2.0 * SLICE:
            rounds = max(1, rounds // 2)


def run_on_threads(work: Callable[[Callable[[], bool]], int], count: int) -> int:
    """Call `work(stopped)` on `count` threads, including the caller's; the sum of the results.

    If one raises, `stopped()` becomes true for the others, and the exception is raised after all have ended. `work`
    must own all that it needs, so that no memory is freed while a thread runs.
    """
    if count == 1:  # there is no other thread to stop, or to wait for
        return work(lambda: False)
    stop, ended, signal = threading.Event(), [], queue.SimpleQueue()

    def help_out():
        try:
            ended.append(work(stop.is_set))
        except BaseException as failure:
            stop.set()
            ended.append(failure)
        signal.put(None)

    helpers = 0
    try:
        for _ in range(count - 1):
            try:
                _thread.start_new_thread(help_out, ())  # `threading.Thread` is left behind half started by an interrupt
            except RuntimeError:  # there are no more threads to be had: those there are do the work
                break
            helpers += 1
        total = work(stop.is_set)
    except BaseException:
        stop.set()
        raise
    finally:
        _wait_for_helpers(helpers, ended, signal, stop)
    for result in ended:
        if isinstance(result, BaseException):
            raise result
        total += result
    return total


def _wait_for_helpers(helpers: int, ended: list, signal: queue.SimpleQueue, stop: threading.Event) -> None:
    """Wait until all helper threads have ended; an interrupt stops them first, and is raised afterwards."""
    interrupt = None
    while len(ended) < helpers:
        try:
            signal.get(timeout=1.0)
        except queue.Empty:
            pass
        except BaseException as reason:
            stop.set()
            interrupt = reason
    if interrupt is not None:
        raise interrupt
