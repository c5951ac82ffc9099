"""Ctrl-C before a command has begun, while it imports what it needs: nothing to clean up."""

import os
import signal
import sys

_MODULES = ("gsmap", "minicity")  # that Python can run
SAID = "interrupted: nothing half-written is left\n"


def is_first_rank() -> bool:
    """Whether this process speaks for a run; known before the processes have met."""
    return os.environ.get("RANK", os.environ.get("SLURM_PROCID", "0")) == "0"


def _runs_a_module() -> bool:
    """Whether Python was started as ``python -m gsmap`` or ``python -m minicity``."""
    if "-m" not in sys.orig_argv[:-1]:
        return False
    return sys.orig_argv[sys.orig_argv.index("-m") + 1] in _MODULES


def starts_a_command() -> bool:
    """Whether this process is ``gsmap`` or a script of ``tools``, and no worker of one."""
    folder, name = os.path.split(os.path.realpath(sys.argv[0])) if sys.argv else ("", "")
    is_tool = os.path.isfile(os.path.join(folder, "dist_run.sh"))
    is_command = name == "gsmap" or is_tool or _runs_a_module()
    return is_command and "--multiprocessing-fork" not in sys.orig_argv


def leave_at_once_on_ctrl_c() -> None:
    """End this process with one line and 130 on Ctrl-C, unless it is ignored or handled already."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def _leave(number: int, _frame: object) -> None:
    """End without the interpreter's own end: an exception would not get through all imports."""
    if is_first_rank():
        os.write(2, SAID.encode())
    os._exit(128 + number)
