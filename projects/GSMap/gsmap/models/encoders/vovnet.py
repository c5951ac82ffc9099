"""VoVNetV2, an image backbone (arXiv 1911.06667) in the sizes V2-19 to V2-99.

Modules are named as in the original code (``stem_1/conv``), so that its checkpoints can be loaded.
"""

from collections import OrderedDict
from collections.abc import Sequence

import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.utils.errors import InputError

STEM_CHANNELS = (64, 64, 128)
STAGE_CHANNELS = ((128, 256), (160, 512), (192, 768), (224, 1024))  # (hidden, output) of each stage
LAYERS_AND_BLOCKS = {  # by depth: 3x3 convolutions per block, and blocks of the four stages
    19: (3, (1, 1, 1, 1)),
    39: (5, (1, 1, 2, 2)),
    57: (5, (1, 1, 4, 3)),
    99: (5, (1, 3, 9, 3)),
}


def _convolution(
    name: str, in_channels: int, channels: int, size: int, stride: int = 1
) -> list[tuple[str, nn.Module]]:
    """Convolution, batch norm and ReLU with their names, for an ``OrderedDict``."""
    conv = nn.Conv2d(
        in_channels,
        channels,
        kernel_size=size,
        stride=stride,
        padding=size // 2,
        bias=False,
    )
    return [
        (f"{name}/conv", conv),
        (f"{name}/norm", nn.BatchNorm2d(channels)),
        (f"{name}/relu", nn.ReLU(inplace=True)),
    ]


class OneShotAggregation(nn.Module):
    """Block of 3x3 convolutions, one after another, whose outputs a 1x1 convolution combines.

    The 1x1 convolution also takes the input of the block. A gate weights the channels of its output
    (effective squeeze and excitation, eSE).

    Args:
        name: Prefix of the names of the modules, such as ``OSA2_1``.
        channels: Number of channels of the input, of each 3x3 convolution and of the output.
        num_layers: Number of 3x3 convolutions.
        residual: Whether to add the input of the block to its output.
    """

    def __init__(
        self, name: str, channels: tuple[int, int, int], num_layers: int, residual: bool
    ) -> None:
        super().__init__()
        self.residual = residual
        in_channels, hidden_channels, out_channels = channels
        self.layers = nn.ModuleList()
        for index in range(num_layers):
            conv = _convolution(
                f"{name}_{index}",
                in_channels=hidden_channels if index else in_channels,
                channels=hidden_channels,
                size=3,
            )
            self.layers.append(nn.Sequential(OrderedDict(conv)))
        concat = _convolution(
            f"{name}_concat",
            in_channels=in_channels + num_layers * hidden_channels,
            channels=out_channels,
            size=1,
        )
        self.concat = nn.Sequential(OrderedDict(concat))
        fc = nn.Conv2d(out_channels, out_channels, kernel_size=1)
        self.ese = nn.Sequential(OrderedDict(fc=fc, gate=nn.Hardsigmoid()))

    def forward(self, feats: Tensor) -> Tensor:
        """Run the block. (n, C_in, H, W) -> (n, C_out, H, W)"""
        outputs = [feats]
        for layer in self.layers:
            outputs.append(layer(outputs[-1]))
        aggregated = self.concat(torch.cat(outputs, dim=1))
        channel_means = aggregated.mean((2, 3), keepdim=True)
        gated = aggregated * self.ese(channel_means)
        if self.residual:
            return gated + feats
        return gated


@MODELS.register_module()
class VoVNet(BaseModule):
    """VoVNetV2 with effective squeeze and excitation.

    Args:
        depth: Size of the network: 19, 39, 57 or 99.
        out_indices: Indices of the stages whose features are returned. Stages 0 to 3 have 1/4, 1/8,
            1/16 and 1/32 of the image size.
        frozen_stages: Number of stages after the stem that are not trained, 0 to 4. The stem is not
            trained either. With -1, the stem and all stages are trained.
        norm_eval: Whether batch norms stay in evaluation mode in training, so that their running
            statistics do not change.
        init_cfg: Settings of mmengine for the initialisation.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(
        self,
        depth: int = 99,
        out_indices: Sequence[int] = (3,),
        frozen_stages: int = -1,
        norm_eval: bool = True,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        if depth not in LAYERS_AND_BLOCKS:
            raise InputError(f"depth must be one of {[*LAYERS_AND_BLOCKS]}, got {depth}.")
        if not set(out_indices) <= {0, 1, 2, 3} or not -1 <= frozen_stages <= 4:
            raise InputError(
                "out_indices must lie in 0 to 3 and frozen_stages in -1 to 4, got "
                f"{tuple(out_indices)} and {frozen_stages}."
            )
        self.out_indices = tuple(out_indices)
        self.frozen_stages = frozen_stages
        self.norm_eval = norm_eval
        first, second, third = STEM_CHANNELS
        stem = [
            *_convolution("stem_1", in_channels=3, channels=first, size=3, stride=2),
            *_convolution("stem_2", in_channels=first, channels=second, size=3),
            *_convolution("stem_3", in_channels=second, channels=third, size=3, stride=2),
        ]
        self.stem = nn.Sequential(OrderedDict(stem))
        num_layers, num_blocks = LAYERS_AND_BLOCKS[depth]
        in_channels = third
        for index, (hidden_channels, out_channels) in enumerate(STAGE_CHANNELS):
            number = index + 2  # the original code counts the stem as stage 1
            stage = nn.Sequential()
            if index:
                stage.add_module("Pooling", nn.MaxPool2d(kernel_size=3, stride=2, ceil_mode=True))
            for block_index in range(num_blocks[index]):
                name = f"OSA{number}_{block_index + 1}"
                block = OneShotAggregation(
                    name,
                    channels=(in_channels, hidden_channels, out_channels),
                    num_layers=num_layers,
                    residual=block_index > 0,  # the first block changes the number of channels
                )
                stage.add_module(name, block)
                in_channels = out_channels
            self.add_module(f"stage{number}", stage)
        # Before the first `train`, because optimizers and DistributedDataParallel collect the
        # trained weights earlier.
        self._freeze()

    @property
    def stages(self) -> tuple[nn.Sequential, ...]:
        """The stages after the stem."""
        return self.stage2, self.stage3, self.stage4, self.stage5

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Compute the features of ``out_indices``. (n, 3, H, W) -> (n, C, h, w) of each stage"""
        feats = self.stem(images)
        outputs = []
        for index, stage in enumerate(self.stages):
            feats = stage(feats)
            if index in self.out_indices:
                outputs.append(feats)
        return tuple(outputs)

    def train(self, mode: bool = True) -> "VoVNet":
        """Set the training mode; frozen modules stay in evaluation mode."""
        super().train(mode)
        self._freeze()
        if self.norm_eval:
            for module in self.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):  # also SyncBN
                    module.eval()
        return self

    def _freeze(self) -> None:
        """Keep the stages of ``frozen_stages`` in evaluation mode and without gradients."""
        parts = (self.stem, *self.stages)
        num_frozen = self.frozen_stages + 1  # with the stem
        for part in parts[:num_frozen]:
            part.eval().requires_grad_(False)
