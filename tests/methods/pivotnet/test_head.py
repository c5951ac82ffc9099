"""PivotNet's head: decoding, bad settings, bad targets, any number of elements."""

import numpy as np
import pytest
import torch
from head_cases import assert_float32_coordinates
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData

import gsmap.registered  # noqa: F401
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.elements import elements_of_predictions
from gsmap.engine.launch import check_config, read_config
from gsmap.models.pivotnet.head import PivotHead, PivotReference
from gsmap.models.pivotnet.targets import FormatPivotTargets
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-15.0, 15.0), (-30.0, 30.0))
CONFIG = "configs/pivotnet/pivotnet_r18_minicity.py"
HEAD = {
    "grid": GRID,
    "classes": ("divider", "boundary"),
    "queries": ((3, 4), (2, 6)),
    "embed_dims": 16,
    "mask_pixel_m": 3.75,
    "decoder": {"num_layers": 2, "num_heads": 4, "ffn_dims": 16},
}


def head(**settings) -> PivotHead:
    init_default_scope("mmdet3d")
    torch.manual_seed(0)
    built = PivotHead(**{**HEAD, **settings})
    built.init_weights()
    return built


def sample(*lines, labels=None, size=(16, 8)) -> Det3DDataSample:
    """Return a sample of straight lines from one point to another in metres."""
    number = len(lines)
    pts = torch.tensor(lines, dtype=torch.float32).view(number, 2, 2)
    found = Det3DDataSample(metainfo={"token": "token-0"})
    found.gt_instances_3d = InstanceData(
        labels_3d=torch.tensor(labels or [0] * number, dtype=torch.long),
        pts=torch.cat([pts, pts[:, 1:]], 1),
        num_pts=torch.full((number,), 2),
        masks=torch.ones(number, *size, dtype=torch.bool),
    )
    return found


def losses(built, found):
    feats = torch.randn(1, 16, 8, 4, generator=torch.Generator().manual_seed(1))
    return built.loss({"bev_feats": feats}, [found])


@pytest.mark.parametrize("lines", [(), ([0, -5, 0, 5],), ([0, -5, 0, 5], [4, 0, 4, 9])])
def test_every_weight_learns_from_any_number_of_lines(lines):
    built = head()
    found = losses(built, sample(*lines, labels=list(range(len(lines)))))
    assert set(found) == {
        f"loss_{name}" for name in ("mask", "pivots", "collinear", "cls", "point_cls", "semantic")
    }
    assert all(torch.isfinite(value) for value in found.values())
    sum(found.values()).backward()
    assert (found["loss_pivots"] > 0) == bool(lines)
    assert built.decoder.query.weight.grad.abs().sum() > 0


def test_decoding_keeps_the_pivots_in_order_and_repeats_the_last():
    places = torch.tensor([[0.9, 0.5], [0.7, 0.5], [0.5, 0.5], [0.1, 0.25]])
    logits = torch.tensor([1.0, -2.0, 3.0, 1.0])
    fields = PivotReference(GRID).decode(torch.cat([places, logits[:, None]], 1)[None])
    assert fields["num_pts"].tolist() == [3]
    expected = [[0.0, -24.0], [0.0, 0.0], [-7.5, 24.0], [-7.5, 24.0]]  # front is the largest y
    torch.testing.assert_close(fields["pts"][0], torch.tensor(expected))
    instances = InstanceData(**fields, labels_3d=torch.tensor([1]), scores_3d=torch.tensor([0.7]))
    assert [len(line) for line in elements_of_predictions(instances).polylines] == [3]


def test_predictions_are_lines_more_likely_than_none():
    built = head().eval()
    built.decoder.cls_branches[1].bias.data += torch.tensor([9.0, 0.0])
    built.decoder.cls_branches[0].bias.data -= torch.tensor([9.0, 0.0])
    (found,) = built.predict({"bev_feats": torch.randn(1, 16, 8, 4)}, [sample()])
    assert found.labels_3d.tolist() == [1, 1]
    assert (found.scores_3d > 0.5).all()
    assert found.pts.shape == (2, 6, 2)
    assert (found.num_pts >= 2).all()


