"""The loss of the depth that the LSS encoder predicts."""

import numpy as np
import pytest
import torch
from lss_cases import encoder, feats, meta, sample_with_depth
from mmdet3d.structures import Det3DDataSample

from gsmap.models.maptrv2.aux_heads import DepthSupervision


def test_depth_loss_and_its_gradient():
    module, supervision = encoder(), DepthSupervision(loss_weight=3.0)
    outputs = module([feats()], [meta()])
    outputs["depth"] = torch.full((1, 1, 6, 3, 5), 1 / 6)
    loss = supervision.loss(outputs, [sample_with_depth(2.5)])
    assert loss.item() == pytest.approx(3 * np.log(6), rel=1e-5)
    outputs = module([feats()], [meta()])
    supervision.loss(outputs, [sample_with_depth(2.5)]).backward()
    assert module.depth_net.depth_conv[-1].weight.grad.abs().sum() > 0


def test_missing_depth_is_named():
    outputs = encoder()([feats()], [meta()])
    with pytest.raises(ValueError, match=r"sample 'b' has no gt_depth"):
        DepthSupervision().loss(outputs, [Det3DDataSample(metainfo={"token": "b"})])


def test_the_depth_loss_stays_float32_under_mixed_precision():
    outputs = encoder()([feats()], [meta()])
    with torch.autocast("cpu", torch.bfloat16):
        assert DepthSupervision().loss(outputs, [sample_with_depth(2.5)]).dtype == torch.float32
