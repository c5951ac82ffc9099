"""Extents, rasters and polylines; nothing here knows of a model or of OpenMMLab."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "BEVGrid": "grid",
        "Gaussians": "gaussians",
        "MapElements": "elements",
    },
)
