"""Losses of matched points: where they are, and which way the edges between them run."""

import torch
from torch import Tensor, nn

_EPS = 1e-12


def check_same_shape(**both: Tensor) -> None:
    """Raise ValueError if two tensors differ in shape; their names are those in the message."""
    (of, first), (name, second) = both.items()
    if first.shape != second.shape:
        raise ValueError(
            f"{name} must have shape {tuple(first.shape)} of {of}, got {tuple(second.shape)}."
        )


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


class SamplingLocationLoss(PointsLoss):
    """The same of each point's mean sampling location, against the point itself (MGMapNet)."""

    name = "mean_loc"
    reads = ("pred.mean_locations", "gt.pts")

    def forward(self, pred: Tensor, target: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted loss in the plane. (M, P, 2), (M, P, 2 or 3) -> ()"""
        return super().forward(pred, target[..., :2], avg_factor)


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
        turns = _sum_of_turns(pred.diff(dim=1), target.diff(dim=1))
        return self.loss_weight * (turns / avg_factor)


class SelfDirectionLoss(nn.Module):
    """One minus the cosine between consecutive edges of a prediction (MapVR Eq. 4).

    It keeps predictions from folding back where nothing but their rendering is supervised. Both
    edges of a pair get a gradient; a ring's last edge and its first are no pair.

    Args:
        loss_weight: Weight of the loss.
    """

    name = "dir"
    reads = ("pred.pts_m",)

    def __init__(self, loss_weight: float = 0.002) -> None:
        super().__init__()
        self.loss_weight = loss_weight

    def forward(self, pred: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted sum over ``avg_factor`` of points in metres. (M, P, 2 or 3) -> ()"""
        # Differs from MapVR Eq. (4), which sums the cosines: their sign would reward folding.
        edges = pred.diff(dim=1)
        return self.loss_weight * (_sum_of_turns(edges[:, :-1], edges[:, 1:]) / avg_factor)


def _sum_of_turns(first: Tensor, second: Tensor) -> Tensor:
    """Return the sum of one minus the cosine between edges. (M, E, 2) each -> ()"""
    lengths = ((first.square().sum(-1) + _EPS) * (second.square().sum(-1) + _EPS)).sqrt()
    return torch.sum(1 - (first * second).sum(-1) / lengths)
