"""Parallel map over worker processes: ordered, with bounded memory and without deadlocks."""

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
from types import FrameType
from typing import Any, TypeVar

from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.inputs import watch_files
from gsmap.utils.signals import SignalError, SignalHandler, hide_dropped_signals
from gsmap.utils.terminal import escape_output

Task = TypeVar("Task")
Result = TypeVar("Result")
# Environment variable with the process ID of torchrun, for the processes that it starts, its ranks.
LAUNCHER = "GSMAP_LAUNCHER"
# Function of Python that returns the interpreter options of new processes. It is replaced below.
_interpreter_flags = util._args_from_interpreter_flags  # type: ignore[attr-defined]


# Function of Linux that requests a signal at the death of the parent. It is loaded here and not in
# a forked process, because loading takes locks. In a forked process, a lock may stay locked by a
# thread that does not exist there.
_PRCTL: Callable[..., Any] | None = None
if sys.platform == "linux":
    _PRCTL = ctypes.CDLL(None).prctl


def _safe_interpreter_flags() -> list[str]:
    """Return interpreter options that exclude the working folder from the module search path.

    Worker processes start with ``-c``, which puts the working folder first on the search path until
    they receive the search path of their parent. A file there, such as ``random.py``, could replace
    a module of Python.
    """
    # Python 3.10 has no -P. There, -I also ignores the environment variables of Python.
    safe_flag = "-P" if sys.version_info >= (3, 11) else "-I"
    flags = _interpreter_flags()
    return flags if safe_flag in flags else [*flags, safe_flag]


util._args_from_interpreter_flags = _safe_interpreter_flags  # type: ignore[attr-defined]


def default_workers() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def die_with_parent(parent: int) -> None:
    """Let Linux kill this process when its parent dies for any reason.

    On other systems this has no effect, and only the workers of `ordered_map` end with their
    parent.

    Args:
        parent: Process ID of the parent.
    """
    if _PRCTL is None:
        return
    _PRCTL(1, signal.SIGKILL)  # 1 is PR_SET_PDEATHSIG
    if os.getppid() != parent:  # the parent has died before the call, so no signal will come
        os.kill(os.getpid(), signal.SIGKILL)


def kill_forks_with_parent() -> None:
    """Let all processes that this process or its children fork die with their parent.

    Examples are the workers of torch's DataLoader.
    """
    parent = 0  # process ID of the process that forks

    def record_parent() -> None:
        nonlocal parent
        parent = os.getpid()

    def follow_parent() -> None:
        die_with_parent(parent)

    os.register_at_fork(before=record_parent, after_in_child=follow_parent)


class _Worker:
    """State of a worker process, in class attributes, since there is one state per process.

    Attributes:
        function: Function of `ordered_map`.
        handler: Handler that interrupts a task.
        must_stop: Whether SIGTERM has been received.
        is_working: Whether a task is in progress.
    """

    function: Callable[[Any], Any]
    handler: SignalHandler
    must_stop = False
    is_working = False


def _start_worker(setup: Path) -> None:
    """Prepare a worker process, which ends with its parent; read its function from ``setup``.

    Args:
        setup: File with the pickled function.
    """
    escape_output()  # prints no control characters
    watch_files()  # raises an error if a pipe or an output of the command is read
    hide_dropped_signals()
    _Worker.handler = SignalHandler()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C for all
    signal.signal(signal.SIGTERM, _stop_worker)
    # The worker was started with both signals blocked (`delay_signals`). Its handlers are set now.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _Worker.function = pickle.loads(setup.read_bytes())


