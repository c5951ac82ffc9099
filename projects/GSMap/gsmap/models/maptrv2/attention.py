"""Decoupled self-attention of MapTRv2."""

from mmdet3d.registry import MODELS
from torch import Tensor, nn


@MODELS.register_module()
class DecoupledSelfAttention(nn.Module):
    """Decoupled self-attention: between instances, then between the points of each (MapTRv2).

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads.
        num_points: Points P per instance.
        dropout: Probability of dropping an attention weight or an output channel in training.
    """

    def __init__(
        self, embed_dims: int = 256, num_heads: int = 8, num_points: int = 20, dropout: float = 0.1
    ) -> None:
        super().__init__()
        self.num_points = num_points
        settings = {"num_heads": num_heads, "dropout": dropout, "batch_first": True}
        self.instance_attn = nn.MultiheadAttention(embed_dims, **settings)
        self.norm = nn.LayerNorm(embed_dims)
        self.point_attn = nn.MultiheadAttention(embed_dims, **settings)
        self.dropout = nn.Dropout(dropout)

    def forward(self, query: Tensor, query_pos: Tensor, attn_mask: Tensor | None = None) -> Tensor:
        """Update the point queries.

        Point p of an instance attends to point p of the other instances; then the points of each
        instance attend to each other.

        Args:
            query: Point queries, instance after instance. (B, N * P, C)
            query_pos: Positional queries. (B, N * P, C)
            attn_mask: True where an instance may not attend to another one. (N, N)

        Returns:
            The queries plus both attentions. (B, N * P, C)
        """
        batch = len(query)
        query = query.unflatten(1, (-1, self.num_points))  # (B, N, P, C)
        query_pos = query_pos.unflatten(1, (-1, self.num_points))
        query = query.transpose(1, 2).flatten(0, 1)  # (B * P, N, C)
        instance_pos = query_pos.transpose(1, 2).flatten(0, 1)
        query = self.norm(self._attend(self.instance_attn, query, pos=instance_pos, mask=attn_mask))
        query = query.unflatten(0, (batch, -1)).transpose(1, 2).flatten(0, 1)  # (B * N, P, C)
        point_pos = query_pos.flatten(0, 1)
        # The decoder layer normalises the result.
        query = self._attend(self.point_attn, query, pos=point_pos, mask=None)
        return query.unflatten(0, (batch, -1)).flatten(1, 2)  # (B, N * P, C)

    def _attend(
        self, attention: nn.MultiheadAttention, query: Tensor, pos: Tensor, mask: Tensor | None
    ) -> Tensor:
        """Apply one attention with its residual."""
        # The positions are part of queries and keys, but not of values.
        query_with_pos = query + pos
        attended, _ = attention(
            query=query_with_pos,
            key=query_with_pos,
            value=query,
            attn_mask=mask,
            need_weights=False,
        )
        return query + self.dropout(attended)
