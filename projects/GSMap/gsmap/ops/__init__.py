"""Rasterizers and other tensor operations.

``ops/<op>/__init__.py`` has the public functions, which check their arguments and choose a backend.
``reference.py`` is the implementation in plain torch, against which the others are tested.
``numba.py`` and ``triton.py`` are fused kernels for a CPU and a GPU, imported at their first use.
An operation that is fast in plain torch is a single file.
"""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "draw_polylines": "polyline_raster",
        "pairwise_soft_iou": "soft_iou",
        "render_gaussians": "gaussian_raster",
    },
)
