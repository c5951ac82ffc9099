"""DBSCAN of points that lie close together: whole balls at once, in little memory."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Points = NDArray[np.float64]
Indices = NDArray[np.int64]
_MOST_BALLS = 64
_MOST_PAIRS = 4_000_000  # compared at once


def squared_distances(points: Points, others: Points) -> Points:
    """Return the squared distances of all pairs. (n, E), (m, E) -> (n, m)"""
    norms = (points**2).sum(1)[:, None] + (others**2).sum(1)
    return norms - 2 * points @ others.T


def dense_clusters(points: Points, eps: float, min_neighbours: int) -> Indices:
    """Cluster points as DBSCAN does (Ester et al., 1996), many of them together.

    All points of a ball of radius ``eps / 2`` are neighbours of each other, so a ball of enough
    points is a part of one cluster, and only the points of small balls are counted one by one.
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
    balls, to_leaders = _balls(points, eps)
    large = np.flatnonzero(np.bincount(balls[balls >= 0]) >= min_neighbours)
    core = np.isin(balls, large)
    alone = np.flatnonzero(~core)
    node = np.where(core, np.searchsorted(large, balls), -1)
    for rows in _parts(alone, len(points)):
        near = squared_distances(points[rows], points) <= eps**2
        core[rows] = near.sum(1) >= min_neighbours
    # nodes: the large balls, then cores of the rest, each by itself
    single = alone[core[alone]]
    node[single] = len(large) + np.arange(len(single))
    cores = np.flatnonzero(core)
    component = np.arange(len(large) + len(single))
    component = _joined(component, _touching(points, balls, to_leaders, large, eps))
    for rows in _parts(single, len(cores)):
        near = squared_distances(points[rows], points[cores]) <= eps**2
        near &= component[node[rows], None] != component[node[cores]]
        row, column = np.nonzero(near)
        component = _joined(component, np.stack([node[rows[row]], node[cores[column]]], 1))
    labels = np.full(len(points), -1)
    labels[cores] = component[node[cores]]
    found, first = np.unique(labels[cores], return_index=True)
    rank = np.full(len(component) + 1, -1)  # the last one for none
    rank[found[np.argsort(first)]] = np.arange(len(found))
    labels = rank[labels]
    for rows in _parts(alone[~core[alone]], len(cores)):
        near = squared_distances(points[rows], points[cores]) <= eps**2
        reached = np.where(near, labels[cores], len(points)).min(1, initial=len(points))
        labels[rows] = np.where(reached < len(points), reached, -1)
    return labels


def _parts(rows: Indices, columns: int) -> Iterator[Indices]:
    """Yield the rows in parts of at most `_MOST_PAIRS` pairs with all columns."""
    size = max(1, _MOST_PAIRS // max(1, columns))
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


def _joined(component: Indices, edges: Indices) -> Indices:
    """Return the component of each node, after edges have joined some. (n,), (edges, 2) -> (n,)"""
    if not len(edges):
        return component
    size = int(component.max()) + 1
    graph = coo_array((np.ones(len(edges), dtype=bool), component[edges].T), shape=(size, size))
    return connected_components(graph, directed=False)[1].astype(np.int64)[component]


def _balls(points: Points, eps: float) -> tuple[Indices, list[Points]]:
    """Return the ball of each point, and all points' squared distances from the balls' leaders.

    Points that are left after `_MOST_BALLS` are in none: -1.
    """
    balls = np.full(len(points), -1)
    to_leaders: list[Points] = []
    inside = (eps / 2) ** 2 * (1 - 1e-9)
    while len(to_leaders) < _MOST_BALLS and (left := balls < 0).any():
        leader = points[np.argmax(left)]
        apart = squared_distances(points, leader[None])[:, 0]
        balls[left & (apart <= inside)] = len(to_leaders)
        balls[np.argmax(left)] = len(to_leaders)
        to_leaders.append(apart)
    return balls, to_leaders


def _touching(
    points: Points,
    balls: Indices,
    to_leaders: list[Points],
    large: Indices,
    eps: float,
) -> Indices:
    """Return the pairs of large balls that have neighbours in each other. (pairs, 2)"""
    found = []
    members = [np.flatnonzero(balls == ball) for ball in large]
    reach = (1.5 * eps) ** 2 * (1 + 1e-9)
    for i, own in enumerate(members):
        for j in range(i + 1, len(members)):
            other = members[j]
            apart, back = to_leaders[large[j]][own], to_leaders[large[i]][other]
            touch = min(apart.min(), back.min()) <= eps**2  # a leader is a member
            if not touch:
                a, b = own[apart <= reach], points[other[back <= reach]]
                touch = any(
                    squared_distances(points[part], b).min(initial=np.inf) <= eps**2
                    for part in _parts(a, len(b))
                )
            if touch:
                found.append((i, j))
    return np.array(found, dtype=np.int64).reshape(-1, 2)
