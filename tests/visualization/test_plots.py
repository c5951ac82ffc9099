"""Curves of results: classes and runs in the colours of all pictures."""

import numpy as np
import pytest
from comparison.run_curves import plot_precision_recall

from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.visualization.plots import plot_result
from gsmap.visualization.style import CLASS_COLOURS, RUN_COLOURS

CLASSES = ("boundary", "divider")


@pytest.fixture(scope="module")
def reports():
    """One sample: a boundary that is found, and a divider 0.7 m beside the annotated one."""
    ahead = np.linspace(-20, 20, 11)
    truth = [np.c_[np.full(11, x), ahead] for x in (-6.0, 0.0)]
    found = [truth[0], truth[1] + [0.7, 0]]
    grid = BEVGrid((-15.0, 15.0), (-30.0, 30.0))
    evaluator = MapEvaluator(ChamferConfig(CLASSES), RasterConfig(CLASSES, grid))
    matches = evaluator.match(
        "t", MapElements.from_polylines(found, [0, 1], [0.9, 0.8]),
        MapElements.from_polylines(truth, [0, 1]),
    )  # fmt: skip
    return evaluator.reports([matches])


def test_curves_of_a_result_have_the_colours_of_its_classes(reports):
    boundary, divider, calibration, *_ = plot_result(reports).axes
    for panel, name in ((boundary, "boundary"), (divider, "divider")):
        assert {line.get_color() for line in panel.lines} == {CLASS_COLOURS[name]}
    assert [line.get_label() for line in divider.lines] == ["0.5: 0.0", "1: 100.0", "1.5: 100.0"]
    assert [line.get_color() for line in calibration.lines[1:]] == [
        CLASS_COLOURS[name] for name in CLASSES
    ]


def test_curves_of_several_results_have_the_colours_of_runs(reports):
    figure = plot_precision_recall({"MapTR": reports, "GSMap": reports})
    assert [line.get_color() for line in figure.axes[0].lines] == list(RUN_COLOURS[:2])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["MapTR", "GSMap"]
    assert figure.axes[1].get_title(loc="left") == "divider, 1 m"