def _end_with_parent() -> None:
    """Wait for the end of the parent in a thread, and end this process then."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # ends all threads at once; `sys.exit` would end this thread only


def _stop_worker(number: int, frame: FrameType | None) -> None:
    """Interrupt the current task by an exception, so that it cleans up, and start no other task.

    This is the handler of SIGTERM.

    Args:
        number: Number of the signal.
        frame: Frame that the signal interrupts.
    """
    _Worker.must_stop = True
    if _Worker.is_working:  # between tasks, a result is being sent and must be complete
        _Worker.handler(number, frame)


def _work(task: Any) -> Any:
    """Run a task in a worker process unless the worker must stop."""
    _Worker.is_working = True
    try:
        if _Worker.must_stop:
            raise SystemExit(128 + signal.SIGTERM)
        return _Worker.function(task)
    except SignalError:
        _Worker.handler.has_ended = True
        # This exception is sent to the parent, so it does not refer to the handler.
        raise SystemExit(128 + signal.SIGTERM) from None
    finally:
        _Worker.is_working = False


def ordered_map(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    workers: int,
    timeout_s: float | None = 600.0,
) -> Iterator[Result]:
    """Apply a function to tasks in worker processes, and yield the results in order.

    At most three tasks per worker are in progress or wait for their turn, so neither tasks nor
    results accumulate. With one worker, the function runs in this process, without a time limit. If
    an error or Ctrl-C occurs or the generator is closed, the tasks in progress are interrupted and
    clean up.

    Args:
        function: Picklable function; each worker reads it once. Its exceptions are raised here.
        tasks: Picklable arguments of the function, consumed on demand.
        workers: Number of processes, >= 1.
        timeout_s: Longest time to wait for the next result, in seconds; None for no limit.

    Raises:
        ValueError: If ``workers`` is below 1.
        RuntimeError: If a worker dies or a result exceeds the time limit (`WorkError`); all workers
            are stopped.
    """
    if workers < 1:
        raise InputError(f"workers must be >= 1, got {workers}.")
    if workers == 1:
        yield from map(function, tasks)
        return
    with TemporaryDirectory() as folder:
        # The function goes through a file. Arguments of a new process go through a pipe, and this
        # process would wait forever if the new one died before it had read a long argument.
        setup = Path(folder, "setup.pickle")
        setup.write_bytes(pickle.dumps(function))
        context = multiprocessing.get_context("spawn")  # without copies of this process's memory
        pool = ProcessPoolExecutor(
            workers, mp_context=context, initializer=_start_worker, initargs=(setup,)
        )
        try:
            yield from _in_order(pool, tasks=tasks, limit=3 * workers, timeout_s=timeout_s)
        except BaseException as error:  # including GeneratorExit
            # Python 3.14 has a public `terminate_workers`; older versions only have this attribute.
            # It is None after the end of the pool.
            for process in list((pool._processes or {}).values()):
                if isinstance(error, TimeoutError):
                    process.kill()  # a task that hangs may not react to SIGTERM
                else:
                    process.terminate()  # SIGTERM: the task cleans up (`_stop_worker`)
            if isinstance(error, BrokenProcessPool):
                raise WorkError(
                    "a worker process died: most likely for want of memory (run again with fewer "
                    "--workers), or because a worker cannot import the program that called this "
                    "without running it (put the call under if __name__ == '__main__')."
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
def delay_signals() -> Iterator[None]:
    """Context that delays SIGINT and SIGTERM to its end.

    It is used around calls that start worker processes or hold locks.

    Otherwise a signal would reach a worker process that is starting, which would print a traceback.
    The signal mask applies to this thread and to new processes. Another thread may receive the
    signal, and Python would run the handler in the main thread at once, so handlers are delayed as
    well.
    """
    delayed: list[int] = []  # numbers of the signals that arrived in the context
    handlers = {}  # the replaced handlers, by the number of their signal

    def delay(number: int, _frame: object) -> None:
        delayed.append(number)

    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        # Python allows only the main thread to set handlers.
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                handler = signal.getsignal(number)
                # None is a handler that was not set from Python. Ignored signals stay ignored.
                if handler not in (None, signal.SIG_IGN):
                    handlers[number] = handler
                    signal.signal(number, delay)
        yield
    finally:  # signals that arrived in the meantime are handled here
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for delayed_number in delayed:
            signal.raise_signal(delayed_number)


def result_of(future: "Future[Result]", timeout_s: float | None = None) -> Result:
    """Wait for the result of a future in a way that a signal can interrupt.

    ``future.result`` holds a lock while it waits. If a signal handler raises at this moment, the
    lock is never released, and the thread that delivers the result waits forever.

    Args:
        future: Future of a pool of threads or processes.
        timeout_s: Time limit in seconds; None for no limit.

    Raises:
        TimeoutError: If there is no result within the time limit. An exception of the task is
            raised as well.
    """
    done: SimpleQueue[Future[Result]] = SimpleQueue()  # waits in C without a Python lock
    with delay_signals():  # `add_done_callback` holds the lock of the future, too
        future.add_done_callback(done.put)
    try:
        done.get(timeout=timeout_s)
    except Empty:
        raise TimeoutError from None
    with delay_signals():
        return future.result()


def _in_order(
    pool: ProcessPoolExecutor, tasks: Iterable[Any], limit: int, timeout_s: float | None
) -> Iterator[Any]:
    """Keep at most ``limit`` tasks in the pool, and yield the results in the order of the tasks."""
    pending: deque[Future[Any]] = deque()
    for task in tasks:
        with delay_signals():  # `submit` may start a worker process
            pending.append(pool.submit(_work, task))
        if len(pending) == limit:
            yield result_of(pending.popleft(), timeout_s=timeout_s)
    while pending:
        yield result_of(pending.popleft(), timeout_s=timeout_s)
