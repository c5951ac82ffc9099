"""Rigid transforms against the general inverse."""

import numpy as np
import pytest
from pyquaternion import Quaternion

from gsmap.structures.rigid import invert_rigid


def test_inverse_undoes_a_batch_of_transforms():
    rng = np.random.default_rng(0)
    poses = np.stack([Quaternion(rng.normal(size=4)).transformation_matrix for _ in range(5)])
    poses[:, :3, 3] = rng.normal(scale=100, size=(5, 3))
    np.testing.assert_allclose(invert_rigid(poses), np.linalg.inv(poses), atol=1e-12)
    np.testing.assert_allclose(invert_rigid(poses[0]) @ poses[0], np.eye(4), atol=1e-12)


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        invert_rigid(np.eye(3))
