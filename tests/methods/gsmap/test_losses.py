import pytest
import torch
from predictions import pairs_of

from gsmap.models.gsmap.losses import RasterLoss
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.ops.raster_loss import raster_loss
from gsmap.ops.soft_iou import pairwise_soft_iou
from gsmap.structures.grid import BEVGrid


def two_masks():
    generator = torch.Generator().manual_seed(0)
    masks = torch.rand(2, 2, 21, 33, generator=generator)
    return (masks * (torch.rand(masks.shape, generator=generator) < 0.3)).unbind()


def test_module_weights_and_averages():
    pred, target = two_masks()
    losses = raster_loss(pred, target, 0.5, 2.0)
    module = RasterLoss(loss_weight=3.0, alpha=0.5, foreground_weight=2.0)
    pairs = pairs_of(pred_masks=pred, gt_masks=target, avg_factor=8)
    torch.testing.assert_close(module(pairs), 3 * losses.sum() / 8)


def test_each_class_has_its_own_weight_and_its_own_overlap_from_which_on_masks_count():
    """Soft IoUs of 1/3, 1 and 1/3: the first class is not gated, the third counts by 1/3 / 0.5."""
    target = torch.zeros(3, 21, 33)
    target[:, :, 10:14] = 1
    pred = target.roll(2, -1)
    pred[1] = target[1] * 0.999  # no gradient is lost where masks agree
    labels = torch.tensor([0, 1, 2])
    pairs = pairs_of(pred_masks=pred, gt_masks=target, gt_labels=labels, avg_factor=2)
    single = raster_loss(pred, target)
    weighted = RasterLoss(loss_weight=(15, 10, 6))(pairs)
    torch.testing.assert_close(weighted, single @ torch.tensor([15.0, 10, 6]) / 2)
    gated = RasterLoss(loss_weight=1, full_iou=(0, 0.5, 0.5))(pairs)
    torch.testing.assert_close(gated, single @ torch.tensor([1, 1, 2 / 3]) / 2)
    one = RasterLoss(loss_weight=1, full_iou=0.5)(pairs)
    torch.testing.assert_close(one, single @ torch.tensor([2 / 3, 1, 2 / 3]) / 2)


def test_the_overlap_that_weighs_a_loss_has_no_gradient():
    pred, target = two_masks()
    pred.requires_grad_()
    pairs = pairs_of(pred_masks=pred, gt_masks=target, gt_labels=torch.tensor([0, 1]))
    weights = RasterLoss(full_iou=0.9).values(pairs).detach() / raster_loss(pred, target).detach()
    (expected,) = torch.autograd.grad(weights @ raster_loss(pred, target), pred)
    (actual,) = torch.autograd.grad(RasterLoss(1.0, full_iou=0.9)(pairs), pred)
    torch.testing.assert_close(actual, expected)


def test_nothing_matched_gives_zero_with_a_gradient():
    pred = torch.zeros(0, 21, 33, requires_grad=True)
    loss = RasterLoss()(pairs_of(pred_masks=pred, gt_masks=torch.zeros(0, 21, 33)))
    loss.backward()
    assert loss.item() == 0
    assert pred.grad.shape == pred.shape


def test_compiled_model_keeps_the_gradient():
    pred, target = two_masks()
    pred.requires_grad_()

    def module(p, t):
        return raster_loss(p * 0.9, t).sum()

    (expected,) = torch.autograd.grad(module(pred, target), pred)
    compiled = torch.compile(module, backend="aot_eager", fullgraph=True)
    (actual,) = torch.autograd.grad(compiled(pred, target), pred)
    torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"alpha": 1.5}, r"alpha must lie in \[0, 1\]"),
        ({"foreground_weight": 0}, "foreground_weight must be > 0"),
        ({"normalize": "mean"}, "normalize must be one of"),
        ({"window_size": 4}, "window_size must be odd"),
        ({"window_sigma": 0}, "window_sigma must be > 0"),
    ],
)
def test_bad_settings_are_named(arguments, match):
    with pytest.raises(ValueError, match=match):
        RasterLoss(**arguments)


def test_gaussians_learn_a_line_from_its_mask():
    """From 1 m of noise on the centres to the line: the soft IoU rises from 0.2 to above 0.75."""
    grid = BEVGrid((-8, 8), (-10, 10), 50, 40)
    y = torch.linspace(-8, 8, 10)
    line = torch.stack([2 * torch.sin(y / 4), y], -1)[None]
    target = draw_polylines(line, grid, width_m=1.0)
    noise = torch.randn(line.shape, generator=torch.Generator().manual_seed(0))
    means = (line + noise).requires_grad_()
    log_scales = torch.zeros(1, 10, 2, requires_grad=True)
    rotations = torch.zeros(1, 10, requires_grad=True)
    optimizer = torch.optim.Adam([means, log_scales, rotations], lr=0.05)
    for _ in range(100):
        mask = render_gaussians(means, log_scales.exp(), rotations, grid)
        optimizer.zero_grad()
        RasterLoss()(pairs_of(pred_masks=mask, gt_masks=target)).backward()
        optimizer.step()
    assert pairwise_soft_iou(mask.detach(), target).item() > 0.75
