"""Losses of MapVR: dice loss of softly rendered elements, and direction loss of their edges."""

from dataclasses import dataclass
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WeightConfig, check_classes
from gsmap.models.maptr.losses import turns
from gsmap.ops.polyline_raster import DISTANCES, soft_rasters
from gsmap.ops.soft_iou import dice_loss
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class ElementRenderer:
    """Soft renderer of map elements as in MapVR: lines or filled polygons, depending on the class.

    Args:
        size: Rows H and columns W of the rasters.
        line_softness: Softness of lines (tau), in pixels, or squared pixels if ``distance`` is
            ``"squared"``.
        polygon_softness: Softness of polygons, in the unit of ``line_softness``.
        polygon_classes: Indices of the classes that are rendered as filled polygons.
        distance: Distance D in the value exp(-D / tau) of a line's pixel: ``"squared"`` distance of
            the pixel from the nearest edge, or ``"plain"`` distance (`soft_rasters`).

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
            raise InputError(f"size must be rows and columns, both >= 1, got {self.size}.")
        if any(label < 0 for label in self.polygon_classes):
            raise InputError(f"polygon_classes must be >= 0, got {self.polygon_classes}.")
        if self.distance not in DISTANCES:
            raise InputError(f"distance must be one of {DISTANCES}, got {self.distance!r}.")
        if not (self.line_softness > 0 and self.polygon_softness > 0):  # true for NaN, too
            raise InputError(
                f"softness must be > 0, got {self.line_softness} and {self.polygon_softness}."
            )

    def check(self, part: object, head: BuiltHead) -> None:
        """Raise ValueError if a class of ``polygon_classes`` does not exist.

        Args:
            part: Loss or cost that uses the renderer, named in the error message.
            head: Head with the classes.
        """
        name = f"{type(part).__name__}.polygon_classes"
        check_classes(name, self.polygon_classes, head.classes)

    def is_polygon(self, labels: Tensor) -> Tensor:
        """Whether elements of the given labels are rendered as polygons. (n,) -> (n,)"""
        # `constant` uploads the indices once and caches them on the device of the labels.
        return torch.isin(labels, constant(labels, self.polygon_classes))

    def render(self, points: Tensor, is_polygon: Tensor) -> Tensor:
        """Render elements to soft rasters.

        Args:
            points: Vertices (x, y), [0, 1] over the map. (n, P, 2)
            is_polygon: True for filled polygons, False for lines. (n,)

        Returns:
            Rasters in [0, 1]. (n, H, W)
        """
        height, width = self.size
        pixels = torch.stack([points[..., 0] * width, points[..., 1] * height], dim=-1)
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

    The class of the ground truth decides whether a pair is rendered as lines or as polygons. All
    equivalent point orders render to equal masks, so the annotated order is used.

    Args:
        loss_weight: Weight of the loss.
        size: Rows H and columns W of the rasters.
        last_layer_only: Compute the loss for the last decoder layer only.
        first_group_only: Compute the loss for the first query group only, the only group that is
            used in prediction.
        rendering: Further settings of `ElementRenderer`.
    """

    name = "dice"

    def __init__(
        self,
        loss_weight: WeightConfig = 15.0,
        size: tuple[int, int] = (256, 128),
        last_layer_only: bool = False,
        first_group_only: bool = False,
        **rendering: Any,
    ) -> None:
        super().__init__(
            loss_weight,
            last_layer_only=last_layer_only,
            first_group_only=first_group_only,
        )
        self.renderer = ElementRenderer(size, **rendering)

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a class of ``polygon_classes`` does not exist."""
        self.renderer.check(self, head)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Dice loss of each of M matched pairs. (M,)"""
        is_polygon = self.renderer.is_polygon(pairs.gt_labels)
        preds = self.renderer.render(pairs.pred_pts, is_polygon)
        targets = self.renderer.render(pairs.gt_first_pts, is_polygon)
        return dice_loss(preds, targets)


@MODELS.register_module()
class SelfDirectionLoss(MapLoss):
    """One minus the cosine between consecutive edges of a prediction.

    It penalises folded predictions, because a loss of rasters alone permits folds. Both edges of a
    pair receive a gradient. The angle at the first vertex of a ring is not penalised. MapVR Eq. 4
    adds the cosines themselves, but minimising them would reward folds.

    Args:
        loss_weight: Weight of the loss.
        flags: ``last_layer_only`` and ``first_group_only``, as in `RenderedDiceLoss`.
    """

    name = "dir"

    def __init__(self, loss_weight: WeightConfig = 0.002, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """One minus the cosine at each inner vertex of M matched pairs. (M, P - 2)"""
        edges = pairs.pred_pts_m.diff(dim=1)  # (M, P - 1, 2)
        # `turns` returns one minus the cosine of the angle between two edges.
        return turns(edges[:, :-1], edges[:, 1:])
