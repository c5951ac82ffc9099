"""Small networks that predict masks: of classes in BEV and camera view, of instances in BEV."""

from torch import nn


def bev_mask_head(embed_dims: int, num_masks: int) -> nn.Sequential:
    """Return a 3x3 and a 1x1 convolution. (B, C, H, W) -> (B, num_masks, H, W)"""
    return nn.Sequential(
        nn.Conv2d(embed_dims, embed_dims, 3, padding=1, bias=False),
        nn.ReLU(True),
        nn.Conv2d(embed_dims, num_masks, 1),
    )


def camera_mask_head(embed_dims: int, num_masks: int) -> nn.Sequential:
    """Return two 3x3 convolutions with BatchNorm and a 1x1. (B, C, h, w) -> (B, num_masks, h, w)"""
    layers: list[nn.Module] = []
    for _ in range(2):
        layers += [
            nn.Conv2d(embed_dims, embed_dims, 3, padding=1, bias=False),
            nn.BatchNorm2d(embed_dims),
            nn.ReLU(True),
        ]
    return nn.Sequential(*layers, nn.Conv2d(embed_dims, num_masks, 1))


def instance_mask_embedding(embed_dims: int) -> nn.Sequential:
    """Return three matrices that turn instance queries into mask embeddings. (..., C)"""
    layers: list[nn.Module] = []
    for _ in range(2):
        layers += [nn.Linear(embed_dims, embed_dims), nn.ReLU(True)]
    return nn.Sequential(*layers, nn.Linear(embed_dims, embed_dims))
