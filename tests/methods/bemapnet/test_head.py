"""BeMapNet: curves and targets by hand, its head with any number of lines, bad settings."""

import numpy as np
import pytest
import torch
from head_cases import assert_float32_coordinates
from mmcv.ops import point_sample
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData

import gsmap.registered  # noqa: F401
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.images import CropImages
from gsmap.models.bemapnet.curves import Curve, control_points, neighbourhood, recovery_loss
from gsmap.models.bemapnet.encoder import BezierBEVEncoder
from gsmap.models.bemapnet.head import BezierHead
from gsmap.models.bemapnet.neck import BiFPN, downsample
from gsmap.models.bemapnet.targets import FormatBezierTargets
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-15.0, 15.0), (-30.0, 30.0))
HEAD = {
    "grid": GRID,
    "classes": ("divider", "boundary"),
    "queries": (3, 2),
    "degrees": (2, 1),
    "pieces": (2, 3),
    "embed_dims": 16,
    "hidden_dims": 16,
    "point_dims": 8,
    "mask_pixel_m": 3.75,
    "bev_pixel_m": 7.5,
    "decoder": {"num_layers": 2, "num_heads": 4, "ffn_dims": 16},
    "losses": {"mask_points": 64},
}
TARGETS = {"degrees": (2, 1), "pieces": (2, 3), "edge_classes": (), "pixel_m": 3.75}


def head(**settings) -> BezierHead:
    init_default_scope("mmdet3d")
    torch.manual_seed(0)
    built = BezierHead(**{**HEAD, **settings})
    built.init_weights()
    return built


def sample(*lines, **settings) -> Det3DDataSample:
    """Return a sample of lines: label, then vertices in metres."""
    instances = [MapInstance(label, np.array(points, float)) for label, points in lines]
    results = {"map_instances": instances, "token": "token-0"}
    ranges = {"x_range": GRID.x_range, "y_range": GRID.y_range}
    transform = FormatBezierTargets(**{**TARGETS, "thickness_px": 1, **settings})
    found = Det3DDataSample(metainfo={"token": "token-0"})
    found.gt_instances_3d = transform.transform({**results, **ranges})["gt_instances_3d"]
    return found


LINES = [(0, [(0, -9), (0, 9)]), (1, [(-5, 9.5), (-5, 0.5), (4.5, 0.5)])]


def losses(built, *found):
    feats = torch.randn(len(found), 16, 8, 4, generator=torch.Generator().manual_seed(1))
    return built.loss({"bev_feats": feats}, found)


def test_inner_points_stand_around_the_middle_of_their_joints():
    joints = torch.tensor([[0.0, 0.0], [0.0, 100.0]])  # (0.5, 0.5) and (0.5, 1)
    inner = torch.tensor([[[0.0, -100.0]]])  # half the map before the middle
    controls = control_points(joints, inner)
    torch.testing.assert_close(controls, torch.tensor([[0.5, 0.5], [0.5, 0.25], [0.5, 1.0]]))


@pytest.mark.parametrize(("to_end", "last"), [(False, [1.98, 0.0]), (True, [2.0, 0.0])])
def test_curves_have_a_hundred_points_of_the_pieces_that_count(to_end, last):
    controls = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [9.0, 9.0]])
    points = Curve(1, 3, to_end)(controls, torch.tensor(1))  # two pieces
    assert points.shape == (100, 2)
    assert points[0].tolist() == [0, 0]
    assert points[-1].tolist() == pytest.approx(last, abs=0.02 if not to_end else 1e-6)
    assert Curve(1, 3).control_mask(torch.tensor(1)).tolist() == [True, True, True, False]


def test_a_curve_on_its_mask_misses_nothing_and_far_off_all():
    mask = torch.zeros(1, 1, 40, 20)
    mask[..., 10:30, 5:15] = 1
    points = torch.tensor([[[0.5, 0.5]]]).expand(1, 100, 2)
    inside, outside = (
        recovery_loss(point_sample(mask, neighbourhood(p, (40, 20)))[:, 0])
        for p in (points, points * 0.1)
    )
    assert inside.item() == pytest.approx(0, abs=1e-6)
    assert outside.item() == pytest.approx(1 - 1 / 2501, abs=1e-6)


