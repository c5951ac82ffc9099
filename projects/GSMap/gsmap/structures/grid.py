"""The extent of the map in metres and its raster: every metres <-> [0, 1] <-> pixel conversion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from gsmap.utils.errors import InputError

if TYPE_CHECKING:  # what scores files and knows no tensors starts without torch
    import torch
    from torch import Tensor

Array = TypeVar("Array", npt.NDArray[Any], "Tensor")


@dataclass(frozen=True)
class BEVGrid:
    """A bird's-eye-view rectangle in metres, divided into ``height`` x ``width`` pixels.

    Row 0 lies at the smallest y, column 0 at the smallest x; a pixel's value is taken at its
    centre, so pixel (row, col) has the continuous pixel coordinates (col + 0.5, row + 0.5).

    Args:
        x_range: Smallest and largest x in metres.
        y_range: Smallest and largest y in metres.
        height: Number of rows H (along y).
        width: Number of columns W (along x).
        forward: Axis of the direction of travel, ``"x"`` or ``"y"``; by default the longer side.

    Raises:
        ValueError: If a range is empty, a size is not positive or ``forward`` is unknown.
    """

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    height: int = 1
    width: int = 1
    forward: str | None = None

    def __post_init__(self) -> None:
        for name in ("x_range", "y_range"):
            low, high = (float(v) for v in getattr(self, name))
            if not low < high:
                raise InputError(f"{name} must be (low, high) with low < high, got {(low, high)}.")
            object.__setattr__(self, name, (low, high))  # a config's lists, made hashable
        if self.height < 1 or self.width < 1:
            raise InputError(f"height and width must be >= 1, got {self.height} x {self.width}.")
        if self.forward is None:
            wide = self.extent_m[0] > self.extent_m[1]
            object.__setattr__(self, "forward", "x" if wide else "y")
        elif self.forward not in ("x", "y"):
            raise InputError(f"forward must be 'x' or 'y', got {self.forward!r}.")

    @property
    def extent_m(self) -> tuple[float, float]:
        """Size along x and y in metres."""
        return self.x_range[1] - self.x_range[0], self.y_range[1] - self.y_range[0]

    @property
    def pixel_size_m(self) -> tuple[float, float]:
        """Size of one pixel along x and y in metres."""
        return self.extent_m[0] / self.width, self.extent_m[1] / self.height

    def resized(self, height: int, width: int) -> "BEVGrid":
        """Return the same extent with another raster size."""
        return replace(self, height=height, width=width)

    def rasterized(self, pixel_m: float | Sequence[float]) -> "BEVGrid":
        """Return the same extent in pixels of a side in metres, or of sizes along x and y.

        ValueError if the pixels do not divide the extent.
        """
        sizes = (pixel_m, pixel_m) if isinstance(pixel_m, (int, float)) else tuple(pixel_m)
        counts = [extent / size for extent, size in zip(self.extent_m, sizes, strict=True)]
        width, height = (round(count) for count in counts)
        if min(width, height) < 1 or max(abs(counts[0] - width), abs(counts[1] - height)) > 1e-3:
            raise InputError(
                f"pixels of {sizes[0]:g} x {sizes[1]:g} m do not divide the map of "
                f"{self.extent_m[0]:g} x {self.extent_m[1]:g} m."
            )
        return self.resized(height, width)

    def norm_from_metres(self, points: Array) -> Array:
        """Map metres to [0, 1] over the extent. (..., 2)"""
        return self._in_units(points, self.extent_m)

    def px_from_metres(self, points: Array) -> Array:
        """Map metres to continuous pixels (u along x, v along y), centres at + 0.5. (..., 2)"""
        return self._in_units(points, self.pixel_size_m)

    def metres_from_norm(self, points: Array) -> Array:
        """Map [0, 1] over the extent to metres. (..., 2)"""
        return _affine(points, self.extent_m, (self.x_range[0], self.y_range[0]))

    def front_from_metres(self, points: Array) -> Array:
        """Map metres to [0, 1] from the front edge to the rear and from the left to the right.

        (..., 2)
        """
        order, scale, shift = self._front
        return _affine(_chosen(self.norm_from_metres(points), order), scale, shift)

    def metres_from_front(self, points: Array) -> Array:
        """Map [0, 1] from the front edge and from the left to metres. (..., 2)"""
        order, scale, shift = self._front
        return self.metres_from_norm(_chosen(_affine(points, scale, shift), order))

    @property
    def _front(self) -> tuple[list[int], tuple[float, float], tuple[float, float]]:
        """Return how [0, 1] over the map is turned to the front and back: order, scale, shift."""
        along_x = self.forward == "x"
        return ([0, 1], (-1, -1), (1, 1)) if along_x else ([1, 0], (-1, 1), (1, 0))

    def _in_units(self, points: Array, sizes_m: tuple[float, float]) -> Array:
        """Measure points from the lower corner in units of given sizes. (..., 2)"""
        shift = -self.x_range[0] / sizes_m[0], -self.y_range[0] / sizes_m[1]
        return _affine(points, (1 / sizes_m[0], 1 / sizes_m[1]), shift)

    def pixel_centres(
        self, device: "torch.device | str | None" = None, dtype: "torch.dtype | None" = None
    ) -> "Tensor":
        """Return the centre (x, y) of every pixel in metres, float32 by default. (H, W, 2)"""
        import torch

        dtype, (dx, dy) = dtype or torch.float32, self.pixel_size_m
        x = self.x_range[0] + dx * (torch.arange(self.width, device=device, dtype=dtype) + 0.5)
        y = self.y_range[0] + dy * (torch.arange(self.height, device=device, dtype=dtype) + 0.5)
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def _chosen(points: Array, order: list[int]) -> Array:
    """Return coordinates in an order, without a list of indices to upload. (..., 2)"""
    if isinstance(points, np.ndarray):
        return points[..., order]
    import torch

    return torch.stack([points[..., axis] for axis in order], -1)


def _affine(points: Array, scale: tuple[float, float], shift: tuple[float, float]) -> Array:
    """Return ``points * scale + shift`` on (x, y); further entries (z) are kept. (..., >= 2)"""
    if points.shape[-1] < 2:
        raise InputError(f"points must end in (x, y), got shape {tuple(points.shape)}.")
    if isinstance(points, np.ndarray):
        xy = points[..., :2] * np.asarray(scale) + np.asarray(shift)
        return np.concatenate([xy, points[..., 2:]], -1).astype(points.dtype, copy=False)
    import torch

    x, y = points[..., 0] * scale[0] + shift[0], points[..., 1] * scale[1] + shift[1]
    return torch.cat([torch.stack([x, y], -1), points[..., 2:]], -1)


def padded_size(size: tuple[int, int], divisor: int) -> tuple[int, int]:
    """Return height and width rounded up to multiples of ``divisor``."""
    return -(-size[0] // divisor) * divisor, -(-size[1] // divisor) * divisor
