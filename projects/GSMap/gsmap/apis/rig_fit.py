"""A model that was built for one set of cameras, on another."""

from collections.abc import Sequence

import numpy as np

from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.frames import FRAME_VIEWS
from gsmap.visualization.camera_view import viewing_azimuth

# Where the cameras of nuScenes and Argoverse 2 look: degrees to the left of straight ahead.
AZIMUTHS_DEG = {
    "CAM_FRONT": 0, "CAM_FRONT_LEFT": 55, "CAM_FRONT_RIGHT": -55, "CAM_BACK_LEFT": 109,
    "CAM_BACK_RIGHT": -111, "CAM_BACK": 180, "ring_front_center": 0, "ring_front_left": 45,
    "ring_front_right": -45, "ring_side_left": 99, "ring_side_right": -99, "ring_rear_left": 153,
    "ring_rear_right": -153,
}  # fmt: skip


def similar_cameras(
    sample: MapSample, frame: str, names: Sequence[str], trained: Sequence[str]
) -> list[int]:
    """Say which of a model's cameras looks most as each camera of a sample does.

    Args:
        sample: A sample.
        frame: Its annotation frame.
        names: Its cameras; one that it lacks counts as looking ahead.
        trained: The model's cameras; the result has an index into these for each name.

    Raises:
        ValueError: If it is not known where the model's cameras look.
    """
    unknown = [name for name in trained if name not in AZIMUTHS_DEG]
    if unknown:
        raise ValueError(
            f"the model is for the cameras {list(trained)}, the input has {list(names)}: name them "
            "as the model does."
        )
    looks = np.radians([AZIMUTHS_DEG[name] for name in trained])
    cameras = {camera.name: camera for camera in sample.cameras}
    found = []
    for name in names:
        azimuth = 0.0
        if name in cameras:
            azimuth = viewing_azimuth(cameras[name].cam_from_frame, FRAME_VIEWS[frame])
        found.append(int(np.argmax(np.cos(looks - azimuth))))
    return found
