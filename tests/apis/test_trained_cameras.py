"""The cameras that a model was trained on, and inputs with others, or in another order."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from export_cases import SCORES, shake
from inferencer_cases import NAMES, make_config, make_samples

from gsmap.apis.export import export_onnx, graph_inputs
from gsmap.apis.loading import load_model
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.apis.trained_cameras import TrainedCamerasHook
from gsmap.checkpoints.reading import read_checked

CAMERAS = "test_dataloader.dataset.cameras"
SIZE = (90, 160)


@pytest.fixture(scope="module")
def weights(inferencer, tmp_path_factory):
    """Weights of the small model, in a checkpoint without and one with the names of its cameras."""
    folder = tmp_path_factory.mktemp("weights")
    model = make_model(inferencer)
    torch.save({"state_dict": model.state_dict()}, folder / "bare.pth")
    meta = {"dataset_meta": {"cameras": NAMES}}
    torch.save({"state_dict": model.state_dict(), "meta": meta}, folder / "named.pth")
    return folder


def make_model(inferencer):
    """Return a copy of a model whose embeddings of cameras count."""
    model = load_model(make_config())
    model.load_state_dict(inferencer.model.state_dict())
    shake(model)
    model.bev_encoder.cams_embeds.data *= 5
    return model


def points_of(inferencer, samples, folder):
    (found,) = inferencer(samples, folder)
    return found.pred_instances_3d.pts


@pytest.mark.parametrize("file", ["bare.pth", "named.pth"])
def test_cameras_of_a_config_get_their_own_embeddings(file, weights, tmp_path):
    samples = make_samples(tmp_path, 1)
    usual = MapInferencer(make_config(), weights / file, device="cpu")
    assert usual.model.camera_names == NAMES
    expected = points_of(usual, samples, tmp_path)
    turned = MapInferencer(
        make_config(), weights / file, device="cpu", cfg_options={CAMERAS: list(NAMES[::-1])}
    )
    assert turned.model.camera_names == NAMES[::-1]
    torch.testing.assert_close(points_of(turned, samples, tmp_path), expected, atol=1e-3, rtol=0)
    alone = MapInferencer(
        make_config(), weights / file, device="cpu", cfg_options={CAMERAS: ["CAM_BACK"]}
    )
    samples[0].cameras = samples[0].cameras[1:]
    dataset = usual.dataset(samples, tmp_path)
    (missing,) = usual.predict(dataset, allow_missing_cameras=True)
    torch.testing.assert_close(
        points_of(alone, samples, tmp_path), missing.pred_instances_3d.pts, atol=1e-3, rtol=0
    )


def test_a_checkpoint_knows_its_cameras_better_than_a_config(weights, tmp_path):
    samples = make_samples(tmp_path, 1)
    usual = MapInferencer(make_config(), weights / "named.pth", device="cpu")
    expected = points_of(usual, samples, tmp_path)
    cfg = make_config()
    cfg.test_dataloader.dataset.cameras = list(NAMES[::-1])
    turned = MapInferencer(cfg, weights / "named.pth", device="cpu")
    torch.testing.assert_close(points_of(turned, samples, tmp_path), expected, atol=1e-3, rtol=0)
    cfg.test_dataloader.dataset.cameras = None  # each sample has its cameras in an order of its own
    samples[0].cameras.reverse()
    free = MapInferencer(cfg, weights / "named.pth", device="cpu")
    torch.testing.assert_close(points_of(free, samples, tmp_path), expected, atol=1e-3, rtol=0)


def test_names_that_do_not_fit_the_embeddings_are_not_used(weights, tmp_path):
    content = torch.load(weights / "named.pth", weights_only=True)
    content["meta"]["dataset_meta"]["cameras"] = ["CAM_BACK"]
    torch.save(content, tmp_path / "odd.pth")
    assert load_model(make_config(), tmp_path / "odd.pth").camera_names == NAMES
    cfg = make_config()
    cfg.test_dataloader.dataset.cameras = ["CAM_BACK"]  # whose embedding is unknown
    assert load_model(cfg, weights / "bare.pth").camera_names is None


def test_without_names_the_order_is_that_of_the_training_data(weights):
    usual = load_model(make_config(), weights / "bare.pth").bev_encoder.cams_embeds
    cfg = make_config()
    cfg.train_dataloader = {"dataset": {"cameras": list(NAMES)}}
    cfg.test_dataloader.dataset.cameras = list(NAMES[::-1])
    model = load_model(cfg, weights / "bare.pth")
    assert list(model.camera_names) == list(NAMES[::-1])
    assert torch.equal(model.bev_encoder.cams_embeds, usual.flip(0))


def test_a_test_of_a_users_data_set_keeps_the_embeddings(weights):
    model = load_model(make_config(), weights / "named.pth")
    runner = SimpleNamespace(
        model=model, cfg=make_config(), test_dataloader=SimpleNamespace(dataset=[])
    )
    path = weights / "named.pth"
    hook = TrainedCamerasHook(make_config(), path, read_checked(path))
    embeds = model.bev_encoder.cams_embeds
    hook.before_test(runner)
    hook.before_test_iter(runner, 0)
    assert model.bev_encoder.cams_embeds is embeds
    hook.after_test_iter(runner, 0)
    assert model.bev_encoder.cams_embeds is embeds


def test_a_test_selects_the_embeddings_during_each_iteration(weights, tmp_path):
    path = weights / "named.pth"
    samples = make_samples(tmp_path, 1)
    usual = MapInferencer(make_config(), path, device="cpu")
    dataset = usual.dataset(samples, tmp_path)
    model = make_model(usual)
    model.load_state_dict(usual.model.state_dict())
    embeds = model.bev_encoder.cams_embeds
    for cameras in (NAMES[::-1], NAMES, NAMES[1:]):
        dataset.cameras = cameras
        loader = SimpleNamespace(dataset=dataset)
        runner = SimpleNamespace(model=model, cfg=make_config(), test_dataloader=loader)
        hook = TrainedCamerasHook(make_config(), path, read_checked(path))
        hook.before_test(runner)
        hook.before_test_iter(runner, 0)
        rows = [NAMES.index(name) for name in cameras]
        assert torch.equal(model.bev_encoder.cams_embeds, embeds[rows])
        hook.after_test_iter(runner, 0)
        assert model.bev_encoder.cams_embeds is embeds
    datasets = [SimpleNamespace(cameras=names) for names in (NAMES, NAMES[::-1])]
    runner.test_dataloader.dataset = SimpleNamespace(datasets=datasets)
    with pytest.raises(ValueError, match="other orders of cameras: give all of them equal"):
        hook.before_test(runner)


def test_a_file_has_the_embeddings_of_the_cameras_that_it_is_exported_for(weights, tmp_path):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    samples = make_samples(tmp_path, 1)
    usual = MapInferencer(make_config(), weights / "bare.pth", device="cpu")
    with pytest.raises(ValueError, match=r"of the cameras CAM_FRONT, CAM_BACK, got .* CAM_BACK: s"):
        export_onnx(usual.model, tmp_path / "no.onnx", ["CAM_BACK"], SIZE)
    samples[0].cameras = samples[0].cameras[1:]
    dataset = usual.dataset(samples, tmp_path)
    (expected,) = usual.predict(dataset, allow_missing_cameras=True)
    model = load_model(make_config(), weights / "bare.pth", cfg_options={CAMERAS: ["CAM_BACK"]})
    export_onnx(model, tmp_path / "back.onnx", ["CAM_BACK"], SIZE)
    exported = OnnxInferencer(tmp_path / "back.onnx", num_threads=1)
    dataset.cameras = ("CAM_BACK",)
    ((_, inputs),) = graph_inputs(exported, dataset, [0])
    scores = exported.run(inputs)["scores"]
    np.testing.assert_allclose(
        np.sort(scores), np.sort(expected.pred_instances_3d.scores_3d), atol=SCORES
    )
