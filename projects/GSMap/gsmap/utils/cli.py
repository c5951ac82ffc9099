"""How every command ends: with a report, or with one line that says what was wrong."""

import re
import signal
import sys
import traceback
from collections.abc import Callable

BAD_INPUT = 2  # exit code, as argparse's for bad arguments


def run_command(command: Callable[[], str | None], heed_kill: bool = True) -> None:
    """Run a command, print what it reports, and leave in words whatever a user can cause.

    A file that cannot be read, understood or written, and whatever a ``raise`` statement says, end
    with ``error: ...`` and exit code 2; Ctrl-C with one line and 130; ``kill`` with 143; each after
    the clean-up of half-written files. A slip in the code keeps its traceback.

    Args:
        command: Returns what to print, or None.
        heed_kill: Whether ``kill`` lets the clean-up run; processes that wait for each other had
            better die at once.

    Raises:
        SystemExit: If the command fails or is interrupted.
    """
    if heed_kill:
        signal.signal(signal.SIGTERM, _leave)
    try:
        report = command()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: nothing half-written is left\n")
        sys.exit(128 + signal.SIGINT)
    except (OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        if not _is_for_the_user(error):
            raise
        # a KeyError's own text is its message in quotes
        text = error.args[0] if type(error) is KeyError else error
        sys.stderr.write(f"error: {' '.join(str(text).split())}\n")
        sys.exit(BAD_INPUT)
    if report is not None:
        sys.stdout.write(f"{report}\n")


def _leave(number: int, _frame: object) -> None:
    """Leave through the clean-up of half-written files, as Ctrl-C does."""
    sys.exit(128 + number)


def _is_for_the_user(error: Exception) -> bool:
    """Whether the system, a parser or a ``raise`` statement speaks, and not Python of a slip."""
    parsing = isinstance(error, ValueError) and type(error) is not ValueError
    if parsing or isinstance(error, OSError):
        return True
    in_worker = type(error.__cause__).__name__ == "_RemoteTraceback"
    frames = [str(error.__cause__)] if in_worker else traceback.format_tb(error.__traceback__)
    statements = re.findall(r'^  File ".*\n    (.*)', "".join(frames), re.MULTILINE)
    return bool(statements) and statements[-1].startswith("raise ")
