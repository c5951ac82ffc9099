"""Edge direction losses: against the ground truth (MapTR), and of a line with itself (MapVR)."""

import torch
from torch import Tensor, nn

_EPS = 1e-12


def direction_loss(
    pred: Tensor, target: Tensor, avg_factor: float | Tensor, interval: int = 1
) -> Tensor:
    """Return the sum of one minus the cosine between edges, over ``avg_factor`` (MapTR Eq. 7).

    Closed shapes need no extra edge: their last point is their first.

    Args:
        pred: Points of matched predictions in metres, so that x and y weigh the same. (M, P, 2)
        target: Points of their ground truth in metres, in the same order. (M, P, 2)
        avg_factor: The divisor: the number of matched elements, at least 1.
        interval: An edge joins points ``interval`` apart.

    Returns:
        The loss; zero without matches. ()

    Raises:
        ValueError: If the shapes disagree or ``interval`` is not in [1, P).
    """
    if pred.shape != target.shape:
        raise ValueError(
            f"target must have shape {tuple(pred.shape)} of pred, got {tuple(target.shape)}."
        )
    if not 1 <= interval < pred.shape[-2]:
        raise ValueError(f"interval must be in [1, {pred.shape[-2]}), got {interval}.")
    pred_edges = pred[:, interval:] - pred[:, :-interval]
    target_edges = target[:, interval:] - target[:, :-interval]
    return _sum_of_turns(pred_edges, target_edges) / avg_factor


def self_direction_loss(pred: Tensor, avg_factor: float | Tensor) -> Tensor:
    """Return the sum of one minus the cosine between consecutive edges, over ``avg_factor``.

    It keeps predictions from folding back where nothing but their rendering is supervised. Both
    edges of a pair get a gradient; a ring's last edge and its first are no pair.

    Args:
        pred: Points of matched predictions in metres, so that x and y weigh the same. (M, P, 2)
        avg_factor: The divisor: the number of matched elements, at least 1.

    Returns:
        The loss; zero without matches or with less than three points. ()
    """
    # Differs from MapVR Eq. (4), which sums the cosines: their sign would reward folding.
    edges = pred.diff(dim=1)
    return _sum_of_turns(edges[:, :-1], edges[:, 1:]) / avg_factor


def _sum_of_turns(first: Tensor, second: Tensor) -> Tensor:
    """Return the sum of one minus the cosine between edges. (M, E, 2) each -> ()"""
    lengths = ((first.square().sum(-1) + _EPS) * (second.square().sum(-1) + _EPS)).sqrt()
    return torch.sum(1 - (first * second).sum(-1) / lengths)


class DirectionLoss(nn.Module):
    """Direction of the edges of matched pairs against the ground truth's (MapTR Eq. 7).

    Args:
        loss_weight: Weight of the loss.
    """

    name = "dir"
    reads = ("pred.pts_m", "gt.pts_m")

    def __init__(self, loss_weight: float = 0.005) -> None:
        super().__init__()
        self.loss_weight = loss_weight

    def forward(self, preds: Tensor, targets: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted loss of points in metres. 2 x (M, P, 2) -> ()"""
        return self.loss_weight * direction_loss(preds, targets, avg_factor)


class SelfDirectionLoss(nn.Module):
    """Direction of a prediction's consecutive edges, without ground truth (MapVR Eq. 4).

    Args:
        loss_weight: Weight of the loss.
    """

    name = "dir"
    reads = ("pred.pts_m",)

    def __init__(self, loss_weight: float = 0.002) -> None:
        super().__init__()
        self.loss_weight = loss_weight

    def forward(self, preds: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted loss of points in metres. (M, P, 2) -> ()"""
        return self.loss_weight * self_direction_loss(preds, avg_factor)
