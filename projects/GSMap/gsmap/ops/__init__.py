"""Rasterizers and other tensor operations.

``ops/<op>/__init__.py`` holds the public functions, which check and choose a backend;
``reference.py`` plain torch, the definition of right; ``numba.py`` and ``triton.py`` fused kernels,
imported when they are first used. What torch itself does fast is one file.
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
