"""A vehicle's signals from its poses, worked by hand."""

import numpy as np
import pytest

from gsmap.structures.calibration import without_history
from gsmap.structures.rigid import rigid
from gsmap.structures.vehicle_signals import motion_signals


def heading(yaw_deg: float, x: float, y: float) -> np.ndarray:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return rigid([[c, -s, 0], [s, c, 0], [0, 0, 1]], (x, y, 0))


def test_a_car_that_drives_north_and_brakes():
    """4 m in the first half second and 3 m in the next: 7 m/s ahead, braking with 4 m/s2."""
    found = motion_signals(
        (0.0, heading(90, 2, 4)), (-0.5, heading(90, 2, 0)), (0.5, heading(90, 2, 7))
    )
    half = np.sqrt(0.5)
    np.testing.assert_allclose(found[:7], [2, 4, 0, half, 0, 0, half], atol=1e-12)
    np.testing.assert_allclose(found[7:10], [-4, 0, 9.81], atol=1e-12)
    np.testing.assert_allclose(found[10:16], [0, 0, 0, 7, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found[16:], [np.pi / 2, 90])


def test_a_turn_to_the_left_of_20_degrees_a_second_from_two_poses():
    for before, after in (((-1.0, heading(-20, 0, 0)), None), (None, (1.0, heading(20, 5, 0)))):
        found = motion_signals((0.0, heading(0, 0, 0)), before, after)
        np.testing.assert_allclose(found[10:13], [0, 0, np.radians(20)], atol=1e-9)
        assert found[13] == (5 if after else 0)
        np.testing.assert_allclose(found[7:10], [0, 0, 9.81])


def test_one_pose_alone_stands_still():
    found = motion_signals((3.0, heading(0, 1, 2)))
    np.testing.assert_allclose(found, [1, 2, 0, 1, 0, 0, 0, 0, 0, 9.81, *[0] * 8])


def test_what_is_of_earlier_frames_is_zero():
    assert without_history(np.arange(1.0, 19.0)).tolist() == [0, 0, 0, *range(4, 18), 0]
    with pytest.raises(ValueError, match=r"18 values, got shape \(3,\)"):
        without_history(np.ones(3))


def test_poses_may_be_rounded_as_annotation_files_allow():
    exact, rounded = heading(33, 2, 4), heading(33, 2, 4).round(4)
    turned = heading(40, 3, 4).round(4)
    found = motion_signals((0.0, rounded), (-0.5, turned), None)
    np.testing.assert_allclose(found[3:7], motion_signals((0.0, exact), None, None)[3:7], atol=1e-3)
