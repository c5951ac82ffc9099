"""No Ctrl-C and no ``kill`` is lost, and each is one line, from the first imports on."""

import os
import signal
import subprocess
import sys

import pytest
from processes import REPO, run_python, search_path

pytestmark = pytest.mark.faults

LINE = "interrupted: nothing half-written is left\n"
LOST = """
import ctypes, os, signal, sys, time
from importlib.machinery import ExtensionFileLoader
from gsmap.utils.cli import run_command

number = signal.{name}
signal.signal(signal.SIGINT, signal.default_int_handler)  # these tests may run in the background

class Finalized:
    def __del__(self):
        signal.raise_signal(number)

class Extension(ExtensionFileLoader):
    def exec_module(self, module):
        signal.raise_signal(number)
        os.write(1, b"whole ")

def in_a_finalizer():
    Finalized()

def in_c():
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()

def after_a_fork():
    os.register_at_fork(after_in_parent=lambda: signal.raise_signal(number))
    if os.fork() == 0:
        os._exit(0)

def by_a_library():
    try:
        signal.raise_signal(number)
    except BaseException:
        pass

def by_a_generator():
    def values():
        try:
            yield 1
        finally:
            signal.raise_signal(number)
    next(values())

def while_an_extension_starts():
    Extension("a", "a.so").exec_module(None)

def command():
    {how}()
    os.write(1, b"went on")
    while {waits}:
        time.sleep(0.01)

run_command(command)
"""
WAYS = (
    "in_a_finalizer", "in_c", "after_a_fork", "by_a_library", "by_a_generator",
    "while_an_extension_starts",
)  # fmt: skip


def end(how: str, name: str, waits: bool) -> tuple[int, str, str]:
    done = run_python("-c", LOST.format(how=how, name=name, waits=waits))
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("how", WAYS)
def test_a_signal_whose_exception_is_dropped_is_sent_again(how):
    wanted = "whole went on" if "extension" in how else "went on"
    assert end(how, "SIGINT", True) == (130, wanted, LINE)
    assert end(how, "SIGTERM", True) == (143, wanted, "")


def test_a_signal_that_was_dropped_counts_also_if_the_command_ends_in_peace():
    assert end("by_a_library", "SIGINT", False) == (130, "went on", LINE)
    assert end("by_a_library", "SIGTERM", False) == (143, "went on", "")


FOLLOWS = """
import signal
from gsmap.utils.cli import run_command

signal.signal(signal.SIGINT, signal.default_int_handler)

def command():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt as error:
        raise {raised}

run_command(command)
"""


@pytest.mark.parametrize(
    ("raised", "code", "said"),
    [
        ("ImportError('numpy.core.multiarray failed to import') from error", 130, LINE),
        ("SystemError('initialization of _C raised unreported exception')", 130, LINE),
        ("OSError(5, 'Input/output error', 'a.json')", 2, "error: [Errno 5] Input/output error"),
    ],
)
def test_an_error_that_follows_from_a_signal_is_the_signal_but_a_failed_clean_up(
    raised, code, said
):
    done = run_python("-c", FOLLOWS.format(raised=raised))
    assert done.returncode == code
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == 1


INTERRUPTING = """
import os, signal, sys

class Interrupting:
    \"\"\"Presses Ctrl-C at an import, counted from where Python's own answer is replaced.\"\"\"

    count = 0

    def find_spec(self, name, path=None, target=None):
        if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            Interrupting.count += 1
            if Interrupting.count == int(os.environ["INTERRUPTED_IMPORT"]):
                signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
"""
INTERRUPTING_BY_NAME = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == os.environ["INTERRUPTED_IMPORT"]:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
"""
COMMANDS = {
    "train": ("tools/train.py", "gsmap_maptr_r18_minicity", "--work-dir", "{out}"),
    "build_map": ("tools/build_map.py", "--help"),
    "torchrun": ("tools/dist_run.sh", "1", "tools/train.py"),
}


@pytest.mark.parametrize(
    ("module", "imported"),
    [("gsmap", "gsmap.__main__"), ("gsmap", "gsmap.utils.cli"), ("minicity", "minicity.cli")],
)
def test_ctrl_c_is_one_line_where_python_runs_a_module(module, imported, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTING_BY_NAME)
    words = ["evaluate", "--help"] if module == "gsmap" else ["--help"]
    done = subprocess.run(
        [sys.executable, "-m", module, *words],
        env={**os.environ, **search_path(tmp_path), "INTERRUPTED_IMPORT": imported},
        text=True,
        capture_output=True,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert (done.returncode, done.stderr) == (130, LINE)


@pytest.mark.parametrize(
    ("name", "numbers"),
    [("train", (1, 50, 500, 2000)), ("build_map", (1, 100)), ("torchrun", (1, 200))],
)
def test_ctrl_c_during_imports_is_one_line(name, numbers, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTING)
    tool, *words = (word.format(out=tmp_path / "out") for word in COMMANDS[name])
    command = [sys.executable] * tool.endswith(".py") + [REPO / tool, *words]
    for number in numbers:
        own = {"INTERRUPTED_IMPORT": str(number), "PYTHON": sys.executable}
        done = subprocess.run(
            command, cwd=REPO, env={**os.environ, **search_path(tmp_path), **own}, text=True,
            capture_output=True, check=False,
            # a job in the background ignores Ctrl-C, and hands that on to what it starts
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (130, LINE), f"at import {number}"
