"""GeMap's self-attention, among the points of other instances and within each instance."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.layers import mlp


class _AttentionBlock(nn.Module):
    """Attention and feed-forward, each normalised *before* its residual is added."""

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.norm1 = nn.LayerNorm(embed_dims)
        self.ffn = mlp(embed_dims, ffn_dims, embed_dims)
        self.norm2 = nn.LayerNorm(embed_dims)

    def forward(self, query: Tensor, attn_mask: Tensor | None = None) -> Tensor:
        """Let queries attend to each other but where the mask (Q, Q) is True. (B, Q, C)"""
        attended = self.attention(query, query, query, attn_mask=attn_mask, need_weights=False)[0]
        query = self.norm1(attended) + query
        return self.norm2(self.ffn(query)) + query


@MODELS.register_module()
class GeometryDecoupledAttention(nn.Module):
    """To all points of other instances, then within each (GeMap, arXiv 2312.03341).

    Differs from the released code in its cost alone: there, the second step is an attention among
    all N * P points with a mask, here one among P points per instance. ``ffn_dims`` are the hidden
    channels of both feed-forward networks.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 20,
        ffn_dims: int = 1024,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.num_points = num_points
        self.inter = _AttentionBlock(embed_dims, num_heads, ffn_dims, dropout)
        self.intra = _AttentionBlock(embed_dims, num_heads, ffn_dims, dropout)

    def forward(
        self, query: Tensor, query_pos: Tensor | None = None, attn_mask: Tensor | None = None
    ) -> Tensor:
        """Let points attend to other instances, then within theirs; there is no position.

        ValueError if the queries are not two or more instances of P points.
        """
        batch, count = query.shape[:2]
        if count % self.num_points or count < 2 * self.num_points:
            raise ValueError(
                f"need two or more instances of num_points {self.num_points} queries each, "
                f"got {count} queries."
            )
        blocked = torch.eye(count // self.num_points, dtype=torch.bool, device=query.device)
        if attn_mask is not None:
            blocked = blocked | attn_mask
        blocked = blocked.repeat_interleave(self.num_points, 0)
        query = self.inter(query, blocked.repeat_interleave(self.num_points, 1))
        query = self.intra(query.reshape(-1, self.num_points, query.shape[-1]))  # (B * N, P, C)
        return query.reshape(batch, count, -1)
