"""Renderer of 2D Gaussians in plain torch, in any floating-point type."""

import math

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid

MAX_DENSITY = 1 - 1e-6  # keeps log1p finite at the centre of a Gaussian
CUT = 1e-8  # fused kernels may leave out a Gaussian where its density is lower
SQUARED_REACH = -2 * math.log(CUT)  # squared Mahalanobis distance at which the density is CUT


def gaussian_densities(means: Tensor, scales: Tensor, rotations: Tensor, grid: BEVGrid) -> Tensor:
    r"""Evaluate each Gaussian at each pixel centre.

    :math:`G(p) = \exp(-\frac12 (p - \mu)^T \Sigma^{-1} (p - \mu))` (GSMap Eq. 2) with
    :math:`\Sigma = R\,\mathrm{diag}(\sigma^2)\,R^T`.

    Args:
        means: Centres in metres, in the frame of ``grid``. (..., P, 2)
        scales: Standard deviations along the axes of each Gaussian, in metres, > 0. (..., P, 2)
        rotations: Angle of the first axis from +x, in radians, anticlockwise. (..., P)
        grid: Extent of the raster in metres and its size in pixels, H rows and W columns.

    Returns:
        Densities in [0, 1]. (..., P, H, W)
    """
    pixels = grid.pixel_centres(means.device, means.dtype)  # (H, W, 2)
    offsets = pixels - means[..., None, None, :]  # (..., P, H, W, 2)
    cos = torch.cos(rotations)[..., None, None]
    sin = torch.sin(rotations)[..., None, None]
    # Differs from GSMap Eq. (3): S = diag(sigma), so that sigma is a standard deviation in metres.
    along = (cos * offsets[..., 0] + sin * offsets[..., 1]) / scales[..., 0, None, None]
    across = (cos * offsets[..., 1] - sin * offsets[..., 0]) / scales[..., 1, None, None]
    return torch.exp(-0.5 * (along.square() + across.square()))


def render_gaussians_reference(
    means: Tensor, scales: Tensor, rotations: Tensor, grid: BEVGrid
) -> Tensor:
    r"""Render :math:`1 - \prod_i (1 - G_i(p))` (GSMap Eq. 6) as ``-expm1(sum log1p(-G))``.

    The product runs over the P Gaussians of an element. The sum of logarithms is more exact where
    all densities are small.

    Args:
        means: Centres in metres, in the frame of ``grid``. (..., P, 2)
        scales: Standard deviations along the axes of each Gaussian, in metres, > 0. (..., P, 2)
        rotations: Angle of the first axis from +x, in radians, anticlockwise. (..., P)
        grid: Extent of the raster in metres and its size in pixels, H rows and W columns.

    Returns:
        Occupancy in [0, 1]. (..., H, W)
    """
    densities = gaussian_densities(means, scales, rotations=rotations, grid=grid)
    densities = densities.clamp(max=MAX_DENSITY)
    return -torch.expm1(torch.log1p(-densities).sum(-3))  # the sum is over the P Gaussians
