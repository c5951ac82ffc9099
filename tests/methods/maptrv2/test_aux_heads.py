"""Auxiliary heads: their losses by hand, and that only training runs them."""

import math

import pytest
import torch
from head_cases import GSMAP, HEAD, N, P, along_y, bev, build_head, elements, with_layer
from mmdet3d.structures import Det3DDataSample

from gsmap.models.base.mask_heads import BEVMaskHead, PVMaskHead
from gsmap.models.maptrv2.aux_heads import DepthSupervision

HEADS = [
    {"type": "BEVMaskHead", "loss_weight": 1.0, "pos_weight": 4.0},
    {"type": "PVMaskHead", "loss_weight": 2.0, "pos_weight": 1.0},
]
V2 = {
    "query_groups": [{"num": N}, {"name": "one2many", "num": 6, "repeats": 3}],
    "decoder": with_layer(HEAD, self_attn={"type": "DecoupledSelfAttention"}),
    "aux_heads": HEADS,
}


def sample(num: int = 1) -> Det3DDataSample:
    result = Det3DDataSample(metainfo={"token": "a"})
    result.gt_instances_3d = elements(*along_y(*range(num)), labels=[i % 3 for i in range(num)])
    result.gt_seg = torch.zeros(1, 10, 5)
    result.gt_seg[0, 2] = 1
    result.gt_pv_seg = torch.zeros(2, 1, 3, 4)
    return result


@pytest.mark.parametrize("num", [0, 1, 3])
@pytest.mark.parametrize("config", [HEAD, GSMAP], ids=["MapTRv2", "GSMap"])
def test_losses_reach_every_parameter(config, num):
    head = build_head({**config, **V2}).train()
    losses = head.loss(bev(), [sample(num)])
    assert {"loss_cls", "d0.loss_cls_one2many", "loss_seg", "loss_pv_seg"} <= set(losses)
    sum(value for name, value in losses.items() if "loss" in name).backward()
    grads = [p.grad for p in head.parameters()]
    assert all(grad is not None for grad in grads)  # or distributed training would hang
    assert all(grad.isfinite().all() for grad in grads)


def test_mask_losses_by_hand():
    heads = BEVMaskHead(16, 1.0, 4.0), PVMaskHead(16, 2.0, 1.0)
    for head in heads:
        for parameter in head.parameters():
            torch.nn.init.zeros_(parameter)  # logits of 0
    seg, pv_seg = (head.loss(bev(), [sample()]).item() for head in heads)
    # a tenth of the BEV cells is foreground, which weighs four times: (4 + 9) / 10 * log 2
    assert seg == pytest.approx(1.3 * math.log(2))
    assert pv_seg == pytest.approx(2 * math.log(2))


def test_masks_of_each_class_by_hand():
    """Logits 0; one of ten rows of the first of three classes is drawn: p = 1/2 on 150 cells."""
    gt = Det3DDataSample(metainfo={"token": "a"})
    gt.gt_seg = torch.zeros(3, 10, 5)
    gt.gt_seg[0, 2] = 1
    settings = {"num_masks": 3, "loss_weight": 2.0, "pos_weight": 1.0, "dice_weight": 3.0}
    head = BEVMaskHead(16, **settings)
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    dice = 1 - (2 * 5 / 2 + 1) / (150 / 2 + 5 + 1)
    assert head.loss(bev(), [gt]).item() == pytest.approx(2 * math.log(2) + 3 * dice)


def test_one_mask_takes_all_classes_together():
    gt = sample()
    head = BEVMaskHead(16)
    single = head.loss(bev(), [gt])
    split = torch.zeros(3, 10, 5)
    split[0, 2, :3] = 1
    split[2, 2, 2:] = 1
    gt.gt_seg = split
    assert torch.equal(head.loss(bev(), [gt]), single)
    with pytest.raises(
        ValueError, match="gt_seg has 1 channels, 3 masks are predicted: set num_cl"
    ):
        BEVMaskHead(16, num_masks=3).loss(bev(), [sample()])


def test_depth_loss_by_hand():
    """Six bins from 1 m, of equal probability; one of two blocks has a return."""
    outputs = {"depth": torch.full((1, 1, 6, 1, 2), 1 / 6), "depth_range": (1.0, 7.0, 1.0)}
    gt = Det3DDataSample(metainfo={"token": "a"})
    gt.gt_depth = torch.zeros(1, 2, 4)
    gt.gt_depth[0, 0, 0] = 2.5
    loss = DepthSupervision(loss_weight=3.0).loss(outputs, [gt])
    assert loss.item() == pytest.approx(3 * math.log(6), rel=1e-6)


@pytest.mark.parametrize(
    ("head", "target", "transform"),
    [
        (BEVMaskHead(16), "gt_seg", "MakeBEVMask"),
        (PVMaskHead(16), "gt_pv_seg", "MakePVMask"),
        (DepthSupervision(), "gt_depth", "MakeDepthMap"),
    ],
)
def test_missing_target_is_named(head, target, transform):
    outputs = {**bev(), "depth": torch.rand(1, 2, 6, 3, 4), "depth_range": (1.0, 7.0, 1.0)}
    with pytest.raises(ValueError, match=rf"'b' has no {target}: add its transform {transform} to"):
        head.loss(outputs, [Det3DDataSample(metainfo={"token": "b"})])


def test_each_can_be_left_out():
    head = build_head({**HEAD, **V2}, aux_heads=HEADS[:1]).train()
    losses = head.loss({"bev_feats": bev()["bev_feats"]}, [sample()])
    assert "loss_seg" in losses
    assert "loss_pv_seg" not in losses


def test_prediction_does_not_run_them():
    head = build_head({**HEAD, **V2}).eval()
    for part in head.aux_heads.values():
        part.register_forward_hook(lambda *_: pytest.fail("an auxiliary head ran"))
    only_bev = {"bev_feats": bev()["bev_feats"]}  # the camera mask would need image features
    result = head.predict(only_bev, [sample(0)])[0]
    assert result.pts.shape[1:] == (P, 2)
