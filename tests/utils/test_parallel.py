"""The pool of worker processes: order, memory, and how it ends."""

import contextlib
import ctypes
import operator
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from processes import run_python

from gsmap.utils import parallel
from gsmap.utils.parallel import ordered_map

pytestmark = pytest.mark.faults


def wait_a_little(value: int) -> int:
    time.sleep(0.01 * (value % 3))
    return value


def die(value: int) -> int:
    os._exit(value)


def hang(_: int) -> None:
    while True:
        time.sleep(0.05)


def write_and_wait(path: Path) -> None:
    """Stand for a task that writes for long, and cleans up after itself."""
    try:
        path.write_text("half")
        while True:
            time.sleep(0.05)
    finally:
        path.unlink()


def fail_once_others_write(path: Path) -> None:
    if path.name == "1":
        while not path.with_name("0").exists():
            time.sleep(0.02)
        raise ValueError("bad")
    write_and_wait(path)


class Finalized:
    """Stands for an object of a library that Python collects when a signal arrives."""

    def __del__(self):
        signal.raise_signal(signal.SIGTERM)


def drop_in_a_finalizer() -> None:
    Finalized()


def drop_in_c() -> None:
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGTERM))()


def drop_in_a_weak_reference() -> None:
    value = {1}
    reference = weakref.ref(value, lambda _: signal.raise_signal(signal.SIGTERM))
    del value
    assert reference() is None


def drop_as_a_library() -> None:
    with contextlib.suppress(BaseException):
        signal.raise_signal(signal.SIGTERM)


def drop_and_hang(drop: Callable[[], None]) -> None:
    drop()
    hang(0)


@pytest.mark.parametrize(
    "drop", [drop_in_a_finalizer, drop_in_c, drop_in_a_weak_reference, drop_as_a_library]
)
def test_a_kill_whose_exception_is_dropped_ends_the_task_in_silence(drop, capfd):
    """The pool ends its workers by SIGTERM, which may come anywhere in a task."""
    with pytest.raises(SystemExit) as end:
        list(ordered_map(drop_and_hang, [drop], 2))
    assert end.value.code == 143
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order(workers: int):
    results = list(ordered_map(wait_a_little, range(20), workers))
    assert results == list(range(20))


def test_tasks_are_drawn_as_needed():
    drawn = []

    def tasks():
        for i in range(100):
            drawn.append(i)
            yield i

    results = ordered_map(wait_a_little, tasks(), 2)
    next(results)
    assert len(drawn) <= 7
    results.close()


def test_a_dead_worker_and_a_hung_one_end_with_words():
    with pytest.raises(RuntimeError, match=r"died.*fewer --workers"):
        list(ordered_map(die, [1], 2))
    with pytest.raises(RuntimeError, match=r"more than 2 s"):
        list(ordered_map(hang, [1], 2, timeout_s=2))
    with pytest.raises(ValueError, match="workers"):
        list(ordered_map(hang, [1], 0))


def test_what_ends_early_stops_the_tasks_under_way_through_their_clean_up(tmp_path):
    tasks = [tmp_path / str(number) for number in range(8)]
    results = ordered_map(fail_once_others_write, reversed(tasks[:2]), 2)
    with pytest.raises(ValueError, match="bad"):
        next(results)
    assert list(tmp_path.iterdir()) == []


def test_the_function_may_carry_more_than_a_pipe_takes():
    holds = partial(operator.contains, bytes(range(200)) * 10**4)
    assert list(ordered_map(holds, [1, 250], 2)) == [True, False]


def test_a_program_that_cannot_be_imported_anew_ends_in_words():
    """Read from standard input; what its workers were to be sent is longer than a pipe takes."""
    program = (
        "import functools, operator\n"
        "from gsmap.utils.parallel import ordered_map\n"
        "print(list(ordered_map(functools.partial(operator.contains, bytes(10**6)), [1, 2], 2)))"
    )
    done = run_python("-", input=program)
    assert done.returncode == 1
    assert "WorkError: a worker process died" in done.stderr


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    """They hold its output open, so it ends when the last of them has."""
    program = tmp_path / "program.py"
    program.write_text(
        "import functools, os, signal\n"
        "from gsmap.utils.parallel import ordered_map\n"
        "if __name__ == '__main__':\n"
        "    say = functools.partial(os.write, 1)  # a line in one piece, print may do it in two\n"
        "    results = ordered_map(say, [b'ready\\n', b'ready\\n'], 2)\n"
        "    next(results)\n"
        "    signal.pause()\n"
    )
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE) as parent:
        assert parent.stdout.readline() == b"ready\n"
        parent.send_signal(signal.SIGKILL)
        assert parent.stdout.read() in (b"", b"ready\n")


ORPHAN = """
import os, signal, sys, time
from gsmap.utils.cli import run_command

def until_the_parent_is_dead():
    while os.getppid() == parent:
        time.sleep(0.01)

def command():
    if os.fork() == 0:
        print("alive", flush=True)
        while True:
            time.sleep(1)
    os._exit(0)

parent = os.getpid()
os.register_at_fork(after_in_child=until_the_parent_is_dead)
run_command(command)
"""


def test_a_fork_dies_also_if_its_parent_died_before_it_could_ask_for_that():
    """It holds the output open, so this ends when it has."""
    assert run_python("-c", ORPHAN).stdout == ""


def test_a_signal_that_another_thread_is_given_waits_until_processes_have_started():
    done = threading.Event()
    other = threading.Thread(target=done.wait)  # it takes what the main thread blocks
    other.start()
    steps, before = [], signal.signal(signal.SIGINT, signal.default_int_handler)  # or ignored

    def start():
        with parallel.delay_signals():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)
            steps.append("started")

    try:
        with pytest.raises(KeyboardInterrupt):
            start()
        assert steps == ["started"]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
        done.set()
        other.join()


LOCKED = """
import signal, sys, threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from gsmap.utils.cli import run_command
from gsmap.utils.parallel import result_of, delay_signals

enter, left = threading.Condition.__enter__, [int(sys.argv[1])]

def interrupted(condition):
    taken = enter(condition)
    if threading.current_thread() is threading.main_thread():
        left[0] -= 1
        if left[0] == 0:
            signal.raise_signal(signal.SIGTERM)
    return taken

def command():
    go = threading.Event()
    threading.Timer(0.1, go.set).start()
    with ThreadPoolExecutor(1) as pool:
        with delay_signals():
            future = pool.submit(go.wait)
        threading.Condition.__enter__ = interrupted
        WAIT
        left[0] = 0
    return "no lock was taken"

run_command(command)
"""


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_signal_that_comes_when_a_lock_is_taken_ends_the_command(number):
    """With the lock left taken, the pool's thread and this process would wait for each other."""
    done = run_python("-c", LOCKED.replace("WAIT", "result_of(future)"), number)
    if number < 3:
        assert (done.returncode, done.stderr) == (143, "")
    else:  # the lock is taken twice: to ask to be told, and to read the result
        assert (done.returncode, done.stdout) == (0, "no lock was taken\n")
