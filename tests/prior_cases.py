"""Classes, poses and frames of a drive, for tests of maps of earlier drives."""

import numpy as np
from model_cases import make_samples, straight_elements

CLASSES = ("divider", "ped_crossing", "boundary")


def pose_at(x: float, y: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:2, 3] = x, y
    return pose


def frames(*places: tuple[str, str, float] | None) -> list:
    """Return a sample of each place: its town, its scene and its x in metres; None without pose."""
    lines = (((-3, -20), (-3, 20)), ((3, -20), (4, 20)))
    samples = make_samples(*(straight_elements(*lines, labels=[0, 2]) for _ in places))
    for number, (sample, place) in enumerate(zip(samples, places, strict=True)):
        meta = {"timestamp_ns": number, "can_bus": np.zeros(18)}
        if place is not None:
            town, scene, x = place
            meta |= {"map_name": town, "scene": scene, "lidar2global": pose_at(x)}
        sample.set_metainfo(meta)
    return samples
