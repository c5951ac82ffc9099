"""StreamMapNet's decoder: instance queries of twice the map's channels, whose lines they refine."""

from typing import Any

import torch
from mmdet.models.layers import SinePositionalEncoding
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, MapDecoder, MapDecoderLayer


@MODELS.register_module()
class StreamMapNetDecoderLayer(MapDecoderLayer):
    """`MapDecoderLayer` for instance queries, with `LinePointAttention` at their points."""

    def __init__(
        self,
        embed_dims: int = 512,
        num_points: int = 20,
        ffn_dims: int = 1024,
        self_attn: dict[str, Any] | None = None,
        cross_attn: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        sampling = {"type": "LinePointAttention", "num_points": num_points}
        super().__init__(
            embed_dims,
            ffn_dims=ffn_dims,
            self_attn={"num_points": 1, **(self_attn or {})},
            cross_attn={**sampling, **(cross_attn or {})},
            **kwargs,
        )

    def forward(self, query: Tensor, query_pos: Tensor, *inputs: Any) -> Tensor:
        """Update the instance queries (B, N, C); their learned position is not used."""
        return super().forward(query, torch.zeros_like(query_pos), *inputs)


@MODELS.register_module()
class StreamMapNetDecoder(MapDecoder):
    """A stack of layers on instance queries, which have no position (StreamMapNet).

    The map's features are widened by one convolution and get a sine code, the only position there
    is. Besides `MapDecoder`'s arguments:

    Args:
        embed_dims: Channels C of the queries.
        bev_dims: Channels of the BEV features; None means ``embed_dims``.
    """

    point_queries = False
    layer_class = StreamMapNetDecoderLayer

    def __init__(
        self,
        layer: dict[str, Any] | None = None,
        embed_dims: int = 512,
        bev_dims: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(layer or {}, embed_dims=embed_dims, **kwargs)
        self.input_proj = nn.Conv2d(bev_dims or embed_dims, embed_dims, 1)
        self.code = SinePositionalEncoding(embed_dims // 2, normalize=True)

    def start(
        self, query: Tensor, reference: Tensor, bev_feats: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries, references of their points (B, N * P, D) and features with a code."""
        cells = bev_feats.new_zeros((1, *bev_feats.shape[-2:]), dtype=torch.bool)
        code = self.code(cells).flip(2)  # rows are counted from the largest y
        points = reference.unflatten(-1, (self.num_points, -1)).flatten(1, 2)
        return query, points, self.input_proj(bev_feats) + code

    def point_states(self, state: Tensor) -> Tensor:
        """Return the states that move the lines: those of the instances. (B, N, C)"""
        return state

    def read(self, state: Tensor, references: Tensor) -> Decoded:
        """Return a layer's output; an instance's points share its state. (B, N * P, D)"""
        points = state[:, :, None].expand(-1, -1, self.num_points, -1)
        return Decoded(points, self.by_instance(references), state)
