"""Extents, rasters and polylines; nothing here knows of a model or of OpenMMLab."""

from gsmap.structures.grid import BEVGrid

__all__ = ["BEVGrid"]
