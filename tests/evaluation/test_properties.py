"""What must hold of both metrics for any map."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.report import flat_metrics
from gsmap.structures.elements import MapElements

CLASSES = ("divider", "ped_crossing")
EVALUATOR = MapEvaluator(ChamferConfig(CLASSES), RasterConfig(CLASSES))
AP_KEYS = tuple(f"{m}/{c}/AP" for m in ("chamfer", "raster") for c in CLASSES)


def score(frames: list[tuple[MapElements, MapElements]]) -> dict[str, float]:
    matches = [EVALUATOR.match(f"{i:03d}", pred, gt) for i, (pred, gt) in enumerate(frames)]
    return flat_metrics(EVALUATOR.reports(matches))


@st.composite
def maps(draw: st.DrawFn) -> MapElements:
    """One to five lines and rings inside the range, far enough apart to be told apart."""
    count = draw(st.integers(1, 5))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lines, labels = [], []
    for row in range(count):
        y = -24.0 + 12.0 * row
        label = int(rng.integers(2))
        if label:
            w, h = rng.uniform(1, 8, 2)
            x = rng.uniform(-12, 4)
            ring = [[x, y], [x + w, y], [x + w, y + h], [x, y + h], [x, y]]
            lines.append(np.array(ring))
        else:
            x = np.sort(rng.uniform(-14, 14, 6))
            lines.append(np.stack([x + np.arange(6), y + rng.uniform(0, 6, 6)], axis=1))
        labels.append(label)
    return MapElements.from_polylines(lines, labels, np.round(rng.permutation(count) / 10 + 0.3, 3))


@given(gt=maps())
@settings(max_examples=40)
def test_ground_truth_as_prediction_gives_one(gt):
    metrics = score([(gt, gt)])
    for key in AP_KEYS:
        if metrics[key.replace("/AP", "/num_gts")]:
            assert abs(metrics[key] - 1.0) < 1e-12


@given(gt=maps())
@settings(max_examples=20)
def test_moved_by_a_hundred_metres_gives_zero(gt):
    moved = MapElements.from_polylines(
        [p + np.array([100.0, 0.0]) for p in gt.polylines], gt.labels, gt.scores
    )
    metrics = score([(moved, gt)])
    assert all(metrics[key] in (0.0, -1.0) for key in AP_KEYS)
    assert metrics["chamfer/mAP"] == 0.0


@given(pred=maps(), gt=maps(), turn=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_reversing_lines_and_rings_changes_nothing(pred, gt, turn):
    flip = np.random.default_rng(turn).integers(2, size=len(pred)).astype(bool)
    lines = [p[::-1] if f else p for p, f in zip(pred.polylines, flip, strict=True)]
    before = score([(pred, gt)])
    after = score([(MapElements.from_polylines(lines, pred.labels, pred.scores), gt)])
    for key, value in before.items():
        assert abs(after[key] - value) < 1e-9, key


@given(pred=maps(), gt=maps(), label=st.integers(0, 1))
@settings(max_examples=40)
def test_a_miss_below_all_scores_never_raises_ap(pred, gt, label):
    far = [[90.0, 0.0], [95.0, 5.0], [90.0, 5.0]]
    scores = np.append(pred.scores, 0.1)
    more = MapElements.from_polylines(
        [*pred.polylines, np.array(far)], np.append(pred.labels, label), scores
    )
    before, after = score([(pred, gt)]), score([(more, gt)])
    assert all(after[key] <= before[key] + 1e-12 for key in AP_KEYS)


@given(pred=maps(), gt=maps())
@settings(max_examples=30)
def test_order_of_elements_and_samples_changes_no_digit(pred, gt):
    order = np.arange(len(pred))[::-1]
    frames = [(pred, gt), (gt, pred), (gt, gt)]
    turned = [(pred.select(order), gt), (gt, pred), (gt, gt)]
    assert score(frames) == score(turned)  # the scores of one sample differ, so no ties
