"""Mask losses by hand; reference*.py compares them with the original."""

import math
from types import SimpleNamespace

import pytest
import torch
from predictions import pairs_of
from torch import nn

from gsmap.models.base.mask_heads import class_mask_losses
from gsmap.models.mgmapnet.losses import (
    InstanceMaskLoss,
    SamplingLocationLoss,
    instance_mask_losses,
)


def test_dice_takes_all_classes_of_a_sample_together():
    """Logits 0, so p = 1/2 everywhere: two samples of two classes and 1 x 2 cells.

    Sample 0 has one cell of truth: 1 - (2 * 0.5 + 1) / (2 + 1 + 1); sample 1 none: 1 - 1 / 3.
    """
    truth = torch.zeros(2, 2, 1, 2)
    truth[0, 1, 0, 0] = 1
    cross_entropy, dice = class_mask_losses(torch.zeros(2, 2, 1, 2), truth)
    assert cross_entropy.item() == pytest.approx(math.log(2))
    assert dice.item() == pytest.approx((1 - 2 / 4 + 1 - 1 / 3) / 2)


def test_the_foreground_weighs_in_the_cross_entropy():
    truth = torch.tensor([1, 0]).view(1, 1, 1, 2)
    cross_entropy, _ = class_mask_losses(torch.zeros(1, 1, 1, 2), truth, pos_weight=4.0)
    assert cross_entropy.item() == pytest.approx(2.5 * math.log(2))


def test_instances_are_summed_over_the_divisor():
    truth = torch.tensor([[[1.0, 0.0]], [[0.0, 0.0]], [[1.0, 1.0]]])
    cross_entropy, dice = instance_mask_losses(torch.zeros(3, 1, 2), truth, avg_factor=6)
    assert cross_entropy.item() == pytest.approx(3 * math.log(2) / 6)
    assert dice.item() == pytest.approx((1 - 2 / 3 + 1 - 1 / 2 + 1 - 3 / 4) / 6)


def test_nothing_matched_gives_zero_with_a_gradient():
    logits = torch.zeros(0, 4, 5, requires_grad=True)
    sum(instance_mask_losses(logits, torch.zeros(0, 4, 5), 1.0)).backward()
    assert logits.grad.shape == logits.shape


def instance_loss(**settings):
    """Return the loss on states as they are, without their network."""
    loss = InstanceMaskLoss(2, **settings)
    loss.embedding = nn.Identity()
    return loss


def test_an_instance_mask_is_the_product_with_each_cell():
    feats = torch.tensor([[1.0, 0.0], [2.0, -1.0]]).view(2, 1, 2)  # cells (1, 2) and (0, -1)
    logits = instance_loss().logits(torch.tensor([[3.0, 10.0]]), feats)
    assert logits.tolist() == [[[23.0, -10.0]]]


def pairs(gt_inds, masks):
    """Return states, masks, ground truths and counts of two instances, whose masks differ."""
    states = torch.tensor([[9.0, 0.0], [0.0, 9.0]])  # the first sees channel 0, the other 1
    feats = torch.tensor([[[[1, -1.0]], [[-1, 1.0]]]])
    return given(states, masks, torch.tensor(gt_inds), [2], feats, 2.0)


def given(states, masks, gt_inds, counts, bev_feats, avg_factor):
    """Return matched pairs as `InstanceMaskLoss` reads them."""
    return pairs_of(
        pred_instance_states=states,
        gt_masks=masks,
        gt_inds=gt_inds,
        counts=counts,
        predictions=SimpleNamespace(bev_feats=bev_feats),
        avg_factor=avg_factor,
    )


def test_the_released_pairing_is_right_only_for_a_sorted_matching():
    masks = torch.tensor([[[1.0, 0.0]], [[0.0, 1.0]]])  # what each instance predicts
    right, wrong = 1e-3, 8.0
    for gt_inds, released in (([0, 1], right), ([1, 0], wrong)):
        inputs = pairs(gt_inds, masks)
        assert instance_loss()(inputs) < right
        found = instance_loss(pairing="released")(inputs)
        assert (found < right) == (released == right)
        assert found <= right or found > wrong
    with pytest.raises(ValueError, match=r"pairing must be one of .*, got 'sorted'"):
        InstanceMaskLoss(pairing="sorted")


def test_masks_of_other_samples_do_not_mix():
    """The same state in two samples sees its own sample's features."""
    states, feats = torch.tensor([[9.0, 0.0]] * 2), torch.zeros(2, 2, 1, 2)
    feats[:, 0, 0] = torch.tensor([[1.0, -1.0], [-1.0, 1.0]])
    masks = torch.tensor([[[1.0, 0.0]], [[0.0, 1.0]]])
    inds = torch.tensor([0, 0])
    assert instance_loss()(given(states, masks, inds, [1, 1], feats, 2.0)) < 1e-3
    assert instance_loss()(given(states, masks.flip(0), inds, [1, 1], feats, 2.0)) > 8


def test_finer_masks_are_averaged_over_the_cells():
    """Half of each cell is covered: logits 0 fit, with a cross-entropy of log 2."""
    masks = torch.tensor([[[1.0, 0.0, 1.0, 0.0]] * 2])
    inputs = torch.zeros(1, 2), masks, torch.tensor([0]), [1], torch.ones(1, 2, 1, 2)
    loss = instance_loss(loss_weight=1.0, dice_weight=0.0)(given(*inputs, 1.0))
    assert loss.item() == pytest.approx(math.log(2))


def test_without_a_match_the_network_gets_a_gradient_of_zero():
    loss = InstanceMaskLoss(2)
    inds = torch.zeros(0, dtype=torch.long)
    inputs = torch.zeros(0, 2), torch.zeros(0, 5, 5), inds, [0], torch.ones(1, 2, 4, 4)
    value = loss(given(*inputs, 1.0))
    value.backward()
    assert value == 0
    assert all(p.grad is not None and not p.grad.any() for p in loss.parameters())


def test_other_shapes_are_named():
    with pytest.raises(ValueError, match=r"shape \(3, 1, 2\) of logits, got \(2, 1, 2\)"):
        instance_mask_losses(torch.zeros(3, 1, 2), torch.zeros(2, 1, 2), 1)
    with pytest.raises(ValueError, match=r"targets must have shape \(1, 3, 4, 4\) of logits"):
        class_mask_losses(torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4))


def test_mean_sampling_locations_are_compared_in_the_plane():
    locations = torch.tensor([[[0.5, 0.25], [1.5, 0.0]]])
    points = torch.tensor([[[0.0, 0.25, 9.0], [1.0, 1.0, 9.0]]])
    predictions = SimpleNamespace(decoded=SimpleNamespace(mean_locations=locations))
    pairs = pairs_of(
        predictions=predictions, of_queries=lambda values: values, gt_pts=points, avg_factor=4.0
    )
    loss = SamplingLocationLoss(loss_weight=2.0)(pairs)
    assert loss.item() == pytest.approx(2 * (0.5 + 0.5 + 1.0) / 4)
