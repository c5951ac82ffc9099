"""BeMapNet's AP: its rules, its canvas and its name."""

from golden_data import CLASSES

from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.metric import metric_names
from gsmap.evaluation.core.raster_ap import NUSCENES_GRID
from gsmap.evaluation.map_metric import MapMetric
from gsmap.models.bemapnet.metric import BeMapNetAP
from gsmap.structures.grid import BEVGrid


def test_the_rules_are_those_of_the_released_evaluator():
    metric = BeMapNetAP(CLASSES, NUSCENES_GRID)
    assert metric.line_px == 1
    assert metric.report_thresholds == {
        "bemapnet": (0.5, 1.0, 1.5),
        "bemapnet_hard": (0.2, 0.5, 1.0),
    }
    assert metric.size_px == (200, 400)


def test_any_canvas_and_the_metric_of_a_config():
    wide = BeMapNetAP(CLASSES, BEVGrid((-50.0, 50.0), (-25.1, 25.0)))
    assert wide.size_px == (667, 334)
    metric = MapMetric(eval=["bemapnet"])
    metric.dataset_meta = {"classes": CLASSES, "x_range": (-15, 15), "y_range": (-30, 30)}
    assert metric.evaluator == MapEvaluator(BeMapNetAP(CLASSES, NUSCENES_GRID))
    assert "bemapnet" in metric_names()