def test_the_mean_of_the_coordinates_is_kept_until_a_weight_changes(monkeypatch):
    built, calls = head().eval(), []
    mean = PivotHead._mean_feature
    monkeypatch.setattr(PivotHead, "_mean_feature", lambda self: calls.append(1) or mean(self))
    with torch.no_grad():
        first = built.coordinate_feature()
        assert built.coordinate_feature() is first
        built.coordinates[0].weight.mul_(2.0)
        assert not torch.equal(built.coordinate_feature(), first)
    assert len(calls) == 2
    assert built.coordinate_feature().requires_grad


@pytest.mark.parametrize("fused", [False, True])
def test_a_step_of_training_is_seen_by_the_next_validation(fused):
    """A fused optimizer changes weights without a new version."""
    built = head()
    optimizer = torch.optim.AdamW(built.parameters(), lr=0.1, fused=fused)
    with torch.no_grad():
        before = built.coordinate_feature()
    sum(losses(built, sample([0, -5, 0, 5])).values()).backward()
    optimizer.step()
    with torch.no_grad():
        after = built.coordinate_feature()
        torch.testing.assert_close(after, built._mean_feature())
    assert (after - before).abs().max() > 0.01


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"queries": ((3, 4),)}, "queries must be two numbers for each class"),
        ({"queries": ((3, 4), (2, 1))}, "queries must be two numbers for each class"),
        ({"decoder": {**HEAD["decoder"], "num_layers": 7}}, "num_layers must be 1 to 6"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        head(**settings)


def test_targets_that_do_not_fit_are_refused():
    plain = Det3DDataSample(metainfo={"token": "token-7"})
    plain.gt_instances_3d = InstanceData(labels_3d=torch.zeros(0), pts=torch.zeros(0, 20, 2))
    with pytest.raises(ValueError, match="'token-7' has no pivots: replace FormatMapTargets"):
        losses(head(), plain)
    with pytest.raises(ValueError, match="set pixel_m there to the head's mask_pixel_m"):
        losses(head(), sample([0, -5, 0, 5], size=(8, 4)))
    many = sample([0, -5, 0, 5])
    many.gt_instances_3d.num_pts += 5
    with pytest.raises(ValueError, match="7 pivots, but the head has 4 points"):
        losses(head(), many)


def test_a_pipeline_without_pivots_is_refused_before_training():
    cfg = read_config(CONFIG)
    check_config(cfg)
    pipeline = cfg.train_dataloader.dataset.pipeline
    cfg.train_dataloader.dataset.pipeline = [
        step for step in pipeline if step.type != "FormatPivotTargets"
    ]
    with pytest.raises(ValueError, match="PivotHead needs the targets of FormatPivotTargets"):
        check_config(cfg)


def test_published_models_have_the_published_parameters():
    counts = {"r50": 49_244_948, "swint": 52_765_518, "effb0": 28_656_464}
    for name, published in counts.items():
        cfg = Config.fromfile(f"configs/pivotnet/pivotnet_{name}_30e.py")
        init_default_scope("mmdet3d")
        model = MODELS.build(cfg.model)
        assert sum(p.numel() for p in model.parameters() if p.requires_grad) == published


def test_mixed_precision_keeps_coordinates_in_float32():
    assert_float32_coordinates(head())


def test_masks_have_the_direction_of_travel_of_the_grid():
    """A line along x, 10 m to the left of a vehicle that drives along x."""
    grid = BEVGrid((-30.0, 30.0), (-30.0, 30.0), forward="x")
    line = MapInstance(0, np.array([[-9.5, 10.5], [13.5, 10.5]]))
    sizes = {"edge_classes": (), "pixel_m": 1.0, "thickness_px": 1}
    targets = FormatPivotTargets(num_points=(4,), forward="x", **sizes)
    results = {"map_instances": [line], "token": "a", "x_range": (-30, 30), "y_range": (-30, 30)}
    (mask,) = targets.transform(results)["gt_instances_3d"].masks
    rows, columns = mask.nonzero().T
    front, left = (grid.front_from_metres(line.points) * 60).T
    assert (rows.min(), rows.max()) == pytest.approx((front.min(), front.max()), abs=1)
    assert set(columns.tolist()) == {int(left[0])}
