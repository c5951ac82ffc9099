"""Point regression loss."""

from torch import Tensor, nn


def points_l1_loss(pred: Tensor, target: Tensor, avg_factor: float | Tensor) -> Tensor:
    """Return the summed L1 distance between points over ``avg_factor`` (MapTR Eq. 6).

    Args:
        pred: Points of matched predictions. (M, P, 2)
        target: Points of their ground truth, in the same units and order. (M, P, 2)
        avg_factor: The divisor: the number of matched elements, at least 1.

    Returns:
        The loss; zero without matches. ()

    Raises:
        ValueError: If the shapes disagree.
    """
    if pred.shape != target.shape:
        raise ValueError(
            f"target must have shape {tuple(pred.shape)} of pred, got {tuple(target.shape)}."
        )
    return (pred - target).abs().sum() / avg_factor


class PointsLoss(nn.Module):
    """L1 loss of the points of matched pairs (MapTR Eq. 6, GSMap Eq. 11).

    Args:
        loss_weight: Weight of the loss: GSMap's lambda_v.
    """

    name = "pts"
    reads = ("pred.pts", "gt.pts")

    def __init__(self, loss_weight: float = 5.0) -> None:
        super().__init__()
        self.loss_weight = loss_weight

    def forward(self, preds: Tensor, targets: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted loss of normalised points. 2 x (M, P, 2) -> ()"""
        return self.loss_weight * points_l1_loss(preds, targets, avg_factor)


class SamplingLocationLoss(PointsLoss):
    """L1 loss of each point's mean sampling location, against the point itself (MGMapNet).

    Args:
        loss_weight: Weight of the loss.
    """

    name = "mean_loc"
    reads = ("pred.mean_locations", "gt.pts")

    def forward(self, preds: Tensor, targets: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted loss in the plane. (M, P, 2), (M, P, 2 or 3) -> ()"""
        return super().forward(preds, targets[..., :2], avg_factor)
