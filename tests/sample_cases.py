"""A sample of an annotation file in which every field has a value."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.record import (
    AnnotationMeta,
    CameraRecord,
    LidarRecord,
    MapInstance,
    MapSample,
    SweepRecord,
)

META = AnnotationMeta("nuscenes", "lidar", "val", options={"centreline": False}, command="make it")


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


INTRINSICS = np.array([[1266.4, 0, 816.3], [0, 1266.4, 491.5], [0, 0, 1]])


def sample(number: int = 0, **changes) -> MapSample:
    cameras = [
        CameraRecord(name, f"samples/{name}/{number}.jpg", 1600, 900, INTRINSICS, pose(number + i))
        for i, name in enumerate(("CAM_FRONT", "CAM_BACK"))
    ]
    lidar = LidarRecord("lidar/0.bin", pose(1), [SweepRecord("lidar/-1.bin", 5, pose(2))])
    points = np.array([[0, 0], [1.5, 2], [3, 4]], np.float32) + number
    known = MapSample(
        f"token{number}", "scene", "town", 10 + number, cameras, pose(3), lidar, np.arange(18.0),
        [MapInstance(2, points), MapInstance(0, points[:2])], pose(4),
    )  # fmt: skip
    return replace(known, **changes)


def assert_same(found: MapSample, wanted: MapSample) -> None:
    for name in ("token", "scene", "map_name", "timestamp_ns"):
        assert getattr(found, name) == getattr(wanted, name)
    np.testing.assert_array_equal(found.global_from_frame, wanted.global_from_frame)
    np.testing.assert_array_equal(found.ego_from_frame, wanted.ego_from_frame)
    for camera, other in zip(found.cameras, wanted.cameras, strict=True):
        assert (camera.name, camera.path, camera.width, camera.height) == (
            other.name, other.path, other.width, other.height,
        )  # fmt: skip
        np.testing.assert_array_equal(camera.intrinsics, other.intrinsics)
        np.testing.assert_array_equal(camera.cam_from_frame, other.cam_from_frame)
