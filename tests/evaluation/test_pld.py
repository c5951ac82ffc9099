"""SOSPA and PLD of lines that are worked by hand, and against all ways to pair points."""

import json
from itertools import combinations, permutations

import numpy as np
import pytest
from golden_data import CLASSES
from test_files import annotated, command, results_of

from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.results_json import write_results
from gsmap.evaluation.metrics.pld import PLD, sample_line, sospa
from gsmap.structures.elements import MapElements

CONFIG = PLD(CLASSES, (1.0,))
LINE = np.array([[0.0, 0.0], [0.0, 3.0]])  # 7 points
SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [0.0, 0.0]])  # 16 points


def aside(metres: float) -> np.ndarray:
    return LINE + np.array([metres, 0])


def of_lines(first: np.ndarray, second: np.ndarray, cutoff_m: float = 1.0) -> tuple:
    return tuple(sospa(sample_line(first), sample_line(second), (cutoff_m,))[0])


def elements(lines: list, labels: list | None = None, scores: list | None = None) -> MapElements:
    return MapElements.from_polylines(lines, labels or [0] * len(lines), scores)


def figures_of(*samples: tuple[MapElements, MapElements], config: PLD = CONFIG) -> dict:
    evaluator = MapEvaluator(config)
    for predictions, truth in samples:
        evaluator.update(predictions, truth)
    return {key.removeprefix("pld/"): value for key, value in evaluator.compute().items()}


def figures(found: list, scores: list, wanted: list, config: PLD = CONFIG) -> dict:
    return figures_of((elements(found, scores=scores), elements(wanted)), config=config)


def test_points_stand_every_half_metre_and_at_the_end():
    line = np.array([[0.0, 0.0], [0.0, 0.7], [0.5, 0.7]])
    np.testing.assert_allclose(sample_line(line), [[0, 0], [0, 0.5], [0.3, 0.7], [0.5, 0.7]])
    np.testing.assert_array_equal(sample_line(LINE), np.stack([np.zeros(7), np.arange(7) / 2], -1))
    np.testing.assert_array_equal(
        sample_line(LINE[[0, 0]]), [[0, 0], [0, 0]]
    )  # a line of no length
    assert sample_line(LINE[:1]).shape == (0, 2)


def test_lines_of_kilometres_have_two_thousand_steps():
    for length_m, count in ((1000.0, 2001), (1001.0, 2001), (100_000.0, 2001), (999.5, 2000)):
        points = sample_line(np.array([[0.0, 0.0], [length_m, 0.0]]))
        assert len(points) in (count, count + 1)  # the end may be there by a rounding
        np.testing.assert_array_equal(points[-1], [length_m, 0])


def test_a_shifted_line_costs_its_shift_at_every_point():
    # C = 7 * 0.2, G = 0.5 * 14: 2 * 1.4 / 8.4, all of it between paired points
    assert of_lines(aside(0.2), LINE) == pytest.approx((1 / 3, 1 / 3), abs=1e-12)
    assert of_lines(LINE[::-1], LINE) == (0, 0)
    assert of_lines(aside(1.0), LINE) == (1, 0)  # no two points are within the cut-off


def test_a_line_that_is_too_short_costs_half_a_cutoff_for_each_point_missing():
    # 5 of 7 points: C = 2 * 0.5, G = 0.5 * 12
    assert of_lines(LINE * [[1, 2 / 3]], LINE) == pytest.approx((2 / 7, 0), abs=1e-12)


def test_order_counts_where_the_chamfer_distance_is_zero():
    """There and back over the same 3 m: every point is on the line, half of them come too late."""
    there_and_back = np.array([[0.0, 0.0], [0.0, 3.0], [0.0, 0.5]])  # 12 points
    # 7 of them pair with the line's at no distance: C = 5 * 0.5, G = 0.5 * 19
    assert of_lines(there_and_back, LINE)[0] == pytest.approx(5 / 12, abs=1e-12)


def test_rings_may_start_anywhere_and_run_either_way():
    turned = np.concatenate([SQUARE[2:-1], SQUARE[:3]])
    assert of_lines(turned, SQUARE) == (0, 0)
    assert of_lines(turned[::-1], SQUARE) == (0, 0)
    nearly = np.concatenate([SQUARE[2:], [[2.0, 0.0], [2.0, 1.95]]])  # ends 5 cm apart
    assert of_lines(nearly, SQUARE)[0] < 0.01
    open_ended = np.array([[2.0, 2.0], [0.0, 2.0], [0.0, 0.0], [2.0, 0.0]])  # 13 of 16 points
    # in the ring's order from there on; C = 3 * 0.5, G = 0.5 * 29
    assert of_lines(open_ended, SQUARE)[0] == pytest.approx(3 / 16, abs=1e-12)


def all_pairings(distances: np.ndarray, gap: float) -> float:
    """Return the least cost over all choices of equally many points of both lines, in order."""
    m, n = distances.shape
    return min(
        sum(distances[i, j] for i, j in zip(rows, columns, strict=True)) + gap * (m + n - 2 * k)
        for k in range(min(m, n) + 1)
        for rows in combinations(range(m), k)
        for columns in combinations(range(n), k)
    )


