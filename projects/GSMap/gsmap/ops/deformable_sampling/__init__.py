"""Sampling of a feature map at weighted locations, as weighted sums of the rows of a table."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.structures.tensors import at_least_float32

# Operators of torch with the kernels of the modules beside this one, which take a backend as a
# further, last argument. The entries are the name, the arguments, the shape of the output, and the
# number of tensors, from the first one, that have gradients.
_sum_rows = fused_operator(
    "deformable_sampling.sum_rows",
    "Tensor table, Tensor weights, Tensor rows",
    lambda table, weights, rows: (len(rows), table.shape[1]),
    differentiable=2,  # table and weights
)
_deformable_sample = fused_operator(
    "deformable_sampling.deformable_sample",
    "Tensor value, Tensor locations, Tensor weights, int height, int width",
    lambda value, locations, *_: (*locations.shape[:3], value.shape[3]),  # (B, Q, heads, C)
    differentiable=3,  # value, locations and weights
    dtype=torch.float32,
)


def has_kernel(value: Tensor) -> bool:
    """Whether ``backend="auto"`` of `deformable_sample` selects the Triton kernel for a map."""
    like = at_least_float32(value[:0])  # the choice depends on device and type, not on values
    return choose_backend("auto", like, fused=("triton",), kernel="deformable_sample") == "triton"


def deformable_sample(
    value: Tensor,
    shape: tuple[int, int],
    locations: Tensor,
    weights: Tensor,
    backend: str = "auto",
) -> Tensor:
    """Sum weighted bilinear samples of a feature map for each head (Deformable DETR Eq. 2).

    The map is a table with one row of C channels per cell and head, and each output is a weighted
    sum of its rows (`sum_rows`). No tensor of all samples is created.

    Args:
        value: Flattened feature map, row-major, float32 or half precision. (B, H * W, heads, C)
        shape: Rows H and columns W of the map.
        locations: Sampling points (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        weights: Attention weights. (B, Q, heads, S)
        backend: A backend of `sum_rows`, or ``"triton"``: one kernel for the forward pass, and one
            for the backward pass. The latter sums the gradient of the map in an order that differs
            between runs.

    Returns:
        Sums of all heads, concatenated, differentiable in ``value``, ``locations`` and
        ``weights``. They have the wider type of value and weights, at least float32.
        (B, Q, heads * C)

    Raises:
        ValueError: If ``"triton"`` does not support the inputs, or if `sum_rows` raises an error
            for another backend.
    """
    dtype = torch.promote_types(value.dtype, weights.dtype)
    dtype = torch.promote_types(dtype, torch.float32)
    locations = locations.to(dtype)
    weights = weights.to(dtype)
    if backend in ("auto", "triton"):
        fused = choose_backend(backend, weights, fused=("triton",), kernel="deformable_sample")
        if fused == "triton":
            height, width = shape
            sums = _deformable_sample(
                value, locations, weights=weights, height=height, width=width, backend=fused
            )
            return sums.flatten(2)
    value = value.to(dtype)
    batch, num_cells, heads, channels = value.shape
    cells, cell_weights = bilinear_cells(locations, weights, shape=shape)  # (B, Q, heads, 4 S)
    # The rows of the table are ordered by sample, then by cell, then by head.
    sample = torch.arange(batch, device=value.device).view(-1, 1, 1, 1)
    head = torch.arange(heads, device=value.device).view(1, 1, -1, 1)
    rows = (sample * num_cells + cells) * heads + head
    table = value.reshape(-1, channels)
    return sum_rows(table, rows, weights=cell_weights, backend=backend).flatten(2)


def bilinear_cells(
    locations: Tensor, weights: Tensor, shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Find the four cells around each sampling point, and their weights.

    The value of a cell lies at its centre (``align_corners=False``).

    Args:
        locations: Sampling points (x, y), [0, 1] over the map. (..., S, 2)
        weights: Weights of the sampling points. (..., S)
        shape: Rows and columns of the map.

    Returns:
        Row-major indices of the cells, and their weights, both (..., 4 S). Cells outside of the map
        have index 0 and weight 0. The cells of a NaN location have index 0 and NaN weights.
    """
    height, width = shape
    x = locations[..., 0] * width - 0.5
    y = locations[..., 1] * height - 0.5
    # Column and row of the upper left cell of the four.
    x0 = x.detach().floor()
    y0 = y.detach().floor()
    right = x - x0
    lower = y - y0
    cells = []
    cell_weights = []
    for col, share_x in ((x0, 1 - right), (x0 + 1, right)):
        for row, share_y in ((y0, 1 - lower), (y0 + 1, lower)):
            inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
            cells.append(torch.where(inside, row * width + col, 0))
            cell_weights.append(share_x * share_y * weights * inside)
    return torch.cat(cells, dim=-1).long(), torch.cat(cell_weights, dim=-1)


def sum_rows(table: Tensor, rows: Tensor, weights: Tensor, backend: str = "auto") -> Tensor:
    """Sum weighted rows of a table, without creating a tensor of all the selected rows.

    Args:
        table: Rows of C channels. (R, C)
        rows: Indices of the rows of each sum. (..., S)
        weights: Weights of the rows. (..., S)
        backend: ``"reference"`` (torch's embedding bags), ``"cpu"`` (torch's forward pass with a
            fused backward pass), or ``"auto"``.

    Returns:
        Sums, differentiable in ``table`` and ``weights``. (..., C)

    Raises:
        ValueError: If a gradient is needed, and ``backend`` is unknown or does not support the
            table. Without a gradient, the backend is not used.
    """
    bags = rows.reshape(-1, rows.shape[-1])
    factors = weights.reshape(-1, rows.shape[-1]).to(table.dtype)
    wants_gradient = torch.is_grad_enabled() and (table.requires_grad or factors.requires_grad)
    # The fused backend has torch's forward pass, and differs in the backward pass only.
    if not wants_gradient or choose_backend(backend, table, fused=("cpu",)) == "reference":
        out = F.embedding_bag(bags, table, per_sample_weights=factors, mode="sum")
    else:
        out = _sum_rows(table, factors, rows=bags, backend="cpu")
    return out.view((*rows.shape[:-1], table.shape[-1]))
