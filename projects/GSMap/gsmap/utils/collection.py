"""Suspension of Python's garbage collection during the import of many modules."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def pause_collection() -> Iterator[None]:
    """Context without garbage collections.

    The import of the library makes some 700,000 objects that live as long as the process. Garbage
    collections during the import would take a sixth of its processor time and free nothing.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
