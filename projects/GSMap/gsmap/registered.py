"""Importing this module registers everything that GSMap adds to mmdet3d's registries."""

from importlib import import_module
from pkgutil import iter_modules

from gsmap.methods import METHODS
from gsmap.utils.collection import collection_paused

FOLDERS = (  # every module of these is imported, and of the methods' folders
    "gsmap.datasets.transforms",
    "gsmap.models.encoders",
    "gsmap.models.base",
    "gsmap.models.streams",
    "gsmap.models.lines",
    *(f"gsmap.models.{method.name}" for method in METHODS),
)

with collection_paused():
    import gsmap.apis.rig_fit
    import gsmap.datasets.stream_samplers
    import gsmap.datasets.vectorized_map_dataset
    import gsmap.engine.checkpoint_hook
    import gsmap.engine.cpu_autocast
    import gsmap.engine.figures
    import gsmap.engine.gaussian_health_hook
    import gsmap.engine.log_processor
    import gsmap.engine.optimizers
    import gsmap.engine.run_log
    import gsmap.evaluation.gaussian_metric
    import gsmap.evaluation.map_metric
    import gsmap.models.data_preprocessor
    import gsmap.models.detector
    import gsmap.visualization.map_visualization_hook
    import gsmap.visualization.map_visualizer

    for folder in FOLDERS:
        for module in iter_modules(import_module(folder).__path__, f"{folder}."):
            import_module(module.name)
