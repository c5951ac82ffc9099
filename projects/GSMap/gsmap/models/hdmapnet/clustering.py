"""DBSCAN of points that lie close together, in little memory."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Points = NDArray[np.float64]
Indices = NDArray[np.int64]


def dense_clusters(points: Points, eps: float, min_neighbours: int) -> Indices:
    """Cluster points as DBSCAN does (Ester et al., 1996), whole clusters at a time.

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
    labels, left = np.full(len(points), -1), np.arange(len(points))
    if not len(points):
        return labels
    core = near_others(points, points, eps, min_neighbours)
    for first in np.flatnonzero(core):
        if labels[first] >= 0:
            continue
        number, grown = labels.max() + 1, np.array([first])
        while len(grown):  # all that is near a core that was found last joins the cluster
            near = near_others(points[left], points[grown], eps)
            labels[left[near]] = number
            grown, left = left[near & core[left]], left[~near]
    return labels


def near_others(points: Points, others: Points, eps: float, number: int = 1) -> NDArray[np.bool_]:
    """Return which points have a number of others within a distance. (n, E), (m, E) -> (n,)"""
    tree, bound = KDTree(others), eps * (1 + 1e-9)  # the tree's bound is left out
    return (tree.query(points, [number], distance_upper_bound=bound)[0] <= eps)[:, 0]
