import torch

from gsmap.models.layers.mask_heads import (
    bev_mask_head,
    camera_mask_head,
    instance_mask_embedding,
    instance_mask_logits,
)


def test_masks_have_a_channel_each_and_the_size_of_the_features():
    feats = torch.randn(2, 4, 6, 5)
    assert bev_mask_head(4, 3)(feats).shape == (2, 3, 6, 5)
    assert camera_mask_head(4, 3)(feats).shape == (2, 3, 6, 5)
    embeddings = instance_mask_embedding(4)(torch.randn(2, 7, 4))
    assert instance_mask_logits(embeddings, feats).shape == (2, 7, 6, 5)


def test_an_instance_mask_is_the_product_with_each_cell():
    feats = torch.tensor([[1.0, 0.0], [2.0, -1.0]]).view(1, 2, 1, 2)  # cells (1, 2) and (0, -1)
    logits = instance_mask_logits(torch.tensor([[[3.0, 10.0]]]), feats)
    assert logits.tolist() == [[[[23.0, -10.0]]]]
