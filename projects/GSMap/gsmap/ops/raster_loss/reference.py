"""The sums behind the raster loss in plain torch: the definition of right."""

import torch
from torch import Tensor
from torch.nn import functional as F

SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # the usual constants for values in [0, 1]
# A window whose weighted mean is below sees a mask as empty. So D-SSIM of a miss is 0.94 to 1.03
# for elements of 4 to 60 m and rasters of 128 x 64 to 256 x 128. At 0 it is 0.59 to 0.93, as
# windows that see next to nothing of the mask count, too; at 1e-2 it is 1.09 to 1.38.
SEEN = 1e-3


def gaussian_window(size: int, sigma: float, like: Tensor) -> Tensor:
    """Return a 1D Gaussian window that sums to one. (size,)

    Args:
        size: Number of values.
        sigma: Standard deviation in values.
        like: Its type and device are those of the window.
    """
    offsets = torch.arange(size, device=like.device, dtype=like.dtype) - (size - 1) / 2
    window = torch.exp(-0.5 * (offsets / sigma).square())
    return window / window.sum()


def _blur(images: Tensor, window: Tensor) -> Tensor:
    """Filter with a separable window, zeros outside the image. (n, H, W)"""
    pad = len(window) // 2
    columns = F.conv2d(images[:, None], window.view(1, 1, 1, -1), padding=(0, pad))
    return F.conv2d(columns, window.view(1, 1, -1, 1), padding=(pad, 0))[:, 0]


def dssim_map(preds: Tensor, targets: Tensor, window: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return 1 - SSIM in [0, 2], and the means of both masks in the window. 3 x (n, H, W)"""
    images = torch.cat([preds, targets, preds.square(), targets.square(), preds * targets])
    mean_p, mean_t, square_p, square_t, product = _blur(images, window).chunk(5)
    var_p, var_t = square_p - mean_p.square(), square_t - mean_t.square()
    covariance = product - mean_p * mean_t
    numerator = (2 * mean_p * mean_t + SSIM_C1) * (2 * covariance + SSIM_C2)
    denominator = (mean_p.square() + mean_t.square() + SSIM_C1) * (var_p + var_t + SSIM_C2)
    return 1 - numerator / denominator, mean_p, mean_t


def raster_loss_sums_reference(
    preds: Tensor, targets: Tensor, window_size: int, window_sigma: float, weight: float
) -> Tensor:
    """Sum what Eq. 12 is made of over each instance's pixels. (n, 7)

    With w = 1 + (weight - 1) t: sum w |p - t|, sum w p, sum (1 - SSIM), sum w t, sum (w - 1), and
    the number of pixels whose window sees the target, and either mask.

    Args:
        preds: Predicted masks p in [0, 1]. (n, H, W)
        targets: True masks t in [0, 1]. (n, H, W)
        window_size: Side of SSIM's window in pixels.
        window_sigma: Standard deviation of SSIM's window in pixels.
        weight: Weight of a foreground pixel, where the background has 1.
    """
    excess = (weight - 1) * targets
    weights = 1 + excess
    window = gaussian_window(window_size, window_sigma, preds)
    dissimilarity, mean_p, mean_t = dssim_map(preds, targets, window)
    reach = F.max_pool2d(targets[:, None], window_size, 1, window_size // 2)[:, 0]
    sums = (
        weights * (preds - targets).abs(),
        weights * preds,
        dissimilarity,
        weights * targets,
        excess,
        (reach > 0).to(preds.dtype),
        (torch.maximum(mean_p, mean_t) > SEEN).to(preds.dtype),
    )
    return torch.stack([values.sum((1, 2)) for values in sums], -1)
