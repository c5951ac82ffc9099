"""MapTRv2's decoupled self-attention: among instances, then among the points of each."""

from typing import Any

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.decoders.map_decoder import MapDecoderLayer


@MODELS.register_module()
class DecoupledDecoderLayer(MapDecoderLayer):
    """MapTR's decoder layer with two small self-attentions in place of one over all points.

    Args:
        num_points: Points per instance P.
        **kwargs: Arguments of the base layer.
    """

    num_norms = 4

    def __init__(self, num_points: int = 20, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.num_points = num_points
        first = self.self_attn
        self.point_attn = nn.MultiheadAttention(
            first.embed_dim, first.num_heads, first.dropout, batch_first=True
        )

    def interact(self, query: Tensor, query_pos: Tensor, attn_mask: Tensor | None) -> Tensor:
        """Let point p of all instances attend to each other, then the points of each instance.

        Args:
            query: Content of the point queries. (B, N * P, C)
            query_pos: Their position. (B, N * P, C)
            attn_mask: True where an instance may not attend to another, or None. (N, N)

        Returns:
            Updated queries, each step with residual and norm. (B, N * P, C)
        """
        batch = len(query)
        per_instance = [x.unflatten(1, (-1, self.num_points)) for x in (query, query_pos)]
        query, query_pos = (x.transpose(1, 2).flatten(0, 1) for x in per_instance)  # (B * P, N, C)
        query = self.norms[0](self._attend(self.self_attn, query, query_pos, attn_mask))
        query = query.unflatten(0, (batch, -1)).transpose(1, 2).flatten(0, 1)  # (B * N, P, C)
        query_pos = per_instance[1].flatten(0, 1)
        query = self.norms[1](self._attend(self.point_attn, query, query_pos, None))
        return query.unflatten(0, (batch, -1)).flatten(1, 2)

    def _attend(
        self, attention: nn.MultiheadAttention, query: Tensor, pos: Tensor, mask: Tensor | None
    ) -> Tensor:
        """Apply one self-attention with its residual."""
        key = query + pos
        attended = attention(key, key, query, attn_mask=mask, need_weights=False)[0]
        return query + self.dropout(attended)
