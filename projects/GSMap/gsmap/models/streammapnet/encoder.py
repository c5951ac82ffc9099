"""StreamMapNet's BEV encoder: BEVFormer's on several levels, rows counted from the largest y."""

from collections.abc import Mapping
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.encoders.bev_query_encoder import BEVEncoderLayer, BEVQueryEncoder
from gsmap.models.encoders.projection import PillarProjection
from gsmap.structures.grid import BEVGrid


class StreamMapNetEncoderLayer(BEVEncoderLayer):
    """`BEVEncoderLayer` whose cells can look at the mirrored row, as in the released code.

    ``mirrored`` switches that on; other arguments as of `BEVEncoderLayer`.
    """

    def __init__(self, *args: Any, mirrored: bool = False, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.mirrored = mirrored

    def centres(self, grid: BEVGrid, device: torch.device) -> Tensor:
        """Return where each cell's query looks around itself, [0, 1] over the map. (H, W, 2)"""
        centres = super().centres(grid, device)
        return centres.flip(0) if self.mirrored else centres


@MODELS.register_module()
class StreamMapNetEncoder(BEVQueryEncoder):
    """`BEVQueryEncoder` without the vehicle's motion, whose weights start with the largest y.

    Its output is as any encoder's, row 0 at the smallest y. Besides `BEVQueryEncoder`'s:

    Args:
        num_levels: Levels of image features.
        mirrored_self_attn: Let each cell's self-attention look at the row mirrored in the middle of
            the map, as released: the released weights need it.
    """

    layer_class = StreamMapNetEncoderLayer

    def __init__(
        self,
        num_levels: int = 3,
        layer_cfg: dict | None = None,
        mirrored_self_attn: bool = False,
        **kwargs: Any,
    ) -> None:
        kwargs["layer_cfg"] = {"mirrored": mirrored_self_attn, **(layer_cfg or {})}
        super().__init__(**kwargs, num_levels=num_levels, with_can_bus=False)

    def encode(
        self, feats: Any, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Tensor]:
        """Return ``bev_feats``, from ``img_from_frame`` (B, V, 4, 4)."""
        bev_feats = super().encode(feats, calibration, img_shape)["bev_feats"]
        return {"bev_feats": bev_feats.flip(2)}

    def project(self, img_from_frame: Tensor, img_shape: tuple[int, int]) -> PillarProjection:
        """Project the pillars of all cells, those of the largest y first, into every camera."""
        seen = super().project(img_from_frame, img_shape)
        rows = self.grid.height
        uv, visible = (part.unflatten(2, (rows, -1)).flip(2).flatten(2, 3) for part in seen)
        return PillarProjection(uv, visible)
