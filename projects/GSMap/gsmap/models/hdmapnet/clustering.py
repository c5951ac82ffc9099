"""DBSCAN of points that lie close together: whole balls at once, the same clusters."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Points = NDArray[np.float64]
_MOST_BALLS = 64


def squared_distances(points: Points, others: Points) -> Points:
    """Return the squared distances of all pairs. (n, E), (m, E) -> (n, m)"""
    norms = (points**2).sum(1)[:, None] + (others**2).sum(1)
    return norms - 2 * points @ others.T


def dense_clusters(points: Points, eps: float, min_neighbours: int) -> NDArray[np.int64] | None:
    """Cluster points as DBSCAN does (Ester et al., 1996), many of them together.

    All points of a ball of radius ``eps / 2`` are neighbours of each other, so a ball of enough
    points is a part of one cluster, and only the points of small balls are counted one by one.

    Args:
        points: Float64, as `sklearn.cluster.DBSCAN` takes them. (n, E)
        eps: Largest distance of neighbours.
        min_neighbours: Neighbours that make a point the core of a cluster, itself included.

    Returns:
        The number of each point's cluster, from 0 on in the order of their first cores, -1 for
        none (n,); None if the points fill too many balls, so that this would be no faster.
    """
    balls, to_leaders = _balls(points, eps)
    if balls is None:
        return None
    large = np.flatnonzero(np.bincount(balls) >= min_neighbours)
    alone = np.flatnonzero(~np.isin(balls, large))
    if 4 * len(alone) > len(points):
        return None
    near = squared_distances(points[alone], points) <= eps**2  # (rest, n)
    core = np.ones(len(points), dtype=bool)
    core[alone] = near.sum(1) >= min_neighbours
    # nodes: the large balls, then cores of the rest, each by itself
    node = np.full(len(points), -1)
    in_large = np.isin(balls, large)
    node[in_large] = np.searchsorted(large, balls[in_large])
    single = alone[core[alone]]
    node[single] = len(large) + np.arange(len(single))
    rows, others = np.nonzero(near[core[alone]] & core)
    touching = _touching(points, balls, to_leaders, large, eps)
    edges = np.concatenate([np.stack([node[single[rows]], node[others]], 1), touching])
    size = len(large) + len(single)
    graph = coo_array((np.ones(len(edges), dtype=np.int8), edges.T), shape=(size, size))
    _, component = connected_components(graph, directed=False)
    labels = np.full(len(points), -1)
    labels[core] = component[node[core]]
    found, first = np.unique(labels[core], return_index=True)
    rank = np.empty(len(found) + 1, dtype=np.int64)
    rank[-1] = -1
    rank[found[np.argsort(first)]] = np.arange(len(found))
    labels = rank[labels]
    border = ~core[alone]
    reached = np.where(near[border] & core, labels, len(points)).min(1, initial=len(points))
    labels[alone[border]] = np.where(reached < len(points), reached, -1)
    return labels


def _balls(points: Points, eps: float) -> tuple[NDArray[np.int64] | None, list[Points]]:
    """Return the ball of each point, and all points' squared distances from the balls' leaders."""
    balls = np.full(len(points), -1)
    to_leaders: list[Points] = []
    inside = (eps / 2) ** 2 * (1 - 1e-9)
    while (left := balls < 0).any():
        if len(to_leaders) == _MOST_BALLS:
            return None, []
        leader = points[np.argmax(left)]
        apart = squared_distances(points, leader[None])[:, 0]
        balls[left & (apart <= inside)] = len(to_leaders)
        balls[np.argmax(left)] = len(to_leaders)
        to_leaders.append(apart)
    return balls, to_leaders


def _touching(
    points: Points,
    balls: NDArray[np.int64],
    to_leaders: list[Points],
    large: NDArray[np.int64],
    eps: float,
) -> NDArray[np.int64]:
    """Return the pairs of large balls that have neighbours in each other. (pairs, 2)"""
    found = [np.zeros((0, 2), dtype=np.int64)]
    members = [np.flatnonzero(balls == ball) for ball in large]
    for i, own in enumerate(members):
        for j in range(i + 1, len(members)):
            other = members[j]
            apart, back = to_leaders[large[j]][own], to_leaders[large[i]][other]
            touch = min(apart.min(), back.min()) <= eps**2  # a leader is a member
            if not touch:
                reach = (1.5 * eps) ** 2 * (1 + 1e-9)
                a, b = points[own[apart <= reach]], points[other[back <= reach]]
                touch = len(a) and len(b) and squared_distances(a, b).min() <= eps**2
            if touch:
                found.append(np.array([[i, j]]))
    return np.concatenate(found)
