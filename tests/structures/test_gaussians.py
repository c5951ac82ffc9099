import math

import pytest
import torch

from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid

SPACE = GaussianSpace(
    BEVGrid((-15, 15), (-30, 30), 1, 1), min_scale_m=0.15, max_scale_m=5.0, init_scales_m=(0.4, 1.0)
)


def test_zeros_stand_for_the_first_gaussian():
    gaussians = SPACE.decode(torch.tensor([[0.5, 0.75, 0.0, 0.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(gaussians.means, torch.tensor([[0.0, 15.0]], dtype=torch.float64))
    torch.testing.assert_close(gaussians.scales, torch.tensor([[0.4, 1.0]], dtype=torch.float64))
    torch.testing.assert_close(gaussians.rotations, torch.zeros(1, dtype=torch.float64))


def test_scales_stay_between_their_bounds_and_grow_with_the_raw_value():
    scales = SPACE.scales(torch.linspace(-30, 30, 101)[:, None].expand(-1, 2))
    assert (scales >= 0.15).all()
    assert (scales <= 5.0).all()
    assert (scales.diff(dim=0) >= 0).all()
    torch.testing.assert_close(scales[[0, -1], 0], torch.tensor([0.15, 5.0]))


def test_half_precision_is_decoded_in_float32():
    gaussians = SPACE.decode(torch.zeros(2, 20, 5, dtype=torch.float16))
    assert gaussians.means.dtype == gaussians.scales.dtype == torch.float32


def test_the_first_frame_is_exactly_the_identity():
    frames = SPACE.frames(torch.rand(3, 7, 5) * torch.tensor([1.0, 1, 0, 0, 0]))
    assert torch.equal(frames, torch.eye(2).expand(3, 7, 2, 2))


def test_a_frame_stretches_along_the_gaussians_axes_and_then_turns():
    """A Gaussian twice as long along its second axis, turned by 90 degrees anticlockwise.

    ::

          y                 y
          |  (0, 1)         |
          |  goes to   ---> |
          +----- x    (-2, 0) ----+----- x
    """
    target = (2.0 - 0.15) / (5.0 - 0.15)
    start = (1.0 - 0.15) / (5.0 - 0.15)
    long = math.log(target / (1 - target)) - math.log(start / (1 - start))
    reference = torch.tensor([0.5, 0.5, 0.0, long, math.pi / 2])
    moved = SPACE.frames(reference) @ torch.tensor([0.0, 1.0])
    torch.testing.assert_close(moved, torch.tensor([-2.0, 0.0]), atol=1e-6, rtol=0)


def test_a_gaussian_turned_by_half_a_circle_is_described_alike():
    reference = torch.tensor([0.3, 0.6, 0.2, -0.1, 0.4])
    turned = reference + torch.tensor([0, 0, 0, 0, math.pi])
    torch.testing.assert_close(SPACE.describe(reference), SPACE.describe(turned))
    torch.testing.assert_close(SPACE.describe(reference)[:2], torch.tensor([-0.4, 0.2]))


def test_decoding_and_frames_have_the_gradients_of_their_values():
    reference = torch.rand(2, 3, 5, dtype=torch.float64, requires_grad=True)

    def everything(values):
        gaussians = SPACE.decode(values)
        parts = (gaussians.means, gaussians.scales, gaussians.rotations[..., None])
        return torch.cat([*parts, SPACE.frames(values).flatten(-2), SPACE.describe(values)], -1)

    assert torch.autograd.gradcheck(everything, (reference,))


@pytest.mark.parametrize(
    "settings",
    [{"min_scale_m": 0.5}, {"max_scale_m": 0.9}, {"min_scale_m": 0.0}],
)
def test_impossible_scales_are_refused(settings):
    with pytest.raises(ValueError, match="min_scale_m < init_scales_m < max_scale_m"):
        GaussianSpace(SPACE.grid, **settings)


def test_a_reference_of_points_is_refused():
    with pytest.raises(ValueError, match=r"reference must have shape \(\.\.\., 5\), got \(4, 2\)"):
        SPACE.decode(torch.zeros(4, 2))
