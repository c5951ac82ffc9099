"""VoVNetV2, an image backbone (arXiv 1911.06667): the V2-99 of GeMap's largest models.

Modules are named as in the original, slashes included, so that its checkpoints load as they are.
"""

from collections import OrderedDict
from collections.abc import Sequence

import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

STEM_CHANNELS = (64, 64, 128)
STAGE_CHANNELS = ((128, 256), (160, 512), (192, 768), (224, 1024))  # of a layer, of the output
LAYERS_AND_BLOCKS = {  # layers per block, blocks of the four stages
    19: (3, (1, 1, 1, 1)),
    39: (5, (1, 1, 2, 2)),
    57: (5, (1, 1, 4, 3)),
    99: (5, (1, 3, 9, 3)),
}


def _convolution(
    name: str, in_channels: int, channels: int, size: int, stride: int = 1
) -> list[tuple[str, nn.Module]]:
    """Return a convolution with norm and ReLU, by name."""
    padding = size // 2
    return [
        (f"{name}/conv", nn.Conv2d(in_channels, channels, size, stride, padding, bias=False)),
        (f"{name}/norm", nn.BatchNorm2d(channels)),
        (f"{name}/relu", nn.ReLU(inplace=True)),
    ]


class OneShotAggregation(nn.Module):
    """A chain of 3x3 convolutions, all aggregated at its end by one 1x1, whose channels are gated.

    Its modules' names begin with its own; channels are those of input, convolutions and output.
    """

    def __init__(
        self, name: str, channels: tuple[int, int, int], num_layers: int, residual: bool
    ) -> None:
        super().__init__()
        self.residual = residual
        first, layer, last = channels
        inputs = [first] + [layer] * (num_layers - 1)
        self.layers = nn.ModuleList(
            nn.Sequential(OrderedDict(_convolution(f"{name}_{i}", size, layer, 3)))
            for i, size in enumerate(inputs)
        )
        total = first + num_layers * layer
        self.concat = nn.Sequential(OrderedDict(_convolution(f"{name}_concat", total, last, 1)))
        gate = OrderedDict(fc=nn.Conv2d(last, last, 1), gate=nn.Hardsigmoid())
        self.ese = nn.Sequential(gate)  # effective squeeze and excitation

    def forward(self, feats: Tensor) -> Tensor:
        """Return the block's features. (B, C, H, W)"""
        outputs = [feats]
        for layer in self.layers:
            outputs.append(layer(outputs[-1]))
        aggregated = self.concat(torch.cat(outputs, 1))
        gated = aggregated * self.ese(aggregated.mean((2, 3), keepdim=True))
        return gated + feats if self.residual else gated


@MODELS.register_module()
class VoVNet(BaseModule):
    """VoVNetV2 with effective squeeze and excitation; ValueError for another depth or index.

    Args:
        depth: 19, 39, 57 or 99.
        out_indices: Stages whose features are returned: 0 to 3, at 1/4, 1/8, 1/16 and 1/32 of the
            image's size.
        frozen_stages: Train none of the stem (0) and the first so many stages; -1 trains all.
        norm_eval: Keep the statistics of batch norms.
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
            raise ValueError(f"depth must be one of {[*LAYERS_AND_BLOCKS]}, got {depth}.")
        if not set(out_indices) <= {0, 1, 2, 3} or not -1 <= frozen_stages <= 4:
            raise ValueError(
                "out_indices must lie in 0 to 3 and frozen_stages in -1 to 4, got "
                f"{tuple(out_indices)} and {frozen_stages}."
            )
        self.out_indices = tuple(out_indices)
        self.frozen_stages, self.norm_eval = frozen_stages, norm_eval
        first, second, channels = STEM_CHANNELS
        stem = _convolution("stem_1", 3, first, 3, 2) + _convolution("stem_2", first, second, 3)
        stem += _convolution("stem_3", second, channels, 3, 2)
        self.stem = nn.Sequential(OrderedDict(stem))
        num_layers, num_blocks = LAYERS_AND_BLOCKS[depth]
        stages = [nn.Sequential() for _ in STAGE_CHANNELS]
        for index, (stage, (layer, last)) in enumerate(zip(stages, STAGE_CHANNELS, strict=True)):
            if index:
                stage.add_module("Pooling", nn.MaxPool2d(3, 2, ceil_mode=True))
            for block in range(num_blocks[index]):
                name, sizes = f"OSA{index + 2}_{block + 1}", (channels, layer, last)
                stage.add_module(name, OneShotAggregation(name, sizes, num_layers, block > 0))
                channels = last
        self.stage2, self.stage3, self.stage4, self.stage5 = stages

    @property
    def stages(self) -> tuple[nn.Sequential, ...]:
        """The stages after the stem."""
        return self.stage2, self.stage3, self.stage4, self.stage5

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the chosen stages' features. (n, 3, H, W) -> tuple of (n, C, h, w)"""
        feats, outputs = self.stem(images), []
        for index, stage in enumerate(self.stages):
            feats = stage(feats)
            if index in self.out_indices:
                outputs.append(feats)
        return tuple(outputs)

    def train(self, mode: bool = True) -> "VoVNet":
        """Switch to training, but for what is frozen."""
        super().train(mode)
        for part in (self.stem, *self.stages)[: self.frozen_stages + 1]:
            part.eval().requires_grad_(False)
        if self.norm_eval:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self
