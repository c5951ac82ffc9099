"""MapVR's losses: the dice loss of softly rendered elements, and straight predictions."""

from dataclasses import dataclass
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WEIGHT, check_classes
from gsmap.models.maptr.losses import turns
from gsmap.ops.polyline_raster import DISTANCES, soft_rasters
from gsmap.ops.soft_iou import dice_loss
from gsmap.structures.tensors import constant


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

    def check(self, part: object, head: BuiltHead) -> None:
        """Raise ValueError if a polygon's class, in the settings of a part, does not exist."""
        name = f"{type(part).__name__}.polygon_classes"
        check_classes(name, self.polygon_classes, head.classes)

    def is_polygon(self, labels: Tensor) -> Tensor:
        """Return which elements are rendered as polygons. (n,) -> (n,)"""
        return torch.isin(labels, constant(labels, self.polygon_classes))

    def render(self, points: Tensor, is_polygon: Tensor) -> Tensor:
        """Return masks of elements whose vertices are normalised. (n, P, 2), (n,) -> (n, H, W)"""
        height, width = self.size
        pixels = torch.stack([points[..., 0] * width, points[..., 1] * height], -1)
        return soft_rasters(
            pixels,
            height=height,
            width=width,
            is_polygon=is_polygon,
            line_softness=self.line_softness,
            polygon_softness=self.polygon_softness,
            distance=self.distance,
        )


@MODELS.register_module()
class RenderedDiceLoss(MapLoss):
    """Dice loss between softly rendered predictions and ground truths (MapVR, section 4.3).

    A pair is rendered as its ground truth's class, from its points in the annotated order.

    Args:
        loss_weight: Weight of the loss.
        size: Rows H and columns W of the rasters.
        last_layer_only: As in `MapLoss`.
        first_group_only: As in `MapLoss`.
        rendering: Further settings of `ElementRenderer`.
    """

    name = "dice"

    def __init__(
        self,
        loss_weight: WEIGHT = 15.0,
        size: tuple[int, int] = (256, 128),
        last_layer_only: bool = False,
        first_group_only: bool = False,
        **rendering: Any,
    ) -> None:
        super().__init__(loss_weight, last_layer_only, first_group_only)
        self.renderer = ElementRenderer(size, **rendering)

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a polygon's class does not exist."""
        self.renderer.check(self, head)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Compare the rasters of pairs. (M,)"""
        is_polygon = self.renderer.is_polygon(pairs.gt_labels)
        preds = self.renderer.render(pairs.pred_pts, is_polygon)
        return dice_loss(preds, self.renderer.render(pairs.gt_first_pts, is_polygon))


@MODELS.register_module()
class SelfDirectionLoss(MapLoss):
    """One minus the cosine between consecutive edges of a prediction (MapVR Eq. 4).

    It keeps predictions from folding back where nothing but their rendering is supervised. Both
    edges of a pair get a gradient; a ring's last edge and its first are no pair.

    Args:
        loss_weight: Weight of the loss.
        flags: As in `MapLoss`.
    """

    name = "dir"

    def __init__(self, loss_weight: WEIGHT = 0.002, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Return the value of each turn, of points in metres. (M, P - 2)"""
        # Differs from MapVR Eq. (4), which sums the cosines: their sign would reward folding.
        edges = pairs.pred_pts_m.diff(dim=1)
        return turns(edges[:, :-1], edges[:, 1:])
