"""torchrun whose end is one line: ``python -m gsmap.engine.torchrun``.

Ctrl-C is left to the ranks to report. A rank that dies, however that happens, ends the others.
"""

import logging
import os
import signal
import sys

from gsmap.utils.interrupt import leave_at_once_on_ctrl_c

if __name__ == "__main__":
    leave_at_once_on_ctrl_c()  # until torchrun's own answer, the import of torch takes seconds
# isort: split
from torch.distributed.elastic.multiprocessing import SignalException
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError, ProcessFailure
from torch.distributed.run import main

from gsmap.utils.cli import ENDING
from gsmap.utils.parallel import LAUNCHER

INTERRUPTED = 128 + signal.SIGINT
STOP_TIMEOUT_S = 30  # torchrun ends ranks with SIGTERM, and after this time with SIGKILL


def _cause(error: ChildFailedError) -> tuple[int, ProcessFailure]:
    """Return the rank whose end caused the others' ends, and its failure.

    torch counts the ranks that it stops itself among the failures, and times all failures in whole
    seconds. Of ranks that ended by themselves, one that was killed comes before one that was
    interrupted, and that before one that met an error: a rank that loses its peers ends with an
    error.
    """
    first_s = min(failure.timestamp for failure in error.failures.values())

    def order(rank: int) -> tuple[bool, bool, bool, float, int]:
        failure = error.failures[rank]
        code = failure.exitcode
        late = failure.timestamp - first_s >= STOP_TIMEOUT_S - 1
        stopped = code == -signal.SIGTERM or (code == -signal.SIGKILL and late)
        return stopped, code >= 0, code != INTERRUPTED, failure.timestamp, rank

    first = min(error.failures, key=order)
    return first, error.failures[first]


def signal_behind(error: BaseException | None) -> SignalException | None:
    """Return the signal that led to an exception, if any.

    torchrun answers a signal by an exception wherever it stands, and code that it interrupts may
    raise another one on top of it.
    """
    while error is not None and not isinstance(error, SignalException):
        error = error.__cause__ or error.__context__
    return error


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
    try:
        main()
    except Exception as error:
        stopped_by = signal_behind(error)
        if stopped_by is not None:  # the ranks have had this signal too, and rank 0 has spoken
            sys.exit(128 + signal.Signals(stopped_by.sigval))
        if not isinstance(error, ChildFailedError):
            raise
        text, code = reason(error)
        sys.stderr.write(f"error: {text}\n")
        sys.exit(code)
