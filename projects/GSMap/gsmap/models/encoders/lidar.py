"""BEV features from LiDAR with modules of mmdet3d, and their fusion with camera features."""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from mmcv.cnn import ConvModule
from mmdet3d.models.layers.spconv import IS_SPCONV2_AVAILABLE
from mmdet3d.models.middle_encoders import SparseEncoder
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor

from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import WorkError


@MODELS.register_module()
class LidarEncoder(BaseModule):
    """Encoder from LiDAR voxels to BEV features: PointPillars or SECOND, depending on its modules.

    The data preprocessor makes the voxels (``voxel=True``). The range of the voxels must be the
    extent of the map.

    Args:
        grid: Extent of the map.
        voxel_encoder: Config of the module that encodes the points of each voxel to one feature.
        middle_encoder: Config of the module that scatters the features of the voxels to the BEV
            plane.
        backbone: Config of the 2D backbone, or None to leave it out.
        neck: Config of the neck, or None to leave it out.
        bev_pixel_m: Side of a cell of the output in metres, or its sizes along x and y. The
            features are interpolated to these cells.
        init_cfg: Config of the initial weights, see mmengine's ``BaseModule``.
    """

    def __init__(
        self,
        grid: BEVGrid,
        voxel_encoder: dict,
        middle_encoder: dict,
        backbone: dict | None = None,
        neck: dict | None = None,
        bev_pixel_m: float | Sequence[float] = 0.3,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.voxel_encoder = MODELS.build(voxel_encoder)
        self.middle_encoder = MODELS.build(middle_encoder)
        self.backbone = MODELS.build(backbone) if backbone else None
        self.neck = MODELS.build(neck) if neck else None
        cells = grid.rasterized(bev_pixel_m)  # the extent, divided into cells of this size
        self.bev_size = (cells.height, cells.width)

    def forward(self, voxels: dict[str, Tensor], batch_size: int) -> Tensor:
        """Encode the voxels of a batch.

        Args:
            voxels: ``voxels``, the points of each voxel (M, points, channels); ``num_points``, the
                number of points of each voxel (M,); and ``coors``, the index of the sample and the
                cell z, y, x of each voxel (M, 4).
            batch_size: Number B of samples.

        Returns:
            BEV features, row 0 at the smallest y. (B, C, H, W)

        Raises:
            RuntimeError: If a sparse encoder (SECOND) runs on the CPU without spconv, or trains on
                the CPU. The class is `WorkError`.
        """
        coors = voxels["coors"]
        if isinstance(self.middle_encoder, SparseEncoder) and not coors.is_cuda:
            if self.training and torch.is_grad_enabled():
                raise WorkError(
                    "the sparse LiDAR encoder trains on a GPU only (spconv's backward pass needs "
                    "CUDA): on a CPU use a PointPillars config."
                )
            if not IS_SPCONV2_AVAILABLE:
                raise WorkError(
                    "the sparse LiDAR encoder needs a GPU or the package spconv (2.x); without "
                    "them use a PointPillars config."
                )
        voxel_feats = self.voxel_encoder(voxels["voxels"], voxels["num_points"], coors)  # (M, c)
        feats = self.middle_encoder(voxel_feats, coors, batch_size)
        for module in (self.backbone, self.neck):
            if module is not None:
                feats = module(feats)
        # Backbones and necks may return several maps, of which the first is used.
        if isinstance(feats, (list, tuple)):
            feats = feats[0]
        if feats.shape[-2:] != self.bev_size:
            feats = F.interpolate(feats, self.bev_size, mode="bilinear", align_corners=False)
        return feats


@MODELS.register_module()
class ConvFuser(ConvModule):
    """One convolution over the concatenated BEV features of cameras and LiDAR.

    Args:
        camera_channels: Channels of the camera features.
        lidar_channels: Channels of the LiDAR features.
        out_channels: Channels of the output.
        kwargs: Further arguments of ``mmcv.cnn.ConvModule``. By default, it is a 3x3 convolution
            without bias, followed by BatchNorm and ReLU.
    """

    def __init__(
        self, camera_channels: int, lidar_channels: int, out_channels: int, **kwargs: Any
    ) -> None:
        defaults = {"kernel_size": 3, "padding": 1, "bias": False, "norm_cfg": {"type": "BN"}}
        super().__init__(camera_channels + lidar_channels, out_channels, **{**defaults, **kwargs})

    def forward(self, camera_feats: Tensor, lidar_feats: Tensor) -> Tensor:
        """Fuse two BEV maps of equal size.

        Args:
            camera_feats: BEV features of the cameras. (B, camera_channels, H, W)
            lidar_feats: BEV features of the LiDAR. (B, lidar_channels, H, W)

        Returns:
            The fused features. (B, out_channels, H, W)
        """
        return super().forward(torch.cat([camera_feats, lidar_feats], dim=1))
