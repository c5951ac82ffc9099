"""HDMapNet's AP: its rules and its name."""

from golden_data import CLASSES

from gsmap.evaluation.core.metric import metric_names
from gsmap.evaluation.core.raster_ap import NUSCENES_GRID
from gsmap.models.hdmapnet.metric import HDMapNetAP


def test_the_rules_are_those_of_the_released_evaluator():
    metric = HDMapNetAP(CLASSES, NUSCENES_GRID)
    assert metric.line_px == 5
    assert metric.report_thresholds == {"hdmapnet": (2.0, 4.0, 6.0)}
    assert metric.size_px == (200, 400)
    assert "hdmapnet" in metric_names()
