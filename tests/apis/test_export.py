"""Exported models in ONNX Runtime: the same map elements as in torch."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gsmap.apis.export import (
    ExportedDetector,
    export_onnx,
    graph_inputs,
    largest_differences,
    quantize_onnx,
)
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.datasets.elements import elements_of_predictions
from gsmap.evaluation.results_json import vectors_of

for _package in ("onnx", "onnxscript", "onnxruntime"):
    pytest.importorskip(_package, reason=f"{_package} is not installed: pip install -e .[onnx]")

REPO = Path(__file__).resolve().parents[2]
GSMAP = "projects/GSMap/configs/gsmap_maptr_r18_minicity.py"
MAPTR = "configs/maptr/maptr_r18_minicity.py"
DEFORMABLE = {"type": "SpatialCrossAttention", "num_heads": 4, "num_points": 8, "num_heights": 4}
LSS = {
    "type": "LSSEncoder",
    "_delete_": True,
    "bev_pixel_m": 1.2,
    "embed_dims": 128,
    "camera_aware": False,
}
# method and encoder: config and overrides; heads see no more of an encoder than its features
CASES = {
    "MapTR, GKT": (MAPTR, {}),
    "MapTR, BEVFormer": (
        MAPTR,
        {"model.bev_encoder.cross_attn": {"_delete_": True, **DEFORMABLE}},
    ),
    "MapTR, LSS": (MAPTR, {"model.bev_encoder": LSS}),
    "MapTRv2": ("configs/maptrv2/maptrv2_r18_minicity.py", {}),
    "MapVR": ("configs/mapvr/mapvr_r18_minicity.py", {}),
    "GeMap": ("configs/gemap/gemap_r18_minicity.py", {}),
    "MGMapNet": ("configs/mgmapnet/mgmapnet_r18_minicity.py", {}),
    "GSMap, heights": (
        GSMAP,
        {"model.map_head.reference": {"coords": 3, "z_range": (-5.0, 3.0)}},
    ),
    "GSMap on MGMapNet": ("projects/GSMap/configs/gsmap_mgmapnet_r18_minicity.py", {}),
}
POINTS_M, SCORES = 1e-3, 1e-4  # float32 sums in another order


@pytest.fixture(scope="module")
def annotations(minicity_annotations):
    return minicity_annotations["val"]


def build(config, overrides, annotations, checkpoint=None):
    """Build a model, and its data set of real images; every query and class is found."""
    options = {"model.map_head.coder.margin_m": None, "model.map_head.coder.max_num": 200}
    inferencer = MapInferencer(REPO / config, checkpoint, "cpu", {**options, **overrides})
    return inferencer, inferencer.dataset(annotations, annotations.parent)


def export(inferencer, dataset, path, **options):
    cameras = inferencer.cfg.test_dataloader.dataset.cameras
    size = tuple(dataset[0]["inputs"]["img"].shape[-2:])
    export_onnx(inferencer.model, path, cameras, size, **options)
    return OnnxInferencer(path, num_threads=1)


def compare(inferencer, dataset, exported, indices=(0, 1)):
    """Return the largest differences of scores and metres, and the elements of the last sample."""
    in_torch = inferencer.predict(dataset, indices)
    differences = []
    for sample, (_, inputs) in zip(
        in_torch, graph_inputs(exported, dataset, indices), strict=True
    ):
        expected = elements_of_predictions(sample.pred_instances_3d)
        found = exported.elements(exported.run(inputs))
        differences.append(largest_differences(found, expected))
    return np.max(differences, 0), found, expected


def shake(model, seed=0):
    """Let no weight be neutral: random ones say more."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.data += 0.03 * torch.randn(parameter.shape, generator=generator)


@pytest.fixture(scope="module")
def shipped(annotations, tmp_path_factory):
    """The shipped GSMap as it predicts: in torch, its data set, and in ONNX Runtime."""
    checkpoint = REPO / "models/gsmap_r18_minicity.pth"
    inferencer = MapInferencer(REPO / GSMAP, checkpoint, "cpu")
    dataset = inferencer.dataset(annotations, annotations.parent)
    path = tmp_path_factory.mktemp("onnx") / "gsmap.onnx"
    return inferencer, dataset, export(inferencer, dataset, path)


@pytest.mark.parametrize("case", CASES)
def test_every_method_and_encoder_predicts_as_in_torch(case, annotations, tmp_path):
    inferencer, dataset = build(*CASES[case], annotations)
    shake(inferencer.model)
    exported = export(inferencer, dataset, tmp_path / "model.onnx")
    (scores, metres), found, expected = compare(inferencer, dataset, exported)
    assert len(found) == len(expected) > 50
    assert scores < SCORES
    assert metres < POINTS_M
    assert found.has_gaussians == ("GSMap" in case)


def test_the_shipped_model_predicts_as_in_torch(shipped):
    (scores, metres), found, expected = compare(*shipped)
    assert scores < SCORES
    assert metres < POINTS_M
    np.testing.assert_allclose(found.scales, expected.scales, atol=1e-3)
    np.testing.assert_allclose(found.rotations, expected.rotations, atol=1e-3)
    names = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT")
    assert shipped[2].cameras[:3] == names
    assert shipped[2].metadata["score_threshold"] is None


def test_files_hold_standard_operators_and_no_word_of_the_machine(shipped):
    import onnx

    model = onnx.load(shipped[2].path)
    assert {node.domain for node in model.graph.node} == {""}
    assert not model.functions
    assert str(REPO).encode() not in Path(shipped[2].path).read_bytes()


def test_the_runner_needs_numpy_and_onnxruntime_alone(shipped, tmp_path):
    """A process without torch and OpenMMLab writes the records that torch's way writes."""
    inferencer, dataset, exported = shipped
    packed = dataset[0]
    images = packed["inputs"]["img"].permute(0, 2, 3, 1).numpy()
    np.savez(tmp_path / "in.npz", images=images, lidar2img=packed["data_samples"].lidar2img)
    script = """
import sys
import numpy as np
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.evaluation.results_json import write_results
data = np.load("in.npz")
model = OnnxInferencer(sys.argv[1])
elements = model(list(data["images"]), {"lidar2img": data["lidar2img"]})
write_results("out.json", [model.record("a", elements)])
others = {"torch", "mmengine", "mmcv", "mmdet", "mmdet3d", "cv2", "onnx", "pyarrow", "shapely"}
print(sorted(others & set(sys.modules)))
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(exported.path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
