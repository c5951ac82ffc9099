"""Camera-aware depth net of MapTRv2, after BEVDepth (arXiv 2206.10092)."""

from collections import OrderedDict

import torch
import torch.nn.functional as F
from mmdet.models.backbones.resnet import BasicBlock
from torch import Tensor, nn

CAMERA_VECTOR_SIZE = 22


def _conv_bn_relu(
    in_channels: int, out_channels: int, kernel_size: int, dilation: int = 1
) -> nn.Sequential:
    """Build a size-keeping convolution with BatchNorm and ReLU, under MapTRv2's parameter names."""
    padding = dilation * (kernel_size // 2)
    conv = nn.Conv2d(
        in_channels, out_channels, kernel_size, padding=padding, dilation=dilation, bias=False
    )
    parts = [("atrous_conv", conv), ("bn", nn.BatchNorm2d(out_channels)), ("relu", nn.ReLU())]
    return nn.Sequential(OrderedDict(parts))


def _camera_mlp(channels: int) -> nn.Sequential:
    """Build the embedding of a camera's parameter vector, under MapTRv2's parameter names."""
    first, second = nn.Linear(CAMERA_VECTOR_SIZE, channels), nn.Linear(channels, channels)
    return nn.Sequential(OrderedDict(fc1=first, relu=nn.ReLU(), fc2=second))


def camera_vector(cam2img: Tensor, img_aug_matrix: Tensor, ego_from_cam: Tensor) -> Tensor:
    """Write a camera's parameters as the 22 numbers that MapTRv2's depth net reads. (..., 22)

    These are fx, fy, cx, cy; a00, a01, tx, a10, a11, ty of the augmentation; the upper three rows
    of the pose.

    Args:
        cam2img: Intrinsics of the original image, in pixels. (..., >= 3, >= 3)
        img_aug_matrix: Augmentation, which acts on (u * d, v * d, d, 1); its translation in pixels
            is in the third column. (..., 4, 4)
        ego_from_cam: Pose of the camera in the vehicle, in metres. (..., 4, 4)
    """
    intrinsics = [cam2img[..., 0, 0], cam2img[..., 1, 1], cam2img[..., 0, 2], cam2img[..., 1, 2]]
    augmentation = img_aug_matrix[..., :2, :3].flatten(-2)
    pose = ego_from_cam[..., :3, :].flatten(-2)
    return torch.cat([torch.stack(intrinsics, -1), augmentation, pose], -1)


class SEGate(nn.Module):
    """Squeeze-and-excitation gate: features scaled per channel by a sigmoid of an embedding."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_reduce = nn.Conv2d(channels, channels, 1)
        self.conv_expand = nn.Conv2d(channels, channels, 1)

    def forward(self, feats: Tensor, embedding: Tensor) -> Tensor:
        """Gate ``feats`` (n, C, h, w) by ``embedding`` (n, C)."""
        # linear layers stored as 1x1 convolutions, which are slow on a single pixel
        reduce, expand = self.conv_reduce, self.conv_expand
        hidden = F.relu(F.linear(embedding, reduce.weight.flatten(1), reduce.bias))
        gate = F.linear(hidden, expand.weight.flatten(1), expand.bias).sigmoid()
        return feats * gate[..., None, None]


class ASPP(nn.Module):
    """Atrous spatial pyramid pooling: five branches side by side, then a 1x1 convolution.

    The branches are a 1x1, three dilated 3x3 convolutions and a global average.
    """

    def __init__(self, channels: int, mid_channels: int) -> None:
        super().__init__()
        self.aspp1 = _conv_bn_relu(channels, mid_channels, 1)
        self.aspp2, self.aspp3, self.aspp4 = (
            _conv_bn_relu(channels, mid_channels, 3, dilation) for dilation in (6, 12, 18)
        )
        self.global_avg_pool = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(channels, mid_channels, 1, bias=False),
            nn.BatchNorm2d(mid_channels),
            nn.ReLU(),
        )
        self.conv1 = nn.Conv2d(5 * mid_channels, channels, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.dropout = nn.Dropout(0.5)

    def forward(self, feats: Tensor) -> Tensor:
        """Apply to ``feats``. (n, C, h, w) -> (n, C, h, w)"""
        branches = [branch(feats) for branch in (self.aspp1, self.aspp2, self.aspp3, self.aspp4)]
        branches.append(self.global_avg_pool(feats).expand_as(branches[0]))
        return self.dropout(F.relu(self.bn1(self.conv1(torch.cat(branches, 1)))))


class CameraAwareDepthNet(nn.Module):
    """Predict D depth logits and C context features, both gated by the camera's parameters.

    ``aspp_channels`` are those of each branch of the depth head's pyramid.
    """

    def __init__(
        self, in_channels: int, context_channels: int, depth_channels: int, aspp_channels: int = 96
    ) -> None:
        super().__init__()
        self.reduce_conv = nn.Sequential(
            nn.Conv2d(in_channels, in_channels, 3, padding=1),
            nn.BatchNorm2d(in_channels),
            nn.ReLU(inplace=True),
        )
        self.bn = nn.BatchNorm1d(CAMERA_VECTOR_SIZE)
        self.context_mlp = _camera_mlp(in_channels)
        self.context_se = SEGate(in_channels)
        self.context_conv = nn.Conv2d(in_channels, context_channels, 1)
        self.depth_mlp = _camera_mlp(in_channels)
        self.depth_se = SEGate(in_channels)
        self.depth_conv = nn.Sequential(
            *(BasicBlock(in_channels, in_channels) for _ in range(3)),
            ASPP(in_channels, aspp_channels),
            nn.Conv2d(in_channels, depth_channels, 1),
        )

    def forward(self, feats: Tensor, camera_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Predict depth logits (n, D, h, w) and context (n, C, h, w) of features (n, C_in, h, w).

        Each camera has its `camera_vector` (n, 22).
        """
        vectors = self.bn(camera_vectors)
        feats = self.reduce_conv(feats)
        context = self.context_conv(self.context_se(feats, self.context_mlp(vectors)))
        depth = self.depth_conv(self.depth_se(feats, self.depth_mlp(vectors)))
        return depth, context


class PlainDepthNet(nn.Module):
    """A single 1x1 convolution to depth logits and context (MapTR's BEVPool encoder)."""

    def __init__(self, in_channels: int, context_channels: int, depth_channels: int) -> None:
        super().__init__()
        self.depth_channels = depth_channels
        self.conv = nn.Conv2d(in_channels, depth_channels + context_channels, 1)

    def forward(self, feats: Tensor, camera_vectors: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Predict depth logits (n, D, h, w) and context (n, C, h, w) from the features alone."""
        depth_and_context = self.conv(feats)
        return depth_and_context.tensor_split([self.depth_channels], 1)
