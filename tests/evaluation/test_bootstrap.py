"""Intervals of AP: equal to matching files of resampled scenes anew, paired, and repeatable."""

import json
from dataclasses import replace

import numpy as np
import pytest
from golden_data import CLASSES, EVALUATOR
from test_files import annotated, command, results_of

from gsmap.evaluation.analysis.bootstrap import (
    Resamples,
    ap_differences,
    ap_intervals,
    format_intervals,
    resampled_aps,
    resampled_figures,
)
from gsmap.evaluation.analysis.groups import Groups, ap_by_group
from gsmap.evaluation.core.average_precision import area_ap, interpolated_ap
from gsmap.evaluation.core.chamfer_ap import HardChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.metric import MetricSettings
from gsmap.evaluation.core.report import format_table
from gsmap.evaluation.core.results_json import write_results
from gsmap.structures.elements import MapElements

CHAMFER, RASTER = EVALUATOR.metrics
HARD = MapEvaluator(CHAMFER, HardChamferConfig.from_settings(MetricSettings(CLASSES)), RASTER)
COUNT = 20


def upright_line(x: float) -> np.ndarray:
    return np.array([[x, -20.0], [x, 15.0]])


def drive(seed: int, offset_m: float) -> list[tuple[str, str, MapElements, MapElements]]:
    """Samples of five scenes: token, scene, predictions some way off, ground truth of lines.

    Predictions of different samples may have the same score. The last class is in one scene only.
    """
    rng = np.random.default_rng(seed)
    samples = []
    for i in range(15):
        labels = rng.integers(0, 2 if i >= 3 else 3, 4)
        x = rng.uniform(-12, 12, 4)
        shifts = rng.exponential(offset_m, 4) * rng.choice([-1, 1], 4)
        lines = [upright_line(a) for a in x]
        found = [upright_line(a) for a in x + shifts]
        scores = rng.choice(np.round(np.linspace(0.1, 0.9, 6), 2), 4, replace=False)
        predictions = MapElements.from_polylines(found, labels, scores)
        truth = MapElements.from_polylines(lines, labels)
        samples.append((f"t{i:02d}", f"s{i // 3}", predictions, truth))
    return samples


def reports_of(samples: list, evaluator: MapEvaluator = HARD) -> list:
    matches = []
    for token, _, predictions, truth in samples:
        matches.append(evaluator.match(token, predictions, truth))
    return evaluator.reports(matches)


def resamples_of(samples: list) -> Resamples:
    return Resamples({token: scene for token, scene, *_ in samples}, COUNT, seed=3)


def repeated(samples: list, drawn: np.ndarray) -> list:
    """The samples of a resample as a file would have them: copies with tokens of their own."""
    copies = []
    for token, scene, predictions, truth in samples:
        num_copies = int(drawn[int(scene[1:])])
        for copy in range(num_copies):
            copies.append((f"{token}-{copy}", scene, predictions, truth))
    return copies


def test_resampled_figures_equal_those_of_files_with_the_scenes_repeated():
    samples = drive(0, 0.6)
    resamples = resamples_of(samples)
    _, drawn = resamples.draw_copies([token for token, *_ in samples])
    assert (drawn.sum(1) == 5).all()
    found = {}
    for report in reports_of(samples):
        found |= resampled_figures(report, resamples)
    assert {"chamfer/mAP", "chamfer_hard/divider/AP@0.2", "raster/line/AP", "raster/mAP"} <= set(
        found
    )
    for b in range(COUNT):
        wanted = {}
        for report in reports_of(repeated(samples, drawn[b])):
            wanted |= report.metrics
        for key, values in found.items():
            if np.isnan(values[b]):  # a report has 0 for AP_chamfer of an absent class
                assert wanted[key] == (0 if key.startswith("chamfer") else -1)
            else:
                assert values[b] == pytest.approx(wanted[key], abs=1e-12), (b, key)
    assert (drawn[:, 0] == 0).any(), "no resample is without the last class"


def test_every_ap_has_an_interval_and_no_other_figure():
    (report, *_) = reports_of(drive(0, 0.6))
    found = ap_intervals([report], resamples_of(drive(0, 0.6)))
    wanted = set()
    for key in report.metrics:
        last_word = key.split("/")[-1]
        if last_word.startswith(("AP", "mAP")):
            wanted.add(key)
    assert set(found) == wanted
    for key, interval in found.items():
        assert interval.value == report.metrics[key]
        assert interval.low <= interval.high
    assert found["chamfer/mAP"].low < found["chamfer/mAP"].value < found["chamfer/mAP"].high


@pytest.mark.parametrize("interpolated", [False, True])
def test_the_kernel_equals_the_metrics_own_ap(interpolated):
    """Each scene drawn once: the AP of the metric, also without a hit and with all."""
    rng = np.random.default_rng(1)
    for share in (0.0, 0.3, 1.0):
        hits = rng.random(60) < share
        scene = rng.integers(0, 4, 60)
        gts = np.array([20.0, 0, 30, 12])
        found = resampled_aps(hits[:, None], scene, np.ones((1, 4)), gts, interpolated)[0, 0]
        wanted = (interpolated_ap if interpolated else area_ap)(hits, 62)
        assert found == pytest.approx(wanted, abs=1e-14)


def test_a_difference_is_paired_scene_by_scene():
    """The same predictions with a constant gain differ less than their intervals are wide."""
    good = drive(0, 0.3)
    bad = drive(0, 0.9)
    resamples = resamples_of(good)
    found = ap_differences(reports_of(good), reports_of(bad), resamples)["chamfer/mAP"]
    ours = reports_of(good)[0].metrics["chamfer/mAP"]
    theirs = reports_of(bad)[0].metrics["chamfer/mAP"]
    assert found.value == ours - theirs
    assert 0 < found.low < found.value < found.high
    same = ap_differences(reports_of(good), reports_of(good), resamples)
    for interval in same.values():
        assert (interval.value, interval.low, interval.high) == (0, 0, 0)
    with pytest.raises(ValueError, match="only if their samples and metrics are equal"):
        ap_differences(reports_of(good), reports_of(bad[:-1]), resamples)


