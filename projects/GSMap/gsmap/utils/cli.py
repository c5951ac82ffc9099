"""Argument parser and entry point of all commands: input checks, error messages and signals."""

import argparse
import atexit
import errno
import logging
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from gsmap.utils.faults import suggestion, user_message
from gsmap.utils.handover import report_lost_batches
from gsmap.utils.inputs import declare_files, protect_inputs
from gsmap.utils.interrupt import INTERRUPTED_TEXT, is_first_rank
from gsmap.utils.overrides import declare_overrides, describe_override
from gsmap.utils.parallel import kill_forks_with_parent
from gsmap.utils.signals import SignalHandler, hide_dropped_signals, signal_behind
from gsmap.utils.terminal import escape_output

BAD_INPUT = 2  # exit code, as for bad arguments in argparse
END_SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


class EachOnce(argparse.Action):
    """Action that stores a list of words, each repeated word once, in the order of the words."""

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option: object = None
    ) -> None:
        """Store the words in the namespace."""
        setattr(namespace, self.dest, list(dict.fromkeys(values)))


class CommandParser(argparse.ArgumentParser):
    """Argument parser that shows the command as ``gsmap NAME`` or by the name of its script.

    Arguments of type `output_file` are outputs of the command, and all other arguments that name a
    file are inputs. A file must not be both (`inputs.declare_files`).

    Attributes:
        program: Name of the command; None for a script.

    Args:
        prog: Name of the program, by default ``program``.
        description: Text of the help.
        **options: Further arguments of ``argparse.ArgumentParser``.
    """

    program: str | None = None

    def __init__(self, prog: str | None = None, description: str | None = None, **options: Any):
        if self.program and description:
            description = re.sub(r"(python )?tools/(\w+)\.py", repl=r"gsmap \2", string=description)
        super().__init__(prog or self.program, description=description, **options)

    def parse_known_args(  # type: ignore[override]
        self, *args: Any, **kwargs: Any
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments; NaN, and files that are both input and output, are errors."""
        namespace, unparsed = super().parse_known_args(*args, **kwargs)
        inputs: list[Path] = []
        outputs: list[tuple[Path, str]] = []  # each with the option that names it
        for action in self._actions:
            option = action.option_strings[0] if action.option_strings else action.metavar
            value = getattr(namespace, action.dest, None)
            if _has_nan(value):
                self.error(f"{option or action.dest} must be a number, got nan")
            for path in _paths_in(value):
                if action.type is output_file:
                    outputs.append((path, str(option or action.dest)))
                # Unlike `Path.is_file`, this accepts every text, also one too long for a name.
                elif os.path.isfile(path):
                    inputs.append(path)
        declare_files(inputs=inputs, outputs=outputs)
        # `run_command` blames an override for an error that the override causes.
        overrides = getattr(namespace, "cfg_options", None)
        declare_overrides(overrides if isinstance(overrides, dict) else {})
        return namespace, unparsed

    def error(self, message: str) -> NoReturn:
        """Print the usage and a message, with the most similar option or choice, and exit."""
        match = re.fullmatch(r"unrecognized arguments: .*?(--[\w-]+).*", string=message, flags=re.S)
        if match:
            # "; did you mean ...?", or an empty text without a similar option
            message += suggestion(match[1], self._option_names())
        super().error(message)

    def _option_names(self) -> list[str]:
        """Names of the options of the command and its subcommands."""
        names = list(self._option_string_actions)
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                for subparser in action.choices.values():
                    names += subparser._option_string_actions
        return names

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Raise an error with the most similar choice if a value is not one of the choices."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            choices = [str(choice) for choice in action.choices or ()]
            error.message += suggestion(str(value), choices)
            raise


def _has_nan(value: Any) -> bool:
    """Whether an argument is NaN or a list with NaN; range checks do not detect NaN."""
    if isinstance(value, list | tuple):
        return any(map(_has_nan, value))
    return isinstance(value, float) and math.isnan(value)


def _paths_in(value: Any) -> Iterator[Path]:
    """Yield the paths in the value of an argument; every text may be a path."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, str):
        yield Path(value)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _paths_in(item)
    elif isinstance(value, dict):
        yield from _paths_in(list(value.values()))


def run_command(command: Callable[[], str | None], clean_up_on_kill: bool = True) -> None:
    """Run a command, print its result, and report user errors in one line.

    Control characters are escaped in all output (`terminal.printable`), and no output replaces an
    input (`inputs.declare_files`).

    The command ends as follows:

    * After an error that a user can cause (`faults.user_message`), or that a value of
      ``--cfg-options`` causes (`overrides.describe_override`): ``error: ...`` and exit code 2.
    * After Ctrl-C: one line and exit code 130.
    * After ``kill``: exit code 143. After the end of its terminal: exit code 129.
    * After any other error: a traceback.

    Half-written files are removed in all cases. Signals that end a command (``END_SIGNALS``) are
    unblocked for the command and its workers, if the caller has blocked them. Forked workers die
    with the command. With the environment variable ``GSMAP_TRACEBACK`` every error has a traceback.

    Args:
        command: Function that returns the text to print, or None.
        clean_up_on_kill: Whether the clean-up runs after ``kill``. It should not run in the ranks
            (processes) of a training: they wait for each other, and should die at once. If False,
            a rank ends by `end_process`.
    """
    try:
        _run(command, clean_up_on_kill=clean_up_on_kill)
    except BaseException as error:
        if clean_up_on_kill or not _is_rank():
            raise
        end_process(_exit_code(error))
    if not clean_up_on_kill and _is_rank():
        end_process(0)


def _is_rank() -> bool:
    """Whether this process is a rank, one of the processes of a training or test."""
    return "RANK" in os.environ


def end_process(code: int) -> NoReturn:
    """Run the exit functions of the process and end it, without the shutdown of the interpreter.

    The threads of gloo, torch's library for communication between processes, take the lock of the
    interpreter (GIL) in C++ destructors. During the shutdown, Python stops every thread that waits
    for this lock. Stopping a thread inside a destructor aborts the process. If the main thread is
    deleting a process group, it may also wait forever for the stopped thread.

    Args:
        code: Exit code.
    """
    try:
        # Two steps of a normal end of Python: wait for threads that are no daemons, and call the
        # functions that are registered with `atexit`.
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _exit_code(error: BaseException) -> int:
    """Return Python's exit code for an exception, and print its message or traceback."""
    if not isinstance(error, SystemExit):
        sys.excepthook(type(error), error, error.__traceback__)
        return 1
    if error.code is None:
        return 0
    if isinstance(error.code, int):
        return error.code
    sys.stderr.write(f"{error.code}\n")
    return 1


@protect_inputs()
def _run(command: Callable[[], str | None], clean_up_on_kill: bool) -> None:
    """Run a command, and raise ``SystemExit`` if it fails; see `run_command`."""
    escape_output()
    os.environ.setdefault("NO_COLOR", "1")  # colours are control characters
    handler = SignalHandler()
    try:
        try:
            _install(handler, clean_up_on_kill=clean_up_on_kill)
            text = command()
            if text is not None:
                sys.stdout.write(f"{text}\n")
            sys.stdout.flush()
        except Exception as error:
            # A library may replace the exception of a signal by another exception.
            cause = signal_behind(error)
            # After a signal, an OSError comes from a clean-up that failed, and is reported below.
            if cause is not None and not isinstance(error, OSError):
                handler.has_ended = True
                raise cause from None
            if not _report(error):
                raise
            sys.exit(BAD_INPUT)
        if handler.received is not None:  # a library has dropped the exception and returned
            if handler.received == signal.SIGINT:
                raise KeyboardInterrupt
            raise SystemExit(128 + handler.received)
    except KeyboardInterrupt:  # also a signal that was found behind another error above
        handler.has_ended = True
        if is_first_rank():
            sys.stderr.write(INTERRUPTED_TEXT)
        if _is_rank() and not clean_up_on_kill:
            sys.stderr.flush()
            os._exit(128 + signal.SIGINT)  # the end of the interpreter would wait for other ranks
        sys.exit(128 + signal.SIGINT)
    finally:
        handler.has_ended = True
        declare_overrides({})


def _install(handler: SignalHandler, clean_up_on_kill: bool) -> None:
    """Install the handlers of signals and of errors in threads, and unblock the signals."""
    logging.raiseExceptions = False  # no traceback for a log file on a full disk
    threading.excepthook = _report_thread_error
    hide_dropped_signals()
    kill_forks_with_parent()
    report_lost_batches()  # workers send the error of a batch that they cannot serialise
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # ignored in the background of a shell
        signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler if clean_up_on_kill else signal.SIG_DFL)
    runs_under_nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    if clean_up_on_kill and not runs_under_nohup:
        signal.signal(signal.SIGHUP, handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, END_SIGNALS)


