import math

import pytest
import torch

from gsmap.structures.gaussians import (
    Gaussians,
    GaussianSpace,
    extents_along_line,
    gaussians_along,
    line_errors,
    stretch_along_line,
)
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-15, 15), (-30, 30))  # y points forward
SPACE = GaussianSpace(GRID, min_scale_m=0.15, max_scale_m=5.0, init_scales_m=(1.0, 0.4))
FORWARD_X = BEVGrid((-30, 30), (-15, 15))


def test_zeros_stand_for_the_first_gaussian():
    gaussians = SPACE.decode(torch.tensor([[0.5, 0.75, 0.0, 0.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(gaussians.means, torch.tensor([[0.0, 15.0]], dtype=torch.float64))
    torch.testing.assert_close(gaussians.scales, torch.tensor([[1.0, 0.4]], dtype=torch.float64))
    along_y = torch.full((1,), math.pi / 2, dtype=torch.float64)
    torch.testing.assert_close(gaussians.rotations, along_y)
    along_x = GaussianSpace(FORWARD_X).decode(torch.zeros(1, 5)).rotations
    torch.testing.assert_close(along_x, torch.zeros(1))


def test_scales_stay_between_their_bounds_and_grow_with_the_raw_value():
    scales = SPACE.scales(torch.linspace(-30, 30, 101)[:, None].expand(-1, 2))
    assert (scales >= 0.15).all()
    assert (scales <= 5.0).all()
    assert (scales.diff(dim=0) >= 0).all()
    torch.testing.assert_close(scales[[0, -1], 0], torch.tensor([0.15, 5.0]))


def test_half_precision_is_decoded_in_float32():
    gaussians = SPACE.decode(torch.zeros(2, 20, 5, dtype=torch.float16))
    assert gaussians.means.dtype == gaussians.scales.dtype == torch.float32


@pytest.mark.parametrize("grid", [GRID, FORWARD_X], ids=["forward y", "forward x"])
@pytest.mark.parametrize("invariant", [False, True])
@pytest.mark.parametrize("literal", [False, True])
def test_the_first_frame_is_exactly_the_identity(grid, invariant, literal):
    space = GaussianSpace(grid, literal_covariance=literal)
    frames = space.frames(torch.rand(3, 7, 5) * torch.tensor([1.0, 1, 0, 0, 0]), invariant)
    assert torch.equal(frames, torch.eye(2).expand(3, 7, 2, 2))


def test_the_invariant_frame_is_the_same_for_a_gaussian_turned_by_half_a_circle():
    reference = torch.tensor([0.3, 0.6, 0.9, -0.4, 0.7], dtype=torch.float64)
    turned = reference + torch.tensor([0, 0, 0, 0, math.pi])
    frame = SPACE.frames(reference, invariant=True)
    torch.testing.assert_close(SPACE.frames(turned, invariant=True), frame)
    torch.testing.assert_close(SPACE.frames(turned), -SPACE.frames(reference))
    gaussian = SPACE.decode(reference)
    along = torch.stack([gaussian.rotations.cos(), gaussian.rotations.sin()])
    torch.testing.assert_close(frame @ along, along * gaussian.scales[0] / 1.0)


@pytest.mark.parametrize("activation", ["sigmoid", "softplus", "exp"])
def test_every_activation_starts_with_the_same_gaussian_and_has_its_own_slope(activation):
    space = GaussianSpace(GRID, activation=activation)
    raw = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    scales = space.scales(raw)
    torch.testing.assert_close(scales, torch.tensor([1.0, 0.4], dtype=torch.float64))
    (slope,) = torch.autograd.grad(scales.sum(), raw)
    rise = torch.tensor([0.85, 0.25], dtype=torch.float64)  # above the floor of 0.15 m
    expected = {"sigmoid": rise * (1 - rise / 4.85), "softplus": 1 - (-rise).exp(), "exp": rise}
    torch.testing.assert_close(slope, expected[activation])


@pytest.mark.parametrize("activation", ["sigmoid", "softplus", "exp"])
def test_every_activation_has_a_slope_close_to_its_floor_and_an_end(activation):
    space = GaussianSpace(GRID, activation=activation)
    raw = torch.tensor([-3.0, 50.0], requires_grad=True)
    small, large = space.scales(raw)
    assert 0.15 < small < 0.3
    assert large.item() == pytest.approx(5.0)
    (slope,) = torch.autograd.grad(small, raw)
    assert slope[0] == pytest.approx(small.item() - 0.15, rel=0.1)  # all alike down there
    with pytest.raises(ValueError, match=r"activation must be one of .*, got 'relu'"):
        GaussianSpace(GRID, activation="relu")


def test_the_literal_covariance_squares_sigma_and_its_floor():
    literal = GaussianSpace(GRID, literal_covariance=True)
    reference = torch.tensor([0.5, 0.5, 0.3, -0.2, 0.0])
    scales = SPACE.decode(reference).scales
    torch.testing.assert_close(literal.decode(reference).scales, scales.square())
    assert literal.floor_m == pytest.approx(0.15**2)
    assert SPACE.floor_m == 0.15


def test_extents_along_the_line_by_hand():
    """Three Gaussians on a line along x: along it, across it, and at 45 degrees."""
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]),
        scales=torch.tensor([[2.0, 0.5]]).expand(3, 2),
        rotations=torch.tensor([0.0, math.pi / 2, math.pi / 4]),
    )
    mean = math.sqrt((4 + 0.25) / 2)
    expected = torch.tensor([[2.0, 0.5], [0.5, 2.0], [mean, mean]])
    torch.testing.assert_close(extents_along_line(gaussians), expected)


def test_gaussians_along_a_line_by_hand():
    """Edges of 3 and 5 m: half the distance along, the mean of both at the corner."""
    points = torch.tensor([[0.0, 0.0], [0.0, 3.0], [4.0, 6.0]])
    means, scales, rotations = gaussians_along(points, across_m=0.3)
    assert torch.equal(means, points)
    torch.testing.assert_close(scales, torch.tensor([[1.5, 0.3], [2.0, 0.3], [2.5, 0.3]]))
    angles = [math.pi / 2, math.atan2(6, 4), math.atan2(3, 4)]
    torch.testing.assert_close(rotations, torch.tensor(angles))
    assert gaussians_along(points, across_m=1.8).scales[0].tolist() == pytest.approx([1.8, 1.8])


def test_extents_on_an_oblique_line_by_hand():
    """A line at 30 degrees: Gaussians along it, across it, and at 60 degrees, 30 from the line."""
    degrees = torch.tensor([30.0, 120.0, 60.0])
    direction = torch.tensor([math.cos(math.pi / 6), math.sin(math.pi / 6)])
    gaussians = Gaussians(
        means=torch.arange(3.0)[:, None] * direction,
        scales=torch.tensor([[2.0, 0.5]]).expand(3, 2),
        rotations=degrees.deg2rad(),
    )
    tilted = [math.sqrt(4 * 0.75 + 0.25 * 0.25), math.sqrt(4 * 0.25 + 0.25 * 0.75)]
    expected = torch.tensor([[2.0, 0.5], [0.5, 2.0], tilted])
    torch.testing.assert_close(extents_along_line(gaussians), expected)


def test_a_frame_stretches_along_the_gaussians_axes_and_then_turns():
    """A Gaussian twice as long along the direction of travel, turned by 90 degrees anticlockwise.

    ::

          y                 y
          |  (0, 1)         |
          |  goes to   ---> |
          +----- x    (-2, 0) ----+----- x
    """
    target = (2.0 - 0.15) / (5.0 - 0.15)
    start = (1.0 - 0.15) / (5.0 - 0.15)
    long = math.log(target / (1 - target)) - math.log(start / (1 - start))
    reference = torch.tensor([0.5, 0.5, long, 0.0, math.pi / 2])
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
    with pytest.raises(
        ValueError, match=r"reference must have shape \(\.\.\., 5\) or more, got \(4, 2\)"
    ):
        SPACE.decode(torch.zeros(4, 2))


def test_errors_along_and_across_the_line_by_hand():
    """A line along x, predicted 0.2 m to its left and 0.5 m too far along; the last point is beyond
    its end and still only 0.2 m aside.

    ::

        predicted   x----x----x
        true      o----o----o
    """
    targets = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    line = torch.tensor([[0.0, 0.0], [0.7, 0.0], [0.7, 0.0], [2.0, 0.0]])
    points = targets + torch.tensor([0.5, 0.2])
    expected = torch.tensor([[0.5, 0.2]]).expand(3, 2)
    torch.testing.assert_close(line_errors(points, targets), expected)
    torch.testing.assert_close(line_errors(points, targets, line), expected)
    turned = torch.tensor([[0.0, 1.0], [-1.0, 0.0]])  # by 90 degrees: the same errors
    torch.testing.assert_close(line_errors(points @ turned, targets @ turned), expected)
    assert line_errors(points, torch.zeros(3, 2)).isfinite().all()


def test_a_ring_does_not_go_on_behind_its_first_vertex():
    """Points in front of the first corner of a square, 1 m from it, and of the next one."""
    ring = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [0.0, 0.0]])
    points = torch.tensor([[-1.0, 0.0], [2.6, -0.8], [1.0, 1.0]])
    across = line_errors(points, points, ring)[:, 1]
    torch.testing.assert_close(across, torch.tensor([1.0, 1.0, 1.0]))
    open_line = line_errors(points, points, ring[:-1])[:, 1]
    torch.testing.assert_close(open_line[0], torch.tensor(1e-6))  # on its straight continuation


