"""Online vectorized HD-map construction with 2D Gaussians.

The names below are imported when they are first used (docs/library.md). docs/architecture.md lists
the packages that need torch and OpenMMLab. A config registers every model, data set and metric with
``custom_imports = dict(imports=['gsmap.registered'])``.
"""

import sys

from gsmap.mmcv_ext import MmcvExtFinder
from gsmap.settings_guard import SettingsGuard
from gsmap.utils.forks import use_one_thread_in_forks
from gsmap.utils.interrupt import leave_at_once_on_ctrl_c, starts_a_command
from gsmap.utils.lazy import lazy_names
from gsmap.utils.moved import MovedModules

__version__ = "0.1.0"

if starts_a_command():
    leave_at_once_on_ctrl_c()  # the imports that follow take seconds
use_one_thread_in_forks()  # forked workers have no OpenMP threads, and torch would wait for them
# The entries of `sys.meta_path` are import hooks, which Python asks in their order. The first one
# prevents libraries from reading settings files in the working folder when they are imported.
sys.meta_path.insert(0, SettingsGuard)
# An mmcv without compiled operators gets replacements for them. This hook is asked after Python's
# usual search, so the compiled operators are used if mmcv has them.
sys.meta_path.append(MmcvExtFinder)
# Modules of this package can be imported by their former names.
sys.meta_path.append(MovedModules())

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {  # the subpackage or module that provides each name
        "BEVGrid": "structures",
        "MapElements": "structures",
        "MapEvaluator": "evaluation",
        "MapInferencer": "apis",
        "OnnxInferencer": "apis",
        "RasterLoss": "models",
        "export_onnx": "apis",
        "list_models": "checkpoints.named_models",
        "load_model": "apis",
        "render_gaussians": "ops",
    },
    others={"from_records": "mapdata"},  # defined in another package
)
