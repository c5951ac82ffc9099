# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Fused CPU kernel (numba): the sum of minima of every pair of masks.

A target is 0 almost everywhere, and so is the minimum: each target's pixels that are not 0 are
listed once, and every prediction is read at those alone. A sum runs in a fixed order in one thread.
"""

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import run_in_threads


@njit(nogil=True, cache=True)
def list_pixels(targets):
    """Return where each target's list of pixels that are not 0 starts, their indices and values."""
    starts = np.zeros(len(targets) + 1, np.int64)
    for k in range(len(targets)):
        starts[k + 1] = starts[k] + np.count_nonzero(targets[k])
    indices, values = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    for k in range(len(targets)):
        position = starts[k]
        for pixel in range(targets.shape[1]):
            if targets[k, pixel] != 0:
                indices[position], values[position] = pixel, targets[k, pixel]
                position += 1
    return starts, indices, values


@njit(nogil=True, cache=True)
def sum_minima(preds, starts, indices, values, out, first, last):
    """Write the sums of minima (N, K) of predictions (N, pixels) with every listed target."""
    for n in range(first, last):
        pred = preds[n]
        for k in range(len(starts) - 1):
            total = 0.0
            for i in range(starts[k], starts[k + 1]):
                total += min(pred[indices[i]], values[i])
            out[n, k] = total


def pairwise_minima(preds, targets):
    """Sum the minimum of every pair of flat float32 masks. (N, pixels), (K, pixels) -> (N, K)"""
    minima = torch.empty(len(preds), len(targets), dtype=torch.float32)
    starts, pixels, values = list_pixels(targets.contiguous().numpy())
    run_in_threads(sum_minima, len(pixels), preds, starts, pixels, values, minima)
    return minima
