"""HDMapNet's BEV network: maps of classes, instance embeddings and directions."""

from typing import NamedTuple, cast

from mmdet.models.backbones.resnet import BasicBlock
from torch import Tensor, nn

from gsmap.models.base.layers import enlarged, resnet_stages
from gsmap.models.hdmapnet.encoder import JoinedMaps, conv_block


class LineMaps(NamedTuple):
    """What the network says of each pixel."""

    semantic: Tensor  # logits of the background and the classes (B, 1 + classes, H, W)
    embedding: Tensor  # alike on one element (B, E, H, W)
    direction: Tensor  # logits of none and of the directions (B, 1 + K, H, W)


class FineMaps(nn.Sequential):
    """Enlarge a map of half the size, and say something of each pixel."""

    def __init__(self, inputs: int, outputs: int) -> None:
        hidden = inputs // 2
        super().__init__(*conv_block(inputs, hidden), nn.Conv2d(hidden, outputs, 1))

    def forward(self, feats: Tensor, like: Tensor) -> Tensor:  # type: ignore[override]
        """Return a map as large as ``like``. (B, C, h, w), (B, _, H, W) -> (B, outputs, H, W)"""
        return super().forward(enlarged(feats, like.shape[-2:]))


class LineMapDecoder(nn.Module):
    """Three stages of ResNet-18, and three decoders on the first and the last (HDMapNet, III-C).

    Args:
        embed_dims: Channels of the BEV features.
        num_classes: Number of classes.
        embedding_dims: Channels E of the embedding.
        num_directions: Directions K.
        shared_direction_block: Whether directions share the first block of the embeddings, as
            released; its own was meant.
        base_channels: Channels of the first stage; each further one has twice as many.
    """

    def __init__(
        self,
        embed_dims: int,
        num_classes: int,
        embedding_dims: int,
        num_directions: int,
        shared_direction_block: bool = True,
        base_channels: int = 64,
    ) -> None:
        super().__init__()
        widths = base_channels, 2 * base_channels, 4 * base_channels
        self.stem, self.stages = resnet_stages(BasicBlock, embed_dims, widths)
        number = 2 if shared_direction_block else 3
        blocks = [JoinedMaps(widths[0] + widths[2], widths[2]) for _ in range(number)]
        self.joined = nn.ModuleList(blocks)
        if shared_direction_block:  # the release runs it twice, so its statistics learn faster
            for part in blocks[1]:
                if isinstance(part, nn.BatchNorm2d):
                    part.momentum = 1 - (1 - cast(float, part.momentum)) ** 2
        outputs = 1 + num_classes, embedding_dims, 1 + num_directions
        self.maps = nn.ModuleList(FineMaps(widths[2], channels) for channels in outputs)

    def init_weights(self) -> None:
        """Initialise the stages as ResNets are; the last normalisation of a block begins at 0."""
        for part in self.stages.modules():
            if isinstance(part, nn.Conv2d):
                nn.init.kaiming_normal_(part.weight, mode="fan_out", nonlinearity="relu")
            elif isinstance(part, BasicBlock):
                nn.init.zeros_(part.norm2.weight)

    def forward(self, bev_feats: Tensor) -> LineMaps:
        """Return maps of the features' size. (B, C, H, W)"""
        first, _, last = self.stage_maps(bev_feats)
        blocks = [block(first, last) for block in self.joined]
        semantic, embedding, direction = self.maps
        return LineMaps(
            semantic(blocks[0], bev_feats),
            embedding(blocks[1], bev_feats),
            direction(blocks[-1], bev_feats),
        )

    def stage_maps(self, bev_feats: Tensor) -> list[Tensor]:
        """Return what the stages make: a half, a quarter and an eighth of the size."""
        feats, found = self.stem(bev_feats), []
        for stage in self.stages:
            feats = stage(feats)
            found.append(feats)
        return found
