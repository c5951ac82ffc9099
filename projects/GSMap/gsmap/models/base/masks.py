"""Masks of map elements: their rasters, and how the ground truth is drawn."""

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
    """The rasters on which predictions and ground truth are compared, and how the latter is drawn.

    Args:
        grid: The map's extent.
        pixel_m: Side of a pixel of the losses' masks in metres, or its sizes along x and y; by
            default a 200th of the map's longer side.
        cost_pixel_m: The same for matching; by default a 128th.
        line_width_m: Width of a line in the ground-truth mask, in metres.
        filled_classes: Classes whose ground-truth mask is filled; the others are bands.
        source: ``"full"``: the ground truth is drawn at full resolution; ``"points"``: by its P
            points in the matched order (in matching, in the annotated one).

    Attributes:
        sources: Values of ``source``; a subclass may add its own.

    Raises:
        ValueError: If ``source`` is unknown, or the pixels do not divide the map.
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
        self.grid = grid.rasterized(pixel_m or longer_m / 200)
        self.cost_grid = grid.rasterized(cost_pixel_m or longer_m / 128)
        self.line_width_m = line_width_m
        self.filled_classes = tuple(filled_classes)
        self.source = source

    @classmethod
    def of(cls, grid: BEVGrid, masks: "ElementMasks | dict[str, Any] | None") -> "ElementMasks":
        """Return masks as they are, or build them from their settings."""
        return masks if isinstance(masks, ElementMasks) else cls(grid, **(masks or {}))

    @property
    def of_points(self) -> bool:
        """Whether the ground truth's P points are drawn, in the matched order."""
        return self.source != "full"

    @property
    def class_settings(self) -> dict[str, tuple[int, ...]]:
        """Class indices of each setting that lists classes."""
        return {"filled_classes": self.filled_classes}

    @property
    def half_pixel_m(self) -> float:
        """Half the longer side of a pixel of the losses' masks, in metres."""
        return max(self.grid.pixel_size_m) / 2

    def draw(self, polylines: Tensor, labels: Tensor, grid: BEVGrid) -> Tensor:
        """Draw ground truths as bands, or filled. (K, M, 2) -> (K, H, W)"""
        filled = None
        if self.filled_classes:
            filled = torch.isin(labels, constant(labels, self.filled_classes))
        return draw_polylines(polylines[..., :2].float(), grid, self.line_width_m, filled)

    def rendered_references(self, references: Tensor, labels: Tensor, coords: int) -> Tensor:
        """References of which predicted masks are rendered; a subclass may stop gradients here.

        Args:
            references: References of the decoder, ``coords`` coordinates first. (M, P, D)
            labels: Class indices of their ground truths. (M,)
            coords: Number of coordinates of a point.
        """
        return references

    def draw_batch(self, gt_instances: Sequence[InstanceData], grid: BEVGrid) -> Tensor:
        """Draw the ground truth of all samples, before its matching is known. (T, H, W)"""
        labels = torch.cat([sample.labels_3d for sample in gt_instances])
        if self.of_points:
            return self.draw(torch.cat([sample.pts for sample in gt_instances]), labels, grid)
        if any("polylines" not in sample for sample in gt_instances):
            raise InputError(
                "masks of source 'full' need gt_instances_3d.polylines: make the targets with "
                "FormatMapTargets."
            )
        lines = [sample.polylines for sample in gt_instances]
        most = max(own.shape[1] for own in lines)
        return self.draw(torch.cat([_lengthened(own, most) for own in lines]), labels, grid)


def _lengthened(lines: Tensor, length: int) -> Tensor:
    """Repeat the last points of lines up to a length. (K, M, 2 or 3) -> (K, length, 2 or 3)"""
    if not len(lines):
        return lines.new_zeros(0, length, lines.shape[2])
    ends = lines[:, -1:].expand(-1, length - lines.shape[1], -1)
    return torch.cat([lines, ends], 1) if ends.shape[1] else lines
