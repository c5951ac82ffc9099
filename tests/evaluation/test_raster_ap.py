import math

import cv2
import numpy as np
import pytest
from golden_data import unpacked

from gsmap.evaluation.core.chamfer_ap import ChamferConfig, match_chamfer
from gsmap.evaluation.core.matches import MatchTable
from gsmap.evaluation.core.raster_ap import RasterConfig, match_raster, raster_report, rasterize
from gsmap.evaluation.core.raster_kernels import class_ious
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid

CLASSES = ("divider", "ped_crossing")
CONFIG = RasterConfig(CLASSES)
RAW = RasterConfig(CLASSES, dilation_px=1)
SMALL = BEVGrid((0, 12), (0, 8))
TINY = RasterConfig(CLASSES, SMALL, px_per_m=1, dilation_px=1)  # a pixel per metre


def rows(mask: np.ndarray) -> list[str]:
    return ["".join("#" if v else "." for v in row) for row in mask]


def test_line_and_polygon_by_hand():
    """A line is one pixel thick, a polygon includes its outline; row 0 is the smallest y."""
    elements = MapElements.from_polylines(
        [[[1, 0], [4, 3]], [[6, 1], [9, 1], [9, 3], [6, 3]]], [0, 1]
    )
    masks = unpacked(rasterize(elements, TINY), 12)
    assert rows(masks[0])[:4] == [
        ".#..........",
        "..#.........",
        "...#........",
        "....#.......",
    ]
    assert rows(masks[1])[:5] == [
        "............",
        "......####..",
        "......####..",
        "......####..",
        "............",
    ]


def test_dilation_is_a_square_and_ends_at_the_canvas():
    dot = MapElements.from_polylines([[[0, 0], [0, 0]]], [0])
    masks = unpacked(rasterize(dot, RasterConfig(CLASSES, SMALL, px_per_m=1)), 12)
    assert rows(masks[0])[:4] == [
        "###.........",
        "###.........",
        "###.........",
        "............",
    ]


def random_lines(count: int) -> list[np.ndarray]:
    """Walks of all sizes, many of which leave the canvas."""
    rng = np.random.default_rng(1)
    lines = []
    for _ in range(count):
        start, size = rng.uniform([-15, -30], [15, 30]), rng.choice([1, 5, 20, 60])
        lines.append(start + rng.normal(size=(rng.integers(2, 25), 2)) * size)
    return lines


def opencv_pixels(line: np.ndarray) -> np.ndarray:
    return np.rint((line - [-15, -30]) / [30, 60] * [240, 480]).astype(np.int32)


def test_lines_are_opencv_lines_on_and_off_the_canvas():
    lines = random_lines(300)
    masks = unpacked(rasterize(MapElements.from_polylines(lines, [0] * len(lines)), CONFIG), 240)
    for i, line in enumerate(lines):
        want = np.zeros((480, 240), np.uint8)
        cv2.polylines(want, [opencv_pixels(line)], False, 1)
        want = cv2.dilate(want, np.ones((5, 5), np.uint8))
        assert (masks[i] == want).all(), i


def test_polygons_contain_opencv_outlines_and_little_else():
    """OpenCV's versions differ along the outline of a filled polygon, never by more than it."""
    lines = [line for line in random_lines(200) if len(line) > 2]
    masks = unpacked(rasterize(MapElements.from_polylines(lines, [1] * len(lines)), RAW), 240)
    for i, line in enumerate(lines):
        outline, filled = np.zeros((2, 480, 240), np.uint8)
        cv2.polylines(outline, [opencv_pixels(line)], True, 1)
        cv2.fillPoly(filled, [opencv_pixels(line)], 1)
        ours = masks[i]
        assert (ours >= outline.astype(bool)).all()
        if np.abs(opencv_pixels(line) - [120, 240]).max(axis=0).max() < 120:  # nothing is cut
            near_outline = cv2.dilate(outline, np.ones((3, 3), np.uint8)).astype(bool)
            assert (ours == filled.astype(bool))[~near_outline].all()


