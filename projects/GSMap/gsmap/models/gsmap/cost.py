"""Matching cost of rendered masks (GSMap Eq. 9)."""

from typing import Any

from mmdet3d.registry import TASK_UTILS
from torch import Tensor

from gsmap.models.base.matching import MapCost
from gsmap.models.base.pairs import BuiltHead, SampleView
from gsmap.models.base.parts import WeightConfig, class_weights
from gsmap.models.gsmap.reference import require_gaussians
from gsmap.ops.soft_iou import pairwise_dice_loss, pairwise_soft_iou
from gsmap.utils.errors import InputError


@TASK_UTILS.register_module()
class IoUCost(MapCost):
    """Matching cost of the overlap of predicted and ground-truth masks (GSMap Eq. 9).

    Args:
        weight: Weight of the cost, or a weight for each class.
        kind: ``"iou"`` for one minus the soft IoU, ``"dice"`` for one minus the dice coefficient.

    Raises:
        ValueError: If ``kind`` is unknown.
    """

    def __init__(self, weight: WeightConfig = 1.0, kind: str = "iou") -> None:
        super().__init__(weight)
        if kind not in ("iou", "dice"):
            raise InputError(f"kind must be 'iou' or 'dice', got {kind!r}.")
        self.kind = kind

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head has no Gaussians, of which masks are rendered."""
        require_gaussians(self, head)

    def __call__(
        self, pred_instances: SampleView, gt_instances: SampleView, img_meta: Any = None
    ) -> Tensor:
        """Weighted cost of each prediction with each ground truth.

        Args:
            pred_instances: Predictions of a sample, with ``cost_masks``, their masks at the lower
                resolution of matching. (N, h, w)
            gt_instances: Ground truth of the sample, with ``cost_masks`` (K, h, w), their masks at
                this resolution, and class indices ``labels`` (K,).
            img_meta: Meta dict of the sample, not used.

        Returns:
            The costs. (N, K)
        """
        # One weight for all, (), or a weight for each ground truth, (K,): both broadcast to (N, K).
        weights = class_weights(self.weight, gt_instances.labels)
        preds = pred_instances.cost_masks
        targets = gt_instances.cost_masks
        if self.kind == "dice":
            return weights * pairwise_dice_loss(preds, targets)
        return weights * (1 - pairwise_soft_iou(preds, targets))
