"""Polylines: values worked by hand, and MapTR's training targets."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from gsmap.structures.polylines import (
    PADDING,
    arc_lengths,
    bounding_boxes,
    clamp,
    clip_to_box,
    equivalent_orders,
    is_closed,
    pad_lines,
    parts_inside,
    resample,
    resample_all,
    shortest_orders,
)

SQUARE = np.array([[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]], float)


def test_resampling_keeps_both_ends_and_spaces_by_arc_length():
    corner = np.array([[0, 0], [3, 0], [3, 1]], float)
    np.testing.assert_allclose(arc_lengths(corner), [0, 3, 4])
    np.testing.assert_allclose(resample(corner, 5), [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1]])


def test_lines_of_any_length_are_stacked():
    lines = [np.array([[1.0, 2], [3, 4]]), np.array([[5.0, 6]])]
    assert pad_lines(lines).tolist() == [[[1, 2], [3, 4]], [[5, 6], [5, 6]]]
    assert pad_lines(lines, 3, "constant")[1].tolist() == [[5, 6], [0, 0], [0, 0]]
    assert (pad_lines([]).shape, pad_lines([], 7).shape) == ((0, 2, 2), (0, 7, 2))


def test_a_line_that_crosses_itself_or_the_border_has_several_parts():
    """A loop from the left to the right through (1, 0); only its upper half is in the rectangle."""
    loop = np.array([[0, 0], [2, 0], [2, 2], [1, 2], [1, -1]], float)
    parts = parts_inside(loop, (-9, 9), (-9, 9))
    assert [part.tolist() for part in parts] == [
        [[0, 0], [1, 0]], [[1, 0], [2, 0], [2, 2], [1, 2], [1, 0]], [[1, 0], [1, -1]]
    ]  # fmt: skip
    assert [part.tolist() for part in parts_inside(loop[:3], (1, 3), (-1, 1))] == [
        [[1, 0], [2, 0], [2, 1]]
    ]
    assert parts_inside(loop[:1], (-9, 9), (-9, 9)) == []
    assert parts_inside(loop[:2], (-9, 0), (-9, 9)) == []  # a point


def test_resampling_interpolates_height_and_survives_repeated_points():
    line = np.array([[0, 0, 0], [0, 0, 0], [4, 0, 8]], float)
    resampled = resample(line, 3)
    assert resampled[1, 2] == pytest.approx(4)
    assert resampled[0].tolist() == [0, 0, 0]
    np.testing.assert_array_equal(resample(np.zeros((2, 2)), 3), np.zeros((3, 2)))


def test_many_polylines_are_resampled_at_once():
    """Six points on an L of length 3 + 2, one metre apart; a repeated point; one without points.

    .. code-block:: text

        o-o-o      (0,3) (1,3) (2,3)
        |
        o          (0,2)
        o          (0,1)
        o          (0,0)
    """
    corner, repeated, still = [[0, 0], [0, 3], [2, 3]], [[0, 0], [0, 0], [10, 0]], [[1, 2], [1, 2]]
    points = np.array([*corner, *repeated, *still], float)
    found = resample_all(points, np.array([0, 3, 6, 6, 8]), 6)
    np.testing.assert_allclose(
        found[0], [[0, 0], [0, 1], [0, 2], [0, 3], [1, 3], [2, 3]], atol=1e-12
    )
    np.testing.assert_allclose(found[1, :, 0], [0, 2, 4, 6, 8, 10], atol=1e-12)
    assert found[0, -1].tolist() == [2, 3]  # the ends are kept to the digit
    assert found[2].tolist() == [[0, 0]] * 6
    assert found[3].tolist() == [[1, 2]] * 6
    assert resample_all(np.zeros((0, 2)), np.array([0, 0]), 3).tolist() == [[[0, 0]] * 3]


def test_height_does_not_lengthen_a_line():
    """A ramp of 3 m in the plane that climbs 4 m, then 1 m on the level; as shapely measures it."""
    ramp = np.array([[0, 0, 0], [3, 0, 4], [3, 1, 4]], float)
    np.testing.assert_allclose(arc_lengths(ramp), [0, 3, 4])
    line = shapely.LineString(ramp)
    wanted = [line.interpolate(distance).coords[0] for distance in range(5)]
    np.testing.assert_allclose(resample(ramp, 5), wanted)


def test_an_open_line_has_two_orders():
    line = np.array([[0, 0], [3, 0]], float)
    orders = equivalent_orders(line, 4)
    assert orders.shape == (3, 4, 2)
    np.testing.assert_allclose(orders[0, :, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(orders[1, :, 0], [3, 2, 1, 0])
    assert (orders[2] == PADDING).all()


@pytest.mark.parametrize(("num_points", "slots"), [(2, 2), (3, 2), (4, 3)])
def test_there_is_room_for_two_orders_at_least(num_points: int, slots: int):
    orders = equivalent_orders(np.array([[0.0, 0.0], [3.0, 0.0]]), num_points)
    assert orders.shape == (slots, num_points, 2)
    np.testing.assert_array_equal(orders[:2, [0, -1], 0], [[0, 3], [3, 0]])
    assert (orders[2:] == PADDING).all()


def test_a_ring_has_one_order_per_vertex_and_order_k_starts_at_vertex_minus_k():
    orders = equivalent_orders(SQUARE, 9)
    assert (orders[4:] == PADDING).all()
    np.testing.assert_allclose(orders[:4, 0], [[0, 0], [0, 4], [4, 4], [4, 0]])
    np.testing.assert_allclose(orders[:4, 0], orders[:4, -1])
    np.testing.assert_allclose(orders[1, :3], [[0, 4], [0, 2], [0, 0]])


def test_of_many_vertices_as_many_as_there_is_room_are_taken():
    angles = np.linspace(0, 2 * np.pi, 31)[:-1]
    ring = np.stack([np.cos(angles), np.sin(angles)], -1)
    ring = np.concatenate([ring, ring[:1]])
    starts = equivalent_orders(ring, 20)[:, 0]
    assert len(np.unique(starts.round(6), axis=0)) == 19
    first = equivalent_orders(ring, 20, np.random.default_rng(1))[:, 0]
    second = equivalent_orders(ring, 20, np.random.default_rng(2))[:, 0]
    assert len(np.unique(first.round(6), axis=0)) == 19
    assert not np.allclose(first, second)


def test_boxes_clamping_and_closure():
    assert bounding_boxes(SQUARE - 1).tolist() == [-1, -1, 3, 3]
    assert clamp(np.array([[9.0, -9, 7]]), (-1, 1), (-2, 2)).tolist() == [[1, -2, 7]]
    assert is_closed(SQUARE)
    assert not is_closed(SQUARE[:-1])
    assert not is_closed(np.zeros((2, 2)))


def test_clipping_splits_a_line_that_leaves_and_comes_back():
    """The line dips below the box between x = 1 and x = 3.

    ::

        0---.       .---4      y = 1
             `.   .'
        ------`.-.'------      y = 0, lower edge
    """
    line = np.array([[0, 1], [1, 0], [2, -1], [3, 0], [4, 1]], float)
    left, right = clip_to_box(line, (0, 4), (0, 2))
    np.testing.assert_allclose(left, [[0, 1], [1, 0]])
    np.testing.assert_allclose(right, [[3, 0], [4, 1]])


def test_clipping_cuts_at_the_edge_and_interpolates_height():
    (piece,) = clip_to_box(np.array([[-2, 0, 0], [2, 0, 4]], float), (-1, 1), (-1, 1))
    np.testing.assert_allclose(piece, [[-1, 0, 1], [1, 0, 3]])


def test_a_cut_ring_is_one_piece_across_its_start():
    (piece,) = clip_to_box(SQUARE, (-1, 3), (-1, 3))
    np.testing.assert_allclose(piece, [[0, 3], [0, 0], [3, 0]])


def test_a_ring_inside_stays_closed_and_a_touching_line_is_left_out():
    (piece,) = clip_to_box(SQUARE, (-1, 5), (-1, 5))
    np.testing.assert_allclose(piece, SQUARE)
    assert clip_to_box(np.array([[-1.0, 1], [0, 0], [-1, -1]]), (0, 1), (-1, 1)) == []
    assert clip_to_box(SQUARE, (5, 6), (5, 6)) == []


@pytest.mark.parametrize("points", [np.zeros((1, 2)), np.zeros(4), np.zeros((3, 1))])
def test_what_is_no_polyline_is_refused(points: np.ndarray):
    for function in (lambda p: resample(p, 5), lambda p: equivalent_orders(p, 5)):
        with pytest.raises(ValueError, match="points must have shape"):
            function(points)
    with pytest.raises(ValueError, match="num_points"):
        resample(SQUARE, 1)


def test_orders_equal_the_reference_targets(golden_dir: Path):
    frames = json.loads((golden_dir / "data/E6_A.json").read_text())["frames"]
    targets = np.load(golden_dir / "data/E6_A_targets.npz")
    seen = 0
    for i, frame in enumerate(frames):
        if f"f{i}_vec_index" not in targets:
            continue
        for j, index in enumerate(targets[f"f{i}_vec_index"]):
            points = np.array(frame["vectors"][index]["pts"])
            fixed = clamp(resample(points, 20), (-15, 15), (-30, 30))
            orders = equivalent_orders(points, 20)
            orders = np.where(orders == PADDING, PADDING, clamp(orders, (-15, 15), (-30, 30)))
            # the reference is rounded to 1e-6 m before and stored as float32 after
            np.testing.assert_allclose(fixed, targets[f"f{i}_fixed"][j], atol=3e-6)
            np.testing.assert_allclose(orders, targets[f"f{i}_shift_v2"][j], atol=3e-6)
            np.testing.assert_allclose(bounding_boxes(points), targets[f"f{i}_bbox"][j], atol=3e-6)
            seen += 1
    assert seen == 185


def test_the_orders_of_a_long_ring_are_spread_evenly_over_it():
    """A circle of 40 vertices and 5 points: four orders, which start at each quarter of it."""
    angles = np.arange(41) * 2 * np.pi / 40
    ring = np.stack([np.cos(angles), np.sin(angles)], -1)
    ring[-1] = ring[0]
    starts = equivalent_orders(ring, 5)[:, 0]
    quarters = [[1, 0], [0, -1], [-1, 0], [0, 1]]  # order k starts at vertex -k
    np.testing.assert_allclose(starts, quarters, atol=1e-12)


def way_m(line):
    return np.linalg.norm(np.diff(line, axis=0), axis=1).sum()


def test_a_line_that_runs_back_and_forth_is_put_straight():
    """Points along x whose middle part was walked backwards, and a line that needs nothing."""
    straight = np.stack([np.arange(8.0), np.zeros(8)], -1)
    folded = straight[[0, 1, 5, 4, 3, 2, 6, 7]]
    orders = shortest_orders(np.stack([folded, straight]))
    np.testing.assert_array_equal(folded[orders[0]], straight)
    assert orders[1].tolist() == list(range(8))


def test_ends_may_change_but_those_of_a_ring():
    line = np.array([[2, 0], [1, 0], [0, 0], [3, 0], [4, 0]], float)
    assert shortest_orders(line[None]).tolist() == [[2, 1, 0, 3, 4]]
    angles = np.linspace(0, 2 * np.pi, 9)
    ring = np.stack([np.cos(angles), np.sin(angles)], -1)
    ring[-1] += 1e-4  # nearly closed: without the rule it would open where its step is longest
    assert shortest_orders(ring[None]).tolist() == [list(range(9))]


def test_orders_are_permutations_that_no_reversal_shortens():
    rng = np.random.default_rng(0)
    lines = rng.normal(size=(40, 7, 3)) * [1, 5, 100]  # heights do not count
    orders = shortest_orders(lines)
    assert (np.sort(orders, 1) == np.arange(7)).all()
    for line, order in zip(lines[..., :2], orders, strict=True):
        found = way_m(line[order])
        ring = np.linalg.norm(line[0] - line[-1]) < way_m(line) / 6
        assert found <= way_m(line)
        for first, last in itertools.combinations(range(7), 2):
            if ring and (first == 0 or last == 6):
                continue
            other = [*order[:first], *order[first : last + 1][::-1], *order[last + 1 :]]
            assert found <= way_m(line[other]) + 1e-3


def test_lines_of_no_or_one_point_and_no_lines_have_an_order():
    assert shortest_orders(np.zeros((0, 20, 2))).shape == (0, 20)
    assert shortest_orders(np.zeros((3, 1, 2))).tolist() == [[0]] * 3
    assert shortest_orders(np.zeros((1, 2, 2))).tolist() == [[0, 1]]
    assert shortest_orders(np.zeros((1, 4, 2))).tolist() == [[0, 1, 2, 3]]
