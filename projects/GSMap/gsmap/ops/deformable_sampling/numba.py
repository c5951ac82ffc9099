# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Weighted sums of table rows on a CPU: torch's forward pass with a fused backward pass (numba).

Torch's own backward pass sorts all indices and walks the table twice. This one adds each bag's
gradient to its rows in order, in one thread, so two runs give the same bits.
"""

import torch
import torch.nn.functional as F
from numba import njit

from gsmap.ops._numba import FASTMATH


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def scatter_rows(grads, table, weights, rows, grad_table, grad_weights):
    """Add each bag's gradient (n, C) to its rows (R, C); write that of the weights (n, S)."""
    for bag in range(rows.shape[0]):
        grad = grads[bag]
        for s in range(rows.shape[1]):
            row, weight = rows[bag, s], weights[bag, s]
            source, target = table[row], grad_table[row]
            total = grad[0] * 0
            for c in range(len(grad)):
                total += grad[c] * source[c]
            for c in range(len(grad)):
                target[c] += weight * grad[c]
            grad_weights[bag, s] = total


def sum_rows(table, weights, rows):
    """Return each bag's weighted sum. (R, C), (n, S), (n, S) -> (n, C)"""
    return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def sum_rows_backward(grads, table, weights, rows):
    """Return the gradients in the table and in the weights."""
    gradients = torch.zeros(table.shape), torch.empty(weights.shape)
    arguments = grads, table, weights, rows, *gradients
    scatter_rows(*(x.contiguous().numpy() for x in arguments))
    return gradients
