import math
from functools import partial

import numpy as np
import pytest
import torch
from predictions import pairs_of

from gsmap.models.base.losses import MapLoss
from gsmap.models.gemap.losses import EuclideanLoss
from gsmap.models.maptr.losses import DirectionLoss, PointsLoss
from gsmap.models.mapvr.losses import SelfDirectionLoss


def given(loss, pred, target, avg_factor):
    """Return a loss of points that are normalised and in metres alike."""
    points = {"pred_pts": pred, "pred_pts_m": pred, "gt_pts": target, "gt_pts_m": target}
    return loss(pairs_of(**points, avg_factor=avg_factor))


points_loss, direction_loss, self_direction_loss = (
    partial(given, loss(1.0)) for loss in (PointsLoss, DirectionLoss, SelfDirectionLoss)
)


def test_points_loss_by_hand():
    pred = torch.tensor([[[0.0, 0.0], [1.0, 2.0]]])
    target = torch.tensor([[[0.5, 0.0], [1.0, 0.0]]])
    assert given(PointsLoss(loss_weight=4.0), pred, target, 2.0).item() == 4 * 1.25


def test_a_pair_has_the_weight_of_its_class():
    pred, labels = torch.ones(2, 3, 2), torch.tensor([2, 0])
    pairs = pairs_of(pred_pts=pred, gt_pts=0 * pred, gt_labels=labels, avg_factor=2.0)
    assert PointsLoss(loss_weight=(1.0, 5.0, 3.0))(pairs).item() == 6 * (1 + 3) / 2
    with pytest.raises(TypeError, match="EuclideanLoss is no sum over pairs: give one loss_weight"):
        EuclideanLoss(loss_weight=(1.0, 5.0, 3.0))


def test_direction_loss_by_hand():
    # one right angle (1 - 0), one turned by 45 degrees, one reversed (1 - -1)
    pred = torch.tensor(
        [
            [[0.0, 0.0], [0.0, 3.0]],
            [[0.0, 0.0], [2.0, 2.0]],
            [[0.0, 0.0], [-1.0, 0.0]],
        ]
    )
    target = torch.tensor([[[0.0, 0.0], [5.0, 0.0]]]).expand(3, -1, -1)
    expected = (1 + (1 - math.sqrt(0.5)) + 2) / 3
    torch.testing.assert_close(direction_loss(pred, target, 3.0), torch.tensor(expected))


def test_self_direction_by_hand():
    """A straight step (0), a right angle (1), a fold back (2); a ring's two ends are no pair."""
    pred = torch.tensor(
        [[[0.0, 0], [1, 0], [3, 0], [3, 5], [3, 0]], [[0, 0], [1, 0], [2, 0], [3, 0], [4, 0]]]
    )
    torch.testing.assert_close(self_direction_loss(pred, None, 2.0), torch.tensor(1.5))
    assert self_direction_loss(pred[:, :2], None, 2.0).item() == 0


@pytest.mark.parametrize("case", ["closed", "many"])
def test_self_direction_equals_the_golden_one(golden_dir, case):
    models = golden_dir / "models"
    golden = np.load(models / f"mapvr_headloss_{case}_A.npz")
    preds = np.load(models / "maptr_r50_forward_reduced_A.npz")["all_pts_preds"][:, 0]
    for layer, pred in enumerate(torch.from_numpy(preds)):
        query = golden[f"match_l{layer}"][:, 0]
        points_m = pred[query] * torch.tensor([30.0, 60.0]) - torch.tensor([15.0, 30.0])
        value = given(SelfDirectionLoss(), points_m, None, len(query))
        name = f"loss/d{layer}.loss_dir" if layer < 5 else "loss/loss_dir"
        assert value.item() == pytest.approx(float(golden[name]), rel=1e-4)


@pytest.mark.parametrize("loss", [points_loss, direction_loss, self_direction_loss])
def test_no_match_gives_a_zero_with_a_gradient(loss):
    pred = torch.zeros(0, 20, 2, requires_grad=True)
    value = loss(pred, torch.zeros(0, 20, 2), 1.0)
    assert value.item() == 0.0
    value.backward()
    assert pred.grad.shape == (0, 20, 2)


@pytest.mark.parametrize("loss", [points_loss, direction_loss, self_direction_loss])
def test_gradients(loss):
    torch.manual_seed(0)
    pred = torch.randn(2, 4, 2, dtype=torch.float64, requires_grad=True)
    target = torch.randn(2, 4, 2, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda p: loss(p, target, 3.0), [pred])


@pytest.mark.parametrize("loss", [direction_loss, self_direction_loss])
def test_equal_neighbours_do_not_break_the_direction(loss):
    pred = torch.zeros(1, 3, 2, requires_grad=True)
    loss(pred, torch.rand(1, 3, 2), 1.0).backward()
    assert torch.isfinite(pred.grad).all()


@pytest.mark.parametrize("loss", [points_loss, direction_loss])
def test_other_shapes_are_refused(loss):
    with pytest.raises(ValueError, match=r"target must have shape \(2, 4, 2\) of pred"):
        loss(torch.rand(2, 4, 2), torch.rand(1, 4, 2), 1.0)


def test_a_misspelt_flag_is_refused_as_an_argument_and_as_an_attribute():
    with pytest.raises(TypeError, match="last_layer_onyl"):
        PointsLoss(last_layer_onyl=True)
    with pytest.raises(TypeError, match=r"Late sets \['last_layer_onyl'\] as attributes .*MapLoss"):

        class Late(MapLoss):
            name = "late"
            last_layer_onyl = True


def test_every_loss_of_pairs_takes_the_flags():
    for kind in (PointsLoss, DirectionLoss, SelfDirectionLoss):
        loss = kind(last_layer_only=True, first_group_only=True)
        assert loss.last_layer_only
        assert loss.first_group_only
        assert not kind().last_layer_only
        assert not kind().first_group_only
