"""Detections of Gaussians: what is sure of its place counts more."""

from typing import Any

from torch import Tensor

from gsmap.models.base.coder import MapCoder, Tensors
from gsmap.utils.errors import InputError


class GaussianCoder(MapCoder):
    """The coder of a head with Gaussians. Besides `MapCoder`'s arguments:

    Args:
        sigma_power: The odds of a score are divided by the smaller sigma, in metres (geometric mean
            of the points), to this power, >= 0.
        kwargs: Arguments of `MapCoder`.

    Raises:
        ValueError: If the power is negative.
    """

    def __init__(self, *args: Any, sigma_power: float = 0.0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if not sigma_power >= 0:
            raise InputError(f"sigma_power must be >= 0, got {sigma_power}.")
        self.sigma_power = sigma_power

    def weigh_scores(self, scores: Tensor, fields: Tensors) -> Tensor:
        """Weigh class logits (N, classes) by ``scales``, sigmas in metres (N, P, 2), if wanted."""
        if not self.sigma_power:
            return scores
        sigma = fields["scales"].amin(-1).log().mean(-1, keepdim=True)
        return scores.float() - self.sigma_power * sigma
