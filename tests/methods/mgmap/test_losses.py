"""MGMap's losses, by hand."""

from types import SimpleNamespace

import pytest
import torch
from predictions import pairs_of

from gsmap.engine.launch import check_config, read_config
from gsmap.models.mgmap.decoder import MaskedDecoded
from gsmap.models.mgmap.losses import ForegroundLoss, QueryMaskLoss


def test_masks_of_queries_by_hand():
    """Two queries of two cells, logits 0: the cross-entropy log 2 of all, times half of them."""
    states, drawn = torch.zeros(1, 2, 1), torch.tensor([[[False, True]], [[True, False]]])
    logits = torch.zeros(1, 2, 1, 2, requires_grad=True)
    pairs = pairs_of(
        predictions=SimpleNamespace(decoded=MaskedDecoded(states, states, states, logits)),
        samples=torch.tensor([0]),
        query_inds=torch.tensor([1]),
        truths=SimpleNamespace(pipeline_masks=drawn),
        of_truths=lambda values: values[[1]],
        of_queries=lambda values: values[[0], [1]],
    )
    dice = 1 - 2 * 0.5 / (0.25 + 0.25 + 1 + 0.002)
    loss = QueryMaskLoss(loss_weight=3.0, dice_weight=5.0)(pairs)
    assert loss.item() == pytest.approx(3 * 0.5 * 0.693147 + 5 * dice / 2, rel=1e-5)
    loss.backward()
    assert logits.grad[0, 0].gt(0).all()  # a query without a match should be empty


def test_the_segmentation_by_hand():
    """One sample of two cells, one drawn; a second one without elements is all background."""
    logits = torch.zeros(2, 2, 1, 2)
    drawn = torch.tensor([[[True, False]], [[True, False]]])
    pairs = pairs_of(
        predictions=SimpleNamespace(decoded=SimpleNamespace(segmentation=logits)),
        truths=SimpleNamespace(pipeline_masks=drawn, counts=[2, 0]),
    )
    cross_entropy = 0.693147 * (4 + 1) / 2  # half of the cells are positive, four times as heavy
    dice = 1 - 2 * 1.0 / (1.0 + 2 + 0.002)
    loss = ForegroundLoss(loss_weight=1.0, dice_weight=2.0)(pairs)
    assert loss.item() == pytest.approx(cross_entropy + 2 * dice, rel=1e-5)


def test_a_pipeline_without_masks_is_refused_before_training():
    cfg = read_config("configs/mgmap/mgmap_r18_minicity.py")
    check_config(cfg)
    dataset = cfg.train_dataloader.dataset
    dataset.pipeline = [step for step in dataset.pipeline if step.type != "MakeInstanceMasks"]
    with pytest.raises(ValueError, match="ForegroundLoss needs the targets of MakeInstanceMasks"):
        check_config(cfg)
