"""HDMapNet's BEV network: class logits, instance embeddings and directions of each pixel."""

from typing import Any, NamedTuple, cast

from mmdet.models.backbones.resnet import BasicBlock
from torch import Tensor, nn

from gsmap.checkpoints.class_axes import mark_classes
from gsmap.models.base.layers import resize_map, resnet_stages
from gsmap.models.hdmapnet.encoder import JoinedMaps, conv_block


class LineMaps(NamedTuple):
    """Predictions for each pixel of the BEV features."""

    semantic: Tensor  # logits of the background and the classes (B, 1 + classes, H, W)
    embedding: Tensor  # instance embeddings, similar within an element (B, E, H, W)
    # Logits of K ranges of the direction of the line at a pixel; the first logit is for no line.
    direction: Tensor  # (B, 1 + K, H, W)


class FineMaps(nn.Sequential):
    """Prediction branch that resizes features to the resolution of the output.

    Args:
        inputs: Channels C of the features.
        outputs: Channels D of the predictions.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        hidden = inputs // 2
        projection = nn.Conv2d(hidden, outputs, kernel_size=1)
        super().__init__(*conv_block(inputs, hidden), projection)

    def forward(self, feats: Tensor, like: Tensor) -> Tensor:  # type: ignore[override]
        """Predict at the resolution of another tensor.

        Args:
            feats: Features. (B, C, h, w)
            like: Tensor of the wanted resolution, with any number of channels. (B, ..., H, W)

        Returns:
            Predictions. (B, D, H, W)
        """
        return super().forward(resize_map(feats, like.shape[-2:]))


class LineMapDecoder(nn.Module):
    """Three stages of ResNet-18 and three prediction branches (HDMapNet, section III-C).

    The branches take the features of the first and the last stage.

    Args:
        embed_dims: Channels C of the BEV features.
        num_classes: Number of classes.
        embedding_dims: Channels E of the instance embedding.
        num_directions: Number K of directions, which divide the full circle.
        shared_direction_block: Whether the directions share the first block of the embeddings, as
            in the released code; the paper has a separate block.
        base_channels: Channels of the first stage, doubled in each further stage.
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
        widths = (base_channels, 2 * base_channels, 4 * base_channels)
        self.stem, self.stages = resnet_stages(BasicBlock, embed_dims, widths=widths)
        self.joined = nn.ModuleList()
        for _ in range(2 if shared_direction_block else 3):
            # Joins the features of the first stage with the resized features of the last one.
            self.joined.append(JoinedMaps(widths[0] + widths[2], widths[2]))
        if shared_direction_block:
            # The released code runs the shared block twice per step, so its running statistics
            # are updated twice. An update keeps the share (1 - momentum) of the old statistics, and
            # two updates keep the square of this share. One update with the momentum below has an
            # equal effect.
            for module in self.joined[1].modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.momentum = 1 - (1 - cast(float, module.momentum)) ** 2
        self.maps = nn.ModuleList()
        for channels in (1 + num_classes, embedding_dims, 1 + num_directions):
            self.maps.append(FineMaps(widths[2], channels))
        semantic_branch: Any = self.maps[0]
        mark_classes(semantic_branch[-1], first=1)  # the first output is the background

    def init_weights(self) -> None:
        """Initialise the stages. The other layers keep torch's initial weights.

        Convolutions follow Kaiming's method. The last normalisation of each block has weight 0, so
        that the block initially returns its shortcut alone.
        """
        for module in self.stages.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            elif isinstance(module, BasicBlock):
                nn.init.zeros_(module.norm2.weight)

    def forward(self, bev_feats: Tensor) -> LineMaps:
        """Predict at the resolution of the BEV features. (B, C, H, W) -> (B, ..., H, W) each"""
        first, _, last = self.stage_maps(bev_feats)
        # Each block joins the maps of the first and the last stage. The first block is for the
        # classes, the second for the embeddings, and the last for the directions. With a shared
        # block, the last block is the second one.
        blocks = [block(first, last) for block in self.joined]
        semantic_branch, embedding_branch, direction_branch = self.maps
        return LineMaps(
            semantic=semantic_branch(blocks[0], like=bev_feats),
            embedding=embedding_branch(blocks[1], like=bev_feats),
            direction=direction_branch(blocks[-1], like=bev_feats),
        )

    def stage_maps(self, bev_feats: Tensor) -> list[Tensor]:
        """Compute the features of each stage, at 1/2, 1/4 and 1/8 of the size of (B, C, H, W)."""
        feats = self.stem(bev_feats)
        outputs = []
        for stage in self.stages:
            feats = stage(feats)
            outputs.append(feats)
        return outputs
