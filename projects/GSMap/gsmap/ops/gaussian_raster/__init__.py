"""Rendering of 2D Gaussians to soft masks (GSMap Eq. 6): one function, several backends."""

from gsmap.ops.gaussian_raster.api import render_gaussians

__all__ = ["render_gaussians"]
