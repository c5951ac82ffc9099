"""Import of optional dependencies, the extras of the package, and of modules of the user."""

import importlib
from types import ModuleType

from gsmap.utils.errors import InputError, WorkError

NOT_INSTALLED = "install it, or name its folder in PYTHONPATH"
"""Advice about a module of the user that is not found."""


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


def import_own(module: str) -> ModuleType:
    """Import a module of the user, such as one that registers metrics.

    Args:
        module: Name of the module.

    Raises:
        ValueError: If the module, or a module that it imports, is not found.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise InputError(f"{module} cannot be imported: {error}; {NOT_INSTALLED}.") from error
