import math

import pytest
import torch
from head_cases import bev
from mmdet3d.structures import Det3DDataSample

from gsmap.models.mgmapnet.aux_heads import NormedPVMaskHead


def test_masks_of_each_class_in_the_cameras_by_hand():
    """Logits 0, and nothing is drawn: p = 1/2 on the 36 pixels of each camera."""
    gt = Det3DDataSample(metainfo={"token": "a"})
    gt.gt_pv_seg = torch.zeros(2, 3, 3, 4)
    head = NormedPVMaskHead(16, num_masks=3, loss_weight=2.0, pos_weight=1.0, dice_weight=3.0)
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    dice = 1 - 1 / (36 / 2 + 1)
    assert head.loss(bev(), [gt]).item() == pytest.approx(2 * math.log(2) + 3 * dice)
