"""Handling of Ctrl-C during the imports of a command, when there is nothing to clean up.

The package `gsmap` calls these functions before its slow imports, so this module imports no
library.
"""

import os
import signal
import sys

_MODULES = ("gsmap", "minicity")  # packages with a __main__ module
INTERRUPTED_TEXT = "interrupted: nothing half-written is left\n"


def is_first_rank() -> bool:
    """Whether this process prints the messages of a run, which may have several ranks (processes).

    The function reads environment variables, so it can be called before the ranks connect. torchrun
    sets ``RANK``, and Slurm sets ``SLURM_PROCID``. A process without both is the only one.
    """
    return os.environ.get("RANK", os.environ.get("SLURM_PROCID", "0")) == "0"


def _runs_a_module() -> bool:
    """Whether Python was started as ``python -m gsmap`` or ``python -m minicity``."""
    # `sys.orig_argv` has the options of Python, too. The name of the module follows "-m".
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
    # The package multiprocessing starts its workers with this option.
    return is_command and "--multiprocessing-fork" not in sys.orig_argv


def leave_at_once_on_ctrl_c() -> None:
    """End this process on Ctrl-C from now on, with one line and exit code 130.

    If the signal already has another handler, or is ignored, nothing changes.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def _leave(number: int, _frame: object) -> None:
    """End the process at once. An exception would be caught by some imports."""
    if is_first_rank():
        os.write(2, INTERRUPTED_TEXT.encode())  # 2 is standard error, here without its buffer
    os._exit(128 + number)
