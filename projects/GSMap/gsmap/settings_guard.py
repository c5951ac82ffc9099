"""Import hooks against settings files in the working folder and against slow imports.

The working folder may hold files of unknown origin, such as a downloaded data set. Some libraries
read settings there:

* matplotlib reads ``matplotlibrc`` on import. Numba reads ``.numba_config.yaml`` on import and
  again when it compiles. This file may name a folder of compiled kernels. These are pickles, which
  can run any code when they are loaded.
* OpenCV prepends a folder to ``LD_LIBRARY_PATH`` and leaves an empty entry there. Because of the
  empty entry, all programs started later load libraries from the working folder first.

mmdet imports scikit-learn for a tracker and for a head of two-dimensional boxes. The import takes
as long as the import of torch, so it is deferred. ``gsmap/__init__.py`` adds `SettingsGuard` to
``sys.meta_path``.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from importlib.abc import Loader
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

_LIBRARIES = "LD_LIBRARY_PATH"


@contextmanager
def _without_relative_files(module: ModuleType) -> Iterator[None]:
    """Hide all files with relative paths from ``os.path.exists`` during the import of a module.

    matplotlib and numba test with this function whether the working folder has a settings file.
    """
    exists = os.path.exists

    def absolute_path_exists(path: Any) -> bool:
        # An integer is a file descriptor, not a path.
        is_relative = not isinstance(path, int) and not os.path.isabs(path)
        return not is_relative and exists(path)

    os.path.exists = absolute_path_exists
    try:
        yield
    finally:
        os.path.exists = exists
    # Relative name of numba's settings file, which numba reads again when it compiles.
    if "_config_fname" in vars(module):
        vars(module)["_config_fname"] = os.devnull


@contextmanager
def _with_unchanged_library_path(_: ModuleType) -> Iterator[None]:
    """Restore the environment variable ``LD_LIBRARY_PATH`` after the import of a module."""
    library_path = os.environ.get(_LIBRARIES)
    try:
        yield
    finally:
        os.environ.pop(_LIBRARIES, None)
        if library_path is not None:
            os.environ[_LIBRARIES] = library_path


# Modules of scikit-learn that mmdet imports, and their parent packages.
_SKLEARN = (
    "sklearn",
    "sklearn.gaussian_process",
    "sklearn.gaussian_process.kernels",
    "sklearn.mixture",
)


class _DeferredModule(ModuleType):
    """Placeholder of a module. It imports the module when one of its functions is called."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):  # Python itself looks for attributes such as ``__path__``
            raise AttributeError(name)

        def call(*args: Any, **options: Any) -> Any:
            module = import_module(self.__name__)
            function = getattr(module, name)
            return function(*args, **options)

        return call


@contextmanager
def _with_deferred_sklearn(_: ModuleType) -> Iterator[None]:
    """Replace scikit-learn by placeholders during the import of a module that uses it."""
    if _SKLEARN[0] in sys.modules:  # scikit-learn is imported already
        yield
        return
    placeholders = {name: _DeferredModule(name) for name in _SKLEARN}
    for name, placeholder in placeholders.items():
        if "." in name:
            # A module is also an attribute of its parent package.
            parent, child = name.rsplit(".", maxsplit=1)
            setattr(placeholders[parent], child, placeholder)
    sys.modules.update(placeholders)
    try:
        yield
    finally:
        # A later import, also by a placeholder, finds the modules of scikit-learn.
        for name in placeholders:
            del sys.modules[name]


_Guard = Callable[[ModuleType], AbstractContextManager[None]]
_GUARDS: dict[str, _Guard] = {
    "matplotlib": _without_relative_files,
    "numba.core.config": _without_relative_files,
    "cv2": _with_unchanged_library_path,
    "mmdet.models.task_modules.tracking.interpolation": _with_deferred_sklearn,
    "mmdet.models.dense_heads.paa_head": _with_deferred_sklearn,
}


class SettingsGuard:
    """Import finder for the modules of ``_GUARDS``. Each is imported under its guard.

    A guard is a context manager that is active while the module is imported. The finder is the
    first entry of ``sys.meta_path``. Modules that were imported before ``gsmap`` are not guarded.
    """

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module that needs a guard.

        Args:
            name: Full name of the module.
            path: Search path of the parent package; None for ``sys.path``.
            target: Module to reload, or None.

        Returns:
            Specification with a guarded loader. None for all other modules, so that Python asks the
            next finder, and for a module that is not installed.
        """
        if name not in _GUARDS:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _GuardedLoader(spec.loader, _GUARDS[name])
        return spec


class _GuardedLoader(Loader):
    """Loader that runs a module under a guard, in place of its original loader.

    Before it runs the module, it restores the original loader in the attributes of the module.
    """

    def __init__(self, loader: Loader, guard: _Guard) -> None:
        self._loader = loader
        self._guard = guard

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Create the module with the original loader."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Run the code of the module under the guard."""
        # Other code may read these attributes, for example to find files of the package.
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        with self._guard(module):
            self._loader.exec_module(module)
