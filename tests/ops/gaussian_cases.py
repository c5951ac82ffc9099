"""Gaussians that every backend is tested on, and the comparison with the float64 reference."""

import math

import torch

from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.grid import BEVGrid

ODD_GRID = BEVGrid((-15, 15), (-30, 30), 21, 33)


def random_gaussians(instances, count, low_m, high_m, grid=ODD_GRID, spread=1.0, seed=0):
    """Means over ``spread`` times the extent, scales log-uniform, rotations over several turns."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.tensor([sum(grid.x_range) / 2, sum(grid.y_range) / 2])
    means = torch.rand(instances, count, 2, generator=generator) - 0.5
    means = means * torch.tensor(grid.extent_m) * spread + centre
    ratio = math.log(high_m / low_m)
    scales = low_m * torch.exp(ratio * torch.rand(instances, count, 2, generator=generator))
    rotations = 20 * torch.rand(instances, count, generator=generator) - 10
    return means, scales, rotations


def on_pixel_centres(instances, count, grid=ODD_GRID):
    """Means at pixel centres, where the density is clamped and has no gradient."""
    centres = grid.pixel_centres().reshape(-1, 2)
    chosen = torch.arange(instances * count) * 17 % len(centres)
    _, scales, rotations = random_gaussians(instances, count, 0.5, 3, grid)
    return centres[chosen].reshape(instances, count, 2), scales, rotations


CASES = {
    "one": (random_gaussians(2, 1, 0.5, 3), ODD_GRID),
    "two": (random_gaussians(2, 2, 0.5, 3), ODD_GRID),
    "twenty": (random_gaussians(2, 20, 0.5, 3), ODD_GRID),
    "sixty-four": (random_gaussians(2, 64, 0.5, 3), ODD_GRID),
    "tiny": (random_gaussians(2, 20, 0.01, 0.3), ODD_GRID),
    "huge": (random_gaussians(2, 5, 20, 50), ODD_GRID),
    "thin": (random_gaussians(2, 5, 0.05, 20), ODD_GRID),
    "far off": (random_gaussians(2, 8, 0.3, 2, spread=5), ODD_GRID),
    "on pixel centres": (on_pixel_centres(2, 8), ODD_GRID),
    "other grid": (
        random_gaussians(2, 8, 0.2, 8, BEVGrid((0, 60), (-15, 15), 37, 70)),
        BEVGrid((0, 60), (-15, 15), 37, 70),
    ),
    "one pixel": (random_gaussians(2, 3, 0.5, 3), BEVGrid((-2, 2), (-2, 2), 1, 1)),
}


def render_with_gradients(gaussians, grid, backend, upstream, device="cpu"):
    """Return the masks and the gradients of ``sum(masks * upstream)`` in all three inputs."""
    leaves = [value.to(device, copy=True).requires_grad_() for value in gaussians]
    masks = render_gaussians(*leaves, grid, backend=backend)
    masks.backward(upstream.to(masks))
    return masks.detach().cpu(), [leaf.grad.cpu() for leaf in leaves]


def compare_with_reference(case, backend, device="cpu"):
    """Assert that a backend gives the masks and gradients of the float64 reference.

    A product of P factors in float32 errs by about P eps (64 * 6e-8), so atol is 1e-5; gradients
    are compared as whole tensors, by relative L2 and cosine.
    """
    gaussians, grid = CASES[case]
    upstream = torch.randn(
        len(gaussians[0]), grid.height, grid.width, generator=torch.Generator().manual_seed(1)
    )
    masks, grads = render_with_gradients(gaussians, grid, backend, upstream, device)
    exact = [value.double() for value in gaussians]
    true_masks, true_grads = render_with_gradients(exact, grid, "reference", upstream)
    torch.testing.assert_close(masks, true_masks.float(), atol=1e-5, rtol=0)
    for grad, true in zip(grads, true_grads, strict=True):
        norm = true.norm()
        assert norm > 0
        assert (grad - true).norm() < 1e-4 * norm
        assert torch.cosine_similarity(grad.double().flatten(), true.flatten(), 0) > 0.9999
