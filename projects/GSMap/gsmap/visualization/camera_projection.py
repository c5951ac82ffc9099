"""Projection of polylines into pinhole images, cut at the near plane and the edges of the image.

Lines are cut in homogeneous pixel coordinates (u w, v w, w). In these coordinates, straight lines
remain straight, and each plane of the viewing frustum is a linear inequality. Therefore, a line
that runs behind the camera is cut correctly, without dense sampling.
"""

import numpy as np

NEAR_M = 0.3
"""Smallest depth in metres of a visible point."""
_NUM_PLANES = 5  # planes of the frustum: near, left, right, top and bottom


def _homogeneous_px(points: np.ndarray, img_from_frame: np.ndarray) -> np.ndarray:
    """Project points in metres (n, 3) to (u w, v w, w), where w is the depth in metres. (n, 3)"""
    return points @ img_from_frame[:3, :3].T + img_from_frame[:3, 3]


def _frustum_values(points: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Compute one value of each point for each plane of the frustum. (n, 3) -> (5, n)

    A value is >= 0 on the inner side of its plane. For example, u >= 0 becomes u w >= 0.
    """
    width, height = size_px
    uw, vw, w = points.T
    return np.stack([w - NEAR_M, uw, width * w - uw, vw, height * w - vw])


def project_segments(
    starts: np.ndarray, ends: np.ndarray, img_from_frame: np.ndarray, size_px: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project straight segments and cut them to the image (Liang and Barsky, 1984).

    Args:
        starts: First end points in metres. (n, 3)
        ends: Second end points in metres. (n, 3)
        img_from_frame: Projection matrix, intrinsics times extrinsics, from the frame of the end
            points. (4, 4)
        size_px: Width and height of the image in pixels.

    Returns:
        Visible parts of the segments in pixels, (m, 2, 2), mean depth of the two ends of each part
        in metres, (m,), and index of the segment of each part, (m,).
    """
    first = _homogeneous_px(starts, img_from_frame)
    last = _homogeneous_px(ends, img_from_frame)
    first_values = _frustum_values(first, size_px)  # (5, n)
    last_values = _frustum_values(last, size_px)  # (5, n)
    first_outside = first_values < 0
    last_outside = last_values < 0
    # A segment crosses a plane where the plane's value is 0. `fraction` is the position of this
    # point, from 0 at the first end to 1 at the last end. The segment is visible from the last
    # plane at which it enters the frustum to the first plane at which it leaves.
    crosses = first_outside != last_outside
    change = np.where(crosses, first_values - last_values, 1.0)  # 1 avoids a division by 0
    fraction = np.where(crosses, first_values / change, 0.0)
    enter = np.where(crosses & first_outside, fraction, 0.0).max(axis=0)  # (n,)
    leave = np.where(crosses & last_outside, fraction, 1.0).min(axis=0)  # (n,)
    is_outside = (first_outside & last_outside).any(axis=0)  # both ends are beyond one plane
    index = np.flatnonzero((enter < leave) & ~is_outside)
    direction = (last - first)[index]
    fractions = np.stack([enter, leave], axis=1)[index, :, None]  # (m, 2, 1)
    visible = first[index, None] + fractions * direction[:, None]  # (m, 2, 3)
    depth_m = visible[..., 2].mean(axis=1)
    pixels = visible[..., :2] / visible[..., 2:]  # (m, 2, 2)
    return pixels, depth_m, index


def project_polygon(
    ring: np.ndarray, img_from_frame: np.ndarray, size_px: tuple[int, int]
) -> np.ndarray:
    """Project a polygon and cut it to the image (Sutherland and Hodgman, 1974).

    Args:
        ring: Vertices in metres; the first one may be repeated at the end. (n, 3)
        img_from_frame: Projection matrix, intrinsics times extrinsics, from the frame of the
            vertices. (4, 4)
        size_px: Width and height of the image in pixels.

    Returns:
        Visible part in pixels, empty if there is none. (m, 2)
    """
    points = _homogeneous_px(ring, img_from_frame)
    for plane in range(_NUM_PLANES):  # each plane cuts the result of the planes before it
        values = _frustum_values(points, size_px)[plane]
        next_points = np.roll(points, -1, axis=0)
        next_values = np.roll(values, -1)
        cut_ring: list[np.ndarray] = []
        for start, end, start_value, end_value in zip(
            points, next_points, values, next_values, strict=True
        ):
            # Vertices on the inner side of the plane are kept. Each edge that crosses the plane
            # gets a vertex at the crossing.
            if start_value >= 0:
                cut_ring.append(start)
            if (start_value < 0) != (end_value < 0):
                fraction = start_value / (start_value - end_value)
                cut_ring.append(start + fraction * (end - start))
        if len(cut_ring) < 3:
            return np.empty((0, 2))
        points = np.stack(cut_ring)
    return points[:, :2] / points[:, 2:]


def subdivide(points: np.ndarray, step_m: float) -> np.ndarray:
    """Insert vertices into a polyline, so that no segment is longer than a step.

    Args:
        points: Vertices in metres. (n, D)
        step_m: Largest length of a segment in metres.

    Returns:
        The given vertices and the inserted ones, in order. (m, D)
    """
    if not len(points):
        return points
    lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    counts = np.maximum(np.ceil(lengths_m / step_m).astype(int), 1)
    # The position i + s is at the share s of the segment from vertex i to vertex i + 1. A segment
    # has the positions from its start on, without its end, which is the start of the next segment.
    segment_positions = [index + np.arange(count) / count for index, count in enumerate(counts)]
    last_position = len(points) - 1.0
    positions = np.concatenate([*segment_positions, [last_position]])  # (m,)
    vertices = np.arange(len(points))
    columns = [np.interp(positions, vertices, column) for column in points.T]
    return np.stack(columns, axis=1)
