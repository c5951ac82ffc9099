"""A word about numba's compilation, which takes a while but happens once a machine."""

import logging
import os
from tempfile import TemporaryDirectory

import numba
from numba.core import caching, event

from gsmap.utils.interrupt import is_first_rank

_KEPT = " They are kept for the next runs, in __pycache__ or NUMBA_CACHE_DIR."


class CompilationNotice(event.Listener):
    """Says once that kernels are compiled; those that numba finds in its cache say nothing."""

    told = False

    def on_start(self, event: event.Event) -> None:
        """Say it."""
        if not self.told and is_first_rank():
            logging.getLogger("gsmap").warning(
                "Kernels for the CPU are compiled, which takes up to a minute."
                + ("" if _FOLDER else _KEPT)
            )
        self.told = True

    def on_end(self, event: event.Event) -> None:
        """Say nothing."""


def place_for_kernels() -> TemporaryDirectory | None:
    """Make a folder for numba's kernels where numba finds none, as in an image that is read-only.

    This process and those that it starts use it, and it goes with this one.

    Returns:
        The folder; None where numba has a place.
    """
    try:
        caching.CompileResultCacheImpl(place_for_kernels)
    except RuntimeError:
        folder = TemporaryDirectory(prefix="gsmap-kernels-")
        os.environ["NUMBA_CACHE_DIR"] = folder.name
        numba.config.reload_config()
        if is_first_rank():
            logging.getLogger("gsmap").warning(
                "Neither the installation nor the home folder can be written to, so that kernels "
                "for the CPU are compiled for this run alone: set NUMBA_CACHE_DIR to a folder that "
                "stays."
            )
        return folder
    return None


NOTICE = CompilationNotice()
event.register("numba:compile", NOTICE)
_FOLDER = place_for_kernels()
