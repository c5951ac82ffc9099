"""AP per sample of drawn lines: cases worked by hand, and against a plain second implementation."""

# Over 400 lines: the cases, and the second implementation that they are compared with.
import json
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import cv2
import numpy as np
import pytest
from golden_data import CLASSES
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from test_files import annotated, command, results_of, truth_of

from gsmap.evaluation.analysis.bootstrap import Resamples, resampled_figures
from gsmap.evaluation.analysis.groups import Groups, ap_by_group
from gsmap.evaluation.core.average_precision import ten_point_ap
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.metric import MetricSettings
from gsmap.evaluation.core.raster_ap import NUSCENES_GRID
from gsmap.evaluation.core.report import flat_metrics
from gsmap.evaluation.core.results_json import write_results
from gsmap.evaluation.core.sample_ap import (
    SampleAP,
    closest_pairs,
    draw_numbers,
    line_distances,
    match_sample_ap,
)
from gsmap.structures.elements import MapElements
from tools.merge import main as merge


class ThickLines(SampleAP):
    """Lines of five pixels."""

    name = "thick"
    line_px = 5
    report_thresholds = MappingProxyType({"thick": (2.0, 4.0, 6.0)})


class ThinLines(SampleAP):
    """Lines of one pixel, at two sets of thresholds."""

    name = "thin"
    line_px = 1
    report_thresholds = MappingProxyType({"thin": (0.5, 1.0, 1.5), "thin_hard": (0.2, 0.5, 1.0)})


RULES: dict[str, SampleAP] = {
    metric.name: metric(CLASSES, NUSCENES_GRID) for metric in (ThickLines, ThinLines)
}
CHAMFER = ChamferConfig(CLASSES)
DRAWN = MapEvaluator(*RULES.values())
UPRIGHT = np.array([[0.05, -20.0], [0.05, 20.0]])


def aside(*metres: float) -> list[np.ndarray]:
    return [UPRIGHT + np.array([m, 0.0]) for m in metres]


def elements(lines: list, scores: list | None = None, label: int = 0) -> MapElements:
    return MapElements.from_polylines(lines, [label] * len(lines), scores)


def figures(*samples: tuple[MapElements, MapElements], evaluator=DRAWN) -> dict[str, float]:
    matches = [evaluator.match(f"{i:03d}", *sample) for i, sample in enumerate(samples)]
    return flat_metrics(evaluator.reports(matches))


NOTHING, TRUTH = elements([], []), elements(aside(0.0))


def test_lines_are_drawn_with_their_numbers_and_later_ones_hide_earlier_ones():
    """A line upright in column 100 (0.05 m), one across it in row 200, one of another class."""
    across = np.array([[-2.95, 0.05], [3.05, 0.05]])
    both = MapElements.from_polylines([UPRIGHT, across, UPRIGHT + 5], [0, 0, 1])
    mask = draw_numbers(both, 0, RULES["thin"])
    assert mask.shape == (400, 200)
    rows, columns = np.nonzero(mask == 0)
    assert set(columns) == {100}
    assert sorted(rows) == [*range(66, 200), *range(201, 334)]  # -20 m is row 66.7, 20 m 333.3
    assert np.argwhere(mask == 1).tolist() == [[200, c] for c in range(80, 121)]
    assert (mask == 2).sum() == 0
    thick = draw_numbers(both.select(np.array([0])), 0, RULES["thick"])
    wanted = cv2.polylines(
        np.zeros((400, 200), np.uint8), [np.array([[100, 66], [100, 333]])], 0, 1, 5
    )
    np.testing.assert_array_equal(thick == 0, wanted == 1)
    assert set(np.nonzero(thick == 0)[1]) == {*range(97, 104)}  # what OpenCV makes of 5


