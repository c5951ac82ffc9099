import numpy as np
import pytest
import torch

from gsmap.models.losses.dice import (
    ElementRenderer,
    RenderedDiceLoss,
    dice_loss,
    pairwise_dice_loss,
    rendered_dice_cost,
)


@pytest.fixture(params=["closed", "many"])
def golden(request, golden_dir):
    arrays = np.load(golden_dir / "models/mapvr_dice_A.npz")
    prefix = request.param + "_"
    names = [name for name in arrays.files if name.startswith(prefix)]
    return {name[len(prefix) :]: torch.from_numpy(arrays[name]) for name in names}


def test_dice_worked_by_hand():
    """1 - (2 (1 * 0.5) + 1) / (1.5 + 1 + 1) = 1 - 2 / 3.5"""
    pred, target = torch.tensor([[[1.0, 0.5, 0.0]]]), torch.tensor([[[0.5, 0.0, 0.5]]])
    torch.testing.assert_close(dice_loss(pred, target), torch.tensor([1 - 2 / 3.5]))
    torch.testing.assert_close(pairwise_dice_loss(pred, target), torch.tensor([[1 - 2 / 3.5]]))


def test_pairs_are_rendered_as_the_ground_truths_class():
    """A ring costs nothing against itself in either class, and its area differs from its edge."""
    ring = torch.tensor([[[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8], [0.2, 0.2]]])
    labels, renderer = torch.tensor([2, 0]), ElementRenderer((32, 32), polygon_classes=(2,))
    cost = rendered_dice_cost(ring, ring.repeat(2, 1, 1), labels, renderer)
    area, edge = renderer.render(ring.repeat(2, 1, 1), torch.tensor([True, False]))
    assert area[16, 16] > 0.99
    assert edge[16, 16] < 1e-6
    expected = torch.stack([dice_loss(m[None], m[None])[0] for m in (area, edge)])
    torch.testing.assert_close(cost[0], expected)


def test_loss_and_true_gradient_equal_the_golden_ones(golden):
    pred = golden["pred"].requires_grad_()
    loss = RenderedDiceLoss()(pred, golden["gt"], golden["labels"])
    loss.backward()
    torch.testing.assert_close(loss.double(), golden["loss_w15"], rtol=1e-4, atol=0)
    difference = (pred.grad - golden["grad_analytic"]).norm()
    assert difference < 1e-4 * golden["grad_analytic"].norm()


def test_cost_equals_the_golden_one(golden):
    renderer = ElementRenderer((128, 64))
    cost = 10 * rendered_dice_cost(golden["cost_pred"], golden["gt"], golden["labels"], renderer)
    torch.testing.assert_close(cost, golden["cost_w10"], rtol=1e-4, atol=1e-5)


def test_nothing_matched_gives_zero_with_a_gradient():
    pred = torch.zeros(0, 20, 2, requires_grad=True)
    loss = RenderedDiceLoss()(pred, torch.zeros(0, 20, 2), torch.zeros(0, dtype=torch.long))
    loss.backward()
    assert loss.item() == 0
    assert pred.grad.shape == pred.shape


def test_bad_softness_is_named():
    with pytest.raises(ValueError, match="softness must be > 0"):
        RenderedDiceLoss(line_softness=0)
