"""BeMapNet's neck: rounds of BiFPN (EfficientDet), whose levels become one map."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

NUM_LEVELS = 5  # P3 to P7


def _norm(channels: int) -> nn.BatchNorm2d:
    """Return EfficientDet's batch norm."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def _projection(inputs: int, outputs: int) -> nn.Sequential:
    """Return a matrix per pixel and a norm."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1), _norm(outputs))


def halved(feats: Tensor) -> Tensor:
    """Return the maxima of 3 x 3 pixels at every second one; zeros are beyond the border.

    An even number of pixels has one more behind the last, an odd one also before the first, so that
    ``(n + 1) // 2`` remain. (B, C, h, w)
    """
    # not F.pad: ONNX Runtime (1.31) makes of it the border of a maximum, which is not zero but -inf
    for axis in (2, 3):
        line = torch.zeros_like(feats.narrow(axis, 0, 1))
        before = [line] * (feats.shape[axis] % 2)
        feats = torch.cat([*before, feats, line], axis)
    return F.max_pool2d(feats, 3, 2)


class FusionConv(nn.Module):
    """Mean of maps by learned weights, swish, a separable convolution and a norm."""

    def __init__(self, num_inputs: int, channels: int) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.ones(num_inputs))
        self.depthwise = nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)
        self.pointwise = nn.Conv2d(channels, channels, 1)
        self.norm = _norm(channels)

    def forward(self, *maps: Tensor) -> Tensor:
        """Fuse maps of one size. (B, C, h, w)"""
        weights = self.weights.relu()
        shares = weights / (weights.sum() + 1e-4)
        fused = sum(share * feats for share, feats in zip(shares, maps, strict=True))
        return self.norm(self.pointwise(self.depthwise(F.silu(fused))))


class BiFPNRound(nn.Module):
    """Information runs from the coarsest level to the finest, and back. (B, C, h, w) each"""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(FusionConv(2, channels) for _ in range(NUM_LEVELS - 1))
        self.up = nn.ModuleList(
            FusionConv(2 if i == NUM_LEVELS - 1 else 3, channels) for i in range(1, NUM_LEVELS)
        )

    def forward(self, levels: Sequence[Tensor], again: Sequence[Tensor]) -> list[Tensor]:
        """Fuse levels, the finest first; ``again`` are they as the way back reads them."""
        *finer, mixed = levels
        ways = [mixed]
        for conv, feats in zip(self.down, reversed(finer), strict=True):
            mixed = conv(feats, F.interpolate(mixed, feats.shape[-2:], mode="nearest"))
            ways.insert(0, mixed)
        results = [mixed]
        for conv, feats, way in zip(self.up, again[1:], [*ways[1:-1], None], strict=True):
            between = () if way is None else (way,)  # the coarsest level has none
            results.append(conv(feats, *between, halved(results[-1])))
        return results


@MODELS.register_module()
class BiFPN(BaseModule):
    """Fuse levels in both directions, then resize all to one size and join their channels.

    Args:
        in_channels: Channels of the three image features, the finest first.
        size: Rows and columns of the result.
        channels: Channels C of each of the five levels; the result has 5 C.
        num_rounds: How often they are fused.
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
        self.size = int(size[0]), int(size[1])
        self.inputs = nn.ModuleList(_projection(c, channels) for c in in_channels)
        self.coarser = _projection(in_channels[-1], channels)
        # what the way back of the first round reads of all levels but the finest
        self.again = nn.ModuleList(_projection(c, channels) for c in in_channels[1:])
        self.rounds = nn.ModuleList(BiFPNRound(channels) for _ in range(num_rounds))

    def forward(self, feats: Sequence[Tensor]) -> list[Tensor]:
        """Return the joined levels. (B, c, h, w) each -> [(B, 5 C, *size)]"""
        coarser = [halved(self.coarser(feats[-1]))]
        coarser.append(halved(coarser[0]))
        levels = [*(conv(f) for conv, f in zip(self.inputs, feats, strict=True)), *coarser]
        seconds = [conv(f) for conv, f in zip(self.again, feats[1:], strict=True)]
        again = [levels[0], *seconds, *coarser]
        for step in self.rounds:
            levels = again = step(levels, again)
        resized = [
            F.interpolate(level, self.size, mode="bilinear", align_corners=True) for level in levels
        ]
        return [torch.cat(resized, 1)]
