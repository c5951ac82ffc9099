"""Worker processes that end: with the work done, or with an error that says what to do."""

import multiprocessing
import os
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

_function: Callable[[Any], Any] | None = None


def _install(function: Callable[[Any], Any]) -> None:
    global _function
    _function = function


def _install_from(path: str) -> None:
    _install(pickle.loads(Path(path).read_bytes()))


def _call(task: Any) -> Any:
    assert _function is not None
    return _function(task)


def _num_threads() -> int | None:
    """Count the threads of this process, those of libraries included; None if that is not known."""
    threads = Path("/proc/self/task")
    return len(os.listdir(threads)) if threads.is_dir() else None


def _await_single_thread(patience_s: float = 1.0) -> None:
    """Wait until threads that have ended for Python have ended for the system, too."""
    deadline = time.monotonic() + patience_s
    while _num_threads() != 1 and time.monotonic() < deadline:
        time.sleep(0.001)


def _start_method() -> str:
    """Fork where it is safe: on Linux, from a process of one thread. Otherwise start afresh.

    A forked worker shares what is loaded already; but a fork while another thread holds a lock is
    how pools come to hang.
    """
    return "fork" if _num_threads() == 1 else "spawn"


@contextmanager
def _pool(function: Callable[[Any], Any], num_workers: int) -> Iterator[ProcessPoolExecutor]:
    """Make a pool whose workers know the function."""
    method = _start_method()
    context = multiprocessing.get_context(method)
    if method == "fork":
        yield ProcessPoolExecutor(num_workers, context, initializer=_install, initargs=(function,))
        return
    # Through a file: Python hands the arguments of a new process over by a pipe, and waits for ever
    # if they are longer than the pipe takes and the process dies before it reads them.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "function.pickle")
        path.write_bytes(pickle.dumps(function))
        arguments = (str(path),)
        yield ProcessPoolExecutor(
            num_workers, context, initializer=_install_from, initargs=arguments
        )


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
    else:
        yield from _map_in_pool(function, tasks, num_workers, stall_timeout_s)


def run_apart(
    function: Callable[[Task], Result],
    task: Task,
    meanwhile: Callable[[], None] | None = None,
    stall_timeout_s: float = 600.0,
) -> Result:
    """Call a function in a forked process, so that nothing it loads stays in this one.

    Where a process cannot be forked safely, it is called here.

    Args:
        function: A function.
        task: Its argument, picklable as the result.
        meanwhile: Work to do here at the same time, such as loading what workers that are forked
            later will share; left out where no process can be forked.
        stall_timeout_s: Longest time that the function may take.

    Returns:
        Its result.

    Raises:
        RuntimeError: If the process dies.
        TimeoutError: If it takes longer than ``stall_timeout_s``.
    """
    if _start_method() != "fork":
        return function(task)
    [result] = _map_in_pool(function, [task], 1, stall_timeout_s, meanwhile)
    _await_single_thread()
    return result


def _map_in_pool(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    num_workers: int,
    stall_timeout_s: float,
    meanwhile: Callable[[], None] | None = None,
) -> Iterator[Result]:
    """Apply a function to tasks in worker processes, as ``map_unordered`` says."""
    with _pool(function, num_workers) as pool:
        before = set(multiprocessing.active_children())
        finished: SimpleQueue[Future[Result]] = SimpleQueue()
        remaining = len(tasks)
        try:
            for task in tasks:
                pool.submit(_call, task).add_done_callback(finished.put)
            if meanwhile is not None:
                meanwhile()
            while remaining:
                future = finished.get(timeout=stall_timeout_s)
                remaining -= 1
                yield future.result()
        except Empty:
            raise TimeoutError(
                f"no worker finished a task within {stall_timeout_s:g} s: run with one worker to "
                "see where it stops."
            ) from None
        except BrokenProcessPool as error:
            raise RuntimeError(
                "a worker process died, most likely for lack of memory: run with fewer workers."
            ) from error
        finally:
            if remaining:  # left early: do not wait for work that nobody will read
                for worker in set(multiprocessing.active_children()) - before:
                    worker.terminate()
            pool.shutdown(wait=True, cancel_futures=True)
