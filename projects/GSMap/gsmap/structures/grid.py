"""Extent of a map in metres and its raster: conversions between metres, [0, 1] and pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from gsmap.utils.errors import InputError

if TYPE_CHECKING:  # result files can be evaluated without the time to import torch
    import torch
    from torch import Tensor

Array = TypeVar("Array", npt.NDArray[Any], "Tensor")


@dataclass(frozen=True)
class BEVGrid:
    """Bird's-eye-view rectangle in metres, divided into ``height`` x ``width`` pixels.

    Row 0 is at the smallest y and column 0 at the smallest x. The value of a pixel belongs to its
    centre, so pixel (row, col) has the continuous pixel coordinates (col + 0.5, row + 0.5).

    Args:
        x_range: Smallest and largest x in metres.
        y_range: Smallest and largest y in metres.
        height: Number H of rows, along y.
        width: Number W of columns, along x.
        forward: Axis of the direction of travel, ``"x"`` or ``"y"``; None selects the axis of the
            longer side, and y for a square.

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
            low, high = getattr(self, name)
            low = float(low)
            high = float(high)
            if not low < high:
                raise InputError(f"{name} must be (low, high) with low < high, got {(low, high)}.")
            # Configs have lists here; tuples make the grid hashable. A frozen dataclass can only be
            # set by `object.__setattr__`.
            object.__setattr__(self, name, (low, high))
        if self.height < 1 or self.width < 1:
            raise InputError(f"height and width must be >= 1, got {self.height} x {self.width}.")
        if self.forward is None:
            is_wide = self.extent_m[0] > self.extent_m[1]
            object.__setattr__(self, "forward", "x" if is_wide else "y")
        elif self.forward not in ("x", "y"):
            raise InputError(f"forward must be 'x' or 'y', got {self.forward!r}.")

    @property
    def extent_m(self) -> tuple[float, float]:
        """Size along x and y in metres."""
        length_x = self.x_range[1] - self.x_range[0]
        length_y = self.y_range[1] - self.y_range[0]
        return length_x, length_y

    @property
    def pixel_size_m(self) -> tuple[float, float]:
        """Size of one pixel along x and y in metres."""
        length_x, length_y = self.extent_m
        return length_x / self.width, length_y / self.height

    def with_size(self, height: int, width: int) -> "BEVGrid":
        """Create a grid of this extent with another number of rows and columns."""
        return replace(self, height=height, width=width)

    def rasterized(self, pixel_m: float | Sequence[float]) -> "BEVGrid":
        """Create a grid of this extent with another size of pixels.

        Args:
            pixel_m: Side of a pixel in metres, or its sizes along x and y.

        Raises:
            ValueError: If a size is not > 0, or the pixels do not divide the extent.
        """
        if isinstance(pixel_m, (int, float)):
            pixel_m = (pixel_m, pixel_m)
        size_x, size_y = pixel_m
        if not (size_x > 0 and size_y > 0):  # true for NaN, too
            raise InputError(f"pixel_m must be > 0 m, got {size_x:g} x {size_y:g} m.")
        length_x, length_y = self.extent_m
        columns = length_x / size_x
        rows = length_y / size_y
        width = round(columns)
        height = round(rows)
        is_empty = width < 1 or height < 1
        # Sizes such as 0.15 m have no exact float, so quotients are rarely whole numbers.
        rounding = max(abs(columns - width), abs(rows - height))
        if is_empty or rounding > 1e-3:
            raise InputError(
                f"pixels of {size_x:g} x {size_y:g} m do not divide the map of "
                f"{length_x:g} x {length_y:g} m: choose sides that are multiples of the pixels, or "
                "pixels that divide the sides."
            )
        return self.with_size(height, width)

    def norm_from_metres(self, points: Array) -> Array:
        """Convert metres to [0, 1] over the extent. (..., 2) -> (..., 2)"""
        return self._count_from_corner(points, self.extent_m)

    def px_from_metres(self, points: Array) -> Array:
        """Convert metres to continuous pixels (u along x, v along y). (..., 2) -> (..., 2)"""
        return self._count_from_corner(points, self.pixel_size_m)

    def metres_from_norm(self, points: Array) -> Array:
        """Convert [0, 1] over the extent to metres. (..., 2) -> (..., 2)"""
        lower_corner = (self.x_range[0], self.y_range[0])
        return _affine(points, scale=self.extent_m, shift=lower_corner)

    def front_from_metres(self, points: Array) -> Array:
        """Convert metres to relative distances from the front and from the left edge.

        Args:
            points: Points (x, y) in metres. (..., 2)

        Returns:
            Distance from the front edge (0 there, 1 at the rear edge), and distance from the left
            edge (0 there, 1 at the right edge). (..., 2)
        """
        order, scale, shift = self._front_axes
        coordinates = _reorder(self.norm_from_metres(points), order)
        return _affine(coordinates, scale=scale, shift=shift)

    def metres_from_front(self, points: Array) -> Array:
        """Convert relative distances from the front and from the left edge to metres.

        Args:
            points: Distance from the front edge (0 there, 1 at the rear edge), and distance from
                the left edge (0 there, 1 at the right edge). (..., 2)

        Returns:
            Points (x, y) in metres. (..., 2)
        """
        order, scale, shift = self._front_axes
        coordinates = _affine(points, scale=scale, shift=shift)
        return self.metres_from_norm(_reorder(coordinates, order))

    @property
    def _front_axes(self) -> tuple[list[int], tuple[float, float], tuple[float, float]]:
        """Order of the axes, scale and shift that `front_from_metres` applies to [0, 1].

        Exchanging the axes twice changes nothing, and neither does t -> 1 - t applied twice.
        Therefore `metres_from_front` applies the same steps in the reverse order.
        """
        if self.forward == "x":
            return [0, 1], (-1, -1), (1, 1)  # (x, y) -> (1 - x, 1 - y), since left is at large y
        return [1, 0], (-1, 1), (1, 0)  # (x, y) -> (1 - y, x), since left is at small x

    def _count_from_corner(self, points: Array, sizes_m: tuple[float, float]) -> Array:
        """Convert metres to multiples of ``sizes_m`` from the lower corner. (..., 2) -> (..., 2)"""
        size_x, size_y = sizes_m
        scale = (1 / size_x, 1 / size_y)
        shift = (-self.x_range[0] / size_x, -self.y_range[0] / size_y)
        return _affine(points, scale=scale, shift=shift)

    def pixel_centres(
        self, device: "torch.device | str | None" = None, dtype: "torch.dtype | None" = None
    ) -> "Tensor":
        """Compute the centres of all pixels.

        Args:
            device: Device of the result; None for torch's default.
            dtype: Type of the result; None for float32.

        Returns:
            Centres (x, y) in metres. (H, W, 2)
        """
        import torch

        dtype = dtype or torch.float32
        dx, dy = self.pixel_size_m
        x = self.x_range[0] + dx * (torch.arange(self.width, device=device, dtype=dtype) + 0.5)
        y = self.y_range[0] + dy * (torch.arange(self.height, device=device, dtype=dtype) + 0.5)
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def _reorder(points: Array, order: list[int]) -> Array:
    """Reorder coordinates. (..., 2) -> (..., 2)"""
    if isinstance(points, np.ndarray):
        return points[..., order]
    import torch

    # Indexing by the list ``order`` would copy the list to the GPU and wait for the copy.
    return torch.stack([points[..., axis] for axis in order], dim=-1)


def _affine(points: Array, scale: tuple[float, float], shift: tuple[float, float]) -> Array:
    """Compute ``points * scale + shift`` on (x, y); z does not change. (..., 2 or more)"""
    if points.shape[-1] < 2:
        raise InputError(f"points must end in (x, y), got shape {tuple(points.shape)}.")
    if isinstance(points, np.ndarray):
        xy = points[..., :2] * np.asarray(scale) + np.asarray(shift)
        dtype = points.dtype if points.dtype.kind == "f" else np.float64  # integers lack decimals
        return np.concatenate([xy, points[..., 2:]], axis=-1).astype(dtype, copy=False)
    import torch

    # Numbers of Python need no copy to a GPU, as tensors would.
    x = points[..., 0] * scale[0] + shift[0]
    y = points[..., 1] * scale[1] + shift[1]
    return torch.cat([torch.stack([x, y], dim=-1), points[..., 2:]], dim=-1)


def padded_size(size: tuple[int, int], divisor: int) -> tuple[int, int]:
    """Round a height and width up to multiples of ``divisor``."""
    rows, columns = size
    # -(-a // b) is a / b rounded up, in integers.
    height = -(-rows // divisor) * divisor
    width = -(-columns // divisor) * divisor
    return height, width