@pytest.mark.parametrize(("shift_px", "tens"), [(3, "ooo"), (4, "xoo"), (7, "xxo"), (10, "xxx")])
def test_a_match_is_strictly_below_the_threshold(shift_px, tens):
    """Lines apart by 0.45, 0.6, 1.05 and 1.5 m; all their pixels are equally far."""
    found = figures((elements(aside(shift_px * 0.15), [0.5]), TRUTH))
    for threshold, mark in zip(CHAMFER_THRESHOLDS, tens, strict=True):
        assert found[f"thin/divider/AP@{threshold}"] == (mark == "o")
    assert found["thick/divider/AP"] == 1.0
    if "o" in tens:
        error = found["thin/divider/error_m@1.5"]
        assert error == pytest.approx(0.15 * shift_px, abs=1e-12)


def test_predictions_count_in_the_order_of_rising_scores():
    hit, miss = aside(0.15, 8.0)
    right = figures((elements([hit, miss], [0.9, 0.2]), TRUTH))
    assert right["thin/divider/AP@0.5"] == 0.5  # the miss is first
    wrong = figures((elements([hit, miss], [0.2, 0.9]), TRUTH))
    assert wrong["thin/divider/AP@0.5"] == 1.0
    equal = figures((elements([miss, hit], [0.5, 0.5]), TRUTH))
    assert equal["thin/divider/AP@0.5"] == 1.0  # matches go first


def test_the_closest_pair_matches_whatever_its_score():
    """Two predictions 0.3 and 0.15 m off one line: the closer one takes it."""
    found = MapElements.from_polylines(aside(0.3, -0.15), [0, 0], [0.9, 0.1])
    matches = match_sample_ap(found, TRUTH, RULES["thin"])
    assert matches.pred_index.tolist() == [0, 1]
    assert matches.matched_gt.tolist() == [[-1] * 4, [0] * 4]
    distance = np.array([[1.0, 2.0], [0.5, 1.5]])
    assert closest_pairs(distance, 9.0).tolist() == [1, 0]
    assert closest_pairs(distance, 2.0).tolist() == [-1, 0]
    assert closest_pairs(np.empty((2, 0)), 2.0).tolist() == [-1, -1]


def test_recalls_are_ten_and_exact():
    assert ten_point_ap(np.array([True, False]), 2) == 0.5
    assert ten_point_ap(np.array([False, True, True]), 2) == pytest.approx(2 / 3)
    # 7 of 10, then a miss: recalls up to 0.7 have precision 1
    assert ten_point_ap(np.arange(8) < 7, 10) == pytest.approx(0.7)


def test_samples_of_one_side_are_zero_and_of_none_do_not_count():
    right = elements(aside(0.0), [0.5])
    found = figures((right, TRUTH), (NOTHING, TRUTH), (right, elements([])), (NOTHING, NOTHING))
    for name in ("thick", "thin", "thin_hard"):
        assert found[f"{name}/divider/AP"] == pytest.approx(1 / 3)
        assert found[f"{name}/divider/num_samples"] == 3
        assert found[f"{name}/mAP"] == pytest.approx(1 / 3)  # the other classes occur nowhere
        assert (
            found[f"{name}/ped_crossing/AP"] == found[f"{name}/boundary/AP@1.0"]
            if (name != "thick")
            else found[f"{name}/boundary/AP@2.0"] == -1
        )
        assert found[f"{name}/num_samples"] == 4
    empty = figures((NOTHING, NOTHING))
    assert empty["thin/mAP"] == empty["thin/AP@0.5"] == -1


def test_hidden_far_and_short_elements_do_not_count():
    far, point = UPRIGHT + 900.0, UPRIGHT[:1]
    beyond = np.array([[0.05, -1e9], [0.05, 1e9]])
    found = elements([*aside(0.0, 0.0), far, point], [0.9, 0.5, 0.8, 0.7])
    metrics = figures((found, elements([UPRIGHT, far, point])))
    assert metrics["thin/divider/num_preds"] == metrics["thin/divider/num_gts"] == 1
    assert metrics["thin/divider/AP"] == 1.0
    drawn = draw_numbers(elements([beyond]), 0, RULES["thin"])
    assert (drawn[:, 100] == 0).all()


