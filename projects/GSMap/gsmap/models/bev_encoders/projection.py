"""Geometry between cameras and BEV: pillars seen by cameras, points along the pixels' rays."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid

_MIN_DEPTH_M = 1e-5


def stack_matrices(img_metas: Sequence[dict[str, Any]], key: str) -> np.ndarray:
    """Stack one matrix field of the samples' metainfo, in float64. (B, ..., 4, 4)

    Raises:
        ValueError: If a sample lacks the field.
    """
    for meta in img_metas:
        if key not in meta:
            raise ValueError(
                f"sample {meta.get('token')!r} has no {key!r} in its metainfo: "
                "pack it in the pipeline."
            )
    return np.stack([np.asarray(meta[key], dtype=np.float64) for meta in img_metas])


class PillarProjection(NamedTuple):
    """Where the Z pillar points of all Q cells fall in every camera, and which cells it sees."""

    uv: Tensor  # [0, 1] over the (padded) image; meaningless behind the camera (B, V, Q, Z, 2)
    visible: Tensor  # whether it sees any point of the cell's pillar (B, V, Q)


def pillar_points(
    grid: BEVGrid, z_range: tuple[float, float], num_heights: int, device: torch.device
) -> Tensor:
    """Return the middle of ``num_heights`` (Z) equal slices of ``z_range`` over every cell centre.

    Homogeneous points (x, y, z, 1) in metres, cells row-major, Q = H x W of the grid. (Q, Z, 4)
    """
    # Fractions first, then metres, in float32: kernel positions round, so the order of operations
    # matters.
    cols = torch.linspace(0.5, grid.width - 0.5, grid.width, device=device) / grid.width
    rows = torch.linspace(0.5, grid.height - 0.5, grid.height, device=device) / grid.height
    depth_m = z_range[1] - z_range[0]
    heights = torch.linspace(0.5 / num_heights, 1 - 0.5 / num_heights, num_heights, device=device)
    x = cols * grid.extent_m[0] + grid.x_range[0]
    y = rows * grid.extent_m[1] + grid.y_range[0]
    z = heights * depth_m + z_range[0]
    y, x, z = torch.meshgrid(y, x, z, indexing="ij")
    return torch.stack([x, y, z, torch.ones_like(x)], -1).flatten(0, 1)


def project_pillars(
    points: Tensor, img_from_frame: Tensor, img_shape: tuple[int, int]
) -> PillarProjection:
    """Project homogeneous points in metres (Q, Z, 4) by matrices to pixels (B, V, 4, 4).

    ``img_shape`` are rows and columns of the padded image.
    """
    with torch.autocast(points.device.type, enabled=False):
        projected = torch.matmul(
            img_from_frame[:, :, None, None].float(), points[..., None].float()
        )[..., 0]
    depth = projected[..., 2]
    uv = projected[..., :2] / depth.clamp(min=_MIN_DEPTH_M)[..., None]
    uv = uv / uv.new_tensor([img_shape[1], img_shape[0]])
    inside = (depth > _MIN_DEPTH_M) & ((uv > 0) & (uv < 1)).all(-1)
    return PillarProjection(uv, inside.any(-1))


def frustum_points(
    frame_from_img: Tensor,
    image_size: tuple[int, int],
    feature_size: tuple[int, int],
    depths_m: Tensor,
) -> Tensor:
    """Place every feature pixel at every depth, in the frame of the map.

    Feature pixels are spread evenly from the first to the last pixel of the image, ends included,
    as in MapTRv2 (they are not the centres of the feature cells).

    Args:
        frame_from_img: Inverse of ``lidar2img`` after augmentation: maps (u * d, v * d, d, 1), with
            the pixel (u, v) and the depth d in metres, to (x, y, z, 1) in metres. (..., 4, 4)
        image_size: Height and width of the (padded) image in pixels.
        feature_size: Height h and width w of the feature map.
        depths_m: Depths in metres, along the optical axis. (D,)

    Returns:
        Points (x, y, z) in metres. (..., D, h, w, 3)

    Raises:
        ValueError: If ``frame_from_img`` does not hold 4 x 4 matrices.
    """
    if frame_from_img.shape[-2:] != (4, 4):
        raise ValueError(
            f"frame_from_img must hold 4 x 4 matrices, got shape {tuple(frame_from_img.shape)}."
        )
    device, dtype = frame_from_img.device, frame_from_img.dtype
    u = torch.linspace(0, image_size[1] - 1, feature_size[1], device=device, dtype=dtype)
    v = torch.linspace(0, image_size[0] - 1, feature_size[0], device=device, dtype=dtype)
    u, v = torch.meshgrid(u, v, indexing="xy")  # (h, w)
    pixels = torch.stack([u, v, torch.ones_like(u)], -1)
    rays = torch.einsum("...ij,hwj->...hwi", frame_from_img[..., :3, :3], pixels)
    origins = frame_from_img[..., None, None, None, :3, 3]  # (..., 1, 1, 1, 3)
    return rays.unsqueeze(-4) * depths_m.to(device, dtype).view(-1, 1, 1, 1) + origins


def camera_vector(cam2img: Tensor, img_aug_matrix: Tensor, ego_from_cam: Tensor) -> Tensor:
    """Write a camera's parameters as the 22 numbers that MapTRv2's depth net reads.

    Args:
        cam2img: Intrinsics of the original image, in pixels. (..., >= 3, >= 3)
        img_aug_matrix: Image augmentation, acting on (u * d, v * d, d, 1): scale and rotation in
            the upper left, translation in pixels in the third column. (..., 4, 4)
        ego_from_cam: Pose of the camera in the ego vehicle, in metres. (..., 4, 4)

    Returns:
        fx, fy, cx, cy; a00, a01, tx, a10, a11, ty; then the upper three rows of the pose. (..., 22)
    """
    intrinsics = [cam2img[..., 0, 0], cam2img[..., 1, 1], cam2img[..., 0, 2], cam2img[..., 1, 2]]
    augmentation = img_aug_matrix[..., :2, :3].flatten(-2)
    pose = ego_from_cam[..., :3, :].flatten(-2)
    return torch.cat([torch.stack(intrinsics, -1), augmentation, pose], -1)
