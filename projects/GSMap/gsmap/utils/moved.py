"""Import of moved modules by their former names, for configs and code outside this repository."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import MappingProxyType, ModuleType

_MAPTR = "gsmap.models.maptr"
_BASE = "gsmap.models.base"
# Modules that moved from `gsmap.models.maptr` to `gsmap.models.base`.
_BASE_MODULES = ("coder", "decoder", "head", "layers", "masks", "pairs", "parts")
# Modules that moved from `gsmap.evaluation` to its subpackages, by the name of the subpackage.
_EVALUATION = {
    "core": (
        "average_precision",
        "chamfer_ap",
        "chamfer_kernels",
        "evaluator",
        "file_evaluation",
        "match_files",
        "matches",
        "raster_ap",
        "raster_kernels",
        "report",
        "results_json",
        "sample_ap",
    ),
    "metrics": ("pld", "topology"),
    "analysis": (
        "bootstrap",
        "calibration",
        "compact",
        "consistency",
        "distances",
        "drive_files",
        "groups",
        "prior",
    ),
}


def _successors() -> dict[str, tuple[str, ...]]:
    """Return the modules to which the contents of each former module have moved."""
    successors: dict[str, tuple[str, ...]] = {}
    for name in _BASE_MODULES:
        successors[f"{_MAPTR}.{name}"] = (f"{_BASE}.{name}",)
    # The contents of these two modules were divided among two modules each.
    successors[f"{_MAPTR}.attention"] = (f"{_BASE}.attention", f"{_MAPTR}.self_attention")
    successors[f"{_MAPTR}.matching"] = (f"{_BASE}.matching", f"{_MAPTR}.cost")
    for package, names in _EVALUATION.items():
        for name in names:
            successors[f"gsmap.evaluation.{name}"] = (f"gsmap.evaluation.{package}.{name}",)
    return successors


MOVED: Mapping[str, tuple[str, ...]] = MappingProxyType(_successors())
"""Modules to which the contents of each former module have moved, by its name."""


class MovedModules(MetaPathFinder, Loader):
    """Importer of modules by their former names, with the contents of the modules in `MOVED`.

    An instance in ``sys.meta_path`` is an import hook. If no earlier hook has found a module,
    Python calls `find_spec`. From the returned spec it makes an empty module, which `exec_module`
    fills.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module by its former name.

        Args:
            fullname: Name of the module.
            path: Search path of the parent package; not used.
            target: Module that is reloaded; not used.

        Returns:
            Spec of the module, or None if the name is not a former name.
        """
        return spec_from_loader(name=fullname, loader=self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Fill a former module with the contents of its successors.

        Importing the successors registers their classes.
        """
        for successor in MOVED[module.__name__]:
            contents = vars(import_module(successor))
            for name, value in contents.items():
                # Names such as `__name__` and `__file__` describe the module itself.
                if not name.startswith("__"):
                    setattr(module, name, value)
