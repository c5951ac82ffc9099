"""The LSS encoder: lifting by hand, shapes, what its depth loss needs."""

import numpy as np
import pytest
import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample

import gsmap.registered  # noqa: F401
from gsmap.models.encoders.lss import LSSEncoder
from gsmap.models.maptrv2.aux_heads import DepthSupervision
from gsmap.structures.calibration import calibration_arrays
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-4, 4), (-8, 8))
DEPTH_RANGE = (1.0, 7.0, 1.0)


def encoder(**settings) -> LSSEncoder:
    torch.manual_seed(0)
    config = {
        "type": "LSSEncoder",
        "grid": GRID,
        "z_range": (-5.0, 5.0),
        "bev_pixel_m": 2.0,
        "embed_dims": 8,
        "depth_range": DEPTH_RANGE,
        "aspp_channels": 4,
    }
    module = MODELS.build({**config, **settings})
    module.init_weights()
    return module.eval()


def meta(num_cams: int = 1) -> dict:
    """Cameras at the origin that look along y, f = 32 px, in images of 33 x 65 px."""
    lidar2cam = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    cam2img = np.eye(4)
    cam2img[:2, :3] = [[32, 0, 32], [0, 32, 16]]
    return {
        "token": "a",
        "batch_input_shape": (33, 65),
        "lidar2img": np.stack([cam2img @ lidar2cam] * num_cams),
        "lidar2cam": np.stack([lidar2cam] * num_cams),
        "cam2img": np.stack([cam2img] * num_cams),
        "img_aug_matrix": np.stack([np.eye(4)] * num_cams),
        "lidar2ego": np.eye(4),
    }


def feats(batch: int = 1, num_cams: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(batch, num_cams, 8, 3, 5, generator=generator)


def sample_with_depth(depth_m: float) -> Det3DDataSample:
    sample = Det3DDataSample(metainfo={"token": "a"})
    sample.gt_depth = torch.full((1, 6, 10), depth_m)
    return sample


def test_shapes():
    outputs = encoder()([feats(2, 3)], [meta(3)] * 2)
    assert outputs["bev_feats"].shape == (2, 8, 8, 4)
    assert outputs["depth"].shape == (2, 3, 6, 3, 5)
    torch.testing.assert_close(outputs["depth"].sum(2), torch.ones(2, 3, 3, 5))


def test_points_of_the_middle_pixel_lie_on_the_optical_axis():
    matrices = calibration_arrays(meta(), ["frame_from_img"])["frame_from_img"]
    points = encoder().points(torch.as_tensor(matrices)[None], (33, 65), feats())
    assert points.shape == (1, 1, 6, 3, 5, 3)
    expected = torch.tensor([[0.0, d, 0.0] for d in range(1, 7)])
    torch.testing.assert_close(points[0, 0, :, 1, 2], expected)


def test_features_reach_only_cells_that_the_camera_sees():
    module = encoder()
    with torch.no_grad():
        one = module([feats()], [meta()])["bev_feats"]
        none = module([torch.zeros_like(feats())], [meta()])["bev_feats"]
        changed = (one - none).abs().sum(1)[0] > 1e-6
    # behind the camera nothing changes: the three convolutions reach 3 m back from y = 0
    assert not changed[:1].any()
    assert changed[5:].any()


def test_samples_of_a_batch_are_independent():
    module = encoder()
    both = module([feats(2)], [meta()] * 2)["bev_feats"]
    alone = module([feats(2)[1:]], [meta()])["bev_feats"]
    torch.testing.assert_close(both[1:], alone, atol=1e-5, rtol=1e-5)


def test_depth_loss_and_its_gradient():
    module, supervision = encoder(), DepthSupervision(loss_weight=3.0)
    outputs = module([feats()], [meta()])
    outputs["depth"] = torch.full((1, 1, 6, 3, 5), 1 / 6)
    loss = supervision.loss(outputs, [sample_with_depth(2.5)])
    assert loss.item() == pytest.approx(3 * np.log(6), rel=1e-5)
    outputs = module([feats()], [meta()])
    supervision.loss(outputs, [sample_with_depth(2.5)]).backward()
    assert module.depth_net.depth_conv[-1].weight.grad.abs().sum() > 0


def test_missing_depth_is_named():
    outputs = encoder()([feats()], [meta()])
    with pytest.raises(ValueError, match=r"sample 'b' has no gt_depth"):
        DepthSupervision().loss(outputs, [Det3DDataSample(metainfo={"token": "b"})])


def test_missing_matrix_is_named():
    broken = meta()
    del broken["lidar2ego"]
    with pytest.raises(ValueError, match=r"sample 'a' has no 'lidar2ego'"):
        encoder()([feats()], [broken])


def test_plain_depth_net_needs_projection_only():
    module = encoder(camera_aware=False)
    few = {key: meta()[key] for key in ("token", "batch_input_shape", "lidar2img")}
    assert module([feats()], [few])["bev_feats"].shape == (1, 8, 8, 4)


def test_training_reaches_every_parameter():
    module = encoder().train()
    outputs = module([feats(1, 2)], [meta(2)])
    outputs["bev_feats"].square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in module.parameters())


def test_mixed_precision_keeps_depth_and_pooling_in_float32():
    module = encoder()
    exact = module([feats()], [meta()])
    with torch.autocast("cpu", torch.bfloat16):
        outputs = module([feats()], [meta()])
        loss = DepthSupervision().loss(outputs, [sample_with_depth(2.5)])
    assert outputs["depth"].dtype == loss.dtype == torch.float32
    assert outputs["bev_feats"].isfinite().all()
    torch.testing.assert_close(outputs["depth"], exact["depth"], atol=0.02, rtol=0)
