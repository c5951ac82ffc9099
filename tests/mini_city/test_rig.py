import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from minicity.rig import (
    CAMERAS,
    LIDAR_POSITION,
    ego_from_lidar,
    mounted_camera,
    quaternion,
    world_from_ego,
)


def test_lidar_x_points_right_and_y_forward() -> None:
    right, forward = ego_from_lidar()[:3, 0], ego_from_lidar()[:3, 1]
    np.testing.assert_allclose(right, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(forward, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(ego_from_lidar()[:3, 3], LIDAR_POSITION)


@pytest.mark.parametrize("mount", CAMERAS, ids=lambda mount: mount.channel)
def test_a_point_ahead_of_a_camera_projects_to_its_principal_point(mount) -> None:
    pose = world_from_ego(5.0, -3.0, 0.4)
    camera = mounted_camera(mount, 800, 450, pose)
    yaw = 0.4 + np.radians(mount.yaw_deg)
    ahead = camera.center + 10 * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    seen = camera.to_camera(ahead)
    np.testing.assert_allclose(seen, [0, 0, 10], atol=1e-9)
    np.testing.assert_allclose(camera.to_pixels(seen), camera.intrinsics[:2, 2])
    # what is higher appears higher up, what is to the left appears left
    above = camera.to_pixels(camera.to_camera(ahead + np.array([0, 0, 1])))
    left = camera.to_pixels(camera.to_camera(ahead + np.array([-np.sin(yaw), np.cos(yaw), 0])))
    assert above[1] == pytest.approx(camera.intrinsics[1, 2] - camera.intrinsics[1, 1] / 10)
    assert left[0] == pytest.approx(camera.intrinsics[0, 2] - camera.intrinsics[0, 0] / 10)


def test_the_cameras_see_all_around() -> None:
    pose, seen = world_from_ego(0, 0, 0), np.zeros(360, bool)
    angles = np.radians(np.arange(360))
    ring = np.stack([100 * np.cos(angles), 100 * np.sin(angles), np.ones(360)], axis=1)
    for mount in CAMERAS:
        camera = mounted_camera(mount, 800, 450, pose)
        points = camera.to_camera(ring)
        px = camera.to_pixels(np.where(points[:, 2:] > 0, points, [1e9, 0, 1]))
        seen |= (px[:, 0] >= 0) & (px[:, 0] < 800)
    assert seen.all()


def test_intrinsics_keep_the_field_of_view_at_every_size() -> None:
    """The left edge of the first pixel and the right edge of the last see the same rays."""
    rays = []
    for width, height in ((1600, 900), (400, 225)):
        inverse = np.linalg.inv(CAMERAS[0].intrinsics(width, height))
        corners = np.array([[-0.5, -0.5, 1], [width - 0.5, height - 0.5, 1]])
        rays.append(corners @ inverse.T)
    np.testing.assert_allclose(rays[0], rays[1])


def test_pose_turns_by_roll_then_pitch_then_yaw() -> None:
    pose = world_from_ego(1.0, 2.0, 0.7, 0.2, -0.3)
    expected = Rotation.from_euler("ZYX", [0.7, 0.2, -0.3])
    np.testing.assert_allclose(pose[:3, :3], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 0])
    x, y, z, w = expected.as_quat()
    np.testing.assert_allclose(np.abs(quaternion(pose) @ np.array([w, x, y, z])), 1.0)
