"""Errors for batches that a worker process of torch's data loader cannot send to its parent.

Without an error, the command would wait for the batch forever.
"""

from multiprocessing import queues
from typing import Any

from gsmap.utils.errors import InputError

_REMEDY = (
    "make room in /dev/shm, raise the limits of open files and of file sizes (ulimit -n, ulimit "
    "-f), or read in the command's own process: num_workers=0, persistent_workers=False, "
    "--workers 1"
)
# Method that Python calls in the sending thread when an item cannot be sent.
_default_handler = queues.Queue._on_queue_feeder_error  # type: ignore[attr-defined]


def report_lost_batches() -> None:
    """Report batches that cannot be sent, in this process and in its forked workers.

    A worker serialises its batches in a thread. If that fails, Python prints an error and drops
    the batch. The replacement of Python's function sends the error in place of the batch.
    """
    queues.Queue._on_queue_feeder_error = _send_error  # type: ignore[attr-defined]


def _send_error(queue: "queues.Queue[Any]", error: Exception, item: Any) -> None:
    """Send an error with the index of a batch in place of the batch."""
    # Imported here, so that importing this module does not load torch. Workers have loaded torch.
    from torch._utils import ExceptionWrapper

    # A worker sends tuples (index of the batch, batch or error).
    index: Any = None
    batch: Any = None
    if isinstance(item, tuple) and len(item) == 2:
        index, batch = item
    is_batch = isinstance(index, int) and not isinstance(batch, ExceptionWrapper)
    if not is_batch:  # an item of another queue, or an error that cannot be sent
        _default_handler(error, item)
        return
    try:
        raise InputError(
            f"a worker could not hand over what it read ({error}): {_REMEDY}."
        ) from error
    except InputError:  # ExceptionWrapper stores the exception that is being handled
        queue.put((index, ExceptionWrapper(where="in a data loader's worker")))
