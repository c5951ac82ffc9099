"""Matching costs between predicted and annotated elements, read off ``InstanceData``."""

from typing import Any

import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData
from torch import Tensor


def order_distances(pts: Tensor, pts_shifts: Tensor) -> Tensor:
    """Return the summed L1 distance of every prediction to every order of every ground truth.

    Args:
        pts: Predicted points. (N, P, 2)
        pts_shifts: Equivalent orders of the annotated points, in the same units. (K, S, P, 2)

    Returns:
        Distances, summed over points and coordinates. (N, K, S)

    Raises:
        ValueError: If the numbers of points differ.
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
        weight: Factor of the cost.
    """

    reads = ("pred.pts", "gt.pts_shifts")

    def __init__(self, weight: float = 5.0) -> None:
        self.weight = weight

    def __call__(
        self,
        pred_instances: InstanceData,
        gt_instances: InstanceData,
        img_meta: dict[str, Any] | None = None,
    ) -> Tensor:
        """Compare normalised ``pts`` (N, P, 2) with ``pts_shifts`` (K, S, P, 2). (N, K)"""
        return order_distances(pred_instances.pts, gt_instances.pts_shifts).amin(-1) * self.weight
