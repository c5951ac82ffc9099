"""Selection of detections that have Gaussians, with a preference for small sigmas."""

from typing import Any

from torch import Tensor

from gsmap.models.base.coder import MapCoder, Tensors
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


class GaussianCoder(MapCoder):
    """Coder of the detections of a head with Gaussians, one for each point of an element.

    `MapCoder` selects the detections with the highest scores. Here, scores are first raised for
    elements whose points are sharp, and lowered for blurred ones.

    Args:
        grid: Extent of the map.
        sigma_power: Exponent >= 0; 0 leaves the scores unchanged. The odds of a score are divided
            by sigma to this power. The Gaussian of each point has two sigmas, in metres, of which
            the smaller one is used. Sigma is the geometric mean of these values over the element.
        kwargs: Further arguments of `MapCoder`.

    Raises:
        ValueError: If the power is negative.
    """

    def __init__(self, grid: BEVGrid, *, sigma_power: float = 0.0, **kwargs: Any) -> None:
        super().__init__(grid, **kwargs)
        if not sigma_power >= 0:
            raise InputError(f"sigma_power must be >= 0, got {sigma_power}.")
        self.sigma_power = sigma_power

    @property
    def weighs_scores(self) -> bool:
        """Whether `weigh_scores` changes scores."""
        return self.sigma_power > 0

    def weigh_scores(self, scores: Tensor, fields: Tensors) -> Tensor:
        """Add the preference for small sigmas to class logits, before detections are selected.

        Args:
            scores: Class logits. (N, classes)
            fields: Decoded references, with ``scales``, sigmas in metres (N, P, 2).

        Returns:
            Class logits. (N, classes)
        """
        if not self.sigma_power:
            return scores
        # The logit is the logarithm of the odds, so a division of the odds is a difference here.
        # The mean of logarithms is the logarithm of the geometric mean.
        log_sigma = fields["scales"].amin(-1).log().mean(-1, keepdim=True)  # (N, 1)
        return scores.float() - self.sigma_power * log_sigma
