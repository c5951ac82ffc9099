"""Clusters are those of DBSCAN."""

import tracemalloc

import numpy as np
import pytest
from sklearn.cluster import DBSCAN

from gsmap.models.hdmapnet.clustering import dense_clusters


def test_clusters_are_dbscans_and_numbered_alike():
    rng, several = np.random.default_rng(0), 0
    for _ in range(60):
        dims, number = rng.integers(1, 5), rng.integers(1, 9)
        centres = rng.normal(size=(number, dims)) * rng.uniform(0.5, 4)
        spread = rng.uniform(0.02, 0.5) * (rng.random((400, 1)) < 0.9) * rng.uniform(0.3, 3)
        points = centres[rng.integers(0, number, 400)] + spread * rng.normal(size=(400, dims))
        eps, least = rng.uniform(0.3, 1.5), int(rng.integers(2, 40))
        found = dense_clusters(points, eps, least)
        wanted = DBSCAN(eps=eps, min_samples=least).fit_predict(points)
        np.testing.assert_array_equal(found, wanted)
        several += found.max() > 0
    assert several > 20


@pytest.mark.parametrize("apart", [0.4, 0.6])
def test_a_chain_is_one_cluster_or_none(apart):
    """A chain of 200 points, and the same points as a cluster for each."""
    points = apart * np.arange(200.0)[:, None]
    found = dense_clusters(points, 0.5, 1)
    assert found.tolist() == ([0] * 200 if apart < 0.5 else list(range(200)))
    assert dense_clusters(points, 0.5, 4).tolist() == [-1] * 200
    assert dense_clusters(points[:0], 0.5, 4).tolist() == []


def test_a_point_on_the_border_of_two_clusters_belongs_to_the_first():
    """Cores at 0 and 2 of five points each; one point at 1, whose neighbours are too few."""
    points = np.array([2.0] * 5 + [1.0] + [0.0] * 5)[:, None]
    assert dense_clusters(points, 1.0, 12).tolist() == [-1] * 11  # no core at all
    assert dense_clusters(points, 0.9, 5).tolist() == [0] * 5 + [-1] + [1] * 5
    points = np.array([2.0] * 9 + [1.0] + [0.0] * 9 + [5.0])[:, None]
    assert dense_clusters(points, 1.0, 9).tolist() == [0] * 19 + [-1]  # a core joins both
    points = np.array([2.0] * 5 + [1.0] + [0.0] * 5 + [2.9] * 8 + [-0.9] * 8)[:, None]
    found = dense_clusters(points, 1.0, 12)  # 1.0 has 11 neighbours, 2.0 and 0.0 have 14
    assert found.tolist() == [0] * 6 + [1] * 5 + [0] * 8 + [1] * 8


def test_equal_points_need_little_memory():
    """20,000 points that lie together: the distances of their pairs alone would take 3 GB."""
    points = np.random.default_rng(0).normal(size=(20_000, 2)) * [1.0, 0.02]
    tracemalloc.start()
    found = dense_clusters(points, 1.5, 50)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    assert (found == 0).mean() > 0.99
