# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Weighted sums of table rows on a CPU: torch's forward pass with a fused backward pass (numba).

The backward pass of torch sorts all indices and goes through the table twice. The backward pass
here adds the gradient of each sum to the rows of the sum in order, in one thread, so repeated runs
are bitwise equal.

`fused_operator` finds `sum_rows` and `sum_rows_backward` by their names, and makes an operator of
torch of them. They are called with float32 tensors.
"""

import torch
import torch.nn.functional as F
from numba import njit

from gsmap.ops._numba import FASTMATH


# FASTMATH allows the compiler to reorder sums, so that they are computed in vector lanes.
@njit(nogil=True, cache=True, fastmath=FASTMATH)
def scatter_rows(grads, table, weights, rows, grad_table, grad_weights):
    """Compute the gradients of weighted sums of table rows.

    Args:
        grads: Gradient of each sum. (n, C)
        table: Rows of C channels. (R, C)
        weights: Weights of the rows of each sum. (n, S)
        rows: Indices of the rows of each sum. (n, S)
        grad_table: Output, to which the gradient of the table is added. (R, C)
        grad_weights: Output for the gradient of the weights. (n, S)
    """
    for bag in range(rows.shape[0]):  # a bag is one sum, as in torch's embedding_bag
        grad = grads[bag]
        for s in range(rows.shape[1]):
            row = rows[bag, s]
            weight = weights[bag, s]
            table_row = table[row]
            grad_table_row = grad_table[row]
            grad_weight = grad[0] * 0  # zero in the type of the gradient
            for c in range(len(grad)):
                grad_weight += grad[c] * table_row[c]
            for c in range(len(grad)):
                grad_table_row[c] += weight * grad[c]
            grad_weights[bag, s] = grad_weight


def sum_rows(table, weights, rows):
    """Sum weighted rows of a table.

    Args:
        table: Rows of C channels. (R, C)
        weights: Weights of the rows of each sum. (n, S)
        rows: Indices of the rows of each sum. (n, S)

    Returns:
        Sums. (n, C)
    """
    return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def sum_rows_backward(grads, table, weights, rows):
    """Compute the gradients of `sum_rows`.

    Args:
        grads: Gradient of the sums. (n, C)
        table: Rows of C channels. (R, C)
        weights: Weights of the rows of each sum. (n, S)
        rows: Indices of the rows of each sum. (n, S)

    Returns:
        Gradients of the table (R, C) and of the weights (n, S).
    """
    grad_table = torch.zeros(table.shape)  # gradients are added to it
    grad_weights = torch.empty(weights.shape)  # every entry is written
    scatter_rows(
        grads.contiguous().numpy(),
        table.contiguous().numpy(),
        weights=weights.contiguous().numpy(),
        rows=rows.contiguous().numpy(),
        grad_table=grad_table.numpy(),
        grad_weights=grad_weights.numpy(),
    )
    return grad_table, grad_weights
