"""The direction loss of the prediction alone."""

import numpy as np
import pytest
import torch
from predictions import pairs_of

from gsmap.models.mapvr.losses import SelfDirectionLoss


def self_direction(
    pred_m: torch.Tensor, avg_factor: float, loss_weight: float = 1.0
) -> torch.Tensor:
    """Return the loss of points in metres."""
    return SelfDirectionLoss(loss_weight)(pairs_of(pred_pts_m=pred_m, avg_factor=avg_factor))


def test_self_direction_by_hand():
    """A straight step (0), a right angle (1), a fold back (2); a ring's two ends are no pair."""
    pred = torch.tensor(
        [[[0.0, 0], [1, 0], [3, 0], [3, 5], [3, 0]], [[0, 0], [1, 0], [2, 0], [3, 0], [4, 0]]]
    )
    torch.testing.assert_close(self_direction(pred, 2.0), torch.tensor(1.5))
    assert self_direction(pred[:, :2], 2.0).item() == 0


@pytest.mark.parametrize("case", ["closed", "many"])
def test_self_direction_equals_the_golden_one(golden_dir, case):
    models = golden_dir / "models"
    golden = np.load(models / f"mapvr_headloss_{case}_A.npz")
    preds = np.load(models / "maptr_r50_forward_reduced_A.npz")["all_pts_preds"][:, 0]
    for layer, pred in enumerate(torch.from_numpy(preds)):
        query = golden[f"match_l{layer}"][:, 0]
        points_m = pred[query] * torch.tensor([30.0, 60.0]) - torch.tensor([15.0, 30.0])
        value = self_direction(points_m, len(query), loss_weight=0.002)
        name = f"loss/d{layer}.loss_dir" if layer < 5 else "loss/loss_dir"
        assert value.item() == pytest.approx(float(golden[name]), rel=1e-4)


def test_no_match_gives_a_zero_with_a_gradient():
    pred = torch.zeros(0, 20, 2, requires_grad=True)
    value = self_direction(pred, 1.0)
    assert value.item() == 0.0
    value.backward()
    assert pred.grad.shape == (0, 20, 2)


def test_its_gradient():
    torch.manual_seed(0)
    pred = torch.randn(2, 4, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda pred: self_direction(pred, 3.0), [pred])


def test_equal_neighbours_do_not_break_it():
    pred = torch.zeros(1, 3, 2, requires_grad=True)
    self_direction(pred, 1.0).backward()
    assert torch.isfinite(pred.grad).all()


def test_it_takes_the_flags_of_a_loss_of_pairs():
    loss = SelfDirectionLoss(last_layer_only=True, first_group_only=True)
    assert loss.last_layer_only
    assert loss.first_group_only
    assert not SelfDirectionLoss().last_layer_only
    assert not SelfDirectionLoss().first_group_only
