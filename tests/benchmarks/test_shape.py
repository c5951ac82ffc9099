"""The shape of predicted lines: what neither metric sees."""

from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import shape
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.core.file_evaluation import read_ground_truth
from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.structures.elements import MapElements
from gsmap.structures.polylines import resample

STRAIGHT = np.stack([np.zeros(5), np.linspace(0, 8, 5)], -1)
FOLDED = STRAIGHT[[0, 2, 1, 3, 4]]


def test_turns_of_a_straight_and_of_a_folded_line():
    """Points at 0, 4, 2, 6, 8 m: two of three vertices lead back."""
    assert shape.turns(STRAIGHT) == (0.0, 0.0)
    assert shape.turns(STRAIGHT[:2]) == (0.0, 0.0)
    assert shape.turns(FOLDED) == pytest.approx((120.0, 2 / 3))
    assert shape.length_m(FOLDED) == pytest.approx(4 + 2 + 4 + 2)


def test_folded_predictions_still_match_and_are_told_apart(minicity_annotations, tmp_path, capsys):
    """The ground truth as prediction, then with every second of its points in exchanged places."""
    path = minicity_annotations["val"]
    classes = AnnotationFile(path).meta.classes
    truth, _ = read_ground_truth(path, classes)

    def results(name: str, order: list[int]) -> Path:
        (tmp_path / name).mkdir()
        samples = {}
        for token, elements in truth.items():
            lines = [resample(line, 20)[order] for line in elements.polylines]
            found = MapElements.from_polylines(lines, elements.labels, np.ones(len(lines)))
            samples[token] = vectors_of(found, classes)
        write_results(tmp_path / name / "results.json", samples.items(), {"classes": list(classes)})
        return tmp_path / name / "results.json"

    same = results("same", list(range(20)))
    folded = results("folded", [0, *(i + 1 - 2 * (i % 2 == 0) for i in range(1, 19)), 19])
    shape.run(Namespace(truth=path, results=[same, folded]))
    table = capsys.readouterr().out
    assert "ped_crossing" not in table
    as_is, turned = (shape.line_shapes(file, path)["boundary"] for file in (same, folded))
    assert len(as_is) == len(turned) > 0
    np.testing.assert_allclose(as_is[:, 0], 1, atol=0.05)  # corners are cut by the resampling
    assert turned[:, 0].min() > 1.5
    assert turned[:, 2].min() > as_is[:, 2].max()
