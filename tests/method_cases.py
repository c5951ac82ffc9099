"""Cases of general tests that belong to one method: ``tests/methods/<method>/cases.py``."""

import importlib
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "methods"


def cases_of_methods(name: str) -> dict[str, Any]:
    """Cases of a general test, by method.

    Args:
        name: Name of the cases in the module of each method, such as ``EXPORTS``.

    Returns:
        The value of each method that has one.
    """
    found = {}
    for path in sorted(FOLDER.glob("*/cases.py")):
        method = path.parent.name
        module = importlib.import_module(f"methods.{method}.cases")
        if hasattr(module, name):
            found[method] = getattr(module, name)
    return found
