"""Sampling of camera features at fixed pixel offsets (kernels) around projected points (GKT).

In contrast to these kernels of pixels, a Triton kernel is a program for the GPU.
"""

import torch
from torch import Tensor

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.kernel_sampling.reference import sample_kernels_reference
from gsmap.structures.tensors import at_least_float32

# Operator of torch with the Triton kernels, which takes a backend as a further, last argument.
_sample_kernels = fused_operator(
    "kernel_sampling.sample_kernels",
    "Tensor value, Tensor uv, Tensor weights, Tensor visible_cells, Tensor offsets, int height, "
    "int width, bool bilinear",
    lambda value, uv, weights, *_: (*weights.shape[:3], value.shape[4]),  # (B, Q, heads, C)
    differentiable=3,  # value, uv and weights, the first three tensors, have gradients
    dtype=torch.float32,
)


def has_kernel(value: Tensor) -> bool:
    """Whether `sample_kernels` with ``backend="auto"`` selects the Triton kernel for ``value``."""
    like = at_least_float32(value[:0])  # an empty tensor, as only the device and the type matter
    return choose_backend("auto", like, fused=("triton",), kernel="sample_kernels") == "triton"


def sample_kernels(
    value: Tensor,
    shape: tuple[int, int],
    uv: Tensor,
    visible_cells: Tensor,
    weights: Tensor,
    offsets: Tensor,
    bilinear: bool = False,
    backend: str = "auto",
) -> Tensor:
    """Sum weighted pixels around the projections of each BEV cell in the cameras.

    Each output is the sum of V * S weighted pixels: S pixels in each of V cameras. The weight is
    zero for cameras to which the cell is not visible. No tensor size depends on the values of
    tensors, so the operation can be captured in a CUDA graph.

    Args:
        value: Flattened feature maps, row-major, float32 or half precision.
            (B, V, h * w, heads, C)
        shape: Rows h and columns w of a feature map.
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map; finite for visible
            cells. (B, V, Q, heads, 2)
        visible_cells: Whether a cell is visible to a camera, bool. (B, V, Q)
        weights: Weights of the pixels. (B, Q, heads, S)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        bilinear: Interpolate between pixels, with zeros outside of the map, instead of rounding to
            the nearest pixel of the map.
        backend: ``"reference"`` (plain torch), ``"triton"``, or ``"auto"`` for the choice by device
            and type. ``"triton"`` has one Triton kernel for the forward pass, and one for the
            backward pass. The latter adds the gradients of the maps in an order that varies, so
            repeated runs differ by rounding.

    Returns:
        Sums, differentiable in ``value``, ``weights`` and, if bilinear, ``uv``. They have the wider
        type of value and weights, at least float32. (B, Q, heads, C)

    Raises:
        ValueError: If ``backend`` is unknown or does not support the inputs.
    """
    dtype = torch.promote_types(value.dtype, weights.dtype)
    dtype = torch.promote_types(dtype, torch.float32)
    uv = uv.to(dtype)
    weights = weights.to(dtype)
    backend = choose_backend(backend, weights, fused=("triton",), kernel="sample_kernels")
    if backend == "triton":
        height, width = shape
        return _sample_kernels(
            value,
            uv,
            weights=weights,
            visible_cells=visible_cells,
            offsets=offsets,
            height=height,
            width=width,
            bilinear=bilinear,
            backend=backend,
        )
    return sample_kernels_reference(
        value.to(dtype),
        shape,
        uv=uv,
        visible_cells=visible_cells,
        weights=weights,
        offsets=offsets,
        bilinear=bilinear,
    )
