"""Worker processes that end: with the work done, or with an error that says what to do."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

_function: Callable[[Any], Any] | None = None


def _install(function: Callable[[Any], Any]) -> None:
    global _function
    _function = function


def _call(task: Any) -> Any:
    assert _function is not None
    return _function(task)


def _start_method() -> str:
    """Fork where it is safe: on Linux, from a process of one thread. Otherwise start afresh.

    A forked worker shares what is loaded already; but a fork while another thread holds a lock is
    how pools come to hang.
    """
    threads = Path("/proc/self/task")
    if threads.is_dir() and len(os.listdir(threads)) == 1:
        return "fork"
    return "spawn"


def map_unordered(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    num_workers: int,
    stall_timeout_s: float = 600.0,
) -> Iterator[Result]:
    """Apply a function to tasks in worker processes and yield the results as they come.

    Args:
        function: A picklable function; it reaches each worker once, not with every task.
        tasks: Picklable arguments.
        num_workers: Number of processes; with 1 everything runs in this one.
        stall_timeout_s: Longest time without any result before the pool is ended.

    Yields:
        Results, in any order.

    Raises:
        RuntimeError: If a worker dies (killed, out of memory).
        TimeoutError: If no task ends for ``stall_timeout_s``.
        ValueError: If ``num_workers`` is below 1.
    """
    if num_workers < 1:
        raise ValueError(f"num_workers must be >= 1, got {num_workers}.")
    if num_workers == 1 or len(tasks) < 2:
        yield from map(function, tasks)
        return
    context = multiprocessing.get_context(_start_method())
    pool = ProcessPoolExecutor(num_workers, context, initializer=_install, initargs=(function,))
    before = set(multiprocessing.active_children())
    pending: set[Future[Result]] = {pool.submit(_call, task) for task in tasks}
    try:
        while pending:
            done, pending = wait(pending, stall_timeout_s, FIRST_COMPLETED)
            if not done:
                raise TimeoutError(
                    f"no worker finished a task within {stall_timeout_s:g} s: run with one worker "
                    "to see where it stops."
                )
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker process died, most likely for lack of memory: run with fewer workers."
        ) from error
    finally:
        if pending:  # left early: do not wait for work that nobody will read
            for worker in set(multiprocessing.active_children()) - before:
                worker.terminate()
        pool.shutdown(wait=True, cancel_futures=True)
