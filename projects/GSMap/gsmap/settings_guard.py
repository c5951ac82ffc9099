"""Keeps files of the working folder from setting up libraries, and slow imports from others.

matplotlib and numba read ``matplotlibrc`` and ``.numba_config.yaml`` of the working folder when
they are imported, and numba again when it compiles; numba's can name a folder of compiled kernels,
which are pickles. OpenCV prepends its folder to ``LD_LIBRARY_PATH`` so that an empty part is left,
by which every program that is started later looks for libraries in the working folder first. That
folder may be a stranger's data set. mmdet imports scikit-learn, which takes as long as torch, for
a tracker and a head of two-dimensional boxes. ``gsmap/__init__.py`` puts `SettingsGuard` in place.
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
    """Let no file exist under a relative path while a module is imported."""
    exists = os.path.exists

    def exists_elsewhere(path: Any) -> bool:
        return (isinstance(path, int) or os.path.isabs(path)) and exists(path)

    os.path.exists = exists_elsewhere
    try:
        yield
    finally:
        os.path.exists = exists
    if "_config_fname" in vars(module):  # numba's, which it reads again
        vars(module)["_config_fname"] = os.devnull


@contextmanager
def _with_library_path_kept(_: ModuleType) -> Iterator[None]:
    """Leave the places where the system looks for libraries as they were."""
    before = os.environ.get(_LIBRARIES)
    try:
        yield
    finally:
        os.environ.pop(_LIBRARIES, None)
        if before is not None:
            os.environ[_LIBRARIES] = before


_SKLEARN = (
    "sklearn",
    "sklearn.gaussian_process",
    "sklearn.gaussian_process.kernels",
    "sklearn.mixture",
)


class _DeferredModule(ModuleType):
    """Stands for a module whose names are only called: each is looked up when it is called."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *args, **options: getattr(import_module(self.__name__), name)(
            *args, **options
        )


@contextmanager
def _with_sklearn_deferred(_: ModuleType) -> Iterator[None]:
    """Import scikit-learn only when a name is called that a module takes from it."""
    if _SKLEARN[0] in sys.modules:
        yield
        return
    deferred = {name: _DeferredModule(name) for name in _SKLEARN}
    for name, module in deferred.items():
        if "." in name:
            parent, child = name.rsplit(".", 1)
            setattr(deferred[parent], child, module)
    sys.modules.update(deferred)
    try:
        yield
    finally:
        for name in deferred:
            del sys.modules[name]


_Guard = Callable[[ModuleType], AbstractContextManager[None]]
_GUARDS: dict[str, _Guard] = {
    "matplotlib": _without_relative_files,
    "numba.core.config": _without_relative_files,
    "cv2": _with_library_path_kept,
    "mmdet.models.task_modules.tracking.interpolation": _with_sklearn_deferred,
    "mmdet.models.dense_heads.paa_head": _with_sklearn_deferred,
}


class SettingsGuard:
    """Finds these libraries as Python does, and imports them guarded; first in ``sys.meta_path``.

    Libraries that were imported before ``gsmap`` stay as they are.
    """

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how the module ``name`` is imported, if it needs a guard."""
        if name not in _GUARDS:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _GuardedLoader(spec.loader, _GUARDS[name])
        return spec


class _GuardedLoader(Loader):
    """A loader that imports under a guard, and then gives its place to the one that it wraps."""

    def __init__(self, loader: Loader, guard: _Guard) -> None:
        self._loader = loader
        self._guard = guard

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Return what the wrapped loader does."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Run the module under its guard."""
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        with self._guard(module):
            self._loader.exec_module(module)
