"""References: refinement, points with height, and the first Gaussian on every data set."""

import pytest
import torch
from head_cases import ALONG_X, ALONG_Y, CLASSES, assert_neighbours_stay_apart_in_bfloat16

from gsmap.models.base.masks import ElementMasks
from gsmap.models.gsmap.reference import GaussianReference
from gsmap.models.gsmap.statistics import gaussian_statistics
from gsmap.models.maptr.references import PointReference, refine_reference
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.gaussians import Gaussians


def test_refinement_moves_centres_before_the_sigmoid_and_adds_the_rest():
    reference = torch.tensor([[0.5, 0.2, 1.0, -2.0, 0.3]])
    offsets = torch.tensor([[0.0, 1.0, 0.5, 0.5, -0.3]])
    logit = torch.logit(torch.tensor(0.2))
    expected = torch.tensor([[0.5, torch.sigmoid(logit + 1.0), 1.5, -1.5, 0.0]])
    torch.testing.assert_close(refine_reference(reference, offsets), expected)


def test_refinement_at_the_border_stays_finite_and_has_a_gradient():
    reference = torch.tensor([[0.0, 1.0]])
    offsets = torch.zeros(1, 2, requires_grad=True)
    refined = refine_reference(reference, offsets)
    torch.testing.assert_close(refined, torch.tensor([[0.0, 1.0]]), atol=2e-5, rtol=0)
    refined.sum().backward()
    assert torch.isfinite(offsets.grad).all()
    assert (offsets.grad > 0).all()


def test_refinement_is_float32_under_mixed_precision():
    refined = refine_reference(torch.rand(1, 2), torch.rand(1, 2, dtype=torch.bfloat16))
    assert refined.dtype == torch.float32


@pytest.mark.parametrize("reference", [PointReference, GaussianReference])
def test_neighbouring_points_stay_apart_in_bfloat16(reference):
    """Rounded onto each other, their edges have no direction, and gradients of thousands."""
    assert_neighbours_stay_apart_in_bfloat16(reference(ALONG_Y, 8, 1))


def test_refinement_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"offsets must have shape \(3, 2\) of reference"):
        refine_reference(torch.rand(3, 2), torch.rand(3, 5))


def test_points_with_height_are_refined_and_brought_to_metres_in_all_three():
    reference = PointReference(ALONG_Y, 8, 1, coords=3, z_range=(-2.0, 6.0))
    points_m = torch.tensor([[-15.0, 0.0, -2.0], [3.0, 15.0, 4.0]])
    norm = torch.tensor([[0.0, 0.5, 0.0], [0.6, 0.75, 0.75]])
    torch.testing.assert_close(reference.norm(points_m), norm)
    torch.testing.assert_close(reference.metres(norm), points_m)
    start = reference.start(torch.randn(4, 8))
    assert start.shape == (4, 3)
    refined = reference.refine(0, torch.randn(4, 8), start)
    assert ((refined > 0) & (refined < 1)).all()
    assert list(reference.decode(refined)) == ["pts"]


def test_a_gaussian_with_height_lies_in_the_plane():
    reference = GaussianReference(ALONG_Y, 8, 1, coords=3, z_range=(-2.0, 6.0))
    start = reference.start(torch.randn(4, 8))
    assert start.shape == (4, 6)
    assert not start[:, 3:].any()  # the same Gaussian for every query
    found = reference.decode(start)
    assert found["pts"].shape == (4, 3)
    assert found["scales"].shape == (4, 2)
    torch.testing.assert_close(reference.space.decode(start).means, found["pts"][:, :2])


@pytest.mark.parametrize("settings", [{"coords": 4}, {"coords": 3}, {"z_range": (-1, 1)}])
def test_a_height_needs_its_range(settings):
    with pytest.raises(ValueError, match="coords must be 2, or 3 with a z_range"):
        PointReference(ALONG_Y, 8, 1, **settings)


@pytest.mark.parametrize(("mlp", "numbers"), [(False, 27), (True, 2 * 72 + 27)])
def test_sigma_and_theta_come_from_one_matrix_or_from_a_branch_like_the_points(mlp, numbers):
    reference = GaussianReference(ALONG_Y, 8, 1, mlp=mlp)
    branch = reference.gaussian_branches[0]
    assert sum(parameter.numel() for parameter in branch.parameters()) == numbers
    reference.init_weights()
    states = torch.randn(2, 8)
    start = reference.start(torch.randn(2, 8))
    assert torch.equal(reference.refine(0, states, start)[:, 2:], start[:, 2:])  # neutral at first
    torch.nn.init.normal_(branch[-1].weight)
    assert (reference.refine(0, states, start)[:, 2:] != start[:, 2:]).all()


def soft_iou_of_the_first_gaussians(grid, masks):
    """Compare a line of 50 m along travel with first Gaussians at its 20 points."""
    reference = GaussianReference(grid, 8, 1, min_scale_m=masks.half_pixel_m)
    line = torch.zeros(1, 20, 2)
    line[..., 0 if grid.forward == "x" else 1] = torch.linspace(-25, 25, 20)
    first = torch.cat([reference.norm(line), torch.zeros(1, 20, 3)], -1)
    rendered = render_gaussians(*reference.space.decode(first), masks.grid)
    drawn = masks.draw(line, torch.zeros(1, dtype=torch.long), masks.grid)
    union = torch.maximum(rendered, drawn).sum()
    return torch.minimum(rendered, drawn).sum() / union


def test_the_first_gaussian_lies_along_the_direction_of_travel_on_every_data_set():
    """Along y everywhere, the overlap on Argoverse 2 would be a third of what it is here."""
    forward_y, forward_x = (
        soft_iou_of_the_first_gaussians(grid, ElementMasks(grid)) for grid in (ALONG_Y, ALONG_X)
    )
    assert forward_y > 0.5
    torch.testing.assert_close(forward_x, forward_y)


def test_statistics_by_hand():
    """One divider as its ground truth is, at its floor; one boundary off by everything."""
    means = torch.tensor([[[0.0, -4.0], [0.0, 0.0], [0.0, 4.0]]]).repeat(2, 1, 1)
    scales = torch.tensor([[0.16, 0.15], [2.0, 0.5]])[:, None].repeat(1, 3, 1)
    gaussians = Gaussians(means, scales, torch.full((2, 3), torch.pi / 2))
    masks = torch.zeros(2, 4, 5)
    masks[:, 1] = 1
    rendered = masks.clone()
    rendered[1] = masks[1].flip(0)
    figures = gaussian_statistics(gaussians, rendered, masks, torch.tensor([0, 2]), CLASSES, 0.15)
    expected = {
        "soft_iou/divider": 1.0,
        "sigma_along/divider": 0.16,
        "sigma_across/divider": 0.15,
        "soft_iou/boundary": 0.0,
        "sigma_along/boundary": 2.0,
        "sigma_across/boundary": 0.5,
        "at_floor": 0.5,
    }
    assert {name: value.item() for name, value in figures.items()} == pytest.approx(expected)
