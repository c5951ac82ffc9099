import numpy as np
import pytest

from gsmap.evaluation.analysis import prior as prior_module
from gsmap.evaluation.analysis.prior import fit_prior
from gsmap.evaluation.core.chamfer_ap import ChamferConfig, chamfer_report, match_chamfer
from gsmap.evaluation.core.matches import MatchTable
from gsmap.structures.elements import MapElements

CHAMFER = ChamferConfig(("divider", "ped_crossing"))
RING = np.array([[3.0, 3], [7, 3], [7, 6], [3, 6], [3, 3]])


def line(x: float) -> np.ndarray:
    return np.array([[x, -20.0], [x, 20.0]])


def score(prior, truth) -> dict[str, float]:
    matches = []
    for number, elements in enumerate(truth):
        matches.append(match_chamfer(prior, elements, CHAMFER, str(number)))
    return chamfer_report(MatchTable(matches), CHAMFER).metrics


def test_the_same_map_everywhere_is_found_exactly():
    truth = [MapElements.from_polylines([line(0.0), line(5.0), RING], [0, 0, 1])] * 6
    prior = fit_prior(truth, CHAMFER)
    assert len(prior) == 3
    assert score(prior, truth)["chamfer/mAP"] == 1.0


def test_lines_are_averaged_in_the_point_order_nearest_to_the_first():
    """Reversed lines, and rings that start elsewhere and run the other way, are put right first."""
    curve = np.array([[0.0, 0], [1, 2], [3, 3], [6, 3]])
    others = np.stack([curve + 1.0, curve[::-1] + 3.0])
    np.testing.assert_allclose(prior_module._aligned_mean(curve, others), curve + 2.0)
    turned = np.concatenate([RING[2:-1], RING[:3]])  # starts at its third corner
    others = np.stack([RING, turned + 1.0, turned[::-1] - 0.4])
    np.testing.assert_allclose(prior_module._aligned_mean(RING, others), RING + 0.2)


def test_scores_order_elements_by_how_often_they_are_right():
    """The line at 0 is there always, the one at 6 in two of four samples."""
    one_line = MapElements.from_polylines([line(0.0)], [0])
    two_lines = MapElements.from_polylines([line(0.0), line(6.0)], [0, 0])
    truth = [one_line, two_lines, one_line, two_lines]
    prior = fit_prior(truth, CHAMFER)
    x = [round(float(polyline[0, 0]), 6) for polyline in prior.polylines]
    assert x == [0.0, 6.0]
    assert prior.scores[0] == pytest.approx(1.0)
    assert prior.scores[1] == pytest.approx(0.05 + 0.95 * 0.5)
    # of 6 ground truths the first element finds 4; then miss, hit (5 of 6), miss, hit (6 of 8)
    want = 4 / 6 + 1 / 6 * 5 / 6 + 1 / 6 * 6 / 8
    assert score(prior, truth)["chamfer/divider/AP@0.5"] == pytest.approx(want)


def test_an_element_is_chosen_by_precision_and_recall():
    """Four samples: a divider that is always there but one of four, a crossing in three of them.

    Gain of the divider: precision 1, recall 4 of 16, so 0.25; of the crossing: 3 of 4 times 3 of 3.
    """
    truth = []
    for i in range(4):
        others = [line(10.0 * (3 * i + k)) for k in range(1, 4)]
        rings = [RING] if i < 3 else []
        labels = [0] * 4 + [1] * len(rings)
        truth.append(MapElements.from_polylines([line(0.0), *others, *rings], labels))
    assert fit_prior(truth, CHAMFER, max_elements=1).labels.tolist() == [1]
    assert fit_prior(truth, CHAMFER, max_elements=2).labels.tolist() == [1, 0]


def test_refinement_moves_an_element_to_the_middle_of_what_it_matches(monkeypatch):
    """Lines within +-0.9 m, every second one turned: only the middle is within 1.0 m of all."""
    truth = []
    for i, x in enumerate(np.linspace(-0.9, 0.9, 7)):
        points = line(x)[::-1] if i % 2 else line(x)
        truth.append(MapElements.from_polylines([points], [0]))
    monkeypatch.setattr(prior_module, "_MAX_CANDIDATES", 1)
    prior = fit_prior(truth, CHAMFER, max_elements=1)
    assert abs(prior.polylines[0][:, 0]).max() < 0.1
    assert score(prior, truth)["chamfer/divider/AP@1.0"] == 1.0


def test_rings_that_start_elsewhere_are_averaged_as_rings():
    truth = []
    for k in range(4):
        corners = np.roll(RING[:-1], k, axis=0)
        ring = np.concatenate([corners, corners[:1]])
        truth.append(MapElements.from_polylines([ring + 0.1 * k], [1]))
    prior = fit_prior(truth, CHAMFER, max_elements=1)
    assert score(prior, truth)["chamfer/ped_crossing/AP"] == 1.0


def test_the_number_of_elements_is_limited_and_fitting_is_deterministic(monkeypatch):
    monkeypatch.setattr(prior_module, "_MAX_CANDIDATES", 30)
    rng = np.random.default_rng(0)
    truth = []
    for _ in range(20):
        lines = [line(x) for x in rng.uniform(-15, 15, 6)]
        truth.append(MapElements.from_polylines(lines, [0] * 6))
    first = fit_prior(truth, CHAMFER, 5)
    second = fit_prior(truth, CHAMFER, 5)
    assert len(first) == 5
    np.testing.assert_array_equal(first.points, second.points)
    assert (np.diff(first.scores) <= 0).all()
    larger = fit_prior(truth, CHAMFER, max_elements=10)
    first_map = score(first, truth)["chamfer/mAP"]
    larger_map = score(larger, truth)["chamfer/mAP"]
    assert larger_map >= first_map > 0


def test_no_ground_truth_is_an_error():
    with pytest.raises(ValueError, match="no ground truth"):
        fit_prior([MapElements.from_polylines([], [])], CHAMFER)
