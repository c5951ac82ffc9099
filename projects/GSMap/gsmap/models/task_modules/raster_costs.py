"""Matching costs between rendered masks: GSMap's soft IoU (Eq. 9) and MapVR's dice."""

from typing import Any

import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.losses.dice import ElementRenderer, rendered_dice_cost
from gsmap.ops.soft_iou import pairwise_soft_iou


def raster_iou_cost(preds: Tensor, targets: Tensor) -> Tensor:
    """Return 1 - soft IoU of every prediction and ground truth.

    Args:
        preds: Masks in [0, 1]. (N, h, w)
        targets: Masks in [0, 1]. (K, h, w)

    Returns:
        Costs in [0, 1], without gradient. (N, K)
    """
    with torch.no_grad():
        return 1 - pairwise_soft_iou(preds, targets)


@TASK_UTILS.register_module()
class IoUCost:
    """Cost 1 - soft IoU of the rasters that the head has rendered.

    Args:
        weight: Weight of the cost.
    """

    def __init__(self, weight: float = 1.0) -> None:
        self.weight = weight

    def __call__(
        self,
        pred_instances: InstanceData,
        gt_instances: InstanceData,
        img_meta: dict[str, object] | None = None,
        **kwargs: object,
    ) -> Tensor:
        """Return the weighted cost of every prediction and ground truth.

        Args:
            pred_instances: With ``rasters`` (N, h, w).
            gt_instances: With ``rasters`` (K, h, w).
            img_meta: Not used.
            kwargs: Not used.

        Returns:
            Costs. (N, K)

        Raises:
            ValueError: If either has no ``rasters``.
        """
        for name, instances in (("pred_instances", pred_instances), ("gt_instances", gt_instances)):
            if "rasters" not in instances:
                raise ValueError(
                    f"IoUCost needs {name}.rasters: use a head that renders masks for matching."
                )
        return self.weight * raster_iou_cost(pred_instances.rasters, gt_instances.rasters)


@TASK_UTILS.register_module()
class RenderedDiceCost:
    """Dice loss of softly rendered points, each pair rendered as the ground truth's class.

    Args:
        weight: Weight of the cost.
        size: Rows and columns of the rasters.
        rendering: Further settings of `ElementRenderer`.
    """

    def __init__(
        self, weight: float = 10.0, size: tuple[int, int] = (128, 64), **rendering: Any
    ) -> None:
        self.weight = weight
        self.renderer = ElementRenderer(size, **rendering)

    def __call__(
        self,
        pred_instances: InstanceData,
        gt_instances: InstanceData,
        img_meta: dict[str, object] | None = None,
        **kwargs: object,
    ) -> Tensor:
        """Return the weighted cost of every prediction and ground truth.

        Args:
            pred_instances: With normalised ``pts`` (N, P, 2).
            gt_instances: With ``labels`` (K,) and normalised ``pts_shifts`` (K, S, P, 2), the first
                of which is the annotated order.
            img_meta: Not used.
            kwargs: Not used.

        Returns:
            Costs. (N, K)
        """
        cost = rendered_dice_cost(
            pred_instances.pts,
            gt_instances.pts_shifts[:, 0],
            gt_instances.labels,
            self.renderer,
        )
        return self.weight * cost
