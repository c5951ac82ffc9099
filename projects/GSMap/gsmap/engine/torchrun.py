"""torchrun whose end is one line: ``python -m gsmap.engine.torchrun``.

Ctrl-C is left to the ranks to report. A rank that dies, however that happens, ends the others.
"""

import logging
import os
import signal
import sys
from typing import Any

from gsmap.utils.interrupt import leave_at_once_on_ctrl_c

if __name__ == "__main__":
    leave_at_once_on_ctrl_c()  # until torchrun's own answer, the import of torch takes seconds
# isort: split
from torch.distributed.elastic.multiprocessing.api import SignalException, SubprocessContext
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError, ProcessFailure
from torch.distributed.run import main

from gsmap.utils.cli import ENDING
from gsmap.utils.parallel import LAUNCHER

INTERRUPTED = 128 + signal.SIGINT
_stopped: set[int] = set()  # processes of ranks that torchrun itself ended


_close = SubprocessContext.close


def _note_and_close(ranks: SubprocessContext, *args: Any, **options: Any) -> None:
    """End the ranks that are left, and note which these were."""
    processes = [handler.proc for handler in ranks.subprocess_handlers.values()]
    _stopped.update(process.pid for process in processes if process.poll() is None)
    _close(ranks, *args, **options)


def _cause(error: ChildFailedError) -> tuple[int, ProcessFailure]:
    """Return the rank whose end is behind the others', and how it ended.

    torch times failures in whole seconds and counts the ranks that it ends itself among them. Of
    ranks that ended by themselves, one that was killed comes before one that was interrupted, and
    that before one that met an error: a rank that loses its peers ends with an error.
    """

    def order(rank: int) -> tuple[bool, bool, bool, float, int]:
        failure = error.failures[rank]
        code = failure.exitcode
        ended = failure.pid in _stopped
        return ended, code >= 0, code != INTERRUPTED, failure.timestamp, rank

    first = min(error.failures, key=order)
    return first, error.failures[first]


def reason(error: ChildFailedError) -> tuple[str, int]:
    """Return what to say of ranks that failed, and the exit code: those of the cause."""
    rank, failure = _cause(error)
    if failure.exitcode < 0:
        kill = signal.Signals(-failure.exitcode)
        hint = ", most likely for want of memory" if kill == signal.SIGKILL else ""
        said, code = f"was killed ({kill.name}{hint})", 128 + kill
    else:
        said, code = f"ended with {failure.exitcode} (its own words stand above)", failure.exitcode
    trains = any(word.endswith("train.py") for word in sys.argv)
    remedy = "; --resume goes on from its last checkpoint" if trains else ""
    return f"rank {rank} {said}, so the run was stopped{remedy}.", code


if __name__ == "__main__":
    for part in ("agent.server.api", "multiprocessing.api"):  # torch gives each a level of its own
        logging.getLogger(f"torch.distributed.elastic.{part}").setLevel(logging.CRITICAL)
    os.environ[LAUNCHER] = str(os.getpid())
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)  # also for the ranks
    SubprocessContext.close = _note_and_close  # type: ignore[assignment,method-assign]
    try:
        main()
    except SignalException as error:  # the ranks have had the same signal, and rank 0 has spoken
        sys.exit(128 + signal.Signals(error.sigval))
    except ChildFailedError as error:
        text, code = reason(error)
        sys.stderr.write(f"error: {text}\n")
        sys.exit(code)
