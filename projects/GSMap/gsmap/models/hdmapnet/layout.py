"""Maps as HDMapNet sees them: columns from rear to front, rows from right to left."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsmap.structures.grid import BEVGrid


def ahead_size(grid: BEVGrid) -> tuple[int, int]:
    """Return the numbers of a raster's pixels across the direction of travel and along it."""
    return (grid.height, grid.width) if grid.forward == "x" else (grid.width, grid.height)


def turned(feats: Tensor, grid: BEVGrid) -> Tensor:
    """Turn a map with row 0 at the smallest y to this layout. (..., H, W)"""
    return feats if grid.forward == "x" else feats.transpose(-1, -2).flip(-2)


def pixels_from_metres(points: NDArray[Any], grid: BEVGrid) -> NDArray[np.float64]:
    """Return continuous pixels (column, row) of points (x, y); centres are at + 0.5. (..., 2)"""
    low, size = np.array([grid.x_range[0], grid.y_range[0]]), np.array([grid.width, grid.height])
    pixels = (points.astype(np.float64) - low) * (size / np.array(grid.extent_m))
    if grid.forward == "x":
        return pixels
    return np.stack([pixels[..., 1], grid.width - pixels[..., 0]], -1)


def metres_from_pixels(pixels: NDArray[Any], grid: BEVGrid) -> NDArray[np.float64]:
    """Return the points (x, y) of continuous pixels (column, row). (..., 2)"""
    column, row = np.moveaxis(pixels.astype(np.float64), -1, 0)
    across = (column, row) if grid.forward == "x" else (grid.width - row, column)
    low = np.array([grid.x_range[0], grid.y_range[0]])
    return np.stack(across, -1) * np.array(grid.pixel_size_m) + low
