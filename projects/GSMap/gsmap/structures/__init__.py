"""Extents, rasters, polylines and Gaussians, independent of models and of OpenMMLab."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "FRAME_VIEWS": "frames",
        "BEVGrid": "grid",
        "FrameView": "frames",
        "Gaussians": "gaussians",
        "MapElements": "elements",
    },
)
