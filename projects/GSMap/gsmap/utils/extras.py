"""Packages that only some of GSMap needs: extras of its own package."""

import importlib
from types import ModuleType

from gsmap.utils.errors import WorkError


def import_extra(module: str, extra: str) -> ModuleType:
    """Import a module that comes with an extra of this package (``pip install -e .[EXTRA]``).

    Raises:
        RuntimeError: If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise WorkError(
            f"{module} is not installed: `pip install -e .[{extra}]` brings it."
        ) from error
