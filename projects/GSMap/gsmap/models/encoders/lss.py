"""BEV encoder that lifts image features along predicted depth (Lift, Splat, Shoot; MapTRv2)."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.depth_net import CameraAwareDepthNet, PlainDepthNet, camera_vector
from gsmap.models.encoders.projection import frustum_points
from gsmap.ops.bev_pool import bev_pool_conv3x3, cell_indices
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import num_depth_bins

CAMERA_MATRICES = ("cam2img", "img_aug_matrix", "ego_from_cam")


@MODELS.register_module()
class LSSEncoder(CameraEncoder):
    """Lift image features by predicted depth, sum them in BEV cells, refine by convolutions.

    The cells are half as large as those of the output; the second convolution halves the
    resolution.

    Args:
        grid: The map's extent; points outside are dropped.
        z_range: Lowest and highest z in metres; it is one layer.
        bev_pixel_m: Side of a cell of the output in metres, or its sizes along x and y.
        embed_dims: Channels C of image and BEV features.
        depth_range: ``(low, high, step)`` of the depth bins in metres; ValueError if there is none.
        camera_aware: Whether the depth net reads the cameras' parameters (MapTRv2) or is one
            convolution (the BEVPool variant of MapTR).
        aspp_channels: Channels of each branch of the camera-aware depth head's pyramid.
    """

    fixed_sizes = False  # whether points are scattered into cells, in place of sorted by cell

    def __init__(
        self,
        grid: BEVGrid,
        z_range: Sequence[float] = (-10.0, 10.0),
        bev_pixel_m: float | Sequence[float] = 0.3,
        embed_dims: int = 256,
        depth_range: tuple[float, float, float] = (1.0, 35.0, 0.5),
        camera_aware: bool = True,
        aspp_channels: int = 96,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid = grid.rasterized(bev_pixel_m)
        self.cells = self.grid.resized(2 * self.grid.height, 2 * self.grid.width)
        self.z_range = (float(z_range[0]), float(z_range[1]))
        low, high, step = (float(x) for x in depth_range)
        self.depth_range = low, high, step
        self.num_bins = num_depth_bins(self.depth_range)
        self.camera_aware = camera_aware
        self.calibration = ("frame_from_img", *(CAMERA_MATRICES if camera_aware else ()))
        sizes = (embed_dims, embed_dims, self.num_bins)
        self.depth_net = (
            CameraAwareDepthNet(*sizes, aspp_channels) if camera_aware else PlainDepthNet(*sizes)
        )
        blocks = []
        for stride in (1, 2, 1):
            conv = nn.Conv2d(embed_dims, embed_dims, 3, stride=stride, padding=1, bias=False)
            blocks += [conv, nn.BatchNorm2d(embed_dims), nn.ReLU(inplace=True)]
        self.downsample = nn.Sequential(*blocks)

    def init_weights(self) -> None:
        """Initialise matrices and kernels as upstream's transformer does: Xavier, uniform."""
        super().init_weights()
        init_matrices(self)

    def encode(
        self, feats: Tensor, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode features, with ``frame_from_img`` and, camera-aware, ``CAMERA_MATRICES``.

        Beside ``bev_feats`` (B, C, H, W) there are ``depth``, the probability of each depth bin (B,
        V, D, h, w), its ``depth_range``, and ``img_feats``, the features used (B, V, C, h, w).
        """
        vectors = None
        if self.camera_aware:
            vectors = camera_vector(*(calibration[name] for name in CAMERA_MATRICES)).flatten(0, 1)
        logits, context = self.depth_net(feats.flatten(0, 1), vectors)
        depth = logits.float().softmax(1).unflatten(0, feats.shape[:2])  # (B, V, D, h, w)
        context = context.float().unflatten(0, feats.shape[:2])  # (B, V, C, h, w)
        points = self.points(calibration["frame_from_img"], img_shape, feats)
        indices = cell_indices(points, self.cells, self.z_range)  # (B, V, D, h, w)
        with torch.autocast(feats.device.type, enabled=False):
            kernel = cast(Tensor, self.downsample[0].weight)
            bev = bev_pool_conv3x3(
                depth, context, indices, self.cells, kernel.float(), self.fixed_sizes
            )
        lifted = {"depth": depth, "depth_range": self.depth_range, "img_feats": feats}
        return {"bev_feats": self.downsample[1:](bev), **lifted}

    def points(self, frame_from_img: Tensor, img_shape: tuple[int, int], feats: Tensor) -> Tensor:
        """Return every feature pixel at every depth, in metres. (B, V, D, h, w, 3)"""
        depths = torch.arange(*self.depth_range, device=feats.device)
        return frustum_points(frame_from_img, img_shape, (feats.shape[-2], feats.shape[-1]), depths)
