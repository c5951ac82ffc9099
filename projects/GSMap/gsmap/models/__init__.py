"""Network parts: detectors, BEV encoders, decoders, heads, losses, matching."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "GSMapHead": "gsmap.head",
        "MapDetector": "detector",
        "MapHead": "maptr.head",
        "RasterLoss": "gsmap.losses",
    },
)
