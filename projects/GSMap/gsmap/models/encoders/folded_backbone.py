"""Image backbone for inference, with batch norms folded into convolutions."""

import copy

import torch
from mmcv.cnn import fuse_conv_bn
from mmdet.models.backbones import ResNet
from torch import Tensor, nn

from gsmap.structures.tensors import tensor_versions


class FoldedBackbone:
    """Runs a backbone. In inference, it runs a copy with batch norms folded into convolutions.

    With fixed statistics, a batch norm is a scale and a shift per channel. The convolution before
    the norm can include both in its weights. The copy is made on first use and again after a weight
    has changed. A call in which no copy can be used, as in training, deletes it. The backbone and
    its checkpoints do not change. Only ResNets are folded, because mmcv's function assumes that
    each norm is applied right after the convolution that was registered before it.
    """

    def __init__(self) -> None:
        self.folded: nn.Module | None = None
        # Address and version of each tensor of the backbone; they differ if a weight has changed.
        self.state: list[tuple[int, int]] = []

    def __call__(self, backbone: nn.Module, images: Tensor) -> tuple[Tensor, ...]:
        """Run the backbone.

        Args:
            backbone: The image backbone.
            images: Normalised images. (n, 3, H, W)

        Returns:
            A feature map per output level. (n, C, h, w) each
        """
        if not can_be_folded(backbone):
            self.folded = None
            return backbone(images)
        state = tensor_versions(backbone)
        if self.folded is None or state != self.state:
            self.folded = fuse_conv_bn(copy.deepcopy(backbone))  # it changes its argument
            self.state = state
        return self.folded(images)


def can_be_folded(backbone: nn.Module) -> bool:
    """Whether a folded copy would compute the output of the backbone in its current state."""
    # Gradients must reach the backbone's weights, and a compiled graph cannot watch for changes.
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return False
    if not isinstance(backbone, ResNet):
        return False
    # mmcv would fold the norm of a deformable convolution into another convolution.
    if backbone.dcn is not None:
        return False
    for module in backbone.modules():
        # A hook may read or replace features that the copy does not compute.
        has_hooks = module._forward_hooks or module._forward_pre_hooks
        if module.training or has_hooks:
            return False
    return True
