import numpy as np
import pytest

from gsmap.structures.elements import MapElements, ground_truth_elements

LINE, RING = [[0.0, 1.0], [2.0, 3.0]], [[4.0, 4.0], [5.0, 4.0], [5.0, 5.0], [4.0, 4.0]]


def test_vertices_lie_one_after_another():
    elements = MapElements.from_polylines([LINE, [], np.array(RING)], [2, 0, 1], [0.5, 0.25, 1])
    assert elements.points.tolist() == LINE + RING
    assert elements.offsets.tolist() == [0, 2, 2, 6]
    assert elements.num_points.tolist() == [2, 0, 4]
    assert [p.tolist() for p in elements.polylines] == [LINE, [], RING]
    assert elements.confidence.tolist() == [0.5, 0.25, 1.0]
    assert not elements.has_gaussians


def test_selected_elements_take_their_scores_and_gaussians_along():
    scales, rotations = [np.full((2, 2), 3.0), np.full((4, 2), 7.0)], [np.zeros(2), np.ones(4)]
    elements = MapElements.from_polylines([LINE, RING], [2, 1], [0.5, 0.25], scales, rotations)
    turned = elements.select(np.array([1, 0]))
    assert [p.tolist() for p in turned.polylines] == [RING, LINE]
    assert turned.scores.tolist() == [0.25, 0.5]
    assert turned.scales[:, 0].tolist() == [7.0] * 4 + [3.0] * 2
    assert turned.rotations.tolist() == [1.0] * 4 + [0.0] * 2
    masked = elements.select(np.array([True, False]))
    assert masked.labels.tolist() == [2]
    assert masked.scales.tolist() == [[3.0, 3.0]] * 2
    none = elements.select(np.array([], dtype=int))
    assert (len(none), none.points.shape, none.scales.shape) == (0, (0, 2), (0, 2))


def test_moved_elements_turn_with_their_gaussians():
    """A quarter turn to the left, then 10 m along x, 20 along y, 3 up."""
    pose = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 3], [0, 0, 0, 1]])
    elements = MapElements.from_polylines([LINE], [0], rotations=[[0.0, 1.0]])
    moved = elements.to_frame(pose)
    np.testing.assert_allclose(moved.points, [[9.0, 20.0], [7.0, 22.0]])
    np.testing.assert_allclose(moved.rotations, [np.pi / 2, 1 + np.pi / 2])
    high = MapElements.from_polylines([[[0.0, 1.0, 5.0]]], [0]).to_frame(pose)
    np.testing.assert_allclose(high.points, [[9.0, 20.0, 8.0]])


def test_z_is_kept_if_all_have_it():
    line_3d = [[0.0, 1.0, 5.0], [2.0, 3.0, 6.0]]
    elements = MapElements.from_polylines([line_3d], [0])
    assert elements.points.tolist() == line_3d
    assert elements.with_coordinates(2).points.tolist() == LINE
    for kind in (list, np.array):
        mixed = MapElements.from_polylines([kind(line_3d), kind(RING)], [0, 1])
        assert mixed.points.tolist() == LINE + RING
    assert elements.with_coordinates(2).with_coordinates(2).points.flags.c_contiguous
    assert elements.with_coordinates(3).points.tolist() == line_3d
    assert MapElements.from_polylines().with_coordinates(3).points.shape == (0, 3)
    with pytest.raises(ValueError, match="points must have 3 coordinates, got 2"):
        elements.with_coordinates(2).with_coordinates(3)


def test_ground_truth_has_full_confidence_and_a_sample_may_be_empty():
    truth = MapElements.from_polylines([LINE], [0])
    assert truth.scores is None
    assert truth.confidence.tolist() == [1.0]
    empty = MapElements.from_polylines()
    assert (len(empty), empty.points.shape, empty.polylines) == (0, (0, 2), [])


@pytest.mark.parametrize("labels", [[], (), np.array([], object), np.array([], str), np.empty(0)])
def test_no_labels_of_any_type_are_no_elements(labels):
    assert len(MapElements.from_polylines([], labels)) == 0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (([LINE], [0, 1]), "labels must have one entry for each of the 1 polylines, got 2"),
        (
            ([LINE] * 3, [0, 1.5, 2]),
            "element 1 has the label 1.5, but labels must be class indices",
        ),
        (([LINE, LINE], [0.9, 0.7], [0, 1]), "label 0.9.*are labels and scores exchanged"),
        (([LINE], np.float32([np.nan])), "element 0 has the label nan"),
        (([LINE, LINE], [[1.0, np.inf]]), "element 1 has the label inf"),
        (([LINE], ["divider"]), "labels must be class indices, got .*divider"),
        (([LINE], [0], [0.5, 0.5]), "scores must have one entry"),
        (([LINE], [0], None, [np.ones((3, 2))]), r"scales must hold \(2, 2\) values in all"),
        (([LINE], [0], None, None, [[0.0]]), r"rotations must hold \(2,\) values"),
        (([[[0.0, 1.0], [2.0]]], [0]), "coordinates"),
        (([[0.0, 1.0]], [0]), r"lists of \(x, y\)"),
        (([LINE, [[0.0, np.nan]]], [0, 0]), "element 1 has a point that is not finite"),
        (([LINE], [0], [np.nan]), r"element 0 has the score nan, not in \[0, 1\]"),
        (([LINE] * 3, [0] * 3, [1, 0, 1.01]), r"element 2 has the score 1.01, not in \[0, 1\]"),
        (
            ([LINE, LINE], [0, 0], None, [np.ones((2, 2)), [[1.0, 1.0], [1.0, 0.0]]]),
            "element 1 has a Gaussian whose scales are not positive numbers",
        ),
        (([LINE], [0], None, [[[np.inf, 1.0]] * 2]), "element 0 has a Gaussian whose scales"),
        (([LINE], [0], None, [[[-1.0, np.nan]] * 2]), "element 0 has a Gaussian whose scales"),
        (([LINE], [0], None, None, [[0.0, np.nan]]), "Gaussian whose rotation is not finite"),
        (([LINE] * 3, [0] * 3, [1, -0.5, 2]), r"element 1 has the score -0.5, not in \[0, 1\]"),
    ],
)
def test_bad_elements_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        MapElements.from_polylines(*values)


def test_whole_labels_of_any_type_are_accepted():
    column = np.array([0, 2], object)
    for labels in ([0.0, 2.0], np.float32([0, 2]), np.uint8([0, 2]), [[0], [2]], column):
        elements = MapElements.from_polylines([LINE, RING], labels)
        assert elements.labels.dtype == np.int64
        assert elements.labels.tolist() == [0, 2]


def test_a_sample_without_ground_truth_is_refused_by_the_name_of_the_transform():
    assert ground_truth_elements({"map_instances": []}, object()) == []
    with pytest.raises(ValueError, match="'a' has no ground truth: leave Exception out of this"):
        ground_truth_elements({"map_instances": None, "token": "a"}, Exception())
