"""StreamMapNet's distance of lines: smooth L1, per point, as a loss and as a matching cost."""

from typing import Any

import torch.nn.functional as F
from mmdet3d.registry import MODELS, TASK_UTILS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import MatchedPairs, SampleView
from gsmap.models.base.parts import weights_of
from gsmap.models.maptr.cost import OrderedPointsCost
from gsmap.structures.tensors import check_same_shape


@MODELS.register_module()
class SmoothPointsLoss(MapLoss):
    """Smooth L1 distance of the points of matched pairs, over their number P (StreamMapNet).

    Args:
        loss_weight: Weight of the loss.
        beta: Distance, [0, 1] over the map, below which it is a parabola.
        flags: As in `MapLoss`.
    """

    name = "pts"

    def __init__(self, loss_weight: float = 50.0, beta: float = 0.01, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)
        self.beta = beta

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Return the distance of each coordinate, over P. (M, P, 2 or 3)"""
        pred, target = pairs.pred_pts, pairs.gt_pts
        check_same_shape(pred=pred, target=target)
        return F.smooth_l1_loss(pred, target, reduction="none", beta=self.beta) / pred.shape[1]


@TASK_UTILS.register_module()
class SmoothPointsCost(OrderedPointsCost):
    """Smooth L1 distance to the closest equivalent point order, over P; it chooses that order.

    Args:
        weight: Weight of the cost.
        beta: As of `SmoothPointsLoss`.
    """

    def __init__(self, weight: float = 50.0, beta: float = 0.01) -> None:
        super().__init__(weight)
        self.beta = beta

    def between_points(self, pts: Tensor, targets: Tensor) -> Tensor:
        """Return the distance of each coordinate, which also chooses the order of a pair."""
        return F.smooth_l1_loss(pts, targets, reduction="none", beta=self.beta)

    def __call__(
        self, pred_instances: SampleView, gt_instances: SampleView, img_meta: Any = None
    ) -> Tensor:
        """Compare normalised ``pts`` (N, P, 2) with ``pts_shifts`` (K, S, P, 2). (N, K)"""
        orders = gt_instances.pts_shifts
        pts = pred_instances.pts[:, None, None].expand(-1, *orders.shape)  # (N, K, S, P, 2)
        distances = self.between_points(pts, orders.expand_as(pts)).sum((-1, -2))
        return distances.amin(-1) / pts.shape[-2] * weights_of(self.weight, gt_instances.labels)
