"""Programs that tests run in processes of their own."""

import os
import runpy
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from io import FileIO, TextIOWrapper
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[1]
_held: list[socket.socket] = []  # keeps ports from being handed out again


def free_port() -> int:
    """Return a port of this machine that nobody has, and nobody else is given meanwhile.

    A server that sets ``SO_REUSEADDR``, as torch's store does, can listen on it.
    """
    probe = socket.socket()
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    probe.bind(("127.0.0.1", 0))
    _held.append(probe)
    return int(probe.getsockname()[1])


def search_path(*folders: object) -> dict[str, str]:
    """Variable with which new processes import from folders, and from `tests` and `tools`."""
    own_folders = [str(REPO / "tests"), str(REPO / "tools")]
    paths = [*map(str, folders), *own_folders, os.environ.get("PYTHONPATH", "")]
    return {"PYTHONPATH": os.pathsep.join(filter(None, paths))}


def run_python(*words: object, env: Any = None, **options: Any) -> subprocess.CompletedProcess:
    """Run Python in the repository, with further variables of the environment; keep its output."""
    return subprocess.run(
        [sys.executable, *map(str, words)],
        **{"cwd": REPO, "capture_output": True, "text": True, "check": False, **options},
        env={**os.environ, **(env or {})},
    )


def wait_for(file: Path, process: subprocess.Popen) -> None:
    """Wait until a process has made a file; an error, with what it said, if it ends before."""
    while not file.exists():
        assert process.poll() is None, process.stdout and process.stdout.read()[-3000:]
        time.sleep(0.02)


def run_tool(*words: object) -> subprocess.CompletedProcess:
    """Run a tool as `run_python` does, in a fork, which does not import torch and the rest anew.

    For tests of what a command does. How it starts, and how its process ends, wants a new one.
    """
    argv = [str(word) for word in words]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush()
        sys.stderr.flush()
        pid = os.fork()
        if pid == 0:
            for file, stream in ((out, 1), (err, 2)):
                os.dup2(file.fileno(), stream)
            os._exit(_exit_code_of(lambda: runpy.run_path(argv[0], run_name="__main__"), argv))
        _, status = os.waitpid(pid, 0)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode())
    return subprocess.CompletedProcess(argv, os.waitstatus_to_exitcode(status), *texts)


def _exit_code_of(work: Callable[[], object], argv: list[str]) -> int:
    """Do a forked process's work with streams of its own; return what it exits with."""
    sys.argv = argv
    sys.stdout, sys.stderr = (TextIOWrapper(FileIO(n, "w", closefd=False)) for n in (1, 2))
    os.chdir(REPO)
    code: Any = 1
    try:
        work()
        code = 0
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return code if isinstance(code, int) else 1
