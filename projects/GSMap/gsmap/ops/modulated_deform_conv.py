"""Modulated deformable convolution (DCNv2) in torch, for mmcv without compiled operators."""

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
    """Convolve images with filters whose taps are shifted and weighted at each output pixel.

    A tap is an entry of a filter. Each tap reads the image at its shifted position by bilinear
    interpolation, and images are zero outside of their borders. The results equal mmcv's operator.

    Args:
        images: Input images. (B, C, H, W)
        weight: Filters of K = kh * kw taps. (O, C / groups, kh, kw)
        bias: Bias of each output channel (O,), or None.
        offset: Shift of each tap along rows, then columns, in pixels. (B, deform_groups * K * 2,
            h, w)
        mask: Weight of each tap. (B, deform_groups * K, h, w)
        stride: Steps of the filters along rows and columns, in pixels.
        padding: Zeros added on each side of the rows and columns.
        dilation: Distances of the taps along rows and columns, in pixels.
        groups: Number of groups of channels that are convolved separately.
        deform_groups: Number of groups of channels with separate shifts and weights of the taps.

    Returns:
        Convolved images. (B, O, h, w)
    """
    batch, _, *size = images.shape
    out_size = offset.shape[2:]  # (h, w)
    num_taps = weight.shape[2] * weight.shape[3]
    # Shifts along rows and along columns, (B, G, K, h, w) each, with G = deform_groups.
    shifts = offset.unflatten(1, (deform_groups, num_taps, 2)).unbind(3)
    tap_rows = torch.arange(weight.shape[2], device=images.device)
    tap_cols = torch.arange(weight.shape[3], device=images.device)
    taps = torch.meshgrid(tap_rows, tap_cols, indexing="ij")  # row and column of each tap
    coordinates = []  # the row coordinates of the samples, then their column coordinates
    shapes = ((-1, 1), (1, -1))  # the row starts as (h, 1), and the column starts as (1, w)
    for axis, (shift, tap) in enumerate(zip(shifts, taps, strict=True)):
        starts = torch.arange(out_size[axis], device=images.device) * stride[axis]
        starts = (starts - padding[axis]).view(shapes[axis])
        pixels = shift + starts + tap.reshape(-1, 1, 1) * dilation[axis]  # (B, G, K, h, w)
        # `grid_sample` takes [-1, 1] over the image, with pixel i centred at (2 i + 1) / size - 1.
        coordinates.append((2 * pixels + 1) / size[axis] - 1)
    rows, cols = coordinates
    locations = torch.stack([cols, rows], dim=-1).flatten(0, 1).flatten(1, 2)  # (B G, K h, w, 2)
    # Each group of channels becomes a separate image, because its taps have other locations.
    group_images = images.reshape(batch * deform_groups, -1, size[0], size[1])
    samples = F.grid_sample(group_images, locations, align_corners=False)  # (B G, C / G, K h, w)
    samples = samples.view(batch, deform_groups, -1, num_taps, out_size[0], out_size[1])
    samples = samples * mask.unflatten(1, (deform_groups, 1, num_taps))
    # The inputs of each output pixel, as from `F.unfold`. (B, groups, C / groups * K, h w)
    unfolded = samples.reshape(batch, groups, -1, out_size[0] * out_size[1])
    filters = weight.view(groups, len(weight) // groups, -1)
    out = (filters @ unfolded).flatten(1, 2)  # (B, O, h w)
    if bias is not None:
        out = out + bias[:, None]
    return out.unflatten(2, out_size)
