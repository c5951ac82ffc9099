"""Masks of map elements: their rasters, and drawing of the ground truth on them."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.ops.polyline_raster import draw_polylines
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


class ElementMasks:
    """Rasters on which masks of predictions are compared with masks of the ground truth.

    Args:
        grid: Extent of the map.
        pixel_m: Pixel size of the masks of losses in metres: one number, or sizes along x and y.
            Default: 1/200 of the longer side of the map.
        cost_pixel_m: Pixel size of the masks of matching costs. Default: 1/128 of the longer side.
        line_width_m: Width of a line in ground-truth masks, in metres.
        filled_classes: Class indices of elements drawn as filled polygons. Others are drawn as
            bands.
        source: ``"full"`` draws the ground truth at full resolution. ``"points"`` draws its P
            points, in the matched order for losses and in the annotated order for matching costs.

    Attributes:
        sources: Valid values of ``source``.

    Raises:
        ValueError: If ``source`` is unknown, or if the pixels do not divide the map.
    """

    sources: ClassVar[tuple[str, ...]] = ("full", "points")

    def __init__(
        self,
        grid: BEVGrid,
        pixel_m: float | Sequence[float] | None = None,
        cost_pixel_m: float | Sequence[float] | None = None,
        line_width_m: float = 0.75,
        filled_classes: Sequence[int] = (),
        source: str = "full",
    ) -> None:
        if source not in self.sources:
            raise InputError(f"source must be one of {self.sources}, got {source!r}.")
        longer_m = max(grid.extent_m)
        # Grids of this extent with other pixels. `rasterized` checks that they divide the map.
        self.grid = grid.rasterized(pixel_m or longer_m / 200)
        self.cost_grid = grid.rasterized(cost_pixel_m or longer_m / 128)
        self.line_width_m = line_width_m
        self.filled_classes = tuple(filled_classes)
        self.source = source

    @classmethod
    def of(cls, grid: BEVGrid, masks: "ElementMasks | dict[str, Any] | None") -> "ElementMasks":
        """Build masks from their settings; an `ElementMasks` object is returned as it is."""
        if isinstance(masks, ElementMasks):
            return masks
        return cls(grid, **(masks or {}))

    @property
    def of_points(self) -> bool:
        """Whether the P points of the ground truth are drawn instead of its full polylines."""
        return self.source != "full"

    @property
    def class_settings(self) -> dict[str, tuple[int, ...]]:
        """Class indices of each setting that lists classes."""
        return {"filled_classes": self.filled_classes}

    @property
    def half_pixel_m(self) -> float:
        """Half the longer side of a pixel of the masks of losses, in metres."""
        return max(self.grid.pixel_size_m) / 2

    def draw(self, polylines: Tensor, labels: Tensor, grid: BEVGrid) -> Tensor:
        """Draw map elements as bands or filled polygons.

        Args:
            polylines: Points in metres, M of each element; heights are ignored. (K, M, 2 or 3)
            labels: Class indices. (K,)
            grid: The raster.

        Returns:
            One mask per element, in [0, 1]. (K, H, W)
        """
        filled = None
        if self.filled_classes:
            # `constant` makes a tensor on the device of `labels`, and caches it.
            filled = torch.isin(labels, constant(labels, self.filled_classes))
        return draw_polylines(
            polylines[..., :2].float(), grid, width_m=self.line_width_m, filled=filled
        )

    def rendered_references(self, references: Tensor, labels: Tensor, coords: int) -> Tensor:
        """References for the rendering of predicted masks; a subclass may stop gradients here.

        Args:
            references: References of M matched predictions, from the decoder. The first ``coords``
                entries are the coordinates of a point. (M, P, D)
            labels: Class indices of the matched ground truths. (M,)
            coords: Number of coordinates of a point.

        Returns:
            References for the rendering. (M, P, D)
        """
        return references

    def draw_batch(self, gt_instances: Sequence[InstanceData], grid: BEVGrid) -> Tensor:
        """Draw the ground truth of a batch before the matching.

        Args:
            gt_instances: Ground truth of each sample: ``labels_3d`` (K,), and in metres the points
                ``pts`` (K, P, 2 or 3) or, for the source ``"full"``, ``polylines`` (K, M, 2 or 3).
                K and M differ between samples.
            grid: The raster.

        Returns:
            Masks of all T elements of the batch, sample after sample, in [0, 1]. (T, H, W)

        Raises:
            ValueError: If ``source`` is ``"full"`` and a sample has no polylines.
        """
        labels = torch.cat([sample.labels_3d for sample in gt_instances])
        if self.of_points:
            points = torch.cat([sample.pts for sample in gt_instances])
            return self.draw(points, labels, grid)
        for sample in gt_instances:
            if "polylines" not in sample:
                raise InputError(
                    "masks of source 'full' need gt_instances_3d.polylines: make the targets with "
                    "FormatMapTargets."
                )
        length = max(sample.polylines.shape[1] for sample in gt_instances)
        padded = [_pad_lines(sample.polylines, length) for sample in gt_instances]
        return self.draw(torch.cat(padded), labels, grid)


def _pad_lines(lines: Tensor, length: int) -> Tensor:
    """Pad lines to a number of points. (K, M, 2 or 3) -> (K, length, 2 or 3)

    The last point is repeated, which does not change the drawn line.
    """
    if not len(lines):  # such lines may have M = 0, without a last point
        return lines.new_zeros(0, length, lines.shape[2])
    num_missing = length - lines.shape[1]
    if num_missing == 0:
        return lines
    return torch.cat([lines, lines[:, -1:].expand(-1, num_missing, -1)], dim=1)
