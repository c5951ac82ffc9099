"""Small networks of heads and encoders, resizing of feature maps, and initialisation."""

from collections.abc import Sequence
from itertools import pairwise

import torch.nn.functional as F
from mmcv.cnn.bricks.transformer import FFN
from mmdet.models.layers import ResLayer
from torch import Tensor, nn


def mlp(*dims: int) -> nn.Sequential:
    """Multilayer perceptron with a ReLU between its linear layers.

    The ReLUs do not run in place, because a linear layer returns a view. The backward pass of an
    in-place change of a view needs an extra tensor of zeros and two copies.

    Args:
        dims: Channels of the input, of each hidden layer, and of the output.
    """
    layers: list[nn.Module] = []
    for in_dims, out_dims in pairwise(dims):
        layers.append(nn.Linear(in_dims, out_dims))
        layers.append(nn.ReLU())
    layers.pop()  # no ReLU after the output
    return nn.Sequential(*layers)


def feed_forward(embed_dims: int, ffn_dims: int, dropout: float) -> FFN:
    """Feed-forward network of mmcv, including the residual.

    The ReLU does not run in place, for the reason that `mlp` gives.

    Args:
        embed_dims: Channels of the input and the output.
        ffn_dims: Hidden channels.
        dropout: Probability to drop a value in training.
    """
    return FFN(embed_dims, ffn_dims, act_cfg={"type": "ReLU"}, ffn_drop=dropout)


def classification_branch(embed_dims: int, num_classes: int) -> nn.Sequential:
    """Classifier with two hidden layers, each followed by LayerNorm and ReLU.

    Args:
        embed_dims: Channels of the input and the hidden layers.
        num_classes: Number of logits.
    """
    layers: list[nn.Module] = []
    for _ in range(2):
        layers.append(nn.Linear(embed_dims, embed_dims))
        layers.append(nn.LayerNorm(embed_dims))
        layers.append(nn.ReLU(True))  # in place: LayerNorm returns no view, unlike Linear (`mlp`)
    layers.append(nn.Linear(embed_dims, num_classes))
    return nn.Sequential(*layers)


def resnet_stages(
    block: type[nn.Module], inputs: int, widths: Sequence[int]
) -> tuple[nn.Sequential, nn.ModuleList]:
    """Stem of a ResNet without pooling, and stages of two blocks.

    The stem halves the resolution of its input, and so does each stage but the first.

    Args:
        block: Class of the blocks, such as mmdet's ``BasicBlock``.
        inputs: Channels of the input.
        widths: Channels of each stage; the stem has the channels of the first one.

    Returns:
        The stem, and the stages, which the caller runs one after the other.
    """
    stem = nn.Sequential(
        nn.Conv2d(inputs, widths[0], kernel_size=7, stride=2, padding=3, bias=False),
        nn.BatchNorm2d(widths[0]),
        nn.ReLU(True),
    )
    stages = nn.ModuleList()
    in_channels = widths[0]
    for channels in widths:
        stride = 2 if len(stages) else 1  # the first stage keeps the resolution of the stem
        stages.append(ResLayer(block, in_channels, channels, num_blocks=2, stride=stride))
        in_channels = channels
    return stem, stages


def resize_map(feats: Tensor, shape: Sequence[int]) -> Tensor:
    """Resize a feature map bilinearly. The centres of the corner cells keep their place.

    Args:
        feats: Feature map. (B, C, H, W)
        shape: Rows and columns of the result.

    Returns:
        The resized map. (B, C, *shape)
    """
    return F.interpolate(feats, size=tuple(shape), mode="bilinear", align_corners=True)


# Ends of the names of matrices that `init_matrices` leaves as they are, because their modules have
# initialised them. At first, these layers do not depend on the query.
_SAMPLING = ("sampling_offsets.weight", "attention_weights.weight", "height_offsets.weight")


def init_matrices(module: nn.Module) -> None:
    """Initialise the matrices of a transformer from Xavier's uniform distribution.

    Weights of convolutions count as matrices, biases and norms do not. The matrices that predict
    sampling offsets, attention weights and heights in deformable attention are left as they are.
    """
    for name, parameter in module.named_parameters():
        if parameter.dim() > 1 and not name.endswith(_SAMPLING):
            nn.init.xavier_uniform_(parameter)
