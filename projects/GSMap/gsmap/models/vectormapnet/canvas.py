"""VectorMapNet's canvas: where points lie as whole numbers, the tokens of a sequence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.structures.grid import Array, BEVGrid


@dataclass(frozen=True)
class Canvas:
    """A raster of W x H pixels over the map and a margin; tokens are 0 (stop) and coordinates + 1.

    Args:
        grid: The map's extent.
        pixel_m: Side of a pixel in metres, with the extent in place of that with the margin.
        margin_m: Metres beyond the upper edges of the map that the canvas covers too.

    Raises:
        ValueError: If the pixels do not divide the extent, or the margin is negative.
    """

    grid: BEVGrid
    pixel_m: float = 0.3
    margin_m: float = 2.0

    def __post_init__(self) -> None:
        if self.margin_m < 0:
            raise ValueError(f"margin_m must be >= 0, got {self.margin_m}.")
        self.grid.rasterized(self.pixel_m)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Numbers of pixels along x and y."""
        pixels = self.grid.rasterized(self.pixel_m)
        return pixels.width, pixels.height

    @property
    def steps(self) -> tuple[int, int]:
        """Steps from the first coordinate to the last along x and y."""
        return self.size[0] - 1, self.size[1] - 1

    @property
    def num_tokens(self) -> int:
        """Size of the vocabulary, one for x and y."""
        return max(self.size) + 1

    @property
    def settings(self) -> tuple[float, ...]:
        """What targets and head must agree on."""
        return self.pixel_m, self.margin_m, *self.grid.x_range, *self.grid.y_range

    @cached_property
    def _covered(self) -> BEVGrid:
        low, high = np.transpose([self.grid.x_range, self.grid.y_range])
        x_range, y_range = np.transpose([low, high + self.margin_m]).tolist()
        return replace(self.grid, x_range=x_range, y_range=y_range)

    def norm_from_metres(self, points: Array) -> Array:
        """Map metres to [0, 1] over the canvas. (..., 2)"""
        return self._covered.norm_from_metres(points)

    def metres_from_norm(self, points: Array) -> Array:
        """Map [0, 1] over the canvas to metres. (..., 2)"""
        return self._covered.metres_from_norm(points)


def tokens_of(points: np.ndarray, steps: Sequence[int]) -> np.ndarray:
    """Return points, [0, 1] over the canvas, as tokens x, y, x, y, ... and a stop. (2 n + 1,)"""
    return np.append((points * steps).astype(np.int64) + 1, 0)
