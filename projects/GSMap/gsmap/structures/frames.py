"""How an annotation frame lies to the driver and the ground, so that ahead points up."""

from dataclasses import dataclass, replace

import numpy as np

from gsmap.structures.elements import FloatArray


@dataclass(frozen=True)
class FrameView:
    """Orientation of the frame in which a map is given, and the ground plane in it.

    Args:
        forward: Axis that points ahead: ``"y"`` (x is right) or ``"x"`` (y is left).
        ground: Ground plane z = a x + b y + c as (a, b, c), c in metres.
        vehicle_m: Rear end, front end (along the forward axis) and width of the ego vehicle, in
            metres.
        ego_ground_z_m: Height of the ground in the *vehicle's* frame, which ``tilted`` starts from,
            in metres.
    """

    forward: str
    ground: tuple[float, float, float]
    vehicle_m: tuple[float, float, float]
    ego_ground_z_m: float = 0.0

    def tilted(self, ego_from_frame: FloatArray | None) -> "FrameView":
        """Return the view with the ground plane that the sensor's mounting implies.

        A roof LiDAR is mounted with a tilt of a degree or two, which at 20 m moves the ground by
        half a metre. None leaves the frame's usual level ground. (4, 4)
        """
        if ego_from_frame is None:
            return self
        a, b, c, height = (float(v) for v in np.asarray(ego_from_frame)[2])
        return replace(self, ground=(-a / c, -b / c, (self.ego_ground_z_m - height) / c))

    def display_from_frame(self, points: FloatArray) -> FloatArray:
        """Turn (x, y) of the frame into (right, ahead), both in metres. (..., >= 2) -> (..., 2)"""
        if self.forward == "y":
            return points[..., :2]
        return np.stack([-points[..., 1], points[..., 0]], axis=-1)

    @property
    def display_turn_rad(self) -> float:
        """Angle by which the display is turned against the frame, anticlockwise, in radians."""
        return 0.0 if self.forward == "y" else np.pi / 2

    def lifted(self, points: FloatArray) -> FloatArray:
        """Return points with a height: their own z, or the ground plane's. (n, 2 or 3) -> (n, 3)"""
        if points.shape[-1] >= 3:
            return points[..., :3]
        height = points[..., :2] @ np.asarray(self.ground[:2]) + self.ground[2]
        return np.concatenate([points, height[..., None]], axis=-1)


def viewing_azimuth(img_from_frame: FloatArray, view: FrameView) -> float:
    """Return where the camera of a projection matrix (4, 4) looks: its angle from straight ahead.

    In radians, in (-pi, pi], to the left positive. The third row of the matrix is the optical axis,
    up to a positive factor.
    """
    right, ahead = view.display_from_frame(np.asarray(img_from_frame)[2, :2])
    return float(np.arctan2(-right, ahead))


# Heights: the roof LiDAR of nuScenes stands 1.84 m above the road, on which its vehicle frame has
# its origin; the ego frame of Argoverse 2 has its own on the rear axle, 0.31 m above the road
# (median z of map vertices within 8 m). Vehicles: Renault Zoe, Ford Fusion.
FRAME_VIEWS: dict[str, FrameView] = {
    "lidar": FrameView(forward="y", ground=(0.0, 0.0, -1.84), vehicle_m=(-1.59, 2.49, 1.73)),
    "ego": FrameView("x", (0.0, 0.0, -0.31), vehicle_m=(-1.10, 3.77, 1.85), ego_ground_z_m=-0.31),
}


def frame_view(frame: str, ground_z_m: float | None = None) -> FrameView:
    """Return the view of an annotation frame.

    Args:
        frame: ``lidar`` or ``ego``.
        ground_z_m: Height of the road in that frame, where a sensor's mounting does not tell it, in
            metres; None is the frame's usual.
    """
    view = FRAME_VIEWS[frame]
    if ground_z_m is None:
        return view
    of_vehicle = ground_z_m if frame == "ego" else view.ego_ground_z_m
    return replace(view, ground=(0.0, 0.0, ground_z_m), ego_ground_z_m=of_vehicle)
