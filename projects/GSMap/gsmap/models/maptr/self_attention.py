"""Self-attention of point queries.

Every self-attention that a decoder layer can use has this interface. Its constructor takes
``embed_dims`` (channels C), ``num_heads``, ``num_points`` (points P per instance) and ``dropout``.
The inputs of its call are point queries, instance after instance (B, N * P, C), positional queries
of equal shape, and a mask (N, N) or None. The mask is True where an instance may not attend to
another one. The output is the sum of queries and attention; the decoder layer normalises it.
"""

from mmdet3d.registry import MODELS
from torch import Tensor, nn


@MODELS.register_module()
class PointSelfAttention(nn.MultiheadAttention):
    """One attention over all points of all instances (MapTR).

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads.
        num_points: Points P per instance.
        dropout: Probability to drop an attention weight or an output channel in training.
    """

    def __init__(
        self, embed_dims: int = 256, num_heads: int = 8, num_points: int = 20, dropout: float = 0.1
    ) -> None:
        super().__init__(embed_dims, num_heads=num_heads, dropout=dropout, batch_first=True)
        self.num_points = num_points
        self.output_dropout = nn.Dropout(dropout)

    def forward(  # type: ignore[override]
        self, query: Tensor, query_pos: Tensor, attn_mask: Tensor | None = None
    ) -> Tensor:
        """Update the point queries.

        Args:
            query: Point queries, instance after instance. (B, N * P, C)
            query_pos: Positional queries. (B, N * P, C)
            attn_mask: True where an instance may not attend to another one; None allows all pairs.
                (N, N)

        Returns:
            The queries plus the attention. (B, N * P, C)
        """
        point_mask = mask_of_points(attn_mask, num_points=self.num_points)
        # Positions influence the attention weights, but they are not part of the attended values.
        positioned_query = query + query_pos
        attended, _ = super().forward(
            query=positioned_query,
            key=positioned_query,
            value=query,
            attn_mask=point_mask,
            need_weights=False,
        )
        return query + self.output_dropout(attended)


def mask_of_points(mask: Tensor | None, num_points: int) -> Tensor | None:
    """Expand a mask of instances to their points. (N, N) -> (N * P, N * P)"""
    if mask is None:
        return None
    mask = mask.repeat_interleave(num_points, dim=0)
    return mask.repeat_interleave(num_points, dim=1)
