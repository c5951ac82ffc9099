"""Frames of fixed sizes, half precision and CUDA graphs; test_export.py compares every method."""

import copy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from inferencer_cases import NAMES, make_config, make_remembering, make_samples
from mmdet.models.backbones import ResNet
from mmengine.dataset import pseudo_collate

from gsmap.apis.fast_frame import FastFrames, StaticFrame, _Recording, reason_against
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.models.encoders.folded_backbone import FoldedBackbone
from gsmap.models.encoders.fused_resnet import convolve_folded, fused_resnet
from gsmap.structures.tensors import matrix_products, tensor_versions

REPO = Path(__file__).resolve().parents[2]
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def batch_of(inferencer, folder, count=1):
    dataset = inferencer.dataset(make_samples(folder, count), folder)
    return pseudo_collate([dataset[index] for index in range(count)])


def test_models_without_a_static_form_are_named(inferencer):
    assert reason_against(inferencer.model) == ""
    remembering = make_remembering().model
    assert "remembers earlier frames" in reason_against(remembering)
    with pytest.raises(ValueError, match=r"no static form: it remembers earlier frames"):
        StaticFrame(remembering)
    with pytest.raises(ValueError, match="cuda_graphs=True needs a GPU, got cpu"):
        MapInferencer(make_config(), None, device="cpu", cuda_graphs=True)


def test_batches_of_other_inputs_are_left_to_the_model(inferencer, tmp_path):
    frames = FastFrames(StaticFrame(inferencer.model), torch.device("cpu"), capture=False)
    batch = batch_of(inferencer, tmp_path, 2)
    assert frames.serves(batch)
    images = batch["inputs"]["img"]
    assert not frames.serves({"inputs": {"img": [images[0], images[1][..., :-4]]}})
    assert not frames.serves({"inputs": {"img": images, "points": []}})


def test_a_missing_field_of_a_sample_is_named(inferencer, tmp_path):
    frames = FastFrames(StaticFrame(inferencer.model), torch.device("cpu"), capture=False)
    batch = batch_of(inferencer, tmp_path)
    batch["data_samples"][0].set_metainfo({"lidar2img": None})
    with pytest.raises(ValueError, match="has no 'lidar2img' in its metainfo"):
        frames(batch)


def test_a_recording_is_made_again_after_a_training(inferencer, tmp_path, monkeypatch):
    """Its graph reads copies of the backbone, which a training deletes."""
    model = copy.deepcopy(inferencer.model)
    frames = FastFrames(StaticFrame(model), torch.device("cpu"))
    recorded = []

    def record(self, key, inputs):
        recorded.append(key)
        self._graphs[key] = _Recording(
            graph=SimpleNamespace(replay=lambda: None),
            inputs=[tensor.clone() for tensor in inputs],
            output=self.frame(*inputs),
            versions=tensor_versions(model),
            copies=model.backbone_copies(),
        )
        return self._graphs[key]

    monkeypatch.setattr(FastFrames, "_record", record)
    batch = batch_of(inferencer, tmp_path)
    for number in (1, 2):
        for _ in range(2):
            frames(copy.deepcopy(batch))
        assert len(recorded) == number
        model.train()
        model.eval()


def test_matrix_products_are_in_tf32_for_a_while():
    before = torch.get_float32_matmul_precision()
    with matrix_products(in_tf32=True):
        assert torch.get_float32_matmul_precision() == "high"
    assert torch.get_float32_matmul_precision() == before
    with matrix_products(in_tf32=False):
        assert torch.get_float32_matmul_precision() == before


@torch.no_grad()
def test_half_precision_keeps_three_digits_and_follows_the_weights():
    torch.manual_seed(0)
    model = MapInferencer("gsmap_r18_minicity", device="cpu").model
    images = torch.randn(1, 2, 3, 64, 96)
    exact = model.extract_img_feats(images)
    model.halve_backbone()
    rounded = model.extract_img_feats(images)
    for ours, theirs in zip(rounded, exact, strict=True):
        assert ours.dtype == torch.float32
        assert 0 < (ours - theirs).norm() < 2e-3 * theirs.norm()  # float16 has eleven bits
    for parameter in model.img_backbone.parameters():
        assert parameter.dtype == torch.float32
        parameter.mul_(1.5)
    (changed,) = model.extract_img_feats(images)
    assert (changed - rounded[0]).norm() > 0.1 * rounded[0].norm()


def test_training_does_not_use_half_copies(inferencer):
    model = copy.deepcopy(inferencer.model)
    images = torch.randn(1, 2, 3, 64, 96)
    expected = model.extract_img_feats(images)
    model.halve_backbone()
    found = model.extract_img_feats(images)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("depth", [18, 50])
@torch.no_grad()
def test_fused_convolutions_are_those_of_the_blocks(depth):
    torch.manual_seed(0)
    backbone = ResNet(depth, base_channels=8, out_indices=(1, 3))
    backbone.eval()
    for name, buffer in backbone.named_buffers():
        if "running" in name:
            buffer.uniform_(0.5, 1.5)
    images = torch.randn(2, 3, 64, 96)
    folding = FoldedBackbone()
    expected = folding(backbone, images)
    found = fused_resnet(folding.folded, images, convolve=convolve_folded)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs)


@needs_gpu
def test_captured_frames_equal_launched_ones(tmp_path):
    torch.manual_seed(0)
    inferencer = MapInferencer(make_config(), None, device="cuda", cuda_graphs=True)
    (frames,) = inferencer._fast_frames
    batch = batch_of(inferencer, tmp_path, 2)
    launched = FastFrames(frames.frame, frames.device, capture=False)

    def compare():
        for ours, theirs in zip(frames(copy.deepcopy(batch)), launched(batch), strict=True):
            for name, values in theirs.pred_instances_3d.items():
                assert torch.equal(ours.pred_instances_3d[name], values)

    compare()
    graph = frames._graphs.copy()
    compare()
    assert frames._graphs == graph  # recorded once
    with torch.no_grad():
        for parameter in inferencer.model.parameters():
            parameter.mul_(0.9)
    compare()  # with the new weights
    images = batch["inputs"]["img"]
    batch["inputs"]["img"] = [image[..., :-16] for image in images]
    compare()  # of another size
    assert len(frames._graphs) == 2


@needs_gpu
def test_half_precision_on_a_gpu(tmp_path):
    found = []
    for amp in (False, True):
        for cuda_graphs in (False, True):
            inferencer = MapInferencer(
                "gsmap_r18_minicity", device="cuda", amp=amp, cuda_graphs=cuda_graphs
            )
            samples = make_samples(tmp_path, 1)
            inferencer.cfg.test_dataloader.dataset.cameras = list(NAMES)
            (sample,) = inferencer(samples, tmp_path)
            found.append(sample.pred_instances_3d)
    exact, _, *halves = found
    for half in halves:
        count = min(len(half), len(exact))
        apart = np.abs(half.scores_3d[:count].numpy() - exact.scores_3d[:count].numpy())
        assert apart.max() < 2e-3
