"""Equality with the reference evaluators, on every file of reference data."""

from pathlib import Path

import numpy as np
import pytest
from golden_data import CLASSES, EVALUATOR, Frame, frame_of, read, unpacked

from gsmap.evaluation.core.chamfer_ap import (
    ChamferConfig,
    chamfer_report,
    match_chamfer,
    nearest_by_chamfer,
)
from gsmap.evaluation.core.matches import MatchTable
from gsmap.evaluation.core.raster_ap import RasterConfig, match_raster, rasterize
from gsmap.evaluation.core.raster_kernels import mask_ious
from gsmap.evaluation.core.report import flat_metrics
from gsmap.structures.elements import MapElements

AP_TOLERANCE = 1e-6  # the reference computes precision and recall of AP_chamfer in float32
STORED = 1e-9  # distances and IoUs are stored with nine decimals


@pytest.fixture(scope="module")
def eval_dir(golden_dir: Path) -> Path:
    return golden_dir / "eval"


@pytest.fixture(scope="module")
def frames(eval_dir: Path) -> list[Frame]:
    return [frame_of(record) for record in read(eval_dir / "E1_A.json")["frames"]]


@pytest.fixture(scope="module")
def metrics(frames: list[Frame]) -> dict[str, float]:
    return score(frames)


def score(frames: list[Frame]) -> dict[str, float]:
    return flat_metrics(EVALUATOR.reports(EVALUATOR.match(*frame) for frame in frames))


def check_chamfer(metrics: dict[str, float], per_class: dict) -> None:
    for name in CLASSES:
        for key, want in per_class[name].items():
            if key == "mean_ap":
                assert metrics[f"chamfer/{name}/AP"] == pytest.approx(want, abs=AP_TOLERANCE)
                continue
            prefix = f"chamfer/{name}"
            assert metrics[f"{prefix}/AP@{key}"] == pytest.approx(want["ap"], abs=AP_TOLERANCE)
            assert metrics[f"{prefix}/num_gts"] == want["num_gts"]
            assert metrics[f"{prefix}/num_preds"] == want["num_dets"]
            recall = want["recall"] or 0.0  # the reference gives none without predictions
            assert metrics[f"{prefix}/recall@{key}"] == pytest.approx(recall, abs=AP_TOLERANCE)
            if "tp" in want:
                assert metrics[f"{prefix}/tp@{key}"] == want["tp"]


def raster_key(upstream: str) -> str:
    """Translate the key of a reference summary, such as "AP,0.25:0.50,divider,100"."""
    parts = upstream.split(",")
    if parts[0] == "Frame mIoU":
        return f"raster/{parts[1]}/mIoU"
    figure, iou, name, limit = parts
    name = "line" if name == "all" else name
    if figure == "AR":
        return f"raster/{name}/AR@{limit}"
    return f"raster/{name}/AP" + ("" if ":" in iou else f"@{float(iou)}")


def check_raster(metrics: dict[str, float], want: dict) -> None:
    for summary in ("upstream_summary_line", "upstream_summary_polygon"):
        for key, value in want[summary].items():
            assert metrics[raster_key(key)] == pytest.approx(value, abs=STORED), key
    for name, figures in want["per_class"].items():
        prefix = f"raster/{name}"
        assert metrics[f"{prefix}/num_gts"] == figures["num_gts"]
        assert metrics[f"{prefix}/num_preds"] == figures["num_dets"]
        assert metrics[f"{prefix}/AP"] == pytest.approx(figures["mean_ap"], abs=STORED)
        for i, threshold in enumerate(figures["thresholds"]):
            for ours, theirs in (("AP", "ap"), ("recall", "recall"), ("tp", "tp")):
                found = metrics[f"{prefix}/{ours}@{threshold}"]
                assert found == pytest.approx(figures[theirs][i], abs=STORED)


def test_chamfer_figures(metrics: dict[str, float], eval_dir: Path) -> None:
    want = read(eval_dir / "E2_A.json")
    check_chamfer(metrics, want["per_class"])
    assert metrics["chamfer/mAP"] == pytest.approx(want["mAP"], abs=AP_TOLERANCE)
    for key, value in want["per_threshold_mean_ap_over_present_classes"].items():
        assert metrics[f"chamfer/AP@{key}"] == pytest.approx(value, abs=AP_TOLERANCE)


def test_chamfer_with_predictions_at_their_own_points(frames, eval_dir: Path) -> None:
    config = ChamferConfig(CLASSES, resample_predictions=False)
    report = chamfer_report(
        MatchTable([match_chamfer(p, g, config, t) for t, p, g in frames]), config
    )
    want = read(eval_dir / "E2_A_noresample.json")
    check_chamfer(report.metrics, want["per_class"])
    assert report.metrics["chamfer/mAP"] == pytest.approx(want["mAP"], abs=AP_TOLERANCE)


