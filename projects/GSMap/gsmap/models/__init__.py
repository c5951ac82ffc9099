"""Network parts: detectors, BEV encoders, the frame of all heads, and a folder for each method."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "GSMapHead": "gsmap.head",
        "MapDetector": "detector",
        "MapHead": "base.head",
        "RasterLoss": "gsmap.losses",
    },
)
