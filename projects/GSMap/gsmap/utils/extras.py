"""Packages that only some of GSMap needs: extras of its own package."""

import importlib
from types import ModuleType


def import_extra(module: str, extra: str) -> ModuleType:
    """Import a module that comes with an extra of this package.

    Args:
        module: Name of the module.
        extra: Name of the extra, as in ``pip install -e .[EXTRA]``.

    Raises:
        RuntimeError: If the module is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise RuntimeError(
            f"{module} is not installed: `pip install -e .[{extra}]` brings it."
        ) from error
