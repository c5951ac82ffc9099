"""A batch that a worker cannot hand over ends its command, which would wait for it for ever."""

from multiprocessing import queues
from typing import Any

from gsmap.utils.errors import InputError

_REMEDY = (
    "make room in /dev/shm, raise the limits of open files and of file sizes (ulimit -n, ulimit "
    "-f), or read in the command's own process: num_workers=0, persistent_workers=False, "
    "--workers 1"
)
_otherwise = queues.Queue._on_queue_feeder_error  # type: ignore[attr-defined]


def tell_lost_batches() -> None:
    """Send on, from this process and its workers, why a batch did not fit through.

    A worker packs its batches in a thread, where Python prints an error and goes on without them.
    """
    queues.Queue._on_queue_feeder_error = _send_error  # type: ignore[attr-defined]


def _send_error(queue: "queues.Queue[Any]", error: Exception, item: Any) -> None:
    """Put an error in the place of a batch, which comes with its number."""
    from torch._utils import ExceptionWrapper  # a worker of torch has it

    number, batch = item if isinstance(item, tuple) and len(item) == 2 else (None, None)
    if not isinstance(number, int) or isinstance(batch, ExceptionWrapper):
        _otherwise(error, item)
        return
    try:
        raise InputError(
            f"a worker could not hand over what it read ({error}): {_REMEDY}."
        ) from error
    except ValueError:
        queue.put((number, ExceptionWrapper(where="in a data loader's worker")))
