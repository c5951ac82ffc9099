"""A camera for a view that is missing."""

import numpy as np

from gsmap.structures.calibration import OUT_OF_SIGHT


def test_a_camera_out_of_sight_sees_nothing_and_is_seen_by_nothing():
    """It is a camera: a rotation and a place; all ground in range lies a kilometre behind it."""
    rotation = OUT_OF_SIGHT[:3, :3]
    np.testing.assert_array_equal(rotation @ rotation.T, np.eye(3))
    assert np.linalg.det(rotation) == 1.0
    np.testing.assert_array_equal(OUT_OF_SIGHT[3], [0, 0, 0, 1])
    corners = np.array([[x, y, z, 1.0] for x in (-60, 60) for y in (-60, 60) for z in (-5, 5)])
    assert (OUT_OF_SIGHT @ corners.T)[2].max() < -900
    np.testing.assert_allclose(np.linalg.inv(OUT_OF_SIGHT) @ [0, 0, 60, 1], [0, 1060, 0, 1])
