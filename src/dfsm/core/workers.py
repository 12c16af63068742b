"""The same work on many tasks, in processes of their own where more than one may run at a time.

Processes are spawned, not forked: JAX has threads, which a fork would leave in mid-work. They are
not joblib's (loky 3.6, in joblib 1.6): its workers do not learn of a killed parent and lived on.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from dfsm.errors import DfsmError

T = TypeVar("T")
R = TypeVar("R")
S = TypeVar("S")

# What all tasks of a worker share; sent once, not with every task.
_shared: Any = None


def processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def default_jobs() -> int:
    """Half the processors, so that every fit has one for XLA's threads besides its own.

    On two processors shared with other work, two fits at a time took longer than one by one.
    """
    return max(1, processors() // 2)


def in_threads(work: Callable[[T], R], tasks: Sequence[T]) -> list[R]:
    """What work gives for every task, in their order; in threads, for work on arrays frees them."""
    if len(tasks) <= 1:
        return [work(task) for task in tasks]
    with ThreadPoolExecutor(processors()) as pool:
        return list(pool.map(work, tasks))


def work_through(
    work: Callable[[S, T], R], shared: S, tasks: Sequence[T], jobs: int
) -> Iterator[tuple[T, R]]:
    """Call ``work(shared, task)`` for every task and yield task and result as they come.

    Parameters
    ----------
    work
        A function of a module, so that a worker can import it.
    shared
        What all calls need.
    tasks
        What each call needs.
    jobs
        Number of processes; with one, everything happens in this one.

    Raises
    ------
    DfsmError
        A worker died.
    """
    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        for task in tasks:
            yield task, work(shared, task)
        return
    pool = ProcessPoolExecutor(
        jobs,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(shared, max(1, processors() // jobs)),
    )
    done = False
    try:
        with _interrupts_wait():
            futures = {pool.submit(_call, work, task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()
        done = True
    except BrokenProcessPool:
        raise DfsmError(
            "a worker process ended without a result, most often for lack of memory: run again "
            "with fewer jobs, what was finished is kept"
        ) from None
    finally:
        # `shutdown` alone would wait for work that nobody wants any more.
        running = [] if done else list((pool._processes or {}).values())
        pool.shutdown(wait=done, cancel_futures=True)
        for process in running:
            process.terminate()


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Let Ctrl-C wait while workers are started: they inherit that, and leave it to us."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(shared: Any, threads: int) -> None:
    """Set up a worker."""
    global _shared
    _shared = shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Read by XLA when it starts, which is later than this.
    os.environ.setdefault("NPROC", str(threads))
    # On a GPU, the first process would take three quarters of its memory and leave none to others.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    threadpool_limits(limits=threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that was killed cannot end its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _call(work: Callable[[Any, T], R], task: T) -> R:
    return work(_shared, task)