def test_low_scores_are_left_out_if_asked():
    found = elements(aside(0.0, 8.0), [0.9, 0.39])
    evaluator = MapEvaluator(replace(RULES["thin"], min_score=0.4))
    assert figures((found, TRUTH), evaluator=evaluator)["thin/divider/AP"] == 1.0
    (matches,) = evaluator.match("t", found.select(np.array([1, 0])), TRUTH).values()
    assert matches.pred_index.tolist() == [1]


def random_map(rng: np.random.Generator, count: int, scored: bool) -> MapElements:
    """Lines that cross each other and the border, of two classes."""
    starts = rng.uniform((-16, -31), (16, 31), (count, 1, 2))
    lines = starts + np.cumsum(rng.normal(0, 4, (count, 4, 2)), axis=1)
    scores = rng.integers(1, 6, count) / 5 if scored else None
    return MapElements.from_polylines(list(lines), rng.integers(0, 2, count), scores)


def near(truth: MapElements, rng: np.random.Generator) -> MapElements:
    """Predictions that are near the truth, and some that are not."""
    moved = [line + rng.normal(0, 0.6, line.shape) for line in truth.polylines]
    other = random_map(rng, 3, True)
    scores = rng.integers(1, 6, len(moved) + 3) / 5
    labels = [*truth.labels, *other.labels]
    return MapElements.from_polylines([*moved, *other.polylines], labels, scores)


def plain_pixels(side: MapElements, label: int, thickness: int) -> dict[int, np.ndarray]:
    """Pixels of each element of a class, in metres."""
    mask = np.zeros((400, 200), np.int32)
    for i, line in enumerate(side.polylines):
        if side.labels[i] == label:
            at = np.trunc((line + np.array([15, 30])) / 0.15).astype(np.int32)
            cv2.polylines(mask, [at], False, (i + 1,), thickness)
    return {i - 1: np.argwhere(mask == i) * 0.15 for i in np.unique(mask)[1:].tolist()}


def plain_ap(pred: MapElements, gt: MapElements, label: int, thickness: int, limit: float):
    """AP of a class of one sample by the rules alone: all distances, loops; None without sides."""
    found, true = (plain_pixels(side, label, thickness) for side in (pred, gt))
    if not (found or true):
        return None
    pairs = []
    for i, own in found.items():
        for j, other in true.items():
            apart = cdist(own, other)
            pairs.append((apart.min(0).mean() / 2 + apart.min(1).mean() / 2, i, j))
    matched, taken = set(), set()
    for distance, i, j in sorted(pairs):
        if distance < limit and i not in matched and j not in taken:
            matched.add(i)
            taken.add(j)
    order = sorted(found, key=lambda i: (pred.scores[i], i not in matched))
    hits = np.array([i in matched for i in order])
    total = 0.0
    for tenth in range(1, 11):
        best = [
            hits[: n + 1].mean()
            for n in range(len(hits))
            if 10 * hits[: n + 1].sum() >= tenth * len(true) and true
        ]
        total += max(best, default=0.0) / 10
    return total


@pytest.mark.parametrize("seed", range(3))
def test_figures_equal_a_plain_implementation(seed):
    rng = np.random.default_rng(seed)
    truths = [random_map(rng, count, False) for count in (5, 3, 0, 12)]
    samples = [(near(truth, rng), truth) for truth in truths] + [(NOTHING, truths[0])]
    metrics, values = figures(*samples), []
    for method in RULES.values():
        for name, thresholds in method.report_thresholds.items():
            for label, threshold in ((c, t) for c in (0, 1) for t in thresholds):
                plain = partial(plain_ap, label=label, thickness=method.line_px, limit=threshold)
                aps = [ap for sample in samples if (ap := plain(*sample)) is not None]
                values.append(metrics[f"{name}/{CLASSES[label]}/AP@{threshold}"])
                assert values[-1] == pytest.approx(np.mean(aps), abs=1e-12)
    assert 0 <= min(values) < max(values) < 1
    assert len(set(values)) > 4


