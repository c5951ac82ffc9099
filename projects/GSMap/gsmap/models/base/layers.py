"""The small networks that turn states into predictions, codes and embeddings; enlarging maps."""

from collections.abc import Sequence
from itertools import pairwise

import torch.nn.functional as F
from mmcv.cnn.bricks.transformer import FFN
from mmdet.models.layers import ResLayer
from torch import Tensor, nn


def mlp(*dims: int) -> nn.Sequential:
    """Return matrices from each number of channels to the next, with ReLUs in between.

    The ReLUs are not in place: a matrix returns a view of its result, and a change of a view in
    place costs zeros and two copies in the backward pass.
    """
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(dims):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def feed_forward(embed_dims: int, ffn_dims: int, dropout: float) -> FFN:
    """Return mmcv's feed-forward network with its residual; its ReLU as in `mlp`.

    Args:
        embed_dims: Channels of input and output.
        ffn_dims: Channels between.
        dropout: Share of values set to zero in training.
    """
    return FFN(embed_dims, ffn_dims, act_cfg={"type": "ReLU"}, ffn_drop=dropout)


def classification_branch(embed_dims: int, num_classes: int) -> nn.Sequential:
    """Return a classifier of two hidden layers, each with LayerNorm; it gives logits."""
    layers: list[nn.Module] = []
    for _ in range(2):
        layers += [nn.Linear(embed_dims, embed_dims), nn.LayerNorm(embed_dims), nn.ReLU(True)]
    return nn.Sequential(*layers, nn.Linear(embed_dims, num_classes))


def resnet_stages(
    block: type[nn.Module], inputs: int, widths: Sequence[int]
) -> tuple[nn.Sequential, nn.ModuleList]:
    """Return a ResNet's stem without pooling, and stages of two blocks; each further one halves.

    Args:
        block: Class of the blocks.
        inputs: Channels of the map.
        widths: Channels of each stage.
    """
    stem = nn.Sequential(
        nn.Conv2d(inputs, widths[0], 7, 2, 3, bias=False), nn.BatchNorm2d(widths[0]), nn.ReLU(True)
    )
    sizes = zip((widths[0], *widths), widths, strict=False)
    stages = [ResLayer(block, *size, 2, stride=1 + (i > 0)) for i, size in enumerate(sizes)]
    return stem, nn.ModuleList(stages)


def resize_map(feats: Tensor, shape: Sequence[int]) -> Tensor:
    """Resize a map, the centres of its corner cells staying where they are. (B, C, *shape)"""
    return F.interpolate(feats, size=tuple(shape), mode="bilinear", align_corners=True)


_SAMPLING = ("sampling_offsets.weight", "attention_weights.weight", "height_offsets.weight")


def init_matrices(module: nn.Module) -> None:
    """Initialise all matrices of a transformer (Xavier) but those that place and weigh samples."""
    for name, parameter in module.named_parameters():
        if parameter.dim() > 1 and not name.endswith(_SAMPLING):
            nn.init.xavier_uniform_(parameter)
