"""Matching costs between predicted and annotated elements, read off ``InstanceData``."""

from typing import Any

import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.losses.dice import ElementRenderer, pairwise_dice_loss
from gsmap.ops.soft_iou import pairwise_soft_iou


def order_distances(pts: Tensor, pts_shifts: Tensor) -> Tensor:
    """Return the summed L1 distance of every prediction to every order of every ground truth.

    ValueError if the numbers of points differ. (N, P, 2), (K, S, P, 2) -> (N, K, S)
    """
    if pts.shape[-2:] != pts_shifts.shape[-2:]:
        raise ValueError(
            f"predictions of {tuple(pts.shape[-2:])} points and ground truth of "
            f"{tuple(pts_shifts.shape[-2:])} do not fit: set the same number of points in the head "
            "and in the pipeline."
        )
    num_gts, num_orders = pts_shifts.shape[:2]
    distances = torch.cdist(pts.flatten(1), pts_shifts.flatten(0, 1).flatten(1), p=1)
    return distances.view(len(pts), num_gts, num_orders)


@TASK_UTILS.register_module()
class OrderedPointsCost:
    """L1 distance to the closest equivalent point order (MapTR Eq. 5).

    Args:
        weight: Weight of the cost.
    """

    reads = ("pred.pts", "gt.pts_shifts")

    def __init__(self, weight: float = 5.0) -> None:
        self.weight = weight

    def __call__(
        self, pred_instances: InstanceData, gt_instances: InstanceData, img_meta: Any = None
    ) -> Tensor:
        """Compare normalised ``pts`` (N, P, 2) with ``pts_shifts`` (K, S, P, 2). (N, K)"""
        return order_distances(pred_instances.pts, gt_instances.pts_shifts).amin(-1) * self.weight


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


@TASK_UTILS.register_module()
class RenderedDiceCost:
    """Dice loss of softly rendered points, each pair rendered as the ground truth's class (MapVR).

    Args:
        weight: Weight of the cost.
        size: Rows H and columns W of the rasters.
        rendering: Further settings of `ElementRenderer`.
    """

    reads = ("pred.pts", "gt.first_pts", "gt.labels")

    def __init__(
        self, weight: float = 10.0, size: tuple[int, int] = (128, 64), **rendering: Any
    ) -> None:
        self.weight = weight
        self.renderer = ElementRenderer(size, **rendering)

    def __call__(
        self, pred_instances: InstanceData, gt_instances: InstanceData, img_meta: Any = None
    ) -> Tensor:
        """Compare ``pts`` (N, P, 2) with ``first_pts`` (K, P, 2) of ``labels`` (K,). (N, K)"""
        preds, is_polygon = pred_instances.pts, self.renderer.is_polygon(gt_instances.labels)
        targets = self.renderer.render(gt_instances.first_pts, is_polygon)
        lines = torch.zeros(len(preds), dtype=torch.bool, device=preds.device)
        as_lines = pairwise_dice_loss(self.renderer.render(preds, lines), targets)
        as_polygons = pairwise_dice_loss(self.renderer.render(preds, ~lines), targets)
        return self.weight * torch.where(is_polygon, as_polygons, as_lines)
