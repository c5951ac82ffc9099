"""Projection of polylines into pinhole images, cut at the near plane and the image's edges.

All cutting happens in homogeneous pixel coordinates (u w, v w, w), where every edge of the viewing
frustum is a linear inequality and a straight line stays straight. So a line that runs behind the
camera is cut instead of wrapping round, and no dense sampling is needed for a correct result.
"""

import numpy as np

NEAR_M = 0.3  # smallest depth that is drawn


def _homogeneous_px(points: np.ndarray, img_from_frame: np.ndarray) -> np.ndarray:
    """Map points in metres (n, 3) to (u w, v w, w), where w is the depth in metres. (n, 3)"""
    return points @ img_from_frame[:3, :3].T + img_from_frame[:3, 3]


def _frustum_values(points: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Signed distances to the five planes of the frustum, >= 0 inside. (n, 3) -> (5, n)"""
    width, height = size_px
    u, v, w = points.T
    return np.stack([w - NEAR_M, u, width * w - u, v, height * w - v])


def project_segments(
    starts: np.ndarray, ends: np.ndarray, img_from_frame: np.ndarray, size_px: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project straight segments into an image and keep the visible parts (Liang-Barsky clipping).

    Args:
        starts: First end points in metres. (n, 3)
        ends: Second end points in metres. (n, 3)
        img_from_frame: Projection matrix, intrinsics times extrinsics. (4, 4)
        size_px: Width and height of the image.

    Returns:
        The visible segments as pixel coordinates (m, 2, 2), the depth of their middle in metres
        (m,), and the index of the segment that each came from (m,).
    """
    first, last = (_homogeneous_px(points, img_from_frame) for points in (starts, ends))
    f0, f1 = (_frustum_values(points, size_px) for points in (first, last))  # (5, n)
    crossing = (f0 < 0) != (f1 < 0)
    t = np.where(crossing, f0 / np.where(crossing, f0 - f1, 1.0), 0.0)
    enter = np.where(crossing & (f0 < 0), t, 0.0).max(axis=0)  # (n,)
    leave = np.where(crossing & (f1 < 0), t, 1.0).min(axis=0)
    index = np.flatnonzero((enter < leave) & ~((f0 < 0) & (f1 < 0)).any(axis=0))
    direction = (last - first)[index]
    at = np.stack([enter, leave], axis=1)[index, :, None]  # (m, 2, 1)
    cut = first[index, None] + at * direction[:, None]  # (m, 2, 3)
    return cut[..., :2] / cut[..., 2:], cut[..., 2].mean(axis=1), index


def project_polygon(
    ring: np.ndarray, img_from_frame: np.ndarray, size_px: tuple[int, int]
) -> np.ndarray:
    """Project a polygon and cut it to the image (Sutherland and Hodgman, 1974).

    Args:
        ring: Vertices in metres; repeating the first one at the end is optional. (n, 3)
        img_from_frame: Projection matrix. (4, 4)
        size_px: Width and height of the image.

    Returns:
        Pixel coordinates of the visible part, empty if there is none. (m, 2)
    """
    points = _homogeneous_px(ring, img_from_frame)
    for plane in range(5):
        values = _frustum_values(points, size_px)[plane]
        following, next_values = np.roll(points, -1, axis=0), np.roll(values, -1)
        kept: list[np.ndarray] = []
        for p, q, f0, f1 in zip(points, following, values, next_values, strict=True):
            if f0 >= 0:
                kept.append(p)
            if (f0 < 0) != (f1 < 0):
                kept.append(p + f0 / (f0 - f1) * (q - p))
        if len(kept) < 3:
            return np.empty((0, 2))
        points = np.stack(kept)
    return points[:, :2] / points[:, 2:]


def subdivided(points: np.ndarray, step_m: float) -> np.ndarray:
    """Insert vertices so that no segment is longer than a step. (n >= 1, D) metres -> (m, D)"""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    counts = np.maximum(np.ceil(lengths / step_m).astype(int), 1)
    parts = [i + np.arange(n) / n for i, n in enumerate(counts)]
    position = np.concatenate([*parts, [len(points) - 1.0]])
    return np.stack([np.interp(position, range(len(points)), xyz) for xyz in points.T], axis=1)
