import importlib
import math

import pytest
import torch
from raster_loss_cases import MASKS, SETTINGS, sparse_masks

from benchmarks.masks import ERRORS_M, LENGTHS_M, RASTER_SIZES, missed_line_loss, scale_gradients
from gsmap.ops.raster_loss import NORMALIZATIONS, raster_loss
from gsmap.ops.raster_loss.reference import dssim_map, gaussian_window

BACKENDS = ["reference", "cpu"]


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
    window = gaussian_window(11, 1.5, expected)
    actual, *_ = dssim_map(pred[None].double(), target[None].double(), window)
    torch.testing.assert_close(actual[0], expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("normalize", "weight", "expected"),
    [
        ("both", 1.0, 0.75 / 3.75),  # sum (p + t) = 1.75 + 2
        ("both", 5.0, 2.75 / 17.75),  # sum w (p + t) = 5 * (2 + 1.5) + 0.25
        ("foreground", 1.0, 0.75 / 2),
        ("foreground", 5.0, 2.75 / 10),
        ("pixels", 1.0, 0.75 / 4),
        ("pixels", 5.0, 2.75 / 12),
    ],
)
def test_l1_term_worked_by_hand(normalize, weight, expected, backend):
    """Target (1, 1, 0, 0), prediction (1, 0.5, 0.25, 0): |d| sums to 0.75.

    With a foreground weight of 5, w = (5, 5, 1, 1) and sum w |d| = 2.75.
    """
    target = torch.tensor([[[1.0, 1.0, 0.0, 0.0]]])
    pred = torch.tensor([[[1.0, 0.5, 0.25, 0.0]]])
    loss = raster_loss(pred, target, 1.0, weight, normalize, backend=backend)
    torch.testing.assert_close(loss, torch.tensor([expected]))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("normalize", "pixels"), [("both", 3), ("foreground", 2), ("pixels", 5)])
def test_dissimilarity_term_worked_by_hand(normalize, pixels, backend):
    """With a window of one pixel, SSIM is (2 p t + C1) / (p^2 + t^2 + C1), C1 = 1e-4.

    Three pixels hold more than 1e-3 of either mask (one more holds 5e-4), two of the target.
    """
    target = torch.tensor([[[1.0, 1.0, 0.0, 0.0, 0.0]]])
    pred = torch.tensor([[[1.0, 0.5, 0.25, 5e-4, 0.0]]])
    total = 3 - 1.0001 / 1.2501 - 1e-4 / 0.0626 - 1e-4 / 1.0025e-4
    loss = raster_loss(pred, target, 0.0, 1.0, normalize, window_size=1, backend=backend)
    torch.testing.assert_close(loss, torch.tensor([total / pixels]))


def test_a_tiny_ground_truth_counts_as_half_a_percent_of_the_raster_by_its_foreground():
    target = torch.zeros(1, 20, 50)
    target[0, 10, 10] = 1
    loss = raster_loss(torch.zeros_like(target), target, 1.0, 3.0, "foreground")
    torch.testing.assert_close(loss, torch.tensor([1 / 5]))


