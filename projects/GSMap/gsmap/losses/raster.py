"""GSMap's raster loss: weighted L1 and structural dissimilarity between soft masks (Eq. 12)."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from ..ops.backends import choose_backend
from .raster_cpu import raster_loss_sums

SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # the usual constants for values in [0, 1]
MIN_FOREGROUND = 0.005  # a smaller ground truth counts as this share of the raster (about 9 m^2)
NORMALIZATIONS = ("foreground", "pixels")


def gaussian_window(size: int, sigma: float, like: Tensor) -> Tensor:
    """Return a 1D Gaussian window that sums to one. (size,)"""
    offsets = torch.arange(size, device=like.device, dtype=like.dtype) - (size - 1) / 2
    window = torch.exp(-0.5 * (offsets / sigma).square())
    return window / window.sum()


def _blur(images: Tensor, window: Tensor) -> Tensor:
    """Filter with a separable window, zeros outside the image. (n, H, W)"""
    pad = len(window) // 2
    columns = F.conv2d(images[:, None], window.view(1, 1, 1, -1), padding=(0, pad))
    return F.conv2d(columns, window.view(1, 1, -1, 1), padding=(pad, 0))[:, 0]


def dssim_map(preds: Tensor, targets: Tensor, size: int = 11, sigma: float = 1.5) -> Tensor:
    """Structural dissimilarity 1 - SSIM at every pixel.

    Args:
        preds: Masks in [0, 1]. (n, H, W)
        targets: Masks in [0, 1]. (n, H, W)
        size: Side of the Gaussian window in pixels, odd.
        sigma: Standard deviation of the window in pixels.

    Returns:
        Dissimilarity in [0, 2]; 0 where both windows are empty. (n, H, W)
    """
    window = gaussian_window(size, sigma, preds)
    mean_p, mean_t = _blur(preds, window), _blur(targets, window)
    var_p = _blur(preds.square(), window) - mean_p.square()
    var_t = _blur(targets.square(), window) - mean_t.square()
    covariance = _blur(preds * targets, window) - mean_p * mean_t
    numerator = (2 * mean_p * mean_t + SSIM_C1) * (2 * covariance + SSIM_C2)
    denominator = (mean_p.square() + mean_t.square() + SSIM_C1) * (var_p + var_t + SSIM_C2)
    return 1 - numerator / denominator


def raster_loss_sums_reference(
    preds: Tensor, targets: Tensor, window_size: int, window_sigma: float, weight: float
) -> Tensor:
    """Sum what Eq. 12 is made of over each instance's pixels.

    Args:
        preds: Masks in [0, 1]. (n, H, W)
        targets: Masks in [0, 1]. (n, H, W)
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels.
        weight: Weight of a pixel of the ground truth; w = 1 + (weight - 1) t.

    Returns:
        sum w |p - t|, sum w t, sum (w - 1), sum (1 - SSIM) and the number of pixels whose window
        sees the target. (n, 5)
    """
    excess = (weight - 1) * targets
    weights = 1 + excess
    reach = F.max_pool2d(targets[:, None], window_size, 1, window_size // 2)[:, 0]
    sums = (
        weights * (preds - targets).abs(),
        weights * targets,
        excess,
        dssim_map(preds, targets, window_size, window_sigma),
        (reach > 0).to(preds.dtype),
    )
    return torch.stack([values.sum((1, 2)) for values in sums], -1)


def raster_loss(
    preds: Tensor,
    targets: Tensor,
    alpha: float = 0.8,
    foreground_weight: float = 5.0,
    normalize: str = "foreground",
    window_size: int = 11,
    window_sigma: float = 1.5,
    backend: str = "auto",
) -> Tensor:
    r"""Per-instance raster loss :math:`\alpha D_w + (1 - \alpha) L_{D-SSIM}` (GSMap Eq. 12).

    :math:`D_w = \sum_p w_p |R_p - R^*_p| / \sum_p w_p R^*_p` with
    :math:`w = 1 + (\mathrm{foreground\_weight} - 1) R^*`; :math:`L_{D-SSIM}` sums 1 - SSIM and
    divides by the number of pixels whose window sees the ground truth. So a miss costs about 1
    whatever the size of the element or of the raster, and empty background adds nothing. With
    ``normalize="pixels"`` both are plain means over the raster's pixels (weighted by w).

    Nothing but the masks is kept for the backward pass; the rest is computed again.

    Args:
        preds: Rendered masks in [0, 1]. (n, H, W)
        targets: Ground-truth masks in [0, 1]. (n, H, W)
        alpha: Share of the L1 term.
        foreground_weight: Weight of a pixel of the ground truth against one of the background.
        normalize: ``"foreground"`` or ``"pixels"``.
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels.
        backend: ``"reference"``, ``"cpu"`` (fused), or ``"auto"``.

    Returns:
        One value per instance, differentiable in ``preds``. (n,)

    Raises:
        ValueError: If the shapes disagree, or ``normalize`` or ``backend`` does not serve.
    """
    if preds.ndim != 3 or preds.shape != targets.shape:
        raise ValueError(
            "preds and targets must both have shape (n, H, W), "
            f"got {tuple(preds.shape)} and {tuple(targets.shape)}."
        )
    if normalize not in NORMALIZATIONS:
        raise ValueError(f"normalize must be one of {NORMALIZATIONS}, got {normalize!r}.")
    dtype = torch.promote_types(preds.dtype, torch.float32)
    preds, targets = preds.to(dtype), targets.detach().to(dtype)
    with torch.autocast(preds.device.type, enabled=False):
        if choose_backend(backend, preds, ("cpu",)) == "cpu":
            window = gaussian_window(window_size, window_sigma, preds)
            constants = SSIM_C1, SSIM_C2, foreground_weight
            sums = raster_loss_sums(preds, targets, window, *constants)
        else:
            settings = window_size, window_sigma, foreground_weight
            sums = checkpoint(
                raster_loss_sums_reference,
                preds,
                targets,
                *settings,
                use_reentrant=False,
                preserve_rng_state=False,  # nothing is random, and saving it would wait for a GPU
            )
        l1, foreground, excess, dissimilarity, seen = sums.unbind(-1)
        pixels = math.prod(preds.shape[1:])
        if normalize == "pixels":
            return alpha * l1 / (pixels + excess) + (1 - alpha) * dissimilarity / pixels
        floor = MIN_FOREGROUND * pixels
        l1 = l1 / foreground.clamp(min=foreground_weight * floor)
        return alpha * l1 + (1 - alpha) * dissimilarity / seen.clamp(min=floor)


class RasterLoss(nn.Module):
    """Raster loss of matched instances, averaged over them (GSMap Eq. 12).

    Args:
        loss_weight: Weight of the loss: the paper's lambda_r.
        alpha: Share of the weighted L1 term: the paper's lambda_alpha. 0 and 1 switch a term off.
        foreground_weight: Weight of a ground-truth pixel in the L1 term; 1 is plain L1.
        normalize: ``"foreground"``: each instance by its own foreground; ``"pixels"``: plain means.
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels.

    Raises:
        ValueError: If an argument is outside its range.
    """

    def __init__(
        self,
        loss_weight: float = 10.0,
        alpha: float = 0.8,
        foreground_weight: float = 5.0,
        normalize: str = "foreground",
        window_size: int = 11,
        window_sigma: float = 1.5,
    ) -> None:
        super().__init__()
        if not 0 <= alpha <= 1:
            raise ValueError(f"alpha must lie in [0, 1], got {alpha}.")
        if foreground_weight <= 0:
            raise ValueError(f"foreground_weight must be > 0, got {foreground_weight}.")
        if normalize not in NORMALIZATIONS:
            raise ValueError(f"normalize must be one of {NORMALIZATIONS}, got {normalize!r}.")
        if window_size < 1 or window_size % 2 == 0:
            raise ValueError(f"window_size must be odd and >= 1, got {window_size}.")
        if window_sigma <= 0:
            raise ValueError(f"window_sigma must be > 0, got {window_sigma}.")
        self.loss_weight, self.alpha = loss_weight, alpha
        self.foreground_weight, self.normalize = foreground_weight, normalize
        self.window_size, self.window_sigma = window_size, window_sigma

    def forward(
        self, preds: Tensor, targets: Tensor, avg_factor: float | Tensor | None = None
    ) -> Tensor:
        """Return the weighted loss.

        Args:
            preds: Rendered masks of the matched instances. (n, H, W)
            targets: Masks of their ground truths. (n, H, W)
            avg_factor: What the sum over instances is divided by; n without it.

        Returns:
            The loss; 0 with a gradient of 0 if nothing is matched. ()
        """
        if not len(preds):
            return preds.float().sum() * 0
        losses = raster_loss(
            preds,
            targets,
            self.alpha,
            self.foreground_weight,
            self.normalize,
            self.window_size,
            self.window_sigma,
        )
        return self.loss_weight * losses.sum() / (len(preds) if avg_factor is None else avg_factor)