@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 40), columns=st.integers(1, 40))
@settings(max_examples=30)
def test_distances_equal_those_of_all_pairs_of_pixels(seed, rows, columns):
    rng = np.random.default_rng(seed)
    found, true = np.where(
        rng.random((2, rows, columns)) < 0.1, rng.integers(0, 4, (2, rows, columns)), -1
    ).astype(np.int32)
    distance, preds, gts = line_distances(found, true)
    limited, *_ = line_distances(found, true, 0.5)
    assert distance.shape == (len(preds), len(gts))
    for row, i in enumerate(preds):
        for column, j in enumerate(gts):
            apart = 0.15 * cdist(np.argwhere(found == i), np.argwhere(true == j))
            wanted = (apart.min(0).mean() + apart.min(1).mean()) / 2
            assert distance[row, column] == pytest.approx(wanted, abs=1e-9)
            if wanted < 0.5:
                assert limited[row, column] == distance[row, column]
            else:
                assert limited[row, column] >= 0.5


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_looser_thresholds_and_the_truth_itself(seed):
    rng = np.random.default_rng(seed)
    truth = random_map(rng, 6, False)
    metrics = figures((near(truth, rng), truth))
    itself = figures((replace(truth, scores=rng.random(6)), truth))
    for method in RULES.values():
        for name, thresholds in method.report_thresholds.items():
            for label in CLASSES[:2]:
                aps = [metrics[f"{name}/{label}/AP@{t}"] for t in thresholds]
                assert aps == sorted(aps)
                assert aps[-1] <= 1
                if itself[f"{name}/{label}/num_gts"]:
                    assert itself[f"{name}/{label}/AP"] == pytest.approx(1.0)


def sample_set() -> list[tuple[str, MapElements, MapElements]]:
    rng = np.random.default_rng(0)
    truths = [random_map(rng, count, False) for count in (3, 0, 4, 2, 5, 3)]
    found = [(f"t{i}", near(truth, rng), truth) for i, truth in enumerate(truths)]
    return [*found, ("t6", NOTHING, truths[0]), ("t7", NOTHING, NOTHING)]


BOTH = MapEvaluator(CHAMFER, *DRAWN.metrics)


def check_groups_and_resamples(evaluator: MapEvaluator) -> None:
    """Compare figures of groups and of resamples with those of files of their samples."""
    samples = sample_set()
    reports = evaluator.reports(evaluator.match(*sample) for sample in samples)
    areas = {report.name for report in reports if report.by_distance and not report.sample_aps}
    group_of = {token: f"g{i % 3}" for i, (token, *_) in enumerate(samples)}
    for group, aps in ap_by_group(reports, Groups(group_of)).items():
        own = figures(*(s[1:] for s in samples if group_of[s[0]] == group), evaluator=evaluator)
        for key, value in aps.items():
            wanted = own[key]
            is_area = key.split("/")[0] in areas
            if is_area and own.get(f"{key.rpartition('/')[0]}/num_gts") == 0:
                wanted = -1  # a file has 0 for a class without ground truth, a group has no AP
            assert value == pytest.approx(wanted, abs=1e-12), (group, key)
        assert aps.keys() == {k for k in own if "/AP" in k or k.endswith("/mAP")}
    resamples = Resamples(group_of, 4, seed=1)
    scenes, drawn = resamples.draw_copies(reports[0].tokens)
    for b, counts in enumerate(drawn.astype(int)):
        copies = [s[1:] for s, g in zip(samples, scenes, strict=True) for _ in range(counts[g])]
        own = figures(*copies, evaluator=DRAWN)
        for report in reports:
            for key, values in resampled_figures(report, resamples).items():
                if key in own:
                    wanted = np.nan if own[key] == -1 else own[key]
                    assert values[b] == pytest.approx(wanted, abs=1e-12, nan_ok=True), key


@pytest.mark.parametrize("evaluator", [DRAWN, BOTH])
def test_groups_and_resamples_are_files_of_their_samples(evaluator):
    check_groups_and_resamples(evaluator)


