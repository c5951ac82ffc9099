"""VectorMapNet's AP_chamfer, and in the units of its release."""

from dataclasses import replace

import numpy as np
import pytest
from golden_data import CLASSES
from test_sample_ap import (
    CHAMFER,
    DRAWN,
    NOTHING,
    TRUTH,
    UPRIGHT,
    aside,
    check_groups_and_resamples,
    elements,
    figures,
    sample_set,
)

from gsmap.evaluation.core.chamfer_ap import ChamferConfig, HardChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.metric import MetricSettings
from gsmap.evaluation.core.raster_ap import NUSCENES_GRID
from gsmap.evaluation.map_metric import MapMetric
from gsmap.models.vectormapnet.metric import ShrunkVectorMapNetAP, VectorMapNetAP

TWO_SIDED_NAME, SHRUNK_NAME = VectorMapNetAP.name, ShrunkVectorMapNetAP.name
SHRUNK = ShrunkVectorMapNetAP(CLASSES, grid=NUSCENES_GRID)
TWO_SIDED = MapEvaluator(CHAMFER, VectorMapNetAP(CLASSES))


def test_groups_and_resamples_are_files_of_their_samples():
    check_groups_and_resamples(MapEvaluator(*TWO_SIDED.metrics, *DRAWN.metrics))


def test_vectormapnets_rule_leaves_out_samples_without_either_side():
    samples = [sample[1:] for sample in sample_set()]
    hard = HardChamferConfig.from_settings(MetricSettings(CLASSES))
    metrics = figures(*samples, evaluator=MapEvaluator(*TWO_SIDED.metrics, hard))
    kept = [sample for sample in samples if len(sample[0]) and len(sample[1])]
    assert len(kept) == len(samples) - 3
    rest, everything = (figures(*some, evaluator=MapEvaluator(CHAMFER)) for some in (kept, samples))
    for key, value in rest.items():
        if not key.endswith("num_samples"):
            assert metrics[key.replace("chamfer", TWO_SIDED_NAME)] == pytest.approx(value), key
    assert everything.items() <= metrics.items()
    assert metrics["vectormapnet/mAP"] > metrics["chamfer/mAP"]
    loose = MapEvaluator(ChamferConfig(CLASSES, (3.0,)), VectorMapNetAP(CLASSES))
    assert figures(*samples, evaluator=loose)["vectormapnet/mAP"] == metrics["vectormapnet/mAP"]


def test_vectormapnets_units_shrink_a_map_as_much_as_its_canvas_is_larger():
    """0.52 m across a map of 30 m are 0.4875 m there, 0.52 m along one of 60 m 0.503 m."""
    both = MapEvaluator(*TWO_SIDED.metrics, SHRUNK)
    along = elements([UPRIGHT[:, ::-1]])
    samples = [
        (elements(aside(0.52), [0.9]), TRUTH),
        (
            elements([UPRIGHT[:, ::-1] + [0.0, 0.52]], [0.8], 1),
            replace(along, labels=along.labels + 1),
        ),
        (NOTHING, TRUTH),  # left out
    ]
    metrics = figures(*samples, evaluator=both)
    names = CLASSES[:2]
    assert [metrics[f"{SHRUNK_NAME}/{name}/AP@0.5"] for name in names] == [1, 0]
    assert [metrics[f"{SHRUNK_NAME}/{name}/AP@1.0"] for name in names] == [1, 1]
    assert [metrics[f"{TWO_SIDED_NAME}/{name}/AP@0.5"] for name in names] == [0, 0]
    rest = {key: value for key, value in metrics.items() if not key.startswith(SHRUNK_NAME)}
    assert rest == figures(*samples, evaluator=TWO_SIDED)
    samples = [sample[1:] for sample in sample_set()]
    factors = np.array([30 / 32, 60 / 62])
    scaled = [[replace(e, points=e.points * factors) for e in sample] for sample in samples]
    found, wanted = figures(*samples, evaluator=both), figures(*scaled, evaluator=TWO_SIDED)
    keys = [key for key in found if key.startswith(f"{SHRUNK_NAME}/")]
    for key in keys:
        assert found[key] == wanted[key.replace(SHRUNK_NAME, TWO_SIDED_NAME)], key
    assert len(keys) > 10


def test_a_config_names_the_metric():
    metric = MapMetric(eval=[SHRUNK_NAME])
    metric.dataset_meta = {"classes": CLASSES, "x_range": (-15, 15), "y_range": (-30, 30)}
    assert metric.evaluator == MapEvaluator(CHAMFER, SHRUNK)
