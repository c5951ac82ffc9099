"""MapQR's BEV encoder: geometry kernels at pillar heights that every layer refines (GKT-h)."""

from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor, nn

from gsmap.models.encoders.bev_query_encoder import BEVQueryEncoder
from gsmap.models.encoders.gkt import GeometryKernelAttention
from gsmap.models.encoders.projection import PillarProjection, pillar_points, visible_points
from gsmap.structures.tensors import at_least_float32


class MovingPillars:
    """The pillars of a batch, whose heights the encoder's layers move, one after another.

    Args:
        feet: Cell centres at z = 0, homogeneous, in metres. (Q, 4)
        start: First heights, [0, 1] over the range. (Z,)
        z_range: Lowest and highest z in metres.
        img_from_frame: Matrices to pixels. (B, V, 4, 4)
        img_shape: Rows and columns of the padded images.

    Attributes:
        heights: Present heights, [0, 1] over the range, not clipped. (B, Q, Z), at first (Z,)
    """

    def __init__(
        self,
        feet: Tensor,
        start: Tensor,
        z_range: Sequence[float],
        img_from_frame: Tensor,
        img_shape: tuple[int, int],
    ) -> None:
        self.start = self.heights = start
        self.low_m, self.extent_m = z_range[0], z_range[1] - z_range[0]
        matrices, self.img_shape = img_from_frame.float(), img_shape
        with torch.autocast(feet.device.type, enabled=False):
            self.feet = feet @ matrices.transpose(-1, -2)  # (B, V, Q, 4)
        self.upwards = matrices[:, :, None, None, :, 2]  # a metre of height (B, V, 1, 1, 4)

    def move(self, offsets_m: Tensor, accumulate: bool) -> PillarProjection:
        """Move the heights by offsets in metres (B, Q, Z), and project the pillars."""
        before = self.heights if accumulate else self.start
        self.heights = before + at_least_float32(offsets_m) / self.extent_m
        z = (self.low_m + self.heights * self.extent_m)[:, None, ..., None]  # (B, 1, Q, Z, 1)
        projected = self.feet[:, :, :, None] + z * self.upwards
        return visible_points(projected, self.img_shape)


@MODELS.register_module()
class HeightKernelAttention(GeometryKernelAttention):
    """Geometry kernel attention that first moves the height of each pillar point (MapQR).

    It samples bilinearly. All points of a cell that a camera sees are used, visible or not.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads; head m looks at pillar height m.
        kernel_size: Rows and columns of the kernel.
        accumulate_heights: Start from the heights of the layer before, as released, or from the
            evenly spaced ones.
        released_cells: As in `GeometryKernelAttention`.
        equal_weights: As there; MapQR's do start equal.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        kernel_size: tuple[int, int] = (2, 4),
        accumulate_heights: bool = True,
        released_cells: bool = False,
        equal_weights: bool = True,
    ) -> None:
        super().__init__(
            embed_dims,
            num_heads,
            kernel_size,
            bilinear=True,
            released_cells=released_cells,
            equal_weights=equal_weights,
        )
        self.accumulate_heights = accumulate_heights
        self.height_offsets = nn.Linear(embed_dims, num_heads)
        constant_init(self.height_offsets, 0.0)

    def forward(  # type: ignore[override]
        self, query: Tensor, img_feats: Tensor, pillars: MovingPillars
    ) -> Tensor:
        """Move the pillars, then attend as the base class does. (B, Q, C) -> (B, Q, C)"""
        seen = pillars.move(self.height_offsets(query), self.accumulate_heights)
        return super().forward(query, img_feats, seen)


@MODELS.register_module()
class HeightQueryEncoder(BEVQueryEncoder):
    """`BEVQueryEncoder` with pillars whose heights its layers move, `HeightKernelAttention`.

    The first heights are spread evenly over ``z_range``, ends included.

    Args:
        cross_attn: Config of the camera cross-attention of every layer (`HeightKernelAttention`).
        kwargs: Further arguments of `BEVQueryEncoder`.

    Raises:
        TypeError: If the cross-attention does not move heights.
    """

    def __init__(self, cross_attn: dict[str, Any] | None = None, **kwargs: Any) -> None:
        super().__init__({"type": HeightKernelAttention, **(cross_attn or {})}, **kwargs)
        kind = type(next(iter(self.layers)).cross_attn)
        if not issubclass(kind, HeightKernelAttention):
            raise TypeError(
                f"HeightQueryEncoder needs HeightKernelAttention, got {kind.__name__}: set "
                "bev_encoder.cross_attn.type, or take BEVQueryEncoder."
            )

    def project(  # type: ignore[override]
        self, img_from_frame: Tensor, img_shape: tuple[int, int]
    ) -> MovingPillars:
        """Return the pillars of a batch, before the first layer moves them."""
        device = img_from_frame.device
        feet = pillar_points(self.grid, (0.0, 0.0), 1, device)[:, 0]  # (Q, 4)
        start = torch.linspace(0, 1, self.num_heights, device=device)
        return MovingPillars(feet, start, self.z_range, img_from_frame, img_shape)
