"""Rasters in the order of line heads (`LineHead`): rows from the front, columns from the left."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid


def front_size(grid: BEVGrid) -> tuple[int, int]:
    """Rows (along the direction of travel) and columns (across it) of a raster of line heads."""
    if grid.forward == "y":
        return (grid.height, grid.width)
    return (grid.width, grid.height)


def turn_raster(feats: Tensor, grid: BEVGrid) -> Tensor:
    """Convert a raster between row 0 at the smallest y and row 0 at the front.

    Rasters of `BEVGrid` have row 0 at the smallest y, and columns along x. Applied twice, the
    conversion returns the given raster.

    Args:
        feats: Raster. (..., H, W)
        grid: Extent of the map and its direction of travel.

    Returns:
        Raster of the other order. (..., H, W), or (..., W, H) if the direction of travel is x
    """
    if grid.forward == "y":
        return feats.flip(-2)
    return feats.transpose(-1, -2).flip(-2, -1)


def centres(shapes: Sequence[tuple[int, int]], device: torch.device) -> Tensor:
    """Centres of the cells of feature maps, as points (x, y) in [0, 1] over each map.

    x increases from column to column, and y increases from row to row.

    Args:
        shapes: Rows and columns of each map.
        device: Device of the points.

    Returns:
        Centres of the cells of the first map row by row, then of the next maps. (all cells, 2)
    """
    points = []
    for height, width in shapes:
        # A grid whose extent is the unit square has its centres in [0, 1].
        grid = BEVGrid(x_range=(0.0, 1.0), y_range=(0.0, 1.0), height=height, width=width)
        points.append(grid.pixel_centres(device).flatten(0, 1))
    return torch.cat(points)


def ahead(points: Tensor, grid: BEVGrid) -> Tensor:
    """Convert points (x, y) in the annotation frame to distances ahead and to the left. (..., 2)

    Both are in metres. If y is ahead, x points to the right; if x is ahead, y points to the left.
    """
    x, y = points.unbind(-1)
    if grid.forward == "y":
        return torch.stack([y, -x], dim=-1)
    return torch.stack([x, y], dim=-1)
