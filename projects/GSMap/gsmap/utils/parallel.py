"""Work spread over processes, in order, with bounded memory, and without a way to hang."""

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, TimeoutError
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import util
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.inputs import watch_files
from gsmap.utils.terminal import print_safely

Task = TypeVar("Task")
Result = TypeVar("Result")
LAUNCHER = "GSMAP_LAUNCHER"  # variable with the number of torchrun's process, for its ranks
_interpreter_flags = util._args_from_interpreter_flags  # type: ignore[attr-defined]


def _found_prctl() -> Callable[..., Any] | None:
    """Return the function of Linux by which a process dies with its parent; None elsewhere."""
    return ctypes.CDLL(None).prctl if sys.platform == "linux" else None


_PRCTL = _found_prctl()  # before a fork, which may happen within a lock


def _safe_interpreter_flags() -> list[str]:
    """Return options for Python processes that take no code from the working folder.

    They are started with ``-c``, which puts that folder first on their search path until they have
    been sent that of their parent.
    """
    safe = "-P" if sys.version_info >= (3, 11) else "-I"
    flags = _interpreter_flags()
    return flags if safe in flags else [*flags, safe]


util._args_from_interpreter_flags = _safe_interpreter_flags  # type: ignore[attr-defined]


def default_workers() -> int:
    """Number of processes that use every core this process may run on."""
    return len(os.sched_getaffinity(0))


def die_with_parent(parent: int) -> None:
    """Have Linux kill this process when its parent, of that number, dies, however it dies.

    Other systems have no such order: there only the workers of `ordered_map` end with their parent.
    """
    if _PRCTL is None:
        return
    _PRCTL(1, signal.SIGKILL)
    if os.getppid() != parent:  # it is dead already
        os.kill(os.getpid(), signal.SIGKILL)


def have_forks_die_too() -> None:
    """Have every process that this one forks, and every one that those fork, die with it."""
    parent = [0]

    def note() -> None:
        parent[0] = os.getpid()

    os.register_at_fork(before=note, after_in_child=lambda: die_with_parent(parent[0]))


class _Worker:
    """State of a worker process."""

    function: Callable[[Any], Any]
    stopping = False
    busy = False


def _start_worker(setup: Path) -> None:
    """Prepare a worker process, which ends with its parent, however that ends."""
    print_safely()
    watch_files()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C for all
    signal.signal(signal.SIGTERM, _stop_worker)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _Worker.function = pickle.loads(setup.read_bytes())


def _end_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
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
    timeout_s: float | None = 600.0,
) -> Iterator[Result]:
    """Apply a function to tasks in worker processes and yield each one's result, in order.

    At most three tasks per worker are under way, so that neither tasks nor results pile up. With
    one worker everything runs in this process. Whatever ends it early, such as an error or Ctrl-C,
    stops the tasks under way, through their own clean-up.

    Args:
        function: A picklable function; it reaches each process once, not with every task.
        tasks: Its arguments, picklable; drawn as they are needed.
        workers: Number of processes, >= 1.
        timeout_s: Longest time that one result may take, in seconds; None for any.

    Raises:
        ValueError: If ``workers`` is below 1.
        RuntimeError: If a worker dies or a result takes too long; the others are stopped.
    """
    if workers < 1:
        raise InputError(f"workers must be >= 1, got {workers}.")
    if workers == 1:
        yield from map(function, tasks)
        return
    with TemporaryDirectory() as folder:
        # Through a file: what a new process is handed goes through a pipe, and if it is long and
        # the process dies before it reads it, this one would wait for ever.
        setup = Path(folder, "setup.pickle")
        setup.write_bytes(pickle.dumps(function))
        context = multiprocessing.get_context("spawn")  # no copies of this process's tables
        pool = ProcessPoolExecutor(workers, context, _start_worker, (setup,))
        try:
            yield from _in_order(pool, tasks, 3 * workers, timeout_s)
        except BaseException as error:  # the generator's end before its time as well
            # Python 3.14 has a public `terminate_workers`; before, only this dictionary knows them
            for process in list((pool._processes or {}).values()):
                process.kill() if isinstance(error, TimeoutError) else process.terminate()
            if isinstance(error, BrokenProcessPool):
                raise WorkError(
                    "a worker process died: most likely for want of memory (run again with fewer "
                    "--workers), or because the program that called this cannot be imported anew "
                    "(put the call under if __name__ == '__main__')."
                ) from error
            if isinstance(error, TimeoutError):
                raise WorkError(
                    f"a task took more than {timeout_s:g} s; run again with --workers 1 to see "
                    "where it stands."
                ) from error
            raise
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def signals_later() -> Iterator[None]:
    """Hold signals back, as while processes start: a half-started one answers with a traceback.

    The mask is for this thread and the new processes. Another thread may be given the signal, whose
    Python handler the main thread then runs at once: so that one waits, too.
    """
    came: list[int] = []
    handlers = {}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if (handler := signal.getsignal(number)) not in (None, signal.SIG_IGN):
                    handlers[number] = handler
                    signal.signal(number, lambda number, _frame: came.append(number))
        yield
    finally:  # what this process was sent meanwhile reaches it here
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for late in came:
            signal.raise_signal(late)


def result_of(future: "Future[Result]", timeout_s: float | None = None) -> Result:
    """Wait for a future's result, in a way that a signal can end.

    ``future.result`` takes a lock. A signal's handler that raises right then leaves it taken: the
    thread that brings the result waits for it for ever, and the end of the pool for that thread.

    Args:
        future: Of a pool of threads or processes.
        timeout_s: Longest time to wait, in seconds; None for any.

    Raises:
        TimeoutError: If there is no result by then.
    """
    done: SimpleQueue[Future[Result]] = SimpleQueue()  # it waits in C, with no lock to leave taken
    with signals_later():
        future.add_done_callback(done.put)
    try:
        done.get(timeout=timeout_s)
    except Empty:
        raise TimeoutError from None
    with signals_later():
        return future.result()


def _in_order(
    pool: ProcessPoolExecutor, tasks: Iterable[Any], limit: int, timeout_s: float | None
) -> Iterator[Any]:
    """Keep at most ``limit`` tasks in the pool and yield the oldest one's result."""
    pending: deque[Future[Any]] = deque()
    for task in tasks:
        with signals_later():
            pending.append(pool.submit(_work, task))
        if len(pending) == limit:
            yield result_of(pending.popleft(), timeout_s)
    while pending:
        yield result_of(pending.popleft(), timeout_s)
