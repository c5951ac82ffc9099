"""Masks of map elements for Gaussians: their ground truth, and the gradients that they pass on."""

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
    """Masks of map elements whose references are Gaussians.

    Args:
        grid: Extent of the map.
        held_classes: Classes whose masks move no point: their losses reach sigma and theta alone.
        **kwargs: Settings of `ElementMasks`. ``source="gaussians"`` draws as ``"points"`` does, by
            Gaussians along the points (GSMap Eq. 6). Such a mask has the line's width in mass, so
            that a prediction can equal it.
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
        """Draw ground truths as bands, filled or by Gaussians. (K, M, 2) -> (K, H, W)"""
        if self.source != "gaussians":
            return super().draw(polylines, labels, grid)
        across_m = self.line_width_m / math.sqrt(2 * math.pi)
        gaussians = gaussians_along(polylines[..., :2].float(), across_m)
        return render_gaussians(*gaussians, grid)

    def rendered_references(self, references: Tensor, labels: Tensor, coords: int) -> Tensor:
        """References whose points get no gradient if their class is held.

        Args:
            references: References of the decoder, ``coords`` coordinates first. (M, P, D)
            labels: Class indices of their ground truths. (M,)
            coords: Number of coordinates of a point.
        """
        if not self.held_classes:
            return references
        is_held = torch.isin(labels, constant(labels, self.held_classes))[:, None, None]
        points = references[..., :coords]
        points = torch.where(is_held, points.detach(), points)
        return torch.cat([points, references[..., coords:]], dim=-1)
