"""Import of optional dependencies, the extras of the package."""

import importlib
from types import ModuleType

from gsmap.utils.errors import WorkError


def import_extra(module: str, extra: str) -> ModuleType:
    """Import a module of an optional dependency (``pip install -e .[EXTRA]``).

    Args:
        module: Name of the module.
        extra: Name of the extra that installs it.

    Raises:
        RuntimeError: If the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise WorkError(
            f"{module} is not installed: `pip install -e .[{extra}]` brings it."
        ) from error
