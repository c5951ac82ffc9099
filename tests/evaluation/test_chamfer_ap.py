import numpy as np
import pytest

from gsmap.evaluation.core.chamfer_ap import (
    ChamferConfig,
    chamfer_report,
    match_chamfer,
    nearest_by_chamfer,
)
from gsmap.evaluation.core.chamfer_kernels import chamfer_distance, resample_lines
from gsmap.evaluation.core.matches import MatchTable
from gsmap.evaluation.core.report import format_table
from gsmap.structures.elements import MapElements
from gsmap.structures.polylines import resample_all

CONFIG = ChamferConfig(("divider", "boundary"))


def upright(x: float, low: float = -20.0, high: float = 20.0) -> list[list[float]]:
    return [[x, low], [x, high]]


def test_chamfer_distance_is_the_mean_of_both_directions():
    """From {0} to {0, 3}: 0; back: (0 + 3) / 2; mean 0.75."""
    first, second = np.zeros((3, 1)), np.array([[0.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    assert chamfer_distance(first, second) == 0.75
    assert chamfer_distance(second, first) == 0.75


def test_hand_worked_ap():
    """Two ground truths G, three predictions; only their distance to the nearest G counts.

    .. code-block:: text

        x:  0.0  0.3                 8.0      8.7     14
            G    A (0.9)             G        B (0.8) C (0.7)

        at 0.5 m:  A hits, B and C miss    precision 1, 1/2, 1/3   recall 1/2, 1/2, 1/2
                   AP = 1/2 * 1
        at 1.0 m:  A and B hit             precision 1, 1, 2/3     recall 1/2, 1, 1
                   AP = 1
        boundary has no ground truth and counts in no mean.
    """
    gt = MapElements.from_polylines([upright(0.0), upright(8.0)], [0, 0])
    pred = MapElements.from_polylines(
        [upright(14.0), upright(0.3), upright(8.7)], [0] * 3, [0.7, 0.9, 0.8]
    )
    matches = match_chamfer(pred, gt, CONFIG, "a")
    assert matches.pred_index.tolist() == [1, 2, 0]
    assert matches.matched_gt.tolist() == [[0, 0, 0], [-1, 1, 1], [-1, -1, -1]]
    report = chamfer_report(MatchTable([matches]), CONFIG)
    metrics = report.metrics
    assert metrics["chamfer/divider/AP@0.5"] == 0.5
    assert metrics["chamfer/divider/AP@1.0"] == 1.0
    assert metrics["chamfer/divider/recall@0.5"] == 0.5
    assert metrics["chamfer/divider/AP"] == pytest.approx(2.5 / 3)
    assert metrics["chamfer/AP@0.5"] == 0.5  # the mean over the classes that have ground truth
    assert metrics["chamfer/mAP"] == pytest.approx(2.5 / 3)
    assert metrics["chamfer/num_absent_classes"] == 1
    assert metrics["chamfer/divider/error_m@1.5"] == pytest.approx(0.5)  # of 0.3 and 0.7
    assert metrics["chamfer/boundary/error_m@1.5"] == -1.0
    name, titles, _, divider, *_ = format_table(report).splitlines()
    assert name == "AP_chamfer"
    assert titles.split()[:4] == ["class", "AP", "@0.5", "m"]
    # the scores 0.9, 0.8 and 0.7 against 1, 1 and 0 at 1.5 m: (0.1 + 0.2 + 0.7) / 3
    cells = "divider 0.8333 0.5000 1.0000 1.0000 1.0000 0.5000 0.3333 2 3"
    assert divider.split() == cells.split()
    assert "without ground truth, left out of the means: boundary" in format_table(report)


def test_classes_may_have_the_names_of_other_rows_of_the_table():
    config = ChamferConfig(("class", "mean"))
    truth = MapElements.from_polylines([upright(0.0)], [0])
    found = MapElements.from_polylines([upright(0.0)], [0], [0.5])
    report = chamfer_report(MatchTable([match_chamfer(found, truth, config, "a")]), config)
    starts = [line.split()[0] for line in format_table(report).splitlines()]
    assert starts[1::2] == ["class", "class", "mean", "mAP_chamfer"]
    assert starts[4] == "mean"


def test_precision_envelope_lifts_an_early_miss():
    """Miss (0.9), hit (0.8), hit (0.7) of two: precision 0, 1/2, 2/3, envelope 2/3 throughout.

    AP = 1/2 * 2/3 + 1/2 * 2/3.
    """
    gt = MapElements.from_polylines([upright(0.0), upright(8.0)], [0, 0])
    pred = MapElements.from_polylines(
        [upright(4.0), upright(0.0), upright(8.0)], [0] * 3, [0.9, 0.8, 0.7]
    )
    metrics = chamfer_report(MatchTable([match_chamfer(pred, gt, CONFIG)]), CONFIG).metrics
    assert metrics["chamfer/divider/AP@0.5"] == pytest.approx(2 / 3)


def test_no_second_choice():
    """Both predictions are nearest to the left line; the second does not get the right one."""
    gt = MapElements.from_polylines([upright(0.0), upright(1.0)], [0, 0])
    pred = MapElements.from_polylines([upright(0.1), upright(0.2)], [0, 0], [0.9, 0.8])
    assert match_chamfer(pred, gt, CONFIG).matched_gt[:, 2].tolist() == [0, -1]


def test_threshold_is_inclusive_and_classes_do_not_mix():
    gt = MapElements.from_polylines([upright(0.0), upright(0.5)], [0, 1])
    pred = MapElements.from_polylines([upright(0.5)], [0], [0.9])
    assert match_chamfer(pred, gt, CONFIG).matched_gt.tolist() == [[0, 0, 0]]


def test_error_of_a_match_that_exists_at_the_tight_threshold_only():
    """At 1.5 m the first prediction, 1.2 m away, has the line; at 0.5 m the second, 0.1 m away."""
    gt = MapElements.from_polylines([upright(0.0)], [0])
    pred = MapElements.from_polylines([upright(1.2), upright(0.1)], [0, 0], [0.9, 0.8])
    matches = match_chamfer(pred, gt, CONFIG)
    assert matches.matched_gt.tolist() == [[-1, -1, 0], [0, 0, -1]]
    metrics = chamfer_report(MatchTable([matches]), CONFIG).metrics
    assert metrics["chamfer/divider/error_m@0.5"] == pytest.approx(0.1)
    assert metrics["chamfer/divider/error_m@1.5"] == pytest.approx(1.2)


def test_unknown_classes_and_short_lines():
    """Label -1 is nobody's; a prediction of one point is dropped, such a ground truth counts."""
    gt = MapElements.from_polylines([upright(0.0), [[1, 1]], upright(3.0)], [0, 0, -1])
    pred = MapElements.from_polylines(
        [[[0, 0]], upright(0.0), upright(3.0)], [0, 0, -1], [0.9, 0.8, 0.7]
    )
    matches = match_chamfer(pred, gt, CONFIG)
    assert matches.pred_index.tolist() == [1]
    assert matches.num_gts.tolist() == [2, 0]


def test_equal_scores_keep_their_order():
    """At 0.5 m the first of two equal scores misses: precision 0, 1/2."""
    gt = MapElements.from_polylines([upright(0.0)], [0])
    pred = MapElements.from_polylines([upright(0.9), upright(0.1)], [0, 0], [0.5, 0.5])
    metrics = chamfer_report(MatchTable([match_chamfer(pred, gt, CONFIG)]), CONFIG).metrics
    assert metrics["chamfer/divider/AP@0.5"] == 0.5
    assert metrics["chamfer/divider/AP@1.0"] == 1.0  # the first takes the line, the second misses


def test_branch_and_bound_finds_what_brute_force_finds():
    rng = np.random.default_rng(3)
    walks = np.cumsum(rng.normal(size=(40, 12, 2)), axis=1) + rng.uniform(-15, 15, (40, 1, 2))
    pred, gt = (
        MapElements.from_polylines(list(walks[:20]), [0] * 20),
        MapElements.from_polylines(list(walks[20:]), [0] * 20),
    )
    best, distance = nearest_by_chamfer(pred, gt, CONFIG, max_distance=6.0)
    p, g = (resample_all(e.points, e.offsets, 100) for e in (pred, gt))
    for i in range(20):
        nn = np.linalg.norm(p[i][:, None] - g[:, None, :, :], axis=-1)  # (K, 100, 100)
        brute = (nn.min(2).mean(1) + nn.min(1).mean(1)) / 2
        if brute.min() <= 6.0 and best[i] >= 0:
            assert best[i] == brute.argmin()
            assert distance[i] == pytest.approx(brute.min(), abs=1e-12)
    assert (best >= 0).sum() >= 5  # so that the comparison says something


def test_bad_configuration_is_refused():
    for classes in ((), "divider", (1, 2), ("divider", "divider")):
        with pytest.raises(ValueError, match="classes must be different names"):
            ChamferConfig(classes)
    assert ChamferConfig(["divider"], (1.0, 0.5, 1.0)).thresholds == (0.5, 1.0)
    assert ChamferConfig(["divider"]).classes == ("divider",)
    with pytest.raises(ValueError, match="> 0 m"):
        ChamferConfig(("divider",), (0.0, 1.0))
    with pytest.raises(ValueError, match="num_points"):
        ChamferConfig(("divider",), num_points=1)


def sloped(x: float, low: float, high: float) -> list[list[float]]:
    """A line of 40 m along y whose height runs from ``low`` to ``high``."""
    return [[x, -20.0, low], [x, 20.0, high]]


IN_SPACE = ChamferConfig(("divider", "boundary"), dim=3)


def test_chamfer_distance_in_space():
    """A 3-4-5 triangle: from {0} to {0, 5}: 0; back: (0 + 5) / 2."""
    first, second = np.zeros((3, 1)), np.array([[0.0, 0.0], [3.0, 0.0], [4.0, 0.0]])
    assert chamfer_distance(first, second) == 1.25


def test_an_error_of_height_misses_near_thresholds_and_hits_far_ones():
    """Predicted 1.2 m too high all along: the distance of every point is 1.2 m.

    In the plane the same prediction is perfect.
    """
    gt = MapElements.from_polylines([sloped(0.0, 0.0, 2.0)], [0])
    pred = MapElements.from_polylines([sloped(0.0, 1.2, 3.2)], [0], [0.9])
    metrics = chamfer_report(MatchTable([match_chamfer(pred, gt, IN_SPACE)]), IN_SPACE).metrics
    assert metrics["chamfer/divider/AP@1.0"] == 0.0
    assert metrics["chamfer/divider/AP@1.5"] == 1.0
    assert metrics["chamfer/divider/error_m@1.5"] == pytest.approx(1.2)
    assert match_chamfer(pred, gt, CONFIG).quality[0] == 0.0


def test_a_line_above_another_is_matched_at_its_own_height():
    """Two levels of a junction 5 m apart; in the plane the better score takes the first."""
    gt = MapElements.from_polylines([sloped(0.0, 0.0, 0.0), sloped(0.0, 5.0, 5.0)], [0, 0])
    pred = MapElements.from_polylines(
        [sloped(0.1, 5.0, 5.0), sloped(0.1, 0.0, 0.0)], [0, 0], [0.9, 0.8]
    )
    assert match_chamfer(pred, gt, IN_SPACE).matched_gt[:, 0].tolist() == [1, 0]


@pytest.mark.parametrize("resampled", [True, False])
def test_constant_heights_change_nothing(resampled):
    """Random lines at z = 1.5 m: every match and distance as without heights, to the digit."""
    rng = np.random.default_rng(5)
    lines = [np.cumsum(rng.normal(0, 2, (8, 2)), 0) for _ in range(12)]
    moved = [line + rng.normal(0, 0.3, 2) for line in lines]
    labels, scores = rng.integers(0, 2, 12), rng.uniform(size=12)
    raised = [[np.c_[line, np.full(8, 1.5)] for line in side] for side in (lines, moved)]
    found = []
    for (truth, predicted), dim in (((lines, moved), 2), (raised, 3)):
        rules = ChamferConfig(
            CONFIG.classes,
            resample_predictions=resampled,
            resample_ground_truth=resampled,
            dim=dim,
        )
        gt = MapElements.from_polylines(truth, labels)
        found.append(
            match_chamfer(MapElements.from_polylines(predicted, labels, scores), gt, rules)
        )
    assert (found[0].matched_gt >= 0).any()
    np.testing.assert_array_equal(found[1].matched_gt, found[0].matched_gt)
    np.testing.assert_allclose(found[1].quality, found[0].quality, rtol=1e-12)


@pytest.mark.parametrize(
    ("predictions", "truth", "distance"),
    [(False, False, 0.0), (True, True, 0.0), (False, True, 1 / 3), (True, False, 1 / 3)],
)
def test_each_side_is_resampled_by_its_own_switch(predictions, truth, distance):
    """The same line of 4 m with points at 0 and 4, or resampled at 0, 2 and 4.

    From two to three points: 0; back: 0, 2, 0, on average 2 / 3; mean of both 1 / 3.
    """
    rules = ChamferConfig(
        ("divider",), num_points=3, resample_predictions=predictions, resample_ground_truth=truth
    )
    line = MapElements.from_polylines([upright(0.0, 0.0, 4.0)], [0], [1.0])
    assert nearest_by_chamfer(line, line, rules)[1].tolist() == pytest.approx([distance])


def test_strips_touch_in_the_plane():
    """End to end, 0.9 m apart: no strip touches the other, whatever the heights; so no match."""
    for dim in (2, 3):
        rules = ChamferConfig(CONFIG.classes, (99.0,), dim=dim)
        ends = [[[0.0, 0.0, 0.0], [0.0, 1.0, 1.0]], [[0.0, 1.9, 0.0], [0.0, 2.9, 1.0]]]
        gt, pred = (MapElements.from_polylines([line], [0], [1.0]) for line in ends)
        assert match_chamfer(pred, gt, rules).matched_gt.tolist() == [[-1]]


def test_without_heights_a_metric_in_space_is_refused():
    flat = MapElements.from_polylines([upright(0.0)], [0], [0.9])
    high = MapElements.from_polylines([sloped(0.0, 0.0, 0.0)], [0])
    with pytest.raises(ValueError, match="sample 'a', AP_chamfer of dim 3: points must have 3"):
        match_chamfer(flat, high, IN_SPACE, "a")
    nothing = MapElements.from_polylines()
    assert match_chamfer(nothing, high, IN_SPACE).num_gts.tolist() == [1, 0]
    high = MapElements.from_polylines(high.polylines, [0], [0.9])
    assert match_chamfer(high, nothing, IN_SPACE).matched_gt.tolist() == [[-1, -1, -1]]
    with pytest.raises(ValueError, match="dim must be 2 or 3, got 4"):
        ChamferConfig(CONFIG.classes, dim=4)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("num_points", [2, 7, 100])
def test_compiled_resampling_equals_the_plain_one_bit_by_bit(dim, num_points):
    """Also lines of no, one and equal vertices, vertices that occur twice, and tiny steps."""
    rng = np.random.default_rng(0)
    lines = [rng.normal(0, 10, (n, dim)) for n in (0, 1, 2, 3, 20, 57)]
    lines += [np.ones((4, dim)), np.repeat(rng.normal(0, 5, (5, dim)), 3, axis=0)]
    lines += [np.cumsum(rng.exponential(1e-9, (6, dim)), 0), 1e6 * rng.normal(size=(9, dim))]
    straight = np.zeros((11, dim))
    straight[:, 0] = np.arange(11.0)  # points fall on vertices
    lines.append(straight)
    points = np.concatenate(lines)
    offsets = np.cumsum([0, *map(len, lines)])
    plain = resample_all(points, offsets, num_points)  # (N, P, D)
    rows = resample_lines(points, offsets, num_points)
    assert rows.shape == (3, len(lines) * num_points)
    np.testing.assert_array_equal(rows[:dim].T.reshape(plain.shape), plain)
    assert not rows[dim:].any()
