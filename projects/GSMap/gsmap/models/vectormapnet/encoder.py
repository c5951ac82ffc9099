"""VectorMapNet's BEV encoder: image features where planes of several heights are seen."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from mmcv.cnn import ConvModule
from mmdet.models.backbones.resnet import BasicBlock
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.layers import enlarged, resnet_stages
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.projection import PillarProjection, project_pillars
from gsmap.structures.grid import BEVGrid


@MODELS.register_module()
class HeightPlanesEncoder(CameraEncoder):
    """Mean features of all cameras at points of planes, side by side, and a neck of stride 4.

    Args:
        grid: The map's extent.
        heights_m: Heights Z of the planes above the ground.
        bev_pixel_m: Distance of a plane's points; its outermost lie on the edges of the map.
        embed_dims: Channels C of image and of BEV features.
        num_levels: Levels of image features, each half as large as the one before.
        neck_dims: Channels inside the neck.
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
        self.grid, self.num_levels = grid.rasterized(bev_pixel_m), num_levels
        norm = {"type": "GN", "num_groups": min(32, embed_dims)}
        self.upsampling = nn.ModuleList(
            nn.ModuleList(
                ConvModule(embed_dims, embed_dims, 3, padding=1, bias=True, norm_cfg=norm)
                for _ in range(level)
            )
            for level in range(1, num_levels)
        )
        self.reduction = nn.Conv2d(len(heights_m) * (embed_dims + 3), embed_dims, 3, padding=1)
        stem, stages = resnet_stages(BasicBlock, embed_dims, [neck_dims])
        last = nn.Conv2d(neck_dims, embed_dims, 1, bias=False)
        self.neck = nn.Sequential(*stem, nn.MaxPool2d(3, 2, 1), *stages, last)
        axes = zip((grid.y_range, grid.x_range), (self.grid.height, self.grid.width), strict=True)
        y, x = (torch.linspace(*ends, number) for ends, number in axes)
        z, y, x = torch.meshgrid(torch.tensor(heights_m), y, x, indexing="ij")
        self.planes: Tensor
        self.register_buffer("planes", torch.stack([x, y, z]), persistent=False)  # (3, Z, H, W)

    def levels(self, mlvl_feats: Sequence[Tensor]) -> list[Tensor]:
        """Return the first levels."""
        return list(mlvl_feats[: self.num_levels])

    def encode(
        self, feats: Sequence[Tensor], calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode feature maps, each (B, V, C, h, w), with ``img_from_ground`` (B, V, 4, 4)."""
        seen = self.project(calibration["img_from_ground"], img_shape)
        planes = self.sampled(self.joined(feats), seen)
        return {"bev_feats": self.neck(self.flattened(planes))}

    def joined(self, feats: Sequence[Tensor]) -> Tensor:
        """Return the sum of all levels at the size of the first. (B, V, C, h, w)

        Each level is enlarged to that of the next finer one, and so on. ValueError if there are
        fewer levels than the encoder is built for.
        """
        if len(feats) != self.num_levels:
            raise ValueError(
                f"HeightPlanesEncoder is built for {self.num_levels} levels of image features, got "
                f"{len(feats)}: set its num_levels, or out_indices and num_outs of backbone and "
                "neck."
            )
        sizes = [level.shape[-2:] for level in feats]
        total = feats[0].flatten(0, 1)
        for number, blocks in enumerate(cast(Any, self.upsampling), 1):
            image = feats[number].flatten(0, 1)
            for block, size in zip(blocks, reversed(sizes[:number]), strict=True):
                image = enlarged(block(image), size)
            total = total + image
        return total.unflatten(0, feats[0].shape[:2])

    def project(self, img_from_ground: Tensor, img_shape: tuple[int, int]) -> PillarProjection:
        """Project every point of the planes, each a pillar of one point. Q = Z * H * W"""
        points = F.pad(self.planes.flatten(1).T, (0, 1), value=1.0)
        return project_pillars(points[:, None], img_from_ground, img_shape)

    def sampled(self, feats: Tensor, seen: PillarProjection) -> Tensor:
        """Return the mean over the cameras that see a point, 0 if none. (B, C, Z, H, W)"""
        shape = self.planes.shape[1:]
        total = feats.new_zeros(())
        uv = (2 * seen.uv[..., 0, :] - 1).where(seen.visible[..., None], -2.0)  # (B, V, Q, 2)
        for view in range(feats.shape[1]):
            grid = uv[:, view].unflatten(1, (-1, shape[-1])).to(feats.dtype)  # (B, Z * H, W, 2)
            image = F.grid_sample(feats[:, view], grid, align_corners=False)
            total = total + image * seen.visible[:, view].view(-1, 1, *grid.shape[1:3])
        number = seen.visible.sum(1).clamp(min=1).view(-1, 1, *shape)
        return total.unflatten(2, shape[:2]) / number

    def flattened(self, planes: Tensor) -> Tensor:
        """Return one map of all planes, which know where they lie. -> (B, C, H, W)"""
        places = self.planes.expand(len(planes), -1, -1, -1, -1).to(planes.dtype)
        return self.reduction(torch.cat([planes, places], 1).flatten(1, 2))
