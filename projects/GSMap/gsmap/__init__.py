"""Online vectorized HD-map construction with 2D Gaussians.

Light on purpose: the mathematics in ``geometry``, ``ops``, ``losses`` and ``evaluation`` needs
torch and numpy alone. A config registers every model, data set and metric with
``custom_imports = dict(imports=['gsmap.registered'])``.
"""

import sys

from gsmap.mmcv_ext import MmcvExtFinder

__version__ = "0.1.0"

sys.meta_path.append(MmcvExtFinder)  # last: mmcv's own compiled module comes first
