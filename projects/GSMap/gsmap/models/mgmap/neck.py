"""MGMap's neck, whose output has four levels: BEV features of three stages, and their fusion."""

from typing import Any

import torch
from mmdet.models.backbones.resnet import BasicBlock
from torch import Tensor, nn

from gsmap.models.base.layers import resize_map, resnet_stages


class Gates(nn.Module):
    """Channel attention followed by spatial attention, each from means and maxima (CBAM).

    The channel weights are computed from the mean and the maximum over the cells, and the spatial
    weights from the mean and the maximum over the channels.

    Args:
        channels: Channels C of the map.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = max(channels // 16, 1)
        self.channel = nn.Sequential(
            nn.Conv2d(channels, hidden, kernel_size=1, bias=False),
            nn.ReLU(),
            nn.Conv2d(hidden, channels, kernel_size=1, bias=False),
        )
        self.space = nn.Conv2d(2, 1, kernel_size=7, padding=3, bias=False)

    def forward(self, feats: Tensor) -> Tensor:
        """Weight the channels and the cells of a map. (B, C, H, W) -> (B, C, H, W)"""
        mean_logits = self.channel(feats.mean(dim=(2, 3), keepdim=True))  # (B, C, 1, 1)
        max_logits = self.channel(feats.amax(dim=(2, 3), keepdim=True))
        feats = feats * (mean_logits + max_logits).sigmoid()
        cell_mean = feats.mean(dim=1, keepdim=True)  # (B, 1, H, W)
        cell_largest = feats.amax(dim=1, keepdim=True)
        cell_logits = self.space(torch.cat([cell_mean, cell_largest], dim=1))
        return feats * cell_logits.sigmoid()


class GatedBlock(BasicBlock):
    """ResNet's basic block with `Gates` after its second normalisation.

    Args:
        inplanes: Input channels.
        planes: Output channels.
        kwargs: Further arguments of mmdet's ``BasicBlock``.
    """

    def __init__(self, inplanes: int, planes: int, **kwargs: Any) -> None:
        super().__init__(inplanes, planes, **kwargs)
        self.gates = Gates(planes)

    def forward(self, feats: Tensor) -> Tensor:
        """Apply the block. (B, inplanes, H, W) -> (B, planes, H / stride, W / stride)"""
        hidden = self.relu(self.norm1(self.conv1(feats)))
        residual = self.gates(self.norm2(self.conv2(hidden)))
        shortcut = feats if self.downsample is None else self.downsample(feats)
        return self.relu(residual + shortcut)


class EnhancedNeck(nn.Module):
    """BEV neck of three stages of gated blocks and a fusion of their outputs (MGMap).

    The stages have C / 4, C / 2 and C channels. A stem before them halves the resolution, and so do
    the second and the third stage.

    Args:
        embed_dims: Channels C of the BEV features.

    Attributes:
        num_levels: Number of levels that `forward` returns.
    """

    num_levels = 4

    def __init__(self, embed_dims: int = 256) -> None:
        super().__init__()
        widths = (embed_dims // 4, embed_dims // 2, embed_dims)
        self.stem, self.stages = resnet_stages(GatedBlock, embed_dims, widths=widths)
        self.fusion = nn.Sequential(
            nn.Conv2d(sum(widths), embed_dims, kernel_size=3, padding=1, bias=False),
            nn.BatchNorm2d(embed_dims),
            nn.LeakyReLU(0.01),
        )
        self.levels = nn.ModuleList()
        for width in (*widths, embed_dims):  # channels of the stages and of the fusion
            conv = nn.Conv2d(width, embed_dims, kernel_size=1)
            norm = nn.GroupNorm(min(32, embed_dims), embed_dims)
            self.levels.append(nn.Sequential(conv, norm))

    def forward(self, bev_feats: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Enhance BEV features.

        Args:
            bev_feats: BEV features. (B, C, H, W)

        Returns:
            Fusion of all stages (B, C, H, W), and maps of four levels (B, C, h, w). The first three
            levels are the outputs of the stages at their sizes. The fourth level is the fusion,
            resized to the size of the output of the stem, which is half of (H, W).
        """
        stem = self.stem(bev_feats)
        feats = stem
        maps = []
        for stage in self.stages:
            feats = stage(feats)
            maps.append(feats)
        size = bev_feats.shape[2:]  # (H, W)
        resized_maps = [resize_map(feats, size) for feats in maps]
        fused_feats = self.fusion(torch.cat(resized_maps, dim=1))
        maps.append(resize_map(fused_feats, stem.shape[2:]))
        levels = [level(feats) for level, feats in zip(self.levels, maps, strict=True)]
        return fused_feats, levels
