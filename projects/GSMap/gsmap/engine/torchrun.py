"""torchrun that reports failures in a one-line error: ``python -m gsmap.engine.torchrun``.

A rank is one of the processes that torchrun starts. Rank 0 reports Ctrl-C itself. If a rank dies
for any reason, torchrun stops the others.
"""

import logging
import os
import signal
import sys

from gsmap.utils.interrupt import leave_at_once_on_ctrl_c

if __name__ == "__main__":
    # The import of torch takes seconds, during which Ctrl-C must end the process at once. torchrun
    # later replaces this handler.
    leave_at_once_on_ctrl_c()
# isort: split
from torch.distributed.elastic.multiprocessing import SignalException
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError, ProcessFailure
from torch.distributed.run import main

from gsmap.utils.cli import END_SIGNALS
from gsmap.utils.parallel import LAUNCHER

INTERRUPTED = 128 + signal.SIGINT  # exit code of a process that Ctrl-C has ended
OWN_WORDS = "(its own words stand above)"  # marks the error of a rank that has printed its own
STOP_TIMEOUT_S = 30  # torchrun ends ranks with SIGTERM, and after this time with SIGKILL


def _cause(error: ChildFailedError) -> tuple[int, ProcessFailure]:
    """Return the rank whose failure caused the failures of the others, and this failure.

    The list of failures also contains the ranks that torchrun stopped, and its times are in whole
    seconds. Failures are therefore ordered by kind first, and by time within a kind. Killed ranks
    are first, then interrupted ranks, then ranks that ended with an error, because a rank that
    loses its peers ends with an error.
    """
    # By rank: its exit code, which is the negative number of a signal that killed it, and its time.
    first_s = min(failure.timestamp for failure in error.failures.values())

    def order(rank: int) -> tuple[bool, bool, bool, float, int]:
        """Sort key of a rank. The cause is the rank with the smallest key."""
        failure = error.failures[rank]
        code = failure.exitcode
        # Whole seconds need a tolerance of one second.
        is_late = failure.timestamp - first_s >= STOP_TIMEOUT_S - 1
        was_killed_late = code == -signal.SIGKILL and is_late
        stopped_by_torchrun = code == -signal.SIGTERM or was_killed_late
        was_killed = code < 0  # by a signal
        was_interrupted = code == INTERRUPTED
        # False sorts before True. Ranks that torchrun stopped are therefore last. Before them are
        # killed ranks, then interrupted ranks, then all others.
        return stopped_by_torchrun, not was_killed, not was_interrupted, failure.timestamp, rank

    first_rank = min(error.failures, key=order)
    return first_rank, error.failures[first_rank]


def signal_behind(error: BaseException | None) -> SignalException | None:
    """Return the signal that led to an exception, or None.

    torchrun raises an exception for a signal at an arbitrary point of the code. The interrupted
    code may raise another exception while it handles this one.
    """
    while error is not None and not isinstance(error, SignalException):
        error = error.__cause__ or error.__context__
    return error


def reason(error: ChildFailedError) -> tuple[str, int]:
    """Describe why ranks failed.

    Returns:
        The message, which names the rank that caused the failure, and the exit code for it.
    """
    rank, failure = _cause(error)
    if failure.exitcode < 0:
        kill = signal.Signals(-failure.exitcode)
        hint = ", most likely for want of memory" if kill == signal.SIGKILL else ""
        end = f"was killed ({kill.name}{hint})"
        code = 128 + kill
    else:
        end = f"ended with {failure.exitcode} {OWN_WORDS}"
        code = failure.exitcode
    is_training = any(word.endswith("train.py") for word in sys.argv)
    remedy = "; --resume goes on from its last checkpoint" if is_training else ""
    return f"rank {rank} {end}, so the run was stopped{remedy}.", code


if __name__ == "__main__":
    # These loggers would print long reports of a failure around the one-line error. They are set
    # one by one, because torch sets a level for each logger.
    for module in ("agent.server.api", "multiprocessing.api"):
        logging.getLogger(f"torch.distributed.elastic.{module}").setLevel(logging.CRITICAL)
    os.environ[LAUNCHER] = str(os.getpid())  # the ranks end when the process with this ID ends
    # The caller may have blocked the signals that end a run (SIGINT, SIGTERM and SIGHUP). The ranks
    # inherit the set of blocked signals.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, END_SIGNALS)
    try:
        main()  # starts the ranks and returns when all of them have ended
    except Exception as error:
        stopped_by = signal_behind(error)
        if stopped_by is not None:  # the ranks receive this signal too, and rank 0 reports it
            sys.exit(128 + signal.Signals(stopped_by.sigval))
        if not isinstance(error, ChildFailedError):  # not a failure of a rank
            raise
        text, code = reason(error)
        sys.stderr.write(f"error: {text}\n")
        sys.exit(code)
