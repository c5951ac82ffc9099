"""Poses of a vehicle over time, and the distortion of its cameras."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapdata.folders.rig import PoseTrack, RigCamera

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
