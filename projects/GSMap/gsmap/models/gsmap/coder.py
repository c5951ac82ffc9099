"""Selection of detections that have Gaussians, with a preference for small sigmas."""

from typing import Any

from torch import Tensor

from gsmap.models.base.coder import MapCoder, Tensors
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


class GaussianCoder(MapCoder):
    """Coder of the detections of a head with Gaussians.

    Args:
        grid: Extent of the map.
        sigma_power: Exponent >= 0. The odds of a score are divided by sigma to this power, where
            sigma is the geometric mean over the points of the element of each point's smaller
            sigma, in metres.
        kwargs: Further arguments of `MapCoder`.

    Raises:
        ValueError: If the power is negative.
    """

    def __init__(self, grid: BEVGrid, *, sigma_power: float = 0.0, **kwargs: Any) -> None:
        super().__init__(grid, **kwargs)
        if not sigma_power >= 0:
            raise InputError(f"sigma_power must be >= 0, got {sigma_power}.")
        self.sigma_power = sigma_power

    def weigh_scores(self, scores: Tensor, fields: Tensors) -> Tensor:
        """Add the preference for small sigmas to class logits.

        Args:
            scores: Class logits. (N, classes)
            fields: Decoded references, with ``scales``, sigmas in metres (N, P, 2).

        Returns:
            Class logits. (N, classes)
        """
        if not self.sigma_power:
            return scores
        log_sigma = fields["scales"].amin(-1).log().mean(-1, keepdim=True)  # (N, 1)
        return scores.float() - self.sigma_power * log_sigma