def test_nearest_ground_truth_and_matches_of_every_prediction(frames, eval_dir: Path) -> None:
    config = ChamferConfig(CLASSES)
    for (token, pred, gt), want in zip(
        frames, read(eval_dir / "E2_A_matches.json")["frames"], strict=True
    ):
        best, distance = nearest_by_chamfer(pred, gt, config)
        matches = match_chamfer(pred, gt, config, token)
        hits = dict(
            zip(matches.pred_index.tolist(), (matches.matched_gt >= 0).tolist(), strict=True)
        )
        for label, name in enumerate(CLASSES):
            rows = want["cls"].get(name, {"pred_index": [], "best_gt": [], "chamfer": [], "tp": []})
            of_class = np.append(np.flatnonzero(gt.labels == label), -1)
            for i, k, d, tp in zip(
                rows["pred_index"], rows["best_gt"], rows["chamfer"], rows["tp"], strict=True
            ):
                far = d == 100.0  # the reference's mark for "no strip touches"
                assert best[i] == (-1 if far else of_class[k])
                assert distance[i] == pytest.approx(np.inf if far else d, abs=STORED)
                assert hits[i] == [bool(flag) for flag in tp]


def test_raster_figures(metrics: dict[str, float], eval_dir: Path) -> None:
    want = read(eval_dir / "E3_A.json")
    check_raster(metrics, want)
    mean = want["mAP_raster_mean_of_3_class_mean_ap"]
    assert metrics["raster/mAP"] == pytest.approx(mean, abs=STORED)


def test_ious_and_matches_of_every_frame(frames, eval_dir: Path) -> None:
    config = RasterConfig(CLASSES)
    for (token, pred, gt), want in zip(
        frames, read(eval_dir / "E3_A_matches.json")["frames"], strict=True
    ):
        matches = match_raster(pred, gt, config, token)
        for label, name in enumerate(CLASSES):
            if name not in want["cls"]:
                continue
            rows, mine = want["cls"][name], matches.labels == label
            assert matches.pred_index[mine].tolist() == rows["pred_index"]
            truths = np.array([*rows["gt_index"], -1])
            matched = truths[np.array(rows["matched_gt"], dtype=int).reshape(-1, 6)]
            assert matches.matched_gt[mine].tolist() == matched.tolist()
            chosen = [
                e.select(np.array(i, dtype=int))
                for e, i in ((pred, rows["pred_index"]), (gt, rows["gt_index"]))
            ]
            masks = [rasterize(elements, config) for elements in chosen]
            labels = [elements.labels for elements in chosen]
            ious = np.array(rows["iou"]).reshape(len(rows["pred_index"]), len(rows["gt_index"]))
            np.testing.assert_allclose(mask_ious(*masks, *labels), ious, rtol=0, atol=STORED)
            assert matches.class_iou[label] == pytest.approx(rows["frame_iou"], abs=STORED)


@pytest.mark.parametrize(("stored", "dilation"), [("raw", 1), ("dilated", 5)])
def test_masks_pixel_by_pixel(frames, eval_dir: Path, stored: str, dilation: int) -> None:
    config = RasterConfig(CLASSES, dilation_px=dilation)
    file = np.load(eval_dir / "E3_masks_A.npz")
    shape = tuple(file["shape"])
    wanted = np.unpackbits(file[stored])[: np.prod(shape)].reshape(shape).astype(bool)
    for (frame, is_pred, index, _, _), want in zip(file["info"], wanted, strict=True):
        elements = frames[frame][1 if is_pred else 2].select(np.array([index]))
        assert (unpacked(rasterize(elements, config), 240)[0] == want).all()


def test_edge_cases(eval_dir: Path) -> None:
    for name, case in read(eval_dir / "E2E3_edge_cases_A.json")["cases"].items():
        metrics = score([frame_of(record) for record in case["frames"]])
        check_raster(metrics, case["mapvr"])
        if "upstream_error" in case["maptr"]:  # a ground truth of one point: counted, unmatched
            assert name == "gt_single_point"
            assert metrics["chamfer/divider/num_gts"] == 2
            assert metrics["chamfer/divider/AP@0.5"] == 0.5
            continue
        check_chamfer(metrics, case["maptr"])
        present = len(CLASSES) - metrics["chamfer/num_absent_classes"]
        of_all = metrics["chamfer/mAP"] * present / len(CLASSES)  # MapTR counts absent ones as 0
        assert of_all == pytest.approx(case["maptr"]["mAP"], abs=AP_TOLERANCE)
        for key, value in case["maptr"]["mean_over_classes_with_gt"].items():
            assert metrics[f"chamfer/AP@{key}"] == pytest.approx(value, abs=AP_TOLERANCE)


def test_order_of_samples_and_repetition_change_no_digit(frames, metrics) -> None:
    shuffled = [frames[i] for i in np.random.default_rng(0).permutation(len(frames))]
    assert score(shuffled + shuffled[:7]) == metrics


def test_a_line_that_touches_no_strip_is_never_matched() -> None:
    """Two short collinear pieces end to end: 1 m apart on average, but their strips only abut."""
    pred = MapElements.from_polylines([[[0.0, 1.2], [0.0, 2.0]]], [0], [0.9])
    gt = MapElements.from_polylines([[[0.0, 0.0], [0.0, 1.0]]], [0])
    best, distance = nearest_by_chamfer(pred, gt, ChamferConfig(CLASSES))
    assert best.tolist() == [-1]
    assert np.isinf(distance[0])
