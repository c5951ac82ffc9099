"""Handling of Ctrl-C during the imports of a command, when there is nothing to clean up."""

import os
import signal
import sys

_MODULES = ("gsmap", "minicity")  # packages with a __main__ module
INTERRUPTED_TEXT = "interrupted: nothing half-written is left\n"


def is_first_rank() -> bool:
    """Whether this process prints the messages of a run. Can be called before the ranks connect."""
    return os.environ.get("RANK", os.environ.get("SLURM_PROCID", "0")) == "0"


def _runs_a_module() -> bool:
    """Whether Python was started as ``python -m gsmap`` or ``python -m minicity``."""
    if "-m" not in sys.orig_argv[:-1]:
        return False
    position = sys.orig_argv.index("-m")
    return sys.orig_argv[position + 1] in _MODULES


def starts_a_command() -> bool:
    """Whether this process is ``gsmap`` or a script of ``tools``, but not a worker process."""
    script = os.path.realpath(sys.argv[0]) if sys.argv else ""
    folder, name = os.path.split(script)
    # The file dist_run.sh exists only in the folder ``tools``.
    is_tool = os.path.isfile(os.path.join(folder, "dist_run.sh"))
    is_command = name == "gsmap" or is_tool or _runs_a_module()
    return is_command and "--multiprocessing-fork" not in sys.orig_argv


def leave_at_once_on_ctrl_c() -> None:
    """End this process on Ctrl-C with one line and exit code 130.

    If the signal already has another handler, or is ignored, nothing changes.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def _leave(number: int, _frame: object) -> None:
    """End the process at once. An exception would be caught by some imports."""
    if is_first_rank():
        os.write(2, INTERRUPTED_TEXT.encode())
    os._exit(128 + number)
