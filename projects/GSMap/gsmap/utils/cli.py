"""What every command shares: its name in help, where it may write, and how it ends."""

import _thread
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
from functools import partial
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from types import FrameType
from typing import Any

from gsmap.utils.faults import in_words
from gsmap.utils.handover import tell_lost_batches
from gsmap.utils.inputs import declare_files, inputs_kept
from gsmap.utils.interrupt import SAID, is_first_rank
from gsmap.utils.parallel import have_forks_die_too
from gsmap.utils.terminal import print_safely

BAD_INPUT = 2  # exit code, as argparse's for bad arguments
ENDING = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
_LONGEST_PATH = 4096  # as Linux has it
CLEAN_UP_S = 5.0  # how long further Ctrl-C are not answered
AGAIN_S = 0.05  # after which a signal that was dropped is sent again


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
        """Parse arguments, and refuse NaN and an output that is an input."""
        found, rest = super().parse_known_args(*args, **kwargs)
        inputs: list[Path] = []
        outputs: list[tuple[Path, str]] = []
        for action in self._actions:
            option = action.option_strings[0] if action.option_strings else action.metavar
            if _holds_nan(getattr(found, action.dest, None)):
                self.error(f"{option or action.dest} must be a number, got nan")
            for path in _files_in(getattr(found, action.dest, None)):
                if action.type is output_file:
                    outputs.append((path, str(option or action.dest)))
                elif path.is_file():
                    inputs.append(path)
        declare_files(inputs, outputs)
        return found, rest


def _holds_nan(value: Any) -> bool:
    """Whether an argument is NaN or a list with NaN, with which every comparison is false."""
    if isinstance(value, list | tuple):
        return any(map(_holds_nan, value))
    return isinstance(value, float) and math.isnan(value)


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
    end = _End()
    try:
        try:
            _listen(end, heed_kill)
            text = command()
            if text is not None:
                sys.stdout.write(f"{text}\n")
            sys.stdout.flush()
        except Exception as error:
            heard = _heard_in(error)
            if heard is not None and not isinstance(error, OSError):  # which a clean-up met
                end.over = True
                raise heard from None
            if not _say(error):
                raise
            sys.exit(BAD_INPUT)
        if end.heard is not None:  # a library has dropped it, and ended in peace
            raise KeyboardInterrupt if end.heard == signal.SIGINT else SystemExit(128 + end.heard)
    except KeyboardInterrupt:  # also of a rank whose peers' end was an error before
        end.over = True
        if is_first_rank():
            sys.stderr.write(SAID)
        if "RANK" in os.environ and not heed_kill:
            sys.stderr.flush()
            os._exit(128 + signal.SIGINT)  # the interpreter's own end would wait for other ranks
        sys.exit(128 + signal.SIGINT)
    finally:
        end.over = True


def _listen(end: "_End", heed_kill: bool) -> None:
    """Answer signals, and let them through."""
    logging.raiseExceptions = False  # a log file on a full disk is no reason for tracebacks
    threading.excepthook = _end_of_thread
    if getattr(sys.unraisablehook, "func", None) is not _drop_in_silence:
        sys.unraisablehook = partial(_drop_in_silence, sys.unraisablehook)
    have_forks_die_too()
    tell_lost_batches()
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background
        signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end if heed_kill else signal.SIG_DFL)
    if heed_kill and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as nohup wants it
        signal.signal(signal.SIGHUP, end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


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


class _Heard(BaseException):
    """What `_End` raises; it tells when it has been dropped on its way."""

    dropped: Callable[[], None]

    def __del__(self) -> None:
        self.dropped()


class _Interrupted(_Heard, KeyboardInterrupt):
    """Ctrl-C."""


class _Killed(_Heard, SystemExit):
    """``kill``, or the end of the terminal; its code is the command's."""


class _End:
    """Answers Ctrl-C and ``kill`` once, so that impatience does not cut a clean-up off.

    It raises, so that clean-ups run. Python drops what is raised in a finalizer or at the end of a
    fork, and C code and libraries drop what they like, above all while they are imported: a signal
    whose exception is gone before `run_command` has seen it is sent again. Forked workers inherit
    this, and leave Ctrl-C to the command's own process.
    """

    def __init__(self) -> None:
        self._main = os.getpid()
        self._answered_s = -math.inf
        self.heard: int | None = None  # a signal that has been raised
        self.over = False  # whether the command has ended

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._main:
            if number == signal.SIGINT:
                return
            sys.exit(128 + number)
        now_s = time.monotonic()
        if now_s - self._answered_s < CLEAN_UP_S:
            return
        if _starts_an_extension(frame):
            self._send_again(number)
            return
        self._answered_s = now_s
        self.heard = number
        raise self._exception(number)  # by no name: its traceback would keep it alive

    def _exception(self, number: int) -> _Heard:
        """Return what to raise for a signal."""
        error = _Interrupted() if number == signal.SIGINT else _Killed(128 + number)
        error.dropped = partial(self._dropped, number)
        return error

    def _dropped(self, number: int) -> None:
        if not self.over and os.getpid() == self._main:
            self._answered_s = -math.inf
            self._send_again(number)

    def _send_again(self, number: int) -> None:
        """Send a signal a little later; without `threading`, whose locks may be taken here."""
        _thread.start_new_thread(_send_later, (number,))


def _send_later(number: int) -> None:
    time.sleep(AGAIN_S)
    signal.pthread_kill(threading.main_thread().ident or 0, number)


def _starts_an_extension(frame: FrameType | None) -> bool:
    """Whether a module in C is being made, which may end the process if that fails."""
    while frame is not None:
        if frame.f_code.co_name in ("create_module", "exec_module") and isinstance(
            frame.f_locals.get("self"), ExtensionFileLoader
        ):
            return True
        frame = frame.f_back
    return False


def _heard_in(error: BaseException | None) -> _Heard | None:
    """Return the signal that an exception is, or that it follows from."""
    while error is not None and not isinstance(error, _Heard):
        error = error.__cause__ or error.__context__
    return error


def _drop_in_silence(otherwise: Callable[[Any], object], args: Any) -> None:
    """Say nothing of a signal that Python drops, as it is sent again; a ``sys.unraisablehook``."""
    if not isinstance(args.exc_value, _Heard):
        otherwise(args)


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
