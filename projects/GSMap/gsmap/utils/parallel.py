"""Work spread over processes, in order, with bounded memory, and without a way to hang."""

import ctypes
import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, TimeoutError
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def default_workers() -> int:
    """Number of processes that use every core this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def spared_from_signals() -> Iterator[None]:
    """Let processes that start in this block ignore Ctrl-C and ``kill`` from their first moment.

    A starting process would answer Ctrl-C, which a terminal sends to all, with a traceback. What
    this process is sent meanwhile reaches it at the end of the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def die_with_parent() -> None:
    """Have Linux kill this process when its parent dies, however that dies."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


class _Worker:
    """State of a worker process."""

    function: Callable[[Any], Any]
    stopping = False
    busy = False


def _start_worker(setup: Path) -> None:
    """Prepare a worker process, which ends with its parent, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C for all
    signal.signal(signal.SIGTERM, _stop_worker)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _Worker.function, initializer, arguments = pickle.loads(setup.read_bytes())
    if initializer is not None:
        initializer(*arguments)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _stop_worker(number: int, _frame: object) -> None:
    """Leave the task at hand through its clean-up, and take up no other."""
    _Worker.stopping = True
    if _Worker.busy:  # in between, results are on their way and must not be cut off
        raise SystemExit(128 + number)


def _work(task: Any) -> Any:
    """Do a task in a worker unless it is to stop."""
    _Worker.busy = True
    try:
        if _Worker.stopping:
            raise SystemExit(128 + signal.SIGTERM)
        return _Worker.function(task)
    finally:
        _Worker.busy = False


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
    one worker everything runs in this process. Whatever ends it early, such as an error or Ctrl-C,
    stops the tasks under way, through their own clean-up.

    Args:
        function: A picklable function; it reaches each process once, not with every task.
        tasks: Its arguments, picklable; drawn as they are needed.
        workers: Number of processes, >= 1.
        initializer: Called once in each process before any task; a module-level function.
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
    with TemporaryDirectory() as folder:
        # Through a file: what a new process is handed goes through a pipe, and if it is long and
        # the process dies before it reads it, this one would wait for ever.
        setup = Path(folder, "setup.pickle")
        setup.write_bytes(pickle.dumps((function, initializer, arguments)))
        context = multiprocessing.get_context("spawn")  # no copies of this process's tables
        with _ending(
            ProcessPoolExecutor(workers, context, _start_worker, (setup,)), timeout_s
        ) as pool:
            yield from _in_order(pool, tasks, 3 * workers, timeout_s)


@contextmanager
def _ending(pool: ProcessPoolExecutor, timeout_s: float) -> Iterator[ProcessPoolExecutor]:
    """End a pool with the block: at leisure if it ends well, and otherwise at once, in words."""
    done = False
    try:
        yield pool
        done = True
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker process died: most likely for want of memory (run again with fewer "
            "--workers), or because the program that called this cannot be imported anew (put the "
            "call under if __name__ == '__main__')."
        ) from error
    except TimeoutError as error:
        for process in list(pool._processes.values()):
            process.kill()
        raise RuntimeError(
            f"a task took more than {timeout_s:g} s; run again with --workers 1 to see where it "
            "stands."
        ) from error
    finally:
        if not done:
            for process in list((pool._processes or {}).values()):
                process.terminate()
        pool.shutdown(cancel_futures=True)


def _in_order(
    pool: ProcessPoolExecutor, tasks: Iterable[Any], limit: int, timeout_s: float
) -> Iterator[Any]:
    """Keep at most ``limit`` tasks in the pool and yield the oldest one's result."""
    pending: deque[Future[Any]] = deque()
    for task in tasks:
        with spared_from_signals():
            pending.append(pool.submit(_work, task))
        if len(pending) == limit:
            yield pending.popleft().result(timeout_s)
    while pending:
        yield pending.popleft().result(timeout_s)
