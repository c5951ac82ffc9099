"""How an annotation frame lies to the driver and the ground, so that ahead points up."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np


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

    Raises:
        ValueError: If ``forward`` is neither ``"x"`` nor ``"y"``.
    """

    forward: str
    ground: tuple[float, float, float]
    vehicle_m: tuple[float, float, float]
    ego_ground_z_m: float = 0.0

    def __post_init__(self) -> None:
        if self.forward not in ("x", "y"):
            raise ValueError(f"forward must be 'x' or 'y', got {self.forward!r}.")

    def tilted(self, ego_from_frame: np.ndarray) -> "FrameView":
        """Return the view with the ground plane that the sensor's mounting implies.

        A roof LiDAR is mounted with a tilt of a degree or two, which at 20 m moves the ground by
        half a metre.

        Args:
            ego_from_frame: Transform from the annotation frame to the vehicle. (4, 4)
        """
        a, b, c, height = (float(v) for v in np.asarray(ego_from_frame)[2])
        return replace(self, ground=(-a / c, -b / c, (self.ego_ground_z_m - height) / c))

    def level(self, ground_z_m: float) -> "FrameView":
        """Return the view with a level ground at z = ``ground_z_m``, in metres."""
        return replace(self, ground=(0.0, 0.0, float(ground_z_m)))

    def display_from_frame(self, points: np.ndarray) -> np.ndarray:
        """Turn (x, y) of the frame into (right, ahead), both in metres. (..., >= 2) -> (..., 2)"""
        if self.forward == "y":
            return points[..., :2]
        return np.stack([-points[..., 1], points[..., 0]], axis=-1)

    @property
    def display_turn_rad(self) -> float:
        """Angle by which the display is turned against the frame, anticlockwise, in radians."""
        return 0.0 if self.forward == "y" else np.pi / 2

    def lifted(self, points: np.ndarray) -> np.ndarray:
        """Return points with a height: their own z, or the ground plane's. (n, 2 or 3) -> (n, 3)"""
        if points.shape[-1] >= 3:
            return points[..., :3]
        height = points[..., :2] @ np.asarray(self.ground[:2]) + self.ground[2]
        return np.concatenate([points, height[..., None]], axis=-1)


# Heights: the roof LiDAR of nuScenes stands 1.84 m above the road, on which its vehicle frame has
# its origin; the ego frame of Argoverse 2 has its own on the rear axle, 0.31 m above the road
# (median z of map vertices within 8 m). Vehicles: Renault Zoe, Ford Fusion.
FRAME_VIEWS: dict[str, FrameView] = {
    "lidar": FrameView(forward="y", ground=(0.0, 0.0, -1.84), vehicle_m=(-1.59, 2.49, 1.73)),
    "ego": FrameView("x", (0.0, 0.0, -0.31), vehicle_m=(-1.10, 3.77, 1.85), ego_ground_z_m=-0.31),
}


def resolve_frame_view(dataset_meta: Mapping[str, Any] | None) -> FrameView:
    """Choose the view for a data set.

    Args:
        dataset_meta: The data set's ``metainfo``; its ``frame`` names an entry of ``FRAME_VIEWS``.
            Without one, ``lidar`` is taken.

    Returns:
        The view.

    Raises:
        ValueError: If the frame is not known.
    """
    frame = (dataset_meta or {}).get("frame", "lidar")
    if frame not in FRAME_VIEWS:
        raise ValueError(
            f"No view is known for frame {frame!r}, only for {sorted(FRAME_VIEWS)}; "
            "add one to gsmap.visualization.frame_view.FRAME_VIEWS."
        )
    return FRAME_VIEWS[frame]
