"""Camera-aware depth net, after BEVDepth (arXiv 2206.10092).

Submodules have the names of BEVDepth's released code, so that released weights can be loaded.
"""

from collections import OrderedDict

import torch
import torch.nn.functional as F
from mmdet.models.backbones.resnet import BasicBlock
from torch import Tensor, nn

CAMERA_VECTOR_SIZE = 22  # numbers of `camera_vector`


def _conv_bn_relu(
    in_channels: int, out_channels: int, kernel_size: int, dilation: int = 1
) -> nn.Sequential:
    """Build a convolution that keeps the size of the map, with BatchNorm and ReLU."""
    padding = dilation * (kernel_size // 2)
    conv = nn.Conv2d(
        in_channels, out_channels, kernel_size, padding=padding, dilation=dilation, bias=False
    )
    norm = nn.BatchNorm2d(out_channels)
    return nn.Sequential(OrderedDict(atrous_conv=conv, bn=norm, relu=nn.ReLU()))


def _camera_mlp(channels: int) -> nn.Sequential:
    """Build the network that embeds the parameter vector of a camera (`camera_vector`)."""
    first = nn.Linear(CAMERA_VECTOR_SIZE, channels)
    second = nn.Linear(channels, channels)
    return nn.Sequential(OrderedDict(fc1=first, relu=nn.ReLU(), fc2=second))


def camera_vector(cam2img: Tensor, img_aug_matrix: Tensor, ego_from_cam: Tensor) -> Tensor:
    """Parameters of a camera as the input vector of the depth net.

    The 22 numbers are, in this order, fx, fy, cx and cy of the intrinsics; a00, a01, tx, a10, a11
    and ty of the augmentation; and the upper three rows of the pose, row by row.

    Args:
        cam2img: Intrinsics of the original image, in pixels. (..., >= 3, >= 3)
        img_aug_matrix: Augmentation, which acts on (u * d, v * d, d, 1). Its third column, which is
            multiplied by the depth d, has the translation in pixels. (..., 4, 4)
        ego_from_cam: Pose of the camera in the frame of the vehicle, in metres. (..., 4, 4)

    Returns:
        The vector. (..., 22)
    """
    intrinsics = [cam2img[..., 0, 0], cam2img[..., 1, 1], cam2img[..., 0, 2], cam2img[..., 1, 2]]
    augmentation = img_aug_matrix[..., :2, :3].flatten(-2)
    pose = ego_from_cam[..., :3, :].flatten(-2)
    return torch.cat([torch.stack(intrinsics, -1), augmentation, pose], dim=-1)


class SEGate(nn.Module):
    """Squeeze-and-excitation gate: features scaled per channel by a sigmoid of an embedding.

    Both layers keep the number of channels; their names are the ones of the released code.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_reduce = nn.Conv2d(channels, channels, kernel_size=1)
        self.conv_expand = nn.Conv2d(channels, channels, kernel_size=1)

    def forward(self, feats: Tensor, embedding: Tensor) -> Tensor:
        """Scale features by their gate.

        Args:
            feats: Features. (n, C, h, w)
            embedding: Embedding of the camera. (n, C)

        Returns:
            The scaled features. (n, C, h, w)
        """
        # The checkpoints store both layers as 1x1 convolutions. They are computed as linear layers,
        # because a convolution is slow on a map of a single pixel.
        reduce = self.conv_reduce
        expand = self.conv_expand
        hidden = F.relu(F.linear(embedding, reduce.weight.flatten(1), reduce.bias))
        gate = F.linear(hidden, expand.weight.flatten(1), expand.bias).sigmoid()
        return feats * gate[..., None, None]


class ASPP(nn.Module):
    """Atrous spatial pyramid pooling: five branches side by side, then a 1x1 convolution.

    The branches are a 1x1, three dilated 3x3 convolutions and a global average.
    """

    def __init__(self, channels: int, mid_channels: int) -> None:
        super().__init__()
        self.aspp1 = _conv_bn_relu(channels, mid_channels, kernel_size=1)
        self.aspp2 = _conv_bn_relu(channels, mid_channels, kernel_size=3, dilation=6)
        self.aspp3 = _conv_bn_relu(channels, mid_channels, kernel_size=3, dilation=12)
        self.aspp4 = _conv_bn_relu(channels, mid_channels, kernel_size=3, dilation=18)
        self.global_avg_pool = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(channels, mid_channels, kernel_size=1, bias=False),
            nn.BatchNorm2d(mid_channels),
            nn.ReLU(),
        )
        self.conv1 = nn.Conv2d(5 * mid_channels, channels, kernel_size=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.dropout = nn.Dropout(0.5)

    def forward(self, feats: Tensor) -> Tensor:
        """Pool the features at five scales. (n, C, h, w) -> (n, C, h, w)"""
        branches = []
        for branch in (self.aspp1, self.aspp2, self.aspp3, self.aspp4):
            branches.append(branch(feats))
        branches.append(self.global_avg_pool(feats).expand_as(branches[0]))
        pyramid = self.conv1(torch.cat(branches, dim=1))
        return self.dropout(F.relu(self.bn1(pyramid)))


class CameraAwareDepthNet(nn.Module):
    """Depth logits and context features of image features, both gated by the camera's parameters.

    Args:
        in_channels: Channels of the image features.
        context_channels: Channels C of the context.
        depth_channels: Number D of depth bins.
        aspp_channels: Channels of each branch of the pyramid of the depth head.
    """

    def __init__(
        self, in_channels: int, context_channels: int, depth_channels: int, aspp_channels: int = 96
    ) -> None:
        super().__init__()
        self.reduce_conv = nn.Sequential(
            nn.Conv2d(in_channels, in_channels, kernel_size=3, padding=1),
            nn.BatchNorm2d(in_channels),
            nn.ReLU(inplace=True),
        )
        self.bn = nn.BatchNorm1d(CAMERA_VECTOR_SIZE)  # the numbers have different units and sizes
        self.context_mlp = _camera_mlp(in_channels)
        self.context_se = SEGate(in_channels)
        self.context_conv = nn.Conv2d(in_channels, context_channels, kernel_size=1)
        self.depth_mlp = _camera_mlp(in_channels)
        self.depth_se = SEGate(in_channels)
        self.depth_conv = nn.Sequential(
            *(BasicBlock(in_channels, in_channels) for _ in range(3)),
            ASPP(in_channels, aspp_channels),
            nn.Conv2d(in_channels, depth_channels, kernel_size=1),
        )

    def forward(self, feats: Tensor, camera_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Predict depth and context.

        Args:
            feats: Image features of n cameras. (n, in_channels, h, w)
            camera_vectors: `camera_vector` of each camera. (n, 22)

        Returns:
            Depth logits, before the softmax over the bins (n, D, h, w), and context (n, C, h, w).
        """
        vectors = self.bn(camera_vectors)
        feats = self.reduce_conv(feats)
        context_embedding = self.context_mlp(vectors)
        context = self.context_conv(self.context_se(feats, context_embedding))
        depth_embedding = self.depth_mlp(vectors)
        depth = self.depth_conv(self.depth_se(feats, depth_embedding))
        return depth, context


class PlainDepthNet(nn.Module):
    """A single 1x1 convolution to depth logits and context (BEVPool encoder of MapTR).

    Args:
        in_channels: Channels of the image features.
        context_channels: Channels C of the context.
        depth_channels: Number D of depth bins.
    """

    def __init__(self, in_channels: int, context_channels: int, depth_channels: int) -> None:
        super().__init__()
        self.depth_channels = depth_channels
        self.conv = nn.Conv2d(in_channels, depth_channels + context_channels, kernel_size=1)

    def forward(self, feats: Tensor, camera_vectors: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Predict depth and context.

        Args:
            feats: Image features of n cameras. (n, in_channels, h, w)
            camera_vectors: Not used; `CameraAwareDepthNet` needs it.

        Returns:
            Depth logits (n, D, h, w) and context (n, C, h, w).
        """
        depth_and_context = self.conv(feats)
        return depth_and_context.tensor_split([self.depth_channels], 1)
