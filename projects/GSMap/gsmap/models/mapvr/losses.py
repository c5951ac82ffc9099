"""MapVR's losses: the dice loss of softly rendered elements, and straight predictions."""

from dataclasses import dataclass
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.maptr.losses import sum_of_turns
from gsmap.ops.polyline_raster import DISTANCES, soft_rasters
from gsmap.ops.soft_iou import dice_loss


@dataclass(frozen=True)
class ElementRenderer:
    """Renders map elements as MapVR does: lines or filled polygons, by their class.

    Args:
        size: Rows H and columns W of the masks.
        line_softness: Softness of lines (tau), in pixels, squared if ``distance`` is.
        polygon_softness: Softness of polygons.
        polygon_classes: Classes that are rendered as filled polygons; none: all are lines.
        distance: ``"squared"`` or ``"plain"`` (see `gsmap.ops.polyline_raster.soft_rasters`).

    Raises:
        ValueError: If a setting is outside its range.
    """

    size: tuple[int, int]
    line_softness: float = 2.0
    polygon_softness: float = 4.0
    polygon_classes: tuple[int, ...] = (1,)
    distance: str = "squared"

    def __post_init__(self) -> None:
        if len(self.size) != 2 or min(self.size) < 1:
            raise ValueError(f"size must be rows and columns, both >= 1, got {self.size}.")
        if any(label < 0 for label in self.polygon_classes):
            raise ValueError(f"polygon_classes must be >= 0, got {self.polygon_classes}.")
        if self.distance not in DISTANCES:
            raise ValueError(f"distance must be one of {DISTANCES}, got {self.distance!r}.")
        softness = self.line_softness, self.polygon_softness
        if min(softness) <= 0:
            raise ValueError(f"softness must be > 0, got {softness[0]} and {softness[1]}.")

    def is_polygon(self, labels: Tensor) -> Tensor:
        """Return which elements are rendered as polygons. (n,) -> (n,)"""
        return torch.isin(labels, labels.new_tensor(self.polygon_classes))

    def render(self, points: Tensor, is_polygon: Tensor) -> Tensor:
        """Return masks of elements whose vertices are normalised. (n, P, 2), (n,) -> (n, H, W)"""
        height, width = self.size
        pixels = torch.stack([points[..., 0] * width, points[..., 1] * height], -1)
        softness = self.line_softness, self.polygon_softness
        return soft_rasters(pixels, *self.size, is_polygon, *softness, self.distance)


@MODELS.register_module()
class RenderedDiceLoss(nn.Module):
    """Dice loss between softly rendered predictions and ground truths (MapVR, section 4.3).

    Args:
        loss_weight: Weight of the loss.
        size: Rows H and columns W of the rasters.
        rendering: Further settings of `ElementRenderer`.
    """

    name = "dice"
    reads = ("pred.pts", "gt.first_pts", "gt.labels")

    def __init__(
        self, loss_weight: float = 15.0, size: tuple[int, int] = (256, 128), **rendering: Any
    ) -> None:
        super().__init__()
        self.loss_weight = loss_weight
        self.renderer = ElementRenderer(size, **rendering)

    def forward(
        self,
        pred_points: Tensor,
        gt_points: Tensor,
        gt_labels: Tensor,
        avg_factor: float | Tensor | None = None,
    ) -> Tensor:
        """Return the weighted sum over ``avg_factor``, or the mean over the n pairs without it.

        Points are normalised (n, P, 2), the ground truth's in their first order; a pair is rendered
        as its ground truth's class (n,). 0 with a gradient of 0 if nothing is matched.
        """
        is_polygon = self.renderer.is_polygon(gt_labels)
        preds = self.renderer.render(pred_points, is_polygon)
        targets = self.renderer.render(gt_points, is_polygon)
        count = max(len(pred_points), 1) if avg_factor is None else avg_factor
        return self.loss_weight * dice_loss(preds, targets).sum() / count


@MODELS.register_module()
class SelfDirectionLoss(nn.Module):
    """One minus the cosine between consecutive edges of a prediction (MapVR Eq. 4).

    It keeps predictions from folding back where nothing but their rendering is supervised. Both
    edges of a pair get a gradient; a ring's last edge and its first are no pair.

    Args:
        loss_weight: Weight of the loss.
    """

    name = "dir"
    reads = ("pred.pts_m",)

    def __init__(self, loss_weight: float = 0.002) -> None:
        super().__init__()
        self.loss_weight = loss_weight

    def forward(self, pred: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted sum over ``avg_factor`` of points in metres. (M, P, 2 or 3) -> ()"""
        # Differs from MapVR Eq. (4), which sums the cosines: their sign would reward folding.
        edges = pred.diff(dim=1)
        return self.loss_weight * (sum_of_turns(edges[:, :-1], edges[:, 1:]) / avg_factor)
