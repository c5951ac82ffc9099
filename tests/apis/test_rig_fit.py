"""Which of a model's cameras looks as one of another rig does."""

import numpy as np
import pytest

from gsmap.apis.rig_fit import similar_cameras
from gsmap.datasets.annotations.record import CameraRecord, MapSample

NUSCENES = (
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
)  # fmt: skip
# rows: the camera's right, down and forward in the vehicle's frame (x forward, y left, z up)
LOOKS_LEFT = [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
LOOKS_RIGHT = [[-1, 0, 0, 0], [0, 0, -1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]


def similar(trained: tuple[str, ...]) -> list[str]:
    """Return what looks most as a camera to the left, one to the right, and one that is absent."""
    matrices = {"west": LOOKS_LEFT, "east": LOOKS_RIGHT}
    cameras = [
        CameraRecord(name, "a.jpg", 1600, 900, np.diag([1000.0, 1000.0, 1.0]), np.array(m, float))
        for name, m in matrices.items()
    ]
    sample = MapSample("a", "scene", "town", 0, cameras, np.eye(4))
    found = similar_cameras(sample, "ego", ["west", "east", "gone"], trained)
    return [trained[index] for index in found]


def test_left_is_left_and_right_is_right():
    """90 degrees lie nearer to 109 and 111 than to 55; what is absent looks ahead."""
    assert similar(NUSCENES) == ["CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_FRONT"]
    assert similar(("ring_side_right", "ring_side_left")) == [
        "ring_side_left",
        "ring_side_right",
        "ring_side_right",  # both are as far from ahead: the first
    ]


def test_a_model_of_unknown_cameras_is_named():
    with pytest.raises(ValueError, match=r"is for the cameras \['a'\], the input has \['west'"):
        similar(("a",))
