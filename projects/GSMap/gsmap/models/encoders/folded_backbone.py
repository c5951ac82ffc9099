"""A backbone for inference, with its batch norms folded into its convolutions."""

import copy

import torch
from mmcv.cnn import fuse_conv_bn
from mmdet.models.backbones import ResNet
from torch import Tensor, nn

from gsmap.structures.tensors import tensor_versions


class FoldedBackbone:
    """Runs a backbone; in inference a copy whose batch norms are part of its convolutions.

    With fixed statistics a batch norm is a scale and a shift per channel, which the convolution
    before it can do by itself. The copy is made when it is first needed or a weight has changed,
    and dropped in training. The backbone, and so every checkpoint, stays as it is. Only ResNets are
    folded: mmcv's folding takes each norm to follow the convolution registered before it.
    """

    def __init__(self) -> None:
        self.folded: nn.Module | None = None
        self.state: list[tuple[int, int]] = []  # address and version of the backbone's tensors

    def __call__(self, backbone: nn.Module, images: Tensor) -> tuple[Tensor, ...]:
        """Return the backbone's feature maps. (n, 3, H, W) -> tuple of (n, C, h, w)"""
        if not can_be_folded(backbone):
            self.folded = None
            return backbone(images)
        state = tensor_versions(backbone)
        if self.folded is None or state != self.state:
            self.folded, self.state = fuse_conv_bn(copy.deepcopy(backbone)), state
        return self.folded(images)


def can_be_folded(backbone: nn.Module) -> bool:
    """Return whether a folded copy of the backbone would do the same as it does, now."""
    if torch.is_grad_enabled() or torch.compiler.is_compiling() or not isinstance(backbone, ResNet):
        return False
    if backbone.dcn is not None:  # mmcv would fold the norm of a deformable convolution elsewhere
        return False
    return not any(
        module.training or module._forward_hooks or module._forward_pre_hooks
        for module in backbone.modules()
    )
