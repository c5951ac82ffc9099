"""Sampling of a map at weighted places: one weighted bag of table rows per output."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.structures.tensors import at_least_float32

_sum_rows = fused_operator(
    "deformable_sampling.sum_rows",
    "Tensor table, Tensor weights, Tensor rows",
    lambda table, weights, rows: (len(rows), table.shape[1]),
    differentiable=2,
)
_deformable_sample = fused_operator(
    "deformable_sampling.deformable_sample",
    "Tensor value, Tensor locations, Tensor weights, int height, int width",
    lambda value, locations, *_: (*locations.shape[:3], value.shape[3]),
    differentiable=3,
    dtype=torch.float32,
)


def has_kernel(value: Tensor) -> bool:
    """Return whether `deformable_sample` samples a map by one kernel, if it chooses itself."""
    like = at_least_float32(value[:0])
    return choose_backend("auto", like, ("triton",), "deformable_sample") == "triton"


def deformable_sample(
    value: Tensor,
    shape: tuple[int, int],
    locations: Tensor,
    weights: Tensor,
    backend: str = "auto",
) -> Tensor:
    """Sum bilinear samples of a map, each head with its own places (Deformable DETR Eq. 2).

    Each output row is one weighted bag of table rows: no tensor of samples in between. The heads'
    sums are concatenated, in the wider type of map and weights, at least float32.
    -> (B, Q, heads * C)

    Args:
        value: Flattened map, row-major, also in half precision. (B, H * W, heads, C)
        shape: Rows and columns of the map.
        locations: Sampling points (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        weights: Attention weights. (B, Q, heads, S)
        backend: As in `sum_rows`; ``"triton"`` is one kernel forward and one backward, which adds
            the map's gradient up in any order.

    Raises:
        ValueError: If ``backend`` does not serve.
    """
    dtype = torch.promote_types(torch.promote_types(value.dtype, weights.dtype), torch.float32)
    locations, weights = locations.to(dtype), weights.to(dtype)
    if backend in ("auto", "triton"):
        fused = choose_backend(backend, weights, ("triton",), "deformable_sample")
        if fused == "triton":
            return _deformable_sample(value, locations, weights, *shape, fused).flatten(2)
    value = value.to(dtype)
    batch, num_cells, heads, channels = value.shape
    cells, cell_weights = bilinear_cells(locations, weights, shape)  # (B, Q, heads, 4 S)
    sample = torch.arange(batch, device=value.device).view(-1, 1, 1, 1)
    head = torch.arange(heads, device=value.device).view(1, 1, -1, 1)
    rows = (sample * num_cells + cells) * heads + head
    return sum_rows(value.reshape(-1, channels), rows, cell_weights, backend).flatten(2)


def bilinear_cells(
    locations: Tensor, weights: Tensor, shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return the cells (row-major) around sampling locations, and their weights. 2 x (..., 4 S)

    The value of a cell lies at its centre (``align_corners=False``). Outside the map both are zero;
    a location that is not a number has a valid index and its weight is not a number.

    Args:
        locations: Sampling points (x, y), [0, 1] over the map. (..., S, 2)
        weights: Their weights. (..., S)
        shape: Rows and columns of the map.
    """
    height, width = shape
    x, y = locations[..., 0] * width - 0.5, locations[..., 1] * height - 0.5
    x0, y0 = x.detach().floor(), y.detach().floor()
    right, lower = x - x0, y - y0
    cells, cell_weights = [], []
    for col, wx in ((x0, 1 - right), (x0 + 1, right)):
        for row, wy in ((y0, 1 - lower), (y0 + 1, lower)):
            inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
            cells.append(torch.where(inside, row * width + col, 0))
            cell_weights.append(wx * wy * weights * inside)
    return torch.cat(cells, -1).long(), torch.cat(cell_weights, -1)


def sum_rows(table: Tensor, rows: Tensor, weights: Tensor, backend: str = "auto") -> Tensor:
    """Sum weighted rows of a table, without a tensor of all the rows in between. (..., C)

    The sums are differentiable in ``table`` and ``weights``.

    Args:
        table: The table. (R, C)
        rows: Row indices. (..., S)
        weights: Their weights. (..., S)
        backend: ``"reference"`` (torch's embedding bags), ``"cpu"`` (the same forward pass with a
            fused backward pass), or ``"auto"``.
    """
    bags = rows.reshape(-1, rows.shape[-1])
    factors = weights.reshape(-1, rows.shape[-1]).to(table.dtype)
    wants_gradient = torch.is_grad_enabled() and (table.requires_grad or factors.requires_grad)
    if not wants_gradient or choose_backend(backend, table, ("cpu",)) == "reference":
        out = F.embedding_bag(bags, table, per_sample_weights=factors, mode="sum")
    else:
        out = _sum_rows(table, factors, bags, "cpu")
    return out.view(*rows.shape[:-1], table.shape[-1])
