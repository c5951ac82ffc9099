"""Former names of modules, for configs and code outside this repository."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import MappingProxyType, ModuleType

_MAPTR, _BASE = "gsmap.models.maptr", "gsmap.models.base"
_WHOLE = ("coder", "decoder", "head", "layers", "masks", "pairs", "parts")
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

# former name -> the modules that hold its contents now
MOVED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        **{f"{_MAPTR}.{name}": (f"{_BASE}.{name}",) for name in _WHOLE},
        f"{_MAPTR}.attention": (f"{_BASE}.attention", f"{_MAPTR}.self_attention"),
        f"{_MAPTR}.matching": (f"{_BASE}.matching", f"{_MAPTR}.cost"),
        **{
            f"gsmap.evaluation.{name}": (f"gsmap.evaluation.{room}.{name}",)
            for room, names in _EVALUATION.items()
            for name in names
        },
    }
)


class MovedModules(MetaPathFinder, Loader):
    """Import a module by its former name: it holds the contents of its successors."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a spec for the former name of a module, else None."""
        return spec_from_loader(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Fill a module with the contents of its successors, which register their classes."""
        for name in MOVED[module.__name__]:
            contents = vars(import_module(name))
            vars(module).update({k: v for k, v in contents.items() if not k.startswith("__")})