def test_lines_run_away_from_the_front_and_too_many_pieces_are_cut():
    found = sample(*LINES).gt_instances_3d
    assert found.labels_3d.tolist() == [0, 1]
    assert found.num_pts.tolist()[0] == 3
    assert (found.pts[:, 0, 1] >= found.pts[:, -1, 1]).all()  # the front is the largest y
    zigzag = (1, [((-1) ** i * 5.0, 4.0 * i - 20) for i in range(10)])
    assert sample(zigzag).gt_instances_3d.num_pts.tolist() == [4]


def test_a_hidden_line_lets_curves_of_its_class_be_drawn_and_be_in_pixels():
    twice = sample((0, [(0, -9), (0, 9)]), (0, [(0, -9), (0, 9)]))
    assert twice.gt_instances_3d.redrawn.tolist() == [True, True]
    in_px = head().truth(twice)[0].curves
    plain = head(losses={"redrawn_in_px": False}).truth(twice)[0].curves
    torch.testing.assert_close(in_px, plain * torch.tensor([8.0, 16.0]))


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("mask_points", [None, 64])
def test_every_weight_learns_from_any_number_of_lines(number, mask_points):
    built = head(losses={"mask_points": mask_points})
    found = losses(built, sample(*LINES[:number]))
    names = ("mask", "cls", "controls", "pieces", "curve", "recovery", "semantic")
    assert set(found) == {f"loss_{name}" for name in names}
    assert all(torch.isfinite(value) for value in found.values())
    sum(found.values()).backward()
    assert (found["loss_controls"] > 0) == bool(number)
    assert built.decoder.query.weight.grad.abs().sum() > 0


