# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Fused CPU kernel (numba): sum of the pixelwise minima of each pair of masks.

A ground-truth mask, and therefore the minimum, is zero almost everywhere. The nonzero pixels of
each target are listed once, and each prediction is read only at these pixels. One thread computes a
sum in a fixed order, so results are repeatable.
"""

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import run_in_threads


@njit(nogil=True, cache=True)
def list_pixels(targets):
    """List the nonzero pixels of each target (K, pixels).

    Returns:
        Start of each target's list (K + 1,), indices of the pixels (n,) and their values (n,).
    """
    starts = np.zeros(len(targets) + 1, np.int64)
    for k in range(len(targets)):
        starts[k + 1] = starts[k] + np.count_nonzero(targets[k])
    indices = np.empty(starts[-1], np.int32)
    values = np.empty(starts[-1], np.float32)
    for k in range(len(targets)):
        position = starts[k]
        for pixel in range(targets.shape[1]):
            if targets[k, pixel] != 0:
                indices[position] = pixel
                values[position] = targets[k, pixel]
                position += 1
    return starts, indices, values


@njit(nogil=True, cache=True)
def sum_minima(preds, starts, indices, values, out, first, last):
    """Sum the pixelwise minima of each target and the predictions ``first`` to ``last - 1``.

    Args:
        preds: Flat predicted masks, float32. (N, pixels)
        starts: Start of each target's list of pixels. (K + 1,)
        indices: Indices of the listed pixels. (n,)
        values: Values of the listed pixels. (n,)
        out: Output for the sums, float32. (N, K)
        first: First prediction.
        last: One past the last prediction.
    """
    for n in range(first, last):
        pred = preds[n]
        for k in range(len(starts) - 1):
            total = 0.0
            for i in range(starts[k], starts[k + 1]):
                total += min(pred[indices[i]], values[i])
            out[n, k] = total


def pairwise_minima(preds, targets):
    """Sum the pixelwise minima of each pair of flat float32 masks.

    Shapes: (N, pixels), (K, pixels) -> (N, K). For masks in [0, 1] the sum of minima is the
    intersection of a soft IoU.
    """
    minima = torch.empty(len(preds), len(targets), dtype=torch.float32)
    starts, indices, values = list_pixels(targets.contiguous().numpy())
    # `run_in_threads` divides the predictions among threads, and gives the kernel their range
    # (`first`, `last`). It passes tensors as arrays, so the kernel writes to the memory of
    # `minima`. The work for one prediction is the number of listed pixels, from which
    # `run_in_threads` decides whether threads are worth their start.
    run_in_threads(sum_minima, len(indices), preds, starts, indices, values, minima)
    return minima
