"""Projection and clipping against values worked by hand.

The camera stands at the origin and looks along +z (the camera's own axes: x right, y down), with a
focal length of 100 px and the principal point in the middle of an image of 200 x 100 px.
"""

import numpy as np

from gsmap.visualization.camera_projection import (
    NEAR_M,
    project_polygon,
    project_segments,
    subdivide,
)

SIZE = (200, 100)
CAMERA = np.array(
    [[100.0, 0, 100, 0], [0, 100.0, 50, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
)  # img_from_frame


def project(start, end):
    return project_segments(np.array([start], float), np.array([end], float), CAMERA, SIZE)


def test_visible_segment_keeps_its_ends():
    segments, depth, index = project((0, 0, 10), (5, 2, 20))
    np.testing.assert_allclose(segments, [[[100, 50], [125, 60]]])
    np.testing.assert_allclose(depth, [15])
    assert index.tolist() == [0]


def test_segment_that_runs_behind_the_camera_is_cut_at_the_near_plane():
    # From 10 m ahead to 10 m behind, 0.12 m beside the axis: at 0.3 m depth it lies at
    # u = 100 + 100 * 0.12 / 0.3.
    segments, _, _ = project((0.12, 0, 10), (0.12, 0, -10))
    np.testing.assert_allclose(segments[0], [[101.2, 50], [140, 50]])


def test_segment_behind_the_camera_vanishes_although_its_projection_lies_inside():
    assert len(project((1, 0, -10), (-1, 0, -5))[0]) == 0


def test_segment_is_cut_at_the_edges_of_the_image():
    # At 10 m depth the image spans x = -10 .. 10 m and y = -5 .. 5 m.
    segments, _, _ = project((-30, 0, 10), (30, 0, 10))
    np.testing.assert_allclose(segments[0], [[0, 50], [200, 50]], atol=1e-9)


def test_segment_that_passes_a_corner_outside_vanishes():
    # Both ends lie outside different edges, and the line between passes beyond the corner (10, 5).
    assert len(project((16, 0, 10), (0, 16, 10))[0]) == 0


def test_index_names_the_segments_that_are_left():
    starts = np.array([[0, 0, 10], [0, 0, -10], [1, 1, 10.0]])
    _, _, index = project_segments(starts, starts + np.array([0.5, 0, 0]), CAMERA, SIZE)
    assert index.tolist() == [0, 2]


def test_no_segments_give_empty_arrays():
    segments, depth, index = project_segments(np.empty((0, 3)), np.empty((0, 3)), CAMERA, SIZE)
    assert segments.shape == (0, 2, 2)
    assert depth.shape == index.shape == (0,)


def test_agrees_with_dense_sampling_on_random_segments():
    rng = np.random.default_rng(0)
    starts, ends = rng.uniform(-20, 20, (2, 200, 3))
    segments, _, index = project_segments(starts, ends, CAMERA, SIZE)
    t = np.linspace(0, 1, 4001)[:, None]
    visible = []
    for i, (a, b) in enumerate(zip(starts, ends, strict=True)):
        points = a + t * (b - a)
        w = points[:, 2]
        uv = points[:, :2] * 100 / np.where(w > 0, w, 1)[:, None] + [100, 50]
        inside = (w >= NEAR_M) & (uv >= 0).all(1) & (uv <= SIZE).all(1)
        if inside.sum() > 1:
            visible.append(i)
            found = segments[index.tolist().index(i)]
            expected = uv[inside][[0, -1]]
            # A sample is up to 1/4000 of a segment away from the true cut.
            step = np.abs(np.diff(uv[inside], axis=0)).max() + 1e-6
            assert np.abs(found - expected).max() <= step + 1e-6
    assert set(visible) <= set(index.tolist())
    assert len(index) - len(visible) <= 2  # slivers between two samples


def test_polygon_around_the_camera_is_cut_and_not_wrapped():
    # Ground 1 m below (y = 1), from 5 m behind to 5 m ahead and 1 m to both sides: ahead it spans
    # u = 100 -+ 20 at v = 50 + 20; the near parts leave through the lower edge, v = 100, at
    # depth 2, where u = 100 -+ 50.
    ring = np.array([[-1, 1, -5], [1, 1, -5], [1, 1, 5], [-1, 1, 5.0]])
    shape = project_polygon(ring, CAMERA, SIZE)
    expected = {(80, 70), (120, 70), (150, 100), (50, 100)}
    assert {tuple(np.round(p).astype(int)) for p in shape} == expected


def test_polygon_out_of_sight_is_empty():
    ring = np.array([[0, 0, -1], [1, 0, -1], [1, 0, -2.0]])
    assert project_polygon(ring, CAMERA, SIZE).shape == (0, 2)


def test_subdivided_keeps_vertices_and_bounds_the_step():
    line = np.array([[0.0, 0, 0], [2.5, 0, 1], [2.5, 0.4, 1]])
    dense = subdivide(line, 1.0)
    np.testing.assert_allclose(dense[[0, 3, 4]], line)
    np.testing.assert_allclose(dense[1], [2.5 / 3, 0, 1 / 3])
    assert np.linalg.norm(np.diff(dense, axis=0), axis=1).max() <= 1.0
