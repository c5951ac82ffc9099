# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Triton kernel: the sum of minima of every pair of masks.

A program owns one pair and walks over its pixels in blocks, one partial sum per lane, added up at
the end: no atomics, so two runs give the same bits.
"""

import torch
import triton
import triton.language as tl

BLOCK = 1024


@triton.jit
def minima_kernel(preds, targets, minima, pixels, BLOCK: tl.constexpr):
    """Sum min(a, b) over the pixels of one pair: (N, pixels), (K, pixels) to (N, K)."""
    k, n = tl.program_id(0).to(tl.int64), tl.program_id(1).to(tl.int64)
    sums = tl.zeros((BLOCK,), tl.float32)
    for start in range(0, pixels, BLOCK):
        index = start + tl.arange(0, BLOCK)
        pred = tl.load(preds + n * pixels + index, mask=index < pixels, other=0.0)
        target = tl.load(targets + k * pixels + index, mask=index < pixels, other=0.0)
        sums += tl.minimum(pred, target)
    tl.store(minima + n * tl.num_programs(0) + k, tl.sum(sums))


def pairwise_minima(preds, targets):
    """Sum the minimum of every pair of flat float32 masks. (N, pixels), (K, pixels) -> (N, K)"""
    minima = preds.new_empty(len(preds), len(targets))
    if minima.numel():
        preds, targets = preds.contiguous(), targets.contiguous()
        with torch.cuda.device_of(preds):
            launch = minima_kernel[len(targets), len(preds)]
            launch(preds, targets, minima, preds.shape[1], BLOCK=BLOCK, num_warps=4)
    return minima
