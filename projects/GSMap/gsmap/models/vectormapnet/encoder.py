"""VectorMapNet's BEV encoder, which samples image features at horizontal planes."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from mmcv.cnn import ConvModule
from mmdet.models.backbones.resnet import BasicBlock
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.layers import resize_map, resnet_stages
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.projection import PillarProjection, project_pillars
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


@MODELS.register_module()
class HeightPlanesEncoder(CameraEncoder):
    """BEV encoder that averages the image features of all cameras at points of horizontal planes.

    The features and coordinates (x, y, z) of the points of all planes are concatenated along the
    channels. A convolution and a neck of stride 4 reduce the result to BEV features.

    Args:
        grid: Extent of the map, in metres.
        heights_m: Heights of the Z planes above the ground, in metres.
        bev_pixel_m: Approximate distance of neighbouring points of a plane, in metres. The
            outermost points lie on the edges of the map.
        embed_dims: Channels C of the image features and of the BEV features.
        num_levels: Number of levels of image features, each half as large as the previous one.
        neck_dims: Hidden channels of the neck.
        init_cfg: Initialisation config of mmengine.
    """

    calibration = ("img_from_ground",)

    def __init__(
        self,
        grid: BEVGrid,
        heights_m: Sequence[float] = (-1.1, 0.0, 0.5, 1.1),
        bev_pixel_m: float = 0.3,
        embed_dims: int = 128,
        num_levels: int = 4,
        neck_dims: int = 64,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid = grid.rasterized(bev_pixel_m)
        self.num_levels = num_levels
        norm = {"type": "GN", "num_groups": min(32, embed_dims)}
        self.upsampling = nn.ModuleList()
        # Level i is enlarged i times, with a convolution before each enlargement.
        for level in range(1, num_levels):
            blocks = nn.ModuleList()
            for _ in range(level):
                block = ConvModule(embed_dims, embed_dims, 3, padding=1, bias=True, norm_cfg=norm)
                blocks.append(block)
            self.upsampling.append(blocks)
        plane_channels = len(heights_m) * (embed_dims + 3)  # features and x, y, z of the points
        self.reduction = nn.Conv2d(plane_channels, embed_dims, kernel_size=3, padding=1)
        # The stem and the pooling have stride 2 each, and the only stage keeps the size.
        stem, stages = resnet_stages(BasicBlock, embed_dims, widths=[neck_dims])
        pooling = nn.MaxPool2d(3, stride=2, padding=1)
        projection = nn.Conv2d(neck_dims, embed_dims, kernel_size=1, bias=False)
        self.neck = nn.Sequential(*stem, pooling, *stages, projection)
        z = torch.tensor(heights_m)
        y = torch.linspace(grid.y_range[0], grid.y_range[1], steps=self.grid.height)
        x = torch.linspace(grid.x_range[0], grid.x_range[1], steps=self.grid.width)
        z, y, x = torch.meshgrid(z, y, x, indexing="ij")
        # The points of the planes follow from the settings, so they are not in checkpoints.
        self.planes: Tensor
        self.register_buffer("planes", torch.stack([x, y, z]), persistent=False)  # (3, Z, H, W)

    def levels(self, mlvl_feats: Sequence[Tensor]) -> list[Tensor]:
        """Return the first ``num_levels`` levels of image features."""
        return list(mlvl_feats[: self.num_levels])

    def encode(
        self, feats: Sequence[Tensor], calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode image features to BEV features.

        Args:
            feats: Levels of image features, the finest first. (B, V, C, h, w) each
            calibration: ``img_from_ground``, transforms from the ground frame in metres to pixels.
                (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.

        Returns:
            ``bev_feats``. (B, C, H / 4, W / 4)
        """
        projection = self.project(calibration["img_from_ground"], img_shape)
        planes = self.sample_planes(self.merge_levels(feats), projection)
        return {"bev_feats": self.neck(self.flatten_planes(planes))}

    def merge_levels(self, feats: Sequence[Tensor]) -> Tensor:
        """Sum all levels at the size of the first one.

        Each level is enlarged step by step through the sizes of the finer levels.

        Args:
            feats: Levels of image features, the finest first. (B, V, C, h, w) each

        Returns:
            Sum of the levels. (B, V, C, h, w)

        Raises:
            ValueError: If the number of levels differs from ``num_levels``.
        """
        if len(feats) != self.num_levels:
            raise InputError(
                f"HeightPlanesEncoder is built for {self.num_levels} levels of image features, got "
                f"{len(feats)}: set its num_levels, or out_indices and num_outs of backbone and "
                "neck."
            )
        sizes = [level.shape[-2:] for level in feats]
        total = feats[0].flatten(0, 1)
        for number, blocks in enumerate(cast(Any, self.upsampling), start=1):
            image = feats[number].flatten(0, 1)
            # The finer sizes, beginning with the next one.
            for block, size in zip(blocks, reversed(sizes[:number]), strict=True):
                image = resize_map(block(image), size)
            total = total + image
        return total.unflatten(0, feats[0].shape[:2])

    def project(self, img_from_ground: Tensor, img_shape: tuple[int, int]) -> PillarProjection:
        """Project the Q = Z * H * W points of the planes, each as a pillar of one point.

        Args:
            img_from_ground: Transforms from the ground frame in metres to pixels. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.

        Returns:
            Image coordinates (B, V, Q, 1, 2), and whether a camera covers the point. (B, V, Q)
        """
        points = F.pad(self.planes.flatten(1).T, (0, 1), value=1.0)  # (Q, 4)
        return project_pillars(points[:, None], img_from_ground, img_shape=img_shape)

    def sample_planes(self, feats: Tensor, projection: PillarProjection) -> Tensor:
        """Average the features of all cameras in which a point is visible.

        Args:
            feats: Image features. (B, V, C, h, w)
            projection: Projection of the points of the planes, from `project`.

        Returns:
            Mean features, 0 where no camera covers the point. (B, C, Z, H, W)
        """
        num_planes, height, width = self.planes.shape[1:]
        visible = projection.visible  # (B, V, Q)
        uv = 2 * projection.uv[..., 0, :] - 1  # [-1, 1] over the image, (B, V, Q, 2)
        # Projections of invisible points may have any value, even NaN. They are set to -2, a place
        # beyond the image, where `grid_sample` returns 0.
        uv = uv.where(visible[..., None], -2.0)
        total = feats.new_zeros(())
        for view in range(feats.shape[1]):
            grid = uv[:, view].unflatten(1, (-1, width)).to(feats.dtype)  # (B, Z * H, W, 2)
            view_feats = F.grid_sample(
                feats[:, view], grid, align_corners=False
            )  # (B, C, Z * H, W)
            total = total + view_feats
        num_views = visible.sum(dim=1).clamp(min=1).view(-1, 1, num_planes, height, width)
        return total.unflatten(2, (num_planes, height)) / num_views

    def flatten_planes(self, planes: Tensor) -> Tensor:
        """Merge the features and the coordinates of all planes into one map.

        Args:
            planes: Features at the points of the planes. (B, C, Z, H, W)

        Returns:
            BEV features before the neck. (B, C, H, W)
        """
        coordinates = self.planes.expand(len(planes), -1, -1, -1, -1).to(planes.dtype)
        return self.reduction(torch.cat([planes, coordinates], dim=1).flatten(1, 2))
