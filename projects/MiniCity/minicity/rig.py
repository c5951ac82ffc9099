"""The sensors of MiniCity's car: six cameras and a LiDAR, placed much as on the nuScenes car."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from minicity.camera import Camera
from minicity.curves import Array

BASE_WIDTH, BASE_HEIGHT = 1600, 900
LIDAR_POSITION = (0.94, 0.0, 1.84)
# camera z forward, x right, y down, seen from x forward, y left, z up
_CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class CameraMount:
    """A camera on the car.

    Attributes:
        channel: nuScenes channel name.
        position: In the ego frame (x forward, y left, z up), metres.
        yaw_deg: Viewing direction, anticlockwise from ahead.
        focal_px: Focal length for an image 1600 pixels wide.
        delay_ms: When it fires, relative to the key frame's LiDAR sweep.
    """

    channel: str
    position: tuple[float, float, float]
    yaw_deg: float
    focal_px: float
    delay_ms: float

    def intrinsics(self, width: int, height: int) -> Array:
        """Intrinsics for an image size. (3, 3)"""
        sx, sy = width / BASE_WIDTH, height / BASE_HEIGHT
        cx, cy = (BASE_WIDTH / 2 + 8.0 + 0.5) * sx - 0.5, (BASE_HEIGHT / 2 + 30.0 + 0.5) * sy - 0.5
        return np.array(
            [[self.focal_px * sx, 0.0, cx], [0.0, self.focal_px * sy, cy], [0.0, 0.0, 1.0]]
        )

    @property
    def ego_from_cam(self) -> Array:
        """Pose in the ego frame. (4, 4)"""
        pose = np.eye(4)
        pose[:3, :3] = (
            Rotation.from_euler("z", self.yaw_deg, degrees=True).as_matrix() @ _CAMERA_AXES
        )
        pose[:3, 3] = self.position
        return pose


CAMERAS = (
    CameraMount("CAM_FRONT", (1.70, 0.02, 1.51), 0.0, 1260.0, -35.0),
    CameraMount("CAM_FRONT_RIGHT", (1.55, -0.49, 1.50), -56.0, 1260.0, -27.0),
    CameraMount("CAM_BACK_RIGHT", (1.02, -0.48, 1.56), -110.5, 1260.0, -19.0),
    CameraMount("CAM_BACK", (0.03, 0.0, 1.57), 180.0, 806.0, -10.0),
    CameraMount("CAM_BACK_LEFT", (1.03, 0.48, 1.59), 109.0, 1260.0, -2.0),
    CameraMount("CAM_FRONT_LEFT", (1.52, 0.49, 1.51), 55.0, 1270.0, -43.0),
)


def ego_from_lidar() -> Array:
    """Pose of LIDAR_TOP, whose x points right and y forward. (4, 4)"""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", -90, degrees=True).as_matrix()
    pose[:3, 3] = LIDAR_POSITION
    return pose


def world_from_ego(x: float, y: float, yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Return the pose of the car on the ground: turned by roll, then pitch, then yaw. (4, 4)

    Args:
        x: East in metres.
        y: North in metres.
        yaw: Anticlockwise from east, in radians.
        pitch: Nose down, in radians.
        roll: Right side down, in radians.
    """
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (yaw, pitch, roll))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def mounted_camera(mount: CameraMount, width: int, height: int, ego_pose: Array) -> Camera:
    """Return the camera as it stands in the world.

    Args:
        mount: Lens and place in the car.
        width: Width of the picture in pixels.
        height: Height of the picture in pixels.
        ego_pose: Pose of the car (``world_from_ego``). (4, 4)
    """
    return Camera(
        mount.intrinsics(width, height), width, height, np.linalg.inv(ego_pose @ mount.ego_from_cam)
    )


def quaternion(pose: Array) -> list[float]:
    """Rotation of a pose as w, x, y, z."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [float(w), float(x), float(y), float(z)]
