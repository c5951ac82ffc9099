"""Rendering of 2D Gaussians to soft masks (GSMap Eq. 6): one function, several backends."""

from .api import BACKENDS, render_gaussians

__all__ = ["BACKENDS", "render_gaussians"]
