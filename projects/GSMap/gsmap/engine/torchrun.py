"""torchrun whose end is one line: ``python -m gsmap.engine.torchrun``.

Ctrl-C is left to the ranks to report. A rank that dies, however that happens, ends the others.
"""

import logging
import os
import signal
import sys

from torch.distributed.elastic.multiprocessing.api import SignalException
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
from torch.distributed.run import main

from gsmap.utils.cli import ENDING
from gsmap.utils.parallel import LAUNCHER


def reason(error: ChildFailedError) -> tuple[str, int]:
    """Return what to say of ranks that failed, and the exit code: those of the first."""
    rank, failure = error.get_first_failure()
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
    except SignalException as error:  # the ranks have had the same signal, and rank 0 has spoken
        sys.exit(128 + signal.Signals(error.sigval))
    except ChildFailedError as error:
        text, code = reason(error)
        sys.stderr.write(f"error: {text}\n")
        sys.exit(code)
