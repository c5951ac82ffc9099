"""Rendering of 2D Gaussians to soft masks (GSMap Eq. 6): one function, several backends."""

from .api import render_gaussians

__all__ = ["render_gaussians"]
