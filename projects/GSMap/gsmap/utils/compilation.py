"""Notice about the compilation of numba kernels, and a cache folder for them."""

import logging
import os
from tempfile import TemporaryDirectory

import numba
from numba.core import caching, event

from gsmap.utils.interrupt import is_first_rank

_CACHE_NOTE = " They are kept for the next runs, in __pycache__ or NUMBA_CACHE_DIR."


class CompilationNotice(event.Listener):
    """Listener that logs once per process that kernels are compiled, unless they are cached."""

    has_logged = False

    def on_start(self, event: event.Event) -> None:
        """Log the notice before the first compilation.

        Args:
            event: Start of a compilation, not used.
        """
        if not self.has_logged and is_first_rank():
            logging.getLogger("gsmap").warning(
                "Kernels for the CPU are compiled, which takes up to a minute."
                # A temporary folder keeps no kernels for later runs.
                + ("" if _FOLDER else _CACHE_NOTE)
            )
        self.has_logged = True

    def on_end(self, event: event.Event) -> None:
        """Do nothing after a compilation."""


def make_kernel_folder() -> TemporaryDirectory | None:
    """Make a cache folder for numba's kernels if numba has none, as in a read-only container.

    This process and its child processes use the folder. It is removed at the end of this process.

    Returns:
        The folder, or None if numba has a cache folder. The folder is removed when the returned
        object is garbage collected, so the caller must keep it.
    """
    try:
        # The constructor raises an error if it finds no cache folder for a function of this file.
        caching.CompileResultCacheImpl(make_kernel_folder)
    except RuntimeError:
        folder = TemporaryDirectory(prefix="gsmap-kernels-")
        os.environ["NUMBA_CACHE_DIR"] = folder.name
        numba.config.reload_config()  # numba reads the environment again
        if is_first_rank():
            logging.getLogger("gsmap").warning(
                "Neither the installation nor the home folder can be written to, so that kernels "
                "for the CPU are compiled for this run alone: set NUMBA_CACHE_DIR to a folder that "
                "stays."
            )
        return folder
    return None


# Both objects are kept until the end of the process.
NOTICE = CompilationNotice()
event.register(kind="numba:compile", listener=NOTICE)
_FOLDER = make_kernel_folder()
