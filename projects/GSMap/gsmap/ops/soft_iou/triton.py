# Functions of Triton have no types, since Triton infers them.
# mypy: disable-error-code="no-untyped-def"
"""Triton kernel that sums the pixelwise minimum of each pair of masks.

A program is one instance of the kernel. It computes one pair of a prediction and a ground truth. It
loops over blocks of pixels. Each position in the block has a partial sum, and the partial sums are
added at the end. There are no atomics, so the order of the additions is fixed, and repeated runs
are equal to the bit.
"""

import torch
import triton
import triton.language as tl

BLOCK = 1024  # pixels read at a time


@triton.jit
def minima_kernel(preds, targets, minima, pixels, BLOCK: tl.constexpr):
    """Sum the pixelwise minimum of one pair of masks.

    Triton passes each tensor as a pointer to its first value, so the tensors must be contiguous.

    Args:
        preds: Flat predicted masks, float32. (N, pixels)
        targets: Flat ground-truth masks, float32. (K, pixels)
        minima: Output for the sums, float32. (N, K)
        pixels: Number of pixels of a mask.
        BLOCK: Number of pixels read at a time.
    """
    # With int64, the positions n * pixels and k * pixels cannot overflow.
    k = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1).to(tl.int64)
    sums = tl.zeros((BLOCK,), dtype=tl.float32)  # partial sum of each position in the block
    for start in range(0, pixels, BLOCK):
        index = start + tl.arange(0, BLOCK)  # pixels of this block
        # Beyond the last pixel nothing is read (``mask`` is an argument of Triton), and 0 is added.
        pred = tl.load(preds + n * pixels + index, mask=index < pixels, other=0.0)
        target = tl.load(targets + k * pixels + index, mask=index < pixels, other=0.0)
        sums += tl.minimum(pred, target)
    tl.store(minima + n * tl.num_programs(0) + k, tl.sum(sums))  # num_programs(0) is K


def pairwise_minima(preds, targets):
    """Sum the pixelwise minimum of each pair of masks. (N, pixels), (K, pixels) -> (N, K)

    Masks are flat float32 tensors on a GPU.
    """
    minima = preds.new_empty(len(preds), len(targets))
    if minima.numel():  # a kernel cannot be launched without programs
        with torch.cuda.device_of(preds):  # Triton launches on the current device
            # The brackets have the numbers of programs: K along axis 0, and N along axis 1.
            minima_kernel[len(targets), len(preds)](
                preds.contiguous(),
                targets.contiguous(),
                minima=minima,
                pixels=preds.shape[1],
                BLOCK=BLOCK,
                num_warps=4,
            )
    return minima
