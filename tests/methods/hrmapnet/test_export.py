"""An exported model: the window is an input, and the writing is outside."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from export_cases import POINTS_M, SCORES, shake
from methods.hrmapnet.prior_cases import PRIOR, prior_model
from model_cases import IMAGE_SHAPE, build_small, small_config
from prior_cases import CLASSES, frames

from gsmap.apis.export import export_onnx, largest_differences
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.datasets.elements import elements_of_predictions
from gsmap.prior import KeepMaximum, MapPrior, PriorSettings
from gsmap.prior.places import Place
from tools import export

for _package in ("onnx", "onnxscript", "onnxruntime"):
    pytest.importorskip(_package, reason=f"{_package} is not installed: pip install -e .[onnx]")


HERE = ("town", "a", 0.0)
NUM_CAMS = 2  # the graph has the operators of each camera
IMAGES = np.random.default_rng(0).integers(0, 255, (NUM_CAMS, *IMAGE_SHAPE, 3), np.uint8)


def images_of(images, model):
    """Return images as a data set hands them to a model, in a batch of one."""
    pixels = torch.from_numpy(images.transpose(0, 3, 1, 2)).float()
    return model.data_preprocessor({"inputs": {"img": [pixels]}})["inputs"]


def test_a_file_reads_the_window_as_in_torch(tmp_path):
    encoder = {**small_config()["bev_encoder"], "num_cams": NUM_CAMS}
    layer = {**PRIOR["bev"]["layer"], "num_cams": NUM_CAMS}
    prior_cfg = {**PRIOR, "bev": {**PRIOR["bev"], "layer": layer}}
    model = build_small(bev_encoder=encoder, prior=prior_cfg).eval()
    shake(model)
    model.map_head.coder.margin_m = None  # every query is found
    path = tmp_path / "model.onnx"
    export_onnx(model, path, [f"CAM_{number}" for number in range(NUM_CAMS)], IMAGE_SHAPE)
    exported = OnnxInferencer(path, num_threads=1)
    assert exported.prior_shape == (3, 48, 24)
    (sample,) = frames(HERE)
    sample.set_metainfo({"lidar2img": sample.metainfo["lidar2img"][:NUM_CAMS]})
    meta = sample.metainfo
    prior = MapPrior(PriorSettings(CLASSES, "town", cell_m=1.25), KeepMaximum())
    maps = model.prior.maps_of([prior])
    drawn = torch.rand(3, 48, 24, generator=torch.Generator().manual_seed(0))
    prior.write(meta["lidar2global"], model.prior.window, drawn)
    window = maps.read(Place.of(meta)).numpy()
    found = exported(IMAGES, {**meta, "prior": window})
    with torch.no_grad(), model.prior.using(maps):
        (predicted,) = model(images_of(IMAGES, model), [sample], mode="predict")
    expected = elements_of_predictions(predicted.pred_instances_3d)
    scores, metres = largest_differences(found, expected)
    assert len(found) == len(expected) > 5
    assert scores < SCORES
    assert metres < POINTS_M
    without = exported(IMAGES, meta)
    zeros = exported(IMAGES, {**meta, "prior": np.zeros_like(window)})
    np.testing.assert_array_equal(without.scores, zeros.scores)
    assert largest_differences(without, expected)[1] > 10 * POINTS_M  # the map counts
    for wrong in (window[:2], window + 1.0, window * np.nan):
        with pytest.raises(ValueError, match=r"prior of model\.onnx must have values in \[0, 1\]"):
            exported(IMAGES, {**meta, "prior": wrong})


def test_a_check_compares_with_an_empty_map_for_all_samples(monkeypatch):
    model = prior_model().eval()
    maps = []
    inferencer = SimpleNamespace(
        model=model, predict=lambda *_: maps.append(model.prior.new_maps()) or []
    )
    samples = SimpleNamespace(annotations=SimpleNamespace(column=lambda _: ["a", "b"]))
    monkeypatch.setattr(export, "open_samples", lambda *_, **__: samples)
    monkeypatch.setattr(export, "graph_inputs", lambda *_: [])
    options = SimpleNamespace(samples=None, check=2, results=None)
    text = export.check(inferencer, SimpleNamespace(metadata={}, has_memory=False), options)
    assert "predict, with an empty map of earlier drives, equal numbers" in text
    assert not maps[0].writes
