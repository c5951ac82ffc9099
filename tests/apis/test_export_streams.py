"""Exported models with memory: one step of a stream, as in torch, by the rules of streams."""

import numpy as np
import pytest
import torch
from export_cases import POINTS_M, SCORES, SMALL, compare, export, shake
from method_cases import cases_of_methods
from model_cases import IMAGE_SHAPE, NUM_CAMS, build_small
from processes import REPO

from gsmap.apis.export import ExportedDetector, largest_differences
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.datasets.elements import elements_of_predictions
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from minicity.generate import generate

for _package in ("onnx", "onnxscript", "onnxruntime"):
    pytest.importorskip(_package, reason=f"{_package} is not installed: pip install -e .[onnx]")

STREAMS = {
    **cases_of_methods("STREAM_EXPORTS"),
    "GSMap": ("projects/GSMap/configs/gsmap_stream_r18_minicity.py", {}),
    "GSMap, small state": (
        "projects/GSMap/configs/gsmap_stream_r18_minicity.py",
        {
            "model.temporal.half": True,
            "model.temporal.bev.kept_dims": 32,
            "model.temporal.queries.covariance": "fused",
        },
    ),
}


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Annotations of two scenes of two samples."""
    root = tmp_path_factory.mktemp("drives") / "root"
    generate(root, 3, 0, (400, 225), samples_per_scene=2, val_scenes=2, workers=1)
    convert_nuscenes(NuScenesOptions(root, "v1.0-trainval", dataset="minicity"))
    return root / "gsmap_minicity_val.arrow"


@pytest.mark.parametrize("case", STREAMS)
def test_a_stream_runs_step_by_step_as_in_torch(case, drives, tmp_path):
    """Two frames of a scene and two of another: with the memory of each, none of the other."""
    config, overrides = STREAMS[case]
    inferencer = MapInferencer(REPO / config, None, "cpu", {**SMALL, **overrides})
    dataset = inferencer.dataset(drives, drives.parent)
    shake(inferencer.model)
    exported = export(inferencer, dataset, tmp_path / "model.onnx")
    first, second = (scene[:2] for scene in dataset.scenes()[:2])
    (scores, metres), found, expected = compare(inferencer, dataset, exported, [*first, *second])
    half = 0.05 if "small" in case else 1.0  # float16 can round the other way
    assert len(found) == len(expected) > 10
    assert scores * half < SCORES
    assert metres * half < POINTS_M
    alone = next(inferencer.predict(dataset, [second[1]]))
    forgetful = elements_of_predictions(alone.pred_instances_3d)
    assert largest_differences(found, forgetful)[1] > 10 * POINTS_M  # the memory counts


@pytest.fixture(scope="module")
def with_memory(stream_onnx):
    """A small model with memory, of its file."""
    return OnnxInferencer(stream_onnx, num_threads=1)


def frame_of(number: int, scene: str = "a", **changes) -> dict:
    """Return the calibration and the place of a sample, 2 m after the one before."""
    pose = np.eye(4)
    pose[1, 3] = 2.0 * number
    at = {"scene": scene, "timestamp_ns": number * 500_000_000, "lidar2global": pose}
    matrices = np.stack([np.eye(4)] * NUM_CAMS)
    return {
        "token": f"{scene}{number}",
        "lidar2img": matrices,
        "can_bus": np.zeros(18),
        **at,
        **changes,
    }


def test_the_state_is_one_flat_set_of_inputs_and_outputs(with_memory):
    inputs, outputs = (
        {value.name: (value.shape, value.type) for value in values}
        for values in (with_memory.session.get_inputs(), with_memory.session.get_outputs())
    )
    names = ["bev_feats", "queries_0", "queries_1", "references"]
    assert [n.removeprefix("memory_") for n in inputs if n.startswith("memory_")] == names
    for name in names:
        assert inputs[f"memory_{name}"] == outputs[f"new_memory_{name}"]
    assert with_memory.metadata["max_gap_s"] == 2.0


def test_every_example_of_inputs_has_the_memory():
    model = build_small(temporal={"bev": {}, "queries": {"num": 3}, "embed_dims": 16}).eval()
    exported = ExportedDetector(model).eval()
    first = exported.example_inputs(NUM_CAMS, image_size=IMAGE_SHAPE)
    names = exported.input_names, exported.output_names
    second = exported.example_inputs(NUM_CAMS, image_size=IMAGE_SHAPE)
    assert (exported.input_names, exported.output_names) == names
    assert len(first) == len(names[0])
    torch.testing.assert_close(second, first)
    assert len(exported(*second)) == len(names[1])


def test_a_stream_of_a_file_follows_the_rules_of_streams(with_memory):
    images = np.zeros((NUM_CAMS, *IMAGE_SHAPE, 3), np.uint8)
    stream = with_memory.new_stream()
    first = with_memory(images, frame_of(0), stream)
    second = with_memory(images, frame_of(1), stream)
    assert not np.allclose(first.scores, second.scores, atol=1e-6)
    after_a_gap = with_memory(images, frame_of(9), stream)
    np.testing.assert_array_equal(after_a_gap.scores, first.scores)
    with pytest.raises(ValueError, match=r"'a9' .* comes twice: its stream is at 'a9'"):
        with_memory(images, frame_of(9), stream)
    with pytest.raises(ValueError, match=r"'b10' .* another scene than 'a9'"):
        with_memory(images, frame_of(10, "b"), stream)
    with pytest.raises(ValueError, match=r"stream\.onnx remembers .* new_stream\(\) starts"):
        with_memory(images, frame_of(10))
    with pytest.raises(ValueError, match=r"has no \['scene'\] in its metainfo"):
        with_memory(images, frame_of(10, scene=None), stream)
    other = OnnxInferencer(with_memory.path)
    with pytest.raises(ValueError, match=r"belongs to .*stream\.onnx, and .* start a new stream"):
        other(images, frame_of(10), stream)
