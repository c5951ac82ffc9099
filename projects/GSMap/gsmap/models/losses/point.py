"""Point regression loss."""

from torch import Tensor


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
