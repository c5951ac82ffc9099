"""Torch operators around the numba kernels of the raster loss."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmap.ops._numba import run_in_threads
from gsmap.ops.raster_loss.reference import SEEN, SSIM_C1, SSIM_C2

_DIFFERENTIABLE = 3  # the first sums
_SUMS = 7


def _settings(window: Tensor, weight: float) -> tuple[Any, Any, Any]:
    """Return the kernels' window, constants and weight in float32."""
    constants = np.float32(SSIM_C1), np.float32(SSIM_C2), np.float32(SEEN)
    return window.float().contiguous().numpy(), constants, np.float32(weight)


@torch.library.custom_op("gsmap::raster_loss_sums", mutates_args=(), device_types="cpu")
def raster_loss_sums(preds: Tensor, targets: Tensor, window: Tensor, weight: float) -> Tensor:
    """Return the sums of `raster_loss_sums_reference`; the first three are differentiable.

    Args:
        preds: Masks, float32. (n, H, W)
        targets: Masks, float32. (n, H, W)
        window: SSIM's window along one axis. (size,)
        weight: Weight of a pixel of the ground truth; w = 1 + (weight - 1) t.

    Returns:
        The sums. (n, 7)
    """
    from gsmap.ops.raster_loss.numba_kernels import loss_forward

    sums = torch.empty(len(preds), _SUMS, dtype=torch.float64)
    settings = _settings(window, weight)
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
    grads: Tensor, preds: Tensor, targets: Tensor, window: Tensor, weight: float
) -> Tensor:
    """Return the gradient in the predictions. (n, H, W)"""
    from gsmap.ops.raster_loss.numba_kernels import loss_backward

    gradient = torch.empty(preds.shape, dtype=torch.float32)
    settings = _settings(window, weight)
    arrays = preds.contiguous().numpy(), targets.contiguous().numpy()
    factors = grads[:, :_DIFFERENTIABLE].contiguous().numpy(), gradient.numpy()
    run_in_threads(
        lambda first, last: loss_backward(*arrays, *settings, *factors, first, last),
        len(preds),
        math.prod(preds.shape[1:]),
    )
    return gradient


@raster_loss_sums.register_fake
def _(preds, targets, window, weight):  # type: ignore[no-untyped-def]
    return preds.new_empty(preds.shape[0], _SUMS)


@_raster_loss_backward.register_fake
def _(grads, preds, targets, window, weight):  # type: ignore[no-untyped-def]
    return preds.new_empty(preds.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.weight = inputs[3]


def _differentiate(ctx: Any, grads: Tensor) -> tuple[Any, ...]:
    gradient = _raster_loss_backward(grads, *ctx.saved_tensors, ctx.weight)
    return gradient, None, None, None


raster_loss_sums.register_autograd(_differentiate, setup_context=_setup_context)
