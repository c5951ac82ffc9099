"""MGMap's neck: BEV features of four levels, and one map of all of them."""

from typing import Any

import torch
from mmdet.models.backbones.resnet import BasicBlock
from torch import Tensor, nn

from gsmap.models.base.layers import enlarged, resnet_stages


class Gates(nn.Module):
    """Weigh the channels of a map, then its cells, each by means and maxima over the other."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = max(channels // 16, 1)
        self.channel = nn.Sequential(
            nn.Conv2d(channels, hidden, 1, bias=False),
            nn.ReLU(),
            nn.Conv2d(hidden, channels, 1, bias=False),
        )
        self.space = nn.Conv2d(2, 1, 7, padding=3, bias=False)

    def forward(self, feats: Tensor) -> Tensor:
        """Return the weighted map. (B, C, H, W)"""
        pooled = feats.mean((2, 3), keepdim=True), feats.amax((2, 3), keepdim=True)
        feats = feats * sum(self.channel(part) for part in pooled).sigmoid()
        summary = torch.cat([feats.mean(1, keepdim=True), feats.amax(1, keepdim=True)], 1)
        return feats * self.space(summary).sigmoid()


class GatedBlock(BasicBlock):
    """ResNet's basic block, gated behind its second normalisation."""

    def __init__(self, inplanes: int, planes: int, *args: Any, **kwargs: Any) -> None:
        super().__init__(inplanes, planes, *args, **kwargs)
        self.gates = Gates(planes)

    def forward(self, feats: Tensor) -> Tensor:
        """Return the block's output. (B, C, H, W)"""
        inner = self.relu(self.norm1(self.conv1(feats)))
        kept = feats if self.downsample is None else self.downsample(feats)
        return self.relu(self.gates(self.norm2(self.conv2(inner))) + kept)


class EnhancedNeck(nn.Module):
    """Three stages of gated blocks on the BEV features, which are then put together (MGMap).

    The stages have a quarter, a half and all of the C channels.
    """

    num_levels = 4

    def __init__(self, embed_dims: int = 256) -> None:
        super().__init__()
        widths = embed_dims // 4, embed_dims // 2, embed_dims
        self.stem, self.stages = resnet_stages(GatedBlock, embed_dims, widths)
        self.fusion = nn.Sequential(
            nn.Conv2d(sum(widths), embed_dims, 3, padding=1, bias=False),
            nn.BatchNorm2d(embed_dims),
            nn.LeakyReLU(0.01),
        )
        self.levels = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(width, embed_dims, 1), nn.GroupNorm(min(32, embed_dims), embed_dims)
            )
            for width in (*widths, embed_dims)
        )

    def forward(self, bev_feats: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return one map of all stages (B, C, H, W), and the levels (B, C, h, w)."""
        feats = stem = self.stem(bev_feats)
        maps = []
        for stage in self.stages:
            feats = stage(feats)
            maps.append(feats)
        fused = self.fusion(torch.cat([enlarged(m, bev_feats.shape[2:]) for m in maps], 1))
        maps.append(enlarged(fused, stem.shape[2:]))
        return fused, [level(m) for level, m in zip(self.levels, maps, strict=True)]
