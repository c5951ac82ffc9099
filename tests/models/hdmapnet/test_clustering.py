"""Clusters of whole balls are those of DBSCAN."""

import numpy as np
from sklearn.cluster import DBSCAN

from gsmap.models.hdmapnet.clustering import dense_clusters


def test_clusters_are_dbscans_and_numbered_alike():
    rng, compared = np.random.default_rng(0), 0
    for _ in range(60):
        dims, number = rng.integers(1, 5), rng.integers(1, 9)
        centres = rng.normal(size=(number, dims)) * rng.uniform(0.5, 4)
        spread = rng.uniform(0.02, 0.5) * (rng.random((400, 1)) < 0.9) * rng.uniform(0.3, 3)
        points = centres[rng.integers(0, number, 400)] + spread * rng.normal(size=(400, dims))
        eps, least = rng.uniform(0.3, 1.5), int(rng.integers(2, 40))
        found = dense_clusters(points, eps, least)
        if found is not None:
            wanted = DBSCAN(eps=eps, min_samples=least).fit_predict(points)
            np.testing.assert_array_equal(found, wanted)
            compared += 1
    assert compared > 20


def test_points_far_from_each_other_are_left_to_dbscan():
    assert dense_clusters(np.arange(200.0)[:, None], 0.5, 2) is None
    assert dense_clusters(np.arange(60.0)[:, None], 0.5, 2) is None


def test_a_point_on_the_border_of_two_clusters_belongs_to_the_first():
    """Cores at 0 and 2 of five points each; one point at 1, whose neighbours are too few."""
    points = np.array([2.0] * 5 + [1.0] + [0.0] * 5)[:, None]
    found = dense_clusters(points, 1.0, 12)
    assert found is None  # no core at all: nothing is dense
    points = np.array([2.0] * 9 + [1.0] + [0.0] * 9)[:, None]
    assert dense_clusters(points, 1.0, 20) is None
    dense = dense_clusters(np.concatenate([points, [[5.0]]]), 1.0, 9)
    assert dense.tolist() == [0] * 19 + [-1]  # a core itself, it joins both
