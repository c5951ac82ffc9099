# Functions of Triton have no types, since Triton infers them.
# mypy: disable-error-code="no-untyped-def"
"""Triton kernel that sums the pixelwise minimum of each pair of masks.

A program computes one pair. It loops over blocks of pixels with one partial sum per lane, and adds
the partial sums at the end. There are no atomics, so repeated runs are equal to the bit.
"""

import torch
import triton
import triton.language as tl

BLOCK = 1024


@triton.jit
def minima_kernel(preds, targets, minima, pixels, BLOCK: tl.constexpr):
    """Sum the pixelwise minimum of one pair of masks.

    Args:
        preds: Flat predicted masks, float32. (N, pixels)
        targets: Flat ground-truth masks, float32. (K, pixels)
        minima: Output for the sums, float32. (N, K)
        pixels: Number of pixels of a mask.
        BLOCK: Number of pixels read at a time.
    """
    k = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1).to(tl.int64)
    sums = tl.zeros((BLOCK,), dtype=tl.float32)
    for start in range(0, pixels, BLOCK):
        index = start + tl.arange(0, BLOCK)
        pred = tl.load(preds + n * pixels + index, mask=index < pixels, other=0.0)
        target = tl.load(targets + k * pixels + index, mask=index < pixels, other=0.0)
        sums += tl.minimum(pred, target)
    tl.store(minima + n * tl.num_programs(0) + k, tl.sum(sums))


def pairwise_minima(preds, targets):
    """Sum the pixelwise minimum of each pair of masks. (N, pixels), (K, pixels) -> (N, K)

    Masks are flat float32 tensors.
    """
    minima = preds.new_empty(len(preds), len(targets))
    if minima.numel():
        with torch.cuda.device_of(preds):
            minima_kernel[len(targets), len(preds)](
                preds.contiguous(),
                targets.contiguous(),
                minima=minima,
                pixels=preds.shape[1],
                BLOCK=BLOCK,
                num_warps=4,
            )
    return minima
