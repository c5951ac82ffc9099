"""Sampling of camera features by fixed kernels around projected points (GKT)."""

import torch
from torch import Tensor

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.kernel_sampling.reference import sample_kernels_reference
from gsmap.structures.tensors import at_least_float32

_sample_kernels = fused_operator(
    "kernel_sampling.sample_kernels",
    "Tensor value, Tensor uv, Tensor weights, Tensor seen, Tensor offsets, int height, int width, "
    "bool bilinear",
    lambda value, uv, weights, *_: (*weights.shape[:3], value.shape[4]),
    differentiable=3,
    dtype=torch.float32,
)


def has_kernel(value: Tensor) -> bool:
    """Return whether `sample_kernels` works on a map by one kernel, if it chooses itself."""
    like = at_least_float32(value[:0])
    return choose_backend("auto", like, ("triton",), "sample_kernels") == "triton"


def sample_kernels(
    value: Tensor,
    shape: tuple[int, int],
    uv: Tensor,
    seen: Tensor,
    weights: Tensor,
    offsets: Tensor,
    bilinear: bool = False,
    backend: str = "auto",
) -> Tensor:
    """Sum weighted pixels around a cell's projections, over all cameras that see the cell.

    Each output row is one bag of V * S pixels with weight 0 where no camera looks: no size depends
    on values, so it can be captured in a CUDA graph. The sums are differentiable in ``value``,
    ``weights`` and, if bilinear, ``uv``; they are in the wider type of value and weights, at least
    float32. -> (B, Q, heads, C)

    Args:
        value: Flattened feature maps, row-major, also in half precision. (B, V, h * w, heads, C)
        shape: Rows h and columns w of a map.
        uv: Projected points (x, y), [0, 1] over the map, one for each head; finite where seen.
            (B, V, Q, heads, 2)
        seen: Whether a camera sees a cell, bool. (B, V, Q)
        weights: Weights of the pixels. (B, Q, heads, S)
        offsets: Offsets (dx, dy) of the pixels from the point. (S, 2)
        bilinear: Sample between pixels, zero outside of the map, in place of rounding to the
            nearest pixel of the map.
        backend: ``"reference"``, ``"triton"`` (one kernel forward and one backward, which adds the
            maps' gradient up in any order) or ``"auto"``.

    Raises:
        ValueError: If ``backend`` does not serve.
    """
    dtype = torch.promote_types(torch.promote_types(value.dtype, weights.dtype), torch.float32)
    uv, weights = uv.to(dtype), weights.to(dtype)
    backend = choose_backend(backend, weights, ("triton",), "sample_kernels")
    if backend == "triton":
        return _sample_kernels(value, uv, weights, seen, offsets, *shape, bilinear, backend)
    return sample_kernels_reference(value.to(dtype), shape, uv, seen, weights, offsets, bilinear)
