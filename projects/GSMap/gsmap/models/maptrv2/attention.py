"""MapTRv2's self-attention."""

from mmdet3d.registry import MODELS
from torch import Tensor, nn


@MODELS.register_module()
class DecoupledSelfAttention(nn.Module):
    """Two small attentions: among instances, then among the points of each (MapTRv2)."""

    def __init__(
        self, embed_dims: int = 256, num_heads: int = 8, num_points: int = 20, dropout: float = 0.1
    ) -> None:
        super().__init__()
        self.num_points = num_points
        self.instance_attn = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.norm = nn.LayerNorm(embed_dims)
        self.point_attn = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.dropout = nn.Dropout(dropout)

    def forward(self, query: Tensor, query_pos: Tensor, attn_mask: Tensor | None = None) -> Tensor:
        """Let point p of all instances attend to each other, then the points of each instance."""
        batch = len(query)
        per_instance = [x.unflatten(1, (-1, self.num_points)) for x in (query, query_pos)]
        query, query_pos = (x.transpose(1, 2).flatten(0, 1) for x in per_instance)  # (B * P, N, C)
        query = self.norm(self._attend(self.instance_attn, query, query_pos, attn_mask))
        query = query.unflatten(0, (batch, -1)).transpose(1, 2).flatten(0, 1)  # (B * N, P, C)
        query_pos = per_instance[1].flatten(0, 1)
        query = self._attend(self.point_attn, query, query_pos, None)
        return query.unflatten(0, (batch, -1)).flatten(1, 2)

    def _attend(
        self, attention: nn.MultiheadAttention, query: Tensor, pos: Tensor, mask: Tensor | None
    ) -> Tensor:
        """Apply one attention with its residual."""
        key = query + pos
        attended = attention(key, key, query, attn_mask=mask, need_weights=False)[0]
        return query + self.dropout(attended)
