"""Work spread over processes, in order, with bounded memory, and without a way to hang."""

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, TimeoutError
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def default_workers() -> int:
    """Number of processes that use every core this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _start_worker(initializer: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C for all
    if initializer is not None:
        initializer(*arguments)


def ordered_map(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    workers: int,
    initializer: Callable[..., None] | None = None,
    arguments: tuple[Any, ...] = (),
    timeout_s: float = 600.0,
) -> Iterator[Result]:
    """Apply a function to tasks in worker processes and yield the results in order.

    At most three tasks per worker are under way, so that neither tasks nor results pile up. With
    one worker everything runs in this process.

    Args:
        function: A module-level function.
        tasks: Its arguments; drawn as they are needed.
        workers: Number of processes, >= 1.
        initializer: Called once in each process before any task.
        arguments: Its arguments.
        timeout_s: Longest time that one result may take, in seconds.

    Yields:
        One result per task.

    Raises:
        ValueError: If ``workers`` is below 1.
        RuntimeError: If a worker dies or a result takes too long; the others are stopped.
    """
    if workers < 1:
        raise ValueError(f"workers must be >= 1, got {workers}.")
    if workers == 1:
        if initializer is not None:
            initializer(*arguments)
        yield from map(function, tasks)
        return
    context = multiprocessing.get_context("spawn")  # no copies of this process's tables
    pool = ProcessPoolExecutor(workers, context, _start_worker, (initializer, arguments))
    try:
        yield from _in_order(pool, function, tasks, 3 * workers, timeout_s)
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker process died, most likely for want of memory: run again with fewer --workers."
        ) from error
    except TimeoutError as error:
        for process in list(pool._processes.values()):
            process.kill()
        raise RuntimeError(
            f"a task took more than {timeout_s:g} s; run again with --workers 1 to see where it "
            "stands."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _in_order(
    pool: ProcessPoolExecutor,
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    limit: int,
    timeout_s: float,
) -> Iterator[Result]:
    """Keep at most ``limit`` tasks in the pool and yield the oldest one's result."""
    pending: deque[Future[Result]] = deque()
    for task in tasks:
        pending.append(pool.submit(function, task))
        if len(pending) == limit:
            yield pending.popleft().result(timeout_s)
    while pending:
        yield pending.popleft().result(timeout_s)
