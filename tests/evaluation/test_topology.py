"""Breaks, false joints, folds and heights of small scenes that are counted by hand."""

import json

import numpy as np
import pytest
from golden_data import CLASSES
from test_files import annotated, command, results_of, vector

from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.metric import Metric
from gsmap.evaluation.core.results_json import write_results
from gsmap.evaluation.metrics.heights import Heights
from gsmap.evaluation.metrics.topology import Topology, count_folds, count_pieces
from gsmap.structures.elements import MapElements

CONFIG = Topology(CLASSES, (1,))


def figures_of(metric: Metric, predictions: MapElements, truth: MapElements) -> dict[str, float]:
    """The figures of one sample, without the name of the metric."""
    evaluator = MapEvaluator(metric)
    evaluator.update(predictions, truth)
    figures = evaluator.compute()
    return {key.removeprefix(f"{metric.name}/"): value for key, value in figures.items()}


def straight(x: float, low: float, high: float) -> np.ndarray:
    return np.array([[x, low], [x, high]])


def elements(lines: list, labels: int | list = 0, scores: list | None = None) -> MapElements:
    labels = [labels] * len(lines) if isinstance(labels, int) else labels
    return MapElements.from_polylines(lines, labels, scores)


def figures(found: list, wanted: list, scores: list | None = None, label: int = 0) -> dict:
    predictions = elements(found, label, scores or [0.9] * len(found))
    return figures_of(CONFIG, predictions, elements(wanted, label))


def test_a_line_found_in_three_pieces_has_two_breaks():
    pieces = [straight(0.1, -20, -8), straight(0.2, -7, 5), straight(-0.1, 6, 20)]
    found = figures(pieces, [straight(0, -20, 20)])
    assert found["divider/breaks"] == 2
    assert found["divider/false_joints"] == 0
    assert (found["divider/num_gts"], found["divider/num_preds"]) == (1, 3)


def test_doubles_faint_lines_and_crossing_ones_break_nothing():
    across = np.array([[-10.0, 0], [10, 0]])
    lines = [straight(0.1, -20, 20), straight(0.3, -15, 18), across, straight(0, -20, 0)]
    found = figures(lines, [straight(0, -20, 20)], [0.9, 0.8, 0.9, 0.3])
    assert found["divider/breaks"] == 0
    assert found["divider/num_preds"] == 3


def test_a_prediction_along_two_lines_joins_them_falsely():
    found = figures([straight(0, -20, 20)], [straight(0.2, -20, -2), straight(-0.2, 2, 20)])
    assert found["divider/false_joints"] == 1
    assert found["divider/breaks"] == 0
    other_class = elements([straight(0.2, -20, -2), straight(-0.2, 2, 20)], [0, 2])
    predictions = elements([straight(0, -20, 20)], 0, [0.9])
    found = figures_of(CONFIG, predictions, other_class)
    assert found["divider/false_joints"] == 0


def test_pieces_must_add_what_no_other_covers():
    covered = np.array([[1, 1, 1, 1, 0, 0], [0, 0, 1, 1, 1, 0], [0, 0, 0, 0, 1, 1]], bool)
    assert count_pieces(covered, 1.0, 2.0) == 2
    assert count_pieces(covered, 1.0, 4.0) == 1
    assert count_pieces(covered[:0], 1.0, 2.0) == 0


@pytest.mark.parametrize(
    ("points", "is_area", "folds"),
    [
        ([[0, 0], [0, 20]], False, 0),
        ([[0, 0], [0, 10], [10, 10]], False, 0),  # a corner
        ([[0, 0], [0, 10], [0.5, 2]], False, 1),  # a hairpin
        ([[0, 0], [0, 10], [0.5, 2], [1, 12]], False, 2),
        ([[0, 0], [0, 1], [0, 0]], False, 0),  # too short to tell
        ([[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]], True, 0),
        ([[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]], True, 1),  # a bow tie
        ([[0, 0], [4, 0], [4, 4], [0, 4]], True, 0),  # left open
    ],
)
def test_folds(points, is_area, folds):
    """Lines that turn back, and areas whose outline crosses itself."""
    assert count_folds(np.array(points, np.float64), is_area) == folds


def test_rings_are_areas_and_huge_coordinates_are_no_trouble():
    bow = [np.array([[0.0, 0], [4, 4], [4, 0], [0, 4]])]
    assert figures(bow, bow, label=1)["ped_crossing/folds"] == 1
    far = [np.array([[-1e300, 0.0], [1e300, 1]])]
    assert figures(far, far)["divider/breaks"] == 0


def test_rules_out_of_range_are_refused():
    with pytest.raises(ValueError, match="min_piece_m more than twice"):
        Topology(CLASSES, min_piece_m=2.0)
    with pytest.raises(ValueError, match="min_score must be in"):
        Topology(CLASSES, min_score=1.5)


def test_heights_are_of_predictions_that_match_in_the_plane():
    """0.3 m too high on one half and 0.1 m too low on the other, 0.2 m aside; another far off."""
    wanted = np.array([[0.0, -20, 0], [0, 20, 4]])
    line = np.array([[0.2, -20, 0.3], [0.2, -1e-6, 2.3], [0.2, 0, 1.9], [0.2, 20, 3.9]])
    lines = [line, np.array([[9.0, -20, 50], [9, 20, 50]])]
    found = figures_of(Heights(CLASSES), elements(lines, 0, [0.9, 0.8]), elements([wanted]))
    assert found["divider/num_matches"] == 1
    assert found["divider/plane_error_m"] == pytest.approx(0.2, abs=1e-3)
    assert found["divider/height_error_m"] == pytest.approx(0.2, abs=0.01)
    assert found["divider/height_bias_m"] == pytest.approx(0.1, abs=0.01)
    assert found["boundary/height_error_m"] == -1


def test_the_command_counts_and_the_aps_stay(tmp_path, capsys):
    truth = annotated(tmp_path / "val.arrow", 4)
    halves = [
        vector([[0, -20], [0, -1]], "divider", 0.9),
        vector([[0, 1], [0, 20]], "divider", 0.5),
    ]
    write_results(tmp_path / "a.json", [(token, halves) for token, _ in results_of(4)])
    words = [str(tmp_path / "a.json"), str(truth), "--eval", "chamfer"]
    for name, more in (
        ("plain", []),
        ("topology", ["--topology"]),
        ("sure", ["--topology", "--min-score", "0.6"]),
    ):
        command()([*words, *more, "--out", str(tmp_path / f"{name}.json")])
    plain, counted, sure = (
        json.loads((tmp_path / f"{name}.json").read_text())
        for name in ("plain", "topology", "sure")
    )
    assert plain == {key: value for key, value in counted.items() if key in plain}
    assert counted["topology/divider/breaks"] == 4
    assert sure["topology/divider/breaks"] == 0
    assert "topology/divider/breaks" in capsys.readouterr().out
