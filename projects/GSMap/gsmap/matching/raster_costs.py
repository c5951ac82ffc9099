"""Matching cost between rendered masks (GSMap Eq. 9)."""

import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData
from torch import Tensor

from ..ops.soft_iou import pairwise_soft_iou


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
