"""Edge direction loss."""

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
    lengths = ((pred_edges.square().sum(-1) + _EPS) * (target_edges.square().sum(-1) + _EPS)).sqrt()
    return torch.sum(1 - (pred_edges * target_edges).sum(-1) / lengths) / avg_factor


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
