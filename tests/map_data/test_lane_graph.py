"""The paths through the lanes, by hand and against networkx."""

import networkx as nx
import numpy as np
import pytest
import shapely

from mapdata import lane_graph
from mapdata.lane_graph import LanePaths, link_lanes


def line(*xy: tuple[float, float]) -> np.ndarray:
    return np.array([(x, y, 0.0) for x, y in xy])


def paths(polylines: list[np.ndarray], successors: list[list[int]], lanes: list[int] | None = None):
    count = len(polylines)
    predecessors = [[j for j in range(count) if i in successors[j]] for i in range(count)]
    links = link_lanes(list(zip(range(count), predecessors, successors, strict=True)))
    lanes = range(count) if lanes is None else lanes
    simplified = LanePaths(polylines, links).simplify_paths(lanes)
    return [shapely.get_coordinates(path).tolist() for path in simplified]


def test_a_lane_and_its_successor_are_one_line_that_drops_small_bends():
    first, second = line((0, 0), (5, 0.1), (10, 0)), line((10, 0), (10, 10))
    assert paths([first, second], [[1], []]) == [[[0, 0], [10, 0], [10, 10]]]


def test_a_gap_between_linked_lanes_is_bridged():
    assert paths([line((0, 0), (4, 0)), line((6, 1), (9, 1))], [[1], []]) == [
        [[0, 0], [4, 0], [6, 1], [9, 1]]
    ]


def test_a_fork_gives_one_line_per_branch():
    r"""
            / (20, 5)
    (0,0)--(10,0)
            \ (20, -5)
    """
    lanes = [line((0, 0), (10, 0)), line((10, 0), (20, 5)), line((10, 0), (20, -5))]
    assert paths(lanes, [[1, 2], [], []]) == [
        [[0, 0], [10, 0], [20, 5]],
        [[0, 0], [10, 0], [20, -5]],
    ]


def test_only_the_lanes_that_take_part_are_joined():
    lanes = [line((0, 0), (10, 0)), line((10, 0), (20, 5)), line((10, 0), (20, -5))]
    assert paths(lanes, [[1, 2], [], []], lanes=[0, 2]) == [[[0, 0], [10, 0], [20, -5]]]


def test_lanes_that_share_a_point_join_there_without_a_link():
    crossing = [line((0, 0), (10, 0), (20, 0)), line((10, -9), (10, 0), (10, 9))]
    assert len(paths(crossing, [[], []])) == 4


def test_a_closed_loop_has_neither_source_nor_sink():
    assert paths([line((0, 0), (9, 0)), line((9, 0), (0, 9), (0, 0))], [[1], [0]]) == []


def test_too_many_paths_are_refused(monkeypatch):
    monkeypatch.setattr(lane_graph, "MAX_PATHS", 1)
    lanes = [line((0, 0), (10, 0)), line((10, 0), (20, 5)), line((10, 0), (20, -5))]
    with pytest.raises(ValueError, match="more than 1 paths"):
        paths(lanes, [[1, 2], [], []])


def test_a_polyline_needs_two_points():
    with pytest.raises(ValueError, match=r"polylines\[0\] must have shape"):
        LanePaths([np.zeros((1, 3))], [[]])


@pytest.mark.parametrize("seed", range(25))
def test_paths_equal_those_of_the_graph_of_all_points(seed):
    """Random lanes on a coarse lattice share many points, repeat some, and form loops."""
    rng = np.random.default_rng(seed)
    count = 6
    polylines = [
        np.pad(rng.integers(0, 5, (rng.integers(2, 6), 2)) * 100.0, ((0, 0), (0, 1)))
        for _ in range(count)
    ]
    successors = [
        sorted({int(j) for j in rng.integers(0, count, 2) if j != i}) for i in range(count)
    ]
    graph = nx.DiGraph()
    for i, polyline in enumerate(polylines):
        points = list(map(tuple, polyline.tolist()))
        nx.add_path(graph, points)
        graph.add_edges_from((points[-1], tuple(polylines[j][0].tolist())) for j in successors[i])
    leaves = [node for node, degree in graph.out_degree() if degree == 0]
    expected = []
    for root in [node for node, degree in graph.in_degree() if degree == 0]:
        expected += [[p[:2] for p in path] for path in nx.all_simple_paths(graph, root, leaves)]
    found = {shapely.LineString(path).wkt for path in paths(polylines, successors)}
    assert found == {shapely.LineString(p).simplify(0.2).wkt for p in expected}
