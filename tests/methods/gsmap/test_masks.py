"""Masks for Gaussians: they fit the points beside them, and pass on the gradients that they say."""

import math

import numpy as np
import pytest
import torch
from head_cases import ALONG_Y, elements
from predictions import pairs_of

import gsmap.registered  # noqa: F401
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.map_targets import map_targets
from gsmap.models.gsmap.losses import RasterLoss
from gsmap.models.gsmap.masks import GaussianMasks
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.gaussians import GaussianSpace, gaussians_along


def test_a_mask_of_gaussians_is_one_that_a_prediction_can_equal_as_wide_as_the_band():
    gt = elements(((-3, -20), (-3, 20)))
    band, soft = (GaussianMasks(ALONG_Y, source=source) for source in ("points", "gaussians"))
    mask = soft.draw_batch([gt], soft.grid)
    across_m = 0.75 / math.sqrt(2 * math.pi)
    own = gaussians_along(gt.pts, across_m)
    assert torch.equal(mask, render_gaussians(*own, soft.grid))
    centre = mask.shape[1] // 2  # the row of the middle point, where its neighbours add little
    drawn = band.draw_batch([gt], soft.grid)
    assert mask[0, centre].sum().item() == pytest.approx(drawn[0, centre].sum().item(), rel=0.1)


@pytest.fixture(scope="module")
def crossing():
    """A crossing of 12 x 3.5 m whose matched order starts at the corner opposite to the first."""
    corners = np.array([[-6.0, 0], [6, 0.5], [6, 4], [-6, 3.5], [-6, 0]])
    gt = map_targets([MapInstance(1, corners)], 20, ALONG_Y.x_range, ALONG_Y.y_range)
    matched = gt.pts_shifts[:, 2]
    assert (matched[0, 0] - gt.pts[0, 0]).norm() > 12
    return gt, matched


def fit(target_pts: torch.Tensor, mask: torch.Tensor, masks: GaussianMasks) -> float:
    """Fit Gaussians to points (L1) and to a mask; return how far off a centre ends, in metres."""
    space = GaussianSpace(ALONG_Y, min_scale_m=masks.half_pixel_m)
    target = ALONG_Y.norm_from_metres(target_pts)
    centres = target.clone().requires_grad_()
    shapes = torch.zeros(1, 20, 3, requires_grad=True)
    rates = [{"params": [centres], "lr": 4e-3}, {"params": [shapes], "lr": 0.1}]
    optimizer = torch.optim.Adam(rates)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 60)
    raster = RasterLoss(loss_weight=10.0)
    for _ in range(60):
        rendered = render_gaussians(*space.decode(torch.cat([centres, shapes], -1)), masks.grid)
        loss = 5 * (centres - target).abs().sum() + raster(
            pairs_of(pred_masks=rendered, gt_masks=mask)
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    off = ALONG_Y.metres_from_norm(centres.detach()) - target_pts
    return off.norm(dim=-1).max().item()


def test_a_crossings_mask_fits_its_points_whichever_order_is_matched(crossing):
    gt, matched = crossing
    masks = GaussianMasks(ALONG_Y)
    full, own = masks.draw_batch([gt], masks.grid), masks.draw(matched, gt.labels_3d, masks.grid)
    assert fit(matched, full, masks) < 0.2
    assert fit(matched, own, masks) < 0.2  # source='points'


def test_the_mask_of_another_order_would_pull_centres_off_their_points(crossing):
    gt, matched = crossing
    masks = GaussianMasks(ALONG_Y)
    first = masks.draw(gt.pts, gt.labels_3d, masks.grid)
    assert fit(matched, first, masks) > 0.5


def test_masks_of_held_classes_move_no_point():
    masks = GaussianMasks(ALONG_Y, held_classes=[1])
    references = torch.rand(3, 4, 5, requires_grad=True)
    held = masks.rendered_references(references, torch.tensor([0, 1, 2]), coords=2)
    torch.testing.assert_close(held, references)
    held.sum().backward()
    expected = torch.ones(3, 4, 5)
    expected[1, :, :2] = 0
    torch.testing.assert_close(references.grad, expected)
    assert (
        GaussianMasks(ALONG_Y).rendered_references(references, torch.tensor([0, 1, 2]), coords=2)
        is references
    )