def test_self_intersection_is_even_odd():
    """The two wings of a bow tie are filled, what lies beside its waist is not."""
    elements = MapElements.from_polylines([[[1, 1], [9, 7], [9, 1], [1, 7]]], [1])
    mask = unpacked(rasterize(elements, TINY), 12)[0]
    assert mask[4, 2]
    assert mask[4, 8]
    assert not mask[1, 5]
    assert not mask[7, 5]


def test_hand_worked_ap_raster():
    """Ground truth 4 x 2 pixels; A shares 6 of 8 (IoU 6 / 10 = 0.6), B misses.

    .. code-block:: text

        GG GG ..      .AA AA A.
        GG GG ..      .AA AA A.      shifted by one: 6 shared, union 10

        A (0.9) hits at 0.50, 0.55, 0.60, misses above; B (0.8) misses.
        AP = 1 at three thresholds, 0 at three: 0.5
    """
    gt = MapElements.from_polylines([[[0, 0], [3, 0], [3, 1], [0, 1]]], [1])
    pred = MapElements.from_polylines(
        [[[8, 5], [10, 5], [10, 7]], [[1, 0], [4, 0], [4, 1], [1, 1]]], [1, 1], [0.8, 0.9]
    )
    matches = match_raster(pred, gt, TINY, "a")
    assert matches.pred_index.tolist() == [1, 0]
    assert matches.matched_gt.tolist() == [[0, 0, 0, -1, -1, -1], [-1] * 6]
    assert matches.quality[0] == pytest.approx(0.6)
    metrics = raster_report(MatchTable([matches]), TINY).metrics
    assert metrics["raster/ped_crossing/AP"] == pytest.approx(0.5)
    assert metrics["raster/ped_crossing/AP@0.6"] == pytest.approx(1.0)
    assert metrics["raster/ped_crossing/AP@0.65"] == 0.0
    assert metrics["raster/divider/AP"] == -1.0  # absent from ground truth: left out of means
    assert metrics["raster/mAP"] == pytest.approx(0.5)
    assert metrics["raster/line/AP"] == -1.0
    assert metrics["raster/ped_crossing/AR@1"] == pytest.approx(0.5)
    assert metrics["raster/ped_crossing/mIoU"] == pytest.approx(6 / (10 + 6))  # B: 6 pixels


def test_average_recall_takes_the_best_predictions_of_a_sample():
    """Two areas, both found exactly: the best prediction finds one, the best ten find both."""
    areas = [[[x, 0], [x + 3, 0], [x + 3, 1], [x, 1]] for x in (0, 6)]
    gt = MapElements.from_polylines(areas, [1, 1])
    pred = MapElements.from_polylines(areas, [1, 1], [0.8, 0.9])
    metrics = raster_report(MatchTable([match_raster(pred, gt, TINY, "a")]), TINY).metrics
    assert metrics["raster/ped_crossing/AR@1"] == 0.5
    assert metrics["raster/ped_crossing/AR@10"] == 1.0


def test_the_iou_of_a_class_unites_its_elements_by_hand():
    """Class 0 shares 1 of 5 pixels; class 1 has one side alone; class 2 has neither side.

    predictions of class 0: 11000 and 01100, the first column first; ground truth: 00111
    """
    words = [[[0b0011]], [[0b0110]], [[0b1]]]
    predictions = np.array(words, np.uint64)
    ground_truth = np.array([[[0b11100]]], np.uint64)
    found = class_ious(
        predictions, ground_truth, pred_labels=np.array([0, 0, 1]), gt_labels=np.array([0]),
        num_classes=3,
    )  # fmt: skip
    np.testing.assert_array_equal(found, [1 / 5, 0.0, np.nan])


def test_half_recall_is_51_of_101():
    line = [[0, -20], [0, 20]]
    gt = MapElements.from_polylines([line, [[8, -20], [8, 20]]], [0, 0])
    metrics = raster_report(
        MatchTable([match_raster(MapElements.from_polylines([line], [0], [1.0]), gt, CONFIG)]),
        CONFIG,
    ).metrics
    assert metrics["raster/divider/AP"] == pytest.approx(51 / 101)


def test_second_choice_is_allowed_and_the_later_of_equals_wins():
    line = [[0, -20], [0, 20]]
    gt, pred = (
        MapElements.from_polylines([line, line], [0, 0]),
        MapElements.from_polylines([line, line], [0, 0], [0.9, 0.8]),
    )
    assert match_raster(pred, gt, CONFIG).matched_gt[:, 0].tolist() == [1, 0]


