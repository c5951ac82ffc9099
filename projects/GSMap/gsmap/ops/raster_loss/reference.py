"""Sums of the raster loss in plain torch."""

import torch
from torch import Tensor
from torch.nn import functional as F

# The usual constants of SSIM for values in [0, 1].
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
# A window covers part of a mask if the weighted mean of the mask in the window is above this
# threshold. With ``normalize="both"``, D-SSIM is the sum of 1 - SSIM over all windows, divided by
# the number of windows that cover part of the prediction or of the target. D-SSIM should be near 1
# for a prediction that misses its element. With this threshold, it is 0.94 to 1.03 for elements of
# 4 to 60 m and rasters of 128 x 64 to 256 x 128. With a threshold of 0, it would be 0.59 to 0.93,
# because windows that cover almost nothing of the masks would be counted. With a threshold of 1e-2,
# it would be 1.09 to 1.38.
MIN_COVERAGE = 1e-3


def gaussian_window(size: int, sigma: float, like: Tensor) -> Tensor:
    """Create a 1D Gaussian window that sums to one.

    Args:
        size: Number of values.
        sigma: Standard deviation, in units of the distance between two values.
        like: Tensor with the type and device of the window.

    Returns:
        Window. (size,)
    """
    offsets = torch.arange(size, device=like.device, dtype=like.dtype) - (size - 1) / 2
    window = torch.exp(-0.5 * (offsets / sigma).square())
    return window / window.sum()


def _blur(images: Tensor, window: Tensor) -> Tensor:
    """Filter images with a separable window, zeros outside. (n, H, W), (size,) -> (n, H, W)

    The size of the window is odd, so the images keep their size.
    """
    pad = len(window) // 2
    filtered_rows = F.conv2d(images[:, None], window.view(1, 1, 1, -1), padding=(0, pad))
    return F.conv2d(filtered_rows, window.view(1, 1, -1, 1), padding=(pad, 0))[:, 0]


def dssim_map(preds: Tensor, targets: Tensor, window: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the structural dissimilarity of masks in a window around each pixel.

    Args:
        preds: Predicted masks in [0, 1]. (n, H, W)
        targets: Ground-truth masks in [0, 1]. (n, H, W)
        window: Weights of the window along one axis, which sum to one. (size,)

    Returns:
        1 - SSIM in [0, 2], and the weighted means of predictions and of targets, all (n, H, W).
    """
    # Five images of each pair of masks are filtered at once. The results are the weighted means of
    # both masks, of their squares and of their product.
    images = torch.cat([preds, targets, preds.square(), targets.square(), preds * targets])
    mean_p, mean_t, square_p, square_t, product = _blur(images, window).chunk(5)
    var_p = square_p - mean_p.square()
    var_t = square_t - mean_t.square()
    covariance = product - mean_p * mean_t
    # SSIM as the product of the comparisons of means (with C1) and of covariances (with C2).
    numerator = (2 * mean_p * mean_t + SSIM_C1) * (2 * covariance + SSIM_C2)
    denominator = (mean_p.square() + mean_t.square() + SSIM_C1) * (var_p + var_t + SSIM_C2)
    return 1 - numerator / denominator, mean_p, mean_t


def raster_loss_sums_reference(
    preds: Tensor, targets: Tensor, window_size: int, window_sigma: float, weight: float
) -> Tensor:
    r"""Sum the terms of GSMap Eq. 12 over the pixels of each mask.

    The equation is :math:`\alpha D_w + (1 - \alpha) L_{D-SSIM}`. `raster_loss` computes it from the
    sums below. :math:`D_w` is the first sum, divided by sum w p + sum w t, by sum w t or by sum w.
    D-SSIM is the third sum, divided by one of the two numbers of pixels or by the number of all
    pixels. The argument ``normalize`` of `raster_loss` selects the divisors.

    Args:
        preds: Predicted masks p in [0, 1]. (n, H, W)
        targets: Ground-truth masks t in [0, 1]. (n, H, W)
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels.
        weight: Weight of a foreground pixel, relative to a background pixel.

    Returns:
        Seven values of each mask, with the weight w = 1 + (weight - 1) t of a pixel:
        sum w |p - t|, sum w p, sum (1 - SSIM), sum w t, sum (w - 1), the number of pixels with any
        part of the target in their window, and the number of pixels in whose window the weighted
        mean of the target or of the prediction is above `MIN_COVERAGE`. (n, 7)
    """
    excess = (weight - 1) * targets  # w - 1
    weights = 1 + excess
    window = gaussian_window(window_size, window_sigma, like=preds)
    dissimilarity, mean_p, mean_t = dssim_map(preds, targets, window=window)
    # Largest value of the target in the window of each pixel: > 0 if any part of it is inside.
    largest_targets = F.max_pool2d(
        targets[:, None], window_size, stride=1, padding=window_size // 2
    )[:, 0]
    larger_means = torch.maximum(mean_p, mean_t)
    terms = (
        weights * (preds - targets).abs(),
        weights * preds,
        dissimilarity,
        weights * targets,
        excess,
        (largest_targets > 0).to(preds.dtype),
        (larger_means > MIN_COVERAGE).to(preds.dtype),
    )
    return torch.stack([term.sum((1, 2)) for term in terms], dim=-1)
