"""Sensors of MiniCity's car: six cameras and a LiDAR, in places similar to the nuScenes car."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from minicity.camera import Camera
from minicity.curves import Array

# Size of a full-size image in pixels.
BASE_WIDTH = 1600
BASE_HEIGHT = 900
LIDAR_POSITION = (0.94, 0.0, 1.84)  # in the ego frame (x forward, y left, z up), in metres
# Columns: axes of a camera that looks ahead (x right, y down, z forward) in the ego frame
# (x forward, y left, z up).
_CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class CameraMount:
    """Camera on the car.

    Attributes:
        channel: nuScenes channel name.
        position: Position in the ego frame (x forward, y left, z up), in metres.
        yaw_deg: Viewing direction in degrees, anticlockwise from ahead.
        focal_px: Focal length in pixels for an image 1600 pixels wide.
        delay_ms: Time of exposure relative to the LiDAR sweep of the key frame, in milliseconds.
            Negative values are before the sweep.
    """

    channel: str
    position: tuple[float, float, float]
    yaw_deg: float
    focal_px: float
    delay_ms: float

    def intrinsics(self, width: int, height: int) -> Array:
        """Intrinsic matrix for an image of ``width`` x ``height`` pixels. (3, 3)"""
        x_scale = width / BASE_WIDTH
        y_scale = height / BASE_HEIGHT
        # Pixel centres are at integers, so the image begins at -0.5. The terms + 0.5 and - 0.5 make
        # the scale apply to distances from the corner of the image. The principal point lies 8
        # columns and 30 rows from the middle of the full-size image.
        cx = (BASE_WIDTH / 2 + 8.0 + 0.5) * x_scale - 0.5
        cy = (BASE_HEIGHT / 2 + 30.0 + 0.5) * y_scale - 0.5
        return np.array(
            [
                [self.focal_px * x_scale, 0.0, cx],
                [0.0, self.focal_px * y_scale, cy],
                [0.0, 0.0, 1.0],
            ]
        )

    @property
    def ego_from_cam(self) -> Array:
        """Pose of the camera in the ego frame, in metres. (4, 4)"""
        rotation = Rotation.from_euler("z", self.yaw_deg, degrees=True)
        pose = np.eye(4)
        pose[:3, :3] = rotation.as_matrix() @ _CAMERA_AXES
        pose[:3, 3] = self.position
        return pose


# The second argument is the position. The cameras are in clockwise order, the front one first.
CAMERAS = (
    CameraMount("CAM_FRONT", (1.70, 0.02, 1.51), yaw_deg=0.0, focal_px=1260.0, delay_ms=-35.0),
    CameraMount(
        "CAM_FRONT_RIGHT", (1.55, -0.49, 1.50), yaw_deg=-56.0, focal_px=1260.0, delay_ms=-27.0
    ),
    CameraMount(
        "CAM_BACK_RIGHT", (1.02, -0.48, 1.56), yaw_deg=-110.5, focal_px=1260.0, delay_ms=-19.0
    ),
    CameraMount("CAM_BACK", (0.03, 0.0, 1.57), yaw_deg=180.0, focal_px=806.0, delay_ms=-10.0),
    CameraMount("CAM_BACK_LEFT", (1.03, 0.48, 1.59), yaw_deg=109.0, focal_px=1260.0, delay_ms=-2.0),
    CameraMount(
        "CAM_FRONT_LEFT", (1.52, 0.49, 1.51), yaw_deg=55.0, focal_px=1270.0, delay_ms=-43.0
    ),
)


def ego_from_lidar() -> Array:
    """Pose of LIDAR_TOP (x right, y forward) in the ego frame, in metres. (4, 4)"""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", -90, degrees=True).as_matrix()
    pose[:3, 3] = LIDAR_POSITION
    return pose


def world_from_ego(x: float, y: float, yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Pose of the car on the ground: rotated by roll, then pitch, then yaw.

    Args:
        x: East in metres.
        y: North in metres.
        yaw: Heading in radians, anticlockwise from east.
        pitch: Angle in radians, positive with the nose down.
        roll: Angle in radians, positive with the right side down.

    Returns:
        Transform from the ego to the world frame, in metres. (4, 4)
    """
    # c and s are the cosine and the sine of yaw (y), pitch (p) and roll (r).
    cy = math.cos(yaw)
    sy = math.sin(yaw)
    cp = math.cos(pitch)
    sp = math.sin(pitch)
    cr = math.cos(roll)
    sr = math.sin(roll)
    # The rotation is R_z(yaw) R_y(pitch) R_x(roll), multiplied out.
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def mounted_camera(mount: CameraMount, width: int, height: int, ego_pose: Array) -> Camera:
    """Place a camera of the car in the world.

    Args:
        mount: Focal length and pose of the camera on the car.
        width: Image width in pixels.
        height: Image height in pixels.
        ego_pose: Pose of the car (``world_from_ego``). (4, 4)

    Returns:
        The camera in the world frame.
    """
    world_from_cam = ego_pose @ mount.ego_from_cam
    return Camera(
        intrinsics=mount.intrinsics(width, height),
        width=width,
        height=height,
        cam_from_world=np.linalg.inv(world_from_cam),
    )


def quaternion(pose: Array) -> list[float]:
    """Rotation of a pose as the unit quaternion w, x, y, z. (4, 4) -> 4 numbers"""
    # SciPy has w last, and nuScenes has it first.
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [float(w), float(x), float(y), float(z)]
