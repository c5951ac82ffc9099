"""Extents, rasters and polylines; nothing here knows of a model or of OpenMMLab."""

from .bev_grid import BEVGrid

__all__ = ["BEVGrid"]
