"""Losses of matched points: where they are, and which way the edges between them run."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.structures.tensors import check_same_shape

_EPS = 1e-12


@MODELS.register_module()
class PointsLoss(nn.Module):
    """L1 distance of the points of matched pairs (MapTR Eq. 6, GSMap Eq. 11).

    Args:
        loss_weight: Weight of the loss (lambda_v).
    """

    name = "pts"
    reads: tuple[str, ...] = ("pred.pts", "gt.pts")

    def __init__(self, loss_weight: float = 5.0) -> None:
        super().__init__()
        self.loss_weight = loss_weight

    def forward(self, pred: Tensor, target: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted sum over ``avg_factor``, of normalised points in the same order.

        ValueError if the shapes disagree. 2 x (M, P, 2 or 3) -> ()
        """
        check_same_shape(pred=pred, target=target)
        return self.loss_weight * ((pred - target).abs().sum() / avg_factor)


@MODELS.register_module()
class DirectionLoss(PointsLoss):
    """One minus the cosine between the edges of matched pairs (MapTR Eq. 7).

    Closed shapes need no extra edge: their last point is their first.

    Args:
        loss_weight: Weight of the loss.
    """

    name = "dir"
    reads = ("pred.pts_m", "gt.pts_m")

    def __init__(self, loss_weight: float = 0.005) -> None:
        super().__init__(loss_weight)

    def forward(self, pred: Tensor, target: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted sum of points in metres: x and y weigh the same. As `PointsLoss`."""
        check_same_shape(pred=pred, target=target)
        turns = sum_of_turns(pred.diff(dim=1), target.diff(dim=1))
        return self.loss_weight * (turns / avg_factor)


def sum_of_turns(first: Tensor, second: Tensor) -> Tensor:
    """Return the sum of one minus the cosine between edges. (M, E, 2) each -> ()"""
    lengths = ((first.square().sum(-1) + _EPS) * (second.square().sum(-1) + _EPS)).sqrt()
    return torch.sum(1 - (first * second).sum(-1) / lengths)
