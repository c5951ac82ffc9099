"""Compact result files: every figure within the error, nothing lost but Gaussians."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from gsmap.evaluation.core.results_json import RESULTS_KEY, read_samples, write_results
from gsmap.utils.inputs import InputReplacedError

REPO = Path(__file__).resolve().parents[2]
CLASSES = ("divider", "boundary")


def command():
    spec = importlib.util.spec_from_file_location("compact", REPO / "tools/compact_results.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def vector(points: np.ndarray, **more) -> dict:
    return {
        "pts": points.tolist(), "pts_num": len(points), "cls_name": "boundary", "type": 7,
        "confidence_level": 0.25, **more,
    }  # fmt: skip


@pytest.fixture
def results(tmp_path):
    angle = np.linspace(0, 2, 30)
    bend = 15 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    gaussians = {"gaussian_scales": [[1, 1]] * 30, "gaussian_rotations": [0] * 30}
    path = tmp_path / "results.json"
    write_results(
        path,
        [("a", [vector(bend, track_id=3, **gaussians), vector(bend[:1])]), ("b", [])],
        {"use_camera": True},
    )
    return path


def test_curves_are_read_as_lines_within_the_error(results, tmp_path):
    out = tmp_path / "compact.json"
    said = command()([str(results), str(out), "--max-error", "0.05"])
    assert said.startswith("1 element, 30 points as ")
    before, _ = read_samples(results, RESULTS_KEY, CLASSES)
    after, _ = read_samples(out, RESULTS_KEY, CLASSES)
    assert list(after) == ["a", "b"]
    assert after["a"].labels.tolist() == [1, 1]
    assert after["a"].scores.tolist() == [0.25, 0.25]
    line, curve = before["a"].polylines[0], after["a"].polylines[0]
    assert shapely.hausdorff_distance(*map(shapely.linestrings, (line, curve))) < 0.05
    np.testing.assert_array_equal(after["a"].polylines[1], before["a"].polylines[1])
    content = json.loads(out.read_text())
    assert content["meta"] == {"use_camera": True, "bezier_max_error_m": 0.05}
    kept = content["results"][0]["vectors"][0]
    assert kept["track_id"] == 3
    assert kept["type"] == 7
    assert set(kept) == {"cls_name", "type", "confidence_level", "track_id", "bezier"}
    assert len(kept["bezier"]["pts"]) < 12
    again = tmp_path / "again.json"  # a compact file can be made compact
    command()([str(out), str(again), "--max-error", "0.05"])
    assert json.loads(again.read_text())["results"][0]["vectors"][0]["bezier"]["degree"] == 3


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        ({"degree": 3, "pts": [[0, 0], [1, 1]]}, "3 control points each"),
        ({"degree": 10**9, "pts": [[0, 0], [1, 1]]}, "must be 1 to 5"),
        ({"degree": 1.5, "pts": [[0, 0], [1, 1]]}, "is no whole number"),
        ({"degree": 1, "pts": [[0, 0], [1, float("nan")]]}, "not finite"),
        ({"degree": 1}, "pts"),
        ({"pts": [[0, 0]]}, "degree"),
    ],
)
def test_a_bad_curve_is_an_error_that_names_the_sample(curve, message, tmp_path):
    path = tmp_path / "bad.json"
    bad = {"cls_name": "divider", "confidence_level": 0.5, "bezier": curve}
    write_results(path, [("sample-1", [bad])])
    with pytest.raises(ValueError, match=f"sample-1.*{message}"):
        read_samples(path, RESULTS_KEY, CLASSES)


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--max-error", "0.001"], "more than 0.001 m"), (["--degree", "6"], "must be 1 to 5")],
)
def test_settings_out_of_range_are_refused_and_nothing_is_written(
    options, message, results, tmp_path
):
    out = tmp_path / "compact.json"
    with pytest.raises(ValueError, match=message):
        command()([str(results), str(out), *options])
    assert not out.exists()


def test_the_results_are_not_replaced(results):
    with pytest.raises(InputReplacedError, match="would replace what this command reads"):
        command()([str(results), str(results)])