def test_command_writes_them_under_their_own_names_also_in_shards(tmp_path, capsys):
    results, truth = tmp_path / "results.json", annotated(tmp_path / "val.arrow", 8, scenes=4)
    write_results(results, [*results_of(7), ("t7", [])])
    out, parts = tmp_path / "all.json", tmp_path / "parts.json"
    words = [
        str(results),
        str(truth),
        "--eval",
        "vectormapnet",
        "vectormapnet_shrunk",
        "hdmapnet",
        "bemapnet",
    ]
    assert command()([*words, "--out", str(out)]).startswith("8 samples")
    written = json.loads(out.read_text())
    assert {key.split("/")[0] for key in written} == {
        "chamfer", "vectormapnet", "vectormapnet_shrunk", "hdmapnet", "bemapnet", "bemapnet_hard",
    }  # fmt: skip
    assert written["bemapnet/divider/AP"] == written["hdmapnet/divider/AP"] == 7 / 8
    assert written["vectormapnet/divider/AP"] == 1 > written["chamfer/divider/AP"]
    assert written["vectormapnet_shrunk/divider/AP"] == 1
    assert "mAP_bemapnet_hard = 0.6" in capsys.readouterr().out
    for part in ("0/2", "1/2"):
        command()([*words, "--out", str(parts), "--shard", part])
    merge([str(parts)])
    assert json.loads(parts.read_text()) == written
    for option in (["--by", "scene"], ["--by", "distance"], ["--bootstrap", "10"]):
        command()([*words, *option])
    assert "hdmapnet divider" in capsys.readouterr().out


def test_bad_settings_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"min_score must be in \[0, 1\], got 1.5"):
        replace(RULES["thin"], min_score=1.5)
    with pytest.raises(ValueError, match=r"different names, got \['thin', 'thin'"):
        MapEvaluator(RULES["thin"], RULES["thin"])
    with pytest.raises(ValueError, match="all metrics must have equal classes"):
        MapEvaluator(*DRAWN.metrics, ChamferConfig(("divider",)))
    with pytest.raises(ValueError, match="at least one metric"):
        MapEvaluator()
    for rules in ({"dim": 3}, {"resample_predictions": False}, {"resample_ground_truth": False}):
        given_so = MetricSettings(CLASSES, grid=NUSCENES_GRID, **rules)
        for name in ("vectormapnet", "vectormapnet_shrunk"):
            with pytest.raises(ValueError, match="is AP_chamfer of lines in the plane"):
                MapEvaluator.from_names([name], given_so)
    with pytest.raises(ValueError, match=r"there is no metric .*'image'.*'chamfer', .*'hdmapnet'"):
        MapEvaluator.from_names(["image"], MetricSettings(CLASSES))
    with pytest.raises(ValueError, match="need the range of the map"):
        MapEvaluator.from_names(["bemapnet"], MetricSettings(CLASSES))
    with pytest.raises(ValueError, match="predictions need scores"):
        match_sample_ap(TRUTH, TRUTH, RULES["thin"])
    results, truth = tmp_path / "results.json", tmp_path / "truth.json"
    write_results(results, results_of(2))
    write_results(truth, truth_of(2), key="GTs")
    for words, message in (
        (["--eval", "bemapnet", "--pr-curves", "a.png"], "name chamfer or raster"),
        (
            ["--min-score", "0.4"],
            "--min-score applies to topology, bemapnet, hdmapnet: leave it out",
        ),
        (["--eval", "raster", "--hard"], "--thresholds and --hard apply to chamfer, heights, pld:"),
        (["--eval", "hdmapnet", "topology", "--thresholds", "1"], "--thresholds and --hard apply"),
        (["--eval", "pld", "--bootstrap"], "apply to AP: name chamfer or raster"),
        (["--eval", "chamfers"], "there is no metric .*'chamfers'"),
    ):
        with pytest.raises(ValueError, match=message):
            command()([str(results), str(truth), *words])
