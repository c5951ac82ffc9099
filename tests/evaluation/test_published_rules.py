"""The rules of the metrics against those that papers print."""

import pytest

from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.raster_ap import MIN_SCORE, RasterConfig


def test_the_metrics_have_their_published_rules():
    classes = ("divider", "ped_crossing", "boundary")
    chamfer, raster = ChamferConfig(classes), RasterConfig(classes)
    assert (chamfer.thresholds, chamfer.num_points) == ((0.5, 1.0, 1.5), 100)
    assert (raster.size_px, raster.dilation_px, MIN_SCORE) == ((240, 480), 5, 0.05)
    lines, polygons = raster.thresholds["divider"], raster.thresholds["ped_crossing"]
    assert lines == pytest.approx((0.25, 0.3, 0.35, 0.4, 0.45, 0.5))
    assert polygons == pytest.approx((0.5, 0.55, 0.6, 0.65, 0.7, 0.75))
