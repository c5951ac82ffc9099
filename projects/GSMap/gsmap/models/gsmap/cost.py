"""The matching cost of rendered masks (GSMap Eq. 9)."""

from typing import Any

from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.ops.soft_iou import pairwise_dice_loss, pairwise_soft_iou


@TASK_UTILS.register_module()
class IoUCost:
    """Cost of the overlap of the rasters that the head has rendered (GSMap Eq. 9).

    Args:
        weight: Weight of the cost.
        kind: ``"iou"`` for 1 - sum min / sum max, ``"dice"`` for MapVR's dice loss.

    Raises:
        ValueError: If ``kind`` is unknown.
    """

    reads = ("pred.rasters", "gt.rasters")

    def __init__(self, weight: float = 1.0, kind: str = "iou") -> None:
        if kind not in ("iou", "dice"):
            raise ValueError(f"kind must be 'iou' or 'dice', got {kind!r}.")
        self.weight, self.kind = weight, kind

    def __call__(
        self, pred_instances: InstanceData, gt_instances: InstanceData, img_meta: Any = None
    ) -> Tensor:
        """Compare ``rasters`` (N, h, w) and (K, h, w); ValueError if either has none. (N, K)"""
        for name, instances in (("pred_instances", pred_instances), ("gt_instances", gt_instances)):
            if "rasters" not in instances:
                raise ValueError(
                    f"IoUCost needs {name}.rasters: use a head that renders masks for matching."
                )
        preds, targets = pred_instances.rasters, gt_instances.rasters
        if self.kind == "dice":
            return self.weight * pairwise_dice_loss(preds, targets)
        return self.weight * (1 - pairwise_soft_iou(preds, targets))
