"""Simulation of a spinning LiDAR, whose rays hit flat ground, vehicles and buildings."""

import numpy as np
from numpy.typing import NDArray

from minicity.curves import Array
from minicity.texture import GroundTexture
from minicity.vehicles import Vehicle

BEAMS = 32  # one for each elevation
COLUMNS = 720  # azimuth angles of a revolution
LOWEST_RAD = np.deg2rad(-30.0)  # elevation of the lowest beam
HIGHEST_RAD = np.deg2rad(9.0)
RANGE_M = 75.0
_NEAREST_M = 0.3  # hits at smaller distances do not count
RANGE_NOISE_M = 0.015  # standard deviation


def footprint_array(footprints: list[Array], heights: list[float]) -> Array:
    """Pack boxes into one array. A box is a rectangle on the ground with a height.

    Args:
        footprints: Corners x, y of each rectangle in metres. Each (4, 2)
        heights: Height of each box in metres.

    Returns:
        x, y of the four corners, then the height, of each box in metres. (n, 9)
    """
    rows = []
    for footprint, height in zip(footprints, heights, strict=True):
        rows.append(np.append(footprint.reshape(-1), height))
    return np.array(rows, dtype=float).reshape(-1, 9)


def vehicle_footprints(vehicles: list[Vehicle]) -> Array:
    """Footprints of vehicles and people: four corners x, y and the height, in metres. (n, 9)"""
    if not vehicles:
        return np.zeros((0, 9))
    # Half the length ahead, and half the width to the left. (n, 2) each
    yaw = np.array([v.yaw_rad for v in vehicles])
    size = np.array([v.size for v in vehicles])
    middle = np.array([v.center for v in vehicles])[:, :2]
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * size[:, :1] / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * size[:, 1:2] / 2
    return np.column_stack(
        [
            middle + forward + left,
            middle - forward + left,
            middle - forward - left,
            middle + forward - left,
            size[:, 2],
        ]
    )


def _entry_distances(origin: Array, directions: Array, boxes: Array) -> Array:
    """Distances at which horizontal rays enter rectangles.

    Args:
        origin: Start of all rays in metres. (2,)
        directions: Unit directions of the A rays. (A, 2)
        boxes: x, y of the four corners, then the height, of each box in metres. (n, 9)

    Returns:
        Distances in metres, inf where a ray misses the rectangle. (A, n)
    """
    # An edge starts at a corner and leads to the next corner. (n, 4, 2) each
    start = boxes[:, :8].reshape(-1, 4, 2) - origin
    edge = np.roll(start, -1, axis=1) - start
    dx = directions[:, 0, None, None]
    dy = directions[:, 1, None, None]
    direction_cross_edge = dx * edge[None, ..., 1] - dy * edge[None, ..., 0]
    # A ray parallel to an edge would divide by zero. With a tiny divisor it misses the edge.
    is_parallel = np.abs(direction_cross_edge) < 1e-12
    direction_cross_edge = np.where(is_parallel, 1e-12, direction_cross_edge)
    # A ray meets the line of an edge where reach * direction = start + share * edge. The cross
    # product of both sides with the edge gives `reach`. The cross product with the direction gives
    # `share`.
    start_cross_edge = (
        start[None, ..., 0] * edge[None, ..., 1] - start[None, ..., 1] * edge[None, ..., 0]
    )
    reach = start_cross_edge / direction_cross_edge
    start_cross_direction = start[None, ..., 0] * dy - start[None, ..., 1] * dx
    share = start_cross_direction / direction_cross_edge  # 0 to 1 on the edge
    hit = (reach > _NEAREST_M) & (share >= 0) & (share <= 1)
    return np.where(hit, reach, np.inf).min(axis=2)


def scan(
    world_from_lidar: Array, texture: GroundTexture, boxes: Array, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Simulate one revolution of the LiDAR.

    Args:
        world_from_lidar: Pose of the sensor, in metres. (4, 4)
        texture: The ground, for its reflectivity.
        boxes: Vehicles and buildings: x, y of the four corners in order, then the height, in
            metres. (n, 9)
        rng: Source of the range noise.

    Returns:
        x, y, z in the sensor frame in metres, intensity in [0, 255], beam index. (N, 5)
    """
    origin = world_from_lidar[:3, 3]
    # A random start of the revolution, less than one step of the azimuth.
    first_rad = rng.uniform(low=0, high=2 * np.pi / COLUMNS)
    azimuth = np.linspace(-np.pi, np.pi, num=COLUMNS, endpoint=False) + first_rad
    elevation = np.linspace(LOWEST_RAD, HIGHEST_RAD, num=BEAMS)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    slope = np.tan(elevation)
    # Horizontal distance at which each beam meets the ground, z = 0. It is infinite for beams that
    # are level or rise.
    ground = np.where(slope < -1e-3, -origin[2] / np.minimum(slope, -1e-3), np.inf)
    # Horizontal distance and box of the hit of each ray; -1 stands for the ground.
    reach = np.broadcast_to(ground[:, None], (BEAMS, COLUMNS)).copy()
    hit_box = np.full((BEAMS, COLUMNS), -1)
    corner_distances = np.linalg.norm(boxes[:, :8].reshape(-1, 4, 2) - origin[:2], axis=-1)
    # Boxes without a corner in range are left out.
    near = boxes[corner_distances.min(axis=1) < RANGE_M]
    entry = _entry_distances(origin[:2], directions, boxes=near)  # (COLUMNS, boxes)
    column, box = np.nonzero(np.isfinite(entry))
    # Far hits first: of several hits of one ray, the nearest is written last and stays.
    order = np.argsort(-entry[column, box], kind="stable")
    column = column[order]
    box = box[order]
    distance = entry[column, box]
    height = origin[2] + slope[:, None] * distance  # of each beam at each hit. (BEAMS, hits)
    # A ray hits a box if its height at the box is between 0 and the height of the box. It is still
    # above the ground, z = 0, so the box is nearer than the ground.
    rows, hit = np.nonzero((height > 0) & (height < near[box, 8]))
    reach[rows, column[hit]] = distance[hit]
    hit_box[rows, column[hit]] = box[hit]
    # Distances along the rays must be in range. `rows` are the beams of the points.
    rows, columns = np.nonzero(reach / np.cos(elevation)[:, None] < RANGE_M)
    noise = rng.normal(loc=0, scale=RANGE_NOISE_M, size=len(rows))
    distance = reach[rows, columns] + noise
    world_xy = origin[:2] + directions[columns] * distance[:, None]
    world_z = origin[2] + slope[rows] * distance
    world = np.column_stack([world_xy, world_z])
    point_box = hit_box[rows, columns]
    # Intensity of each box. Points on the ground have the index -1 and read the additional last
    # entry, which `np.where` replaces by the intensity of the ground.
    tint = 18.0 + 7.0 * (np.arange(len(near) + 1) % 9)
    ground_intensity = texture.sample_reflectivity(world[:, :2]).astype(float)
    intensity = np.where(point_box >= 0, tint[point_box], ground_intensity)
    intensity = intensity + rng.normal(loc=0, scale=2.0, size=len(rows))
    # The points are row vectors, so multiplying by R from the right applies the inverse rotation.
    local_points = (world - origin) @ world_from_lidar[:3, :3]
    cloud = np.column_stack([local_points, np.clip(np.round(intensity), 0, 255), rows])
    return cloud.astype(np.float32)
