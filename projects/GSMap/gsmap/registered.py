"""Registration of all GSMap classes in the registries of mmdet3d, on import of this module."""

from importlib import import_module
from pkgutil import iter_modules

from gsmap.methods import METHODS
from gsmap.utils.collection import pause_collection

# Modules with registered classes outside of FOLDERS. A decorator registers each class when its
# module is imported.
MODULES = (
    "gsmap.apis.rig_fit",
    "gsmap.datasets.concatenation",
    "gsmap.datasets.stream_samplers",
    "gsmap.datasets.vectorized_map_dataset",
    "gsmap.engine.checkpoint_hook",
    "gsmap.engine.cpu_autocast",
    "gsmap.engine.figures",
    "gsmap.engine.gaussian_health_hook",
    "gsmap.engine.log_processor",
    "gsmap.engine.optimizers",
    "gsmap.engine.run_log",
    "gsmap.engine.sync_buffers",
    "gsmap.evaluation.gaussian_metric",
    "gsmap.evaluation.map_metric",
    "gsmap.models.data_preprocessor",
    "gsmap.models.detector",
    "gsmap.visualization.map_visualization_hook",
    "gsmap.visualization.map_visualizer",
)
FOLDERS = (  # all modules directly in these folders are imported, without subfolders
    "gsmap.datasets.transforms",
    "gsmap.models.encoders",
    "gsmap.models.base",
    "gsmap.models.streams",
    "gsmap.models.priors",
    "gsmap.models.lines",
    *(f"gsmap.models.{method.name}" for method in METHODS),
)

with pause_collection():  # garbage collections would only slow the imports down
    for name in MODULES:
        import_module(name)
    for folder in FOLDERS:
        package = import_module(folder)
        for module in iter_modules(package.__path__, prefix=f"{folder}."):
            import_module(module.name)
