"""StreamMapNet's smooth L1 distance of lines, as a loss and as a matching cost."""

from typing import Any

import torch.nn.functional as F
from mmdet3d.registry import MODELS, TASK_UTILS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import MatchedPairs, SampleView
from gsmap.models.base.parts import class_weights
from gsmap.models.maptr.cost import OrderedPointsCost
from gsmap.structures.tensors import check_same_shape


@MODELS.register_module()
class SmoothPointsLoss(MapLoss):
    """Smooth L1 distance of matched pairs, averaged over the P points of a pair (StreamMapNet).

    Args:
        loss_weight: Weight of the loss.
        beta: Distance in [0, 1] over the map below which the loss is quadratic, > 0.
        flags: Flags ``last_layer_only`` and ``first_group_only`` of `MapLoss`, which restrict the
            loss to the last decoder layer or to the first query group.
    """

    name = "pts"

    def __init__(self, loss_weight: float = 50.0, beta: float = 0.01, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)
        self.beta = beta

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Compute the distance of each coordinate, divided by P. (M, P, 2 or 3)

        `MapLoss` sums and weights the distances. The targets are in the point order of the match.
        """
        pred = pairs.pred_pts
        target = pairs.gt_pts
        check_same_shape(pred=pred, target=target)  # other shapes could broadcast
        return F.smooth_l1_loss(pred, target, reduction="none", beta=self.beta) / pred.shape[1]


@TASK_UTILS.register_module()
class SmoothPointsCost(OrderedPointsCost):
    """Smooth L1 distance to the closest equivalent point order, divided by the number of points.

    Equivalent orders describe one element, such as both directions of a line. The distance also
    determines the point order of matched pairs.

    Args:
        weight: Weight of the cost.
        beta: Distance in [0, 1] over the map below which the cost is quadratic, > 0.
    """

    def __init__(self, weight: float = 50.0, beta: float = 0.01) -> None:
        super().__init__(weight)
        self.beta = beta

    def between_points(self, pts: Tensor, targets: Tensor) -> Tensor:
        """Compute the distance of each coordinate between two lists of points.

        The base class calls it to select the point order of matched pairs.

        Args:
            pts: Normalised points. (..., P, 2 or 3)
            targets: Normalised points. (..., P, 2 or 3)

        Returns:
            Distances. (..., P, 2 or 3)
        """
        return F.smooth_l1_loss(pts, targets, reduction="none", beta=self.beta)

    def __call__(
        self, pred_instances: SampleView, gt_instances: SampleView, img_meta: Any = None
    ) -> Tensor:
        """Compute the costs of all pairs.

        Args:
            pred_instances: Predictions with normalised ``pts``. (N, P, 2)
            gt_instances: Ground truth with ``pts_shifts``, S equivalent orders (K, S, P, 2), and
                ``labels`` (K,).
            img_meta: Metadata of the sample; unused.

        Returns:
            Weighted costs. (N, K)
        """
        orders = gt_instances.pts_shifts
        pts = pred_instances.pts[:, None, None]  # (N, 1, 1, P, 2)
        pts = pts.expand((len(pts), *orders.shape))  # (N, K, S, P, 2)
        distances = self.between_points(pts, orders.expand_as(pts)).sum(dim=(-1, -2))
        closest = distances.amin(dim=-1) / pts.shape[-2]  # (N, K)
        return closest * class_weights(self.weight, gt_instances.labels)
