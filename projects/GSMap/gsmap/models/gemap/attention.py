"""Geometry-decoupled self-attention of GeMap: between instances, then within each of them."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.layers import mlp
from gsmap.utils.errors import InputError


class _AttentionBlock(nn.Module):
    """Self-attention and feed-forward network, each normalised *before* its residual is added."""

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.norm1 = nn.LayerNorm(embed_dims)
        self.ffn = mlp(embed_dims, ffn_dims, embed_dims)
        self.norm2 = nn.LayerNorm(embed_dims)

    def forward(self, query: Tensor, attn_mask: Tensor | None = None) -> Tensor:
        """Update queries (B, Q, C). The mask (Q, Q) is True where attention is blocked."""
        attended, _ = self.attention(query, query, query, attn_mask=attn_mask, need_weights=False)
        query = self.norm1(attended) + query
        return self.norm2(self.ffn(query)) + query


@MODELS.register_module()
class GeometryDecoupledAttention(nn.Module):
    """Self-attention to the points of other instances, then within each instance (GeMap).

    The released code computes the second step as a masked attention among all N * P points. Here it
    is an attention among the P points of each instance, with an equal result.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads.
        num_points: Points P per instance.
        ffn_dims: Hidden channels of both feed-forward networks.
        dropout: Probability of dropping an attention weight in training.
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
        self.inter = _AttentionBlock(
            embed_dims, num_heads=num_heads, ffn_dims=ffn_dims, dropout=dropout
        )
        self.intra = _AttentionBlock(
            embed_dims, num_heads=num_heads, ffn_dims=ffn_dims, dropout=dropout
        )

    def forward(
        self, query: Tensor, query_pos: Tensor | None = None, attn_mask: Tensor | None = None
    ) -> Tensor:
        """Update the point queries.

        Args:
            query: Point queries, instance after instance. (B, N * P, C)
            query_pos: Not used: GeMap has no positional encoding here.
            attn_mask: True where an instance may not attend to another one. (N, N)

        Returns:
            The updated queries. (B, N * P, C)

        Raises:
            ValueError: If there are fewer than two instances, or not P queries for each.
        """
        batch, num_queries = query.shape[:2]
        if num_queries % self.num_points or num_queries < 2 * self.num_points:
            raise InputError(
                f"need two or more instances of num_points {self.num_points} queries each, "
                f"got {num_queries} queries."
            )
        num_instances = num_queries // self.num_points
        # The first step has no attention within an instance, so there must be another instance.
        blocked = torch.eye(num_instances, dtype=torch.bool, device=query.device)
        if attn_mask is not None:
            blocked = blocked | attn_mask
        # Repeat each row and column for the P points of its instance.
        blocked = blocked.repeat_interleave(self.num_points, 0)
        blocked = blocked.repeat_interleave(self.num_points, 1)  # (N * P, N * P)
        query = self.inter(query, blocked)
        by_instance = query.reshape(-1, self.num_points, query.shape[-1])  # (B * N, P, C)
        return self.intra(by_instance).reshape(batch, num_queries, -1)
