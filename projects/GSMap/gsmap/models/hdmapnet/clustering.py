"""DBSCAN that needs little memory for many points that lie close together."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

import gsmap.utils.compilation  # noqa: F401 - prints a notice when kernels are compiled

Points = NDArray[np.float64]
Indices = NDArray[np.int64]
_NOISE = -1


def dense_clusters(points: Points, eps: float, min_neighbours: int) -> Indices:
    """Cluster points with DBSCAN (Ester et al., KDD 1996).

    Points are sorted along their first principal axis, which bounds the search for neighbours. A
    cluster grows over unlabelled points only, so that each point is reached once. In contrast,
    `sklearn.cluster.DBSCAN` stores the neighbours of all points, which takes gigabytes when an
    untrained network predicts equal embeddings for all pixels.

    Args:
        points: Points in E dimensions, float64. (n, E)
        eps: Largest distance of two neighbours.
        min_neighbours: Smallest number of neighbours of a core point, itself included.

    Returns:
        Cluster number of each point, from 0 on in the order of the clusters' first core points; -1
        for noise. (n,)
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    # The shape (E, E), since NumPy returns a scalar for E = 1.
    covariance = np.cov(points, rowvar=False, bias=True).reshape(points.shape[1], -1)
    _, axes = np.linalg.eigh(covariance)
    points = points @ axes[:, ::-1]  # coordinates along the axes, the largest variance first
    order = np.argsort(points[:, 0], kind="stable")
    points = np.ascontiguousarray(points[order].T)  # (E, n): most pairs differ in the first axes
    # Neighbours of a point lie in low:high, because they differ by at most eps in the first axis.
    low = np.searchsorted(points[0], points[0] - eps)
    high = np.searchsorted(points[0], points[0] + eps, side="right")
    seeds = np.argsort(order)  # position of each given point in the sorted order
    labels = np.empty(len(order), dtype=np.int64)
    # The labels of the sorted points are written to the positions of the given points.
    labels[order] = _clusters(points, seeds, low, high, eps**2, min_neighbours)
    return labels


@njit(cache=True)
def _clusters(
    points: Points,
    seeds: Indices,
    low: Indices,
    high: Indices,
    eps2: float,
    min_neighbours: int,
) -> Indices:
    """Cluster points that are sorted along the first axis.

    Args:
        points: Sorted points. (E, n)
        seeds: Indices of the points, in the order in which clusters start from them. (n,)
        low: Index of the first candidate neighbour of each point. Candidates are the points within
            the largest distance along the first axis. (n,)
        high: End (exclusive) of the candidate neighbours of each point. (n,)
        eps2: Largest squared distance of two neighbours.
        min_neighbours: Smallest number of neighbours of a core point, itself included.

    Returns:
        Cluster number of each point, -1 for noise. (n,)
    """
    count = len(seeds)
    is_core = np.zeros(count, np.bool_)
    for i in range(count):
        is_core[i] = _is_core(points, i, low[i], high[i], eps2, min_neighbours)
    labels = np.full(count, _NOISE)  # points keep this label until a cluster reaches them
    stack = np.empty(count, np.int64)  # points whose neighbours are still to be visited
    # Following the entries from a point leads to the next unlabelled point. The entry of an
    # unlabelled point is the point itself. The last entry, the end of the points, is also itself.
    unlabelled = np.arange(count + 1)
    num_clusters = 0
    for seed in seeds:
        if not is_core[seed] or labels[seed] != _NOISE:  # the latter: already in a cluster
            continue
        labels[seed] = num_clusters
        unlabelled[seed] = seed + 1
        stack[0] = seed
        depth = 1
        while depth:
            depth -= 1
            point = stack[depth]
            other = _follow_jumps(unlabelled, low[point])
            while other < high[point]:  # for all unlabelled candidates
                if _are_neighbours(points, point, other, eps2):
                    labels[other] = num_clusters
                    unlabelled[other] = other + 1
                    if is_core[other]:  # a cluster does not grow from other points
                        stack[depth] = other
                        depth += 1
                other = _follow_jumps(unlabelled, other + 1)
        num_clusters += 1
    return labels


@njit(cache=True)
def _is_core(
    points: Points, point: int, low: int, high: int, eps2: float, min_neighbours: int
) -> bool:
    """Check whether a point has enough neighbours, beginning with the candidates next to it."""
    number = 1  # the point itself
    for step in range(1, max(point - low, high - 1 - point) + 1):
        if point - step >= low:
            number += _are_neighbours(points, point, point - step, eps2)
        if point + step < high:
            number += _are_neighbours(points, point, point + step, eps2)
        if number >= min_neighbours:
            return True
    return number >= min_neighbours


@njit(cache=True)
def _are_neighbours(points: Points, i: int, j: int, eps2: float) -> bool:
    """Check whether two points are neighbours; stops at the first axis that exceeds the limit."""
    total = 0.0
    for axis in points:
        total += (axis[i] - axis[j]) ** 2
        if total > eps2:
            return False
    return True


@njit(cache=True)
def _follow_jumps(jumps: Indices, start: int) -> int:
    """Follow jumps to their end and return it; then let each of these jumps lead to the end."""
    end = start
    while jumps[end] != end:
        end = jumps[end]
    while jumps[start] != end:
        following = jumps[start]
        jumps[start] = end
        start = following
    return end
