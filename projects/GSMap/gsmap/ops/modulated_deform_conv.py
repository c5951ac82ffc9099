"""Modulated deformable convolution (DCNv2) in torch, for where mmcv has no compiled operator."""

import torch
import torch.nn.functional as F
from torch import Tensor

Pair = tuple[int, int]


def modulated_deform_conv(
    images: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    offset: Tensor,
    mask: Tensor,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
    groups: int,
    deform_groups: int,
) -> Tensor:
    """Convolve at shifted and weighted places, like mmcv's operator. -> (B, O, h, w)

    Outside the images everything is zero. All pairs are of rows and columns, in pixels.

    Args:
        images: The input. (B, C, H, W)
        weight: The filters, of K = kh * kw taps. (O, C / groups, kh, kw)
        bias: Added to each output channel (O,), or None.
        offset: Shift of every tap along rows, then columns. (B, deform_groups * K * 2, h, w)
        mask: Weight of every tap. (B, deform_groups * K, h, w)
        stride: Steps of the filters.
        padding: Zeros around the images.
        dilation: Distances of the taps.
        groups: Groups of channels that are convolved each by itself.
        deform_groups: Groups of channels with shifts of their own.
    """
    batch, _, *size = images.shape
    taps = weight.shape[2] * weight.shape[3]
    shifts = offset.unflatten(1, (deform_groups, taps, 2)).unbind(3)
    grid = torch.meshgrid(
        *(torch.arange(n, device=images.device) for n in weight.shape[2:]), indexing="ij"
    )
    places = []
    for axis, (shift, tap) in enumerate(zip(shifts, grid, strict=True)):
        starts = torch.arange(offset.shape[2 + axis], device=images.device) * stride[axis]
        starts = (starts - padding[axis]).view((-1, 1) if axis == 0 else (1, -1))
        place = shift + starts + tap.reshape(-1, 1, 1) * dilation[axis]  # (B, G, K, h, w)
        places.append((2 * place + 1) / size[axis] - 1)
    where = torch.stack(places[::-1], -1).flatten(0, 1).flatten(1, 2)  # (B * G, K * h, w, 2)
    parts = images.reshape(batch * deform_groups, -1, *size)
    sampled = F.grid_sample(parts, where, align_corners=False)
    sampled = sampled.view(batch, deform_groups, -1, taps, *offset.shape[2:])
    sampled = sampled * mask.unflatten(1, (deform_groups, 1, taps))
    columns = sampled.reshape(batch, groups, -1, offset.shape[2] * offset.shape[3])
    out = (weight.view(groups, len(weight) // groups, -1) @ columns).flatten(1, 2)
    out = out if bias is None else out + bias[:, None]
    return out.unflatten(2, offset.shape[2:])
