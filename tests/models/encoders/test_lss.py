"""The LSS encoder: lifting by hand, shapes, what is refused."""

import pytest
import torch
from lss_cases import encoder, feats, meta

import gsmap.registered  # noqa: F401
from gsmap.structures.calibration import calibration_arrays


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
    assert outputs["depth"].dtype == torch.float32
    assert outputs["bev_feats"].isfinite().all()
    torch.testing.assert_close(outputs["depth"], exact["depth"], atol=0.02, rtol=0)


@pytest.mark.parametrize(("depth_range", "bins"), [((1, 8.2, 0.5), 14), ((1, 5.3, 0.1), 43)])
def test_a_part_of_a_bin_does_not_count_and_rounding_loses_none(depth_range, bins):
    module = encoder(depth_range=depth_range)
    outputs = module([feats()], [meta()])
    assert outputs["depth"].shape[2] == bins
    matrices = torch.eye(4).view(1, 1, 4, 4)
    depths = module.points(matrices, (33, 65), feats())[0, 0, :, 0, 0, 2]
    torch.testing.assert_close(depths, 1 + depth_range[2] * torch.arange(bins))


def test_mixed_precision_keeps_points_in_float32():
    """In bfloat16, points would move by up to 0.4 m."""
    matrices = torch.as_tensor(calibration_arrays(meta(), ["frame_from_img"])["frame_from_img"])
    module = encoder()
    exact = module.points(matrices[None], (33, 65), feats())
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(module.points(matrices[None], (33, 65), feats()), exact)
