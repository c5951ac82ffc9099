"""Pivots of the ground truth by hand, and what the transform refuses."""

import numpy as np
import pytest

from gsmap.datasets.annotations.record import MapInstance
from gsmap.engine.launch import read_config
from gsmap.models.lines.targets import orient_line
from gsmap.models.pivotnet.matching import match_pivots, path_costs
from gsmap.models.pivotnet.targets import FormatPivotTargets, significances
from gsmap.structures.grid import BEVGrid


def targets(*instances, **settings):
    results = {"map_instances": instances, "token": "a", "x_range": (-15, 15), "y_range": (-30, 30)}
    return FormatPivotTargets(**settings).transform(results)["gt_instances_3d"]


def test_areas_by_hand():
    line = np.array([[0.0, 0.0], [1.0, 0.1], [2.0, 0.0], [3.0, 4.0], [4.0, 0.0]])
    # (1, .1) goes with 0.1; then (2, 0) lies in a triangle of 4 with (0, 0) and (3, 4)
    assert significances(line).tolist() == pytest.approx([np.inf, 0.1, 4.0, 8.0, np.inf])


def test_a_corner_is_a_pivot_and_a_line_starts_at_the_rear():
    corner = MapInstance(0, np.array([[0.0, 20.0], [0.0, 0.0], [10.0, 0.0]]))
    found = targets(corner)
    assert found.num_pts.tolist() == [3]
    np.testing.assert_allclose(found.pts[0, :3], [[10, 0], [0, 0], [0, 20]], atol=1.01)
    assert found.masks.shape == (1, 400, 200)
    assert found.masks[0, 200, 100:160].all()


def test_a_crossing_becomes_its_two_longest_edges_or_stays_a_ring():
    ring = np.array([[-5.0, 0], [5, 0], [5, 3], [-5, 3], [-5, 0]])
    found = targets(MapInstance(1, ring))
    assert found.num_pts.tolist() == [2, 2]
    whole = targets(MapInstance(1, ring), edge_classes=(), num_points=(10, 10, 30), sort_rings=True)
    assert whole.num_pts.tolist()[0] >= 4
    np.testing.assert_array_equal(whole.pts[0, 0], whole.pts[0, whole.num_pts[0] - 1])


def test_the_end_of_a_long_line_is_lost_unless_it_is_kept():
    zigzag = np.array([[(-1) ** i * 5.0, 4.0 * i - 20] for i in range(10)])
    first = targets(MapInstance(0, zigzag), num_points=(4, 2, 30))
    kept = targets(MapInstance(0, zigzag), num_points=(4, 2, 30), keep_end=True)
    assert first.num_pts.tolist() == kept.num_pts.tolist() == [4]
    assert first.pts[0, 3, 1] < 0 < kept.pts[0, 3, 1]


def test_lines_across_start_at_the_right():
    across = np.array([[10.0, 2.0], [10.5, 9.0]])  # (u, v): metres from the front and from the left
    assert orient_line(across, 1.0).tolist() == across[::-1].tolist()


def test_elements_and_settings_that_cannot_be():
    with pytest.raises(ValueError, match="label 3 of an element"):
        targets(MapInstance(3, np.array([[0.0, 0], [0, 9]])))
    with pytest.raises(ValueError, match="num_points must be >= 2"):
        FormatPivotTargets(num_points=(10, 1))
    with pytest.raises(ValueError, match="edge_classes must be indices of the 3 classes"):
        FormatPivotTargets(edge_classes=(3,))
    for name in ("pixel_m", "step_m", "thickness_px"):
        with pytest.raises(ValueError, match=f"{name} must be more than 0, got 0"):
            FormatPivotTargets(**{name: 0})


def test_the_matching_by_hand_and_too_few_points():
    costs = np.array([[0.0, 5, 5], [9, 1, 9], [9, 9, 2]])
    assert match_pivots(costs).tolist() == [0, 1, 2]
    assert path_costs(costs)[-1, -1] == 3
    with pytest.raises(ValueError, match="2 pivots cannot be matched with 1 points"):
        match_pivots(np.zeros((2, 1)))


@pytest.mark.parametrize("forward", ["x", "y"])
def test_the_front_left_corner_is_the_origin_and_back(forward):
    grid = BEVGrid((-10, 10), (-20, 20), forward=forward)
    corner = {"x": [10.0, 20.0], "y": [-10.0, 20.0]}[forward]
    np.testing.assert_allclose(grid.front_from_metres(np.array([corner])), [[0, 0]])
    points = np.array([[3.0, -7.0]])
    np.testing.assert_allclose(grid.metres_from_front(grid.front_from_metres(points)), points)


@pytest.mark.parametrize("queries", [5, [5, 5, 5], None])
def test_settings_that_the_head_refuses_are_left_to_it(queries):
    cfg = read_config("configs/pivotnet/pivotnet_r18_minicity.py")
    cfg.model.map_head.queries = queries
    read_config(cfg)