@pytest.mark.parametrize("size", RASTER_SIZES)
@pytest.mark.parametrize("band_m", [0.75, 4.0])
def test_missing_an_element_costs_about_one_whatever_its_size_and_the_raster(band_m, size):
    # the L1 term is 1; D-SSIM's mean depends a little on how the band falls on the pixels
    assert all(
        0.98 < missed_line_loss("both", band_m, length_m, size) < 1.02 for length_m in LENGTHS_M
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_missing_an_element_costs_the_same_on_a_larger_raster(backend):
    losses = []
    for size in (20, 60):
        target = torch.zeros(1, size, size)
        target[0, 8:12, 6:14] = 1
        losses.append(raster_loss(torch.zeros_like(target), target, backend=backend))
        assert 0.98 < losses[-1].item() < 1.02
    torch.testing.assert_close(losses[0], losses[1])


@pytest.mark.parametrize("error_m", ERRORS_M)
def test_small_gaussians_off_their_line_are_pushed_to_grow(error_m):
    assert min(scale_gradients("both", 0.75, error_m, 0.25, seeds=16)) > 0


def test_a_loss_by_the_foreground_pushes_gaussians_two_metres_off_to_shrink():
    assert max(scale_gradients("foreground, weight 5", 0.75, 2.0, 0.25, seeds=16)) < 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("normalize", NORMALIZATIONS)
def test_equal_masks_cost_nothing(normalize, backend):
    masks = sparse_masks((21, 33), 0.3)
    masks[1] = 0
    loss = raster_loss(masks, masks, normalize=normalize, backend=backend)
    torch.testing.assert_close(loss, torch.zeros(2), atol=1e-6, rtol=0)


@pytest.mark.usefixtures("poisoned_empty")
@pytest.mark.parametrize("normalize", NORMALIZATIONS)
@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("case", MASKS)
def test_fused_loss_equals_the_float64_reference(case, settings, normalize):
    pred, target = MASKS[case]
    leaf, exact = pred.clone().requires_grad_(), pred.double().requires_grad_()
    loss = raster_loss(leaf, target, normalize=normalize, backend="cpu", **settings)
    true = raster_loss(exact, target.double(), normalize=normalize, backend="reference", **settings)
    # sums of some hundred float32 terms of size 1
    torch.testing.assert_close(loss, true.float(), atol=1e-6, rtol=1e-5)
    upstream = torch.tensor([1.0, -0.5])
    loss.backward(upstream)
    true.backward(upstream.double())
    assert (leaf.grad - exact.grad).norm() <= 1e-5 * exact.grad.norm()


@pytest.mark.parametrize("normalize", NORMALIZATIONS)
def test_gradcheck(normalize):
    pred = sparse_masks((9, 7), 0.6).double().requires_grad_()
    target = (sparse_masks((9, 7), 0.4, seed=1) > 0).double()
    # a pixel where prediction and target agree sits on the kink of |x|
    target = torch.where(pred == target, 1 - target, target).detach()
    assert torch.autograd.gradcheck(
        lambda p: raster_loss(p, target, foreground_weight=3.0, normalize=normalize), pred
    )


def test_autocast_second_backward_and_runs_change_nothing():
    pred, target = sparse_masks((21, 33), 0.3), sparse_masks((21, 33), 0.3, seed=1)
    pred.requires_grad_()
    plain = raster_loss(pred, target)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = raster_loss(pred, target)
    assert torch.equal(plain, mixed)
    first = torch.autograd.grad(plain.sum(), pred, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(plain.sum(), pred)[0])


def test_many_masks_are_compared_some_at_a_time(monkeypatch):
    """The plain path keeps some thirty tensors of its masks at once: of no more than so many."""
    module = importlib.import_module("gsmap.ops.raster_loss")
    torch.manual_seed(0)
    preds, targets = torch.rand(2, 5, 7, 9, dtype=torch.float64)
    numbers, sums = [], module.raster_loss_sums_reference
    found = []
    for most in (5, 2):
        monkeypatch.setattr(module, "AT_ONCE", most)
        monkeypatch.setattr(
            module,
            "raster_loss_sums_reference",
            lambda pred, *rest: numbers.append(len(pred)) or sums(pred, *rest),
        )
        leaf = preds.clone().requires_grad_()
        values = raster_loss(leaf, targets, backend="reference")
        values.sum().backward()
        found.append((values.detach(), leaf.grad))
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=0)
    assert sorted(numbers) == [1, 1, 2, 2, 2, 2, 5, 5]  # forward, and again for the gradient


def test_shapes_that_disagree_are_named():
    with pytest.raises(ValueError, match=r"\(2, 4, 5\) and \(1, 4, 5\)"):
        raster_loss(torch.zeros(2, 4, 5), torch.zeros(1, 4, 5))


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"normalize": "mean"}, r"normalize must be one of .*got 'mean'"),
        ({"window_size": 10}, "window_size must be odd and >= 1, got 10"),
        ({"window_size": 0}, "window_size must be odd and >= 1, got 0"),
        ({"window_sigma": 0.0}, "window_sigma must be > 0 and finite, got 0.0"),
        ({"alpha": float("nan")}, r"alpha must lie in \[0, 1\], got nan"),
        ({"foreground_weight": float("inf")}, "foreground_weight must be > 0 and finite"),
    ],
)
def test_a_setting_outside_its_range_is_named(settings, text, backend):
    with pytest.raises(ValueError, match=text):
        raster_loss(torch.zeros(1, 4, 5), torch.zeros(1, 4, 5), **settings, backend=backend)
