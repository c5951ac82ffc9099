"""Soft intersection over union of masks: sum(min) / sum(max)."""

from collections.abc import Callable

import torch
from torch import Tensor

from gsmap.ops._numba import run_in_threads
from gsmap.ops.backends import choose_backend


def pairwise_soft_iou(
    preds: Tensor, targets: Tensor, eps: float = 1e-6, backend: str = "auto"
) -> Tensor:
    r"""Soft IoU of every prediction with every ground truth, without an (N, K, H, W) tensor.

    :math:`\sum_p \min(a, b) / \sum_p \max(a, b)`; since min + max = a + b, only the minimum is
    summed per pair.

    Args:
        preds: Masks in [0, 1]. (N, H, W)
        targets: Masks in [0, 1]. (K, H, W)
        eps: Added to the union, so that two empty masks have IoU 0.
        backend: ``"reference"`` (plain torch), ``"cpu"`` or ``"triton"`` (fused), or ``"auto"``: a
            fused kernel where it serves and no gradient is asked for.

    Returns:
        IoU in [0, 1]; without gradient from the fused kernels. (N, K)

    Raises:
        ValueError: If the shapes disagree or ``backend`` does not serve.
    """
    if preds.ndim != 3 or targets.ndim != 3 or preds.shape[1:] != targets.shape[1:]:
        raise ValueError(
            "preds and targets must have shapes (N, H, W) and (K, H, W), "
            f"got {tuple(preds.shape)} and {tuple(targets.shape)}."
        )
    dtype = torch.promote_types(preds.dtype, torch.float32)
    preds, targets = preds.to(dtype).flatten(1), targets.to(dtype).flatten(1)  # (N, HW), (K, HW)
    wants_gradient = torch.is_grad_enabled() and (preds.requires_grad or targets.requires_grad)
    if backend == "auto" and wants_gradient:
        backend = "reference"
    backend = choose_backend(backend, preds)
    if backend != "reference":
        preds, targets = preds.detach(), targets.detach()
    minima = MINIMA[backend](preds, targets)
    union = preds.sum(-1)[:, None] + targets.sum(-1) - minima
    return minima / (union + eps)


def _minima_reference(preds: Tensor, targets: Tensor) -> Tensor:
    """Sum the minimum of every pair, one target at a time. (N, HW), (K, HW) -> (N, K)"""
    if not len(targets):
        return preds.new_zeros(len(preds), 0)
    return torch.stack([torch.minimum(preds, target).sum(-1) for target in targets], -1)


@torch.library.custom_op("gsmap::pairwise_minima_cpu", mutates_args=())
def _minima_cpu(preds: Tensor, targets: Tensor) -> Tensor:
    """Sum the minimum of every pair of flat float32 masks. (N, HW), (K, HW) -> (N, K)"""
    from gsmap.ops.soft_iou.cpu_kernels import list_pixels, sum_minima

    minima = torch.empty(len(preds), len(targets), dtype=torch.float32)
    starts, pixels, values = list_pixels(targets.contiguous().numpy())
    array, out = preds.contiguous().numpy(), minima.numpy()
    run_in_threads(
        lambda first, last: sum_minima(array, starts, pixels, values, out, first, last),
        len(preds),
        len(pixels),
    )
    return minima


@_minima_cpu.register_fake
def _(preds, targets):  # type: ignore[no-untyped-def]
    return preds.new_empty(preds.shape[0], targets.shape[0])


@torch.library.custom_op("gsmap::pairwise_minima_triton", mutates_args=())
def _minima_triton(preds: Tensor, targets: Tensor) -> Tensor:
    """Sum the minimum of every pair of flat float32 masks. (N, HW), (K, HW) -> (N, K)"""
    from gsmap.ops.soft_iou.triton import pairwise_minima

    return pairwise_minima(preds, targets)


@_minima_triton.register_fake
def _(preds, targets):  # type: ignore[no-untyped-def]
    return preds.new_empty(preds.shape[0], targets.shape[0])


MINIMA: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "reference": _minima_reference,
    "cpu": _minima_cpu,
    "triton": _minima_triton,
}
