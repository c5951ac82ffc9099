"""BeMapNet's neck: several rounds of BiFPN (EfficientDet), whose levels are joined to one map."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

NUM_LEVELS = 5  # P3 to P7


def _norm(channels: int) -> nn.BatchNorm2d:
    """Return EfficientDet's batch normalisation."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def _projection(inputs: int, outputs: int) -> nn.Sequential:
    """Return a 1x1 convolution and its normalisation."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, kernel_size=1), _norm(outputs))


def downsample(feats: Tensor) -> Tensor:
    """Max-pool a map with a 3x3 kernel and stride 2, padded with zeros.

    An axis of even size is padded by one cell after the last cell. An axis of odd size is also
    padded by one cell before the first cell. An axis of n cells is reduced to ``(n + 1) // 2``.

    (B, C, h, w) -> (B, C, (h + 1) // 2, (w + 1) // 2)
    """
    # Concatenation, not F.pad: ONNX Runtime (1.31) merges padding into the pooling, which pads with
    # -inf instead of zeros.
    for axis in (2, 3):
        border = torch.zeros_like(feats.narrow(axis, start=0, length=1))
        parts = [feats, border]
        if feats.shape[axis] % 2:
            parts.insert(0, border)
        feats = torch.cat(parts, dim=axis)
    return F.max_pool2d(feats, kernel_size=3, stride=2)


class FusionConv(nn.Module):
    """Weighted mean of maps, followed by swish, a separable convolution and normalisation.

    Args:
        num_inputs: Number of maps.
        channels: Channels C of the maps.
    """

    def __init__(self, num_inputs: int, channels: int) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.ones(num_inputs))
        self.depthwise = nn.Conv2d(
            channels, channels, kernel_size=3, padding=1, groups=channels, bias=False
        )
        self.pointwise = nn.Conv2d(channels, channels, kernel_size=1)
        self.norm = _norm(channels)

    def forward(self, *maps: Tensor) -> Tensor:
        """Fuse maps of equal size. (B, C, h, w) each -> (B, C, h, w)"""
        weights = self.weights.relu()
        shares = weights / (weights.sum() + 1e-4)  # no division by 0 if all weights are negative
        mean = sum(share * feats for share, feats in zip(shares, maps, strict=True))
        fused = self.depthwise(F.silu(mean))
        fused = self.pointwise(fused)
        return self.norm(fused)


class BiFPNRound(nn.Module):
    """Fusion of all levels on a path from the coarsest to the finest one, and on a path back.

    Args:
        channels: Channels C of each level.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(FusionConv(2, channels) for _ in range(NUM_LEVELS - 1))
        self.up = nn.ModuleList()
        for level in range(1, NUM_LEVELS):
            # The coarsest level has no intermediate result, because the first path starts there.
            num_inputs = 2 if level == NUM_LEVELS - 1 else 3
            self.up.append(FusionConv(num_inputs, channels))

    def forward(self, levels: Sequence[Tensor], back_levels: Sequence[Tensor]) -> list[Tensor]:
        """Fuse the levels, the finest first. (B, C, h, w) each -> (B, C, h, w) each

        Args:
            levels: Inputs of the path from the coarsest to the finest level.
            back_levels: Further inputs of the path from the finest to the coarsest level; the
                finest entry is not used. After the first round, they equal ``levels``.
        """
        top_down = [levels[-1]]
        for conv, feats in zip(self.down, reversed(levels[:-1]), strict=True):
            coarse_feats = F.interpolate(top_down[-1], size=feats.shape[-2:], mode="nearest")
            top_down.append(conv(feats, coarse_feats))
        top_down.reverse()  # the finest first
        results = [top_down[0]]
        for level, conv in enumerate(self.up, start=1):
            fine_feats = downsample(results[-1])
            if level == NUM_LEVELS - 1:
                results.append(conv(back_levels[level], fine_feats))
            else:
                results.append(conv(back_levels[level], top_down[level], fine_feats))
        return results


@MODELS.register_module()
class BiFPN(BaseModule):
    """Image neck that fuses levels in both directions and concatenates them at one size.

    Args:
        in_channels: Channels of the three levels of image features, the finest first.
        size: Rows and columns of the result.
        channels: Channels C of each of the five levels; the result has 5 C channels.
        num_rounds: Number of rounds of fusion.
        init_cfg: Initialisation config of mmengine.
    """

    def __init__(
        self,
        in_channels: Sequence[int] = (512, 1024, 2048),
        size: Sequence[int] = (21, 49),
        channels: int = 120,
        num_rounds: int = 3,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.size = (int(size[0]), int(size[1]))
        self.inputs = nn.ModuleList(_projection(inputs, channels) for inputs in in_channels)
        self.coarser = _projection(in_channels[-1], channels)
        # Second projections of the image features, inputs of the first round on its path from fine
        # to coarse levels. The finest level has no second projection.
        self.again = nn.ModuleList(_projection(inputs, channels) for inputs in in_channels[1:])
        self.rounds = nn.ModuleList(BiFPNRound(channels) for _ in range(num_rounds))

    def forward(self, feats: Sequence[Tensor]) -> list[Tensor]:
        """Fuse levels (n, c, h, w) of n images, the finest first, to one map.

        Returns:
            List of one map. (n, 5 C, *size)
        """
        # The image features are P3 to P5; P6 and P7 are computed from P5.
        sixth = downsample(self.coarser(feats[-1]))
        seventh = downsample(sixth)
        levels = []
        for conv, level in zip(self.inputs, feats, strict=True):
            levels.append(conv(level))
        back_levels = [levels[0]]  # not used: `BiFPNRound` ignores the finest entry
        for conv, level in zip(self.again, feats[1:], strict=True):
            back_levels.append(conv(level))
        levels += [sixth, seventh]
        back_levels += [sixth, seventh]
        for fuse in self.rounds:
            levels = fuse(levels, back_levels)
            back_levels = levels
        resized_levels = []
        for level in levels:
            level = F.interpolate(level, size=self.size, mode="bilinear", align_corners=True)
            resized_levels.append(level)
        return [torch.cat(resized_levels, dim=1)]
