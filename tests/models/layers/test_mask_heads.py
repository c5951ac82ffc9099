import torch

from gsmap.models.layers.mask_heads import (
    bev_mask_head,
    camera_mask_head,
    instance_mask_embedding,
)


def test_masks_have_a_channel_each_and_the_size_of_the_features():
    feats = torch.randn(2, 4, 6, 5)
    assert bev_mask_head(4, 3)(feats).shape == (2, 3, 6, 5)
    assert camera_mask_head(4, 3)(feats).shape == (2, 3, 6, 5)
    assert instance_mask_embedding(4)(torch.randn(2, 7, 4)).shape == (2, 7, 4)
