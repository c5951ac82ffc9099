"""Masks of map elements for heads with Gaussians."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsmap.models.base.masks import ElementMasks
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.gaussians import gaussians_along
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant


class GaussianMasks(ElementMasks):
    """Masks of map elements whose vertices are Gaussians.

    Args:
        grid: Extent of the map.
        held_classes: Class indices of elements whose masks pass no gradient to the points, only to
            the other parameters of the Gaussians: their sizes sigma and angles theta.
        kwargs: Settings of `ElementMasks`, such as ``line_width_m`` and ``source``, the form of the
            ground truth in masks. ``"full"`` draws it at full resolution, and ``"points"`` draws
            its P points, both as bands or filled polygons. ``"gaussians"`` renders its mask from
            Gaussians along the P points (GSMap Eq. 6). The integral of this mask across a line is
            the width of the line. Predictions are rendered from Gaussians as well, so their masks
            can equal such a mask.

    Attributes:
        sources: Valid values of ``source``.
    """

    sources: ClassVar[tuple[str, ...]] = ("full", "points", "gaussians")

    def __init__(self, grid: BEVGrid, held_classes: Sequence[int] = (), **kwargs: Any) -> None:
        super().__init__(grid, **kwargs)
        self.held_classes = tuple(held_classes)

    @property
    def class_settings(self) -> dict[str, tuple[int, ...]]:
        """Class indices of each setting that lists classes."""
        return {**super().class_settings, "held_classes": self.held_classes}

    def draw(self, polylines: Tensor, labels: Tensor, grid: BEVGrid) -> Tensor:
        """Draw map elements as bands, filled polygons or Gaussians.

        Args:
            polylines: Points in metres. (K, M, 2 or 3)
            labels: Class indices, which select the elements drawn as filled polygons. They have no
                effect on Gaussians. (K,)
            grid: The raster.

        Returns:
            One mask per element, in [0, 1]. (K, H, W)
        """
        if self.source != "gaussians":
            return super().draw(polylines, labels, grid)
        # The integral of a Gaussian of height 1 is sqrt(2 pi) sigma, here the width of the line.
        across_m = self.line_width_m / math.sqrt(2 * math.pi)  # sigma across the line
        # One Gaussian per point, whose longer axis points along the line.
        gaussians = gaussians_along(polylines[..., :2].float(), across_m)
        return render_gaussians(
            gaussians.means, gaussians.scales, rotations=gaussians.rotations, grid=grid
        )

    def rendered_references(self, references: Tensor, labels: Tensor, coords: int) -> Tensor:
        """Prepare references for rendering: points of ``held_classes`` are detached.

        Args:
            references: Vertices that the decoder predicts: ``coords`` coordinates, then the other
                parameters of the Gaussian. (M, P, D)
            labels: Class indices of their ground truths. (M,)
            coords: Number of coordinates of a point, 2 or 3.

        Returns:
            References with equal values. (M, P, D)
        """
        if not self.held_classes:
            return references
        # `constant` creates the tensor of the class indices once for each device.
        is_held = torch.isin(labels, constant(labels, self.held_classes))[:, None, None]
        points = references[..., :coords]
        points = torch.where(is_held, points.detach(), points)
        return torch.cat([points, references[..., coords:]], dim=-1)
