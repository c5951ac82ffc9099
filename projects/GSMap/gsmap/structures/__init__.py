"""Extents, rasters and polylines; nothing here knows of a model or of OpenMMLab."""
