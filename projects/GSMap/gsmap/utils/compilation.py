"""A word about numba's compilation, which takes a while but happens once a machine."""

import logging

from numba.core import event

from gsmap.utils.interrupt import is_first_rank


class CompilationNotice(event.Listener):
    """Says once that kernels are compiled; those that numba finds in its cache say nothing."""

    told = False

    def on_start(self, event: event.Event) -> None:
        """Say it."""
        if not self.told and is_first_rank():
            logging.getLogger("gsmap").warning(
                "Kernels for the CPU are compiled, which takes up to a minute. They are kept for "
                "the next runs, in __pycache__ or NUMBA_CACHE_DIR."
            )
        self.told = True

    def on_end(self, event: event.Event) -> None:
        """Say nothing."""


NOTICE = CompilationNotice()
event.register("numba:compile", NOTICE)
