"""Torch operators around the numba kernels of the raster loss."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..ops._numba import run_in_threads


def _settings(window: Tensor, c1: float, c2: float, weight: float) -> tuple[Any, Any, Any]:
    """Return the kernels' window, constants and weight in float32."""
    constants = np.float32(c1), np.float32(c2)
    return window.float().contiguous().numpy(), constants, np.float32(weight)


@torch.library.custom_op("gsmap::raster_loss_sums", mutates_args=(), device_types="cpu")
def raster_loss_sums(
    preds: Tensor, targets: Tensor, window: Tensor, c1: float, c2: float, weight: float
) -> Tensor:
    """Sum an instance's weighted L1 and dissimilarity, and what they are divided by.

    Args:
        preds: Masks, float32. (n, H, W)
        targets: Masks, float32. (n, H, W)
        window: SSIM's window along one axis. (size,)
        c1: SSIM's constant of the means.
        c2: SSIM's constant of the variances.
        weight: Weight of a pixel of the ground truth; w = 1 + (weight - 1) t.

    Returns:
        sum w |p - t|, sum w t, sum (w - 1), sum (1 - SSIM) and the number of pixels whose window
        sees the target; the first and fourth are differentiable in ``preds``. (n, 5)
    """
    from .raster_kernels import loss_forward

    sums = torch.empty(len(preds), 5, dtype=torch.float64)
    settings = _settings(window, c1, c2, weight)
    arrays = preds.contiguous().numpy(), targets.contiguous().numpy()
    results = sums.numpy()
    run_in_threads(
        lambda first, last: loss_forward(*arrays, *settings, results, first, last),
        len(preds),
        math.prod(preds.shape[1:]),
    )
    return sums.float()


@torch.library.custom_op("gsmap::raster_loss_backward", mutates_args=(), device_types="cpu")
def _raster_loss_backward(
    grads: Tensor,
    preds: Tensor,
    targets: Tensor,
    window: Tensor,
    c1: float,
    c2: float,
    weight: float,
) -> Tensor:
    """Return the gradient in the predictions. (n, H, W)"""
    from .raster_kernels import loss_backward

    gradient = torch.empty(preds.shape, dtype=torch.float32)
    settings = _settings(window, c1, c2, weight)
    arrays = preds.contiguous().numpy(), targets.contiguous().numpy()
    factors = grads[:, [0, 3]].contiguous().numpy(), gradient.numpy()
    run_in_threads(
        lambda first, last: loss_backward(*arrays, *settings, *factors, first, last),
        len(preds),
        math.prod(preds.shape[1:]),
    )
    return gradient


@raster_loss_sums.register_fake
def _(preds, targets, window, c1, c2, weight):  # type: ignore[no-untyped-def]
    return preds.new_empty(preds.shape[0], 5)


@_raster_loss_backward.register_fake
def _(grads, preds, targets, window, c1, c2, weight):  # type: ignore[no-untyped-def]
    return preds.new_empty(preds.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.constants = inputs[3:]


def _differentiate(ctx: Any, grads: Tensor) -> tuple[Any, ...]:
    gradient = _raster_loss_backward(grads, *ctx.saved_tensors, *ctx.constants)
    return gradient, None, None, None, None, None


raster_loss_sums.register_autograd(_differentiate, setup_context=_setup_context)
