"""Axes and ground planes of annotation frames, for displays.

The annotation frame is the frame in which the map of a sample is given. In a display, x points to
the right of the vehicle and y points ahead.
"""

from dataclasses import dataclass, replace

import numpy as np

from gsmap.structures.elements import FloatArray


@dataclass(frozen=True)
class FrameView:
    """Orientation of the frame in which a map is given, and the ground plane in it.

    Args:
        forward: Axis that points ahead: ``"y"`` (x is right) or ``"x"`` (y is left).
        ground: Ground plane z = a x + b y + c as (a, b, c), c in metres.
        vehicle_m: Rear end and front end of the ego vehicle as coordinates along the forward axis,
            and its width, all in metres.
        ego_ground_z_m: Height of the ground in the frame of the *vehicle*, in metres, from which
            ``with_mounting`` computes the ground plane.
    """

    forward: str
    ground: tuple[float, float, float]
    vehicle_m: tuple[float, float, float]
    ego_ground_z_m: float = 0.0

    def with_mounting(self, ego_from_frame: FloatArray | None) -> "FrameView":
        """Create the view with the ground plane that follows from the mounting of the sensor.

        A roof LiDAR is mounted with a tilt of one or two degrees, which moves the ground by half a
        metre at a distance of 20 m.

        Args:
            ego_from_frame: Transform from the frame to the vehicle, in metres; None keeps the
                ground plane of this view. (4, 4)
        """
        if ego_from_frame is None:
            return self
        # A point (x, y, z) of the annotation frame has the height a x + b y + c z + height in the
        # frame of the vehicle. On the ground, this height is ``ego_ground_z_m``. Solved for z, the
        # equation is the ground plane in the annotation frame.
        a, b, c, height = np.asarray(ego_from_frame)[2].tolist()
        return replace(self, ground=(-a / c, -b / c, (self.ego_ground_z_m - height) / c))

    def display_from_frame(self, points: FloatArray) -> FloatArray:
        """Convert (x, y) of the frame to (right, ahead) in metres. (..., 2 or more) -> (..., 2)"""
        if self.forward == "y":
            return points[..., :2]
        return np.stack([-points[..., 1], points[..., 0]], axis=-1)

    @property
    def display_turn_rad(self) -> float:
        """Rotation from the frame to the display in radians, anticlockwise."""
        return 0.0 if self.forward == "y" else np.pi / 2

    def lift(self, points: FloatArray) -> FloatArray:
        """Add the height of the ground plane to points without z.

        Args:
            points: Points in metres in the frame. (..., 2 or 3)

        Returns:
            Points with z; points that already have z are not changed. (..., 3)
        """
        if points.shape[-1] >= 3:
            return points[..., :3]
        height = points[..., :2] @ np.asarray(self.ground[:2]) + self.ground[2]
        return np.concatenate([points, height[..., None]], axis=-1)


def viewing_azimuth(img_from_frame: FloatArray, view: FrameView) -> float:
    """Compute the horizontal direction of a camera.

    Args:
        img_from_frame: Projection from metres in the frame to pixels. Its third row is the optical
            axis, up to a positive factor. (4, 4)
        view: Orientation of the frame.

    Returns:
        Angle of the optical axis from straight ahead in radians, in (-pi, pi], positive to the
        left.
    """
    # The direction of the axis, without its height. A direction is rotated like a point.
    right, ahead = view.display_from_frame(np.asarray(img_from_frame)[2, :2])
    return float(np.arctan2(-right, ahead))  # the left is positive, hence the minus sign


# "lidar" is the frame of the roof LiDAR of nuScenes, 1.84 m above the road. The vehicle frame of
# nuScenes has its origin on the road, so `ego_ground_z_m` is 0, the default. "ego" is the vehicle
# frame of Argoverse 2. Its origin is on the rear axle, 0.31 m above the road (median z of map
# vertices within 8 m). The vehicles are a Renault Zoe (nuScenes) and a Ford Fusion (Argoverse 2).
FRAME_VIEWS: dict[str, FrameView] = {
    "lidar": FrameView(forward="y", ground=(0.0, 0.0, -1.84), vehicle_m=(-1.59, 2.49, 1.73)),
    "ego": FrameView(
        forward="x",
        ground=(0.0, 0.0, -0.31),
        vehicle_m=(-1.10, 3.77, 1.85),
        ego_ground_z_m=-0.31,
    ),
}


def frame_view(frame: str, ground_z_m: float | None = None) -> FrameView:
    """Create the view of an annotation frame.

    Args:
        frame: ``lidar`` or ``ego``.
        ground_z_m: Height of the road in that frame in metres, for sensors whose mounting is not
            known; None for the usual height of the frame.
    """
    view = FRAME_VIEWS[frame]
    if ground_z_m is None:
        return view
    # The frame ``ego`` is the frame of the vehicle, so both heights are equal.
    ego_ground_z_m = ground_z_m if frame == "ego" else view.ego_ground_z_m
    return replace(view, ground=(0.0, 0.0, ground_z_m), ego_ground_z_m=ego_ground_z_m)
