"""Decoder of MapQR: instance queries with scatter-and-gather cross-attention."""

import math
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.models.base.decoder import Decoded, MapDecoder, MapDecoderLayer
from gsmap.models.base.groups import without_groups
from gsmap.models.base.layers import mlp
from gsmap.utils.errors import InputError


def sine_code(points: Tensor, channels: int) -> Tensor:
    """Sinusoidal positional encoding of points.

    The first half of the channels encodes y, and the second half encodes x. Within the half of a
    coordinate v, channel 2 i is the sine and channel 2 i + 1 is the cosine of
    2 pi v / 10000^(2 i / half), where ``half`` is C / 2.

    Args:
        points: Points (x, y) in [0, 1]. (..., 2)
        channels: Channels C, a multiple of 4.

    Returns:
        The encoding. (..., C)
    """
    half = channels // 2
    steps = 10000.0 ** (torch.arange(0, half, 2, device=points.device) / half)
    phases = 2 * math.pi * points.flip(-1)[..., None] / steps  # (..., 2, C / 4)
    return torch.stack([phases.sin(), phases.cos()], dim=-1).flatten(-3)


class Gather(nn.Sequential):
    """Gathering of MapQR: an MLP that maps the features of an instance's points to one query.

    Args:
        embed_dims: Channels C.
        points: Points P per instance.
    """

    def __init__(self, embed_dims: int, points: int) -> None:
        inputs = points * embed_dims
        super().__init__()
        # The layers are children of this module, so their state keys have no further level.
        for layer in mlp(inputs, inputs // 2, embed_dims, embed_dims):
            self.append(layer)
        self.points = points

    def forward(self, point_feats: Tensor) -> Tensor:
        """Gather the features of each instance. (B, N * P, C) -> (B, N, C)"""
        instance_feats = point_feats.unflatten(1, (-1, self.points)).flatten(2)
        return super().forward(instance_feats)


@MODELS.register_module()
class ScatterGatherAttention(BEVDeformableAttention):
    """Scatter-and-gather attention of MapQR.

    Each instance query is copied to the points of the instance. The points attend to the BEV
    features, and the results are gathered to one vector per instance.

    Args:
        points_per_instance: Points P per instance.
        embed_dims: Channels C.
        kwargs: Further arguments of :class:`SamplingAttention`; ``num_points`` is the number of
            samples per head and point.
    """

    def __init__(self, points_per_instance: int = 20, embed_dims: int = 256, **kwargs: Any) -> None:
        super().__init__(embed_dims=embed_dims, **kwargs)
        self.points_per_instance = points_per_instance
        # Replaces the projection of the base class, which is applied to the sampled features.
        self.output_proj = Gather(embed_dims, points_per_instance)

    def forward(
        self,
        query: Tensor,
        reference: Tensor,
        feats: Tensor,
        frames: Tensor | None = None,
        position: Tensor | float = 0.0,
    ) -> Tensor:
        """Attend from the points of the instances to the BEV features, without the residual.

        Args:
            query: Instance queries. (B, N, C)
            reference: References of the points, which begin with (x, y) in [0, 1] over the map.
                (B, N * P, D)
            feats: BEV features. (B, C, H, W)
            frames: Matrices that multiply the sampling offsets of the points from the left, or None
                for unchanged offsets. (B, N * P, 2, 2)
            position: Positional encoding of the points (B, N * P, C), or 0 for none.

        Returns:
            A vector per instance. (B, N, C)
        """
        point_query = query.repeat_interleave(self.points_per_instance, 1)  # (B, N * P, C)
        return super().forward(
            point_query + position, reference=reference, feats=feats, frames=frames
        )


@MODELS.register_module()
class MapQRDecoderLayer(MapDecoderLayer):
    """Decoder layer of MapQR: self-attention of instances, scatter-and-gather attention, FFN.

    Instance queries have no positional encoding. The positional encoding of a point is the
    sinusoidal encoding of its reference.

    Args:
        embed_dims: Channels C, a multiple of 4.
        num_points: Points P per instance.
        mask_groups: Whether to block self-attention between query groups (`MapQRDecoder.layer_mask`
            reads it). The published figures of MapQR were obtained without this mask.
        self_attn: Config of the self-attention of instances (`PointSelfAttention`).
        cross_attn: Config of the cross-attention (`ScatterGatherAttention`).
        kwargs: Further arguments of `MapDecoderLayer`.

    Raises:
        ValueError: If ``embed_dims`` is not a multiple of 4.
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
            raise InputError(f"embed_dims must be divisible by 4, got {embed_dims}.")
        # The self-attention treats an instance query as an instance with one point.
        self_attn_defaults = {"num_points": 1}
        cross_attn_defaults = {"type": "ScatterGatherAttention", "points_per_instance": num_points}
        super().__init__(
            embed_dims,
            self_attn={**self_attn_defaults, **(self_attn or {})},
            cross_attn={**cross_attn_defaults, **(cross_attn or {})},
            **kwargs,
        )
        self.mask_groups = mask_groups
        self.position_proj = nn.Linear(embed_dims, embed_dims)
        nn.init.zeros_(self.position_proj.bias)

    def forward(self, query: Tensor, _: Tensor, *inputs: Any) -> Tensor:  # type: ignore[override]
        """Update the instance queries.

        The second argument, the positional queries, is not used.

        Args:
            query: Instance queries. (B, N, C)
            inputs: References of the points (B, N * P, D), BEV features (B, C, H, W), and
                the self-attention mask (N, N) or None, as in `MapDecoderLayer`. The mask may be
                left out.

        Returns:
            The updated queries. (B, N, C)
        """
        reference, bev_feats, *attn_masks = inputs
        attn_mask = attn_masks[0] if attn_masks else None
        no_position = torch.zeros_like(query)
        attended = self.self_attn(query, no_position, attn_mask)  # with the residual
        query = self.norms[0](attended)
        code = sine_code(reference[..., :2], query.shape[-1])
        position = self.position_proj(code)
        frames = None
        # With guidance, the layer is conditioned on the references: they change the positional
        # encoding and transform the sampling offsets.
        if self.guidance is not None:
            position = self.guidance.position(position, reference)
            frames = self.guidance.frames(reference, bev_feats)
        bev_context = self.cross_attn(
            query, reference, feats=bev_feats, frames=frames, position=position
        )
        query = self.norms[1](query + bev_context)
        return self.norms[2](self.ffn(query))  # the FFN adds its residual itself


@MODELS.register_module()
class MapQRDecoder(MapDecoder):
    """Decoder with instance queries, each of which refines all points of its instance.

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
        """Settings of the point reference: one state per instance refines all its points.

        Args:
            num_points: Points P per instance.
        """
        return {"points_per_state": num_points}

    def layer_mask(self, mask: Tensor | None, group_mask: Tensor | None) -> Tensor | None:
        """Return the self-attention mask, by default without the mask between query groups.

        Args:
            mask: True where an instance (row) may not attend to another (column), or None. (N, N)
            group_mask: The mask between query groups, which ``mask`` contains, or None.
        """
        # All layers have the settings of the first one.
        layer: Any = self.layers[0]
        return mask if layer.mask_groups else without_groups(mask, group_mask)

    def read(self, state: Tensor, references: Tensor) -> Decoded:
        """Output of a layer: the points share the state of their instance.

        Args:
            state: States of the instances. (B, N, C)
            references: References of the points. (B, N * P, D)
        """
        points = state[:, :, None].expand(-1, -1, self.num_points, -1)
        return Decoded(points, self.by_instance(references), state)
