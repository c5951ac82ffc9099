"""Maps of whole drives: merging of frames, scores against the true map, files for other tools."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "MapOrigin": "geodetic",
        "write_geojson": "geojson",
    },
)
