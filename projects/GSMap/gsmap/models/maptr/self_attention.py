"""Self-attention of point queries.

A self-attention is made of ``embed_dims`` channels C, ``num_heads``, ``num_points`` per instance P
and a ``dropout``. It takes point queries, instance after instance (B, N * P, C), their position,
and a mask, True where an instance may not attend to another (N, N) or None. It returns the queries
with its residual; the layer normalises them.
"""

from mmdet3d.registry import MODELS
from torch import Tensor, nn


@MODELS.register_module()
class PointSelfAttention(nn.MultiheadAttention):
    """One attention over all points of all instances (MapTR)."""

    def __init__(
        self, embed_dims: int = 256, num_heads: int = 8, num_points: int = 20, dropout: float = 0.1
    ) -> None:
        super().__init__(embed_dims, num_heads, dropout, batch_first=True)
        self.num_points = num_points
        self.output_dropout = nn.Dropout(dropout)

    def forward(  # type: ignore[override]
        self, query: Tensor, query_pos: Tensor, attn_mask: Tensor | None = None
    ) -> Tensor:
        """Let all points attend to each other. (B, N * P, C) -> (B, N * P, C)"""
        attn_mask = mask_of_points(attn_mask, self.num_points)
        key = query + query_pos
        attended = super().forward(key, key, query, attn_mask=attn_mask, need_weights=False)[0]
        return query + self.output_dropout(attended)


def mask_of_points(mask: Tensor | None, num_points: int) -> Tensor | None:
    """Return a mask of instances (N, N) as one of their points. (N * P, N * P)"""
    if mask is None:
        return None
    return mask.repeat_interleave(num_points, 0).repeat_interleave(num_points, 1)
