"""GSMap's raster loss (Eq. 12) between two soft masks: weighted L1 and structural dissimilarity."""

import math

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.raster_loss.reference import gaussian_window, raster_loss_sums_reference
from gsmap.utils.errors import InputError

NORMALIZATIONS = ("both", "foreground", "pixels")
# Smallest share of the raster by which the sums are divided with ``normalize="foreground"``.
MIN_FOREGROUND = 0.005
# Masks per step of the reference, whose intermediate values take 30 times the memory of the masks.
AT_ONCE = 512
_EPS = 1e-6  # smallest divisor of the L1 term, for two empty masks
# Operator of torch with kernels for the CPU (numba) and the GPU (Triton): folder and name of the
# function, and its arguments in the syntax of a torch schema.
_raster_loss_sums = fused_operator(
    "raster_loss.raster_loss_sums",
    "Tensor preds, Tensor targets, Tensor window, float weight",
    lambda preds, *_: (len(preds), 7),  # shape of the output: seven sums per mask
    differentiable=1,  # the first tensor has a gradient
)


def check_raster_settings(
    alpha: float,
    foreground_weight: float,
    normalize: str,
    window_size: int,
    window_sigma: float,
) -> None:
    """Check the settings of the raster loss.

    Args:
        alpha: Share of the L1 term, in [0, 1].
        foreground_weight: Weight of a foreground pixel, > 0.
        normalize: Divisor of the sums over pixels.
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels, > 0.

    Raises:
        ValueError: If a setting is outside its range.
    """
    if not 0 <= alpha <= 1:
        raise InputError(f"alpha must lie in [0, 1], got {alpha}.")
    if not 0 < foreground_weight < math.inf:
        raise InputError(f"foreground_weight must be > 0 and finite, got {foreground_weight}.")
    if normalize not in NORMALIZATIONS:
        raise InputError(f"normalize must be one of {NORMALIZATIONS}, got {normalize!r}.")
    if window_size < 1 or window_size % 2 == 0:
        raise InputError(f"window_size must be odd and >= 1, got {window_size}.")
    if not 0 < window_sigma < math.inf:
        raise InputError(f"window_sigma must be > 0 and finite, got {window_sigma}.")


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
    r"""Compute the raster loss :math:`\alpha D_w + (1 - \alpha) L_{D-SSIM}` (GSMap Eq. 12).

    The paper does not define the divisor of the sums over pixels. With the rendered mask R, the
    ground truth R* and :math:`w = 1 + (\mathrm{foreground\_weight} - 1) R^*`, ``normalize`` is one
    of:

    * ``"both"``: :math:`D_w = \sum w |R - R^*| / \sum w (R + R^*)`, and D-SSIM is the mean over the
      pixels whose window covers part of either mask. A prediction that misses its element
      costs about 1 for any size of the element and of the raster. If small Gaussians lie metres off
      their line, the gradient makes them larger until they reach it, not smaller
      (`python -m benchmarks masks`).
    * ``"foreground"``: :math:`D_w` is divided by :math:`\sum w R^*`, and D-SSIM by the number of
      pixels whose window covers part of R*. Both divisors are at least as large as for a mask
      that fills 0.5 % of the raster. If Gaussians lie 2 m off their line, the gradient makes them
      smaller.
    * ``"pixels"``: :math:`D_w` is the mean over the raster weighted by w, and D-SSIM is the mean
      without weights.

    Only the masks are saved for the backward pass; the other values are computed again.

    Args:
        preds: Rendered masks in [0, 1]. (n, H, W)
        targets: Ground-truth masks in [0, 1]. (n, H, W)
        alpha: Share of the L1 term, in [0, 1].
        foreground_weight: Weight of a foreground pixel, relative to a background pixel, > 0.
        normalize: ``"both"``, ``"foreground"`` or ``"pixels"``.
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels, > 0.
        backend: Backend, see `choose_backend`.

    Returns:
        Loss of each mask, differentiable in ``preds``. (n,)

    Raises:
        ValueError: If the shapes disagree, a setting is outside its range, or ``backend`` is
            unknown or does not support the inputs.
    """
    if preds.ndim != 3 or preds.shape != targets.shape:
        raise InputError(
            "preds and targets must both have shape (n, H, W), "
            f"got {tuple(preds.shape)} and {tuple(targets.shape)}."
        )
    check_raster_settings(alpha, foreground_weight, normalize, window_size, window_sigma)
    dtype = torch.promote_types(preds.dtype, torch.float32)
    preds = preds.to(dtype)
    targets = targets.detach().to(dtype)
    # Sums over all pixels would lose precision in the half types of autocast.
    with torch.autocast(preds.device.type, enabled=False):
        backend = choose_backend(backend, preds, kernel="raster_loss")
        if backend != "reference":
            window = gaussian_window(window_size, window_sigma, like=preds)
            sums = _raster_loss_sums(
                preds, targets, window=window, weight=foreground_weight, backend=backend
            )
        else:
            # A checkpoint saves only its inputs for the backward pass.
            parts = []
            # Without masks there is one empty step, so that there is a tensor to concatenate.
            for start in range(0, max(len(preds), 1), AT_ONCE):
                part = checkpoint(
                    raster_loss_sums_reference,
                    preds[start : start + AT_ONCE],
                    targets[start : start + AT_ONCE],
                    window_size,
                    window_sigma,
                    foreground_weight,
                    use_reentrant=False,
                    preserve_rng_state=False,  # nothing is random; saving it would wait for a GPU
                )
                parts.append(part)
            sums = torch.cat(parts)
        # With w as above, `predicted` is the sum of w R, `foreground` the sum of w R*, and `excess`
        # the sum of w - 1. `near_target` and `near_either` count the pixels whose window covers
        # part of R*, or part of either mask.
        l1, predicted, dissimilarity, foreground, excess, near_target, near_either = sums.unbind(-1)
        pixels = math.prod(preds.shape[1:])
        if normalize == "both":
            l1 = l1 / (predicted + foreground).clamp(min=_EPS)
            dissimilarity = dissimilarity / near_either.clamp(min=1)
        elif normalize == "foreground":
            # Smallest number of foreground pixels. Each of them has w = `foreground_weight`.
            floor = MIN_FOREGROUND * pixels
            l1 = l1 / foreground.clamp(min=foreground_weight * floor)
            dissimilarity = dissimilarity / near_target.clamp(min=floor)
        else:
            l1 = l1 / (pixels + excess)  # the sum of w
            dissimilarity = dissimilarity / pixels
        return alpha * l1 + (1 - alpha) * dissimilarity