def rare_crossings(found: int) -> list[tuple[str, str, MapElements, MapElements]]:
    """Three scenes with a divider each; the first one also has three crossings, some found."""
    samples = []
    for number in range(3):
        truth = [0, 1, 1, 1] if number == 0 else [0]
        lines = [upright_line(4.0 * place) for place in range(len(truth))]
        count = 1 + found if number == 0 else 1
        predictions = MapElements.from_polylines(lines[:count], truth[:count], [0.9] * count)
        truth = MapElements.from_polylines(lines, truth)
        samples.append((f"t{number}", f"s{number}", predictions, truth))
    return samples


def test_resamples_without_a_class_do_not_count_in_its_interval():
    good = reports_of(rare_crossings(found=3))
    bad = reports_of(rare_crossings(found=1))
    resamples = Resamples({f"t{i}": f"s{i}" for i in range(3)}, count=100, seed=0)
    _, drawn = resamples.draw_copies(["t0", "t1", "t2"])
    assert (drawn[:, 0] == 0).sum() > 10
    intervals = ap_intervals(good, resamples)
    differences = ap_differences(good, bad, resamples)
    for metric in ("chamfer", "chamfer_hard", "raster"):
        key = f"{metric}/ped_crossing/AP"
        assert intervals[key].low == intervals[key].high == intervals[key].value == 1
        difference = differences[key]
        assert difference.low == pytest.approx(difference.value)
        assert difference.value > 0.5
    # No scene has a boundary.
    assert intervals["chamfer/boundary/AP"].low == -1
    assert "chamfer/boundary/AP" not in differences
    rows = format_intervals(intervals, "title").splitlines()
    assert [row.split()[1:] for row in rows if row.startswith("chamfer/boundary/AP ")] == [["-"]]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"chamfer/divider/AP@0.5": None}, "has no 'chamfer/divider/AP@0.5': let it have"),
        ({"chamfer/mAP": None}, "has no 'chamfer/mAP'"),
        (
            {"chamfer/divider/AP": 0.4225},
            r"divider/AP of .* is 0\.4225, but .* \(area below the curve",
        ),
    ],
)
def test_an_ap_of_another_rule_has_no_intervals_and_groups(changes, reason):
    samples = drive(0, 0.6)
    report = reports_of(samples)[0]
    metrics = {}
    for key, value in (report.metrics | changes).items():
        if value is not None:
            metrics[key] = value
    own = replace(report, metrics=metrics)
    with pytest.raises(ValueError, match=reason):
        ap_intervals([own], resamples_of(samples))
    with pytest.raises(ValueError, match=reason):
        ap_by_group([own], Groups({token: "all" for token, *_ in samples}))
    if None in changes.values():
        with pytest.raises(ValueError, match=reason):
            format_table(own)


def test_resamples_are_repeatable_and_need_scenes():
    scenes = {f"t{i}": f"s{i}" for i in range(6)}
    _, first = Resamples(scenes, 50, 0).draw_copies(list(scenes))
    _, again = Resamples(scenes, 50, 0).draw_copies(list(scenes))
    _, other = Resamples(scenes, 50, 1).draw_copies(list(scenes))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    with pytest.raises(ValueError, match="two scenes, two resamples"):
        Resamples({"a": "s", "b": "s"})
    with pytest.raises(ValueError, match="scene of sample 'x' is not known"):
        Resamples(scenes).draw_copies(["x"])


def test_the_command_writes_intervals_and_differences(tmp_path, capsys):
    truth = annotated(tmp_path / "val.arrow", 8, scenes=4)
    write_results(tmp_path / "a.json", results_of(8))
    write_results(tmp_path / "b.json", [(token, found[:1]) for token, found in results_of(8)])
    words = [str(tmp_path / "a.json"), str(truth), "--out", str(tmp_path / "m.json")]
    command()([*words, "--against", str(tmp_path / "b.json"), "--bootstrap", "200"])
    text = capsys.readouterr().out
    assert "AP with intervals of 95 % of 200 resamples of the scenes, seed 0" in text
    assert "a.json minus" in text
    found = json.loads((tmp_path / "m.json").read_text())
    assert found["chamfer/mAP/low"] <= found["chamfer/mAP"] <= found["chamfer/mAP/high"]
    assert found["minus_other/chamfer/mAP/value"] == pytest.approx(0.5 / 2, abs=1e-9)
    write_results(tmp_path / "t.json", results_of(8), key="GTs")
    with pytest.raises(ValueError, match="knows no scenes"):
        command()([words[0], str(tmp_path / "t.json"), "--bootstrap"])


def test_hard_thresholds_beside_the_others_are_those_of_their_own_run(tmp_path):
    samples = drive(2, 0.6)
    both = reports_of(samples)
    assert [report.name for report in both] == ["chamfer", "chamfer_hard", "raster"]
    easy, _ = reports_of(samples, EVALUATOR)
    alone = replace(CHAMFER, thresholds=(0.2, 0.5, 1.0))
    (hard,) = reports_of(samples, MapEvaluator(alone))
    assert both[0].metrics == easy.metrics
    renamed = {}
    for key, value in hard.metrics.items():
        renamed[key.replace("chamfer/", "chamfer_hard/")] = value
    assert both[1].metrics == renamed
    assert set(both[1].detections) == set(CLASSES)