@pytest.mark.parametrize("seed", range(20))
def test_sospa_is_the_least_over_all_pairings_in_order(seed):
    rng = np.random.default_rng(seed)
    first, second = (rng.uniform(0, 2, (rng.integers(1, 6), 2)) for _ in range(2))
    closed = seed % 2 and len(first) > 2
    cutoffs = (0.5, 1.5)
    found = sospa(np.concatenate([first, first[:1]]) if closed else first, second, cutoffs)
    starts = range(len(first)) if closed else (0,)
    for cutoff, (value, part) in zip(cutoffs, found, strict=True):
        orders = (np.roll(first, -s, 0)[::way] for s in starts for way in (1, -1))
        apart = (np.linalg.norm(order[:, None] - second, axis=-1) for order in orders)
        cost = min(all_pairings(distances, cutoff / 2) for distances in apart)
        whole = cutoff / 2 * (len(first) + len(second))
        assert value == pytest.approx(2 * cost / (whole + cost), abs=1e-12)
        assert 0 <= part <= value + 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_sospa_is_a_metric_of_open_lines(seed):
    rng = np.random.default_rng(seed)
    a, b, c = (np.cumsum(rng.normal(0, 0.4, (rng.integers(2, 9), 2)), 0) for _ in range(3))
    ab, ba, bc, ac = (sospa(*pair, (1.0,))[0, 0] for pair in ((a, b), (b, a), (b, c), (a, c)))
    assert ab == pytest.approx(ba, abs=1e-12)
    assert ac <= ab + bc + 1e-12
    assert sospa(a, a, (1.0,))[0, 0] == 0


def test_pld_of_a_sample_by_hand():
    """One line is found 0.2 m aside (s = 1/3, score 0.9), one is missed, one of 0.4 is false."""
    far = aside(10.0)
    found = figures([aside(0.2), aside(-10.0)], [0.9, 0.4], [LINE, far])
    # D = 0.9 / 3 + 0.1 / 2 + 0.4 / 2 + 1 / 2, M = (1.3 + 2) / 2
    assert found["divider/PLD@1.0"] == pytest.approx(2 * 1.05 / (1.65 + 1.05), abs=1e-12)
    assert found["divider/localisation"] == pytest.approx(2 * 0.3 / 2.7, abs=1e-12)
    parts = found["divider/localisation"] + found["divider/cardinality"]
    assert parts == pytest.approx(found["divider/PLD"], abs=1e-12)
    assert found["ped_crossing/PLD"] == 0
    assert found["PLD"] == pytest.approx(found["divider/PLD"] / 3, abs=1e-12)


def test_pld_has_its_ends_at_equal_maps_and_at_maps_without_a_pair():
    assert figures([LINE, SQUARE], [1, 1], [SQUARE, LINE])["divider/PLD"] == 0
    assert figures([aside(5.0)], [0.3], [LINE])["divider/PLD"] == 1
    assert figures([], [], [LINE])["divider/PLD"] == 1
    assert figures([LINE], [0.3], [])["divider/PLD"] == 1
    assert figures([], [], [])["divider/PLD"] == 0
    # a ground truth of one point is one that nobody finds, a prediction of one point is none
    assert figures([LINE[:1]], [0.5], [LINE[:1]])["divider/PLD"] == 1


def test_samples_count_by_their_elements_and_classes_apart():
    other = elements([LINE], [2], [1.0])
    first = elements([LINE], scores=[1.0]), elements([LINE])
    found = figures_of(first, (other, elements([LINE])))
    # dividers: one found, one missed: D = 1/2, M = 3/2; boundaries: one that is not there
    assert found["divider/PLD"] == pytest.approx(0.5)
    assert found["boundary/PLD"] == 1


@pytest.mark.parametrize("seed", range(10))
def test_pld_takes_the_best_of_all_ways_to_pair_lines(seed):
    rng = np.random.default_rng(seed)
    wanted = [LINE + rng.uniform(-1, 1, 2) for _ in range(3)]
    found = [LINE + rng.uniform(-1, 1, 2) for _ in range(3)]
    scores = rng.random(3)
    apart = np.array([[of_lines(a, b)[0] for b in wanted] for a in found])
    costs = []
    for order in permutations(range(3)):  # a pair of s = 1 costs what both cost alone
        costs.append(sum(scores * apart[range(3), order] + (1 - scores) / 2))
    whole = (scores.sum() + 3) / 2
    expected = 2 * min(costs) / (whole + min(costs))
    found = figures(found, scores, wanted)["divider/PLD"]
    assert found == pytest.approx(expected, abs=1e-12)


def test_looser_cutoffs_are_averaged():
    config = PLD(CLASSES, (0.5, 1.0))
    found = figures([aside(0.2)], [1.0], [LINE], config)
    at = [of_lines(aside(0.2), LINE, cutoff)[0] for cutoff in (0.5, 1.0)]
    # one pair, score 1: D = s, M = 1
    expected = [2 * s / (1 + s) for s in at]
    assert [found["divider/PLD@0.5"], found["divider/PLD@1.0"]] == pytest.approx(expected)
    assert found["divider/PLD"] == pytest.approx(np.mean(expected))


def test_the_command_writes_pld(tmp_path, capsys):
    truth = annotated(tmp_path / "val.arrow", 4, scenes=2)
    write_results(tmp_path / "a.json", results_of(4))
    words = [str(tmp_path / "a.json"), str(truth), "--eval", "chamfer"]
    command()([*words, "--pld", "--out", str(tmp_path / "m.json")])
    found = json.loads((tmp_path / "m.json").read_text())
    # dividers are found exactly at 0.9: D = 4 * 0.1 / 2, M = 4 * 1.9 / 2
    assert found["pld/divider/PLD@0.5"] == pytest.approx(2 * 0.2 / (3.8 + 0.2))
    assert "pld/PLD " in capsys.readouterr().out
