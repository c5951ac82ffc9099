"""BeMapNet's BEV encoder: BEV cells attend to all pixels, whose positions are ground points."""

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
from gsmap.models.lines.front import ahead, centres, front_size, turn_raster
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


@MODELS.register_module()
class BezierBEVEncoder(CameraEncoder):
    """BEV encoder with self-attention of all pixels and cross-attention from BEV cells to pixels.

    Pixels are the cells of the feature maps of all cameras. The positional encoding of a pixel is
    computed from the point where its viewing ray meets the ground (IPM-PE, BeMapNet).
    Pixels above the horizon are masked. In addition to ``bev_feats``, the encoder returns
    ``bev_levels``, the outputs of all BEV layers.

    Args:
        grid: Extent of the map, in metres.
        in_channels: Channels of the image features.
        bev_pixel_m: Side of a BEV cell in metres.
        embed_dims: Channels C of the BEV features.
        num_layers: Number of self-attention layers of the pixels, and number of BEV layers, in
            which cells attend to pixels.
        layer_cfg: Settings ``num_heads``, ``ffn_dims`` and ``dropout`` of all layers.
        position_dims: Hidden channels of the network of the positional encoding.
        position_size: Rows and columns of the image that the feature maps are taken to cover when
            viewing rays are computed. The default is the size before cropping, as in the released
            code. None is the size of the cropped images.
        from_camera: Whether ground points are relative to the point below their camera, as in the
            released code, instead of relative to the origin of the ground frame.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If ``num_layers`` does not have two entries, or the second is less than 1.
    """

    calibration = ("ground_from_img",)  # names of the matrices that `encode` receives

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
                "num_layers must be two numbers, of pixel layers and of BEV layers (>= 1), got "
                f"{tuple(num_layers)}."
            )
        self.grid = grid.rasterized(bev_pixel_m)
        self.from_camera = from_camera
        self.position_size = position_size
        self.embed_dims = embed_dims
        self.input_proj = nn.Conv2d(in_channels, embed_dims, kernel_size=1)
        settings = {"num_heads": 8, "ffn_dims": 1024, "dropout": 0.1, **(layer_cfg or {})}
        num_source_layers, num_bev_layers = num_layers
        # Layers with `to_memory` have self-attention and cross-attention, other layers only the
        # former.
        self.source_layers = nn.ModuleList(
            AttentionLayer(embed_dims, **settings, to_memory=False)
            for _ in range(num_source_layers)
        )
        self.bev_layers = nn.ModuleList(
            AttentionLayer(embed_dims, **settings, to_memory=True) for _ in range(num_bev_layers)
        )
        self.norm = nn.LayerNorm(embed_dims)
        self.bev_embedding = nn.Embedding(self.grid.height * self.grid.width, embed_dims)
        self.position = nn.Sequential(
            nn.Conv2d(embed_dims, position_dims, kernel_size=1),
            nn.ReLU(),
            nn.Conv2d(position_dims, embed_dims, kernel_size=1),
        )

    def init_weights(self) -> None:
        """Initialise the matrices of the layers and the cell embeddings with Xavier's method."""
        super().init_weights()
        for module in (self.source_layers, self.bev_layers, self.bev_embedding):
            init_matrices(module)

    def encode(
        self, feats: Tensor, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode image features to BEV features.

        Args:
            feats: Image features. (B, V, C', h, w)
            calibration: ``ground_from_img``, transforms from pixels (u * d, v * d, d, 1) with the
                depth d to the ground frame, in metres. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.

        Returns:
            ``bev_feats`` (B, C, H, W) and ``bev_levels``, one map (B, C, H, W) for each BEV layer.
        """
        # Ground points (B, S, 2), and whether the viewing ray of a pixel meets the ground (B, S).
        points, on_ground = self.ground_points(
            calibration["ground_from_img"], size=feats.shape[-2:], img_shape=img_shape
        )
        # The sources are the pixels of all cameras, to which the BEV cells attend.
        images = feats.flatten(0, 1)  # (B * V, C', h, w)
        sources = self.input_proj(images).unflatten(0, feats.shape[:2])  # (B, V, C, h, w)
        sources = sources.permute(0, 1, 3, 4, 2).flatten(1, 3)  # (B, S, C), S = V * h * w
        source_pos = self.positions(points, on_ground)
        # Attention needs at least one key, so samples without any ground pixel are not masked.
        ignored = ~on_ground & on_ground.any(dim=-1, keepdim=True)  # (B, S)
        for layer in self.source_layers:
            sources = layer(sources, source_pos, key_padding_mask=ignored)
        # In the layers, row 0 of the BEV cells is at the front, as in line heads and in the
        # released code. `turn_raster` converts the outputs to the order of `grid`.
        shape = front_size(self.grid)
        cells_yx = centres([shape], feats.device).flip(-1)  # (H * W, 2), row first, in [0, 1]
        cell_centres = self.grid.metres_from_front(cells_yx)
        # As for the pixels: distances ahead and to the left.
        cell_points = ahead(cell_centres, self.grid)[None]  # (1, H * W, 2), for all samples
        cell_pos = self.positions(cell_points)
        cells = self.bev_embedding.weight.expand(len(feats), -1, -1)  # (B, H * W, C)
        levels = []
        for layer in self.bev_layers:
            # Cells attend by features and positions (keys), and receive features only (memory).
            cells = layer(
                cells,
                cell_pos,
                key=sources + source_pos,
                memory=sources,
                key_padding_mask=ignored,
            )
            level = self.norm(cells).transpose(1, 2).unflatten(2, shape)
            levels.append(turn_raster(level, self.grid))
        return {"bev_feats": levels[-1], "bev_levels": levels}

    def ground_points(
        self, ground_from_img: Tensor, size: Sequence[int], img_shape: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """Intersect the viewing rays of feature pixels with the ground.

        Args:
            ground_from_img: Transforms from pixels (u * d, v * d, d, 1) with the depth d to the
                ground frame, in metres. (B, V, 4, 4)
            size: Rows h and columns w of the image features, S = V * h * w pixels.
            img_shape: Rows and columns of the padded images.

        Returns:
            Points as (distance ahead, distance to the left) in metres, (B, S, 2), and a mask that
            is True for pixels below the horizon, (B, S).

        Raises:
            ValueError: If ``position_size`` has fewer rows than the images, or another number of
                columns.
        """
        matrices = ground_from_img.float()
        image_size = self.position_size or img_shape
        if image_size[0] < img_shape[0] or image_size[1] != img_shape[1]:
            raise InputError(
                f"position_size of BezierBEVEncoder is {tuple(image_size)}, but images have "
                f"{img_shape[0]} rows and {img_shape[1]} columns: set it to their size before rows "
                "are cut off, or to None."
            )
        rays = pixel_rays(
            matrices,
            image_size=(image_size[0], image_size[1]),
            feature_size=(size[0], size[1]),
        )
        camera = matrices[:, :, None, None, :3, 3]  # camera centres (B, V, 1, 1, 3)
        depth = -camera[..., 2:] / rays[..., 2:]  # where the ray has height 0 (B, V, h, w, 1)
        # Differs from the paper, as in the released code: the camera centre is not added.
        points = rays[..., :2] * depth
        if not self.from_camera:
            points = points + camera[..., :2]
        on_ground = depth[..., 0] > 0
        return ahead(points, self.grid).flatten(1, 3), on_ground.flatten(1)

    def positions(self, points: Tensor, on_ground: Tensor | None = None) -> Tensor:
        """Compute positional encodings of ground points.

        Args:
            points: Points as (distance ahead, distance to the left) in metres. (B, Q, 2)
            on_ground: True for pixels whose rays meet the ground. The sine encoding of others is
                set to 0. None if all points are on the ground. (B, Q)

        Returns:
            Positional encodings. (B, Q, C)
        """
        with torch.autocast(points.device.type, enabled=False):
            # Each of the two coordinates has half of the channels.
            encoding = coordinate_to_encoding(points, self.embed_dims // 2, scale=1.0)  # (B, Q, C)
        if on_ground is not None:
            encoding = torch.where(on_ground[..., None], encoding, 0.0)
        encoding = encoding.transpose(1, 2)[..., None]  # (B, C, Q, 1), for 1x1 convolutions
        return self.position(encoding)[..., 0].transpose(1, 2)
