"""Mask losses by hand; tests/reference compares them with the original."""

import math

import pytest
import torch

from gsmap.models.losses.segmentation import class_mask_losses, instance_mask_losses, pair_masks


def test_dice_takes_all_classes_of_a_sample_together():
    """Logits 0, so p = 1/2 everywhere: two samples of two classes and 1 x 2 cells.

    Sample 0 has one cell of truth: 1 - (2 * 0.5 + 1) / (2 + 1 + 1); sample 1 none: 1 - 1 / 3.
    """
    truth = torch.zeros(2, 2, 1, 2)
    truth[0, 1, 0, 0] = 1
    cross_entropy, dice = class_mask_losses(torch.zeros(2, 2, 1, 2), truth)
    assert cross_entropy.item() == pytest.approx(math.log(2))
    assert dice.item() == pytest.approx((1 - 2 / 4 + 1 - 1 / 3) / 2)


def test_instances_are_summed_over_the_divisor():
    truth = torch.tensor([[[1.0, 0.0]], [[0.0, 0.0]], [[1.0, 1.0]]])
    cross_entropy, dice = instance_mask_losses(torch.zeros(3, 1, 2), truth, avg_factor=6)
    assert cross_entropy.item() == pytest.approx(3 * math.log(2) / 6)
    assert dice.item() == pytest.approx((1 - 2 / 3 + 1 - 1 / 2 + 1 - 3 / 4) / 6)


def test_nothing_matched_gives_zero_with_a_gradient():
    logits = torch.zeros(0, 4, 5, requires_grad=True)
    sum(instance_mask_losses(logits, torch.zeros(0, 4, 5), 1.0)).backward()
    assert logits.grad.shape == logits.shape


def test_the_released_pairing_is_right_only_for_a_sorted_matching():
    query, gt = torch.tensor([7, 2, 9]), torch.tensor([0, 1, 2])
    assert [x.tolist() for x in pair_masks(query, gt)] == [[7, 2, 9], [0, 1, 2]]
    assert [x.tolist() for x in pair_masks(query, gt, "released")] == [[2, 7, 9], [0, 1, 2]]
    with pytest.raises(ValueError, match=r"pairing must be one of .*, got 'sorted'"):
        pair_masks(query, gt, "sorted")


def test_other_shapes_are_named():
    with pytest.raises(ValueError, match=r"shape \(3, 1, 2\) of logits, got \(2, 1, 2\)"):
        instance_mask_losses(torch.zeros(3, 1, 2), torch.zeros(2, 1, 2), 1)
    with pytest.raises(ValueError, match="target must have shape"):
        class_mask_losses(torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4))