def test_low_scores_and_more_than_the_limit_are_dropped():
    lines = [[[x, -20.0], [x, 20.0]] for x in np.linspace(-14, 14, 120)]
    scores = np.linspace(0.9, 0.04, 120)
    matches = match_raster(
        MapElements.from_polylines(lines, [0] * 120, scores),
        MapElements.from_polylines([], []),
        CONFIG,
    )
    assert matches.pred_index.tolist() == list(range(100))
    few = match_raster(
        MapElements.from_polylines(lines[:3], [0] * 3, [0.05, 0.0499, 0.9]),
        MapElements.from_polylines([], []),
        CONFIG,
    )
    assert few.pred_index.tolist() == [2, 0]


def test_argoverse_range_turns_the_canvas():
    config = RasterConfig(CLASSES, BEVGrid((-30, 30), (-15, 15)))
    assert config.size_px == (480, 240)
    line = MapElements.from_polylines([[[-30, 0], [29.9, 0]]], [0])
    mask = unpacked(rasterize(line, config), 480)[0]
    assert mask[118:123].all()
    assert not mask[117].any()


@pytest.mark.parametrize("name", ["line", "polygon"])
def test_a_class_cannot_have_the_name_of_a_mean_over_classes(name):
    with pytest.raises(ValueError, match=rf"^a class cannot be called '{name}', since"):
        RasterConfig(("divider", name))


def test_extended_classes_are_polygons():
    config = RasterConfig(("divider", "stop_line", "intersection", "carpark"))
    assert config.is_polygon == (False, True, True, True)
    square = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]
    mask = unpacked(rasterize(MapElements.from_polylines([square], [2]), config), 240)[0]
    assert mask[256, 136]  # the middle of the square: (2 + 15) * 8, (2 + 30) * 8


@pytest.mark.parametrize("match", [match_raster, match_chamfer])
@pytest.mark.parametrize(
    ("labels", "scores", "true", "message"),
    [
        ([2], [0.5], [0], "'a': prediction 0 has the label 2, beyond the 2 classes divider,"),
        ([0, -2], [0.5, 0.5], [0], "prediction 1 has the label -2"),
        ([0], [0.5], [0, 9], "ground truth 1 has the label 9"),
        ([0], None, [0], "predictions need scores"),
    ],
)
def test_what_cannot_be_scored_is_refused(match, labels, scores, true, message):
    line = [[0, -20], [0, 20]]
    config = CONFIG if match is match_raster else ChamferConfig(CLASSES)
    pred = MapElements.from_polylines([line] * len(labels), labels, scores)
    with pytest.raises(ValueError, match=message):
        match(pred, MapElements.from_polylines([line] * len(true), true), config, "a")
    match(MapElements.from_polylines(), MapElements.from_polylines(), config)


def test_far_points_do_not_overflow():
    lines = [[[0.0, 0.0], [1e30, 1e30]], [[1e12, 0], [1e12, 5]]]
    masks = unpacked(rasterize(MapElements.from_polylines(lines, [0, 1]), CONFIG), 240)
    assert masks[0][240, 120]
    assert not masks[1].any()


def test_no_sample_at_all_has_no_iou():
    assert len(MatchTable([]).class_iou(0)) == 0
    metrics = raster_report(MatchTable([]), TINY).metrics
    assert metrics["raster/mAP"] == -1.0


def test_bad_configuration_is_refused():
    for classes in ((), "divider"):
        with pytest.raises(ValueError, match="classes must be different names"):
            RasterConfig(classes)
    with pytest.raises(ValueError, match="odd"):
        RasterConfig(CLASSES, dilation_px=4)
    for px_per_m in (0.01, 0.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="at least one pixel"):
            RasterConfig(CLASSES, px_per_m=px_per_m)
    with pytest.raises(
        ValueError, match=r"at most 2e\+07 pixels, not 800000 x 800000: give --range"
    ):
        RasterConfig(CLASSES, BEVGrid((-5e4, 5e4), (-5e4, 5e4)))
