import math
from functools import partial

import pytest
import torch
from predictions import pairs_of

from gsmap.models.base.losses import MapLoss
from gsmap.models.maptr.losses import DirectionLoss, PointsLoss


def given(loss, pred, target, avg_factor):
    """Return a loss of points that are normalised and in metres alike."""
    points = {"pred_pts": pred, "pred_pts_m": pred, "gt_pts": target, "gt_pts_m": target}
    return loss(pairs_of(**points, avg_factor=avg_factor))


points_loss, direction_loss = (partial(given, loss(1.0)) for loss in (PointsLoss, DirectionLoss))


def test_points_loss_by_hand():
    pred = torch.tensor([[[0.0, 0.0], [1.0, 2.0]]])
    target = torch.tensor([[[0.5, 0.0], [1.0, 0.0]]])
    assert given(PointsLoss(loss_weight=4.0), pred, target, 2.0).item() == 4 * 1.25


def test_a_pair_has_the_weight_of_its_class():
    pred, labels = torch.ones(2, 3, 2), torch.tensor([2, 0])
    pairs = pairs_of(pred_pts=pred, gt_pts=0 * pred, gt_labels=labels, avg_factor=2.0)
    assert PointsLoss(loss_weight=(1.0, 5.0, 3.0))(pairs).item() == 6 * (1 + 3) / 2


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


@pytest.mark.parametrize("loss", [points_loss, direction_loss])
def test_no_match_gives_a_zero_with_a_gradient(loss):
    pred = torch.zeros(0, 20, 2, requires_grad=True)
    value = loss(pred, torch.zeros(0, 20, 2), 1.0)
    assert value.item() == 0.0
    value.backward()
    assert pred.grad.shape == (0, 20, 2)


@pytest.mark.parametrize("loss", [points_loss, direction_loss])
def test_gradients(loss):
    torch.manual_seed(0)
    pred = torch.randn(2, 4, 2, dtype=torch.float64, requires_grad=True)
    target = torch.randn(2, 4, 2, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda p: loss(p, target, 3.0), [pred])


def test_equal_neighbours_do_not_break_the_direction():
    pred = torch.zeros(1, 3, 2, requires_grad=True)
    direction_loss(pred, torch.rand(1, 3, 2), 1.0).backward()
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
    for kind in (PointsLoss, DirectionLoss):
        loss = kind(last_layer_only=True, first_group_only=True)
        assert loss.last_layer_only
        assert loss.first_group_only
        assert not kind().last_layer_only
        assert not kind().first_group_only
