"""MGMapNet's decoder: instance queries and point queries in one stack of layers."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from mmcv.cnn.bricks.transformer import FFN
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.decoders.map_decoder import refine_reference
from gsmap.models.layers.bev_pyramid import BEVPyramid
from gsmap.models.layers.multi_granularity import Granularities, mlp


class DecodedGranularities(NamedTuple):
    """What a decoder of two granularities returns.

    Attributes:
        instance_states: Instance queries after each layer; they say the class. (L, B, N, C)
        point_states: Point queries after each layer; they move the reference. (L, B, N * P, C)
        references: Refined references, float32. (L, B, N * P, D)
        mean_locations: Mean of each point's sampling locations (x, y), [0, 1] over the map, which
            MGMapNet supervises like the points; not clipped. (L, B, N, P, 2)
    """

    instance_states: Tensor
    point_states: Tensor
    references: Tensor
    mean_locations: Tensor


@MODELS.register_module()
class MGMapNetDecoderLayer(BaseModule):
    """Self-attention of the instances, attention on the BEV, and a network for each granularity.

    Args:
        embed_dims: Channels C.
        num_heads: Heads of both attentions.
        num_points: Points per instance P.
        num_levels: Levels of BEV features.
        cross_attn: Config of the attention on the BEV; it may leave out its ``type``
            (:class:`MultiGranularityAttention`).
        ffn_dims: Hidden channels of both feed-forward networks.
        dropout: Dropout of every sublayer.
        reference_dims: Entries of the reference that its position code reads; None for the learned
            position instead.
        init_cfg: As in mmengine.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 20,
        num_levels: int = 2,
        cross_attn: dict[str, Any] | None = None,
        ffn_dims: int = 512,
        dropout: float = 0.1,
        reference_dims: int | None = 2,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.num_points = num_points
        self.reference_dims = reference_dims
        self.self_attn = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.cross_attn = MODELS.build(
            {
                "type": "MultiGranularityAttention",
                "embed_dims": embed_dims,
                "num_heads": num_heads,
                "num_points": num_points,
                "num_levels": num_levels,
                "dropout": dropout,
                **(cross_attn or {}),
            }
        )
        self.ffn = FFN(embed_dims, ffn_dims, ffn_drop=dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))
        self.dropout = nn.Dropout(dropout)
        self.point_ffn = FFN(embed_dims, ffn_dims, ffn_drop=dropout)
        self.point_norm = nn.LayerNorm(embed_dims)
        self.reference_code: nn.Sequential | None = None
        if reference_dims is not None:
            self.reference_code = mlp(num_points * reference_dims, embed_dims)

    def forward(
        self,
        state: Granularities,
        query_pos: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        attn_mask: Tensor | None = None,
    ) -> Granularities:
        """Update the queries.

        Args:
            state: The queries that the layer before left.
            query_pos: Learned position of the instances. (B, N, C)
            reference: References of the points. (B, N * P, D)
            feats: BEV features, finest level first. levels x (B, C, H, W)
            attn_mask: True where an instance may not attend to another, or None. (N, N)

        Returns:
            The updated queries.
        """
        state = self.update_instances(state, query_pos, reference, feats, attn_mask)
        return state._replace(points=self.point_norm(self.point_ffn(state.points)))

    def update_instances(
        self,
        state: Granularities,
        query_pos: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        attn_mask: Tensor | None,
    ) -> Granularities:
        """Run both attentions and the instances' network; the points' own network is to come."""
        query, key = state.instances, state.instances + query_pos
        attended = self.self_attn(key, key, query, attn_mask=attn_mask, need_weights=False)[0]
        query = self.norms[0](query + self.dropout(attended))
        reference = reference.unflatten(1, (-1, self.num_points))  # (B, N, P, D)
        position = query_pos
        if self.reference_code is not None:
            position = self.reference_code(reference[..., : self.reference_dims].flatten(2))
        state = self.cross_attn(state._replace(instances=query), position, reference, feats)
        instances = self.norms[2](self.ffn(self.norms[1](state.instances)))
        return state._replace(instances=instances)


@MODELS.register_module()
class MGMapNetDecoder(BaseModule):
    """A stack of layers with instance and point queries that refine one reference (MGMapNet).

    Args:
        layer: Config of the layer; it may leave out its ``type`` (:class:`MGMapNetDecoderLayer`).
            Its ``reference_dims`` holds from the second layer on: the first has no reference that
            the points made.
        num_layers: Number of layers L.
        embed_dims: Channels C.
        num_levels: Levels of BEV features.
        init_cfg: As in mmengine.
    """

    def __init__(
        self,
        layer: dict[str, Any] | None = None,
        num_layers: int = 6,
        embed_dims: int = 256,
        num_levels: int = 2,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        layer = {
            "type": "MGMapNetDecoderLayer",
            "embed_dims": embed_dims,
            "num_levels": num_levels,
            **(layer or {}),
        }
        # Differs from the poster: the released model's first layer adds the learned position.
        first = {**layer, "reference_dims": None}
        self.bev_pyramid = BEVPyramid(embed_dims, num_levels)
        self.layers = nn.ModuleList(
            MODELS.build(layer if number else first) for number in range(num_layers)
        )

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        predict_offsets: Callable[[int, Tensor], Tensor],
        attn_mask: Tensor | None = None,
    ) -> DecodedGranularities:
        """Run all layers, each on the reference that the one before refined, the gradient cut.

        Args:
            query: Content of the instance queries. (B, N, C)
            query_pos: Their learned position. (B, N, C)
            reference: Initial references of the points. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)
            predict_offsets: Maps a layer's number and its point states (B, N * P, C) to offsets
                (B, N * P, D).
            attn_mask: True where an instance may not attend to another, or None. (N, N)

        Returns:
            States, refined references and mean sampling locations of all layers.
        """
        feats = self.bev_pyramid(bev_feats)
        state = Granularities(query)
        outputs = []
        for number, layer in enumerate(self.layers):
            state = layer(state, query_pos, reference, feats, attn_mask)
            points = state.points.flatten(1, 2)  # (B, N * P, C)
            refined = refine_reference(reference, predict_offsets(number, points))
            outputs.append((state.instances, points, refined, state.mean_locations))
            reference = refined.detach()
        return DecodedGranularities(*(torch.stack(part) for part in zip(*outputs, strict=True)))
