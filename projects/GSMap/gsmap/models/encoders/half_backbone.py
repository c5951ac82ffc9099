"""Image backbone and neck in half precision, for inference on a GPU."""

import copy

import torch
from mmcv.cnn import fuse_conv_bn
from torch import Tensor, nn

from gsmap.models.encoders.folded_backbone import can_be_folded
from gsmap.models.encoders.fused_resnet import convolve_folded, fused_resnet, is_plain
from gsmap.structures.tensors import tensor_versions


class HalfBackbone:
    """Runs copies of an image backbone and its neck whose weights were cast to float16 once.

    Backbone and neck do nearly all arithmetic of a frame. Autocast would cast every weight again in
    each frame. Batch norms of ResNets are folded into their convolutions in float32, before the
    cast. On a GPU, fused operators of cuDNN compute each convolution of a ResNet block together
    with its bias, residual and ReLU. The copies are made on first use and again after a weight has
    changed.
    """

    def __init__(self) -> None:
        self.backbone: nn.Module | None = None
        self.neck: nn.Module | None = None
        self.fuses = False  # whether the blocks can run as fused convolutions on a GPU
        # Address and version of each tensor of the original modules at the time of the copy. A
        # change of a weight changes one of them.
        self.state: list[tuple[int, int]] = []

    @torch.no_grad()
    def __call__(
        self, backbone: nn.Module, neck: nn.Module | None, images: Tensor, channels_last: bool
    ) -> list[Tensor]:
        """Compute the feature maps of normalised images.

        Args:
            backbone: The image backbone, in evaluation mode.
            neck: Its neck, or None.
            images: Normalised and padded images of all cameras, in float32. (n, 3, H, W)
            channels_last: Whether images and weights are stored with the channels last. It should
                be equal in all calls, because the copies keep the format of the first call.

        Returns:
            One map per level, in float32. (n, C, h, w) each
        """
        memory_format = torch.channels_last if channels_last else torch.contiguous_format
        state = tensor_versions(backbone) + ([] if neck is None else tensor_versions(neck))
        if self.backbone is None or state != self.state:
            # Only a ResNet without deformable convolutions and hooks can be folded.
            can_fold = can_be_folded(backbone)
            replica = copy.deepcopy(backbone)  # `fuse_conv_bn` and `half` change it in place
            if can_fold:
                replica = fuse_conv_bn(replica)
            self.backbone = replica.half().to(memory_format=memory_format)  # type: ignore[call-overload]
            self.neck = copy.deepcopy(neck)
            if self.neck is not None:
                self.neck.half().to(memory_format=memory_format)  # type: ignore[call-overload]
            # `fused_resnet` requires folded norms and blocks without extra layers.
            self.fuses = can_fold and is_plain(replica)
            self.state = state
        images = images.to(torch.float16, memory_format=memory_format)
        if self.fuses and images.is_cuda:
            feats = fused_resnet(self.backbone, images, convolve=convolve_folded)
        else:
            feats = self.backbone(images)
        if self.neck is not None:
            feats = self.neck(feats)
        return [feat.float() for feat in feats]
