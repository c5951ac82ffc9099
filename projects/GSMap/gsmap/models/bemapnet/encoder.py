"""BeMapNet's BEV encoder: attention of all cells to all pixels, placed on the ground."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmdet.models.layers import coordinate_to_encoding
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.projection import pixel_rays
from gsmap.models.lines.decoder import AttentionLayer
from gsmap.models.lines.front import ahead, centres, front_size, turned
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


@MODELS.register_module()
class BezierBEVEncoder(CameraEncoder):
    """Mix the cameras side by side, then let BEV cells look at them, all at all (BeMapNet).

    A pixel's position is that of the point on the ground that it shows (IPM-PE); pixels above the
    horizon are not looked at. Besides ``bev_feats`` there are ``bev_levels``, what each of the BEV
    layers returns.

    Args:
        grid: The map's extent.
        in_channels: Channels of the feature map.
        bev_pixel_m: Side of a BEV cell in metres.
        num_layers: Layers over the cameras, and BEV layers.
        layer_cfg: ``num_heads``, ``ffn_dims``, ``dropout`` of all layers.
        position_dims: Hidden channels of the positions' network.
        position_size: Rows and columns of the image over which positions of pixels are spread: as
            released, of the one that is not cropped yet. None takes the images' own.
        from_camera: Place points relative to their camera, as released, not to the vehicle.

    Raises:
        ValueError: If ``num_layers`` are not two numbers, of which the second is 1 or more.
    """

    calibration = ("ground_from_img",)

    def __init__(
        self,
        grid: BEVGrid,
        in_channels: int = 600,
        bev_pixel_m: float = 0.9375,
        embed_dims: int = 512,
        num_layers: Sequence[int] = (2, 4),
        layer_cfg: Mapping[str, Any] | None = None,
        position_dims: int = 2048,
        position_size: Sequence[int] | None = (512, 896),
        from_camera: bool = True,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        if len(num_layers) != 2 or num_layers[1] < 1:
            raise InputError(
                "num_layers must be those over the cameras and those of the BEV cells, of which at "
                f"least 1, got {tuple(num_layers)}."
            )
        self.grid, self.from_camera = grid.rasterized(bev_pixel_m), from_camera
        self.position_size, self.embed_dims = position_size, embed_dims
        self.input_proj = nn.Conv2d(in_channels, embed_dims, 1)
        settings = {"num_heads": 8, "ffn_dims": 1024, "dropout": 0.1, **(layer_cfg or {})}
        self.source_layers, self.bev_layers = (
            nn.ModuleList(
                AttentionLayer(embed_dims, **settings, to_memory=memory) for _ in range(number)
            )
            for memory, number in zip((False, True), num_layers, strict=True)
        )
        self.norm = nn.LayerNorm(embed_dims)
        self.bev_embedding = nn.Embedding(self.grid.height * self.grid.width, embed_dims)
        self.position = nn.Sequential(
            nn.Conv2d(embed_dims, position_dims, 1),
            nn.ReLU(),
            nn.Conv2d(position_dims, embed_dims, 1),
        )

    def init_weights(self) -> None:
        """Initialise the matrices of the layers and the table of cells (Xavier)."""
        super().init_weights()
        for part in (self.source_layers, self.bev_layers, self.bev_embedding):
            init_matrices(part)

    def encode(
        self, feats: Tensor, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode features (B, V, C, h, w) with ``ground_from_img`` (B, V, 4, 4)."""
        points, seen = self.ground_points(
            calibration["ground_from_img"], feats.shape[-2:], img_shape
        )
        sources = self.input_proj(feats.flatten(0, 1)).unflatten(0, feats.shape[:2])
        sources = sources.permute(0, 1, 3, 4, 2).flatten(1, 3)  # (B, S, C)
        position = self.positions(points, seen)
        hidden = ~seen & seen.any(-1, keepdim=True)  # without any ground, all are looked at
        for layer in self.source_layers:
            sources = layer(sources, position, key_padding_mask=hidden)
        shape = front_size(self.grid)
        places = self.grid.metres_from_front(centres([shape], feats.device).flip(-1))
        own = self.positions(ahead(places, self.grid)[None])
        cells, bev = self.bev_embedding.weight.expand(len(feats), -1, -1), []
        for layer in self.bev_layers:
            cells = layer(cells, own, sources + position, sources, key_padding_mask=hidden)
            level = self.norm(cells).transpose(1, 2).unflatten(2, shape)
            bev.append(turned(level, self.grid))
        return {"bev_feats": bev[-1], "bev_levels": bev}

    def ground_points(
        self, ground_from_img: Tensor, size: Sequence[int], img_shape: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """Return what point on the ground each pixel of maps of a size shows, and whether it does.

        Points are metres ahead and to the left. (B, S, 2), (B, S)

        ValueError if ``position_size`` is not that of these images before rows were cut off.
        """
        matrices = ground_from_img.float()
        image_size = self.position_size or img_shape
        if image_size[0] < img_shape[0] or image_size[1] != img_shape[1]:
            raise InputError(
                f"position_size of BezierBEVEncoder is {tuple(image_size)}, but images have "
                f"{img_shape[0]} rows and {img_shape[1]} columns: set it to their size before rows "
                "are cut off, or to None."
            )
        rays = pixel_rays(matrices, (image_size[0], image_size[1]), (size[0], size[1]))
        camera = matrices[:, :, None, None, :3, 3]
        depth = -camera[..., 2:] / rays[..., 2:]
        points = rays[..., :2] * depth  # differs from the paper, as released
        if not self.from_camera:
            points = points + camera[..., :2]
        return ahead(points, self.grid).flatten(1, 3), (depth[..., 0] > 0).flatten(1)

    def positions(self, points: Tensor, seen: Tensor | None = None) -> Tensor:
        """Return the positions of points (B, Q, 2); of those that are not seen, that of zeros.

        (B, Q, C)
        """
        with torch.autocast(points.device.type, enabled=False):
            code = coordinate_to_encoding(points, self.embed_dims // 2, scale=1.0)  # of metres
        if seen is not None:
            code = torch.where(seen[..., None], code, 0.0)
        return self.position(code.transpose(1, 2)[..., None])[..., 0].transpose(1, 2)
