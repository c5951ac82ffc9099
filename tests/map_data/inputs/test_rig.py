"""Poses of a vehicle over time, and the distortion of its cameras."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapdata.folders.rig import PoseTrack, RigCamera, set_rectification_targets

SECOND_NS = 1_000_000_000


def pose(x: float, yaw_deg: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    matrix[0, 3] = x
    return matrix


TRACK = PoseTrack([SECOND_NS, 0], [pose(4.0, 90.0), pose(0.0, 0.0)])


def test_poses_between_two_are_interpolated():
    """A quarter of the way from 0 m and 0 degrees to 4 m and 90 degrees."""
    np.testing.assert_allclose(TRACK.at(SECOND_NS // 4), pose(1.0, 22.5), atol=1e-12)
    np.testing.assert_array_equal(TRACK.at(SECOND_NS), pose(4.0, 90.0))


@pytest.mark.parametrize(("end_ns", "step_ns", "x"), [(0, -1, 0.0), (SECOND_NS, 1, 4.0)])
def test_the_ends_reach_a_tenth_of_the_gap(end_ns: int, step_ns: int, x: float):
    near = end_ns + step_ns * SECOND_NS // 10
    assert TRACK.at(near)[0, 3] == x
    assert TRACK.at(near + step_ns) is None
    assert TRACK.at(near + 1000 * step_ns * SECOND_NS) is None


def test_a_longer_gap_is_not_bridged():
    assert PoseTrack([0, 10], [np.eye(4)] * 2, gap_ns=10).at(5) is not None
    assert PoseTrack([0, 11], [np.eye(4)] * 2, gap_ns=10).at(5) is None


def test_near_its_ends_a_longer_gap_has_a_pose_as_the_ends_of_the_track():
    track = PoseTrack([0, 100], [pose(0.0, 0.0), pose(4.0, 0.0)], gap_ns=50)
    at = [track.at(time_ns) for time_ns in (-6, -5, 5, 6, 94, 95, 105, 106)]
    x = [None if found is None else found[0, 3] for found in at]
    assert x == [None, 0.0, 0.0, None, None, 4.0, 4.0, None]


@pytest.mark.parametrize(
    ("model", "numbers", "known"),
    [
        *(("plumb_bob", [0.01] + [0.0] * (n - 1), n in (4, 5, 8, 12, 14)) for n in range(3, 16)),
        ("equidistant", [0.01, 0, 0, 0], True),
        ("equidistant", [0.01, 0, 0, 0, 0], True),  # some drivers add zeros
        ("equidistant", [0.01, 0, 0, 0, 0.01], False),
        ("equidistant", [0.01, 0, 0], False),
        ("equidistant", [0.0, 0, 0, 0], True),  # an ideal fisheye lens is no pinhole camera
        ("equidistant", [0, 0, 0], False),
    ],
)
def test_coefficients_are_as_many_as_opencv_has(model: str, numbers: list[float], known: bool):
    intrinsics = np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])

    def camera() -> RigCamera:
        return RigCamera("a", intrinsics, np.eye(4), (160, 120), np.array(numbers), model)

    if known:
        assert camera().is_distorted
    else:
        with pytest.raises(ValueError, match=f"the model {model} takes 4 [or0-9 ]*numbers"):
            camera()


def test_zeros_of_a_plain_lens_are_a_pinhole_and_a_fisheye_needs_its_coefficients():
    intrinsics = np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])
    size_px = (160, 120)
    for numbers in ([], [0.0] * 5):
        camera = RigCamera("a", intrinsics, np.eye(4), size_px, np.array(numbers), "plumb_bob")
        assert not camera.is_distorted
    with pytest.raises(ValueError, match="but no distortion: give its four coefficients"):
        RigCamera("a", intrinsics, np.eye(4), size_px, np.zeros(0), "equidistant")
    for model in ("none", "pinhole", "omni"):  # names of rectified images
        camera = RigCamera("a", intrinsics, np.eye(4), size_px, np.zeros(4), model)
        assert not camera.is_distorted
        with pytest.raises(ValueError, match=f"distortion model {model!r}; known are"):
            RigCamera("a", intrinsics, np.eye(4), size_px, np.ones(4), model)
    # A ray at 30 degrees from the axis meets r = f theta in the image, f tan(theta) afterwards.
    camera = RigCamera("a", intrinsics, np.eye(4), size_px, np.zeros(4), "equidistant")
    image = np.zeros((120, 160, 3), np.uint8)
    angle = np.radians(30)
    cv2.circle(image, (round(80 + 100 * angle), 60), 1, (255, 255, 255), -1)
    column = camera.rectify(image)[60, :, 0].argmax()
    assert abs(column - (80 + 100 * np.tan(angle))) <= 2


def test_the_focal_length_of_a_model_is_taken_only_if_it_shows_the_image():
    intrinsics = np.array([[5000.0, 0, 800], [0, 5000, 450], [0, 0, 1]])
    bent = np.array([-0.05, 0.01, 0, 0])
    tele, near = (
        RigCamera(name, intrinsics / [[k], [k], [1]], np.eye(4), (1600, 900), bent)
        for name, k in (("tele", 1.0), ("near", 3.5))
    )
    trained = dict.fromkeys(("tele", "near"), (1600, 900, 1266, 1266, 800, 450))
    key, notes = set_rectification_targets([tele, near], trained)
    assert b"near" in key
    assert b"tele" not in key
    assert tele.rectified_intrinsics[0, 0] == 5000
    assert near.rectified_intrinsics[0, 0] == 1266
    assert "camera 'tele' keeps its focal length: with that of the model only 7%" in notes[0]
    assert "camera 'near' is rectified to the focal length of the model, 1266 in" in notes[1]


def test_a_camera_of_another_ratio_is_not_squeezed():
    intrinsics = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    camera = RigCamera("a", intrinsics, np.eye(4), (640, 480), np.array([-0.1, 0, 0, 0]))
    camera.trained = (1600, 900, 1266, 1266, 800, 460)
    wanted = [[506.4, 0, 320], [0, 506.4, 244], [0, 0, 1]]
    np.testing.assert_allclose(camera.rectified_intrinsics, wanted)
