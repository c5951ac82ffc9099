"""Matching costs between rendered masks: GSMap's soft IoU (Eq. 9) and MapVR's dice."""

from typing import Any

import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.losses.dice import (
    ElementRenderer,
    pairwise_dice_loss,
    rendered_dice_cost,
)
from gsmap.ops.soft_iou import pairwise_soft_iou


@TASK_UTILS.register_module()
class IoUCost:
    """Cost of the overlap of the rasters that the head has rendered (GSMap Eq. 9).

    Args:
        weight: Weight of the cost.
        kind: ``"iou"``: 1 - sum min / sum max; ``"dice"``: MapVR's dice loss.

    Raises:
        ValueError: If ``kind`` is unknown.
    """

    reads = ("pred.rasters", "gt.rasters")

    def __init__(self, weight: float = 1.0, kind: str = "iou") -> None:
        if kind not in ("iou", "dice"):
            raise ValueError(f"kind must be 'iou' or 'dice', got {kind!r}.")
        self.weight = weight
        self.kind = kind

    @torch.no_grad()
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
            Costs, without gradient. (N, K)

        Raises:
            ValueError: If either has no ``rasters``.
        """
        for name, instances in (("pred_instances", pred_instances), ("gt_instances", gt_instances)):
            if "rasters" not in instances:
                raise ValueError(
                    f"IoUCost needs {name}.rasters: use a head that renders masks for matching."
                )
        preds, targets = pred_instances.rasters, gt_instances.rasters
        if self.kind == "dice":
            return self.weight * pairwise_dice_loss(preds, targets)
        return self.weight * (1 - pairwise_soft_iou(preds, targets))


@TASK_UTILS.register_module()
class RenderedDiceCost:
    """Dice loss of softly rendered points, each pair rendered as the ground truth's class.

    Args:
        weight: Weight of the cost.
        size: Rows and columns of the rasters.
        rendering: Further settings of `ElementRenderer`.
    """

    reads = ("pred.pts", "gt.first_pts", "gt.labels")

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
            gt_instances: With ``labels`` (K,) and normalised ``first_pts`` (K, P, 2).
            img_meta: Not used.
            kwargs: Not used.

        Returns:
            Costs. (N, K)
        """
        cost = rendered_dice_cost(
            pred_instances.pts,
            gt_instances.first_pts,
            gt_instances.labels,
            self.renderer,
        )
        return self.weight * cost
