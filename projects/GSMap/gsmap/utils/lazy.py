"""Lazy import of the names of a package, on first use (PEP 562)."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, str], others: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make ``__getattr__``, ``__dir__`` and ``__all__`` of a package with lazily imported names.

    Args:
        package: ``__name__`` of the package.
        modules: For each name, the module of the package that defines it, relative to the package.
        others: For each name from another package, the full name of the module that defines it.

    Returns:
        ``__getattr__``, ``__dir__`` and ``__all__``, which the package assigns to these names.
    """
    module_of_name = {name: f"{package}.{module}" for name, module in modules.items()}
    module_of_name.update(others or {})

    def load(name: str) -> Any:
        if name not in module_of_name:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(module_of_name[name])
        value = getattr(module, name)
        # Python calls this function only for names that the package does not have yet.
        setattr(sys.modules[package], name, value)
        return value

    def list_names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of_name})

    return load, list_names, sorted(module_of_name)
