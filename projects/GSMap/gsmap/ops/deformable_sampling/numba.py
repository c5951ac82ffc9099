# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Weighted sums of table rows on a CPU: torch's forward pass with a fused backward pass (numba).

Torch's own backward pass sorts all indices and walks the table twice. This one adds each bag's
gradient to its rows in order, in one thread, so two runs give the same bits.
"""

import torch
import torch.nn.functional as F
from numba import njit
from torch import Tensor

from gsmap.ops._numba import FASTMATH
from gsmap.ops.backends import register_gradient


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


@torch.library.custom_op("gsmap::sum_rows", mutates_args=(), device_types="cpu")
def sum_rows_cpu(table: Tensor, weights: Tensor, rows: Tensor) -> Tensor:
    """Return each bag's weighted sum. (R, C), (n, S), (n, S) -> (n, C)"""
    return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


@torch.library.custom_op("gsmap::sum_rows_backward", mutates_args=(), device_types="cpu")
def _backward(grads: Tensor, table: Tensor, weights: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the gradients in the table and in the weights."""
    grad_table = torch.zeros(table.shape)
    grad_weights = torch.empty(weights.shape)
    inputs = [x.contiguous().numpy() for x in (grads, table, weights, rows)]
    outputs = [x.numpy() for x in (grad_table, grad_weights)]
    scatter_rows(*inputs, *outputs)
    return grad_table, grad_weights


@sum_rows_cpu.register_fake
def _(table, weights, rows):
    return table.new_empty(rows.shape[0], table.shape[1])


register_gradient(sum_rows_cpu, _backward, tensors=3, differentiable=2)
