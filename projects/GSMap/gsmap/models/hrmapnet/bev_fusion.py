"""Fusion of BEV features with the map of earlier frames."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule, constant_init
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices
from gsmap.models.base.parts import DEFAULTS, build_part
from gsmap.structures.grid import BEVGrid

# Default settings of the BEV layer.
_LAYER = {
    "type": "BEVQueryEncoder",
    "cross_attn": {
        "type": "SpatialCrossAttention",
        "num_heads": 8,
        "num_points": 8,
        "num_heights": 4,
    },
    "layer_cfg": {"num_heads": 8, "ffn_dims": 512, "dropout": 0.1},
    "with_can_bus": False,
}


@MODELS.register_module()
class PriorBEVFusion(BaseModule):
    """Fuses BEV features with the map of earlier frames (HRMapNet).

    The output of a BEV layer is added to the features where the map is known. Then the map is
    appended to the channels, and a convolution is applied.

    Args:
        grid: Extent and cells of the BEV features, H rows and W columns.
        embed_dims: Channels C of the BEV features.
        num_channels: Channels M of the map in each cell.
        threshold: Smallest value of a channel from which a cell counts as known.
        layer: Settings of the BEV layer, a `BEVQueryEncoder`, which computes BEV features from the
            images. They replace the defaults in ``_LAYER``. None leaves the layer out.
        z_range: Lowest and highest z of the pillars of the layer, in metres.
        residual: Whether the result is added to the features through a 1 x 1 convolution, whose
            weights start at 0. A model that was trained without a map then starts with unchanged
            features. If False, the result replaces the features, as published.
        init_cfg: Initialisation by mmengine, in addition to ``init_weights``; None for none.
    """

    def __init__(
        self,
        grid: BEVGrid,
        embed_dims: int = 256,
        num_channels: int = 3,
        threshold: float = 0.8,
        layer: Mapping[str, Any] | None = DEFAULTS,
        z_range: Sequence[float] = (-10.0, 10.0),
        residual: bool = False,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.threshold = threshold
        self.layer: Any = None
        if layer is not None:
            sizes = {"grid": grid, "bev_pixel_m": grid.pixel_size_m, "embed_dims": embed_dims}
            # Settings in `layer` take precedence over the keyword arguments.
            self.layer = build_part(layer, **_LAYER, **sizes, z_range=z_range)
        self.conv = nn.Sequential(
            nn.Conv2d(embed_dims + num_channels, embed_dims, kernel_size=3, padding=1, bias=False),
            nn.BatchNorm2d(embed_dims),
            nn.ReLU(inplace=True),
        )
        self.output_conv = nn.Conv2d(embed_dims, embed_dims, kernel_size=1) if residual else None

    @property
    def calibration(self) -> tuple[str, ...]:
        """Names of the calibration arrays that the layer reads; none without a layer."""
        return () if self.layer is None else self.layer.calibration

    def init_weights(self) -> None:
        """Initialise the BEV layer, and the convolution from Xavier's uniform distribution.

        The weights of the residual convolution are set to 0.
        """
        super().init_weights()
        init_matrices(self.conv)
        if self.output_conv is not None:
            constant_init(self.output_conv, 0.0)

    def forward(
        self,
        feats: Tensor,
        cells: Tensor,
        img_feats: Tensor,
        calibration: Mapping[str, Tensor],
        img_shape: tuple[int, int],
    ) -> Tensor:
        """Fuse BEV features with the map.

        Args:
            feats: BEV features. (B, C, H, W)
            cells: Map in each cell, [0, 1]. (B, M, H, W)
            img_feats: Image features, for the layer. (B, V, C, h, w)
            calibration: A tensor for each name in the property ``calibration``. (B, ...)
            img_shape: Rows and columns of the padded images.

        Returns:
            Fused features. (B, C, H, W)
        """
        enhanced_feats = feats
        if self.layer is not None:
            encoded = self.layer.encode(img_feats, calibration, img_shape=img_shape)
            is_known = cells.amax(1, keepdim=True) >= self.threshold  # (B, 1, H, W)
            enhanced_feats = feats + torch.where(is_known, encoded["bev_feats"], 0.0)
        fused = self.conv(torch.cat([enhanced_feats, cells.to(feats.dtype)], dim=1))
        if self.output_conv is None:
            return fused
        return feats + self.output_conv(fused)
