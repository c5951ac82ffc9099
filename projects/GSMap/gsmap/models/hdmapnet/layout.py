"""HDMapNet's raster layout: columns from rear to front, rows from right to left.

The axis of a grid that points ahead is ``grid.forward``, ``"x"`` or ``"y"``. In the grid itself,
columns run along x and rows along y.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsmap.structures.grid import BEVGrid


def forward_size(grid: BEVGrid) -> tuple[int, int]:
    """Return the numbers of rows (across the direction of travel) and columns of the layout."""
    if grid.forward == "x":
        return grid.height, grid.width
    return grid.width, grid.height


def orient_forward(feats: Tensor, grid: BEVGrid) -> Tensor:
    """Rotate BEV features, whose row 0 is at the smallest y, to HDMapNet's layout.

    (..., H, W) -> (..., rows, columns)
    """
    if grid.forward == "x":  # y points to the left: row 0 is at the right already
        return feats
    # x points to the right: columns along y, and row 0 at the largest x.
    return feats.transpose(-1, -2).flip(-2)


def pixels_from_metres(points: NDArray[Any], grid: BEVGrid) -> NDArray[np.float64]:
    """Convert points (x, y) in metres to continuous pixels (column, row). (..., 2) -> (..., 2)

    Pixels are in HDMapNet's layout. The centre of pixel (0, 0) is at (0.5, 0.5).
    """
    low = np.array([grid.x_range[0], grid.y_range[0]])
    scale = np.array([grid.width, grid.height]) / np.array(grid.extent_m)
    pixels = (points.astype(np.float64) - low) * scale
    if grid.forward == "x":
        return pixels
    # Columns run along y, and rows are counted from the largest x, as in `orient_forward`.
    return np.stack([pixels[..., 1], grid.width - pixels[..., 0]], axis=-1)


def metres_from_pixels(pixels: NDArray[Any], grid: BEVGrid) -> NDArray[np.float64]:
    """Convert continuous pixels (column, row) to points (x, y) in metres. (..., 2) -> (..., 2)

    The inverse of `pixels_from_metres`.
    """
    # `grid_pixels` are (column, row) in the grid itself.
    column, row = np.moveaxis(pixels.astype(np.float64), -1, 0)
    if grid.forward == "x":
        grid_pixels = np.stack([column, row], axis=-1)
    else:
        grid_pixels = np.stack([grid.width - row, column], axis=-1)
    low = np.array([grid.x_range[0], grid.y_range[0]])
    return grid_pixels * np.array(grid.pixel_size_m) + low
