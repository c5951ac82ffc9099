"""StreamMapNet's BEV encoder: BEVFormer's encoder on several levels of image features."""

from collections.abc import Mapping
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.encoders.bev_query_encoder import BEVEncoderLayer, BEVQueryEncoder
from gsmap.models.encoders.projection import PillarProjection
from gsmap.structures.grid import BEVGrid


class StreamMapNetEncoderLayer(BEVEncoderLayer):
    """`BEVEncoderLayer` whose self-attention can be mirrored, as in the released code.

    Args:
        cross_attn: Settings of the camera cross-attention.
        mirrored: Whether a cell attends around its mirror image: the cell in its column whose row
            is counted from the other end of the map.
        kwargs: Further arguments of `BEVEncoderLayer`.
    """

    def __init__(self, cross_attn: dict, mirrored: bool = False, **kwargs: Any) -> None:
        super().__init__(cross_attn, **kwargs)
        self.mirrored = mirrored

    def centres(self, grid: BEVGrid, device: torch.device) -> Tensor:
        """Return the reference points (x, y) of the cells' self-attention.

        Args:
            grid: Extent and cells of the map.
            device: Device of the result.

        Returns:
            Reference points in [0, 1] over the map. (H, W, 2)
        """
        centres = super().centres(grid, device)
        return centres.flip(0) if self.mirrored else centres


@MODELS.register_module()
class StreamMapNetEncoder(BEVQueryEncoder):
    """`BEVQueryEncoder` that does not receive the vehicle's motion signals (StreamMapNet).

    Inside the encoder, row 0 is at the largest y, as in the released weights. Row 0 of its output
    is at the smallest y, as in all encoders.

    Args:
        num_levels: Number of levels of image features.
        layer_cfg: Settings of `StreamMapNetEncoderLayer`.
        mirrored_self_attn: Argument ``mirrored`` of the layers. True, as in the released code, is
            required by the released weights.
        kwargs: Further arguments of `BEVQueryEncoder`.
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
        # The CAN bus has the signals of the vehicle's motion.
        super().__init__(**kwargs, num_levels=num_levels, with_can_bus=False)

    def encode(
        self, feats: Any, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Tensor]:
        """Encode image features to BEV features.

        Args:
            feats: Image features of one level (B, V, C, h, w), or a list of levels.
            calibration: ``img_from_frame``, transforms from the map frame in metres to pixels.
                (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.

        Returns:
            ``bev_feats`` (B, C, H, W), with row 0 at the smallest y, and the input as
            ``img_feats``.
        """
        outputs = super().encode(feats, calibration, img_shape=img_shape)
        return {**outputs, "bev_feats": outputs["bev_feats"].flip(2)}

    def project(self, img_from_frame: Tensor, img_shape: tuple[int, int]) -> PillarProjection:
        """Project the pillars of all cells into every camera. Row 0 of the cells has the largest y.

        A pillar is the vertical row of points above a cell. `encode` of the base class calls this
        method. The method of the base class has row 0 at the smallest y, so its rows are flipped.

        Args:
            img_from_frame: Transforms from the map frame in metres to pixels. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.
        """
        projection = super().project(img_from_frame, img_shape)
        return PillarProjection(
            uv=self._flip_rows(projection.uv), visible=self._flip_rows(projection.visible)
        )

    def _flip_rows(self, values: Tensor) -> Tensor:
        """Reverse the order of the rows. (B, V, H * W, ...) -> (B, V, H * W, ...)"""
        return values.unflatten(2, (self.grid.height, -1)).flip(2).flatten(2, 3)
