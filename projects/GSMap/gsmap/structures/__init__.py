"""Extents, rasters and polylines; nothing here knows of a model or of OpenMMLab.

``BEVGrid`` is imported when it is asked for: converters need polylines, not torch.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsmap.structures.grid import BEVGrid

__all__ = ["BEVGrid"]


def __getattr__(name: str) -> Any:
    if name != "BEVGrid":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from gsmap.structures.grid import BEVGrid

    return BEVGrid
