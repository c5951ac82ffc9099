"""Matching cost of points in MapTR."""

from typing import Any

import torch
from mmdet3d.registry import TASK_UTILS
from torch import Tensor

from gsmap.models.base.matching import PointsCost
from gsmap.models.base.pairs import SampleView
from gsmap.models.base.parts import WeightConfig, class_weights
from gsmap.utils.errors import InputError


def order_distances(pts: Tensor, pts_shifts: Tensor) -> Tensor:
    """L1 distance of every prediction to every equivalent point order of every ground truth.

    Args:
        pts: Normalised points of the predictions. (N, P, 2 or 3)
        pts_shifts: Normalised points of the ground truths, in S equivalent orders: an element is
            unchanged if its points are reversed, or if the points of a ring are rotated.
            (K, S, P, 2 or 3)

    Returns:
        Distances, summed over points and coordinates. (N, K, S)

    Raises:
        ValueError: If the numbers of points differ.
    """
    if pts.shape[-2:] != pts_shifts.shape[-2:]:
        raise InputError(
            f"predictions of {tuple(pts.shape[-2:])} points and ground truth of "
            f"{tuple(pts_shifts.shape[-2:])} do not fit: set the same number of points in the head "
            "and in the pipeline."
        )
    num_gts, num_orders = pts_shifts.shape[:2]
    # Distances between vectors with all coordinates of an element. (N, K * S)
    distances = torch.cdist(pts.flatten(1), pts_shifts.flatten(0, 1).flatten(1), p=1)
    return distances.view(len(pts), num_gts, num_orders)


@TASK_UTILS.register_module()
class OrderedPointsCost(PointsCost):
    """L1 distance to the closest equivalent point order (MapTR Eq. 5).

    As a `PointsCost`, it also selects the point order with which losses compare a matched pair.

    Args:
        weight: Weight of the cost, or a weight for each class.
    """

    def __init__(self, weight: WeightConfig = 5.0) -> None:
        super().__init__(weight=weight)

    def __call__(
        self, pred_instances: SampleView, gt_instances: SampleView, img_meta: Any = None
    ) -> Tensor:
        """Weighted distances between predictions and ground truths, in normalised coordinates.

        Args:
            pred_instances: Predictions with normalised ``pts`` (N, P, 2).
            gt_instances: Ground truths with ``pts_shifts`` (K, S, P, 2) and ``labels`` (K,).
            img_meta: Meta dict of the sample, not used. All matching costs have this argument.

        Returns:
            The costs. (N, K)
        """
        distances = order_distances(pred_instances.pts, gt_instances.pts_shifts).amin(-1)
        return distances * class_weights(self.weight, gt_instances.labels)
