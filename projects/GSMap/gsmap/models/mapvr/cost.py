"""Matching cost of MapVR."""

from typing import Any

import torch
from mmdet3d.registry import TASK_UTILS
from torch import Tensor

from gsmap.models.base.matching import MapCost
from gsmap.models.base.pairs import BuiltHead, SampleView
from gsmap.models.base.parts import WeightConfig, class_weights
from gsmap.models.mapvr.losses import ElementRenderer
from gsmap.ops.soft_iou import pairwise_dice_loss


@TASK_UTILS.register_module()
class RenderedDiceCost(MapCost):
    """Dice loss between soft rasters of predictions and ground truths (MapVR).

    The class of the ground truth decides whether a pair is rendered as lines or as polygons.

    Args:
        weight: Weight of the cost.
        size: Rows H and columns W of the rasters.
        rendering: Further settings of `ElementRenderer`. It renders classes in ``polygon_classes``
            as filled polygons, and all others as lines.
    """

    def __init__(
        self, weight: WeightConfig = 10.0, size: tuple[int, int] = (128, 64), **rendering: Any
    ) -> None:
        super().__init__(weight)
        self.renderer = ElementRenderer(size, **rendering)

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a class of ``polygon_classes`` does not exist."""
        self.renderer.check(self, head)  # the message names the class of this cost

    def __call__(
        self, pred_instances: SampleView, gt_instances: SampleView, img_meta: Any = None
    ) -> Tensor:
        """Weighted dice losses between predictions and ground truths.

        Args:
            pred_instances: Predictions with normalised ``pts`` (N, P, 2).
            gt_instances: Ground truths with ``first_pts`` (K, P, 2), the normalised points in the
                annotated order, and ``labels`` (K,).
            img_meta: Not used.

        Returns:
            The costs. (N, K)
        """
        preds = pred_instances.pts
        is_polygon = self.renderer.is_polygon(gt_instances.labels)
        targets = self.renderer.render(gt_instances.first_pts, is_polygon)
        # A prediction is paired with ground truths of all classes, so it is rendered in both ways.
        all_lines = torch.zeros(len(preds), dtype=torch.bool, device=preds.device)
        all_polygons = torch.ones_like(all_lines)
        lines = self.renderer.render(preds, is_polygon=all_lines)  # (N, H, W)
        polygons = self.renderer.render(preds, is_polygon=all_polygons)
        line_costs = pairwise_dice_loss(lines, targets)  # (N, K)
        polygon_costs = pairwise_dice_loss(polygons, targets)
        costs = torch.where(is_polygon, polygon_costs, line_costs)  # (K,) selects columns
        # `class_weights` returns one weight for all, or the weight of each ground truth's class.
        return costs * class_weights(self.weight, gt_instances.labels)
