"""2D Gaussians as parts of map elements, and how a network's numbers become Gaussians."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid


@dataclass(frozen=True)
class Gaussians:
    """Ordered 2D Gaussians G = (mu, sigma, theta) (GSMap Eq. 1).

    Attributes:
        means: Centres mu in metres. (..., 2)
        scales: Standard deviations sigma along each Gaussian's own axes, in metres. (..., 2)
        rotations: Angle theta of the first axis from +x, in radians, anticlockwise. (...)
    """

    means: Tensor
    scales: Tensor
    rotations: Tensor


@dataclass(frozen=True)
class GaussianSpace:
    r"""How a decoder's reference of five numbers stands for a Gaussian.

    The first two are the centre, [0, 1] over the map; two stand for sigma and one for theta, all
    three zero for the Gaussian that a query starts with:
    :math:`\sigma = \sigma_{min} + (\sigma_{max} - \sigma_{min})\,\mathrm{sigmoid}(s + s_0)`, theta
    as it is. The first Gaussian is longer along y than along x (or the other way round), because a
    round one has no direction, and so no gradient in theta.

    Args:
        grid: The map's extent; its raster is not used.
        min_scale_m: Smallest sigma in metres. Half a pixel of the training raster: a smaller
            Gaussian falls between pixels and gets no gradient.
        max_scale_m: Largest sigma in metres.
        init_scales_m: Sigma of the Gaussian that a query starts with, along x and y, in metres.

    Raises:
        ValueError: If not min < init < max for both axes.
    """

    grid: BEVGrid
    min_scale_m: float = 0.15
    max_scale_m: float = 5.0
    init_scales_m: tuple[float, float] = (0.4, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "init_scales_m", tuple(float(s) for s in self.init_scales_m))
        if not all(0 < self.min_scale_m < s < self.max_scale_m for s in self.init_scales_m):
            raise ValueError(
                "0 < min_scale_m < init_scales_m < max_scale_m must hold, got "
                f"{self.min_scale_m}, {self.init_scales_m}, {self.max_scale_m}."
            )

    def decode(self, reference: Tensor) -> Gaussians:
        """Return the Gaussians that a reference stands for, in float32 at least.

        Args:
            reference: Centre in [0, 1], sigma and theta before their activation. (..., 5)

        Returns:
            The Gaussians, differentiable in ``reference``. (...)

        Raises:
            ValueError: If the last axis does not hold five numbers.
        """
        if reference.shape[-1] != 5:
            raise ValueError(f"reference must have shape (..., 5), got {tuple(reference.shape)}.")
        reference = reference.to(torch.promote_types(reference.dtype, torch.float32))
        means = self.grid.metres_from_norm(reference[..., :2])
        return Gaussians(means, self.scales(reference[..., 2:4]), reference[..., 4])

    def scales(self, raw: Tensor) -> Tensor:
        """Activate sigma: zero gives ``init_scales_m``. (..., 2) -> (..., 2) metres"""
        span = self.max_scale_m - self.min_scale_m
        start = [
            math.log((s - self.min_scale_m) / (self.max_scale_m - s)) for s in self.init_scales_m
        ]
        return self.min_scale_m + span * (raw + raw.new_tensor(start)).sigmoid()

    def frames(self, reference: Tensor) -> Tensor:
        r"""Return what turns an offset into the Gaussian's own frame, the identity at the start.

        The matrix is :math:`R(\theta)\,\mathrm{diag}(\sigma / \sigma_{init})`: a Gaussian that is
        twice as long as the one that every query starts with looks twice as far along that axis.

        Args:
            reference: As in :meth:`decode`. (..., 5)

        Returns:
            Matrices that multiply (x, y) in metres from the left. (..., 2, 2)
        """
        gaussians = self.decode(reference)
        stretch = gaussians.scales / self.scales(gaussians.scales.new_zeros(2))
        cos, sin = gaussians.rotations.cos(), gaussians.rotations.sin()
        rotation = torch.stack([cos, -sin, sin, cos], -1).unflatten(-1, (2, 2))  # GSMap Eq. 4
        return rotation * stretch[..., None, :]

    def describe(self, reference: Tensor) -> Tensor:
        """Return numbers of unit size that describe the Gaussians, for an embedding.

        The angle enters as cosine and sine of 2 theta: a Gaussian turned by half a circle is the
        same.

        Args:
            reference: As in :meth:`decode`. (..., 5)

        Returns:
            mu in [-1, 1], sigma before its activation, cos and sin of 2 theta. (..., 6)
        """
        centre, raw_scales, theta = reference.split([2, 2, 1], -1)
        return torch.cat([2 * centre - 1, raw_scales, (2 * theta).cos(), (2 * theta).sin()], -1)
