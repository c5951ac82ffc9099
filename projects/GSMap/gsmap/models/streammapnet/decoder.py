"""StreamMapNet's decoder, in which instance queries refine the points of their lines."""

from typing import Any

import torch
from mmdet.models.layers import SinePositionalEncoding
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, MapDecoder, MapDecoderLayer


@MODELS.register_module()
class StreamMapNetDecoderLayer(MapDecoderLayer):
    """`MapDecoderLayer` of instance queries.

    Its cross-attention is `LinePointAttention`: each query samples the BEV features near each point
    of its line.

    Args:
        embed_dims: Channels C of the queries.
        num_points: Points per instance P.
        ffn_dims: Hidden channels of the feed-forward network.
        self_attn: Settings of the self-attention.
        cross_attn: Settings of the cross-attention.
        kwargs: Further arguments of `MapDecoderLayer`.
    """

    def __init__(
        self,
        embed_dims: int = 512,
        num_points: int = 20,
        ffn_dims: int = 1024,
        self_attn: dict[str, Any] | None = None,
        cross_attn: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        # Self-attention is between instances: each of them has one query instead of P.
        self_attn_defaults = {"num_points": 1}
        cross_attn_defaults = {"type": "LinePointAttention", "num_points": num_points}
        super().__init__(
            embed_dims,
            ffn_dims=ffn_dims,
            self_attn={**self_attn_defaults, **(self_attn or {})},
            cross_attn={**cross_attn_defaults, **(cross_attn or {})},
            **kwargs,
        )

    def forward(self, query: Tensor, query_pos: Tensor, *inputs: Any) -> Tensor:
        """Update the instance queries; their learned position is ignored.

        Args:
            query: Instance queries. (B, N, C)
            query_pos: Learned positions, of which only the shape is used. (B, N, C)
            inputs: Further arguments of `MapDecoderLayer.forward`.

        Returns:
            Updated queries. (B, N, C)
        """
        return super().forward(query, torch.zeros_like(query_pos), *inputs)


@MODELS.register_module()
class StreamMapNetDecoder(MapDecoder):
    """Decoder of instance queries without a positional embedding (StreamMapNet).

    A convolution projects the BEV features to the channels of the queries, and a sine encoding of
    the cells is added.

    Args:
        layer: Settings of `StreamMapNetDecoderLayer`.
        embed_dims: Channels C of the queries.
        bev_dims: Channels C' of the BEV features; None for ``embed_dims``.
        kwargs: Further arguments of `MapDecoder`.
    """

    point_queries = False  # the queries are of instances (B, N, C), not of points (B, N * P, C)
    layer_class = StreamMapNetDecoderLayer

    def __init__(
        self,
        layer: dict[str, Any] | None = None,
        embed_dims: int = 512,
        bev_dims: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(layer or {}, embed_dims=embed_dims, **kwargs)
        self.input_proj = nn.Conv2d(bev_dims or embed_dims, embed_dims, kernel_size=1)
        # Half of the channels encode the row of a cell, the other half its column.
        self.code = SinePositionalEncoding(embed_dims // 2, normalize=True)

    def start(
        self, query: Tensor, reference: Tensor, bev_feats: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Prepare the inputs of the layers.

        Args:
            query: Instance queries. (B, N, C)
            reference: Initial lines: the references of all points of a query, D values for each.
                (B, N, P * D)
            bev_feats: BEV features. (B, C', H, W)

        Returns:
            Instance queries (B, N, C), references of their points (B, N * P, D), and projected BEV
            features with the sine encoding (B, C, H, W).
        """
        # The encoding takes a mask of the cells to leave out: none.
        cells = bev_feats.new_zeros((1, *bev_feats.shape[-2:]), dtype=torch.bool)
        # The first row of StreamMapNet's encoding is at the largest y, but the first row of the BEV
        # features is at the smallest y.
        code = self.code(cells).flip(2)
        points = reference.unflatten(-1, (self.num_points, -1)).flatten(1, 2)
        return query, points, self.input_proj(bev_feats) + code

    def point_states(self, state: Tensor) -> Tensor:
        """Return the states from which the lines are refined, one per instance. (B, N, C)

        The state of an instance refines all its points at once.
        """
        return state

    def read(self, state: Tensor, references: Tensor) -> Decoded:
        """Return the output of a layer, in which all points of an instance share its state.

        Args:
            state: States of the instances. (B, N, C)
            references: Refined references of the points. (B, N * P, D)
        """
        point_states = state[:, :, None].expand(-1, -1, self.num_points, -1)  # (B, N, P, C)
        return Decoded(point_states, self.by_instance(references), instance_states=state)
