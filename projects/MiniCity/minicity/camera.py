"""A pinhole camera in the world."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from minicity.curves import Array

NEAR_M = 0.25


@dataclass(frozen=True)
class Camera:
    """A pinhole camera. Integer pixel coordinates lie at pixel centres; x right, y down, z forward.

    Attributes:
        intrinsics: Focal lengths and principal point, pixels. (3, 3)
        width: Image width.
        height: Image height.
        cam_from_world: Rigid transform. (4, 4)
    """

    intrinsics: Array
    width: int
    height: int
    cam_from_world: Array

    def __post_init__(self) -> None:
        """Refuse matrices that cannot belong to a camera."""
        if np.shape(self.intrinsics) != (3, 3) or np.shape(self.cam_from_world) != (4, 4):
            raise ValueError(
                "intrinsics must be (3, 3) and cam_from_world (4, 4), got "
                f"{np.shape(self.intrinsics)} and {np.shape(self.cam_from_world)}."
            )
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size must be positive, got {self.width}x{self.height}.")
        if not (np.isfinite(self.intrinsics).all() and np.isfinite(self.cam_from_world).all()):
            raise ValueError("intrinsics and cam_from_world must be finite.")

    @cached_property
    def center(self) -> Array:
        """Position in the world. (3,)"""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    @cached_property
    def world_from_pixel(self) -> Array:
        """Maps (u, v, 1) to a viewing direction in the world. (3, 3)"""
        return self.cam_from_world[:3, :3].T @ np.linalg.inv(self.intrinsics)

    def to_camera(self, points: Array) -> Array:
        """World points in the camera's frame. (..., 3) -> (..., 3)"""
        return points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]

    def to_pixels(self, points_cam: Array) -> Array:
        """Points of the camera's frame, z > 0, in pixels. (..., 3) -> (..., 2)"""
        image = points_cam @ self.intrinsics.T
        return image[..., :2] / image[..., 2:]


def clip_near(polygon: Array, near_m: float = NEAR_M) -> Array:
    """The part of a convex polygon with z >= ``near_m``, perhaps nothing. (n, 3) -> (m, 3)"""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= near_m:
            kept.append(a)
        if (a[2] >= near_m) != (b[2] >= near_m):
            kept.append(a + (near_m - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept).reshape(-1, 3)
