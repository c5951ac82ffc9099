"""Points above every feature pixel (Lift, Splat, Shoot), and a camera's parameters as a vector."""

import torch
from torch import Tensor


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
        depths_m: Along the optical axis. (D,)

    ValueError if ``frame_from_img`` does not hold 4 x 4 matrices. -> (..., D, h, w, 3) in metres
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
    """Write a camera's parameters as the 22 numbers that MapTRv2's depth net reads. (..., 22)

    fx, fy, cx, cy of the original image in pixels (..., >= 3, >= 3); a00, a01, tx, a10, a11, ty of
    the augmentation, which acts on (u * d, v * d, d, 1), translation in pixels in the third column
    (..., 4, 4); the upper three rows of the camera's pose in the vehicle, in metres (..., 4, 4).
    """
    intrinsics = [cam2img[..., 0, 0], cam2img[..., 1, 1], cam2img[..., 0, 2], cam2img[..., 1, 2]]
    augmentation = img_aug_matrix[..., :2, :3].flatten(-2)
    pose = ego_from_cam[..., :3, :].flatten(-2)
    return torch.cat([torch.stack(intrinsics, -1), augmentation, pose], -1)
