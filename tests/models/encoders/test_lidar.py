import copy

import pytest
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from model_cases import (
    CONFIGS,
    build_small,
    make_images,
    make_samples,
    small_config,
    straight_elements,
)

from gsmap.models.encoders.lidar import ConvFuser, LidarEncoder
from gsmap.structures.grid import BEVGrid

CONFIG = "maptr/maptr_r18_pointpillars_minicity.py"
GRID = BEVGrid((-15, 15), (-30, 30))
LINE = straight_elements(((-5.0, -20.0), (-5.0, 20.0)))


@pytest.fixture(scope="module")
def config():
    cfg = Config.fromfile(CONFIGS / CONFIG, import_custom_modules=False).model
    cfg.lidar_encoder.bev_pixel_m = 5.0
    cfg.bev_fuser.update(camera_channels=16, out_channels=16)
    return cfg


def voxelise(config, *clouds):
    """Run the data preprocessor on point clouds (n, 5) and return what the model gets."""
    preprocessor = MODELS.build(config.data_preprocessor)
    data = {"inputs": {"points": list(clouds)}, "data_samples": make_samples(*[LINE] * len(clouds))}
    return preprocessor(data, training=False)["inputs"]["voxels"]


def cloud(*points):
    return torch.tensor([[*point, 0.5, 0.0] for point in points])


def test_a_point_lights_up_its_own_cell_of_its_own_sample(config):
    torch.manual_seed(0)
    encoder_config = copy.deepcopy(config.lidar_encoder)
    encoder_config.update(backbone=None, neck=None, bev_pixel_m=0.6, grid=GRID)
    encoder = LidarEncoder(**{k: v for k, v in encoder_config.items() if k != "type"}).eval()
    voxels = voxelise(config, cloud((-14.9, -29.9, 0.0)), cloud((0.1, 29.9, 1.0), (14.9, 0.1, 0.0)))
    with torch.no_grad():
        feats = encoder(voxels, 2)
    assert feats.shape == (2, 32, 100, 50)
    lit = feats.abs().amax(1).nonzero().tolist()
    # row = (y + 30) / 0.6, column = (x + 15) / 0.6
    assert lit == [[0, 0, 0], [1, 50, 49], [1, 99, 25]]


def test_features_are_interpolated_to_the_size_of_the_grid(config):
    encoder = MODELS.build({**config.lidar_encoder, "grid": GRID}).eval()
    with torch.no_grad():
        feats = encoder(voxelise(config, cloud((0.0, 0.0, 0.0))), 1)
    assert feats.shape == (1, 128, 12, 6)


def test_the_fuser_is_one_convolution_over_both():
    torch.manual_seed(0)
    fuser = ConvFuser(4, 6, 8).eval()
    camera, lidar = torch.randn(2, 4, 5, 3), torch.randn(2, 6, 5, 3)
    both = torch.cat([camera, lidar], 1)
    expected = torch.nn.functional.conv2d(both, fuser.conv.weight, padding=1)
    # a new BatchNorm in eval divides by sqrt(1 + eps)
    expected = (expected / (1 + 1e-5) ** 0.5).relu()
    torch.testing.assert_close(fuser(camera, lidar), expected)


@pytest.mark.parametrize("cameras", [True, False], ids=["camera and lidar", "lidar alone"])
def test_models_with_lidar_train_and_predict(config, cameras):
    torch.manual_seed(0)
    overrides = {"lidar_encoder": config.lidar_encoder}
    if cameras:
        overrides["bev_fuser"] = config.bev_fuser
    else:
        overrides["lidar_encoder"] = copy.deepcopy(config.lidar_encoder)
        overrides["lidar_encoder"].neck.out_channels = [16]
        overrides.update(img_backbone=None, img_neck=None, bev_encoder=None)
    model = build_small(**overrides).train()
    size, low = torch.tensor([30.0, 60, 2, 1, 0]), torch.tensor([-15.0, -30, -1, 0, 0])
    points = torch.rand(200, 5) * size + low
    inputs = {"voxels": voxelise(config, points, points[:50] * 0.9)}
    if cameras:
        inputs.update(make_images(2))
    losses = model.loss(inputs, make_samples(LINE, straight_elements()))
    torch.stack(list(losses.values())).sum().backward()
    without = [n for n, p in model.named_parameters() if p.requires_grad and p.grad is None]
    assert not without
    with torch.no_grad():
        found = model.eval().predict(inputs, make_samples(LINE, LINE))[0].pred_instances_3d
        moved = {**inputs, "voxels": voxelise(config, points * 0.5, points[:50] * 0.9)}
        other = model.predict(moved, make_samples(LINE, LINE))[0].pred_instances_3d
    assert found.pts.shape[1:] == (20, 2)
    assert not torch.allclose(found.scores_3d[:1], other.scores_3d[:1], atol=1e-7)


def test_combinations_that_mean_nothing_are_refused(config):
    with pytest.raises(ValueError, match="a bev_encoder"):
        MODELS.build({**small_config(), "bev_encoder": None})
    with pytest.raises(ValueError, match="bev_fuser belongs to a model of cameras and LiDAR"):
        MODELS.build({**small_config(), "lidar_encoder": config.lidar_encoder})


def test_a_sparse_encoder_without_its_package_says_so(monkeypatch):
    path = CONFIGS / "maptr/maptr_r50_second_24e.py"
    cfg = Config.fromfile(path, import_custom_modules=False)
    monkeypatch.setattr("gsmap.models.encoders.lidar.IS_SPCONV2_AVAILABLE", False)
    encoder = MODELS.build({**cfg.model.lidar_encoder, "grid": GRID})
    with pytest.raises(RuntimeError, match="use a PointPillars config"):
        encoder({"coors": torch.zeros(1, 4, dtype=torch.int32)}, 1)
