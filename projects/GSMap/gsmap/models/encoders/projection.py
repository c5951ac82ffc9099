"""Projection of BEV pillars into the cameras, and of feature pixels to points in 3D.

A pillar is a column of points over a BEV cell. All points are in the annotation frame. The padded
image is the input of the backbone, whose sides are rounded up to multiples of a divisor.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError

_MIN_DEPTH_M = 1e-5  # points that are nearer to the camera plane are not visible


class PillarProjection(NamedTuple):
    """Projection of the Z points of the pillars of all Q cells into V cameras.

    Attributes:
        uv: Image coordinates, [0, 1] over the padded image; undefined behind a camera.
            (B, V, Q, Z, 2)
        visible: Whether any point of the cell's pillar lies in the image. (B, V, Q)
    """

    uv: Tensor
    visible: Tensor


def pillar_points(
    grid: BEVGrid, z_range: tuple[float, float], num_heights: int, device: torch.device
) -> Tensor:
    """Points of a vertical pillar over every cell: the centres of Z slices of equal height.

    Args:
        grid: The cells, H x W = Q.
        z_range: Lowest and highest z in the annotation frame, in metres.
        num_heights: Number Z of slices.
        device: Device of the points.

    Returns:
        Homogeneous points (x, y, z, 1) in metres, cells row by row. (Q, Z, 4)
    """
    # The fractions are computed first, then the metres, both in float32. `GeometryKernelAttention`
    # rounds the projections to pixels, so another order of operations could select other pixels.
    cols = torch.linspace(0.5, grid.width - 0.5, grid.width, device=device) / grid.width
    rows = torch.linspace(0.5, grid.height - 0.5, grid.height, device=device) / grid.height
    heights = torch.linspace(0.5 / num_heights, 1 - 0.5 / num_heights, num_heights, device=device)
    x = cols * grid.extent_m[0] + grid.x_range[0]
    y = rows * grid.extent_m[1] + grid.y_range[0]
    z = heights * (z_range[1] - z_range[0]) + z_range[0]
    y, x, z = torch.meshgrid(y, x, z, indexing="ij")
    return torch.stack([x, y, z, torch.ones_like(x)], dim=-1).flatten(0, 1)


def project_pillars(
    points: Tensor, img_from_frame: Tensor, img_shape: tuple[int, int]
) -> PillarProjection:
    """Project pillar points into the cameras.

    Args:
        points: Homogeneous points in the annotation frame, in metres. (Q, Z, 4)
        img_from_frame: Matrices from metres to (u * d, v * d, d, 1) in pixels. (B, V, 4, 4)
        img_shape: Rows and columns of the padded image.
    """
    matrices = img_from_frame[:, :, None, None].float()  # (B, V, 1, 1, 4, 4), for all Q and Z
    x, y, z, _ = points.float()[..., None].unbind(-2)  # (Q, Z, 1) each
    # The product is written out. On a GPU, a product of millions of small matrices takes ten times
    # as long, and TF32 would move the projections by pixels.
    # `matrices[..., j]` is column j. The coordinate 1 of the points leaves column 3 as it is.
    projected = matrices[..., 0] * x + matrices[..., 1] * y + matrices[..., 2] * z
    return visible_points(projected + matrices[..., 3], img_shape)


def visible_points(projected: Tensor, img_shape: tuple[int, int]) -> PillarProjection:
    """Compute the normalised image coordinates and the visibility of projected pillar points.

    Args:
        projected: Points (u * d, v * d, d, ...), with pixels u, v and the depth d in metres.
            (B, V, Q, Z, 3 or 4)
        img_shape: Rows and columns of the padded image.
    """
    depth = projected[..., 2]
    uv = projected[..., :2] / depth.clamp(min=_MIN_DEPTH_M)[..., None]
    uv = uv / constant(uv, [img_shape[1], img_shape[0]])  # a cached tensor (width, height)
    inside = (depth > _MIN_DEPTH_M) & ((uv > 0) & (uv < 1)).all(-1)
    return PillarProjection(uv, inside.any(-1))


def pixel_rays(
    frame_from_img: Tensor, image_size: tuple[int, int], feature_size: tuple[int, int]
) -> Tensor:
    """Viewing rays of the feature pixels, as vectors from the camera to the depth of 1 m.

    Args:
        frame_from_img: Inverse projections, which map (u * d, v * d, d, 1) to (x, y, z, 1) in
            metres as in `frustum_points`. Only the first three rows and columns are used.
            (..., 3 or 4, 3 or 4)
        image_size: Height and width of the padded image in pixels.
        feature_size: Height h and width w of the feature map.

    Returns:
        Vectors in metres, in the annotation frame. (..., h, w, 3)
    """
    device = frame_from_img.device
    dtype = frame_from_img.dtype
    u = torch.linspace(0, image_size[1] - 1, feature_size[1], device=device, dtype=dtype)
    v = torch.linspace(0, image_size[0] - 1, feature_size[0], device=device, dtype=dtype)
    u, v = torch.meshgrid(u, v, indexing="xy")  # (h, w)
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1)
    # In half precision, points would be off by up to 0.4 m.
    with torch.autocast(device.type, enabled=False):
        return torch.einsum("...ij,hwj->...hwi", frame_from_img[..., :3, :3], pixels)


def frustum_points(
    frame_from_img: Tensor,
    image_size: tuple[int, int],
    feature_size: tuple[int, int],
    depths_m: Tensor,
) -> Tensor:
    """Points of every feature pixel at every depth, in the annotation frame.

    Feature pixels are spaced evenly from the first to the last pixel of the image, as in the
    released code. They are not the centres of the feature cells.

    Args:
        frame_from_img: Inverse of ``lidar2img`` after augmentation: maps (u * d, v * d, d, 1), with
            the pixel (u, v) and the depth d in metres, to (x, y, z, 1) in metres. (..., 4, 4)
        image_size: Height and width of the padded image in pixels.
        feature_size: Height h and width w of the feature map.
        depths_m: Depths along the optical axis, in metres. (D,)

    Returns:
        Points in metres. (..., D, h, w, 3)

    Raises:
        ValueError: If ``frame_from_img`` does not contain 4 x 4 matrices.
    """
    if frame_from_img.shape[-2:] != (4, 4):
        raise InputError(
            f"frame_from_img must hold 4 x 4 matrices, got shape {tuple(frame_from_img.shape)}."
        )
    rays = pixel_rays(frame_from_img, image_size, feature_size)
    origins = frame_from_img[..., None, None, None, :3, 3]  # (..., 1, 1, 1, 3)
    return rays.unsqueeze(-4) * depths_m.to(rays).view(-1, 1, 1, 1) + origins