def test_the_losses_fall_in_a_few_steps():
    built, found = head(losses={"mask_points": None}), sample(*LINES)
    optimizer = torch.optim.AdamW(built.parameters(), lr=3e-3)
    totals = []
    for _ in range(25):
        total = sum(losses(built, found).values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < 0.7 * totals[0]


def test_predictions_are_curves_more_likely_than_none_in_metres():
    built = head().eval()
    built.decoder.cls_branches[0].bias.data += torch.tensor([9.0, 0.0])
    (found,) = built.predict({"bev_feats": torch.randn(1, 16, 8, 4)}, [sample()])
    assert sorted(found.labels_3d.tolist()) == [0, 0, 0, 1, 1]
    assert found.pts.shape == (5, 100, 2)
    assert (found.scores_3d > 0.5).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"queries": (3,)}, "must be one for each of"),
        ({"degrees": (2, 6)}, "degrees must be 1 to 5"),
        ({"pieces": (2, 0)}, "pieces must be >= 1"),
        ({"decoder": {**HEAD["decoder"], "num_layers": 7}}, "num_layers must be 1 to 6"),
        ({"losses": {"mask_points": 3}}, "mask_points must be >= 10 or None"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        head(**settings)


def test_targets_that_do_not_fit_are_refused():
    plain = Det3DDataSample(metainfo={"token": "token-7"})
    plain.gt_instances_3d = InstanceData(labels_3d=torch.zeros(0), pts=torch.zeros(0, 20, 2))
    with pytest.raises(ValueError, match="'token-7' has no control points: replace FormatMap"):
        losses(head(), plain)
    with pytest.raises(ValueError, match="set degrees and pieces of FormatBezierTargets"):
        losses(head(), sample(LINES[0], degrees=(3, 1)))
    with pytest.raises(ValueError, match="label 2 of an element, but degrees of FormatBezier"):
        sample((2, [(0, -9), (0, 9)]))
    with pytest.raises(ValueError, match="edge_classes must be indices of the 2 classes"):
        sample(edge_classes=(2,))


def test_pooling_keeps_half_of_the_pixels_rounded_up():
    assert downsample(torch.arange(12.0).view(1, 1, 3, 4)).shape == (1, 1, 2, 2)
    assert downsample(torch.arange(4.0).view(1, 1, 1, 4)).tolist() == [[[[2.0, 3.0]]]]
    neck = BiFPN((4, 8, 16), (3, 5), 6, 2).eval()
    feats = [torch.randn(1, 4 << i, 12 >> i, 20 >> i) for i in range(3)]  # P6 has 2 x 3 pixels
    (joined,) = neck(feats)
    assert joined.shape == (1, 30, 3, 5)


def encoder(**settings) -> BezierBEVEncoder:
    layers = {"num_heads": 2, "ffn_dims": 8, "dropout": 0.0}
    own = {"bev_pixel_m": 15.0, "embed_dims": 8, "num_layers": (1, 2), "position_dims": 8}
    built = BezierBEVEncoder(GRID, 4, layer_cfg=layers, **{**own, **settings})
    return built.eval()


def ground_from_img() -> torch.Tensor:
    """Return a camera at (1, 2), 2 m high, that looks along y; its horizon is row 4."""
    camera = torch.eye(4)
    camera[:3, :3] = torch.tensor([[0.1, 0, -0.8], [0, 0, 1], [0, -0.1, 0.4]])
    camera[:3, 3] = torch.tensor([1.0, 2.0, 2.0])
    return camera[None, None]


@pytest.mark.parametrize(("from_camera", "expected"), [(True, (5.0, 4.0)), (False, (7.0, 3.0))])
def test_a_pixel_stands_for_the_ground_that_it_shows(from_camera, expected):
    built = encoder(position_size=(9, 17), from_camera=from_camera)
    points, seen = built.ground_points(ground_from_img(), (2, 2), (9, 17))
    assert seen.tolist() == [[False, False, True, True]]  # the upper row is above the horizon
    # the lower left pixel (0, 8): 5 m ahead, 4 m to the left of the camera
    assert points[0, 2].tolist() == pytest.approx(expected)


@pytest.mark.parametrize("size", [(9, 20), (12, 17)])
def test_positions_of_other_images_are_refused(size):
    built = encoder(position_size=(9, 17))
    with pytest.raises(
        ValueError, match=rf"\(9, 17\), but images have {size[0]} rows and {size[1]}"
    ):
        built.ground_points(ground_from_img(), (2, 2), size)
    built.ground_points(ground_from_img(), (2, 2), (7, 17))  # two rows are cut off
    with pytest.raises(ValueError, match="num_layers must be two numbers, of pixel layers"):
        encoder(num_layers=(1, 0))


def test_more_levels_than_weights_are_refused():
    levels = [torch.randn(1, 16, 8, 4)] * 5
    with pytest.raises(ValueError, match="each of its 5 layers, but BezierHead has weights"):
        head().loss({"bev_feats": levels[-1], "bev_levels": levels}, [sample(*LINES)])


def test_a_batch_gives_what_its_samples_give_alone():
    built, feats = encoder(position_size=None), torch.randn(2, 1, 4, 3, 3)
    matrices = ground_from_img().repeat(2, 1, 1, 1)
    matrices[1, 0, :3, 3] += 1
    both = built.encode(feats, {"ground_from_img": matrices}, (9, 17))
    assert [level.shape for level in both["bev_levels"]] == [(2, 8, 4, 2)] * 2
    for i in range(2):
        own = {"ground_from_img": matrices[i : i + 1]}
        alone = built.encode(feats[i : i + 1], own, (9, 17))
        torch.testing.assert_close(alone["bev_feats"][0], both["bev_feats"][i])


def test_cropped_images_show_the_same_points():
    results = {"img": [np.arange(12.0).reshape(4, 3)], "raw_shapes": [(4, 3)]}
    results |= {"lidar2img": [np.eye(4)], "img_aug_matrix": [np.eye(4)]}
    found = CropImages(top=1).transform(results)
    assert found["img"][0].tolist() == [[3, 4, 5], [6, 7, 8], [9, 10, 11]]
    assert found["img_shape"] == (3, 3)
    assert (found["lidar2img"][0] @ [2, 3, 1, 1])[:2].tolist() == [2, 2]
    with pytest.raises(ValueError, match="top=4 leaves nothing of images of 3 rows"):
        CropImages(top=4).transform(found)


def test_the_published_model_has_the_published_parameters():
    cfg = Config.fromfile("configs/bemapnet/bemapnet_r50_30e.py")
    init_default_scope("mmdet3d")
    model = MODELS.build(cfg.model)
    assert sum(p.numel() for p in model.parameters() if p.requires_grad) == 73_751_676
    assert sum(p.numel() for p in model.parameters()) == 73_977_020


def test_mixed_precision_keeps_coordinates_in_float32():
    assert_float32_coordinates(head())