def test_errors_have_a_gradient_where_points_lie_apart():
    generator = torch.Generator().manual_seed(0)
    points, targets = torch.randn(2, 2, 5, 2, generator=generator, dtype=torch.float64).unbind()
    assert torch.autograd.gradcheck(line_errors, (points.requires_grad_(), targets))


def test_factors_stretch_the_extents_along_and_across_the_line():
    """Whatever the Gaussians' own axes are; a factor of one leaves them as they are."""
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(4, 6, 2, generator=generator, dtype=torch.float64)
    scales = torch.rand(4, 6, 2, generator=generator, dtype=torch.float64) + 0.05
    gaussians = Gaussians(means, scales, 3 * means[..., 0])
    factors = torch.tensor([2.0, 0.3], dtype=torch.float64)
    found = stretch_along_line(gaussians, factors)
    torch.testing.assert_close(extents_along_line(found), extents_along_line(gaussians) * factors)
    area = found.scales.prod(-1) / gaussians.scales.prod(-1)
    torch.testing.assert_close(area, torch.full_like(area, 0.6))
    same = stretch_along_line(gaussians, torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close(same.scales, gaussians.scales.sort(descending=True).values)
    torch.testing.assert_close(covariances(same), covariances(gaussians))


def covariances(gaussians: Gaussians) -> torch.Tensor:
    cos, sin = gaussians.rotations.cos(), gaussians.rotations.sin()
    axes = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -1)
    return axes * gaussians.scales.square()[..., None, :] @ axes.transpose(-1, -2)


def test_gaussians_along_a_line_are_half_as_long_as_their_centres_are_apart():
    """Steps of 1, 2 and 4 m; an inner centre takes the mean of its two."""
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [1.0, 6.0]])
    found = gaussians_along(points, across_m=0.6)
    torch.testing.assert_close(found.scales[:, 0], torch.tensor([0.6, 0.75, 1.5, 2.0]))
    torch.testing.assert_close(found.scales[:, 1], torch.full((4,), 0.6))
    torch.testing.assert_close(found.rotations[[0, 3]], torch.tensor([0.0, torch.pi / 2]))
