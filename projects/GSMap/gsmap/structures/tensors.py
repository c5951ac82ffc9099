"""Small helpers of tensors that every room uses."""

import torch
from torch import Tensor, nn


def at_least_float32(values: Tensor) -> Tensor:
    """Return half-precision values in float32, others as they are: coordinates need the digits."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def in_float32(layer: nn.Module, values: Tensor) -> Tensor:
    """Apply a layer outside of autocast and return its values in float32 or more.

    Neighbouring points differ in digits that half precision lacks: where they fall onto each other
    the direction of the edge between them, and the gradient of a loss of it, is noise.
    """
    if not torch.is_autocast_enabled(values.device.type):
        return at_least_float32(layer(values))
    with torch.autocast(values.device.type, enabled=False):
        return layer(at_least_float32(values))


def check_same_shape(**both: Tensor) -> None:
    """Raise ValueError if two tensors differ in shape; their names are those in the message."""
    (of, first), (name, second) = both.items()
    if first.shape != second.shape:
        raise ValueError(
            f"{name} must have shape {tuple(first.shape)} of {of}, got {tuple(second.shape)}."
        )


def num_depth_bins(depth_range: tuple[float, float, float]) -> int:
    """Return the number of bins of ``(low, high, step)``; ValueError if there is none."""
    low, high, step = depth_range
    if step <= 0 or high - low < step:
        raise ValueError(
            f"depth_range must be (low, high, step) with one bin or more, got {depth_range}."
        )
    return int((high - low) / step)
