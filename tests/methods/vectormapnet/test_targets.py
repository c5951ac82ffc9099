"""VectorMapNet's targets, by hand."""

import numpy as np
import pytest
import torch
from methods.vectormapnet.cases import GRID, transformed

from gsmap.datasets.transforms.map_targets import FormatMapTargets
from gsmap.models.vectormapnet.canvas import Canvas, tokenize_points
from gsmap.models.vectormapnet.targets import (
    FormatPolylineTargets,
    StretchToPadding,
    bounding_box,
    edge_weights,
    even_weights,
)


def test_a_box_without_height_grows_on_all_sides():
    line = np.array([[0.2, 0.5], [0.6, 0.5]])
    np.testing.assert_allclose(bounding_box(line, 0.02), [0.19, 0.49, 0.61, 0.51], atol=1e-12)
    square = np.array([[0.2, 0.5], [0.6, 0.9]])
    np.testing.assert_allclose(bounding_box(square, 0.02), [0.2, 0.5, 0.6, 0.9])


def test_points_weigh_as_long_as_their_edges():
    line = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.1]])  # means 0.3, 0.2, 0.1
    np.testing.assert_allclose(
        edge_weights(line), [1 / 4, 1 / 4, 1 / 6, 1 / 6, 1 / 12, 1 / 12, 1 / 6]
    )
    np.testing.assert_allclose(even_weights(line), np.full(7, 1 / 7))


def test_tokens_count_pixels_from_one_and_stop_with_zero():
    canvas = Canvas(GRID)
    assert (canvas.size, canvas.num_tokens) == ((200, 100), 201)
    points = canvas.norm_from_metres(np.array([[-30.0, -15.0], [32.0, 17.0], [1.0, 1.0]]))
    np.testing.assert_allclose(points, [[0, 0], [1, 1], [0.5, 0.5]], atol=1e-12)
    assert tokenize_points(points, canvas.steps).tolist() == [1, 1, 200, 100, 100, 50, 0]
    np.testing.assert_allclose(canvas.metres_from_norm(points)[2], [1.0, 1.0])


def test_targets_of_two_lines():
    long = [[-29.0, 0.0], [0.0, 0.1], [20.0, 0.0], [20.0, 10.0]]  # the second is not needed
    found = transformed(long, [[0.0, -5.0], [0.0, 5.0]], labels=[2, 1])
    assert found.num_pts.tolist() == [3, 2]
    assert found.labels_3d.tolist() == [2, 1]
    torch.testing.assert_close(found.pts[1], torch.tensor([[0.0, -5.0], [0.0, 5.0], [0.0, 5.0]]))
    assert found.tokens.shape == found.token_weights.shape == (2, 7)
    # (0 + 30) / 62 * 199 = 96.3, (-5 + 15) / 32 * 99 = 30.9, (5 + 15) / 32 * 99 = 61.9
    assert found.tokens[1].tolist() == [97, 31, 97, 62, 0, 0, 0]
    torch.testing.assert_close(found.token_weights[1], torch.tensor([0.2] * 5 + [0.0] * 2))
    middle = 30 / 62
    expected = [200 * (middle - 0.01), 100 * (10 / 32 - 0.01), 200 * (middle + 0.01)]
    torch.testing.assert_close(found.keypoints[1, :3], torch.tensor(expected), atol=1e-3, rtol=0)
    assert found.keypoint_tokens[1].tolist() == [94, 29, 98, 62]


def test_corners_stay_off_the_border():
    found = transformed([[-30.0, -15.0], [-30.0, 15.0]])
    assert found.keypoints[0, :2].tolist() == pytest.approx([0.1, 0.1])
    assert (found.keypoint_tokens >= 0).all()


def test_behind_maptrs_targets_both_are_there():
    results = {
        "map_instances": [], "token": "a", "x_range": GRID.x_range, "y_range": GRID.y_range,
    }  # fmt: skip
    results = FormatMapTargets().transform(results)
    found = FormatPolylineTargets().transform(results)["gt_instances_3d"]
    assert found.pts.shape == (0, 20, 2)
    assert "num_pts" not in found
    assert "tokens" in found


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="must not be negative"):
        FormatPolylineTargets(tolerance_m=-1.0)
    with pytest.raises(ValueError, match="margin_m must be >= 0"):
        Canvas(GRID, margin_m=-1.0)
    with pytest.raises(ValueError, match="do not divide the map"):
        Canvas(GRID, pixel_m=0.7)


def test_projections_are_stretched_over_the_padding():
    half = np.diag([0.5, 0.5, 1, 1])
    results = {"img_shape": (256, 455), "lidar2img": [np.eye(4)], "img_aug_matrix": [half]}
    found = StretchToPadding().transform(results)
    np.testing.assert_allclose(np.diag(found["lidar2img"][0]), [480 / 455, 1, 1, 1])
    back = np.linalg.inv(found["img_aug_matrix"][0]) @ found["lidar2img"][0]
    np.testing.assert_allclose(back, np.diag([2, 2, 1, 1]))  # pictures show the file, as before
