"""A spinning LiDAR: rays against flat ground, vehicles and buildings."""

import numpy as np
from numpy.typing import NDArray

from minicity.curves import Array
from minicity.texture import GroundTexture
from minicity.vehicles import Vehicle

BEAMS = 32
COLUMNS = 720
LOWEST_RAD, HIGHEST_RAD = np.deg2rad(-30.0), np.deg2rad(9.0)
RANGE_M = 75.0
RANGE_NOISE_M = 0.015


def footprint_array(footprints: list[Array], heights: list[float]) -> Array:
    """Rectangles and their heights as rows: 4 corners, then the height. (n, 9)"""
    rows = [np.append(f.reshape(-1), h) for f, h in zip(footprints, heights, strict=True)]
    return np.array(rows, float).reshape(-1, 9)


def vehicle_footprints(vehicles: list[Vehicle]) -> Array:
    """The rectangles of vehicles and people. (n, 9)"""
    if not vehicles:
        return np.zeros((0, 9))
    yaw = np.array([v.yaw_rad for v in vehicles])
    size, center = np.array([v.size for v in vehicles]), np.array([v.center for v in vehicles])
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * size[:, :1] / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * size[:, 1:2] / 2
    middle = center[:, :2]
    corners = [middle + forward + left, middle - forward + left, middle - forward - left]
    corners.append(middle + forward - left)
    return np.column_stack([*corners, size[:, 2]])


def _entry_distances(origin: Array, directions: Array, boxes: Array) -> Array:
    """Distances at which level rays enter each rectangle, inf where they miss. (A, n)"""
    corners = boxes[:, :8].reshape(-1, 4, 2) - origin
    start, edge = corners, np.roll(corners, -1, axis=1) - corners
    dx, dy = directions[:, 0, None, None], directions[:, 1, None, None]
    cross = dx * edge[None, ..., 1] - dy * edge[None, ..., 0]
    cross = np.where(np.abs(cross) < 1e-12, 1e-12, cross)
    reach = (
        start[None, ..., 0] * edge[None, ..., 1] - start[None, ..., 1] * edge[None, ..., 0]
    ) / cross
    share = (start[None, ..., 0] * dy - start[None, ..., 1] * dx) / cross
    hit = (reach > 0.3) & (share >= 0) & (share <= 1)
    return np.where(hit, reach, np.inf).min(axis=2)


def scan(
    world_from_lidar: Array, texture: GroundTexture, boxes: Array, rng: np.random.Generator
) -> NDArray[np.float32]:
    """One revolution.

    Args:
        world_from_lidar: Pose of the sensor. (4, 4)
        texture: The ground, for its reflectivity.
        boxes: Vehicles and buildings: 4 corners and a height each. (n, 9)
        rng: Source of the range noise.

    Returns:
        x, y, z in the sensor's frame, intensity in [0, 255], beam index. (N, 5)
    """
    origin = world_from_lidar[:3, 3]
    azimuth = np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False) + rng.uniform(
        0, 2 * np.pi / COLUMNS
    )
    elevation = np.linspace(LOWEST_RAD, HIGHEST_RAD, BEAMS)
    level = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    slope = np.tan(elevation)
    ground = np.where(slope < -1e-3, -origin[2] / np.minimum(slope, -1e-3), np.inf)
    reach = np.broadcast_to(ground[:, None], (BEAMS, COLUMNS)).copy()
    struck = np.full((BEAMS, COLUMNS), -1)
    near = boxes[
        np.linalg.norm(boxes[:, :8].reshape(-1, 4, 2) - origin[:2], axis=-1).min(1) < RANGE_M
    ]
    entry = _entry_distances(origin[:2], level, near)
    column, box = np.nonzero(np.isfinite(entry))
    # Far hits first: of several hits of one ray, the nearest is written last and stays.
    order = np.argsort(-entry[column, box], kind="stable")
    column, box = column[order], box[order]
    distance = entry[column, box]
    at = origin[2] + slope[:, None] * distance
    rows, hit = np.nonzero((at > 0) & (at < near[box, 8]))
    reach[rows, column[hit]] = distance[hit]
    struck[rows, column[hit]] = box[hit]
    rows, columns = np.nonzero(reach / np.cos(elevation)[:, None] < RANGE_M)
    distance = reach[rows, columns] + rng.normal(0, RANGE_NOISE_M, len(rows))
    world = np.column_stack(
        [origin[:2] + level[columns] * distance[:, None], origin[2] + slope[rows] * distance]
    )
    on_box = struck[rows, columns]
    intensity = texture.sample_reflectivity(world[:, :2]).astype(float)
    tint = 18.0 + 7.0 * (np.arange(len(near) + 1) % 9)
    intensity = np.where(on_box >= 0, tint[on_box], intensity) + rng.normal(0, 2.0, len(rows))
    local_points = (world - origin) @ world_from_lidar[:3, :3]
    cloud = np.column_stack([local_points, np.clip(np.round(intensity), 0, 255), rows])
    return cloud.astype(np.float32)
