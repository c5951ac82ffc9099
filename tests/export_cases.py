"""Models in torch beside their exported files."""

import fcntl
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from mmengine.dataset import pseudo_collate
from model_cases import IMAGE_SHAPE, NUM_CAMS, build_small

from gsmap.apis.export import export_onnx, graph_inputs, largest_differences
from gsmap.apis.fast_frame import FastFrames, StaticFrame
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.datasets.elements import elements_of_predictions

SMALL = {  # of ResNet-18, whose whole is exported with the shipped weights, the first stage
    "model.img_backbone.num_stages": 1,
    "model.img_backbone.strides": (1,),
    "model.img_backbone.dilations": (1,),
    "model.img_backbone.out_indices": (0,),
    "model.img_neck.in_channels": [24],
    "model.img_neck.out_channels": [128],
    "model.img_neck.upsample_strides": [0.5],
    "model.map_head.coder.margin_m": None,  # every query and class is found
    "model.map_head.coder.max_num": 200,
}
POINTS_M, SCORES = 1e-3, 1e-4  # float32 sums in another order


def export(inferencer, dataset, path):
    cameras = inferencer.cfg.test_dataloader.dataset.cameras
    size = tuple(dataset[0]["inputs"]["img"].shape[-2:])
    export_onnx(inferencer.model, path, cameras, size)
    return OnnxInferencer(path, num_threads=1)


def export_once(factory: pytest.TempPathFactory, name: str, **overrides: object) -> Path:
    """Export the tiny model once for all processes of a test run.

    Args:
        factory: pytest's factory of temporary folders.
        name: Name of the file.
        **overrides: Parts of the model's config, as in `build_small`.

    Returns:
        The file, which no test may change. Its cameras are ``CAM_0`` to ``CAM_5``.
    """
    folder = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # of all workers
    path = folder / name
    with (folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            model = build_small(**overrides).eval()
            cameras = [f"CAM_{number}" for number in range(NUM_CAMS)]
            export_onnx(model, path, cameras, IMAGE_SHAPE)
    return path


def compare(inferencer, dataset, exported, indices=(0, 1)):
    """Return the largest differences of scores and metres, and the elements of the last sample."""
    in_torch = inferencer.predict(dataset, indices)
    differences = []
    for sample, (_, inputs) in zip(in_torch, graph_inputs(exported, dataset, indices), strict=True):
        expected = elements_of_predictions(sample.pred_instances_3d)
        found = exported.elements(exported.run(inputs))
        unfolded = exported.metadata.get("unfold_classes", [])
        differences.append(largest_differences(found, expected, unfolded))
    return np.max(differences, 0), found, expected


def shake(model, seed=0):
    """Let no weight be neutral: random ones say more."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.data += 0.03 * torch.randn(parameter.shape, generator=generator)


def assert_static_frames_are_equal(inferencer, dataset, indices=(0, 1)):
    """Predict a batch as a function of fixed sizes, and compare all that is said of its samples."""
    expected = inferencer.model.test_step(pseudo_collate([dataset[index] for index in indices]))
    frames = FastFrames(StaticFrame(inferencer.model), torch.device("cpu"), capture=False)
    batch = pseudo_collate([dataset[index] for index in indices])
    assert frames.serves(batch)
    for ours, theirs in zip(frames(batch), expected, strict=True):
        assert ours.metainfo.keys() == theirs.metainfo.keys()
        for name in ("batch_input_shape", "pad_shape", "token"):
            assert ours.metainfo[name] == theirs.metainfo[name]
        found, wanted = ours.pred_instances_3d, theirs.pred_instances_3d
        assert found.metainfo == wanted.metainfo
        assert sorted(found.keys()) == sorted(wanted.keys())
        assert len(found) == len(wanted) > 0
        for name, values in wanted.items():
            assert found[name].dtype == values.dtype
            torch.testing.assert_close(found[name], values, atol=2 * POINTS_M, rtol=1e-4)