def _report(error: BaseException | None) -> bool:
    """Print one line for an error that a user can cause; return whether it is one."""
    if error is None or os.environ.get("GSMAP_TRACEBACK"):
        return False
    message = user_message(error) or describe_override(error)
    if not message:
        return False
    sys.stderr.write(f"error: {' '.join(message.split())}\n")
    return True


def _report_thread_error(args: Any) -> None:
    """Report an error in a thread of a library, such as a full disk while it writes a log."""
    if not _report(args.exc_value):
        threading.__excepthook__(args)


def output_file(text: str) -> Path:
    """Parse the path of an output file, and check that it can be written.

    Raises:
        OSError: If the path is a folder, or the file can be neither created nor replaced.
    """
    path = Path(text)
    # Nearest parent that exists; the others are created with the file.
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if path.is_dir():
        raise _os_error(number=errno.EISDIR, path=path)
    if not folder.is_dir():
        raise _os_error(number=errno.ENOTDIR, path=folder)
    target = path if path.exists() else folder
    if not os.access(target, mode=os.W_OK):
        raise _os_error(number=errno.EACCES, path=folder)
    return path


def _os_error(number: int, path: Path) -> OSError:
    """Return the error of the system with this number, such as ``errno.EISDIR``, for a path."""
    return OSError(number, os.strerror(number), str(path))
