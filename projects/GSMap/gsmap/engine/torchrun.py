"""torchrun, but Ctrl-C is left to the ranks to report: ``python -m gsmap.engine.torchrun``."""

import logging
import signal
import sys

from torch.distributed.elastic.multiprocessing.api import SignalException
from torch.distributed.run import main

if __name__ == "__main__":
    for part in ("agent.server.api", "multiprocessing.api"):  # torch gives each a level of its own
        logging.getLogger(f"torch.distributed.elastic.{part}").setLevel(logging.ERROR)
    try:
        main()
    except SignalException as error:  # the ranks have had the same signal, and rank 0 has spoken
        sys.exit(128 + signal.Signals(error.sigval))
