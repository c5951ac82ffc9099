"""VectorMapNet's canvas, the raster that turns coordinates into tokens."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.structures.grid import Array, BEVGrid
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class Canvas:
    """Raster of W x H pixels over the map and a margin at its upper edges.

    The token of a coordinate is its pixel number plus one. Token 0 ends a sequence. Points are
    normalised to [0, 1] over the canvas: 0 is in the first pixel of an axis, and 1 in the last one.

    Args:
        grid: Extent of the map, in metres.
        pixel_m: Side of a pixel in metres, > 0, which gives W and H for the map without the margin.
            With the margin, the pixels are larger.
        margin_m: Width in metres, >= 0, of the margin beyond the upper edges of the map.

    Raises:
        ValueError: If the pixels do not divide the extent of the map, or if the margin is negative.
    """

    grid: BEVGrid
    pixel_m: float = 0.3
    margin_m: float = 2.0

    def __post_init__(self) -> None:
        if self.margin_m < 0:
            raise InputError(f"margin_m must be >= 0, got {self.margin_m}.")
        self.grid.rasterized(self.pixel_m)  # raises an error if the pixels do not divide the extent

    @cached_property
    def size(self) -> tuple[int, int]:
        """Numbers of pixels along x and y."""
        pixels = self.grid.rasterized(self.pixel_m)
        return pixels.width, pixels.height

    @property
    def steps(self) -> tuple[int, int]:
        """Numbers of steps from the first pixel to the last along x and y."""
        return self.size[0] - 1, self.size[1] - 1

    @property
    def num_tokens(self) -> int:
        """Size of the vocabulary, shared by x and y: the pixels of the longer axis and token 0."""
        return max(self.size) + 1

    @property
    def settings(self) -> tuple[float, ...]:
        """Settings that must be equal in the targets and in the head.

        They are the pixel size, the margin, the range of x and the range of y, all in metres.
        """
        return self.pixel_m, self.margin_m, *self.grid.x_range, *self.grid.y_range

    @cached_property
    def _grid_with_margin(self) -> BEVGrid:
        """Extent of the canvas, which is the map with the margin at its upper edges."""
        x_low, x_high = self.grid.x_range
        y_low, y_high = self.grid.y_range
        return replace(
            self.grid,
            x_range=(x_low, x_high + self.margin_m),
            y_range=(y_low, y_high + self.margin_m),
        )

    def norm_from_metres(self, points: Array) -> Array:
        """Map metres to [0, 1] over the canvas. (..., 2)"""
        return self._grid_with_margin.norm_from_metres(points)

    def metres_from_norm(self, points: Array) -> Array:
        """Map [0, 1] over the canvas to metres. (..., 2)"""
        return self._grid_with_margin.metres_from_norm(points)


def tokenize_points(points: np.ndarray, steps: Sequence[int]) -> np.ndarray:
    """Convert points to the tokens x, y, x, y, ... and a stop token.

    Args:
        points: Points in [0, 1] over the canvas. (n, 2)
        steps: Steps of the canvas along x and y (`Canvas.steps`).

    Returns:
        Tokens, the last of which is 0. (2 n + 1,)
    """
    pixels = (points * steps).astype(np.int64)  # rounded down; (n, 2)
    return np.append(pixels + 1, 0)  # `append` flattens the rows (x, y) to x, y, x, y, ...
