"""Networks: the detector, BEV encoders, base classes of heads, and a folder for each map model."""

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
