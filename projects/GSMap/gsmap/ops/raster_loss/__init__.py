"""GSMap's raster loss (Eq. 12) between two soft masks: weighted L1 and structural dissimilarity."""

import math

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.raster_loss.reference import gaussian_window, raster_loss_sums_reference

NORMALIZATIONS = ("both", "foreground", "pixels")
MIN_FOREGROUND = 0.005  # "foreground": a smaller ground truth counts as this share of the raster
AT_ONCE = 512  # masks whose values in between are in memory at once, some 30 times their own
_EPS = 1e-6
_raster_loss_sums = fused_operator(
    "raster_loss.raster_loss_sums",
    "Tensor preds, Tensor targets, Tensor window, float weight",
    lambda preds, *_: (len(preds), 7),
    differentiable=1,
)


def raster_loss(
    preds: Tensor,
    targets: Tensor,
    alpha: float = 0.8,
    foreground_weight: float = 1.0,
    normalize: str = "both",
    window_size: int = 11,
    window_sigma: float = 1.5,
    backend: str = "auto",
) -> Tensor:
    r"""Per-instance raster loss :math:`\alpha D_w + (1 - \alpha) L_{D-SSIM}` (GSMap Eq. 12).

    The paper leaves open what the sums over pixels are divided by. With R the rendered mask, R* the
    ground truth and :math:`w = 1 + (\mathrm{foreground\_weight} - 1) R^*`, ``normalize`` chooses:

    * ``"both"``: :math:`D_w = \sum w |R - R^*| / \sum w (R + R^*)`; D-SSIM is the mean over the
      pixels whose window sees either mask. A miss costs about 1 whatever the size of the element
      or of the raster. Small Gaussians that lie off their line by metres are pushed to grow until
      they find it, not to vanish (`python -m benchmarks masks`).
    * ``"foreground"``: D_w by :math:`\sum w R^*`, D-SSIM by the pixels whose window sees R*, each
      at least 0.5 % of the raster. Gaussians that lie off by 2 m are pushed to shrink.
    * ``"pixels"``: plain means over the raster, weighted by w.

    Nothing but the masks is kept for the backward pass; the rest is computed again. The values are
    differentiable in ``preds``. -> (n,)

    Args:
        preds: Rendered masks in [0, 1]. (n, H, W)
        targets: Ground-truth masks in [0, 1]. (n, H, W)
        alpha: Share of the L1 term.
        foreground_weight: Weight of a pixel of the ground truth against one of the background.
        normalize: ``"both"``, ``"foreground"`` or ``"pixels"``.
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels.
        backend: As in `choose_backend`.

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
        backend = choose_backend(backend, preds, kernel="raster_loss")
        if backend != "reference":
            window = gaussian_window(window_size, window_sigma, preds)
            sums = _raster_loss_sums(preds, targets, window, foreground_weight, backend)
        else:
            parts = [
                checkpoint(
                    raster_loss_sums_reference,
                    *part,
                    window_size,
                    window_sigma,
                    foreground_weight,
                    use_reentrant=False,
                    preserve_rng_state=False,  # nothing is random; saving it would wait for a GPU
                )
                for part in zip(preds.split(AT_ONCE), targets.split(AT_ONCE), strict=True)
            ]
            sums = torch.cat(parts)
        l1, predicted, dissimilarity, foreground, excess, sees_target, sees_either = sums.unbind(-1)
        pixels = math.prod(preds.shape[1:])
        if normalize == "both":
            l1 = l1 / (predicted + foreground).clamp(min=_EPS)
            dissimilarity = dissimilarity / sees_either.clamp(min=1)
        elif normalize == "foreground":
            floor = MIN_FOREGROUND * pixels
            l1 = l1 / foreground.clamp(min=foreground_weight * floor)
            dissimilarity = dissimilarity / sees_target.clamp(min=floor)
        else:
            l1, dissimilarity = l1 / (pixels + excess), dissimilarity / pixels
        return alpha * l1 + (1 - alpha) * dissimilarity
