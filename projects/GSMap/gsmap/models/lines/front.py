"""BEV features and masks as PivotNet sees them: rows from the front, columns from the left."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid


def front_size(grid: BEVGrid) -> tuple[int, int]:
    """Return the numbers of a raster's pixels along the direction of travel and across it."""
    return (grid.height, grid.width) if grid.forward == "y" else (grid.width, grid.height)


def turned(feats: Tensor, grid: BEVGrid) -> Tensor:
    """Turn a raster with row 0 at the smallest y to the front, or back again. (..., H, W)"""
    return feats.flip(-2) if grid.forward == "y" else feats.transpose(-1, -2).flip(-2, -1)


def centres(shapes: Sequence[tuple[int, int]], device: torch.device) -> Tensor:
    """Return the centres (x, y) of maps' cells, [0, 1] over each, row-major. (all cells, 2)"""
    grids = [BEVGrid((0.0, 1.0), (0.0, 1.0), *shape) for shape in shapes]
    return torch.cat([grid.pixel_centres(device).flatten(0, 1) for grid in grids])


def ahead(points: Tensor, grid: BEVGrid) -> Tensor:
    """Return points (x, y) in metres as (ahead, to the left). (..., 2)"""
    x, y = points.unbind(-1)
    return torch.stack([y, -x] if grid.forward == "y" else [x, y], -1)
