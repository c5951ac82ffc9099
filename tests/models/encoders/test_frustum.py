"""Frustum points against hand-worked projections."""

import pytest
import torch

from gsmap.models.encoders.depth_net import camera_vector
from gsmap.models.encoders.projection import frustum_points


def camera_looking_along_y() -> torch.Tensor:
    """``lidar2img`` of a camera 1 m above the origin that looks along y; f = 10, c = (8, 4)."""
    cam_from_frame = torch.tensor(
        [[1.0, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64
    )
    intrinsics = torch.eye(4, dtype=torch.float64)
    intrinsics[:2, :3] = torch.tensor([[10.0, 0, 8], [0, 10, 4]], dtype=torch.float64)
    return intrinsics @ cam_from_frame


def test_corner_pixels_land_where_the_pinhole_says():
    points = frustum_points(
        camera_looking_along_y().inverse(), (9, 17), (2, 3), torch.tensor([2.0, 5.0])
    )
    assert points.shape == (2, 2, 3, 3)
    # pixel (0, 0): x = (0 - 8) / 10 * d to the left, 4 / 10 * d above the camera at z = 1
    expected = torch.tensor([[-1.6, 2.0, 1.8], [-4.0, 5.0, 3.0]], dtype=torch.float64)
    torch.testing.assert_close(points[:, 0, 0], expected)
    # the last feature pixel is the image's last pixel (16, 8), not a cell centre
    expected = torch.tensor([[1.6, 2.0, 0.2], [4.0, 5.0, -1.0]], dtype=torch.float64)
    torch.testing.assert_close(points[:, 1, 2], expected)


def test_augmentation_is_undone():
    aug = torch.diag(torch.tensor([0.5, 0.5, 1, 1], dtype=torch.float64))
    aug[0, 2] = -3.0  # a crop by three pixels
    lidar2img = camera_looking_along_y()
    points = frustum_points((aug @ lidar2img).inverse(), (9, 17), (2, 3), torch.tensor([2.0]))
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    u = homogeneous @ lidar2img[0] / 2.0
    # image pixel 16 of the augmented image is pixel (16 + 3) / 0.5 of the original
    torch.testing.assert_close(u[0, 0, 2], torch.tensor(38.0, dtype=torch.float64))


def test_camera_vector_order():
    intrinsics = torch.tensor([[1.0, 0, 3], [0, 2, 4], [0, 0, 1]])
    aug = torch.eye(4)
    aug[:2, :3] = torch.tensor([[5.0, 6, 7], [8, 9, 10]])
    pose = torch.arange(11.0, 27).view(4, 4)
    vector = camera_vector(intrinsics[None], aug[None], pose[None])
    assert vector[0].tolist() == list(range(1, 23))


def test_bad_matrix_is_named():
    with pytest.raises(ValueError, match="frame_from_img"):
        frustum_points(torch.eye(3), (9, 17), (2, 3), torch.tensor([2.0]))
