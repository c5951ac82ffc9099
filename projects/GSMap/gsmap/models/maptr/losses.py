"""Losses of MapTR: distances of points and directions of edges.

The base class `MapLoss` computes the weighted sum of ``values``, and divides it by the average
factor of the pairs.
"""

from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import MatchedPairs
from gsmap.models.base.parts import WeightConfig
from gsmap.structures.tensors import check_same_shape

_EPS = 1e-12  # added to squared lengths, so that an edge of length 0 has no infinite gradient


@MODELS.register_module()
class PointsLoss(MapLoss):
    """L1 distance of the points of matched pairs (MapTR Eq. 6, GSMap Eq. 11).

    Coordinates are in [0, 1] over the map.

    Args:
        loss_weight: Weight of the loss (lambda_v).
        flags: ``last_layer_only`` and ``first_group_only`` of `MapLoss`.
    """

    name = "pts"

    def __init__(self, loss_weight: WeightConfig = 5.0, **flags: bool) -> None:
        super().__init__(loss_weight=loss_weight, **flags)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Absolute difference of each coordinate of M matched pairs. (M, P, 2 or 3)"""
        check_same_shape(pred=pairs.pred_pts, target=pairs.gt_pts)
        return (pairs.pred_pts - pairs.gt_pts).abs()


@MODELS.register_module()
class DirectionLoss(MapLoss):
    """One minus the cosine between the edges of matched pairs (MapTR Eq. 7).

    Points are in metres, so x and y have equal weights. Closed shapes need no extra edge: their
    last point equals their first.

    Args:
        loss_weight: Weight of the loss.
        flags: ``last_layer_only`` and ``first_group_only`` of `MapLoss`.
    """

    name = "dir"

    def __init__(self, loss_weight: WeightConfig = 0.005, **flags: bool) -> None:
        super().__init__(loss_weight=loss_weight, **flags)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """One minus the cosine for each edge of M matched pairs. (M, P - 1)"""
        check_same_shape(pred=pairs.pred_pts_m, target=pairs.gt_pts_m)
        return turns(pairs.pred_pts_m.diff(dim=1), pairs.gt_pts_m.diff(dim=1))


def turns(first: Tensor, second: Tensor) -> Tensor:
    """One minus the cosine of the angle between edges.

    Args:
        first: Edge vectors. (M, E, 2 or 3)
        second: Edge vectors. (M, E, 2 or 3)

    Returns:
        Values in [0, 2]. (M, E)
    """
    first_squared = first.square().sum(-1) + _EPS
    second_squared = second.square().sum(-1) + _EPS
    lengths = (first_squared * second_squared).sqrt()
    return 1 - (first * second).sum(-1) / lengths
