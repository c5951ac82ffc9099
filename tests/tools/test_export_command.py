"""Which samples tools/export.py compares on, and how it reports the differences."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from tools import export as tool


class Drives:
    """Samples of drives of 20 frames, which lie frame by frame."""

    def __init__(self, scenes: int):
        self.num_scenes = scenes
        tokens = [f"t{index}" for index in range(20 * scenes)]
        self.annotations = SimpleNamespace(column=lambda _: tokens)

    def scenes(self) -> list[list[int]]:
        """Indices of each drive, in the order of their times."""
        return [[s + self.num_scenes * i for i in range(20)] for s in range(self.num_scenes)]


def model_with(temporal):
    return SimpleNamespace(model=SimpleNamespace(temporal=temporal, prior=None))


@pytest.mark.parametrize(
    ("count", "lengths"), [(1, [1]), (5, [4, 1]), (8, [4, 4]), (24, [8, 8, 8]), (99, [20, 20, 20])]
)
def test_a_model_with_memory_is_compared_on_samples_in_a_row(count, lengths):
    chosen = tool.choose_samples(model_with(object()), Drives(3), count)
    runs = {}
    for index in chosen:
        runs.setdefault(index % 3, []).append(index // 3)
    assert list(runs.values()) == [list(range(length)) for length in lengths]


@pytest.mark.parametrize(("lengths", "count"), [([1] * 100, 10), ([3, 40], 10), ([2, 1], 9)])
def test_as_many_samples_are_compared_where_scenes_are_short(lengths, count):
    starts = np.cumsum([0, *lengths])
    scenes = [list(range(*pair)) for pair in itertools.pairwise(starts)]
    samples = SimpleNamespace(scenes=lambda: scenes)
    chosen = tool.choose_samples(model_with(object()), samples, count)
    assert len(chosen) == len(set(chosen)) == min(count, sum(lengths))


def test_other_models_are_compared_on_samples_far_apart():
    assert tool.choose_samples(model_with(None), Drives(3), 3) == [0, 30, 59]
    for temporal in (None, object()):
        with pytest.raises(ValueError, match="must be >= 1, got"):
            tool.choose_samples(model_with(temporal), Drives(3), -1)


def test_steps_of_images_that_a_file_does_not_have_are_noted():
    load, pack = {"type": "LoadCameraImages"}, {"type": "PackMapInputs"}
    for scale in ({"scale": 0.5}, {"size": (8, 6)}, {"size": (8, 6), "kernel": "bilinear"}):
        assert tool.image_notes([load, {"type": "ScaleImages", **scale}, pack]) == []
    scale = {"type": "ScaleImages", "size": (896, 512), "kernel": "bicubic"}
    crop = {"type": "mmdet3d.CropImages", "top": 128}
    first, second = tool.image_notes([load, scale, crop, pack])
    assert "also changed by ScaleImages(size=(896, 512), kernel=bicubic), which is not" in first
    assert "also changed by CropImages(top=128), which is not in the file: chan" in second


def report_of(differences, monkeypatch, continues=None, fp16=False) -> str:
    """Report of a comparison with these differences of scores and metres, one for each sample."""
    samples = [SimpleNamespace(pred_instances_3d=None) for _ in differences]
    inputs = [("t", {"continues": np.array([c])}) for c in continues or [0.0] * len(differences)]
    remaining = iter(differences)
    monkeypatch.setattr(tool, "open_samples", lambda *_, **__: Drives(1))
    monkeypatch.setattr(tool, "graph_inputs", lambda *_: inputs)
    monkeypatch.setattr(tool, "largest_differences", lambda *_: next(remaining))
    monkeypatch.setattr(tool, "elements_of_predictions", lambda _: None)
    inferencer = model_with(None)
    inferencer.predict = lambda *_: samples
    exported = SimpleNamespace(
        metadata={}, has_memory=continues is not None, run=lambda _: {}, elements=lambda _: None
    )
    args = SimpleNamespace(
        samples=None, check=len(samples), results=None, fp16=fp16, int8=False, out="m.onnx"
    )
    return tool.check(inferencer, exported, args)


def test_the_largest_differences_of_equal_samples_are_reported(monkeypatch):
    text = report_of([(1e-6, 2e-5), (np.inf, np.inf), (3e-6, 1e-5)], monkeypatch)
    assert text.startswith("in 2 of 3 samples, ONNX Runtime and torch predict equal numbers")
    assert text.endswith("differ by at most 3.0e-06, and nearest elements by at most 2.0e-05 m")


def test_samples_that_all_differ_are_an_error_in_single_precision(monkeypatch):
    differences = [(np.inf, np.inf)] * 3
    with pytest.raises(RuntimeError, match=r"in 0 of 3 .* each class: do not use m.onnx"):
        report_of(differences, monkeypatch)
    # Rounding can change the elements of a few samples, and of a file in half precision.
    for number, half in ((3, True), (2, False)):
        text = report_of(differences[:number], monkeypatch, fp16=half)
        assert text.startswith(f"in 0 of {number} samples")
        assert text.endswith("equal numbers of elements of each class")


def test_a_comparison_says_whether_the_memory_counted(monkeypatch):
    pairs = [(0.0, 0.0)] * 3
    text = report_of(pairs, monkeypatch, continues=[0.0, 1.0, 1.0])
    assert text.endswith("m; 2 of the samples continue a stream")
    text = report_of(pairs, monkeypatch, continues=[0.0, 0.0, 0.0])
    assert "0 of the samples continue a stream, so the memory was not compared: give" in text
