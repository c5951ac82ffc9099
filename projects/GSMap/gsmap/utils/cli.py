"""What every command shares: its name in help, where it may write, and how it ends."""

import argparse
import errno
import logging
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gsmap.utils.faults import in_words
from gsmap.utils.inputs import declare_files, inputs_kept
from gsmap.utils.parallel import have_forks_die_too
from gsmap.utils.terminal import print_safely

BAD_INPUT = 2  # exit code, as argparse's for bad arguments
ENDING = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
_LONGEST_PATH = 4096  # as Linux has it
CLEAN_UP_S = 5.0  # how long further Ctrl-C are not answered


class CommandParser(argparse.ArgumentParser):
    """A parser that calls its command as the user does: ``gsmap NAME``, or by its script's name.

    Arguments of the type `output_file` name what the command writes, and all others that name a
    file what it reads: none may be both (`inputs.declare_files`).
    """

    program: str | None = None

    def __init__(self, prog: str | None = None, description: str | None = None, **options: Any):
        if self.program and description:
            description = re.sub(r"(python )?tools/(\w+)\.py", r"gsmap \2", description)
        super().__init__(prog or self.program, description=description, **options)

    def parse_known_args(  # type: ignore[override]
        self, *args: Any, **kwargs: Any
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments, and refuse an output that is an input."""
        found, rest = super().parse_known_args(*args, **kwargs)
        inputs: list[Path] = []
        outputs: list[tuple[Path, str]] = []
        for action in self._actions:
            option = action.option_strings[0] if action.option_strings else action.metavar
            for path in _files_in(getattr(found, action.dest, None)):
                if action.type is output_file:
                    outputs.append((path, str(option or action.dest)))
                elif path.is_file():
                    inputs.append(path)
        declare_files(inputs, outputs)
        return found, rest


def _files_in(value: Any) -> Iterator[Path]:
    """Yield the paths, and the texts that may be such, in the value of an argument."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, str) and 0 < len(value) < _LONGEST_PATH and "\0" not in value:
        yield Path(value)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _files_in(item)
    elif isinstance(value, dict):
        yield from _files_in(list(value.values()))


def is_first_rank() -> bool:
    """Whether this process speaks for a run; known before the processes have met."""
    return os.environ.get("RANK", os.environ.get("SLURM_PROCID", "0")) == "0"


@inputs_kept()
def run_command(command: Callable[[], str | None], heed_kill: bool = True) -> None:
    """Run a command, print what it returns, and leave in words whatever a user can cause.

    Nothing that it prints can make the terminal act (`terminal.printable`), and none of its outputs
    replaces one of its inputs (`inputs.declare_files`).

    A file that cannot be read, understood or written, and whatever a ``raise`` statement says, end
    with ``error: ...`` and exit code 2 (`faults.in_words`); Ctrl-C with one line and 130; ``kill``
    with 143, and the end of its terminal with 129; each after the clean-up of half-written files.
    Whoever started the command may have blocked these signals: they are let through, also to its
    workers, and forked ones die with it. A slip in the code keeps its traceback,
    and with the environment variable ``GSMAP_TRACEBACK`` every error does.

    Args:
        command: Returns what to print, or None.
        heed_kill: Whether ``kill`` lets the clean-up run; processes that wait for each other had
            better die at once.
    """
    print_safely()
    os.environ.setdefault("NO_COLOR", "1")  # colours are control characters as well
    logging.raiseExceptions = False  # a log file on a full disk is no reason for tracebacks
    threading.excepthook = _end_of_thread
    end = _End()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    have_forks_die_too()
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background
        signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end if heed_kill else signal.SIG_DFL)
    if heed_kill and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as nohup wants it
        signal.signal(signal.SIGHUP, end)
    try:
        try:
            text = command()
            if text is not None:
                sys.stdout.write(f"{text}\n")
            sys.stdout.flush()
        except Exception as error:
            if not _say(error):
                raise
            sys.exit(BAD_INPUT)
    except KeyboardInterrupt:  # also of a rank whose peers' end was an error before
        if is_first_rank():
            sys.stderr.write("interrupted: nothing half-written is left\n")
        if "RANK" in os.environ and not heed_kill:
            sys.stderr.flush()
            os._exit(128 + signal.SIGINT)  # the interpreter's own end would wait for other ranks
        sys.exit(128 + signal.SIGINT)


def _say(error: BaseException | None) -> bool:
    """Say in a line what a user can cause; whether the error is such."""
    words = error is not None and not os.environ.get("GSMAP_TRACEBACK") and in_words(error)
    if words:
        sys.stderr.write(f"error: {' '.join(words.split())}\n")
    return bool(words)


def _end_of_thread(args: Any) -> None:
    """Say why a library's thread ended, such as that of a log on a full disk."""
    if not _say(args.exc_value):
        threading.__excepthook__(args)


class _End:
    """Answers Ctrl-C and ``kill`` once, so that impatience does not cut a clean-up off.

    Forked workers inherit it, and leave Ctrl-C to the command's own process.
    """

    def __init__(self) -> None:
        self._main = os.getpid()
        self._answered_s = -math.inf

    def __call__(self, number: int, _frame: object) -> None:
        if number == signal.SIGINT and os.getpid() != self._main:
            return
        now_s = time.monotonic()
        if now_s - self._answered_s < CLEAN_UP_S:
            return
        self._answered_s = now_s
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)


def output_file(text: str) -> Path:
    """Read an argument that names what a command writes, before it begins to work.

    Raises:
        OSError: If it is a folder, or no file can be made there.
    """
    path = Path(text)
    place = next(parent for parent in path.absolute().parents if parent.exists())
    if path.is_dir():
        number, at = errno.EISDIR, path
    elif not place.is_dir():
        number, at = errno.ENOTDIR, place
    elif not os.access(path if path.exists() else place, os.W_OK):
        number, at = errno.EACCES, place
    else:
        return path
    raise OSError(number, os.strerror(number), str(at))
