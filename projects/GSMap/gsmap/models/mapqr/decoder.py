"""MapQR's decoder: an instance query is scattered to its points, which look, and gathered again."""

import math
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.models.base.decoder import Decoded, MapDecoder, MapDecoderLayer
from gsmap.models.base.layers import mlp


def sine_code(points: Tensor, channels: int) -> Tensor:
    """Return a code of points (x, y) in [0, 1]: half of the channels of y, then half of x.

    Each half holds sine and cosine in turn, of 2 pi v / 10000^(2 i / half). (..., 2) -> (..., C)
    """
    half = channels // 2
    steps = 10000.0 ** (torch.arange(0, half, 2, device=points.device) / half)
    phases = 2 * math.pi * points.flip(-1)[..., None] / steps  # (..., 2, C / 4)
    return torch.stack([phases.sin(), phases.cos()], -1).flatten(-3)


class Gather(nn.Sequential):
    """The network that joins what the points of an instance saw (MapQR)."""

    def __init__(self, embed_dims: int, points: int) -> None:
        joined = points * embed_dims
        super().__init__(*mlp(joined, joined // 2, embed_dims, embed_dims))
        self.points = points

    def forward(self, seen: Tensor) -> Tensor:
        """Join the points of each instance. (B, N * P, C) -> (B, N, C)"""
        return super().forward(seen.unflatten(1, (-1, self.points)).flatten(2))


@MODELS.register_module()
class ScatterGatherAttention(BEVDeformableAttention):
    """Deformable attention of instance queries by way of their points (MapQR).

    Args:
        points_per_instance: Points per instance P.
        kwargs: Arguments of :class:`SamplingAttention`; ``num_points`` are the samples per head and
            point.
    """

    def __init__(self, points_per_instance: int = 20, embed_dims: int = 256, **kwargs: Any) -> None:
        super().__init__(embed_dims=embed_dims, **kwargs)
        self.points_per_instance = points_per_instance
        self.output_proj = Gather(embed_dims, points_per_instance)

    def forward(
        self,
        query: Tensor,
        reference: Tensor,
        feats: Tensor,
        frames: Tensor | None = None,
        position: Tensor | float = 0.0,
    ) -> Tensor:
        """Return what each instance's points see of the map (B, C, H, W). (B, N, C) -> (B, N, C)

        References and frames are as in `place_samples`, of the points, as is the position that is
        added to their copies of the query. (B, N * P, ...)
        """
        scattered = query.repeat_interleave(self.points_per_instance, 1)
        return super().forward(scattered + position, reference, feats, frames)


@MODELS.register_module()
class MapQRDecoderLayer(MapDecoderLayer):
    """Self-attention of the instances, scatter-and-gather attention, feed-forward (MapQR).

    Only the points have a position: a code of their reference.

    Args:
        embed_dims: Channels C; ValueError if 4 does not divide them.
        num_points: Points per instance P.
        mask_groups: Keep the query groups apart in the self-attention. MapQR's published figures
            were made without.
        self_attn: Config of the self-attention of instances (`PointSelfAttention`).
        cross_attn: Config of the cross-attention (`ScatterGatherAttention`).
        kwargs: Further arguments of `MapDecoderLayer`.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_points: int = 20,
        mask_groups: bool = False,
        self_attn: dict[str, Any] | None = None,
        cross_attn: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if embed_dims % 4:
            raise ValueError(f"embed_dims must be divisible by 4, got {embed_dims}.")
        scattered = {"type": "ScatterGatherAttention", "points_per_instance": num_points}
        super().__init__(
            embed_dims,
            self_attn={"num_points": 1, **(self_attn or {})},
            cross_attn={**scattered, **(cross_attn or {})},
            **kwargs,
        )
        self.mask_groups = mask_groups
        self.position_proj = nn.Linear(embed_dims, embed_dims)
        nn.init.zeros_(self.position_proj.bias)

    def forward(self, query: Tensor, _: Tensor, *inputs: Any) -> Tensor:  # type: ignore[override]
        """Update the instance queries. (B, N, C) -> (B, N, C)

        As in `MapDecoderLayer`, but that references are of the points (B, N * P, D) and that the
        learned position, which the first reference comes from, is not used.
        """
        reference, bev_feats, *masks = inputs
        mask = masks[0] if self.mask_groups else None
        query = self.norms[0](self.self_attn(query, torch.zeros_like(query), mask))
        code = sine_code(reference[..., :2], query.shape[-1])
        position, frames = self.position_proj(code), None
        if self.guidance is not None:
            position = self.guidance.position(position, reference)
            frames = self.guidance.frames(reference, bev_feats)
        seen = self.cross_attn(query, reference, bev_feats, frames, position)
        return self.norms[2](self.ffn(self.norms[1](query + seen)))


@MODELS.register_module()
class MapQRDecoder(MapDecoder):
    """A stack of layers with instance queries, each of which moves all points of its instance.

    Args:
        layer: Config of the layer (`MapQRDecoderLayer`).
        kwargs: Further arguments of `MapDecoder`.
    """

    point_queries = False
    layer_class = MapQRDecoderLayer

    def __init__(self, layer: dict[str, Any] | None = None, **kwargs: Any) -> None:
        super().__init__(layer or {}, **kwargs)

    @classmethod
    def reference_settings(cls, num_points: int) -> dict[str, Any]:
        """Return that all points of an instance start from one query and move by one state."""
        return {"points_per_state": num_points}

    def read(self, state: Tensor, references: Tensor) -> Decoded:
        """Return a layer's output: the points share the state of their instance. (B, N, C)"""
        points = state[:, :, None].expand(-1, -1, self.num_points, -1)
        return Decoded(points, self.by_instance(references), state)
