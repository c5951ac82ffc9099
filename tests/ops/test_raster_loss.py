import math

import pytest
import torch

from gsmap.models.losses.raster import RasterLoss
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.ops.raster_loss import raster_loss
from gsmap.ops.raster_loss.reference import dssim_map
from gsmap.ops.soft_iou import pairwise_soft_iou
from gsmap.structures.grid import BEVGrid

BACKENDS = ["reference", "cpu"]
SETTINGS = [
    {},
    {"normalize": "pixels"},
    {"window_size": 5, "foreground_weight": 1.0, "alpha": 0.3},
    {"alpha": 1.0},
    {"alpha": 0.0},
]


def sparse_masks(shape, share, seed=0):
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(2, *shape, generator=generator)
    return masks * (torch.rand(2, *shape, generator=generator) < share)


def direct_ssim(pred, target, size=11, sigma=1.5):
    """SSIM at every pixel from its definition, window by window, zeros outside the image."""
    taps = torch.tensor([math.exp(-0.5 * ((i - size // 2) / sigma) ** 2) for i in range(size)])
    window = torch.outer(taps, taps).double() / taps.sum() ** 2
    pad = size // 2
    p, t = (torch.nn.functional.pad(image.double(), (pad,) * 4) for image in (pred, target))
    result = torch.zeros(pred.shape).double()
    for row in range(pred.shape[0]):
        for col in range(pred.shape[1]):
            a, b = (m[row : row + size, col : col + size] for m in (p, t))
            mean_a, mean_b = (window * a).sum(), (window * b).sum()
            var_a = (window * a * a).sum() - mean_a**2
            var_b = (window * b * b).sum() - mean_b**2
            cov = (window * a * b).sum() - mean_a * mean_b
            result[row, col] = (2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)
            result[row, col] /= (mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)
    return result


def test_dissimilarity_is_one_minus_ssim_by_definition():
    pred, target = sparse_masks((13, 9), 0.3)
    expected = 1 - direct_ssim(pred, target)
    actual = dssim_map(pred[None].double(), target[None].double())[0]
    torch.testing.assert_close(actual, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_l1_term_worked_by_hand(backend):
    """Target (1, 1, 0, 0), prediction (1, 0.5, 0.25, 0), foreground weight 5.

    sum w |d| = 5 * 0.5 + 1 * 0.25 = 2.75; the foreground weighs 10, all pixels 12.
    """
    target = torch.tensor([[[1.0, 1.0, 0.0, 0.0]]])
    pred = torch.tensor([[[1.0, 0.5, 0.25, 0.0]]])
    by_foreground = raster_loss(pred, target, alpha=1.0, backend=backend)
    torch.testing.assert_close(by_foreground, torch.tensor([0.275]))
    by_pixels = raster_loss(pred, target, alpha=1.0, normalize="pixels", backend=backend)
    torch.testing.assert_close(by_pixels, torch.tensor([2.75 / 12]))


@pytest.mark.parametrize("backend", BACKENDS)
def test_missing_an_element_costs_about_one_whatever_the_background(backend):
    losses = []
    for size in (20, 60):
        target = torch.zeros(1, size, size)
        target[0, 8:12, 6:14] = 1
        losses.append(raster_loss(torch.zeros_like(target), target, backend=backend))
        # the L1 term is 1; SSIM is not quite 0 where its window only touches the element
        assert 0.9 < losses[-1].item() < 1
    torch.testing.assert_close(losses[0], losses[1])


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_masks_cost_nothing(backend):
    masks = sparse_masks((21, 33), 0.3)
    torch.testing.assert_close(
        raster_loss(masks, masks, backend=backend), torch.zeros(2), atol=1e-6, rtol=0
    )


@pytest.mark.usefixtures("poisoned_empty")
@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize(
    ("shape", "share"), [((21, 33), 0.3), ((21, 33), 0.005), ((7, 4), 0.3), ((40, 50), 0.0)]
)
def test_fused_loss_equals_the_float64_reference(shape, share, settings):
    pred, target = sparse_masks(shape, share), sparse_masks(shape, share, seed=1)
    leaf, exact = pred.clone().requires_grad_(), pred.double().requires_grad_()
    loss = raster_loss(leaf, target, backend="cpu", **settings)
    true = raster_loss(exact, target.double(), backend="reference", **settings)
    # sums of some hundred float32 terms of size 1
    torch.testing.assert_close(loss, true.float(), atol=1e-6, rtol=1e-5)
    upstream = torch.tensor([1.0, -0.5])
    loss.backward(upstream)
    true.backward(upstream.double())
    assert (leaf.grad - exact.grad).norm() <= 1e-5 * exact.grad.norm()


@pytest.mark.parametrize("normalize", ["foreground", "pixels"])
def test_gradcheck(normalize):
    pred = sparse_masks((9, 7), 0.6).double().requires_grad_()
    target = (sparse_masks((9, 7), 0.4, seed=1) > 0).double()
    # a pixel where prediction and target agree sits on the kink of |x|
    target = torch.where(pred == target, 1 - target, target).detach()
    loss = RasterLoss(normalize=normalize).double()
    assert torch.autograd.gradcheck(lambda p: loss(p, target), pred)


def test_module_weights_and_averages():
    pred, target = sparse_masks((21, 33), 0.3), sparse_masks((21, 33), 0.3, seed=1)
    losses = raster_loss(pred, target, 0.5, 2.0)
    module = RasterLoss(loss_weight=3.0, alpha=0.5, foreground_weight=2.0)
    torch.testing.assert_close(module(pred, target), 3 * losses.mean())
    torch.testing.assert_close(module(pred, target, avg_factor=8), 3 * losses.sum() / 8)


def test_nothing_matched_gives_zero_with_a_gradient():
    pred = torch.zeros(0, 21, 33, requires_grad=True)
    loss = RasterLoss()(pred, torch.zeros(0, 21, 33))
    loss.backward()
    assert loss.item() == 0
    assert pred.grad.shape == pred.shape


def test_autocast_second_backward_and_runs_change_nothing():
    pred, target = sparse_masks((21, 33), 0.3), sparse_masks((21, 33), 0.3, seed=1)
    pred.requires_grad_()
    plain = RasterLoss()(pred, target)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = RasterLoss()(pred, target)
    assert torch.equal(plain, mixed)
    first = torch.autograd.grad(plain, pred, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(plain, pred)[0])


def test_compiled_model_keeps_the_gradient():
    pred, target = sparse_masks((21, 33), 0.3), sparse_masks((21, 33), 0.3, seed=1)
    pred.requires_grad_()
    module = RasterLoss()
    (expected,) = torch.autograd.grad(module(pred * 0.9, target), pred)
    compiled = torch.compile(lambda p, t: module(p * 0.9, t), backend="aot_eager", fullgraph=True)
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


def test_shapes_that_disagree_are_named():
    with pytest.raises(ValueError, match=r"\(2, 4, 5\) and \(1, 4, 5\)"):
        raster_loss(torch.zeros(2, 4, 5), torch.zeros(1, 4, 5))


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
        RasterLoss()(mask, target).backward()
        optimizer.step()
    assert pairwise_soft_iou(mask.detach(), target).item() > 0.75
