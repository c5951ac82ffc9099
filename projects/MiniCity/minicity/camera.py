"""Pinhole camera in the world frame."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmap.utils.errors import InputError
from minicity.curves import Array

NEAR_M = 0.25  # least depth of points that are projected


@dataclass(frozen=True)
class Camera:
    """Pinhole camera.

    The axes of the camera frame are x right, y down and z forward. Integer pixel coordinates lie at
    pixel centres.

    Attributes:
        intrinsics: Focal lengths and principal point, in pixels. (3, 3)
        width: Image width in pixels, >= 1.
        height: Image height in pixels, >= 1.
        cam_from_world: Rigid transform from the world to the camera frame, in metres. (4, 4)

    Raises:
        ValueError: If a matrix has a wrong shape or an infinite entry, or the image is empty.
    """

    intrinsics: Array
    width: int
    height: int
    cam_from_world: Array

    def __post_init__(self) -> None:
        """Check the shapes and values of both matrices and the image size."""
        if np.shape(self.intrinsics) != (3, 3) or np.shape(self.cam_from_world) != (4, 4):
            raise InputError(
                "intrinsics must be (3, 3) and cam_from_world (4, 4), got "
                f"{np.shape(self.intrinsics)} and {np.shape(self.cam_from_world)}."
            )
        if self.width < 1 or self.height < 1:
            raise InputError(f"image size must be positive, got {self.width}x{self.height}.")
        if not (np.isfinite(self.intrinsics).all() and np.isfinite(self.cam_from_world).all()):
            raise InputError("intrinsics and cam_from_world must be finite.")

    @cached_property
    def center(self) -> Array:
        """Position of the camera in the world, in metres. (3,)"""
        # The inverse of the transform x -> R x + t maps the origin to -R^T t.
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    @cached_property
    def world_from_pixel(self) -> Array:
        """Matrix that maps (u, v, 1) to a viewing direction in the world, of any length. (3, 3)"""
        return self.cam_from_world[:3, :3].T @ np.linalg.inv(self.intrinsics)

    def to_camera(self, points: Array) -> Array:
        """Transform points from the world to the camera frame, in metres. (..., 3) -> (..., 3)"""
        return points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]

    def to_pixels(self, points_cam: Array) -> Array:
        """Project points to the image.

        Args:
            points_cam: Points in the camera frame with z > 0, in metres. (..., 3)

        Returns:
            Image coordinates (u, v) in pixels. (..., 2)
        """
        image = points_cam @ self.intrinsics.T
        return image[..., :2] / image[..., 2:]


def clip_near(polygon: Array, near_m: float = NEAR_M) -> Array:
    """Clip a convex polygon to the half-space in front of a camera.

    Args:
        polygon: Corners in the camera frame, in metres. (n, 3)
        near_m: Least depth of the result, in metres.

    Returns:
        Corners of the part with z >= ``near_m``; m is 0 if there is no such part. (m, 3)
    """
    corners = []
    # Edges from each corner a to the next corner b; the last edge ends at the first corner.
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= near_m:
            corners.append(a)
        if (a[2] >= near_m) != (b[2] >= near_m):  # the edge from a to b crosses the plane
            fraction = (near_m - a[2]) / (b[2] - a[2])  # position of the crossing: 0 at a, 1 at b
            corners.append(a + fraction * (b - a))
    return np.array(corners).reshape(-1, 3)
