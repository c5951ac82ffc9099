"""DBSCAN of many points that lie close together, in little memory."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled

Points = NDArray[np.float64]
Indices = NDArray[np.int64]
_NOISE = -1


def dense_clusters(points: Points, eps: float, min_neighbours: int) -> Indices:
    """Cluster points as DBSCAN does (Ester et al., 1996).

    Points are sorted along their first principal axis, so that neighbours are near in this order;
    a cluster grows over the points that no cluster has yet, so each is reached once.
    `sklearn.cluster.DBSCAN` keeps the neighbours of all points, which are gigabytes where a
    network that is not trained yet gives every pixel the same embedding.

    Args:
        points: Float64. (n, E)
        eps: Largest distance of neighbours.
        min_neighbours: Neighbours that make a point the core of a cluster, itself included.

    Returns:
        The number of each point's cluster, from 0 on in the order of their first cores, -1 for
        none. (n,)
    """
    if not len(points):
        return np.zeros(0, np.int64)
    _, axes = np.linalg.eigh(np.cov(points, rowvar=False, bias=True).reshape(points.shape[1], -1))
    points = points @ axes[:, ::-1]  # the axis along which they differ most first
    order = np.argsort(points[:, 0], kind="stable")
    points = np.ascontiguousarray(points[order].T)  # few points are compared in all dimensions
    low = np.searchsorted(points[0], points[0] - eps)
    high = np.searchsorted(points[0], points[0] + eps, "right")
    labels = np.empty(len(order), np.int64)
    labels[order] = _clusters(points, np.argsort(order), low, high, eps**2, min_neighbours)
    return labels


@njit(cache=True)
def _clusters(
    points: Points, firsts: Indices, low: Indices, high: Indices, eps2: float, least: int
) -> Indices:
    """Return the clusters of points whose neighbours lie between low and high; see above.

    Args:
        points: (E, n)
        firsts: In which order clusters begin. (n,)
        low: First place that may be a neighbour's. (n,)
        high: Place after the last that may be. (n,)
        eps2: Largest squared distance of neighbours.
        least: Neighbours of a core.
    """
    count, found = len(firsts), 0
    core = np.array([_is_core(points, i, low[i], high[i], eps2, least) for i in range(count)])
    labels, stack = np.full(count, _NOISE), np.empty(count, np.int64)
    free = np.arange(count + 1)  # from each place, the next point of no cluster, by jumps
    for first in firsts:
        if not core[first] or labels[first] != _NOISE:
            continue
        labels[first], free[first] = found, first + 1
        stack[0], depth = first, 1
        while depth:
            depth -= 1
            own = stack[depth]
            other = _end(free, low[own])
            while other < high[own]:
                if _near(points, own, other, eps2):
                    labels[other], free[other] = found, other + 1
                    if core[other]:
                        stack[depth] = other
                        depth += 1
                other = _end(free, other + 1)
        found += 1
    return labels


@njit(cache=True)
def _is_core(points: Points, own: int, low: int, high: int, eps2: float, least: int) -> bool:
    """Return whether a point has enough neighbours, itself included; the nearest places first."""
    number = 1
    for step in range(1, max(own - low, high - 1 - own) + 1):
        if own - step >= low:
            number += _near(points, own, own - step, eps2)
        if own + step < high:
            number += _near(points, own, own + step, eps2)
        if number >= least:
            return True
    return number >= least


@njit(cache=True)
def _near(points: Points, i: int, j: int, eps2: float) -> bool:
    """Return whether two points are neighbours; stops at the first dimension that says no."""
    total = 0.0
    for axis in points:
        total += (axis[i] - axis[j]) ** 2
        if total > eps2:
            return False
    return True


@njit(cache=True)
def _end(jumps: Indices, start: int) -> int:
    """Return where the jumps from a place end, and shorten them."""
    end = start
    while jumps[end] != end:
        end = jumps[end]
    while jumps[start] != end:
        jumps[start], start = end, jumps[start]
    return end
